//! The page and its script, as `web/build` made them: gzip, with everything in it.

pub const PAGE: &[u8] = include_bytes!("../../../web/dist/index.html.gz");
pub const SCRIPT: &[u8] = include_bytes!("../../../web/dist/viewer.js.gz");
