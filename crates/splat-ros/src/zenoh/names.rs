//! How rmw_zenoh spells topics, services and those who have them, for one run.

use zenoh::Session;

use crate::error::PublishError;
use crate::params::PublishParams;
use crate::transport::{Delivery, Topic};
use splat_msgs::ros::Message;
use splat_msgs::services::Service;
use splat_msgs::type_hash::{dds_name, hash_of, service_hash};

pub(crate) struct Names {
    domain_id: u32,
    /// `a/b`: the node is the last part.
    namespace: String,
}

impl Names {
    pub(crate) fn new(params: &PublishParams) -> Result<Self, PublishError> {
        let namespace = params.namespace.trim_matches('/').to_owned();
        let is_name = |part: &str| {
            part.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
                && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        };
        if !namespace.split('/').all(is_name) {
            return Err(PublishError::Param {
                name: "namespace",
                found: params.namespace.clone(),
                expected: "letters, digits and underscores, parts joined by /".to_owned(),
            });
        }
        Ok(Self {
            domain_id: params.domain_id,
            namespace,
        })
    }

    /// Without a slash in front.
    fn full(&self, name: &str) -> String {
        match name.strip_prefix('/') {
            Some(alone) => alone.to_owned(),
            None => format!("{}/{name}", self.namespace),
        }
    }

    pub(crate) fn topic_key(&self, topic: &Topic) -> String {
        format!(
            "{}/{}/{}/{}",
            self.domain_id,
            self.full(topic.name),
            dds_name(topic.type_name),
            hash_of(topic.type_name, topic.definition)
        )
    }

    /// Of a topic that others publish, below our namespace unless it begins with `/`; whatever hash they have for the type.
    pub(crate) fn incoming_key<T: Message>(&self, topic: &str) -> String {
        self.incoming_key_of(topic, T::TYPE_NAME)
    }

    /// The same of a type by its name.
    pub(crate) fn incoming_key_of(&self, topic: &str, type_name: &str) -> String {
        format!(
            "{}/{}/{}/*",
            self.domain_id,
            self.full(topic),
            dds_name(type_name)
        )
    }

    pub(crate) fn service_key(&self, service: &Service) -> String {
        format!(
            "{}/{}/{}/{}",
            self.domain_id,
            self.full(service.name),
            dds_name(service.type_name),
            hash_of_service(service)
        )
    }

    /// The node is the last part of the namespace, the rest is the node's namespace; `%` stands for `/`.
    fn node(&self) -> String {
        match self.namespace.rsplit_once('/') {
            Some((parent, node)) => format!("%/%{}/{node}", parent.replace('/', "%")),
            None => format!("%/%/{}", self.namespace),
        }
    }

    pub(crate) fn node_token(&self, session: &Session) -> String {
        format!(
            "@ros2_lv/{}/{}/0/0/NN/{}",
            self.domain_id,
            session.zid(),
            self.node()
        )
    }

    /// Reliability, durability, history and depth; empty where they are the default: reliable, volatile, keep last.
    pub(crate) fn topic_token(&self, session: &Session, topic: &Topic, entity: usize) -> String {
        let qos = match topic.delivery {
            Delivery::Latched { depth } => format!(":1:,{depth}:,:,:,,"),
            Delivery::Reliable { depth } => format!("::,{depth}:,:,:,,"),
            Delivery::Newest => "2::,5:,:,:,,".to_owned(),
        };
        let (name, type_name) = (topic.name, topic.type_name);
        let hash = hash_of(type_name, topic.definition);
        self.token(session, entity, "MP", (name, type_name, &hash, &qos))
    }

    pub(crate) fn service_token(
        &self,
        session: &Session,
        service: &Service,
        entity: usize,
    ) -> String {
        let hash = hash_of_service(service);
        let (name, type_name) = (service.name, service.type_name);
        self.token(
            session,
            entity,
            "SS",
            (name, type_name, &hash, "::,10:,:,:,,"),
        )
    }

    fn token(
        &self,
        session: &Session,
        entity: usize,
        kind: &str,
        (name, type_name, hash, qos): (&str, &str, &str, &str),
    ) -> String {
        format!(
            "@ros2_lv/{}/{}/0/{entity}/{kind}/{}/%{}/{}/{hash}/{qos}",
            self.domain_id,
            session.zid(),
            self.node(),
            self.full(name).replace('/', "%"),
            dds_name(type_name),
        )
    }
}

fn hash_of_service(service: &Service) -> String {
    service_hash(
        service.type_name,
        service.request_definition,
        service.response_definition,
    )
}
