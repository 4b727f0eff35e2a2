//! The node's way out to browsers.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use crate::hub::Hub;
use crate::plan_frames::PlanFrames;
use crate::server::Server;
use crate::settings::ViewSettings;
use crate::view_map::Published;
use splat_msgs::ros;
use splat_msgs::status_message::MapperStatus;
use splat_ros::error::PublishError;
use splat_ros::transport::{Event, Sample, Transport};

/// Serves the page while it lives.
#[derive(Debug)]
pub struct ViewTransport {
    hub: Arc<Hub>,
    server: Server,
    thread: Option<JoinHandle<()>>,
    /// Frames that plans come in.
    frames: Mutex<PlanFrames>,
}

impl ViewTransport {
    pub fn start(settings: &ViewSettings) -> std::io::Result<Self> {
        let hub = Arc::new(Hub::default());
        let server = Server::start(settings, Arc::clone(&hub))?;
        let (of_thread, sh_degree) = (Arc::clone(&hub), settings.sh_degree);
        let thread = std::thread::Builder::new()
            .name("view map".to_owned())
            .spawn(move || of_thread.run(sh_degree))?;
        Ok(Self {
            hub,
            server,
            thread: Some(thread),
            frames: Mutex::new(PlanFrames::new(&settings.map_frame)),
        })
    }

    fn frames(&self) -> MutexGuard<'_, PlanFrames> {
        self.frames.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub fn url(&self) -> &str {
        self.server.url()
    }

    pub fn hub(&self) -> &Arc<Hub> {
        &self.hub
    }
}

impl Drop for ViewTransport {
    fn drop(&mut self) {
        self.hub.end();
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
    }
}

impl Transport for ViewTransport {
    fn send(&self, post: &Sample) -> Result<(), PublishError> {
        if post.topic.name == "status"
            && let Ok(status) = ros::decode::<MapperStatus>(&post.payload)
        {
            self.hub.status(&status);
        }
        Ok(())
    }

    fn observe(&self, event: &Event<'_>) {
        match event {
            Event::Map {
                snapshot,
                map_from_world,
            } => self.hub.publish(Published {
                snapshot: Arc::clone(snapshot),
                map_from_world: *map_from_world,
            }),
            Event::Frame(frame) => self.hub.frame(frame),
            Event::Keyframe { stamp, image } => self.hub.keyframe(*stamp, image),
            Event::Correction(correction) => self.hub.correction(correction),
            Event::Grid {
                grid,
                map_from_grid,
                ground,
                frame,
            } => {
                self.frames().set_grid(frame, *map_from_grid, *ground);
                self.hub.grid(grid, *map_from_grid, *ground);
            }
            Event::Plan(plan) => match self.frames().in_map(plan) {
                Some(points) => self.hub.plan(&points),
                None => tracing::debug!("a plan in the frame {:?} is not drawn", plan.frame_id),
            },
        }
    }

    fn endpoints(&self) -> Vec<String> {
        vec![self.server.url().to_owned()]
    }

    fn close(&self) -> Result<(), PublishError> {
        self.hub.end();
        Ok(())
    }
}
