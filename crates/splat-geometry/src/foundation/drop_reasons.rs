//! What was dropped of a model's answers, counted by reason, and one sentence that says so.

use std::collections::BTreeMap;

use crate::foundation::decode::Fault;
use crate::foundation::preprocess::Fit;

#[derive(Debug, Default)]
pub(crate) struct DropReasons {
    n_windows: usize,
    n_frames: usize,
    frames: BTreeMap<Fault, usize>,
    windows: BTreeMap<&'static str, usize>,
    n_links: usize,
    last_link: String,
    has_warned: bool,
}

impl DropReasons {
    /// A window of so many frames was looked at.
    pub(crate) fn count(&mut self, n_frames: usize) {
        self.n_windows += 1;
        self.n_frames += n_frames;
    }

    pub(crate) fn lose_frame(&mut self, fault: Fault) {
        *self.frames.entry(fault).or_default() += 1;
    }

    pub(crate) fn lose_window(&mut self, reason: &'static str) {
        *self.windows.entry(reason).or_default() += 1;
    }

    pub(crate) fn lose_link(&mut self, reason: String) {
        tracing::warn!("a window starts a map of its own, it could not be joined: {reason}");
        self.n_links += 1;
        self.last_link = reason;
    }

    /// Once: bars take room from the image.
    pub(crate) fn warn_of_bars(&mut self, fit: &Fit) {
        if !std::mem::replace(&mut self.has_warned, true) {
            let ([width, height], [w, h]) = (fit.image_px, fit.model_px);
            tracing::warn!(
                "images of {width}x{height} do not fill the model's {w}x{h}; a model exported for their aspect sees more"
            );
        }
    }

    /// `None` where nothing was lost.
    pub(crate) fn note(&self) -> Option<String> {
        let mut parts = Vec::new();
        for (reason, n) in &self.windows {
            parts.push(format!(
                "{n} of {} windows dropped: {reason}",
                self.n_windows
            ));
        }
        for (fault, n) in &self.frames {
            parts.push(format!(
                "{n} of {} frames dropped for {fault}",
                self.n_frames
            ));
        }
        if self.n_links > 0 {
            let (n, last) = (self.n_links, &self.last_link);
            parts.push(format!(
                "{n} windows could not be joined to those before: {last}"
            ));
        }
        (!parts.is_empty()).then(|| format!("the model's answers: {}", parts.join("; ")))
    }
}
