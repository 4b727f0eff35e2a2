//! Parameters -> all that goes out, opened: the publisher, which threads share, and the streams, which they own.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::Receiver;

use crate::error::PublishError;
#[cfg(feature = "foxglove")]
use crate::foxglove_transport::FoxgloveTransport;
use crate::grid_stream::{self, GridStream};
use crate::latched::{self, LatchedStore};
use crate::map_stream::{self, MapStream};
use crate::mcap_transport::McapTransport;
use crate::navigation;
use crate::obstacles;
use crate::odometry::FrameCells;
use crate::params::PublishParams;
use crate::pose_messages;
use crate::pose_stream::{PoseStream, mount_of};
use crate::publisher::Publisher;
use crate::render_view::Frames;
use crate::reports::Reports;
use crate::service_server::{Controls, ServiceCall, ServiceServer};
use crate::status;
use crate::status_stream::StatusStream;
use crate::transport::{Topic, Transport};

/// All topics of the node; each stream lists its own.
pub fn topics() -> Vec<&'static Topic> {
    [
        &pose_messages::TOPICS[..],
        &navigation::TOPICS,
        &latched::TOPICS,
        &map_stream::TOPICS,
        &grid_stream::TOPICS,
        &obstacles::TOPICS,
        &status::TOPICS,
    ]
    .concat()
}

/// All that goes out while a run goes on.
#[derive(Debug)]
pub struct Output {
    pub handles: OutputHandles,
    pub streams: Streams,
    /// What services ask of the map thread; `None` while that thread has it.
    pub calls: Option<Receiver<ServiceCall>>,
}

/// What threads share.
#[derive(Debug, Clone)]
pub struct OutputHandles {
    pub publisher: Arc<Publisher>,
    pub reports: Arc<Reports>,
    pub controls: Arc<Controls>,
    pub frames: Arc<FrameCells>,
}

/// What goes from message to message, each part owned by one thread; it outlives a map that is thrown away.
#[derive(Debug)]
pub struct Streams {
    pub map: MapStream,
    pub poses: PoseStream,
    pub status: StatusStream,
    pub grid: GridStream,
}

impl Output {
    /// Opens the transports that the parameters ask for, and `more` beside them.
    pub fn open(
        params: &PublishParams,
        more: Vec<Box<dyn Transport>>,
    ) -> Result<Self, PublishError> {
        let mount = mount_of(params)?;
        let cells = Arc::<FrameCells>::default();
        let latched = Arc::new(LatchedStore::new(&params.splat_frame, params.chunk_bytes));
        let controls = Arc::new(Controls::default());
        let frames = Frames {
            map: params.map_frame.clone(),
            splats: params.splat_frame.clone(),
            cells: Arc::clone(&cells),
        };
        let (service_server, calls) = ServiceServer::new(
            Arc::clone(&latched),
            Arc::clone(&controls),
            frames,
            &params.map_directory,
        );
        let service_server = Arc::new(service_server);
        let mut transports: Vec<Box<dyn Transport>> = Vec::new();
        #[cfg(feature = "zenoh")]
        if params.zenoh {
            let (latched, service_server) = (Arc::clone(&latched), Arc::clone(&service_server));
            let transport = crate::zenoh::transport::ZenohTransport::open(
                params,
                &topics(),
                latched,
                service_server,
            )?;
            transports.push(Box::new(transport));
        }
        #[cfg(not(feature = "zenoh"))]
        if params.zenoh {
            return Err(PublishError::Param {
                name: "zenoh",
                found: "true".to_owned(),
                expected: "false, since this build has no zenoh; build with --features zenoh"
                    .to_owned(),
            });
        }
        #[cfg(feature = "foxglove")]
        if !params.foxglove.is_empty() {
            let transport = FoxgloveTransport::open(&params.foxglove, &params.namespace)?;
            transports.push(Box::new(transport));
        }
        #[cfg(not(feature = "foxglove"))]
        if !params.foxglove.is_empty() {
            return Err(PublishError::Param {
                name: "foxglove",
                found: params.foxglove.clone(),
                expected:
                    "nothing, since this build has no Foxglove; build with --features foxglove"
                        .to_owned(),
            });
        }
        if !params.record.is_empty() {
            let transport = McapTransport::create(&PathBuf::from(&params.record))?;
            transports.push(Box::new(transport));
        }
        transports.extend(more);
        // Time without an image counts from here.
        let reports = Arc::<Reports>::default();
        let streams = Streams {
            map: MapStream::new(params, Arc::clone(&reports), Arc::clone(&cells)),
            grid: GridStream::new(params, Arc::clone(&reports), Arc::clone(&cells)),
            poses: PoseStream::new(mount, params, Arc::clone(&reports), Arc::clone(&cells)),
            status: StatusStream::new(params, Arc::clone(&reports)),
        };
        let publisher = Arc::new(Publisher::new(transports, latched, service_server));
        if !params.view.is_empty() && !params.plan_topic.is_empty() {
            publisher.receive_plans(&params.plan_topic)?;
        }
        Ok(Self {
            handles: OutputHandles {
                publisher,
                reports,
                controls,
                frames: cells,
            },
            streams,
            calls: Some(calls),
        })
    }
}
