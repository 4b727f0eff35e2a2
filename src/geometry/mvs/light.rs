//! Luma of a source by that of the reference, where exposure or lamps differ between them.
//!
//! A coarse sweep by windows alone, which no change of light disturbs, finds depth; the pairs of pixels that it finds say
//! how luma goes over into luma. Without that a pixel could not be told by its own luma in pictures of a camera that
//! sets its exposure by itself.

use super::grey::Grey;
use super::planes::Planes;
use super::sweep::{Warp, matching_costs};
use super::zncc::slack;
use super::{MIN_SIDE_PX, Prepared};

/// Side of the square of pixels that make one coarse pixel.
const COARSE: usize = 4;
const N_PLANES: usize = 32;
/// Costs, of 255, above which a coarse pixel has not found its depth.
const MOST_COST: u8 = 40;
/// Half the step of luma to the neighbours above which a pixel that is a little off would count as light.
const MOST_SLACK: f32 = 0.03;
/// Fewer pairs say nothing.
const MIN_PAIRS: usize = 50;
/// Darker and brighter pixels must lie this far apart to tell a gain from an offset.
const MIN_RANGE: f32 = 0.1;
/// A gain farther from 1 is none of light.
const MOST_GAIN: f32 = 0.3;
/// The median difference must fall by this factor; else the light is the same, and what differs is something else.
const MIN_FALL: f32 = 1.3;
/// A median difference that is as good as none: a quarter of a grey level.
const NO_DIFFERENCE: f32 = 0.001;

/// `luma of the source = gain * luma of the reference + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Light {
    pub(super) gain: f32,
    pub(super) offset: f32,
}

impl Light {
    pub(super) const SAME: Self = Self {
        gain: 1.0,
        offset: 0.0,
    };

    pub(super) fn of_source(self, luma: f32) -> f32 {
        self.gain * luma + self.offset
    }

    /// Of each source; the same light where too little is found.
    pub(super) fn of(reference: &Prepared, sources: &[&Prepared], planes: &Planes) -> Vec<Self> {
        let mut lights = vec![Self::SAME; sources.len()];
        let Some(reference) = coarse(reference) else {
            return lights;
        };
        let planes = Planes {
            n: N_PLANES.min(planes.n),
            ..*planes
        };
        let sources: Vec<(usize, Prepared)> = sources
            .iter()
            .enumerate()
            .filter_map(|(ix, source)| Some((ix, coarse(source)?)))
            .collect();
        let (found, warps): (Vec<usize>, Vec<Warp<'_>>) = sources
            .iter()
            .filter_map(|(ix, source)| Some((*ix, Warp::new(&reference, source, &planes)?)))
            .unzip();
        if !warps.is_empty() {
            let pairs = pairs(&reference.grey, &warps, &planes);
            for (ix, pairs) in found.into_iter().zip(pairs) {
                lights[ix] = Self::between(&pairs);
            }
        }
        lights
    }

    /// From pairs of luma, reference and source.
    fn between(pairs: &[(f32, f32)]) -> Self {
        if pairs.len() < MIN_PAIRS {
            return Self::SAME;
        }
        let fitted = Self::fitted(pairs);
        let off = |light: Self| {
            let off = pairs.iter().map(|(r, s)| (light.of_source(*r) - s).abs());
            median(off.collect())
        };
        let is_better = off(Self::SAME) > MIN_FALL * off(fitted).max(NO_DIFFERENCE);
        if is_better { fitted } else { Self::SAME }
    }

    /// Through the medians of the darker and the brighter half.
    fn fitted(pairs: &[(f32, f32)]) -> Self {
        let mut pairs = pairs.to_vec();
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (dark, bright) = pairs.split_at(pairs.len() / 2);
        let luma = [dark, bright].map(|half| median(half.iter().map(|p| p.0).collect()));
        let more = [dark, bright].map(|half| median(half.iter().map(|p| p.1 - p.0).collect()));
        let range = luma[1] - luma[0];
        let slope = if range > MIN_RANGE {
            ((more[1] - more[0]) / range).clamp(-MOST_GAIN, MOST_GAIN)
        } else {
            0.0
        };
        Self {
            gain: 1.0 + slope,
            offset: 0.5 * (more[0] + more[1] - slope * (luma[0] + luma[1])),
        }
    }
}

/// Luma of even pixels that have found their depth, and of what each source shows there.
fn pairs(reference: &Grey, warps: &[Warp<'_>], planes: &Planes) -> Vec<Vec<(f32, f32)>> {
    let costs = matching_costs(reference, warps, planes, 0.0);
    let mut pairs = vec![Vec::new(); warps.len()];
    for (ix, costs) in costs.chunks_exact(planes.n).enumerate() {
        let (x, y) = (ix % reference.width, ix / reference.width);
        let best = costs.iter().enumerate().min_by_key(|(_, cost)| **cost);
        let Some((plane, _)) = best.filter(|(_, cost)| **cost <= MOST_COST) else {
            continue;
        };
        if slack(reference, x, y) > MOST_SLACK {
            continue;
        }
        let inverse_depth = planes.inverse_depth(plane as f64);
        for (warp, pairs) in warps.iter().zip(&mut pairs) {
            let at = warp.pixel_in_source(x as f64, y as f64, inverse_depth);
            if let Some(luma) = at.and_then(|at| nearest(warp.source, at)) {
                pairs.push((reference.row(y)[x], luma));
            }
        }
    }
    pairs
}

fn median(mut values: Vec<f32>) -> f32 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

fn nearest(grey: &Grey, at: glam::DVec2) -> Option<f32> {
    let (x, y) = (at.x.round(), at.y.round());
    let inside = x >= 0.0 && y >= 0.0 && x < grey.width as f64 && y < grey.height as f64;
    inside.then(|| grey.row(y as usize)[x as usize])
}

/// `None` where too little would be left.
fn coarse(view: &Prepared) -> Option<Prepared> {
    let (width, height) = (view.grey.width / COARSE, view.grey.height / COARSE);
    if width < MIN_SIDE_PX || height < MIN_SIDE_PX {
        return None;
    }
    let values = (0..width * height).map(|ix| {
        let (x, y) = (ix % width * COARSE, ix / width * COARSE);
        let rows = (y..y + COARSE).map(|row| &view.grey.row(row)[x..x + COARSE]);
        rows.flatten().sum::<f32>() / (COARSE * COARSE) as f32
    });
    let scale = 1.0 / COARSE as f64;
    let mut intrinsics = view.intrinsics;
    (intrinsics.width_px, intrinsics.height_px) = (width as u32, height as u32);
    (intrinsics.fx, intrinsics.fy) = (intrinsics.fx * scale, intrinsics.fy * scale);
    (intrinsics.cx, intrinsics.cy) = (intrinsics.cx * scale, intrinsics.cy * scale);
    Some(Prepared {
        grey: Grey {
            width,
            height,
            values: values.collect(),
            colours: Vec::new(),
        },
        fine: Grey::empty(),
        intrinsics,
        world_from_cam: view.world_from_cam,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Luma evenly from -0.4 to 0.4 as a source shows it; every fourth pair is of something else.
    fn pairs_by(light: Light) -> Vec<(f32, f32)> {
        let luma = (0..400).map(|ix| (ix, -0.4 + 0.002 * ix as f32));
        let source = |(ix, luma): (usize, f32)| {
            let noise = 0.004 * ((ix * 37 % 11) as f32 / 5.0 - 1.0);
            let other = 0.8 * ((ix * 53 % 17) as f32 / 8.0 - 1.0);
            (
                luma,
                if ix % 4 == 0 {
                    other
                } else {
                    light.of_source(luma) + noise
                },
            )
        };
        luma.map(source).collect()
    }

    #[test]
    fn gain_and_offset_are_found_among_wrong_pairs() {
        for (gain, offset) in [(0.8, 0.05), (1.15, -0.04), (1.0, 0.1)] {
            let found = Light::between(&pairs_by(Light { gain, offset }));
            let off = (found.gain - gain).abs().max((found.offset - offset).abs());
            assert!(off < 0.03, "{gain} {offset}: {found:?}");
        }
    }

    #[test]
    fn the_same_light_stays_the_same() {
        assert_eq!(Light::between(&pairs_by(Light::SAME)), Light::SAME);
        let mut few = pairs_by(Light {
            gain: 0.8,
            offset: 0.1,
        });
        few.truncate(MIN_PAIRS - 1);
        assert_eq!(Light::between(&few), Light::SAME);
    }
}
