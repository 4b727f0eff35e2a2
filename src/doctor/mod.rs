//! What is missing on this machine, and the line that mends it.

pub mod model_check;

pub mod check;

mod cameras;

pub mod checks;
