//! Whether the process is a ROS 2 node, and what ties that node to the stages.

#[cfg(feature = "ros2")]
pub use joined::*;
#[cfg(not(feature = "ros2"))]
pub use left_out::*;

#[cfg(feature = "ros2")]
mod joined {
    use std::sync::Arc;

    use crate::config::Settings;
    use crate::config::ros2::Ros2Face;
    use crate::source::ros2::link::{Link, NODE_NAME};
    use crate::source::ros2::names::split_arguments;

    /// The node, where the parameters, the source or arguments behind `--ros-args` ask for one. Parameters that came by
    /// ROS 2 are in `settings` then.
    pub fn join(settings: &mut Settings, input: &str) -> anyhow::Result<Option<Arc<Link>>> {
        let is_wanted = match settings.params()?.ros2.enabled {
            Ros2Face::On => true,
            Ros2Face::Off => false,
            Ros2Face::Auto => {
                input.starts_with("ros2:") || !split_arguments(std::env::args_os()).1.is_empty()
            }
        };
        Ok(if is_wanted {
            Some(Link::open(settings, NODE_NAME)?)
        } else {
            None
        })
    }
}

#[cfg(not(feature = "ros2"))]
mod left_out {
    use anyhow::bail;

    use crate::config::Settings;
    use crate::config::ros2::Ros2Face;

    pub fn join(settings: &mut Settings, _input: &str) -> anyhow::Result<Option<()>> {
        if settings.params()?.ros2.enabled == Ros2Face::On {
            bail!(
                "ros2.enabled is on, but this build has no ROS 2; docs/ROS2.md says how to build"
            );
        }
        Ok(None)
    }
}
