//! splat/cpu
