//! The page and its script, as `web/build` made them: gzip, with everything in it.

pub(crate) const PAGE: &[u8] = include_bytes!("../../../web/dist/index.html.gz");
pub(crate) const SCRIPT: &[u8] = include_bytes!("../../../web/dist/viewer.js.gz");
