//! Every kind against a plain comparison of all with all.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg32;

use crate::matching::*;

/// Sets of different sizes, of which some members of the second are noisy members of the first.
fn sift_sets(n: usize, m: usize, seed: u64) -> (Vec<[u8; 128]>, Vec<[u8; 128]>) {
    let mut rng = Pcg32::seed_from_u64(seed);
    let a: Vec<[u8; 128]> = (0..n)
        .map(|_| [(); 128].map(|()| rng.random_range(0..32)))
        .collect();
    let b = (0..m).map(|j| match a.get(j * 3 % n) {
        Some(d) if j % 2 == 0 => d.map(|v| v + rng.random_range(0..6)),
        _ => [(); 128].map(|()| rng.random_range(0..32)),
    });
    let b = b.collect();
    (a, b)
}

fn orb_sets(n: usize, m: usize, seed: u64) -> (Vec<[u64; 4]>, Vec<[u64; 4]>) {
    let mut rng = Pcg32::seed_from_u64(seed);
    let a: Vec<[u64; 4]> = (0..n).map(|_| rng.random()).collect();
    let b = (0..m).map(|j| {
        let mut d = if j % 2 == 0 {
            a[j * 3 % n]
        } else {
            rng.random()
        };
        (0..j % 80).for_each(|_| d[rng.random_range(0..4)] ^= 1 << rng.random_range(0..64));
        d
    });
    let b = b.collect();
    (a, b)
}

fn xfeat_sets(n: usize, m: usize, seed: u64) -> (Vec<[i16; 64]>, Vec<[i16; 64]>) {
    let mut rng = Pcg32::seed_from_u64(seed);
    let mut unit = move |near: Option<&[i16; 64]>, noise: i16| {
        let raw = [(); 64].map(|()| rng.random_range(-noise..=noise));
        let raw: [f32; 64] =
            std::array::from_fn(|i| f32::from(raw[i]) + near.map_or(0.0, |d| f32::from(d[i])));
        let length = raw.iter().map(|v| v * v).sum::<f32>().sqrt();
        raw.map(|v| (XFEAT_LENGTH * v / length).round() as i16)
    };
    let a: Vec<[i16; 64]> = (0..n).map(|_| unit(None, 100)).collect();
    let b = (0..m).map(|j| match j % 2 {
        0 => unit(Some(&a[j * 3 % n]), (j % 40) as i16),
        _ => unit(None, 100),
    });
    let b = b.collect();
    (a, b)
}

/// Index, likeness and runner-up of the candidate that a plain loop finds; the first of equals.
fn plain(n: usize, likeness: impl Fn(usize) -> i64) -> (u32, i64, i64) {
    let (mut ix, mut best, mut second) = (u32::MAX, i64::MIN, i64::MIN);
    for j in 0..n {
        let here = likeness(j);
        if here > best {
            (ix, best, second) = (j as u32, here, best);
        } else {
            second = second.max(here);
        }
    }
    (ix, best, second)
}

fn check<D>(
    (a, b): &(Vec<D>, Vec<D>),
    kind: fn(Vec<D>) -> Descriptors,
    likeness: impl Fn(&D, &D) -> i64,
    is_clear: impl Fn(i64, i64) -> bool,
) where
    D: Clone,
{
    let mut expected = Vec::new();
    for (i, d) in a.iter().enumerate() {
        let (j, best, second) = plain(b.len(), |j| likeness(d, &b[j]));
        if j == u32::MAX || !is_clear(best, second) {
            continue;
        }
        if plain(a.len(), |k| likeness(&a[k], &b[j as usize])).0 == i as u32 {
            expected.push((i as u32, j));
        }
    }
    let of = |all: &[D]| PreparedDescriptors::new(&kind(all.to_vec()));
    assert_eq!(
        matches(&of(a), &of(b)),
        expected,
        "{} and {}",
        a.len(),
        b.len()
    );
}

/// Sizes that fill groups and blocks, and that do not.
const SIZES: [(usize, usize); 6] = [(1, 1), (3, 31), (64, 32), (70, 97), (130, 64), (5, 200)];

#[test]
fn orb_matches_are_those_of_a_plain_loop() {
    let differing = |a: &[u64; 4], b: &[u64; 4]| -> i64 {
        let all = a
            .iter()
            .zip(b)
            .map(|(x, y)| i64::from((x ^ y).count_ones()));
        all.sum()
    };
    for (n, m) in SIZES {
        let sets = orb_sets(n, m, 1);
        let is_clear = |best: i64, second: i64| {
            best >= -64 && (second == i64::MIN || -best * 100 < -second * 80)
        };
        check(&sets, Descriptors::Orb, |a, b| -differing(a, b), is_clear);
    }
    let opposite = (vec![[0; 4]], vec![[u64::MAX; 4]]);
    check(
        &opposite,
        Descriptors::Orb,
        |a, b| -differing(a, b),
        |best, _| best >= -64,
    );
}

#[test]
fn sift_matches_are_those_of_a_plain_loop() {
    let dot = |a: &[u8; 128], b: &[u8; 128]| -> i64 {
        let all = a.iter().zip(b).map(|(x, y)| i64::from(*x) * i64::from(*y));
        all.sum()
    };
    for (n, m) in SIZES {
        let square = |dot: i64| (2 * (250 * 250 - dot.max(0))).max(0) as f64;
        let is_clear = |best: i64, second: i64| {
            square(best).sqrt() <= 0.645 * 250.0 && square(best) < 0.64 * square(second)
        };
        check(&sift_sets(n, m, 2), Descriptors::Sift, dot, is_clear);
    }
}

#[test]
fn xfeat_matches_are_those_of_a_plain_loop() {
    let dot = |a: &[i16; 64], b: &[i16; 64]| -> i64 {
        let all = a.iter().zip(b).map(|(x, y)| i64::from(*x) * i64::from(*y));
        all.sum()
    };
    for (n, m) in SIZES {
        let is_clear = |best: i64, _| best as f64 > 0.82 * 176.0 * 176.0;
        check(&xfeat_sets(n, m, 3), Descriptors::Xfeat, dot, is_clear);
    }
}

#[test]
fn a_point_with_a_lookalike_matches_nothing() {
    let (a, _) = orb_sets(5, 1, 4);
    let twice = Descriptors::Orb([a.clone(), a.clone()].concat());
    let of = |all: &Descriptors| PreparedDescriptors::new(all);
    let (one, all) = (Descriptors::Orb(vec![a[0]]), Descriptors::Orb(a));
    assert!(matches(&of(&all), &of(&twice)).is_empty());
    assert!(matches(&of(&all), &of(&Descriptors::Orb(Vec::new()))).is_empty());
    // With one candidate there is no second best to compare with: mutual and near is enough.
    assert_eq!(matches(&of(&one), &of(&one)), [(0, 0)]);
}

#[test]
fn kinds_never_match_each_other() {
    let mut rng = Pcg32::seed_from_u64(5);
    // As long as SIFT descriptors are: 64 times 31.
    let sift = (0..40).map(|_| {
        let mut d = [0; 128];
        d[..64].fill(31);
        (1..128).for_each(|k| d.swap(k, rng.random_range(0..=k)));
        d
    });
    let all = [
        Descriptors::Sift(sift.collect()),
        Descriptors::Orb(orb_sets(40, 1, 5).0),
        Descriptors::Xfeat(xfeat_sets(40, 1, 5).0),
    ];
    for (i, a) in all.iter().enumerate() {
        for (j, b) in all.iter().enumerate() {
            let found = matches(&PreparedDescriptors::new(a), &PreparedDescriptors::new(b)).len();
            assert_eq!(found, if i == j { 40 } else { 0 }, "{i} with {j}");
        }
    }
}

#[test]
fn products_of_bytes_without_avx2_are_dot_products() {
    let (a, b) = sift_sets(7, 45, 9);
    let (rows, columns) = (Bytes::new(&a), Bytes::new(&b));
    let found = bytes::products((&rows, 1), (&columns, 1));
    for (r, lanes) in found.iter().enumerate() {
        for (lane, product) in lanes.as_flattened().iter().enumerate() {
            let pair = a.get(ROWS + r).zip(b.get(LANES + lane));
            let dot = pair.map_or(0, |(a, b)| {
                let all = a.iter().zip(b).map(|(x, y)| u32::from(*x) * u32::from(*y));
                all.sum::<u32>()
            });
            assert_eq!(u32::from(*product), dot, "{r} {lane}");
        }
    }
}
