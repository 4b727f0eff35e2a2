//! Cameras of Linux, straight from the kernel.

mod answers;

mod raw;

#[expect(
    unsafe_code,
    reason = "the kernel's calls take pointers; safe functions come out"
)]
mod sys;

pub mod controls;

mod probe;

pub mod list;

pub mod camera;
