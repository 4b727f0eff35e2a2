//! project: splats and a camera -> the visible splats as 2D Gaussians with colour, in order of their index.
//!
//! First stage. Equations: docs/GRADIENTS.md, projection. Geometry is f64: the loop is scalar, so it costs nothing,
//! and long thin splats keep their determinant.

use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use crate::sh;
use splat_types::camera::Intrinsics;
use splat_types::splats::splats::Splats;
use splat_types::transform::Rigid;

/// Splats closer than this are culled at least; as `view::NEAR`.
pub const NEAR: f64 = 0.01;
/// Added to the 2D covariance, px^2: a splat is never thinner than about half a pixel (Kerbl et al. 2023).
pub const EPS_2D_PX2: f64 = 0.3;
/// Below this a splat moves no 8-bit pixel value.
pub const MIN_ALPHA: f32 = 1.0 / 255.0;
/// Side of a tile.
pub const TILE_PX: usize = 16;
/// Splats of one parallel task. Fixed, so that sums over tasks do not depend on the number of threads.
pub(crate) const CHUNK: usize = 256;
/// At this many standard deviations even an opaque splat is below `MIN_ALPHA`.
const MAX_EXTENT_SIGMAS: f64 = 3.33;
/// Squares of pixel coordinates beyond this lose their meaning in f32.
const MAX_CENTER_PX: f64 = 1e9;
/// A colour beyond this is a broken splat; its square would take SSIM, and with it the whole image, to infinity.
const MAX_COLOR: f32 = 1e4;

/// A pinhole at a pose.
#[derive(Debug, Clone)]
pub struct Camera {
    pub width_px: u32,
    pub height_px: u32,
    pub fx: f64,
    pub fy: f64,
    pub cx: f64,
    pub cy: f64,
    pub rotation: DMat3,
    pub translation: DVec3,
    pub center_in_world: DVec3,
    /// Bounds of x/z and y/z in the Jacobian: far outside the image the linearisation explodes.
    slope_min: DVec2,
    slope_max: DVec2,
    /// Splats closer than this are culled.
    near: f64,
}

/// One visible splat on the image; a cache line, since tiles fetch them in no order.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(align(64))]
pub struct ProjectedSplat {
    pub splat_ix: u32,
    /// z in the camera.
    pub depth: f32,
    pub center: [f32; 2],
    /// Upper triangle a, b, c of the inverse 2D covariance.
    pub conic: [f32; 3],
    pub opacity: f32,
    /// Exactly 0 where spherical harmonics went below black.
    pub color: [f32; 3],
    /// `ln(opacity / MIN_ALPHA)`: exponents above it are invisible.
    pub cut: f32,
    /// Half-open rectangle of tiles: x0, y0, x1, y1.
    pub tiles: [u16; 4],
}

#[derive(Debug, Default)]
pub struct Projected {
    /// In order of `splat_ix`.
    pub splats: Vec<ProjectedSplat>,
    /// `splats[chunk_ends[c - 1]..chunk_ends[c]]` stem from the c-th `CHUNK` of all splats.
    chunk_ends: Vec<u32>,
    chunks: Vec<Vec<ProjectedSplat>>,
}

/// What projection knows of one splat before the image; `project_backward` needs it again.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shape {
    pub(crate) mean_in_cam: DVec3,
    /// Own axes in the map, and its unit quaternion (w, x, y, z) with the length it was normalised by.
    pub(crate) rotation: DMat3,
    pub(crate) quat: [f64; 4],
    pub(crate) quat_length: f64,
    pub(crate) scale: DVec3,
    /// `R Rot diag(s)`: the covariance in the camera is this times its transpose.
    pub(crate) root_in_cam: DMat3,
    /// Rows of the projection's Jacobian.
    pub(crate) jacobian: [DVec3; 2],
    /// x/z and y/z as the Jacobian uses them.
    pub(crate) slope: DVec2,
    pub(crate) is_clamped: [bool; 2],
    /// Upper triangle of the 2D covariance, eps included, and its determinant.
    pub(crate) cov: [f64; 3],
    pub(crate) det: f64,
}

impl Projected {
    /// Indices of the visible splats that stem from the c-th `CHUNK`.
    pub(crate) fn of_chunk(&self, c: usize) -> std::ops::Range<usize> {
        let begin = c.checked_sub(1).map_or(0, |before| self.chunk_ends[before]);
        begin as usize..self.chunk_ends[c] as usize
    }
}

/// Finds the splats that `camera` can see. SH bands above `sh_degree` are left out.
pub fn project(splats: &Splats, camera: &Camera, sh_degree: u8, out: &mut Projected) {
    let n_chunks = splats.len().div_ceil(CHUNK);
    out.chunks.resize_with(n_chunks, Vec::new);
    out.chunks
        .par_iter_mut()
        .enumerate()
        .for_each(|(c, chunk)| {
            chunk.clear();
            let range = c * CHUNK..splats.len().min((c + 1) * CHUNK);
            chunk.extend(range.filter_map(|ix| project_one(splats, ix, camera, sh_degree)));
        });
    out.splats.clear();
    out.chunk_ends.clear();
    for chunk in &out.chunks {
        out.splats.extend_from_slice(chunk);
        out.chunk_ends.push(out.splats.len() as u32);
    }
}

fn project_one(
    splats: &Splats,
    ix: usize,
    camera: &Camera,
    sh_degree: u8,
) -> Option<ProjectedSplat> {
    let opacity = sigmoid(splats.opacity_logits[ix]);
    if opacity < MIN_ALPHA || opacity.is_nan() {
        return None;
    }
    let shape = Shape::new(
        splats.means[ix],
        splats.log_scales[ix],
        splats.quats[ix],
        camera,
    )?;
    let center = camera.pixel(shape.mean_in_cam);
    let cut = f64::from(opacity / MIN_ALPHA).ln().max(0.0);
    let sigmas = (2.0 * cut).sqrt().min(MAX_EXTENT_SIGMAS);
    let half = DVec2::new(shape.cov[0].sqrt(), shape.cov[2].sqrt()) * sigmas;
    let tiles = tile_rectangle(center, half.ceil(), camera)?;
    let color = color(
        splats,
        ix,
        shape_direction(splats.means[ix], camera),
        sh_degree,
    )?;
    let [s00, s01, s11] = shape.cov;
    Some(ProjectedSplat {
        splat_ix: ix as u32,
        depth: shape.mean_in_cam.z as f32,
        center: center.as_vec2().to_array(),
        conic: [
            (s11 / shape.det) as f32,
            (-s01 / shape.det) as f32,
            (s00 / shape.det) as f32,
        ],
        opacity,
        color,
        cut: cut as f32,
        tiles,
    })
}

/// `None` when the box misses the image.
fn tile_rectangle(center: DVec2, radius: DVec2, camera: &Camera) -> Option<[u16; 4]> {
    let size = DVec2::new(f64::from(camera.width_px), f64::from(camera.height_px));
    let (low, high) = (center - radius, center + radius);
    let touches = high.cmpgt(DVec2::ZERO).all()
        && low.cmplt(size).all()
        && center.abs().max_element() < MAX_CENTER_PX;
    if !touches {
        return None;
    }
    let tile = TILE_PX as f64;
    let first = (low.max(DVec2::ZERO) / tile).floor();
    let last = (high.min(size) / tile).ceil();
    Some([first.x as u16, first.y as u16, last.x as u16, last.y as u16])
}

/// From the camera to the splat, unit length.
pub(crate) fn shape_direction(mean: [f32; 3], camera: &Camera) -> DVec3 {
    // A visible splat is at least NEAR away.
    (vec3(mean) - camera.center_in_world).normalize_or_zero()
}

/// `None` when it is NaN or absurd.
fn color(splats: &Splats, ix: usize, dir: DVec3, sh_degree: u8) -> Option<[f32; 3]> {
    let degree = sh_degree.min(splats.sh_degree);
    let basis = sh::basis(dir, degree);
    let stride = splats.sh_stride();
    let mut color = [0.5; 3];
    let (coefficients, _) = splats.sh[ix * stride..(ix + 1) * stride].as_chunks::<3>();
    for (b, k) in basis
        .iter()
        .zip(&coefficients[..sh::n_coefficients(degree)])
    {
        for (sum, k) in color.iter_mut().zip(k) {
            *sum += b * f64::from(*k);
        }
    }
    let color = color.map(|c| c as f32);
    color
        .iter()
        .all(|c| c.abs() < MAX_COLOR)
        .then(|| color.map(|c| c.max(0.0)))
}

impl Camera {
    pub fn new(intrinsics: &Intrinsics, cam_from_world: &Rigid) -> Self {
        let Intrinsics {
            width_px,
            height_px,
            fx,
            fy,
            cx,
            cy,
        } = *intrinsics;
        let center_in_world = cam_from_world.inverse().translation;
        let size = DVec2::new(f64::from(width_px), f64::from(height_px));
        let focal = DVec2::new(fx, fy);
        let principal = DVec2::new(cx, cy);
        // 0.3 of half the image's slope beyond its edges, as gsplat does.
        let beyond = 0.3 * 0.5 * size / focal;
        Self {
            width_px,
            height_px,
            fx,
            fy,
            cx,
            cy,
            rotation: cam_from_world.rotation_matrix(),
            translation: cam_from_world.translation,
            center_in_world,
            slope_min: -(principal / focal + beyond),
            slope_max: (size - principal) / focal + beyond,
            near: NEAR,
        }
    }

    /// Culls what is nearer than this.
    pub(crate) fn with_near(self, near: f64) -> Self {
        Self {
            near: near.max(NEAR),
            ..self
        }
    }

    fn pixel(&self, point_in_cam: DVec3) -> DVec2 {
        let inv_z = 1.0 / point_in_cam.z;
        DVec2::new(
            self.fx * point_in_cam.x * inv_z + self.cx,
            self.fy * point_in_cam.y * inv_z + self.cy,
        )
    }
}

impl Shape {
    /// `None`: too near, or a number that is not finite.
    pub(crate) fn new(
        mean: [f32; 3],
        log_scale: [f32; 3],
        quat: [f32; 4],
        camera: &Camera,
    ) -> Option<Self> {
        let p = camera.rotation * vec3(mean) + camera.translation;
        if !(p.z > camera.near && p.is_finite()) {
            return None;
        }
        let scale = vec3(log_scale.map(f32::exp));
        let (quat, quat_length) = unit_quat(quat)?;
        let rotation = DMat3::from_quat(DQuat::from_xyzw(quat[1], quat[2], quat[3], quat[0]));
        let root_in_cam = camera.rotation * rotation * DMat3::from_diagonal(scale);
        let true_slope = p.truncate() / p.z;
        // Not clamp(): it asserts on the NaN bounds that a broken camera gives.
        let slope = true_slope.max(camera.slope_min).min(camera.slope_max);
        let inv_z = 1.0 / p.z;
        let jacobian = [
            DVec3::new(camera.fx * inv_z, 0.0, -camera.fx * slope.x * inv_z),
            DVec3::new(0.0, camera.fy * inv_z, -camera.fy * slope.y * inv_z),
        ];
        let u = root_in_cam.transpose() * jacobian[0];
        let v = root_in_cam.transpose() * jacobian[1];
        let (s00, s01, s11) = (u.length_squared(), u.dot(v), v.length_squared());
        // |u x v|^2 is s00 s11 - s01^2 without the cancellation.
        let det = u.cross(v).length_squared() + EPS_2D_PX2 * (s00 + s11 + EPS_2D_PX2);
        let is_clamped = [slope.x != true_slope.x, slope.y != true_slope.y];
        let cov = [s00 + EPS_2D_PX2, s01, s11 + EPS_2D_PX2];
        det.is_finite().then_some(Self {
            mean_in_cam: p,
            rotation,
            quat,
            quat_length,
            scale,
            root_in_cam,
            jacobian,
            slope,
            is_clamped,
            cov,
            det,
        })
    }
}

pub(crate) fn sigmoid(logit: f32) -> f32 {
    1.0 / (1.0 + (-logit).exp())
}

pub(crate) fn vec3(v: [f32; 3]) -> DVec3 {
    DVec3::new(f64::from(v[0]), f64::from(v[1]), f64::from(v[2]))
}

/// Unit quaternion and the length before; a quaternion without direction is the identity, of length infinity so
/// that its gradient is 0. `None` when not finite.
fn unit_quat(quat: [f32; 4]) -> Option<([f64; 4], f64)> {
    let q = quat.map(f64::from);
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    if !length.is_finite() {
        return None;
    }
    // f32 numbers this small are what is left of an underflow.
    if length < 1e-30 {
        return Some(([1.0, 0.0, 0.0, 0.0], f64::INFINITY));
    }
    Some((q.map(|x| x / length), length))
}
