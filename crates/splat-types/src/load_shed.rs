//! What a live run left out, or put off, for lack of time.

/// What was left out, or waited, since poses were more urgent: counts since the start of a live run.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct LoadShed {
    /// Keyframes that had gathered, so that each got fewer features and fewer matches.
    pub hurried_keyframes: u64,
    /// Keyframes that were not compared with places seen long before.
    pub unsought_keyframes: u64,
    /// Seconds that depth waited for poses.
    pub depth_secs: f64,
    /// Seconds that steps of the optimiser waited for poses.
    pub steps_secs: f64,
}
