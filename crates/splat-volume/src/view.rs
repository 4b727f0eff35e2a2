//! A keyframe's depth as the volume keeps it: small, and with the slant of the surface at each pixel.

use glam::{DVec2, DVec3};

use splat_types::camera::Intrinsics;
use splat_types::depth::DepthMap;

/// Longer side that depth is kept at: a pixel of a 60 degree lens is 3 cm wide at 5 m.
const MAX_SIDE: u32 = 192;
/// Code of the farthest depth; 0 is none.
const MAX_CODE: f64 = 65_535.0;
/// Neighbours whose depths differ by a larger share lie on two surfaces.
const MAX_JUMP: f64 = 0.08;
/// Steps of the slant in a byte.
const SLANT_STEPS: f64 = 100.0;
/// A surface that is seen at a flatter angle has no trustworthy slant.
const MIN_SLANT: f64 = 0.15;
/// Trust in the least confident of verified depth.
const MIN_TRUST: f64 = 0.25;
/// Steps of the trust in a byte.
const TRUST_STEPS: f64 = 64.0;

/// Depth, trust and slant of each pixel, six bytes in all.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthView {
    /// Of the kept size.
    pub intrinsics: Intrinsics,
    /// Units of the map in one code.
    step: f64,
    codes: Vec<u16>,
    /// Of the nearest depth among the pixel and those around it.
    nearest: Vec<u16>,
    trust: Vec<u8>,
    slants: Vec<u8>,
}

/// What one pixel says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// z-depth, units of the map.
    pub z: f32,
    /// The smallest z-depth among the pixel and those around it: space before it is empty, whatever lies between pixels.
    pub nearest: f32,
    /// Length of the ray's part along the surface's normal, for a ray with z = 1: depth along the ray times it is distance to the surface's plane.
    pub slant: f32,
    /// 1 to 64.
    pub trust: u32,
}

impl DepthView {
    /// Verified depth of an image that `intrinsics` belong to.
    pub fn new(depth: &DepthMap, intrinsics: &Intrinsics) -> Self {
        let (width_px, height_px) = kept_size(depth);
        let intrinsics = intrinsics.resized(width_px.max(1), height_px.max(1));
        let small = if (width_px, height_px) == (depth.width_px, depth.height_px) {
            depth.clone()
        } else {
            depth.subsampled(width_px, height_px)
        };
        let farthest = (0..small.depth.len())
            .filter_map(|at| small.verified(at))
            .fold(0.0, |most, (z, _)| f64::max(most, f64::from(z)));
        let step = if farthest > 0.0 {
            farthest / MAX_CODE
        } else {
            1.0
        };
        let pixels: Vec<(u16, u8, u8)> = (0..small.depth.len())
            .map(|at| match small.verified(at) {
                Some((z, confidence)) => {
                    let code = (f64::from(z) / step).round().clamp(1.0, MAX_CODE);
                    let trust = MIN_TRUST + (1.0 - MIN_TRUST) * f64::from(confidence.min(1.0));
                    let slant = slant(&small, &intrinsics, at);
                    (
                        code as u16,
                        (TRUST_STEPS * trust).round() as u8,
                        (SLANT_STEPS * slant).round() as u8,
                    )
                }
                None => (0, 0, 0),
            })
            .collect();
        let codes: Vec<u16> = pixels.iter().map(|p| p.0).collect();
        Self {
            intrinsics,
            step,
            nearest: nearest(&codes, width_px as usize),
            codes,
            trust: pixels.iter().map(|p| p.1).collect(),
            slants: pixels.iter().map(|p| p.2).collect(),
        }
    }

    /// Of a pixel inside of the image.
    #[inline]
    pub fn seen(&self, column: usize, row: usize) -> Option<Seen> {
        let at = row * self.intrinsics.width_px as usize + column;
        let code = *self.codes.get(at)?;
        (code > 0).then(|| Seen {
            z: (f64::from(code) * self.step) as f32,
            nearest: (f64::from(self.nearest[at]) * self.step) as f32,
            slant: f32::from(self.slants[at]) / SLANT_STEPS as f32,
            trust: u32::from(self.trust[at]),
        })
    }

    /// The greatest depth, units of the map; 0 where there is none.
    pub fn farthest(&self) -> f64 {
        let code = self.codes.iter().max().copied().unwrap_or(0);
        f64::from(code) * self.step
    }

    /// Points in the camera's frame, units of the map, of every `every`-th pixel with depth.
    pub fn points(&self, every: usize) -> impl Iterator<Item = DVec3> + '_ {
        let width = self.intrinsics.width_px as usize;
        (0..self.codes.len())
            .step_by(every.max(1))
            .filter_map(move |at| {
                let (column, row) = (at % width, at / width);
                let z = f64::from(self.seen(column, row)?.z);
                let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
                Some(self.intrinsics.ray_in_cam(pixel) * z)
            })
    }

    pub fn n_pixels(&self) -> usize {
        self.codes.len()
    }

    pub fn bytes(&self) -> usize {
        self.codes.len() * 6
    }
}

fn kept_size(depth: &DepthMap) -> (u32, u32) {
    let longer = depth.width_px.max(depth.height_px);
    if longer <= MAX_SIDE {
        return (depth.width_px, depth.height_px);
    }
    let side = |px: u32| {
        (u64::from(px) * u64::from(MAX_SIDE))
            .div_ceil(u64::from(longer))
            .max(1) as u32
    };
    (side(depth.width_px), side(depth.height_px))
}

/// The smallest code that is not 0 in three by three pixels.
fn nearest(codes: &[u16], width: usize) -> Vec<u16> {
    let least = |a: u16, b: u16| if a == 0 || (b > 0 && b < a) { b } else { a };
    let rows: Vec<u16> = (0..codes.len())
        .map(|at| {
            let column = at % width;
            let left = if column > 0 { codes[at - 1] } else { 0 };
            let right = if column + 1 < width { codes[at + 1] } else { 0 };
            least(least(left, codes[at]), right)
        })
        .collect();
    let above = |at: usize| at.checked_sub(width).map_or(0, |at| rows[at]);
    let below = |at: usize| rows.get(at + width).copied().unwrap_or(0);
    (0..codes.len())
        .map(|at| least(least(above(at), rows[at]), below(at)))
        .collect()
}

/// From depth two pixels apart, where both lie on the same surface; 1 where that is not known: then distance is along the camera's axis.
fn slant(depth: &DepthMap, k: &Intrinsics, at: usize) -> f64 {
    let (width, height) = (depth.width_px as usize, depth.height_px as usize);
    let (column, row) = (at % width, at / width);
    let point = |column: usize, row: usize| {
        let (z, _) = depth.verified(row * width + column)?;
        let pixel = DVec2::new(column as f64 + 0.5, row as f64 + 0.5);
        Some(k.ray_in_cam(pixel) * f64::from(z))
    };
    let Some(own) = point(column, row) else {
        return 1.0;
    };
    // Towards larger columns or rows, over as much as there is of the same surface.
    let tangent = |before: Option<DVec3>, behind: Option<DVec3>| {
        let near = |p: DVec3| ((p.z - own.z).abs() <= MAX_JUMP * own.z).then_some(p);
        match (before.and_then(near), behind.and_then(near)) {
            (Some(before), Some(behind)) => Some(behind - before),
            (Some(before), None) => Some(own - before),
            (None, Some(behind)) => Some(behind - own),
            (None, None) => None,
        }
    };
    let left = column.checked_sub(1).and_then(|c| point(c, row));
    let right = (column + 1 < width)
        .then(|| point(column + 1, row))
        .flatten();
    let above = row.checked_sub(1).and_then(|r| point(column, r));
    let below = (row + 1 < height).then(|| point(column, row + 1)).flatten();
    let (Some(across), Some(down)) = (tangent(left, right), tangent(above, below)) else {
        return 1.0;
    };
    let normal = across.cross(down);
    let ray = own / own.z;
    let slant = normal.dot(ray).abs() / normal.length();
    if slant.is_finite() {
        slant.clamp(MIN_SLANT, 2.5)
    } else {
        1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Intrinsics {
        Intrinsics {
            width_px: 64,
            height_px: 48,
            fx: 50.0,
            fy: 50.0,
            cx: 32.0,
            cy: 24.0,
        }
    }

    /// A floor one unit below the camera, as far as it is below the horizon.
    fn floor() -> DepthMap {
        let k = camera();
        let depth: Vec<f32> = (0..64 * 48)
            .map(|at| {
                let pixel = DVec2::new((at % 64) as f64 + 0.5, (at / 64) as f64 + 0.5);
                let y = k.ray_in_cam(pixel).y;
                if y > 0.05 { (1.0 / y) as f32 } else { 0.0 }
            })
            .collect();
        let confidence = depth.iter().map(|d| if *d > 0.0 { 1.0 } else { 0.0 });
        DepthMap {
            width_px: 64,
            height_px: 48,
            confidence: confidence.collect(),
            depth,
        }
    }

    #[test]
    fn depth_times_slant_is_the_distance_to_the_plane() {
        let view = DepthView::new(&floor(), &camera());
        let seen = view.seen(20, 40).unwrap();
        // From the camera itself: one unit above the floor.
        assert!((seen.z * seen.slant - 1.0).abs() < 0.02, "{seen:?}");
        assert_eq!(seen.trust, 64);
        assert_eq!(view.seen(20, 5), None);
    }

    #[test]
    fn what_is_not_finite_or_not_verified_is_no_depth() {
        let mut depth = floor();
        depth.depth[40 * 64 + 20] = f32::NAN;
        depth.depth[40 * 64 + 21] = f32::INFINITY;
        depth.confidence[40 * 64 + 22] = 0.0;
        depth.confidence[40 * 64 + 23] = f32::NAN;
        let view = DepthView::new(&depth, &camera());
        for column in 20..24 {
            assert_eq!(view.seen(column, 40), None);
        }
        assert_eq!(DepthView::new(&DepthMap::none(), &camera()).farthest(), 0.0);
    }

    #[test]
    fn large_depth_is_kept_small() {
        let depth = DepthMap {
            width_px: 640,
            height_px: 480,
            depth: vec![2.0; 640 * 480],
            confidence: vec![0.5; 640 * 480],
        };
        let view = DepthView::new(&depth, &camera());
        assert_eq!(
            (view.intrinsics.width_px, view.intrinsics.height_px),
            (192, 144)
        );
        assert_eq!(view.bytes(), 192 * 144 * 6);
        assert!((f64::from(view.seen(96, 72).unwrap().z) - 2.0).abs() < 1e-4);
    }
}
