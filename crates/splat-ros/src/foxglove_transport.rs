//! Outgoing messages -> a live server that Foxglove connects to ("Open connection", `ws://ADDRESS`): the same CDR bytes as over
//! zenoh, with their definitions. Nothing comes in.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use foxglove::websocket::{ChannelView, Client, ServerListener};
use foxglove::{Context, PartialMetadata, RawChannel, Schema, WebSocketServerHandle};

use crate::error::PublishError;
use crate::transport::{Delivery, Sample, Transport};

/// Messages that wait for one client; beyond them the oldest are dropped. Chunks of a map come some hundred at once.
const BACKLOG: usize = 1024;

/// A topic with what a client gets that comes late.
struct Channel {
    raw: Arc<RawChannel>,
    depth: usize,
    latched: VecDeque<Sample>,
}

/// By the name that Foxglove shows.
#[derive(Default)]
struct Channels(Mutex<BTreeMap<String, Channel>>);

impl Channels {
    fn locked(&self) -> MutexGuard<'_, BTreeMap<String, Channel>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The server; closed with the node.
pub(crate) struct FoxgloveTransport {
    namespace: String,
    context: Arc<Context>,
    channels: Arc<Channels>,
    server: Mutex<Option<WebSocketServerHandle>>,
    address: String,
}

impl std::fmt::Debug for FoxgloveTransport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "FoxgloveTransport({})", self.address)
    }
}

impl FoxgloveTransport {
    /// Serves on `address`, host:port; port 0 is any that is free.
    pub(crate) fn open(address: &str, namespace: &str) -> Result<Self, PublishError> {
        let (host, port) = address
            .rsplit_once(':')
            .and_then(|(host, port)| Some((host, port.parse().ok()?)))
            .ok_or_else(|| PublishError::Param {
                name: "foxglove",
                found: address.to_owned(),
                expected: "an address and a port, as in 127.0.0.1:8765".to_owned(),
            })?;
        let context = Context::new();
        let channels = Arc::<Channels>::default();
        let late = Late {
            channels: Arc::clone(&channels),
        };
        let server = context
            .websocket_server()
            .name(namespace)
            .bind(host, port)
            .message_backlog_size(BACKLOG)
            .listener(Arc::new(late))
            .start_blocking()
            .map_err(|e| PublishError::Foxglove {
                address: address.to_owned(),
                reason: e.to_string(),
            })?;
        let address = format!("ws://{host}:{}", server.port());
        tracing::info!("Foxglove may connect to {address}");
        Ok(Self {
            namespace: namespace.to_owned(),
            context,
            channels,
            server: Mutex::new(Some(server)),
            address,
        })
    }

    /// The topic's channel, made when it is first needed; keeps the sample for late clients where the topic is latched.
    fn channel(&self, post: &Sample) -> Result<Arc<RawChannel>, PublishError> {
        let name = post.topic.full_name(&self.namespace);
        let mut channels = self.channels.locked();
        let channel = match channels.entry(name) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => {
                let raw = self.new_channel(new.key(), post)?;
                let depth = match post.topic.delivery {
                    Delivery::Latched { depth } => depth,
                    Delivery::Reliable { .. } | Delivery::Newest => 0,
                };
                new.insert(Channel {
                    raw,
                    depth,
                    latched: VecDeque::new(),
                })
            }
        };
        if channel.depth > 0 {
            channel.latched.push_back(post.clone());
            if channel.latched.len() > channel.depth {
                channel.latched.pop_front();
            }
        }
        Ok(Arc::clone(&channel.raw))
    }

    fn new_channel(&self, name: &str, post: &Sample) -> Result<Arc<RawChannel>, PublishError> {
        let schema = Schema::new(
            post.topic.type_name,
            "ros2msg",
            post.topic.definition.as_bytes(),
        );
        self.context
            .channel_builder(name)
            .message_encoding("cdr")
            .schema(schema)
            .build_raw()
            .map_err(|e| PublishError::Foxglove {
                address: self.address.clone(),
                reason: format!("{name}: {e}"),
            })
    }
}

fn metadata(post: &Sample) -> PartialMetadata {
    PartialMetadata {
        log_time: u64::try_from(post.stamp.nanos).ok(),
    }
}

/// Sends what is latched to a client that subscribes after it went out.
struct Late {
    channels: Arc<Channels>,
}

impl ServerListener for Late {
    fn on_subscribe(&self, client: Client, channel: ChannelView<'_>) {
        let channels = self.channels.locked();
        let Some(known) = channels.get(channel.topic()) else {
            return;
        };
        let (raw, latched) = (Arc::clone(&known.raw), known.latched.clone());
        drop(channels);
        for post in &latched {
            raw.log_with_meta_to_sink(&post.payload, metadata(post), client.sink_id());
        }
    }
}

impl Transport for FoxgloveTransport {
    fn send(&self, post: &Sample) -> Result<(), PublishError> {
        self.channel(post)?
            .log_with_meta(&post.payload, metadata(post));
        Ok(())
    }

    fn endpoints(&self) -> Vec<String> {
        vec![self.address.clone()]
    }

    fn close(&self) -> Result<(), PublishError> {
        let mut server = self.server.lock().unwrap_or_else(PoisonError::into_inner);
        // Its tasks say goodbye to clients, on the runtime of the server: nothing here waits for one that does not read.
        if let Some(server) = server.take() {
            server.stop().detach_all();
        }
        Ok(())
    }
}
