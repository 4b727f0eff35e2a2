//! project_backward: gradients of 2D Gaussians -> gradients of the visible splats' parameters and of the pose.
//!
//! After `raster_backward`. Also adds the regularisers, which act on visible splats. Equations: docs/GRADIENTS.md,
//! projection and pose.

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

use crate::cpu::bin::Tiles;
use crate::cpu::project::{CHUNK, Camera, ProjectedSplat, Shape, shape_direction, sigmoid};
use crate::cpu::raster_backward::{InstanceGradient, InstanceGradients};
use crate::settings::StepSettings;
use crate::sh;
use splat_types::splats::splats::Splats;

/// d loss / d parameters, one entry per visible splat.
#[derive(Debug, Default)]
pub struct SplatGradients {
    pub means: Vec<[f32; 3]>,
    pub log_scales: Vec<[f32; 3]>,
    pub quats: Vec<[f32; 4]>,
    pub opacity_logits: Vec<f32>,
    /// d loss / d projected mean, per pixel.
    pub centers: Vec<[f32; 2]>,
    /// `sh_stride` numbers a splat, the active bands only.
    pub sh: Vec<f32>,
    pub sh_stride: usize,
    /// false: a number is not finite and the splat must not be updated.
    pub is_finite: Vec<bool>,
    /// d loss / d (rho, theta) of `exp([rho; theta]) * cam_from_world` at 0.
    pub pose: [f64; 6],
    /// d loss / d s at 0, where `exp(s)` multiplies both focal lengths.
    pub log_focal: f64,
    /// Part of the loss that the regularisers are.
    pub regulariser: f64,
    partials: Vec<Partial>,
}

/// What a chunk of splats adds to the sums over all.
#[derive(Debug, Clone, Copy, Default)]
struct Partial {
    rho: DVec3,
    theta: DVec3,
    log_focal: f64,
    opacity: f64,
    scale: f64,
}

/// What the forward stages left of an image.
#[derive(Debug, Clone, Copy)]
pub struct Forward<'a> {
    pub splats: &'a Splats,
    pub camera: &'a Camera,
    pub visible: &'a [ProjectedSplat],
    pub tiles: &'a Tiles,
}

/// Gradient of one splat in f64.
struct Gradient {
    mean: DVec3,
    log_scale: DVec3,
    quat: [f64; 4],
    opacity_logit: f64,
    rho: DVec3,
    theta: DVec3,
    log_focal: f64,
}

/// Sums the instances of each visible splat and takes them through the projection.
pub fn project_backward(
    forward: Forward<'_>,
    instances: &InstanceGradients,
    settings: &StepSettings,
    out: &mut SplatGradients,
) {
    let degree = settings.sh_degree.min(forward.splats.sh_degree);
    out.resize(forward.visible.len(), degree);
    let stride = out.sh_stride;
    let chunks = (
        forward.visible.par_chunks(CHUNK),
        out.means.par_chunks_mut(CHUNK),
        out.log_scales.par_chunks_mut(CHUNK),
        out.quats.par_chunks_mut(CHUNK),
        out.opacity_logits.par_chunks_mut(CHUNK),
        out.centers.par_chunks_mut(CHUNK),
        out.sh.par_chunks_mut(CHUNK * stride),
        out.is_finite.par_chunks_mut(CHUNK),
        out.partials.par_iter_mut(),
    );
    chunks.into_par_iter().enumerate().for_each(
        |(c, (visible, means, log_scales, quats, logits, centers, sh, is_finite, partial))| {
            *partial = Partial::default();
            let mut sums = [InstanceGradient::default(); CHUNK];
            // All at once: the slots are scattered over memory, and in one short loop their loads overlap.
            for (k, sum) in sums[..visible.len()].iter_mut().enumerate() {
                *sum = forward.sum_instances(c * CHUNK + k, instances);
            }
            for (k, (projected, sum)) in visible.iter().zip(&sums).enumerate() {
                let sh = &mut sh[k * stride..(k + 1) * stride];
                let gradient = forward.splat_gradient(projected, sum, settings, sh, partial);
                means[k] = gradient.mean.as_vec3().to_array();
                log_scales[k] = gradient.log_scale.as_vec3().to_array();
                quats[k] = gradient.quat.map(|g| g as f32);
                logits[k] = gradient.opacity_logit as f32;
                centers[k] = sum.center;
                let geometry = [&means[k][..], &log_scales[k], &quats[k], &logits[k..=k]];
                is_finite[k] = geometry.iter().all(|part| all_finite(part)) && all_finite(sh);
                if is_finite[k] {
                    partial.rho += gradient.rho;
                    partial.theta += gradient.theta;
                    partial.log_focal += gradient.log_focal;
                }
            }
        },
    );
    out.sum_partials(settings);
}

impl Forward<'_> {
    /// In the order of tiles, so that the sum is the same on any number of threads.
    fn sum_instances(&self, visible_ix: usize, instances: &InstanceGradients) -> InstanceGradient {
        let mut sum = InstanceGradient::default();
        let [first, end] = self.tiles.place_ranges[visible_ix];
        for &[tile, place] in &self.tiles.places[first as usize..end as usize] {
            let [start, end] = [0, 1].map(|next| instances.starts[tile as usize + next]);
            // Behind a full tile there is no slot.
            if start + place < end {
                sum.add(&instances.slots[(start + place) as usize]);
            }
        }
        sum
    }

    /// E.4 and E.5: `g_x` is d loss / d x. Writes the gradient of SH into `sh`, adds to the sums of the regularisers.
    fn splat_gradient(
        &self,
        projected: &ProjectedSplat,
        sums: &InstanceGradient,
        settings: &StepSettings,
        sh: &mut [f32],
        partial: &mut Partial,
    ) -> Gradient {
        let ix = projected.splat_ix as usize;
        let mean = self.splats.means[ix];
        let Some(shape) = Shape::new(
            mean,
            self.splats.log_scales[ix],
            self.splats.quats[ix],
            self.camera,
        ) else {
            return Gradient::NONE;
        };
        let g_direction = self.sh_gradient(projected, sums, sh);
        let g_cov2d = cov2d_gradient(&shape, sums.conic.map(f64::from));
        let [j0, j1] = shape.jacobian;
        let [g00, g01, g11] = g_cov2d;
        let cov_in_cam = shape.root_in_cam * shape.root_in_cam.transpose();
        // J^T G2 J as a sum of outer products, and 2 G2 J Sc row by row.
        let g_cov_in_cam = outer(j0, j0 * g00 + j1 * g01) + outer(j1, j0 * g01 + j1 * g11);
        let g_j0 = 2.0 * (cov_in_cam * (j0 * g00 + j1 * g01));
        let g_j1 = 2.0 * (cov_in_cam * (j0 * g01 + j1 * g11));
        let g_center = DVec2::new(f64::from(sums.center[0]), f64::from(sums.center[1]));
        let g_in_cam = position_gradient(&shape, self.camera, g_center, [g_j0, g_j1])
            + DVec3::Z * f64::from(sums.depth);

        let back = self.camera.rotation.transpose();
        let g_cov = back * g_cov_in_cam * self.camera.rotation;
        let g_root = 2.0 * (g_cov * shape.rotation * DMat3::from_diagonal(shape.scale));
        let g_scale =
            DVec3::from_array([0, 1, 2].map(|k| shape.rotation.col(k).dot(g_root.col(k))));
        let g_rotation = g_root * DMat3::from_diagonal(shape.scale);

        let opacity = f64::from(sigmoid(self.splats.opacity_logits[ix]));
        let n_regularised = if settings.all_splats {
            self.splats.len() as f64
        } else {
            self.visible.len() as f64
        };
        let g_opacity =
            f64::from(sums.opacity) + f64::from(settings.weights.opacity_reg) / n_regularised;
        let g_scale = g_scale + f64::from(settings.weights.scale_reg) / (3.0 * n_regularised);
        partial.opacity += opacity;
        partial.scale += shape.scale.element_sum();

        let twist = cov_in_cam * g_cov_in_cam - g_cov_in_cam * cov_in_cam;
        Gradient {
            mean: back * g_in_cam + g_direction,
            log_scale: shape.scale * g_scale,
            quat: quat_gradient(&shape, &g_rotation),
            opacity_logit: g_opacity * opacity * (1.0 - opacity),
            rho: g_in_cam + self.camera.rotation * g_direction,
            theta: shape.mean_in_cam.cross(g_in_cam)
                + 2.0 * DVec3::new(twist.col(2).y, twist.col(0).z, twist.col(1).x),
            log_focal: log_focal_gradient(&shape, self.camera, g_center, [g_j0, g_j1]),
        }
    }

    /// Returns the gradient of the mean through the viewing direction.
    fn sh_gradient(
        &self,
        projected: &ProjectedSplat,
        sums: &InstanceGradient,
        sh: &mut [f32],
    ) -> DVec3 {
        let ix = projected.splat_ix as usize;
        let n_coefficients = sh.len() / 3;
        let degree = (n_coefficients.isqrt() - 1) as u8;
        let dir = shape_direction(self.splats.means[ix], self.camera);
        let basis = sh::basis(dir, degree);
        // Where SH was clamped at black, nothing flows.
        let g_color: [f64; 3] = std::array::from_fn(|c| {
            if projected.color[c] > 0.0 {
                f64::from(sums.color[c])
            } else {
                0.0
            }
        });
        let stride = self.splats.sh_stride();
        let (coefficients, _) = self.splats.sh[ix * stride..(ix + 1) * stride].as_chunks::<3>();
        let (out, _) = sh.as_chunks_mut::<3>();
        let mut weights = [0.0; sh::MAX_COEFFICIENTS];
        for (b, (out, k)) in out.iter_mut().zip(coefficients).enumerate() {
            *out = g_color.map(|g| (basis[b] * g) as f32);
            weights[b] = k.iter().zip(&g_color).map(|(&k, g)| f64::from(k) * g).sum();
        }
        let g_dir = sh::basis_gradient(dir, degree, &weights);
        let distance = (crate::cpu::project::vec3(self.splats.means[ix])
            - self.camera.center_in_world)
            .length();
        (g_dir - dir * g_dir.dot(dir)) / distance
    }
}

/// Without a branch per number, so that it vectorises.
fn all_finite(numbers: &[f32]) -> bool {
    numbers.iter().fold(true, |all, x| all & x.is_finite())
}

/// Conic to 2D covariance: -Q GQ Q, upper triangle.
fn cov2d_gradient(shape: &Shape, g_conic: [f64; 3]) -> [f64; 3] {
    let [s00, s01, s11] = shape.cov;
    let (a, b, c) = (s11 / shape.det, -s01 / shape.det, s00 / shape.det);
    let [ga, gb, gc] = [g_conic[0], 0.5 * g_conic[1], g_conic[2]];
    // Rows of GQ Q.
    let (r00, r01) = (ga * a + gb * b, ga * b + gb * c);
    let (r10, r11) = (gb * a + gc * b, gb * b + gc * c);
    [
        -(a * r00 + b * r10),
        -(a * r01 + b * r11),
        -(b * r01 + c * r11),
    ]
}

/// Through the pixel and through the Jacobian, not through the depth channel.
fn position_gradient(
    shape: &Shape,
    camera: &Camera,
    g_center: DVec2,
    [g_j0, g_j1]: [DVec3; 2],
) -> DVec3 {
    let p = shape.mean_in_cam;
    let (focal, inv_z) = (DVec2::new(camera.fx, camera.fy), 1.0 / p.z);
    let g_diagonal = DVec2::new(g_j0.x, g_j1.y);
    let g_slope = DVec2::new(g_j0.z, g_j1.z);
    // A clamped slope depends on z alone, a free one on x and twice on z.
    let free = DVec2::from_array(
        shape
            .is_clamped
            .map(|is_clamped| if is_clamped { 0.0 } else { 1.0 }),
    );
    let g_xy = focal * inv_z * g_center - free * focal * inv_z * inv_z * g_slope;
    let g_z = -focal * p.truncate() * inv_z * inv_z * g_center - focal * inv_z * inv_z * g_diagonal
        + (1.0 + free) * focal * shape.slope * inv_z * inv_z * g_slope;
    g_xy.extend(g_z.element_sum())
}

/// Both focal lengths times `exp(s)`: through the pixel and through the Jacobian. A held slope is as the inverse of
/// the focal length, so its entry of the Jacobian stays.
fn log_focal_gradient(
    shape: &Shape,
    camera: &Camera,
    g_center: DVec2,
    [g_j0, g_j1]: [DVec3; 2],
) -> f64 {
    let p = shape.mean_in_cam;
    let of_axis = |axis: usize, focal: f64, g_diagonal: f64, g_slope: f64| {
        let free = if shape.is_clamped[axis] { 0.0 } else { 1.0 };
        let by_slope = free * shape.slope[axis] * g_slope;
        focal / p.z * (p[axis] * g_center[axis] + g_diagonal - by_slope)
    };
    of_axis(0, camera.fx, g_j0.x, g_j0.z) + of_axis(1, camera.fy, g_j1.y, g_j1.z)
}

/// Rotation matrix to the stored quaternion, through its normalisation.
fn quat_gradient(shape: &Shape, g_rotation: &DMat3) -> [f64; 4] {
    let [w, x, y, z] = shape.quat;
    let g = |row: usize, column: usize| g_rotation.col(column - 1)[row - 1];
    let unit = [
        2.0 * (x * (g(3, 2) - g(2, 3)) + y * (g(1, 3) - g(3, 1)) + z * (g(2, 1) - g(1, 2))),
        2.0 * (-2.0 * x * (g(2, 2) + g(3, 3))
            + y * (g(2, 1) + g(1, 2))
            + z * (g(3, 1) + g(1, 3))
            + w * (g(3, 2) - g(2, 3))),
        2.0 * (x * (g(2, 1) + g(1, 2)) - 2.0 * y * (g(1, 1) + g(3, 3))
            + z * (g(3, 2) + g(2, 3))
            + w * (g(1, 3) - g(3, 1))),
        2.0 * (x * (g(3, 1) + g(1, 3)) + y * (g(3, 2) + g(2, 3)) - 2.0 * z * (g(1, 1) + g(2, 2))
            + w * (g(2, 1) - g(1, 2))),
    ];
    let along: f64 = unit.iter().zip(&shape.quat).map(|(g, q)| g * q).sum();
    std::array::from_fn(|i| (unit[i] - along * shape.quat[i]) / shape.quat_length)
}

/// `a b^T`.
fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

impl Gradient {
    const NONE: Self = Self {
        mean: DVec3::ZERO,
        log_scale: DVec3::ZERO,
        quat: [0.0; 4],
        opacity_logit: 0.0,
        rho: DVec3::ZERO,
        theta: DVec3::ZERO,
        log_focal: 0.0,
    };
}

impl InstanceGradient {
    #[inline(always)]
    fn add(&mut self, other: &Self) {
        for (sum, x) in self.center.iter_mut().zip(other.center) {
            *sum += x;
        }
        for (sum, x) in self.conic.iter_mut().zip(other.conic) {
            *sum += x;
        }
        for (sum, x) in self.color.iter_mut().zip(other.color) {
            *sum += x;
        }
        self.opacity += other.opacity;
        self.depth += other.depth;
    }
}

impl SplatGradients {
    fn resize(&mut self, n: usize, degree: u8) {
        self.sh_stride = 3 * sh::n_coefficients(degree);
        self.means.resize(n, [0.0; 3]);
        self.log_scales.resize(n, [0.0; 3]);
        self.quats.resize(n, [0.0; 4]);
        self.opacity_logits.resize(n, 0.0);
        self.centers.resize(n, [0.0; 2]);
        self.sh.resize(n * self.sh_stride, 0.0);
        self.is_finite.resize(n, true);
        self.partials.resize(n.div_ceil(CHUNK), Partial::default());
    }

    /// In order of chunks, f64: the same on any number of threads.
    fn sum_partials(&mut self, settings: &StepSettings) {
        let mut sum = Partial::default();
        for partial in &self.partials {
            sum.rho += partial.rho;
            sum.theta += partial.theta;
            sum.log_focal += partial.log_focal;
            sum.opacity += partial.opacity;
            sum.scale += partial.scale;
        }
        self.pose = [
            sum.rho.x,
            sum.rho.y,
            sum.rho.z,
            sum.theta.x,
            sum.theta.y,
            sum.theta.z,
        ];
        self.log_focal = sum.log_focal;
        let n = self.means.len().max(1) as f64;
        self.regulariser = f64::from(settings.weights.opacity_reg) * sum.opacity / n
            + f64::from(settings.weights.scale_reg) * sum.scale / (3.0 * n);
    }
}
