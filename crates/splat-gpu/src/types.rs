//! Host side of the structs in `shaders/lib/`: same names, order and padding; `tests/it/shader_layouts.rs` compares them.

use bytemuck::{Pod, Zeroable};

/// `SortPass` of `shaders/lib/sorting.wgsl`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct SortPass {
    pub shift: u32,
    pub padding_0: u32,
    pub padding_1: u32,
    pub padding_2: u32,
}

/// Numbers of `shaders/lib/`; `tests/it/shader_layouts.rs` compares them too.
pub const SORT_BLOCK: u32 = 2048;
pub const SCAN_BLOCK: u32 = 2048;
