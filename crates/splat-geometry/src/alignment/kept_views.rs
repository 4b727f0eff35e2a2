//! Keyframes that are remembered for loops and for corrections of a whole submap.

use std::collections::BTreeMap;

use crate::answer::View;

/// What is remembered of keyframes: with a grid of depths each, and the depth of each feature.
pub(crate) type KeptView = BTreeMap<u32, (View, Vec<Option<f64>>)>;
