//! Two small images -> how far one is shifted in the other, roughly.

use crate::select::grey::GreyImage;

/// Images are compared at about this size of the longer side.
const SIDE_PX: usize = 60;
/// Share of the image that must be in both.
const MIN_OVERLAP: f64 = 0.35;
/// Shifts at half the size that are looked at again.
const N_REFINED: usize = 4;
/// Least correlation of what is in both.
const MIN_CORRELATION: f32 = 0.3;

/// The image at a size at which whole images are compared.
pub(crate) fn small(image: &GreyImage) -> GreyImage {
    let mut small = image.halved();
    while small.width.max(small.height) > SIDE_PX {
        small = small.halved();
    }
    small
}

/// What is at a place of `from` is at that place plus the shift in `to`, as shares of width and height; `None` where no shift makes
/// them alike, or the sizes differ.
pub(crate) fn image_shift(from: &GreyImage, to: &GreyImage) -> Option<[f64; 2]> {
    if from.size() != to.size() {
        return None;
    }
    // All shifts at half the size, then those around the best ones.
    let (small_from, small_to) = (from.halved(), to.halved());
    let (width, height) = (small_from.width as i64, small_from.height as i64);
    let all = (1 - height..height).flat_map(|dy| (1 - width..width).map(move |dx| [dx, dy]));
    let score = |shift: [i64; 2]| Some((shift, correlation(&small_from, &small_to, shift)?));
    let mut coarse: Vec<([i64; 2], f32)> = all.filter_map(score).collect();
    coarse.sort_by(|a, b| b.1.total_cmp(&a.1));
    coarse.truncate(N_REFINED);
    let near = coarse.iter().flat_map(|([dx, dy], _)| {
        let (dx, dy) = (2 * dx, 2 * dy);
        (-1..=1).flat_map(move |y| (-1..=1).map(move |x| [dx + x, dy + y]))
    });
    let fine = near.filter_map(|shift| Some((shift, correlation(from, to, shift)?)));
    let ([dx, dy], score) = fine.max_by(|a, b| a.1.total_cmp(&b.1))?;
    let share = |d: i64, side: usize| d as f64 / side as f64;
    (score >= MIN_CORRELATION).then(|| [share(dx, from.width), share(dy, from.height)])
}

/// Of what is in both images when `from` is shifted; `None`: too little.
fn correlation(from: &GreyImage, to: &GreyImage, [dx, dy]: [i64; 2]) -> Option<f32> {
    let left = |d: i64, side: usize| (side as i64 - d.abs()).max(0);
    let overlap = left(dx, from.width) * left(dy, from.height);
    if (overlap as f64) < MIN_OVERLAP * (from.width * from.height) as f64 {
        return None;
    }
    let span = |d: i64, side: usize| {
        let first = (-d).max(0) as usize;
        first..first + side - d.unsigned_abs() as usize
    };
    let (columns, rows) = (span(dx, from.width), span(dy, from.height));
    let n = (columns.len() * rows.len()) as f32;
    let (mut a, mut b, mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for y in rows {
        let own = &from.values[y * from.width..][columns.clone()];
        let start = (y as i64 + dy) as usize * to.width + (columns.start as i64 + dx) as usize;
        for (own, other) in own.iter().zip(&to.values[start..start + own.len()]) {
            a += own;
            b += other;
            aa += own * own;
            bb += other * other;
            ab += own * other;
        }
    }
    let squares = (aa - a * a / n) * (bb - b * b / n);
    Some(if squares > 0.0 {
        (ab - a * b / n) / squares.sqrt()
    } else {
        0.0
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texture(shift: [f32; 2]) -> GreyImage {
        let (width, height) = (40, 30);
        let value = |p: usize| {
            let (x, y) = ((p % width) as f32 - shift[0], (p / width) as f32 - shift[1]);
            0.5 + 0.2 * ((0.31 * x).sin() * (0.23 * y).cos() + (0.05 * x * y * 0.1 + 0.4 * y).sin())
        };
        GreyImage {
            width,
            height,
            values: (0..width * height).map(value).collect(),
        }
    }

    #[test]
    fn shifts_of_up_to_a_quarter_are_found_and_what_is_not_alike_has_none() {
        for shift in [[0.0, 0.0], [8.0, -5.0], [-10.0, 7.0]] {
            let found = image_shift(&texture([0.0; 2]), &texture(shift)).unwrap();
            let expected = [shift[0] as f64 / 40.0, shift[1] as f64 / 30.0];
            assert!(
                (0..2).all(|i| (found[i] - expected[i]).abs() < 1e-6),
                "{found:?} {shift:?}"
            );
        }
        let flat = GreyImage {
            values: vec![0.5; 1200],
            ..texture([0.0; 2])
        };
        assert_eq!(image_shift(&texture([0.0; 2]), &flat), None);
        let other = GreyImage {
            width: 30,
            height: 40,
            values: vec![0.5; 1200],
        };
        assert_eq!(image_shift(&texture([0.0; 2]), &other), None);
    }
}
