//! The ROS 2 transport: bytes of posts go out as they are; services, parameters and the lifecycle are answered.
//!
//! Everything here speaks through `source::ros2::link`, which owns the node.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use r2r::{PublisherUntyped, QosProfile};

use crate::error::PublishError;
use crate::plan::{Plan, PlanSink};
use crate::ros2::error::LinkError;
use crate::ros2::lifecycle::Hands;
use crate::ros2::node::Link;
use crate::ros2::parameter_store::ParameterStore;
use crate::ros2::services::{spawn_handler, trigger};
use crate::transport::{Delivery, Sample, Topic, Transport};
use splat_msgs::ros::Message;
use splat_msgs::ros::standard::Path;

/// Not part of every ROS 2: map_msgs comes with Nav2, nvblox_msgs with Isaac ROS.
const OPTIONAL_PACKAGES: [&str; 2] = ["map_msgs", "nvblox_msgs"];
/// Poses that may wait for a slow reader.
const NEWEST_DEPTH: usize = 5;

/// Publishers of all topics.
#[derive(Debug)]
pub struct Ros2Transport {
    link: Arc<Link>,
    /// `None`: this ROS 2 has no such type.
    publishers: Mutex<BTreeMap<&'static str, Option<PublisherUntyped>>>,
}

impl Ros2Transport {
    /// Declares the topics, so that others see them before the first message. One that is not among them is declared when
    /// it is first sent.
    pub fn open(
        link: Arc<Link>,
        topics: impl IntoIterator<Item = &'static Topic>,
    ) -> Result<Self, LinkError> {
        let transport = Self {
            link,
            publishers: Mutex::default(),
        };
        for topic in topics {
            let publisher = transport.declared(topic)?;
            transport.lock().insert(topic.name, publisher);
        }
        Ok(transport)
    }

    /// A type of a package that many do without is left out where it is missing.
    fn declared(&self, topic: &'static Topic) -> Result<Option<PublisherUntyped>, LinkError> {
        let package = topic.type_name.split('/').next().unwrap_or_default();
        match self.declare(topic) {
            Ok(publisher) => Ok(Some(publisher)),
            Err(e) if OPTIONAL_PACKAGES.contains(&package) => {
                tracing::info!(
                    "{} does not go out over ROS 2: this program was built without {package} ({e})",
                    topic.name
                );
                Ok(None)
            }
            Err(e) => Err(e),
        }
    }

    fn declare(&self, topic: &'static Topic) -> Result<PublisherUntyped, LinkError> {
        let name = ros_name(topic.name);
        let qos = qos(topic.delivery);
        self.link
            .ask(&format!("a publisher of {name:?}"), move |spun| {
                spun.node
                    .create_publisher_untyped(&name, topic.type_name, qos)
            })
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<&'static str, Option<PublisherUntyped>>> {
        // Publishers are only added: a panic leaves nothing half made.
        self.publishers
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

impl Transport for Ros2Transport {
    fn send(&self, post: &Sample) -> Result<(), PublishError> {
        let fail = |reason: String| PublishError::Ros2 {
            topic: post.topic.name,
            reason,
        };
        let known = self.lock().get(post.topic.name).cloned();
        let publisher = match known {
            Some(publisher) => publisher,
            None => {
                let publisher = self.declared(post.topic).map_err(|e| fail(e.to_string()))?;
                self.lock().insert(post.topic.name, publisher.clone());
                publisher
            }
        };
        match publisher {
            Some(publisher) => publisher
                .publish_raw(&post.payload)
                .map_err(|e| fail(e.to_string())),
            None => Ok(()),
        }
    }

    fn receive_plans(&self, topic: &str, sink: PlanSink) -> Result<(), PublishError> {
        let qos = QosProfile::default().keep_last(1);
        let subscribed =
            self.link
                .subscribe(&ros_name(topic), Path::TYPE_NAME, qos, move |payload| {
                    if let Some(plan) = Plan::read(&payload) {
                        sink(plan);
                    }
                    true
                });
        subscribed.map_err(|e| PublishError::Param {
            name: "plan_topic",
            found: topic.to_owned(),
            expected: format!("a topic that can be subscribed ({e})"),
        })
    }

    fn close(&self) -> Result<(), PublishError> {
        self.link.close();
        Ok(())
    }
}

/// Parameters, services and the lifecycle, answered as long as the link is up. Also makes a new map when time jumps.
pub fn serve(
    link: &Link,
    store: &Arc<dyn ParameterStore>,
    hands: &Hands,
    autostart: bool,
) -> Result<(), LinkError> {
    let jobs = spawn_handler().map_err(|e| LinkError::Refused {
        what: "a thread for services".to_owned(),
        reason: e.to_string(),
    })?;
    crate::ros2::parameters::offer(link, store)?;
    crate::ros2::services::offer(link, &hands.service_server, &jobs)?;
    crate::ros2::lifecycle::offer(link, hands.clone(), &jobs, autostart)?;
    let service_server = Arc::clone(&hands.service_server);
    link.when_time_jumps(move || {
        trigger(&service_server, "reset");
    });
    Ok(())
}

/// `pose` stands below the node, `/tf` alone.
fn ros_name(name: &str) -> String {
    if name.starts_with('/') {
        name.to_owned()
    } else {
        format!("~/{name}")
    }
}

/// All publishers are reliable, since readers of either kind receive those (REP-2003). None waits for a slow one: the
/// oldest message goes.
fn qos(delivery: Delivery) -> QosProfile {
    let reliable = QosProfile::default().reliable();
    match delivery {
        Delivery::Latched { depth } => reliable.keep_last(depth).transient_local(),
        Delivery::Reliable { depth } => reliable.keep_last(depth),
        Delivery::Newest => reliable.keep_last(NEWEST_DEPTH),
    }
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use crate::output::topics;
    use splat_msgs::services::SERVICES;
    use splat_msgs::type_hash::hash_of;
    use splat_msgs::type_hash::service_hash;

    /// What rosidl computed when the interface package was built.
    fn rosidl_hash(type_name: &str) -> String {
        let (package, rest) = type_name.split_once('/').unwrap();
        let prefixes = std::env::var("AMENT_PREFIX_PATH").expect("a sourced ROS 2");
        let file = |prefix: &str| {
            let share = Path::new(prefix).join("share").join(package);
            Some(share.join(format!("{rest}.json"))).filter(|file| file.is_file())
        };
        let file: PathBuf = prefixes.split(':').find_map(file).expect(type_name);
        let json: serde_json::Value =
            serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap();
        let hashes = json["type_hashes"].as_array().unwrap();
        let own = hashes.iter().find(|hash| hash["type_name"] == type_name);
        own.unwrap()["hash_string"].as_str().unwrap().to_owned()
    }

    #[test]
    fn type_hashes_of_all_topics_and_services_are_those_of_rosidl() {
        for topic in topics() {
            let own = hash_of(topic.type_name, topic.definition);
            assert_eq!(own, rosidl_hash(topic.type_name), "{}", topic.type_name);
        }
        for service in &SERVICES {
            let (question, answer) = (service.request_definition, service.response_definition);
            let own = service_hash(service.type_name, question, answer);
            assert_eq!(own, rosidl_hash(service.type_name), "{}", service.type_name);
        }
    }
}
