//! Luma of a source by that of the reference, where exposure or lamps differ between them.
//!
//! A coarse sweep by windows alone, which no change of light disturbs, finds depth; the pairs of pixels that it finds say
//! how luma goes over into luma: by one gain and offset, and by what is left in each part of the image (sheen, shade,
//! a lens darker towards its rim). Without that a pixel could not be determined by its own luma in images of a camera that
//! sets its exposure by itself.

use std::sync::Arc;

use crate::mvs::luma::Grey;
use crate::mvs::luma_map::LumaFit;
use crate::mvs::planes::Planes;
use crate::mvs::sweep::matching_costs;
use crate::mvs::view::{MIN_SIDE_PX, Prepared};
use crate::mvs::warp::Warp;
use crate::mvs::zncc::slack;

/// Side of the square of pixels that make one coarse pixel.
const COARSE: usize = 4;
const N_PLANES: usize = 32;
/// Costs, of 255, above which a coarse pixel has not found its depth.
const MOST_COST: u8 = 40;
/// Half the step of luma to the neighbours above which a pixel that is a little off would count as light.
const MOST_SLACK: f32 = 0.03;
/// Fewer pairs say nothing.
const MIN_PAIRS: usize = 50;
/// Darker and brighter pixels must lie this far apart to distinguish a gain from an offset.
const MIN_RANGE: f32 = 0.1;
/// A gain farther from 1 is none of light.
const MOST_GAIN: f32 = 0.3;
/// The median difference must fall by this factor; else the light is the same, and what differs is something else.
const MIN_FALL: f32 = 1.3;
/// A median difference that is as good as none: a quarter of a grey level.
const NO_DIFFERENCE: f32 = 0.001;
/// Side of a part of the image, in coarse pixels.
const PART: usize = 8;
/// Fewer pairs say nothing of a part; as many others without an offset are added to those that are there.
const MIN_PAIRS_OF_PART: usize = 6;
/// A part's offset must stand out so far from the scatter of its median: wrong pairs scatter widely.
const MIN_SIGNIFICANCE: f32 = 6.0;
const MOST_OF_PART: f32 = 0.1;

impl LumaFit {
    fn between(pairs: &[Pair]) -> Self {
        if pairs.len() < MIN_PAIRS {
            return Self::SAME;
        }
        let fitted = Self::fitted(pairs);
        let off = |light: Self| {
            let off = pairs.iter().map(|pair| pair.off(light).abs());
            median(off.collect())
        };
        let is_better = off(Self::SAME) > MIN_FALL * off(fitted).max(NO_DIFFERENCE);
        if is_better { fitted } else { Self::SAME }
    }

    /// Through the medians of the darker and the brighter half.
    fn fitted(pairs: &[Pair]) -> Self {
        let mut pairs = pairs.to_vec();
        pairs.sort_by(|a, b| a.own.total_cmp(&b.own));
        let (dark, bright) = pairs.split_at(pairs.len() / 2);
        let luma = [dark, bright].map(|half| median(half.iter().map(|p| p.own).collect()));
        let more =
            [dark, bright].map(|half| median(half.iter().map(|p| p.off(Self::SAME)).collect()));
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

/// The light of a source over the image of the reference.
#[derive(Debug, Clone)]
pub(crate) struct Lighting {
    pub(crate) overall: LumaFit,
    /// What is to be added in each part of the image, `columns` by `rows`.
    parts: Vec<f32>,
    columns: usize,
    rows: usize,
}

impl Lighting {
    pub(crate) const SAME: Self = Self {
        overall: LumaFit::SAME,
        parts: Vec::new(),
        columns: 0,
        rows: 0,
    };

    /// Of each source; the same light where too little is found.
    pub(crate) fn of(reference: &Prepared, sources: &[&Prepared], planes: &Planes) -> Vec<Self> {
        let mut all = vec![Self::SAME; sources.len()];
        let Some(reference) = coarse(reference) else {
            return all;
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
                all[ix] = Self::between(&pairs, (reference.grey.width, reference.grey.height));
            }
        }
        all
    }

    /// `size`: of the coarse image.
    fn between(pairs: &[Pair], (width, height): (usize, usize)) -> Self {
        let overall = LumaFit::between(pairs);
        let (columns, rows) = (width.div_ceil(PART), height.div_ceil(PART));
        let mut off = vec![Vec::new(); columns * rows];
        for pair in pairs {
            let [x, y] = pair.at;
            off[y / PART * columns + x / PART].push(pair.off(overall));
        }
        Self {
            overall,
            parts: off.iter().map(|off| offset_of_part(off)).collect(),
            columns,
            rows,
        }
    }

    /// At a pixel of the reference; between the middles of parts it changes evenly.
    pub(crate) fn at(&self, x: usize, y: usize) -> LumaFit {
        let LumaFit { gain, offset } = self.overall;
        if self.parts.is_empty() {
            return self.overall;
        }
        let place = |pixel: usize, n: usize| {
            let place = (pixel as f32 + 0.5) / (PART * COARSE) as f32 - 0.5;
            let place = place.clamp(0.0, (n - 1) as f32);
            let first = (place as usize).min(n.saturating_sub(2));
            (first, (first + 1).min(n - 1), place - first as f32)
        };
        let (left, right, x) = place(x, self.columns);
        let (above, below, y) = place(y, self.rows);
        let row = |row: usize| {
            let parts = &self.parts[row * self.columns..];
            parts[left] + (parts[right] - parts[left]) * x
        };
        LumaFit {
            gain,
            offset: offset + row(above) + (row(below) - row(above)) * y,
        }
    }

    /// The reference's luma as the source shows it.
    pub(crate) fn shown(&self, reference: &Grey) -> Vec<f32> {
        let (pixels, width) = (reference.values.iter().enumerate(), reference.width);
        pixels
            .map(|(ix, luma)| self.at(ix % width, ix / width).of_source(*luma))
            .collect()
    }
}

/// 0 where it does not stand out.
fn offset_of_part(off: &[f32]) -> f32 {
    let n = off.len() as f32;
    if off.len() < MIN_PAIRS_OF_PART {
        return 0.0;
    }
    let middle = median(off.to_vec());
    let scatter = median(off.iter().map(|o| (o - middle).abs()).collect());
    if middle.abs() < MIN_SIGNIFICANCE * scatter / n.sqrt() {
        return 0.0;
    }
    let held = middle * n / (n + MIN_PAIRS_OF_PART as f32);
    held.clamp(-MOST_OF_PART, MOST_OF_PART)
}

/// Luma of a coarse pixel, and of what a source shows there.
#[derive(Debug, Clone, Copy)]
struct Pair {
    at: [usize; 2],
    own: f32,
    seen: f32,
}

impl Pair {
    fn off(&self, light: LumaFit) -> f32 {
        self.seen - light.of_source(self.own)
    }
}

/// Even pixels that have found their depth, by source.
fn pairs(reference: &Grey, warps: &[Warp<'_>], planes: &Planes) -> Vec<Vec<Pair>> {
    let costs = matching_costs(reference, warps, planes, 0.0, &|| ());
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
            if let Some(seen) = at.and_then(|at| luma_at(warp.source, at)) {
                let own = reference.row(y)[x];
                pairs.push(Pair {
                    at: [x, y],
                    own,
                    seen,
                });
            }
        }
    }
    pairs
}

fn median(mut values: Vec<f32>) -> f32 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

/// Bilinear; `None` beyond the outermost centres.
fn luma_at(grey: &Grey, at: glam::DVec2) -> Option<f32> {
    let last = glam::DVec2::new((grey.width - 1) as f64, (grey.height - 1) as f64);
    if !(at.cmpge(glam::DVec2::ZERO).all() && at.cmple(last).all()) {
        return None;
    }
    let (x, y) = (
        (at.x as usize).min(grey.width - 2),
        (at.y as usize).min(grey.height - 2),
    );
    let (share_x, share_y) = ((at.x - x as f64) as f32, (at.y - y as f64) as f32);
    let between = |row: &[f32]| row[x] + (row[x + 1] - row[x]) * share_x;
    let (above, below) = (between(grey.row(y)), between(grey.row(y + 1)));
    Some(above + (below - above) * share_y)
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
        grey: Arc::new(Grey {
            width,
            height,
            values: values.collect(),
            colours: Vec::new(),
        }),
        fine: Arc::new(Grey::empty()),
        intrinsics,
        submap_from_cam: view.submap_from_cam,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Luma evenly from -0.4 to 0.4 as a source shows it; every fourth pair is of something else.
    fn pairs_by(light: LumaFit) -> Vec<Pair> {
        let luma = (0..400).map(|ix| (ix, -0.4 + 0.002 * ix as f32));
        let source = |(ix, luma): (usize, f32)| {
            let noise = 0.004 * ((ix * 37 % 11) as f32 / 5.0 - 1.0);
            let other = 0.8 * ((ix * 53 % 17) as f32 / 8.0 - 1.0);
            let right = light.of_source(luma) + noise;
            Pair {
                at: [ix % 20, ix / 20],
                own: luma,
                seen: if ix % 4 == 0 { other } else { right },
            }
        };
        luma.map(source).collect()
    }

    #[test]
    fn gain_and_offset_are_found_among_wrong_pairs() {
        for (gain, offset) in [(0.8, 0.05), (1.15, -0.04), (1.0, 0.1)] {
            let found = LumaFit::between(&pairs_by(LumaFit { gain, offset }));
            let off = (found.gain - gain).abs().max((found.offset - offset).abs());
            assert!(off < 0.03, "{gain} {offset}: {found:?}");
        }
    }

    #[test]
    fn the_same_light_stays_the_same() {
        assert_eq!(LumaFit::between(&pairs_by(LumaFit::SAME)), LumaFit::SAME);
        let mut few = pairs_by(LumaFit {
            gain: 0.8,
            offset: 0.1,
        });
        few.truncate(MIN_PAIRS - 1);
        assert_eq!(LumaFit::between(&few), LumaFit::SAME);
    }

    #[test]
    fn a_part_in_another_light_is_found_and_noise_makes_none() {
        // 4 parts side by side; the last is brighter, the first holds wrong pairs only.
        let pair = |ix: usize| {
            let at = [ix % (4 * PART), ix / (4 * PART)];
            let own = 0.4 * ((ix * 29 % 31) as f32 / 15.0 - 1.0);
            let noise = 0.004 * ((ix * 37 % 11) as f32 / 5.0 - 1.0);
            let seen = match at[0] / PART {
                0 => 0.4 * ((ix * 53 % 17) as f32 / 8.0 - 1.0),
                3 => own + 0.05 + noise,
                _ => own + noise,
            };
            Pair { at, own, seen }
        };
        let pairs: Vec<Pair> = (0..4 * PART * PART).map(pair).collect();
        let lighting = Lighting::between(&pairs, (4 * PART, PART));
        assert_eq!(lighting.overall, LumaFit::SAME);
        let offset = |column: usize| lighting.at(column * COARSE, 0).offset;
        let (bright, between) = (offset(4 * PART - 1), offset(3 * PART));
        assert_eq!([offset(0), offset(PART)], [0.0; 2]);
        assert!((bright - 0.05).abs() < 0.006, "{bright}");
        assert!(
            between > 0.3 * bright && between < 0.7 * bright,
            "{between}"
        );
        let grey = Grey {
            width: 4 * PART * COARSE,
            height: 1,
            values: vec![0.1; 4 * PART * COARSE],
            colours: Vec::new(),
        };
        let shown = lighting.shown(&grey);
        assert_eq!(shown[0], 0.1);
        assert!((shown[grey.width - 1] - 0.1 - bright).abs() < 1e-6);
    }
}
