//! Whether the process is a ROS 2 node, and what ties that node to the stages.

#[cfg(any(feature = "ros2", test))]
use std::sync::Arc;

#[cfg(any(feature = "ros2", test))]
use crate::params::error::ParamsError;
#[cfg(any(feature = "ros2", test))]
use crate::params::live::Live;
use crate::params::settings::Settings;
#[cfg(any(feature = "ros2", test))]
use splat_ros::ros2::parameter_store::Ros2Setup;
use splat_ros::ros2::params::Ros2Face as Wish;

#[cfg(feature = "ros2")]
pub use joined::Node;
#[cfg(not(feature = "ros2"))]
pub use left_out::Node;

/// The node, where the parameters, the source or arguments behind `--ros-args` ask for one. Parameters that came by ROS 2
/// are in `settings` then.
pub fn join(settings: &mut Settings, input: &str) -> anyhow::Result<Option<Node>> {
    let has_arguments = || !splat_ros::ros2::names::ros_arguments().is_empty();
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

    use crate::node::ros2::configured;
    use crate::node::stop::Stop;
    use crate::params::live::Live;
    use crate::params::settings::Settings;
    use splat_msgs::services::SERVICES;
    use splat_ros::output::topics;
    use splat_ros::publisher::Publisher;
    use splat_ros::ros2::lifecycle::Hands;
    use splat_ros::ros2::node::Link;
    use splat_ros::ros2::node::NODE_NAME;
    use splat_ros::ros2::parameter_store::ParameterStore;
    use splat_ros::ros2::transport;
    use splat_ros::ros2::transport::Ros2Transport;
    use splat_ros::transport::Transport;

    #[derive(Debug)]
    pub struct Node {
        link: Arc<Link>,
        live: Arc<Live>,
    }

    impl Node {
        pub(crate) fn open(settings: &mut Settings) -> anyhow::Result<Self> {
            let mut live = None;
            let link = Link::open(NODE_NAME, |overrides| {
                let (setup, own) = configured(settings, overrides).map_err(|e| e.to_string())?;
                live = Some(own);
                Ok(setup)
            })?;
            let live = live.expect("a link that is open was configured");
            Ok(Self { link, live })
        }

        pub fn transport(&self) -> anyhow::Result<Box<dyn Transport>> {
            Ok(Box::new(Ros2Transport::open(
                Arc::clone(&self.link),
                topics(),
            )?))
        }

        /// Answers services, parameters and the lifecycle until the transport is closed.
        pub fn serve(
            &self,
            publisher: &Publisher,
            stop: &Stop,
            autostart: bool,
        ) -> anyhow::Result<()> {
            let (service_server, stop) = (publisher.service_server(), stop.clone());
            let hands = Hands {
                service_server: Arc::new(move |name, question| {
                    let service = SERVICES.iter().find(|service| service.name == name);
                    let service =
                        service.expect("the transport offers services of the service server only");
                    service_server.answer(service.kind, question)
                }),
                end: Arc::new(move || stop.ask()),
            };
            let store: Arc<dyn ParameterStore> = Arc::<Live>::clone(&self.live);
            Ok(transport::serve(&self.link, &store, &hands, autostart)?)
        }
    }
}

/// Parameters from ROS 2 over those in `settings` -> what the node reads of them, and the store that its services change.
#[cfg(any(feature = "ros2", test))]
fn configured(
    settings: &mut Settings,
    overrides: Vec<(String, serde_json::Value)>,
) -> Result<(Ros2Setup, Arc<Live>), ParamsError> {
    for (key, value) in overrides {
        settings.set(&key, value)?;
    }
    settings.log_warnings();
    let params = settings.params()?;
    let live = Arc::new(Live::new(settings.clone())?);
    let setup = Ros2Setup {
        params: params.ros2,
        live: Arc::clone(&live.ros2),
        use_sim_time: params.use_sim_time,
        odom_frame: params.publish.odom_frame,
        base_frame: params.publish.base_frame,
    };
    Ok((setup, live))
}

#[cfg(not(feature = "ros2"))]
mod left_out {
    use anyhow::bail;

    use crate::node::stop::Stop;
    use crate::params::settings::Settings;
    use splat_ros::publisher::Publisher;
    use splat_ros::transport::Transport;

    /// There is none in this build.
    #[derive(Debug)]
    pub enum Node {}

    impl Node {
        pub(crate) fn open(_settings: &mut Settings) -> anyhow::Result<Self> {
            bail!("ros2.enabled is on, but this build has no ROS 2; docs/ROS2.md says how to build")
        }

        pub fn transport(&self) -> anyhow::Result<Box<dyn Transport>> {
            match *self {}
        }

        pub fn serve(
            &self,
            _publisher: &Publisher,
            _stop: &Stop,
            _autostart: bool,
        ) -> anyhow::Result<()> {
            match *self {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_ros::ros2::parameter_store::ParameterStore;

    #[test]
    fn parameters_of_ros_2_go_over_the_settings_and_reach_the_node() {
        let mut settings = Settings::shipped();
        let overrides = vec![
            ("use_sim_time".to_owned(), true.into()),
            ("ros2.silence_secs".to_owned(), 9.into()),
            ("publish.base_frame".to_owned(), "base".into()),
        ];
        let (setup, live) = configured(&mut settings, overrides).unwrap();
        assert!(setup.use_sim_time && settings.params().unwrap().use_sim_time);
        assert_eq!(setup.base_frame, "base");
        assert_eq!(setup.live.get().image_timeout, 9.0);
        let change = ("ros2.image_timeout".to_owned(), 4.5.into());
        live.set(&[change]).unwrap();
        assert_eq!(setup.live.get().image_timeout, 4.5);
    }

    #[test]
    fn a_parameter_of_ros_2_that_does_not_fit_is_refused() {
        let overrides = vec![("ros2.image_timeout".to_owned(), (-1).into())];
        let error = configured(&mut Settings::shipped(), overrides).unwrap_err();
        assert!(error.to_string().contains("out of range"), "{error}");
    }
}
