//! Two images and points of the first -> where those points are in the second.
//!
//! Pyramidal Lucas-Kanade with forward-additive Gauss-Newton (Bouguet 2000), a window of 21x21 pixels.

use rayon::prelude::*;

use crate::select::grey::GreyImage;
use crate::select::window::Window;

const MAX_ITERATIONS: usize = 15;
/// A step shorter than this has converged.
const MIN_STEP_PX: f32 = 0.01;
/// Levels on which a point is looked for that is expected within some 20 pixels.
const LEVELS_NEAR: usize = 2;
/// Smaller eigenvalue of the structure tensor, per pixel of the window, below which a point of a dense grid has no definite place,
/// and a corner has none: its window is flat but for a few pixels.
const MIN_EIGENVALUE: f32 = 1e-4;
const MIN_CORNER_EIGENVALUE: f32 = 1e-5;
/// Far points are looked for within this share of the longer side, and patches reach so many pixels from their middle.
const SEARCH_SHARE: f32 = 1.0 / 7.0;
const PATCH: i64 = 4;

/// An image at full size, half, quarter, and so on, with derivatives.
#[derive(Debug, Clone)]
pub(crate) struct Pyramid {
    levels: Vec<Level>,
}

#[derive(Debug, Clone)]
struct Level {
    image: GreyImage,
    gradients: [GreyImage; 2],
}

/// Where a point was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Found {
    pub at: [f32; 2],
    /// Mean absolute difference between the windows.
    pub error: f32,
}

impl Pyramid {
    /// Without derivatives: what others are followed in, not from.
    pub(crate) fn without_gradients(image: GreyImage, max_level: usize) -> Self {
        Self::of(image, max_level, |_| {
            [GreyImage::empty(), GreyImage::empty()]
        })
    }

    /// `max_level` halvings.
    pub(crate) fn new(image: GreyImage, max_level: usize) -> Self {
        Self::of(image, max_level, GreyImage::gradients)
    }

    fn of(
        image: GreyImage,
        max_level: usize,
        gradients: impl Fn(&GreyImage) -> [GreyImage; 2],
    ) -> Self {
        let mut levels: Vec<Level> = Vec::with_capacity(max_level + 1);
        let mut image = Some(image);
        while let Some(next) = image.take() {
            let gradients = gradients(&next);
            image = (levels.len() < max_level).then(|| next.halved());
            levels.push(Level {
                image: next,
                gradients,
            });
        }
        Self { levels }
    }

    /// The image at full size.
    pub(crate) fn image(&self) -> &GreyImage {
        &self.levels[0].image
    }

    pub(crate) fn n_levels(&self) -> usize {
        self.levels.len()
    }

    /// The image after so many halvings.
    pub(crate) fn level(&self, level_ix: usize) -> Option<&GreyImage> {
        self.levels.get(level_ix).map(|level| &level.image)
    }

    /// The image after the most halvings.
    pub(crate) fn coarsest(&self) -> &GreyImage {
        &self.levels[self.levels.len() - 1].image
    }

    /// The image at half size, where there is one.
    pub(crate) fn half(&self) -> Option<&GreyImage> {
        self.levels.get(1).map(|level| &level.image)
    }
}

/// Follows any pixel positions of `from` into `to`, an image of the same size; `None` where the window has too little
/// structure.
pub(crate) fn optical_flow(
    from: &Pyramid,
    to: &Pyramid,
    points: &[[f32; 2]],
) -> Vec<Option<Found>> {
    let begin = |point: &[f32; 2]| Some((*point, Begin::anywhere(MIN_EIGENVALUE)));
    follow_each(from, to, points, begin)
}

/// The same for corners, begun where one is expected: (point, where it may be now). Who is expected near is looked for on the finest
/// levels alone.
pub(crate) fn optical_flow_near(
    from: &Pyramid,
    to: &Pyramid,
    points: &[([f32; 2], Option<[f32; 2]>)],
) -> Vec<Option<Found>> {
    let anywhere = Begin::anywhere(MIN_CORNER_EIGENVALUE);
    let begin = |(point, near): &([f32; 2], Option<[f32; 2]>)| {
        let expected = near.map(|near| Begin {
            shift: [near[0] - point[0], near[1] - point[1]],
            n_levels: LEVELS_NEAR,
            ..anywhere
        });
        Some((*point, expected.unwrap_or(anywhere)))
    };
    follow_each(from, to, points, begin)
}

/// The same for corners that have all moved by about one shift, on all levels.
pub(crate) fn optical_flow_shifted(
    from: &Pyramid,
    to: &Pyramid,
    points: &[[f32; 2]],
    shift: [f32; 2],
) -> Vec<Option<Found>> {
    let begin = Begin {
        shift,
        ..Begin::anywhere(MIN_CORNER_EIGENVALUE)
    };
    follow_each(from, to, points, |point| Some((*point, begin)))
}

/// The same for points that may be anywhere within a seventh of the longer side: each begins where its
/// patch looks most alike on the coarsest level. Takes about as long as ten of the others.
pub(crate) fn optical_flow_far(
    from: &Pyramid,
    to: &Pyramid,
    points: &[[f32; 2]],
) -> Vec<Option<Found>> {
    let begin = |point: &[f32; 2]| {
        let begin = Begin {
            shift: most_alike(from, to, *point)?,
            ..Begin::anywhere(MIN_CORNER_EIGENVALUE)
        };
        Some((*point, begin))
    };
    follow_each(from, to, points, begin)
}

/// How a point is looked for.
#[derive(Debug, Clone, Copy)]
struct Begin {
    /// From where it was, at full size.
    shift: [f32; 2],
    /// On so many of the finest levels.
    n_levels: usize,
    /// Of its window, per pixel, at least.
    min_eigenvalue: f32,
}

impl Begin {
    fn anywhere(min_eigenvalue: f32) -> Self {
        Self {
            shift: [0.0; 2],
            n_levels: usize::MAX,
            min_eigenvalue,
        }
    }
}

fn follow_each<T: Sync>(
    from: &Pyramid,
    to: &Pyramid,
    points: &[T],
    begin: impl Fn(&T) -> Option<([f32; 2], Begin)> + Sync,
) -> Vec<Option<Found>> {
    assert_eq!(from.image().size(), to.image().size(), "images of one size");
    let follow = |point: &T| begin(point).and_then(|(at, begin)| follow(from, to, at, begin));
    points.par_iter().map(follow).collect()
}

/// The shift, at full size, after which the patch about a point on the coarsest level differs least; `None` where the patch
/// leaves the image.
fn most_alike(from: &Pyramid, to: &Pyramid, point: [f32; 2]) -> Option<[f32; 2]> {
    let level = from.levels.len().checked_sub(1)?;
    let (from, to) = (&from.levels[level].image, &to.levels[level].image);
    let scale = 0.5_f32.powi(level as i32);
    let reach = (SEARCH_SHARE * from.width.max(from.height) as f32).ceil() as i64;
    let centre = point.map(|v| (v * scale) as i64);
    let sides = [from.width as i64, from.height as i64];
    let fits = |at: [i64; 2]| (0..2).all(|a| at[a] >= PATCH && at[a] + PATCH < sides[a]);
    let row = |at: [i64; 2], dy: i64| {
        let start = (at[1] + dy) * sides[0] + at[0] - PATCH;
        start as usize..(start + 2 * PATCH + 1) as usize
    };
    if !fits(centre) {
        return None;
    }
    let difference = |at: [i64; 2]| -> f32 {
        let rows = (-PATCH..=PATCH).map(|dy| {
            let own = &from.values[row(centre, dy)];
            let other = &to.values[row(at, dy)];
            own.iter()
                .zip(other)
                .map(|(a, b)| (a - b).abs())
                .sum::<f32>()
        });
        rows.sum()
    };
    let shifts = (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| [dx, dy]));
    let found = shifts
        .map(|shift| (shift, [centre[0] + shift[0], centre[1] + shift[1]]))
        .filter(|(_, at)| fits(*at))
        .map(|(shift, at)| (shift, difference(at)))
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(found.0.map(|v| v as f32 / scale))
}

fn follow(from: &Pyramid, to: &Pyramid, point: [f32; 2], begin: Begin) -> Option<Found> {
    let n_levels = begin.n_levels.min(from.levels.len());
    let coarsest = 0.5_f32.powi(n_levels.saturating_sub(1) as i32);
    let mut shift = begin.shift.map(|v| v * coarsest);
    let levels = from.levels.iter().zip(&to.levels).take(n_levels);
    for (level_ix, (from, to)) in levels.enumerate().rev() {
        let scale = 0.5_f32.powi(level_ix as i32);
        let centre = point.map(|v| v * scale);
        let window = Window::cut(&from.image, &from.gradients, centre);
        let inverse = window.inverse_tensor(begin.min_eigenvalue)?;
        for _ in 0..MAX_ITERATIONS {
            let at = [centre[0] + shift[0], centre[1] + shift[1]];
            let [d, e] = window.descent(&to.image, at);
            let step = inverse.times([d, e]);
            shift = [shift[0] + step[0], shift[1] + step[1]];
            if step[0] * step[0] + step[1] * step[1] < MIN_STEP_PX * MIN_STEP_PX {
                break;
            }
        }
        if level_ix == 0 {
            let at = [point[0] + shift[0], point[1] + shift[1]];
            let error = window.difference(&to.image, at);
            return Some(Found { at, error });
        }
        shift = shift.map(|v| v * 2.0);
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Smooth, with structure everywhere; shifted by a fraction of a pixel.
    fn texture(shift: [f32; 2]) -> GreyImage {
        let (width, height) = (160, 120);
        let value = |p: usize| {
            let (x, y) = ((p % width) as f32 - shift[0], (p / width) as f32 - shift[1]);
            let waves = (0.31 * x).sin() * (0.23 * y).cos() + (0.11 * x + 0.17 * y).sin();
            0.5 + 0.2 * waves
        };
        GreyImage {
            width,
            height,
            values: (0..width * height).map(value).collect(),
        }
    }

    fn flow(shift: [f32; 2], max_level: usize, points: &[[f32; 2]]) -> Vec<Option<Found>> {
        let pyramid = |shift| Pyramid::new(texture(shift), max_level);
        optical_flow(&pyramid([0.0; 2]), &pyramid(shift), points)
    }

    #[test]
    fn a_shift_is_found_to_a_fiftieth_of_a_pixel() {
        let points = [[40.0, 40.0], [80.3, 60.8], [120.0, 90.0]];
        for shift in [[0.25, -0.5], [3.5, 2.25], [-7.0, 5.0]] {
            for (point, found) in points.iter().zip(flow(shift, 2, &points)) {
                let found = found.unwrap();
                for axis in 0..2 {
                    let off = found.at[axis] - point[axis] - shift[axis];
                    assert!(off.abs() < 0.02, "{point:?} {shift:?}: off by {off}");
                }
                assert!(found.error < 2e-3, "{}", found.error);
            }
        }
    }

    #[test]
    fn points_at_the_border_and_outside_are_followed_or_lost_without_a_fault() {
        let points = [
            [0.0, 0.0],
            [159.0, 119.0],
            [9.9, 60.0],
            [-1.0, -1.0],
            [1e6, 5.0],
        ];
        for found in flow([1.0, 0.5], 2, &points).into_iter().flatten() {
            assert!(found.at.iter().all(|v| v.is_finite()));
        }
    }

    #[test]
    fn a_blank_wall_has_nothing_to_follow() {
        let blank = || {
            let values = vec![0.4; 64 * 48];
            Pyramid::new(
                GreyImage {
                    width: 64,
                    height: 48,
                    values,
                },
                1,
            )
        };
        assert_eq!(optical_flow(&blank(), &blank(), &[[30.0, 20.0]]), [None]);
    }
}
