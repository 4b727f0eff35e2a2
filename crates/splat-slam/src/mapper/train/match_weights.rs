//! Epipolar errors of all matches -> the weight of each: matches that err as most do are right, others are not.

/// Bins of the histogram, and the error at its end, px of an image of this longer side (VGGT-X works on 518 px).
const BINS: usize = 100;
const MAX_ERROR_PX: f64 = 20.0;
pub(crate) const ERROR_SIDE_PX: f64 = 518.0;

/// The share of all matches that is in the same bin of the histogram of errors, over the mean of all shares (the adaptive weights of
/// VGGT-X, arXiv 2509.25191, which 3R-GS shares). 0 beyond the last bin and for matches without an error, as near an epipole.
pub(crate) fn adaptive_weights(errors_px: &[Option<f64>]) -> Vec<f32> {
    let bin = |error: &Option<f64>| {
        let error = error.filter(|e| (0.0..=MAX_ERROR_PX).contains(e))?;
        Some(((error / MAX_ERROR_PX * BINS as f64) as usize).min(BINS - 1))
    };
    let mut counts = [0_usize; BINS];
    for bin in errors_px.iter().filter_map(bin) {
        counts[bin] += 1;
    }
    let mass: Vec<f64> = errors_px
        .iter()
        .map(|error| bin(error).map_or(0.0, |bin| counts[bin] as f64))
        .collect();
    let mean = mass.iter().sum::<f64>() / mass.len().max(1) as f64;
    let weight = |mass: f64| {
        if mean > 0.0 {
            (mass / mean) as f32
        } else {
            0.0
        }
    };
    mass.into_iter().map(weight).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_that_err_as_most_do_have_the_most_weight() {
        // Three in the bin from 1.0 to 1.2 px, one at 5 px, one beyond the end, one without an error.
        let errors = [1.01, 1.1, 1.19, 5.0, 21.0].map(Some);
        let errors: Vec<_> = errors.into_iter().chain([None]).collect();
        let mean = (3.0 * 3.0 + 1.0) / 6.0;
        let expected = [3.0, 3.0, 3.0, 1.0, 0.0, 0.0].map(|mass: f32| mass / mean as f32);
        let found = adaptive_weights(&errors);
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{found} for {expected}");
        }
        assert!((found.iter().sum::<f32>() - 6.0).abs() < 1e-5, "of mean 1");
    }

    #[test]
    fn matches_that_are_all_wrong_have_no_weight() {
        assert_eq!(
            adaptive_weights(&[Some(25.0), None, Some(f64::NAN)]),
            [0.0; 3]
        );
        assert!(adaptive_weights(&[]).is_empty());
    }
}
