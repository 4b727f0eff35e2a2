//! How many descriptors are compared at once.

/// Columns that are compared with a row at once, as two registers of AVX2, and rows at once: what all its registers hold.
pub(crate) const WIDE: usize = 16;
pub(crate) const HALVES: usize = 2;
pub(crate) const LANES: usize = HALVES * WIDE;
pub(crate) const ROWS: usize = 4;
pub(crate) type Lanes = [[u16; WIDE]; HALVES];
pub(crate) const NO_LANES: Lanes = [[0; WIDE]; HALVES];
