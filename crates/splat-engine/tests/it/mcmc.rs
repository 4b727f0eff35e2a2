//! Arithmetic of MCMC moves against the paper's, and the numbers they are drawn by.

use splat_engine::mcmc::{self, Relocation};

/// Opacity after sharing and factor on the scale, by the paper's double sum.
fn by_double_sum(opacity: f64, n: u32, min_opacity: f64) -> (f64, f64) {
    let shared = (1.0 - (1.0 - opacity).powf(1.0 / f64::from(n))).max(min_opacity);
    let mut sum = 0.0;
    for i in 1..=n {
        let mut binomial = 1.0;
        for k in 0..i {
            let sign = if k % 2 == 0 { 1.0 } else { -1.0 };
            sum += binomial * sign * shared.powi(k as i32 + 1) / f64::from(k + 1).sqrt();
            binomial *= f64::from(i - 1 - k) / f64::from(k + 1);
        }
    }
    (shared, opacity / sum)
}

#[test]
fn shares_are_those_of_the_papers_vectors() {
    for (o, n, shared, factor) in [
        (0.1, 2, 0.051_317, 0.992_346),
        (0.5, 2, 0.292_893, 0.952_152),
        (0.5, 3, 0.206_299, 0.936_882),
        (0.5, 10, 0.066_967, 0.916_068),
        (0.9, 2, 0.683_772, 0.867_938),
        (0.9, 5, 0.369_043, 0.797_124),
        (0.9, 51, 0.044_145, 0.757_846),
    ] {
        let found = Relocation::Line.shared(o, n, 0.005);
        assert!((found.0 - shared).abs() < 1e-5, "{o}, {n}: {found:?}");
        assert!((found.1 - factor).abs() < 1e-5, "{o}, {n}: {found:?}");
    }
    // Held at the least opacity, the scale takes it all.
    assert!((Relocation::Line.shared(0.1, 51, 0.005).1 - 0.4276).abs() < 5e-5);
}

#[test]
fn the_integral_is_the_double_sum() {
    let mut worst = 0.0_f64;
    for o in [
        0.0051_f32, 0.01, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 0.999, 0.99999,
    ] {
        for n in 1..=51 {
            let (shared, factor) = by_double_sum(f64::from(o), n, 0.005);
            let found = Relocation::Line.shared(o, n, 0.005);
            let error = (f64::from(found.1) - factor).abs();
            assert!((f64::from(found.0) - shared).abs() < 2e-6, "{o}, {n}");
            assert!(error < 1e-5, "{o}, {n}: {} and {factor}", found.1);
            worst = worst.max(error);
        }
    }
    eprintln!("factor: {worst:.1e}");
}

/// Sums over the image of what `n` copies hide together, and of its square, by quadrature, in units of 2 pi and the scale squared.
fn sums_in_image(opacity: f64, n: u32, factor: f64) -> [f64; 2] {
    const STEP: f64 = 1e-3;
    let mut sums = [0.0; 2];
    for ring in 0..8000 {
        let r = (f64::from(ring) + 0.5) * STEP;
        let one = opacity * (-0.5 * (r / factor).powi(2)).exp();
        let all = 1.0 - (1.0 - one).powf(f64::from(n));
        sums[0] += all * r * STEP;
        sums[1] += all * all * r * STEP;
    }
    sums
}

#[test]
fn copies_by_the_image_keep_what_it_sums_up_to() {
    for o in [0.0051_f32, 0.02, 0.1, 0.5, 0.9, 0.99, 0.999_999] {
        let before = sums_in_image(f64::from(o), 1, 1.0);
        for n in [1, 2, 3, 10, 51] {
            let (shared, factor) = Relocation::Image.shared(o, n, 0.0);
            let after = sums_in_image(f64::from(shared), n, f64::from(factor));
            for (before, after) in before.iter().zip(after) {
                assert!(
                    (after / before - 1.0).abs() < 5e-4,
                    "{o}, {n}: {after} and {before}"
                );
            }
            let line = Relocation::Line.shared(o, n, 0.0);
            assert!(
                shared <= line.0 * 1.000_1,
                "{o}, {n}: {shared} and {}",
                line.0
            );
        }
    }
    // Held at the least opacity, the scale takes it all, and keeps the sum.
    let (shared, factor) = Relocation::Image.shared(0.1, 51, 0.005);
    let [sum, _] = sums_in_image(f64::from(shared), 51, f64::from(factor));
    assert_eq!(shared, 0.005);
    assert!((sum / 0.1 - 1.0).abs() < 1e-4, "{sum}");
}

#[test]
fn one_share_is_the_splat_itself_and_extremes_stay_finite() {
    for copies in [Relocation::Line, Relocation::Image] {
        let (o, factor) = copies.shared(0.3, 1, 0.005);
        assert!((o - 0.3).abs() < 1e-6 && (factor - 1.0).abs() < 1e-5);
        for o in [0.0, 1e-30, 0.005, 0.999_999_9, 1.0] {
            for n in [0, 1, 2, 51, u32::MAX] {
                let (shared, factor) = copies.shared(o, n, 0.005);
                assert!((0.005..=mcmc::MAX_OPACITY).contains(&shared));
                let fits = factor.is_finite() && factor <= 1.0001;
                assert!(fits, "{copies:?}, {o}, {n}: {factor}");
            }
        }
    }
}

#[test]
fn hashed_numbers_are_normal_and_do_not_follow_their_neighbours() {
    const N: u32 = 100_000;
    let (mut mean, mut square, mut fourth) = ([0.0; 3], [0.0; 3], 0.0);
    let (mut across, mut along) = (0.0, 0.0);
    let mut before = [0.0; 3];
    for ix in 0..N {
        let eta = mcmc::normal3([3, 1000, ix]).map(f64::from);
        assert!(eta.iter().all(|x| x.is_finite()));
        for k in 0..3 {
            mean[k] += eta[k] / f64::from(N);
            square[k] += eta[k] * eta[k] / f64::from(N);
        }
        fourth += eta[0].powi(4) / f64::from(N);
        across += (eta[0] * eta[1] + eta[1] * eta[2] + eta[2] * eta[0]) / f64::from(N);
        along += eta.iter().zip(before).map(|(a, b)| a * b).sum::<f64>() / f64::from(N);
        before = eta;
    }
    // Five standard errors: 1 / sqrt(N) of a mean, sqrt(2 / N) of a variance, sqrt(96 / N) of a fourth moment.
    let error = 5.0 / f64::from(N).sqrt();
    assert!(mean.iter().all(|m| m.abs() < error), "{mean:?}");
    assert!(
        square.iter().all(|s| (s - 1.0).abs() < 1.5 * error),
        "{square:?}"
    );
    assert!((fourth - 3.0).abs() < 10.0 * error, "{fourth}");
    assert!(across.abs() < 1.8 * error && along.abs() < 1.8 * error);
    assert_ne!(mcmc::normal3([3, 1000, 0]), mcmc::normal3([3, 1001, 0]));
    assert_ne!(mcmc::normal3([3, 1000, 0]), mcmc::normal3([4, 1000, 0]));
}

/// For whoever writes it again for a GPU.
#[test]
fn the_hash_gives_these_words() {
    for (words, expected) in [
        ([0, 0, 0], [0x9baf_d7c6, 0xa8e8_8a6b, 0x3f15_482c]),
        ([1, 2, 3], [0xfa9f_79a6, 0x48f2_f44c, 0x596f_5ab1]),
        ([u32::MAX; 3], [0xa5f4_8f40, 0xa453_3e83, 0x515b_8a62]),
    ] {
        assert_eq!(mcmc::hash(words), expected);
    }
}

#[test]
fn draws_follow_opacity_and_leave_out_who_has_no_weight() {
    let opacities = [0.0, 0.1, 0.0, 0.6, 0.3, 0.0];
    let bits = mcmc::weight_bits(opacities.len());
    let mut total = 0;
    let starts: Vec<u32> = opacities
        .iter()
        .map(|&o| {
            let start = total;
            total += mcmc::weight(o, bits);
            start
        })
        .collect();
    let mut counts = [0; 6];
    for k in 0..100_000 {
        counts[mcmc::draw(&starts, total, mcmc::hash([9, k, 0])[0])] += 1;
    }
    for (count, o) in counts.into_iter().zip(opacities) {
        assert!(
            (f64::from(count) / 1e5 - f64::from(o)).abs() < 0.01,
            "{counts:?}"
        );
    }
    assert_eq!(mcmc::draw(&starts, total, 0), 1);
    assert_eq!(mcmc::draw(&starts, total, u32::MAX), 4);
}

#[test]
fn weights_of_any_number_of_splats_fit_32_bits() {
    for n in [
        0_u64,
        1,
        2,
        255,
        256,
        257,
        1_000_000,
        1 << 24,
        1 << 31,
        u64::from(u32::MAX),
    ] {
        let bits = mcmc::weight_bits(n as usize);
        let most = n * u64::from(mcmc::weight(1.0, bits));
        assert!(most <= u64::from(u32::MAX), "{n}: {most}");
    }
    assert_eq!(mcmc::weight_bits(1_000_000), 12);
}

#[test]
fn growth_never_exceeds_the_cap_and_never_drops_a_splat() {
    for (n, growth, max, expected) in [
        (100, 1.05, 1000, 105),
        (100, 1.05, 103, 103),
        (100, 1.05, 50, 100),
        (100, 1.0, 1000, 100),
        (100, 0.5, 1000, 100),
        (100, f32::NAN, 1000, 100),
        (100, f32::INFINITY, 1000, 1000),
        (19, 1.05, 1000, 19),
        (0, 2.0, 1000, 0),
    ] {
        assert_eq!(
            mcmc::grown(n, growth, max),
            expected,
            "{n}, {growth}, {max}"
        );
    }
}

#[test]
fn the_noise_is_the_covariance_times_the_draw_and_fades_with_opacity() {
    let half = 0.5_f32.sqrt();
    let log_scale = [0.2_f32.ln(), 0.1_f32.ln(), 0.05_f32.ln()];
    // A quarter turn about z: the own x axis is the map's y.
    let offset = mcmc::add_noise(log_scale, [half, 0.0, 0.0, half], 0.005, [1.0, 2.0, 3.0]);
    for (found, expected) in offset.into_iter().zip([0.01, 0.08, 0.0075]) {
        assert!((found - 0.5 * expected).abs() < 1e-6, "{offset:?}");
    }
    let faint = mcmc::add_noise(log_scale, [1.0, 0.0, 0.0, 0.0], 0.02, [1.0; 3])[0];
    assert!((faint / 0.04 - 0.182_4).abs() < 1e-3, "{faint}");
    let solid = mcmc::add_noise(
        log_scale,
        [1.0, 0.0, 0.0, 0.0],
        mcmc::MAX_SHAKEN_OPACITY,
        [1.0; 3],
    );
    assert!(solid[0] / 0.04 < 4e-9);
}
