//! New splats, and which of them are guesses.

use splat_types::splats::splats::Splats;

/// Splats that are to be added.
#[derive(Debug, Clone, Default)]
pub struct Seeds {
    pub splats: Splats,
    /// Of each: it lies at a depth that no view has verified.
    pub is_guess: Vec<bool>,
}

impl Seeds {
    /// Keeps the first `n`.
    pub(crate) fn truncate(&mut self, n: usize) {
        self.splats.truncate(n);
        self.is_guess.truncate(n);
    }
}

/// What verified depth says of a guess.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Guess {
    /// Nothing.
    Open,
    /// It lies on the surface.
    Confirmed,
    /// The surface is behind it, or something better is known of its place.
    Replaced,
}
