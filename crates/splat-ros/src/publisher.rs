//! Messages on their way out, over all transports alike: each is made once, whoever carries it.
//!
//! It knows no topic and nothing of what messages say; streams make them.

use std::sync::Arc;

use crate::error::PublishError;
use crate::latched::LatchedStore;
use crate::plan::PlanSink;
use crate::service_server::ServiceServer;
use crate::transport::{Delivery, Event, Sample, Transport};

/// The node's way out. It never changes once it is open, so threads share it as it is: a slow peer of the map holds up
/// no pose. The latched store alone has a lock, since late joiners read what other threads send; it is held for a copy.
pub struct Publisher {
    transports: Vec<Box<dyn Transport>>,
    latched: Arc<LatchedStore>,
    service_server: Arc<ServiceServer>,
}

impl std::fmt::Debug for Publisher {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Publisher({} transports)", self.transports.len())
    }
}

impl Publisher {
    pub fn new(
        transports: Vec<Box<dyn Transport>>,
        latched: Arc<LatchedStore>,
        service_server: Arc<ServiceServer>,
    ) -> Self {
        Self {
            transports,
            latched,
            service_server,
        }
    }

    /// Answers services; transports keep it.
    pub fn service_server(&self) -> Arc<ServiceServer> {
        Arc::clone(&self.service_server)
    }

    /// What late joiners get.
    pub fn latched(&self) -> &LatchedStore {
        &self.latched
    }

    /// Where peers may connect, for example `tcp/127.0.0.1:40123`.
    pub fn endpoints(&self) -> Vec<String> {
        self.transports
            .iter()
            .flat_map(|transport| transport.endpoints())
            .collect()
    }

    /// Sends to all transports; the first fault is returned once all have had it.
    pub fn send(&self, post: &Sample) -> Result<(), PublishError> {
        // Transforms are asked for by viewers that come when no frame does.
        let is_asked_for = post.topic.name == "/tf";
        if is_asked_for || !matches!(post.topic.delivery, Delivery::Reliable { .. }) {
            self.latched.keep(post);
        }
        let sent = self.transports.iter().map(|transport| transport.send(post));
        sent.fold(Ok(()), Result::and)
    }

    /// Says to all transports what happens.
    pub fn observe(&self, event: &Event<'_>) {
        self.transports
            .iter()
            .for_each(|transport| transport.observe(event));
    }

    /// Paths that planners publish on a topic become events, by whatever transport they come.
    pub fn receive_plans(self: &Arc<Self>, topic: &str) -> Result<(), PublishError> {
        // Transports belong to the publisher: it must not belong to them.
        let publisher = Arc::downgrade(self);
        let sink: PlanSink = Arc::new(move |plan| {
            if let Some(publisher) = publisher.upgrade() {
                publisher.observe(&Event::Plan(&plan));
            }
        });
        let mut transports = self.transports.iter();
        transports.try_for_each(|transport| transport.receive_plans(topic, Arc::clone(&sink)))
    }

    /// Ends all transports.
    pub fn close(&self) -> Result<(), PublishError> {
        let closed = self.transports.iter().map(|transport| transport.close());
        closed.fold(Ok(()), Result::and)
    }
}
