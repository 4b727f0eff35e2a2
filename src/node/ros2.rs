//! Whether the process is a ROS 2 node, and what ties that node to the stages.

use crate::config::Settings;
use crate::config::ros2::Ros2Face as Wish;

#[cfg(feature = "ros2")]
pub use joined::Node;
#[cfg(not(feature = "ros2"))]
pub use left_out::Node;

/// The node, where the parameters, the source or arguments behind `--ros-args` ask for one. Parameters that came by ROS 2
/// are in `settings` then.
pub fn join(settings: &mut Settings, input: &str) -> anyhow::Result<Option<Node>> {
    let has_arguments = || !crate::source::ros2::names::ros_arguments().is_empty();
    match settings.params()?.ros2.enabled {
        Wish::On => Node::open(settings).map(Some),
        Wish::Auto if cfg!(feature = "ros2") && (input.starts_with("ros2:") || has_arguments()) => {
            Node::open(settings).map(Some)
        }
        Wish::Auto | Wish::Off => Ok(None),
    }
}

#[cfg(feature = "ros2")]
mod joined {
    use std::sync::Arc;

    use crate::config::Settings;
    use crate::node::Stop;
    use crate::publish::face::Face;
    use crate::publish::offered::SERVICES;
    use crate::publish::outbox::{Outbox, TOPICS};
    use crate::publish::ros2::lifecycle::Hands;
    use crate::publish::ros2::{self, Ros2Face};
    use crate::source::ros2::link::{Link, NODE_NAME};

    #[derive(Debug)]
    pub struct Node {
        link: Arc<Link>,
    }

    impl Node {
        pub(super) fn open(settings: &mut Settings) -> anyhow::Result<Self> {
            let link = Link::open(settings, NODE_NAME)?;
            Ok(Self { link })
        }

        pub fn face(&self) -> anyhow::Result<Box<dyn Face>> {
            Ok(Box::new(Ros2Face::open(Arc::clone(&self.link), TOPICS)?))
        }

        /// Answers services, parameters and the lifecycle until the face is closed.
        pub fn serve(&self, outbox: &Outbox, stop: &Stop, autostart: bool) -> anyhow::Result<()> {
            let (desk, stop) = (outbox.desk(), stop.clone());
            let hands = Hands {
                desk: Arc::new(move |name, question| {
                    let service = SERVICES.iter().find(|service| service.name == name);
                    let service = service.expect("the face offers services of the desk only");
                    desk.answer(service.kind, question)
                }),
                end: Arc::new(move || stop.ask()),
            };
            Ok(ros2::serve(&self.link, &hands, autostart)?)
        }
    }
}

#[cfg(not(feature = "ros2"))]
mod left_out {
    use anyhow::bail;

    use crate::config::Settings;
    use crate::node::Stop;
    use crate::publish::face::Face;
    use crate::publish::outbox::Outbox;

    /// There is none in this build.
    #[derive(Debug)]
    pub enum Node {}

    impl Node {
        pub(super) fn open(_settings: &mut Settings) -> anyhow::Result<Self> {
            bail!("ros2.enabled is on, but this build has no ROS 2; docs/ROS2.md says how to build")
        }

        pub fn face(&self) -> anyhow::Result<Box<dyn Face>> {
            match *self {}
        }

        pub fn serve(
            &self,
            _outbox: &Outbox,
            _stop: &Stop,
            _autostart: bool,
        ) -> anyhow::Result<()> {
            match *self {}
        }
    }
}
