//! Parameters: files and `--set` -> checked structs.

pub mod error;

pub mod file;

pub mod engine_params;

#[expect(
    clippy::module_inception,
    reason = "the file holds the struct of all parameters"
)]
pub mod params;

pub mod schema;

pub mod aliases;

pub mod settings;

pub mod describe;

pub mod live;
