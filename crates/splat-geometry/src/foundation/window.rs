//! How many frames a network sees at once, and which.

use std::ops::Range;
use std::path::Path;

use crate::foundation::sidecar::{Attention, Family, Precision, Sidecar};

/// Share of the free memory that a window may take: the map grows meanwhile.
const MEMORY_SHARE: f64 = 0.6;
/// VGGT keeps 0.195 GB a frame in half precision, besides attention, at 1041 tokens a frame (its README, batch of 200).
/// Narrower networks have fewer heads and keep as much less; DA3-SMALL was measured to.
const BYTES_PER_TOKEN: f64 = 0.195e9 / 1041.0;
/// Camera and register tokens of a frame, beside those of its patches.
const EXTRA_TOKENS: f64 = 5.0;
/// Heads of ViT-L, which both VGGT and the large DA3 are made of.
const USUAL_HEADS: u32 = 16;
const MIB: f64 = (1 << 20) as f64;

/// Bytes that a window of `n` frames takes beside the weights: what grows with the frames, and one layer that looks
/// from every token at every token, scores and their softmax, where no fused operator spares them.
pub fn bytes_of(sidecar: &Sidecar, n: usize) -> f64 {
    let pixels = f64::from(sidecar.width) * f64::from(sidecar.height);
    let tokens = pixels / f64::from(sidecar.patch).powi(2) + EXTRA_TOKENS;
    let n = n as f64;
    // Image, depth, confidence, and what is made of them.
    let in_and_out = 64.0 * n * pixels;
    if sidecar.family == Family::Mock {
        return in_and_out;
    }
    let number = match sidecar.precision {
        Precision::F32 => 4.0,
        Precision::F16 => 2.0,
    };
    let heads = match sidecar.heads {
        0 => USUAL_HEADS,
        heads => heads,
    };
    let attention = match sidecar.attention {
        Attention::Plain => 2.0 * number * f64::from(heads) * (n * tokens).powi(2),
        Attention::Fused => 0.0,
    };
    let width = f64::from(heads) / f64::from(USUAL_HEADS);
    in_and_out + n * tokens * BYTES_PER_TOKEN * width * number / 2.0 + attention
}

/// Frames of one window: what is wished for, else what fits; within the limits of the network, and at least two,
/// since one frame alone has no place.
pub fn size(sidecar: &Sidecar, wished: usize, free_bytes: Option<f64>) -> usize {
    let (least, most) = (sidecar.s_min.max(2), sidecar.s_max);
    if wished > 0 {
        return wished.clamp(least, most);
    }
    let budget = free_bytes.map_or(f64::INFINITY, |free| MEMORY_SHARE * free);
    let fits = |n: &usize| bytes_of(sidecar, *n) <= budget;
    let found = (least..=most).rev().find(fits);
    if found.is_none() {
        tracing::warn!(
            "a window of {least} frames may take {:.0} MiB, {:.0} MiB are free for it",
            bytes_of(sidecar, least) / MIB,
            budget / MIB
        );
    }
    found.unwrap_or(least)
}

/// The next window over `n` frames of which the first `done` have been in one.
pub fn next(done: usize, n: usize, size: usize, overlap: usize) -> Option<Range<usize>> {
    if done >= n {
        return None;
    }
    let shared = overlap.min(size.saturating_sub(1)).min(done);
    let end = (done - shared + size).min(n);
    // The last window reaches back: as many frames as it can take see each other.
    Some(end.saturating_sub(size)..end)
}

/// Bytes of the network's files, weights beside it included.
pub fn weight_bytes(model: &Path) -> u64 {
    let size = |path: &Path| path.metadata().map_or(0, |m| m.len());
    let mut beside = model.as_os_str().to_owned();
    beside.push("_data");
    size(model) + size(Path::new(&beside))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::foundation::sidecar::tests::sidecar;

    #[test]
    fn windows_cover_all_frames_and_share_some() {
        for n in 1..30 {
            for size in 2..9 {
                for overlap in 1..4 {
                    let mut done = 0;
                    while let Some(range) = next(done, n, size, overlap) {
                        assert!(range.end > done && range.len() <= size, "{range:?}");
                        assert_eq!(range.len(), size.min(n));
                        assert!(done == 0 || range.start < done, "nothing is shared");
                        assert!(done == 0 || done - range.start >= overlap.min(size - 1));
                        done = range.end;
                    }
                    assert_eq!(done, n);
                }
            }
        }
    }

    #[test]
    fn a_window_is_what_fits_into_memory() {
        let vggt = Sidecar {
            family: Family::Vggt,
            s_max: 16,
            ..sidecar(518, 392)
        };
        // 16 heads, 8 frames of 1041 tokens, f32: 4.4 GB for one matrix of scores.
        let n = 8.0 * 1041.0;
        assert!(bytes_of(&vggt, 8) > 2.0 * 16.0 * n * n * 4.0);
        assert_eq!(size(&vggt, 0, None), 16);
        let at = |gib: f64| size(&vggt, 0, Some(gib * 1024.0 * MIB));
        assert_eq!((at(0.0), at(200.0)), (2, 16));
        assert!((4..16).contains(&at(24.0)), "{}", at(24.0));
        let fused = Sidecar {
            attention: Attention::Fused,
            ..vggt.clone()
        };
        assert_eq!(size(&fused, 0, Some(24.0 * 1024.0 * MIB)), 16);
        assert_eq!((size(&vggt, 5, Some(0.0)), size(&vggt, 99, None)), (5, 16));
        let fixed = Sidecar {
            s_min: 4,
            s_max: 4,
            ..vggt
        };
        assert_eq!(size(&fixed, 2, None), 4);
    }
}
