//! What the machine has: memory, processor, GPU.

pub mod memory;

pub mod probe;

pub mod priority;
