//! Densification by a threshold on gradients, in numbers: which splats are cloned, split or removed, and what the new ones are.
//!
//! Pure functions on copies of the splats; whoever calls them moves the rows of an engine. 3D Gaussian Splatting (Kerbl et al.
//! 2023, section 5.2); docs/GRADIENTS.md, densification.

use crate::mcmc::normal3;
use splat_types::splats::splats::Splats;

/// Splats that take the place of a split one, and what their scales are divided by: 0.8 times their number, as the authors have it.
const N_PARTS: u32 = 2;
const PART_DIVISOR: f32 = 1.6;

/// What steps with `accumulate_screen_gradients` have seen of each splat since it was last taken.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScreenGradients {
    /// Sum over those steps of the norm of d loss / d projected mean, in normalised device coordinates: the gradient per pixel
    /// times half of the image's width and height.
    pub sums: Vec<f32>,
    /// Steps whose view saw the splat.
    pub counts: Vec<u32>,
}

/// Which splats change. Lengths are in world units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DensifySettings {
    /// Mean norm of the screen gradient from which on a splat is cloned or split; 2e-4 in 3DGS.
    pub gradient: f32,
    /// A splat whose largest scale is at most this is cloned, a larger one split; 0.01 of the scene's extent in 3DGS.
    pub dense_scale: f32,
    /// A splat whose largest scale is above it is removed; infinite: none.
    pub max_scale: f32,
    /// A splat of less opacity is removed; 0.005 in 3DGS.
    pub min_opacity: f32,
    /// Splats that there may be in all: beyond, those with the largest gradients go first.
    pub max_splats: usize,
    /// Of the places of the parts; different in every pass.
    pub seed: u32,
}

/// What becomes of a splat.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// It stays as it is.
    Kept,
    /// It stays, and a copy of it comes.
    Cloned,
    /// Two smaller ones, drawn from it, take its place.
    Split,
    /// It goes.
    Removed,
}

/// What a pass makes of the splats: first rows go, then others come behind the last.
#[derive(Debug, Clone, PartialEq)]
pub struct Densified {
    /// One flag per splat that was there.
    pub keep: Vec<bool>,
    /// The new ones.
    pub added: Splats,
    /// Index of the splat that each new one stems from, among those that were there.
    pub parents: Vec<usize>,
}

impl ScreenGradients {
    /// Mean over the steps that saw the splat; 0 where none did.
    pub fn mean(&self, splat_ix: usize) -> f32 {
        let count = self.counts.get(splat_ix).copied().unwrap_or(0);
        let sum = self.sums.get(splat_ix).copied().unwrap_or(0.0);
        if count == 0 { 0.0 } else { sum / count as f32 }
    }
}

/// What becomes of each splat.
pub fn fates(
    splats: &Splats,
    gradients: &ScreenGradients,
    settings: &DensifySettings,
) -> Vec<Fate> {
    let mut fates: Vec<Fate> = (0..splats.len())
        .map(|ix| fate(splats, ix, gradients.mean(ix), settings))
        .collect();
    let is_more = |fate: &Fate| matches!(fate, Fate::Cloned | Fate::Split);
    let n_left = fates.iter().filter(|fate| **fate != Fate::Removed).count();
    let room = settings.max_splats.saturating_sub(n_left);
    let mut wanted: Vec<usize> = (0..fates.len()).filter(|ix| is_more(&fates[*ix])).collect();
    if wanted.len() > room {
        let by_gradient = |a: &usize, b: &usize| {
            let gradient = |ix: &usize| gradients.mean(*ix);
            gradient(b).total_cmp(&gradient(a)).then(a.cmp(b))
        };
        wanted.sort_by(by_gradient);
        for ix in &wanted[room..] {
            let is_small = largest_scale(splats, *ix) <= settings.max_scale;
            fates[*ix] = if is_small { Fate::Kept } else { Fate::Removed };
        }
    }
    fates
}

/// The rows that go and come where these are the splats' fates.
pub fn densify(splats: &Splats, fates: &[Fate], seed: u32) -> Densified {
    let mut parents = Vec::new();
    // Number of the part; `None`: a clone.
    let mut parts = Vec::new();
    for (ix, fate) in fates.iter().enumerate() {
        match fate {
            Fate::Kept | Fate::Removed => {}
            Fate::Cloned => {
                parents.push(ix);
                parts.push(None);
            }
            Fate::Split => {
                parents.extend((0..N_PARTS).map(|_| ix));
                parts.extend((0..N_PARTS).map(Some));
            }
        }
    }
    let mut added = splats.picked(&parents);
    for (row, (parent, part)) in parents.iter().zip(parts).enumerate() {
        if let Some(number) = part {
            make_part(&mut added, row, [seed, *parent as u32, number]);
        }
    }
    let stays = |fate: &Fate| matches!(fate, Fate::Kept | Fate::Cloned);
    Densified {
        keep: fates.iter().map(stays).collect(),
        added,
        parents,
    }
}

/// Opacity 0 to 1 -> before activation.
pub fn logit(opacity: f32) -> f32 {
    (opacity / (1.0 - opacity)).ln()
}

fn fate(splats: &Splats, ix: usize, gradient: f32, settings: &DensifySettings) -> Fate {
    let opacity = 1.0 / (1.0 + (-splats.opacity_logits[ix]).exp());
    if opacity < settings.min_opacity || !splats.is_finite(ix) {
        return Fate::Removed;
    }
    let scale = largest_scale(splats, ix);
    let is_wanted = gradient >= settings.gradient;
    if is_wanted && scale <= settings.dense_scale {
        return Fate::Cloned;
    }
    // Of a splat that is split, the parts must not be too large.
    let most = if is_wanted {
        PART_DIVISOR * settings.max_scale
    } else {
        settings.max_scale
    };
    match (scale > most, is_wanted) {
        (true, _) => Fate::Removed,
        (false, true) => Fate::Split,
        (false, false) => Fate::Kept,
    }
}

fn largest_scale(splats: &Splats, ix: usize) -> f32 {
    let log_scales = splats.log_scales[ix];
    log_scales.into_iter().fold(f32::MIN, f32::max).exp()
}

/// Makes a splat smaller and moves it to a place that is drawn from it as from a normal distribution.
fn make_part(splats: &mut Splats, ix: usize, words: [u32; 3]) {
    let eta = normal3(words);
    let scales = splats.log_scales[ix].map(f32::exp);
    let along: [f32; 3] = std::array::from_fn(|axis| scales[axis] * eta[axis]);
    let offset = turned(splats.quats[ix], along);
    for (mean, offset) in splats.means[ix].iter_mut().zip(offset) {
        *mean += offset;
    }
    for log_scale in &mut splats.log_scales[ix] {
        *log_scale -= PART_DIVISOR.ln();
    }
}

/// A vector turned by a quaternion w, x, y, z of any length; one without direction is the identity.
fn turned(quat: [f32; 4], v: [f32; 3]) -> [f32; 3] {
    let length = quat.iter().map(|q| q * q).sum::<f32>().sqrt();
    if length == 0.0 {
        return v;
    }
    let [w, x, y, z] = quat.map(|q| q / length);
    let rows = [
        [
            1.0 - 2.0 * (y * y + z * z),
            2.0 * (x * y - w * z),
            2.0 * (x * z + w * y),
        ],
        [
            2.0 * (x * y + w * z),
            1.0 - 2.0 * (x * x + z * z),
            2.0 * (y * z - w * x),
        ],
        [
            2.0 * (x * z - w * y),
            2.0 * (y * z + w * x),
            1.0 - 2.0 * (x * x + y * y),
        ],
    ];
    rows.map(|row| row.iter().zip(v).map(|(a, b)| a * b).sum())
}

#[cfg(test)]
mod tests;
