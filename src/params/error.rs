//! Faults of parameters that a user gave.

use std::path::PathBuf;

#[derive(Debug, thiserror::Error)]
pub enum ParamsError {
    #[error("cannot read the parameter file: {reason}: {}", path.display())]
    Read { reason: String, path: PathBuf },
    #[error("the parameter file is not ROS 2 parameter YAML (splat_mapper: ros__parameters: ...): {reason}: {}", path.display())]
    Form { reason: String, path: PathBuf },
    #[error("unknown parameter {key:?}{}; launch/params.yaml lists all", nearest.as_ref().map(|n| format!(", nearest is {n:?}")).unwrap_or_default())]
    UnknownKey {
        key: String,
        nearest: Option<String>,
    },
    #[error("parameter {key} = {found} is out of range, expected {expected}")]
    OutOfRange {
        key: String,
        found: String,
        expected: String,
    },
    #[error("{found:?} is no preset, expected {known}")]
    Preset { found: String, known: String },
    #[error("{found:?} is no setting, expected key=value, for example train.steps=500")]
    Setting { found: String },
    #[error(
        "parameters select.batch_overlap = {overlap} and select.batch_size = {size} do not fit: the overlap must be smaller"
    )]
    Overlap { overlap: usize, size: usize },
    #[error(
        "parameters densify.enabled and mcmc.enabled are both true, and both decide which splats come and go: set one of them to false"
    )]
    TwoGrowths,
    #[error(
        "parameter {key} is read at the start only: set it in a parameter file, by --set or behind --ros-args, and start anew"
    )]
    Fixed { key: String },
}
