//! Corners, each followed from frame to frame under one number.

use std::collections::BTreeSet;

use crate::select::grey::GreyImage;
use crate::select::image_shift::{image_shift, small};
use crate::select::motion::corners_in_cells;
use crate::select::optical_flow::{
    Found, Pyramid, optical_flow_far, optical_flow_near, optical_flow_shifted,
};

/// Cells of an image, about; each has one new corner where it has none.
const N_CELLS: usize = 500;
/// Smaller eigenvalue of the structure tensor from which a place at half size is a corner: there, sensor noise of two levels gives
/// 6e-4.
const MIN_RESPONSE: f32 = 1.5e-3;
/// The same where fewer than a share of the cells have a corner, as in the dark: some will be noise, and are given up soon.
const MIN_WEAK_RESPONSE: f32 = 5e-4;
const FEW_CORNERS: usize = N_CELLS / 4;
/// Least longer side of the coarsest level, on which windows still lie inside.
const COARSEST_PX: usize = 80;
/// Mean absolute difference of the windows, grey 0..1, above which a corner has slipped.
const MAX_ERROR: f32 = 0.08;
/// Share of the corners that must be found near where they were expected.
const MIN_AS_EXPECTED: f64 = 0.6;
/// Corners nearer than this to the border are given up: much of their windows leaves the image, and their places err.
const BORDER_PX: f32 = 8.0;

/// A corner that is followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FeatureTrack {
    /// Never given twice.
    pub(crate) id: u32,
    /// In the newest image, as the lens shows it.
    pub(crate) pixel: [f32; 2],
}

/// All corners of the newest image that are followed.
#[derive(Debug, Default)]
pub(crate) struct FeatureTracks {
    pub(crate) tracks: Vec<FeatureTrack>,
    newest: Option<Pyramid>,
    next_id: u32,
}

impl FeatureTracks {
    pub(crate) fn newest_image(&self) -> Option<&Pyramid> {
        self.newest.as_ref()
    }

    /// Follows all corners into the next image; `expected` says where one may be. An image of another size loses all.
    pub(crate) fn follow(
        &mut self,
        grey: GreyImage,
        expected: impl Fn(&FeatureTrack) -> Option<[f32; 2]>,
    ) {
        let longest = grey.width.max(grey.height);
        let n_halvings = (longest / COARSEST_PX).max(1).ilog2() as usize;
        let next = Pyramid::new(grey, n_halvings);
        let last = self.newest.take();
        let same_size = |last: &Pyramid| last.image().size() == next.image().size();
        let Some(last) = last.filter(same_size) else {
            self.tracks.clear();
            self.newest = Some(next);
            return;
        };
        let inside = |p: [f32; 2]| is_inside(next.image(), p);
        let near = |track: &FeatureTrack| (track.pixel, expected(track).filter(|p| inside(*p)));
        let points: Vec<_> = self.tracks.iter().map(near).collect();
        let is_good = |found: &Option<Found>| {
            found.is_some_and(|found| found.error < MAX_ERROR && inside(found.at))
        };
        let is_enough = |found: &[Option<Found>]| {
            let n_good = found.iter().filter(|found| is_good(found)).count();
            n_good as f64 >= MIN_AS_EXPECTED * points.len() as f64
        };
        let mut found = optical_flow_near(&last, &next, &points);
        if !is_enough(&found) {
            // The camera has not gone on as it went: all are looked for from where they were, by what is coarse, for far
            // motion, and by what is fine, since repeated patterns mislead where they are small; then farther than windows reach.
            let places: Vec<[f32; 2]> = points.iter().map(|(at, _)| *at).collect();
            let shift = image_shift(&small(last.coarsest()), &small(next.coarsest()));
            if let Some([x, y]) = shift {
                let (width, height) = next.image().size();
                let shift = [x as f32 * width as f32, y as f32 * height as f32];
                keep_better(
                    &mut found,
                    optical_flow_shifted(&last, &next, &places, shift),
                );
            }
            if !is_enough(&found) {
                let anywhere: Vec<_> = places.iter().map(|at| (*at, None)).collect();
                let at_rest: Vec<_> = places.iter().map(|at| (*at, Some(*at))).collect();
                if points.iter().any(|(_, expected)| expected.is_some()) {
                    keep_better(&mut found, optical_flow_near(&last, &next, &anywhere));
                }
                keep_better(&mut found, optical_flow_near(&last, &next, &at_rest));
                if !is_enough(&found) {
                    keep_better(&mut found, optical_flow_far(&last, &next, &places));
                }
            }
        }
        let followed = self.tracks.iter().zip(found);
        let followed = followed.filter(|(_, found)| is_good(found));
        let followed = followed.filter_map(|(track, found)| {
            Some(FeatureTrack {
                id: track.id,
                pixel: found?.at,
            })
        });
        self.tracks = followed.collect();
        self.newest = Some(next);
    }

    /// New corners of the newest image in cells that have none.
    pub(crate) fn refill(&mut self) {
        self.refill_from(MIN_RESPONSE);
        if self.tracks.len() < FEW_CORNERS {
            self.refill_from(MIN_WEAK_RESPONSE);
        }
    }

    fn refill_from(&mut self, min_response: f32) {
        let Some(newest) = &self.newest else {
            return;
        };
        let cell_px = cell_px(newest.image());
        // Corners at half size cost a quarter, and have a definite place at full size as well.
        let (image, scale) = match newest.half() {
            Some(half) if cell_px.is_multiple_of(2) => (half, 2),
            _ => (newest.image(), 1),
        };
        let cell = |p: [f32; 2]| p.map(|v| v.max(0.0) as usize / cell_px);
        let taken: BTreeSet<[usize; 2]> = self.tracks.iter().map(|t| cell(t.pixel)).collect();
        let is_free = |cell: [usize; 2]| !taken.contains(&cell);
        for pixel in corners_in_cells(image, cell_px / scale, min_response, is_free) {
            let pixel = pixel.map(|v| v * scale as f32);
            if !is_inside(newest.image(), pixel) {
                continue;
            }
            // A corner on the edge of its cell may be that of the cell beside it.
            let is_apart = self.tracks.iter().all(|track| {
                let off = [0, 1].map(|axis| track.pixel[axis] - pixel[axis]);
                off[0].hypot(off[1]) >= 0.5 * cell_px as f32
            });
            if is_apart {
                self.tracks.push(FeatureTrack {
                    id: self.next_id,
                    pixel,
                });
                self.next_id = self.next_id.wrapping_add(1);
            }
        }
    }

    /// Gives up corners.
    pub(crate) fn retain(&mut self, mut is_kept: impl FnMut(u32) -> bool) {
        self.tracks.retain(|track| is_kept(track.id));
    }
}

/// Of two places of each corner, where it looks more alike.
fn keep_better(found: &mut [Option<Found>], others: Vec<Option<Found>>) {
    let error = |found: &Option<Found>| found.map_or(f32::INFINITY, |found| found.error);
    for (found, other) in found.iter_mut().zip(others) {
        if error(&other) < error(found) {
            *found = other;
        }
    }
}

/// Whether a corner is far enough from the border to be followed.
fn is_inside(image: &GreyImage, pixel: [f32; 2]) -> bool {
    let is_between = |at: f32, side: usize| at >= BORDER_PX && at < side as f32 - BORDER_PX;
    is_between(pixel[0], image.width) && is_between(pixel[1], image.height)
}

fn cell_px(grey: &GreyImage) -> usize {
    let side = ((grey.width * grey.height) as f64 / N_CELLS as f64).sqrt();
    ((side / 2.0).round() as usize).max(4) * 2
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(shift: f32) -> GreyImage {
        let (width, height) = (320, 240);
        let value = |p: usize| {
            let (x, y) = ((p % width) as f32 - shift, (p / width) as f32);
            let waves = (0.31 * x).sin() * (0.23 * y).cos() + (0.11 * x + 0.17 * y).sin();
            0.5 + 0.2 * waves
        };
        GreyImage {
            width,
            height,
            values: (0..width * height).map(value).collect(),
        }
    }

    #[test]
    fn corners_keep_their_numbers_and_free_cells_are_filled() {
        let mut tracks = FeatureTracks::default();
        tracks.follow(texture(0.0), |_| None);
        assert!(tracks.tracks.is_empty());
        tracks.refill();
        let first = tracks.tracks.clone();
        assert!(first.len() > 100, "{}", first.len());
        tracks.follow(texture(2.5), |_| None);
        assert!(
            10 * tracks.tracks.len() > 7 * first.len(),
            "{} of {}",
            tracks.tracks.len(),
            first.len()
        );
        for track in &tracks.tracks {
            let before = first.iter().find(|t| t.id == track.id).unwrap();
            assert!((track.pixel[0] - before.pixel[0] - 2.5).abs() < 0.1);
        }
        let n = tracks.tracks.len();
        tracks.retain(|id| id % 2 == 0);
        assert!(tracks.tracks.len() < n);
        tracks.refill();
        let mut ids: Vec<u32> = tracks.tracks.iter().map(|t| t.id).collect();
        ids.dedup();
        assert_eq!(ids.len(), tracks.tracks.len(), "numbers are unique");
        assert!(tracks.tracks.iter().any(|t| t.id as usize >= first.len()));
    }

    #[test]
    fn far_motion_is_found_where_it_is_expected_and_another_size_loses_all() {
        let mut tracks = FeatureTracks::default();
        tracks.follow(texture(0.0), |_| None);
        tracks.refill();
        let first = tracks.tracks.clone();
        let at = |id: u32| first.iter().find(|t| t.id == id).map(|t| t.pixel);
        tracks.follow(texture(30.0), |t| Some([t.pixel[0] + 29.0, t.pixel[1]]));
        let right = tracks.tracks.iter().filter(|track| {
            let before = at(track.id).unwrap();
            (track.pixel[0] - before[0] - 30.0).abs() < 0.2
        });
        assert!(right.count() > first.len() / 2);
        let small = GreyImage {
            width: 64,
            height: 48,
            values: vec![0.5; 64 * 48],
        };
        tracks.follow(small, |_| None);
        assert!(tracks.tracks.is_empty());
    }
}
