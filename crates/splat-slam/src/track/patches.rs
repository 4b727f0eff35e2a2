//! A point that a keyframe shows, with the image around it -> where a frame shows it, to a fraction of a pixel.
//!
//! The patch is warped as the motion between the cameras would show a small plane that faces the keyframe, and then moved
//! until it fits the frame: Lucas-Kanade, inverse compositional (Baker and Matthews 2004), with an offset of brightness, from
//! coarse to fine; the "feature alignment" of SVO (Forster, Pizzoli and Scaramuzza 2014).

use glam::{DMat2, DVec2, DVec3};
use nalgebra::{Matrix3, Vector3};

use crate::select::grey::GreyImage;
use crate::select::optical_flow::Pyramid;
use crate::working_camera::WorkingCamera;
use splat_types::camera::Intrinsics;
use splat_types::transform::Rigid;

/// Halvings of the image, from none on, that a patch is kept of.
pub(crate) const N_LEVELS: usize = 4;
/// Side of the patch that is compared, and with the border that its derivatives need.
const SIDE: usize = 8;
const BORDERED: usize = SIDE + 2;
/// Side of what is kept: holds a bordered patch turned by 45 degrees and 1.3 times as large.
const KEPT: usize = 20;
const KEPT_HALF: i64 = KEPT as i64 / 2;
/// Pixels of the keyframe over which the warp is measured.
const WARP_PX: f64 = 4.0;
/// Areas may differ by so much; the point must be seen within 53 degrees of where the keyframe saw it from.
const MAX_AREA_RATIO: f64 = 6.0;
const MIN_ANGLE_COSINE: f64 = 0.6;
const MAX_ITERATIONS: usize = 12;
const MIN_STEP_PX: f32 = 0.02;
/// A patch may move by so many pixels of the coarsest level that it is looked for on.
const MAX_SHIFT_PX: f64 = 4.0;
/// Least correlation of the patch with what it was moved to.
const MIN_CORRELATION: f32 = 0.8;
/// The same of the best place in reach; its lead over others, and how far off those are.
const MIN_FAR_CORRELATION: f32 = 0.75;
const MIN_LEAD: f32 = 0.05;
const APART_PX: i64 = 2;
/// Least standard deviation of a patch, of 1 = black to white: what is flat fits anywhere.
const MIN_CONTRAST: f32 = 0.012;

/// A point, and the image of its keyframe around it.
#[derive(Debug, Clone)]
pub(crate) struct MapPoint {
    /// The same in all keyframes.
    pub(crate) id: u32,
    pub(crate) point_in_key: DVec3,
    /// Where the keyframe's pinhole shows it.
    pub(crate) pixel: DVec2,
    /// Where its lens shows it, which is where the patches are from.
    shown: DVec2,
    /// `KEPT` x `KEPT` for each level, row by row.
    patches: Box<[u8]>,
}

impl MapPoint {
    /// `None` outside the image and at its border. `pixel`: where the pinhole shows it; `image`: at full size and its halvings.
    pub(crate) fn new(
        id: u32,
        (pixel, point_in_key): (DVec2, DVec3),
        (image, camera): (&Pyramid, &WorkingCamera),
    ) -> Option<Self> {
        let shown = camera.distorted(pixel)?;
        let (width, height) = image.image().size();
        let border = SIDE as f64;
        let is_inside = shown.x >= border
            && shown.y >= border
            && shown.x < width as f64 - border
            && shown.y < height as f64 - border;
        if !is_inside || !point_in_key.is_finite() || point_in_key.z <= 0.0 {
            return None;
        }
        let mut patches = Vec::with_capacity(N_LEVELS * KEPT * KEPT);
        for level_ix in 0..N_LEVELS {
            let Some(level) = image.level(level_ix) else {
                break;
            };
            let [x, y] = corner_of(shown, level_ix);
            for row in 0..KEPT as i64 {
                let row = (y + row).clamp(0, level.height as i64 - 1) as usize * level.width;
                for column in 0..KEPT as i64 {
                    let column = (x + column).clamp(0, level.width as i64 - 1) as usize;
                    patches.push((level.values[row + column] * 255.0 + 0.5) as u8);
                }
            }
        }
        Some(Self {
            id,
            point_in_key,
            pixel,
            shown,
            patches: patches.into_boxed_slice(),
        })
    }

    /// Where a camera that stands at `cam_from_key` would show the point, and how it would show the pixels around it.
    pub(crate) fn warp(
        &self,
        cam_from_key: &Rigid,
        [key, frame]: [&Intrinsics; 2],
    ) -> Option<Warp> {
        let p = cam_from_key.transform_point(self.point_in_key);
        let at = frame.project(p)?;
        let is_inside = at.x >= 0.0
            && at.y >= 0.0
            && at.x < f64::from(frame.width_px)
            && at.y < f64::from(frame.height_px);
        let ray = cam_from_key.rotation * self.point_in_key;
        let cosine = ray.dot(p) / (ray.length() * p.length());
        if !is_inside || cosine < MIN_ANGLE_COSINE {
            return None;
        }
        let column = |along: DVec2| {
            let ray = key.ray_in_cam(self.pixel + along * WARP_PX) * self.point_in_key.z;
            Some((frame.project(cam_from_key.transform_point(ray))? - at) / WARP_PX)
        };
        let frame_from_key = DMat2::from_cols(column(DVec2::X)?, column(DVec2::Y)?);
        let area = frame_from_key.determinant();
        let is_alike = (1.0 / MAX_AREA_RATIO..=MAX_AREA_RATIO).contains(&area);
        is_alike.then(|| Warp {
            at,
            key_from_frame: frame_from_key.inverse(),
            scale: area.sqrt(),
        })
    }

    /// Where a frame's pinhole shows the patch, which is looked for on levels from `coarsest` down.
    pub(crate) fn align(
        &self,
        warp: &Warp,
        (frame, camera): (&Pyramid, &WorkingCamera),
        coarsest: usize,
    ) -> Option<DVec2> {
        self.align_from(warp, camera.distorted(warp.at)?, (frame, camera), coarsest)
    }

    fn align_from(
        &self,
        warp: &Warp,
        expected: DVec2,
        (frame, camera): (&Pyramid, &WorkingCamera),
        coarsest: usize,
    ) -> Option<DVec2> {
        let mut at = expected;
        let n_levels = (coarsest + 1).min(N_LEVELS).min(frame.n_levels());
        let reach = MAX_SHIFT_PX * f64::from(1_u32 << (n_levels - 1));
        for level_ix in (0..n_levels).rev() {
            let template = Template::of(&self.warped(warp, level_ix));
            let Some(template) = template else {
                // Flat when seen from afar; not at full size.
                if level_ix == 0 {
                    return None;
                }
                continue;
            };
            let scale = f64::from(1_u32 << level_ix);
            let start = ((at - 0.5) / scale).as_vec2();
            let image = frame.level(level_ix)?;
            let (found, correlation) = template.fit(image, [start.x, start.y])?;
            at = DVec2::new(f64::from(found[0]), f64::from(found[1])) * scale + 0.5;
            let is_lost = at.distance(expected) > reach;
            if is_lost || (level_ix == 0 && correlation < MIN_CORRELATION) {
                return None;
            }
        }
        let pixel = camera.undistorted(at);
        pixel.is_finite().then_some(pixel)
    }

    /// Where the coarsest level of a frame, whose camera may stand anywhere near, shows the patch: the place within `reach_px` of
    /// where it was, plus a shift, whose pixels correlate best with it as the keyframe shows it, if no other place is nearly as good; then from there down.
    pub(crate) fn look_for(
        &self,
        (frame, camera): (&Pyramid, &WorkingCamera),
        shift: DVec2,
        reach_px: usize,
    ) -> Option<DVec2> {
        let unmoved = Warp {
            at: self.pixel,
            key_from_frame: DMat2::IDENTITY,
            scale: 1.0,
        };
        let level_ix = N_LEVELS.min(frame.n_levels()) - 1;
        let template = Template::of(&self.warped(&unmoved, level_ix))?;
        let scale = f64::from(1_u32 << level_ix);
        let start = ((camera.distorted(self.pixel)? + shift - 0.5) / scale).floor();
        let found = template.best_place(frame.level(level_ix)?, start, reach_px)?;
        let found = found * scale + 0.5;
        self.align_from(&unmoved, found, (frame, camera), level_ix)
    }

    /// What a level of the frame would show about the point, with a border of one pixel.
    fn warped(&self, warp: &Warp, level_ix: usize) -> [f32; BORDERED * BORDERED] {
        let step = f64::from(1_u32 << level_ix);
        // Of the levels of the keyframe the one whose pixels are as large.
        let coarsest = self.patches.len() / (KEPT * KEPT) - 1;
        let own = (step / warp.scale).log2().round();
        let own = own.clamp(0.0, coarsest as f64) as usize;
        let to_own = warp.key_from_frame * (step / f64::from(1_u32 << own));
        let [x, y] = corner_of(self.shown, own);
        let centre = (self.shown - 0.5) / f64::from(1_u32 << own) - DVec2::new(x as f64, y as f64);
        let patch = &self.patches[own * KEPT * KEPT..][..KEPT * KEPT];
        let middle = (BORDERED - 1) as f64 / 2.0;
        std::array::from_fn(|i| {
            let off = DVec2::new((i % BORDERED) as f64, (i / BORDERED) as f64) - middle;
            let at = (centre + to_own * off).clamp(DVec2::ZERO, DVec2::splat((KEPT - 1) as f64));
            let (column, row) = ((at.x as usize).min(KEPT - 2), (at.y as usize).min(KEPT - 2));
            let (u, v) = ((at.x - column as f64) as f32, (at.y - row as f64) as f32);
            let value = |dx: usize, dy: usize| f32::from(patch[(row + dy) * KEPT + column + dx]);
            let above = value(0, 0) + u * (value(1, 0) - value(0, 0));
            let below = value(0, 1) + u * (value(1, 1) - value(0, 1));
            (above + v * (below - above)) / 255.0
        })
    }
}

/// How a frame would show the pixels around a point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Warp {
    /// Where its pinhole would show the point.
    pub(crate) at: DVec2,
    key_from_frame: DMat2,
    /// Pixels of the frame in one of the keyframe.
    scale: f64,
}

/// First column and row of what is kept of a level.
fn corner_of(shown: DVec2, level_ix: usize) -> [i64; 2] {
    let at = (shown - 0.5) / f64::from(1_u32 << level_ix);
    [
        at.x.floor() as i64 - KEPT_HALF + 1,
        at.y.floor() as i64 - KEPT_HALF + 1,
    ]
}

/// A warped patch, its derivatives and the inverse of their normal matrix.
struct Template {
    values: [f32; SIDE * SIDE],
    /// To the right, and down.
    slopes: [[f32; SIDE * SIDE]; 2],
    inverse: Matrix3<f32>,
}

impl Template {
    /// `None`: it has no definite place.
    fn of(bordered: &[f32; BORDERED * BORDERED]) -> Option<Self> {
        let at = |x: usize, y: usize| bordered[y * BORDERED + x];
        let inner = |i: usize| (i % SIDE + 1, i / SIDE + 1);
        let values: [f32; SIDE * SIDE] = std::array::from_fn(|i| {
            let (x, y) = inner(i);
            at(x, y)
        });
        let slope = |(dx, dy): (usize, usize)| -> [f32; SIDE * SIDE] {
            std::array::from_fn(|i| {
                let (x, y) = inner(i);
                0.5 * (at(x + dx, y + dy) - at(x - dx, y - dy))
            })
        };
        let slopes = [slope((1, 0)), slope((0, 1))];
        let n = values.len() as f32;
        let mean = values.iter().sum::<f32>() / n;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n;
        if variance < MIN_CONTRAST * MIN_CONTRAST {
            return None;
        }
        let mut normal = Matrix3::<f32>::zeros();
        for (gx, gy) in slopes[0].iter().zip(&slopes[1]) {
            let j = Vector3::new(*gx, *gy, 1.0);
            normal += j * j.transpose();
        }
        let inverse = normal.try_inverse()?;
        inverse.iter().all(|v| v.is_finite()).then_some(Self {
            values,
            slopes,
            inverse,
        })
    }

    /// The whole pixel near `start` about which an image is most like it; `None` where two places are about as good.
    fn best_place(&self, image: &GreyImage, start: DVec2, reach_px: usize) -> Option<DVec2> {
        let n = self.values.len() as f32;
        let mean = self.values.iter().sum::<f32>() / n;
        let own = self.values.map(|v| v - mean);
        let own_squares = own.iter().map(|v| v * v).sum::<f32>();
        let half = SIDE as i64 / 2;
        let reach = reach_px as i64;
        let (width, height) = (image.width as i64, image.height as i64);
        let mut scores = Vec::with_capacity((2 * reach_px + 1).pow(2));
        for y in start.y as i64 - reach..=start.y as i64 + reach {
            for x in start.x as i64 - reach..=start.x as i64 + reach {
                // The patch reaches from half a side before its middle to one pixel less behind it.
                let (left, top) = (x - half + 1, y - half + 1);
                let fits = left >= 0 && top >= 0 && left + 8 <= width && top + 8 <= height;
                if !fits {
                    continue;
                }
                let mut lanes = [[0.0; SIDE]; 3];
                for (row, own) in own.chunks_exact(SIDE).enumerate() {
                    let from = (top as usize + row) * image.width + left as usize;
                    let other = &image.values[from..from + SIDE];
                    for i in 0..SIDE {
                        lanes[0][i] += own[i] * other[i];
                        lanes[1][i] += other[i];
                        lanes[2][i] += other[i] * other[i];
                    }
                }
                let [ab, b, bb] = lanes.map(|lanes| lanes.iter().sum::<f32>());
                let squares = (bb - b * b / n) * own_squares;
                let score = if squares > 0.0 {
                    ab / squares.sqrt()
                } else {
                    0.0
                };
                scores.push(([x, y], score));
            }
        }
        let (best, score) = *scores.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
        let is_apart = |at: &[i64; 2]| (0..2).any(|axis| (at[axis] - best[axis]).abs() > APART_PX);
        let others = scores.iter().filter(|(at, _)| is_apart(at));
        let second = others.map(|(_, score)| *score).fold(0.0, f32::max);
        let is_clear = score >= MIN_FAR_CORRELATION && score - second >= MIN_LEAD;
        // The middle of the patch lies between four pixels.
        is_clear.then(|| DVec2::new(best[0] as f64, best[1] as f64) + 0.5)
    }

    /// Where it fits, from a place on, and how well; pixel centres at whole numbers. `None` outside the image.
    fn fit(&self, image: &GreyImage, start: [f32; 2]) -> Option<([f32; 2], f32)> {
        let (mut at, mut offset) = (start, 0.0);
        let mut shown = [0.0; SIDE * SIDE];
        for _ in 0..MAX_ITERATIONS {
            sample(image, at, &mut shown)?;
            // One lane for each column, so that vector units make the sums.
            let mut lanes = [[0.0; SIDE]; 3];
            for row in 0..SIDE {
                let at = row * SIDE;
                let (own, other) = (&self.values[at..at + SIDE], &shown[at..at + SIDE]);
                let (gx, gy) = (
                    &self.slopes[0][at..at + SIDE],
                    &self.slopes[1][at..at + SIDE],
                );
                for i in 0..SIDE {
                    let off = own[i] + offset - other[i];
                    lanes[0][i] += gx[i] * off;
                    lanes[1][i] += gy[i] * off;
                    lanes[2][i] += off;
                }
            }
            let descent = Vector3::from(lanes.map(|lanes| lanes.iter().sum::<f32>()));
            let step = self.inverse * descent;
            at = [at[0] + step.x, at[1] + step.y];
            offset -= step.z;
            if !step.x.is_finite() || !step.y.is_finite() {
                return None;
            }
            if step.x.hypot(step.y) < MIN_STEP_PX {
                break;
            }
        }
        sample(image, at, &mut shown)?;
        Some((at, correlation(&self.values, &shown)))
    }
}

/// Linear between pixels; `None` where the patch leaves the image.
fn sample(image: &GreyImage, at: [f32; 2], out: &mut [f32; SIDE * SIDE]) -> Option<()> {
    let half = (SIDE - 1) as f32 / 2.0;
    let (x, y) = (at[0] - half, at[1] - half);
    let is_inside = x >= 0.0
        && y >= 0.0
        && x + (SIDE as f32) < image.width as f32
        && y + (SIDE as f32) < image.height as f32;
    if !is_inside {
        return None;
    }
    let (column, row) = (x as usize, y as usize);
    let (u, v) = (x - column as f32, y - row as f32);
    let weights = [(1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v];
    for (i, target) in out.chunks_exact_mut(SIDE).enumerate() {
        let above = &image.values[(row + i) * image.width + column..][..=SIDE];
        let below = &image.values[(row + i + 1) * image.width + column..][..=SIDE];
        for (j, target) in target.iter_mut().enumerate() {
            *target = weights[0] * above[j]
                + weights[1] * above[j + 1]
                + weights[2] * below[j]
                + weights[3] * below[j + 1];
        }
    }
    Some(())
}

/// Of two patches, whatever their brightness and contrast.
fn correlation(a: &[f32; SIDE * SIDE], b: &[f32; SIDE * SIDE]) -> f32 {
    let n = (SIDE * SIDE) as f32;
    let (mean_a, mean_b) = (a.iter().sum::<f32>() / n, b.iter().sum::<f32>() / n);
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in a.iter().zip(b) {
        let (a, b) = (a - mean_a, b - mean_b);
        ab += a * b;
        aa += a * a;
        bb += b * b;
    }
    if aa * bb > 0.0 {
        ab / (aa * bb).sqrt()
    } else {
        0.0
    }
}

#[cfg(test)]
mod tests;
