use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver as Signals, SyncSender as Signal, sync_channel};

use crate::node::engines::Engines;
use crate::node::open_source;
use crate::node::pipeline::*;
use crate::node::stop::Stop;
use crate::params::settings::Settings;
use splat_geometry::answer::GeometryBatch;
use splat_io::frame_source::{Source, SourceCounts};
use splat_msgs::correction_message::MapCorrectionMsg;
use splat_msgs::map_messages::SplatManifest;
use splat_msgs::ros;
use splat_msgs::status_message::MapperStatus;
use splat_ros::error::PublishError;
use splat_ros::service_server::Controls;
use splat_ros::transport::{Sample, Transport};
use splat_types::frame::Frame;

/// Longer than anything here takes on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// A network that takes as long as it likes.
struct Stuck {
    entered: Signal<()>,
    released: Signals<()>,
}

impl GeometryModel for Stuck {
    fn infer(&mut self, _: &Batch) -> Result<GeometryBatch, GeometryError> {
        self.entered.send(()).ok();
        self.released.recv().ok();
        Ok(GeometryBatch::default())
    }

    fn finish(&mut self) -> Result<GeometryBatch, GeometryError> {
        Ok(GeometryBatch::default())
    }
}

#[test]
fn a_stop_does_not_wait_for_geometry_that_is_at_work() {
    let mut settings = Settings::shipped();
    for setting in [
        "source.max_side=64",
        "select.batch_size=2",
        "select.batch_overlap=1",
        "backend=cpu",
    ] {
        settings.merge_setting(setting).expect("known");
    }
    let params = settings.params().expect("fits");
    let stop = Stop::default();
    let job = Job {
        source: open_source::open("synthetic:room", &params.source, 0).expect("always there"),
        params,
        is_live: false,
        stop: stop.clone(),
        out: None,
        output: None,
        engines: Engines::default(),
    };
    let ((entered_tx, entered), (release, released)) = (sync_channel(4), sync_channel(0));
    let model = Box::new(Stuck {
        entered: entered_tx,
        released,
    });
    let (done_tx, done) = sync_channel(1);
    spawn("run", move || {
        let end = run_with(model, Scale::UP_TO_SCALE, job, &mut |_| {});
        let outcome = end.map(|end| end.into_outcome(None, true));
        done_tx
            .send(outcome.map(|o| (o.error, o.input.n_selected)))
            .ok();
    })
    .expect("starts");
    entered.recv_timeout(PATIENCE).expect("a batch comes");
    // By then, selection waits for room behind the batch.
    std::thread::sleep(Duration::from_millis(300));
    stop.ask();
    let outcome = done.recv_timeout(PATIENCE).expect("the run ends");
    let (error, n_selected) = outcome.expect("in order");
    assert_eq!(error, None);
    assert!(n_selected >= 2, "{n_selected} keyframes");
    drop(release);
}

/// Asks for a fresh map with one of its frames, as the service does.
struct ResetAt {
    inner: Box<dyn Source>,
    frames_left: u32,
    controls: Arc<Controls>,
}

impl Source for ResetAt {
    fn next(&mut self) -> Option<Frame> {
        self.frames_left = self.frames_left.saturating_sub(1);
        if self.frames_left == 1 {
            self.controls.wants_reset.store(true, Ordering::Relaxed);
        }
        self.inner.next()
    }

    fn counts(&self) -> SourceCounts {
        self.inner.counts()
    }

    fn len_hint(&self) -> Option<u64> {
        None
    }

    fn truth_extent(&self) -> Option<f64> {
        self.inner.truth_extent()
    }
}

/// Keeps what goes out.
#[derive(Default)]
struct Kept(Arc<Mutex<Vec<Sample>>>);

impl Transport for Kept {
    fn send(&self, post: &Sample) -> Result<(), PublishError> {
        self.0.lock().expect("no panic").push(post.clone());
        Ok(())
    }

    fn close(&self) -> Result<(), PublishError> {
        Ok(())
    }
}

#[test]
fn after_a_reset_the_next_map_goes_out_by_the_same_streams_and_services_reach_it() {
    for is_sequential in [true, false] {
        let mut settings = Settings::shipped();
        for setting in [
            "source.max_side=64",
            "train.steps=4",
            "backend=cpu",
            "geometry=ground_truth",
            "track.enabled=false",
            &format!("sequential={is_sequential}"),
        ] {
            settings.merge_setting(setting).expect("known");
        }
        let params = settings.params().expect("fits");
        let kept = Kept::default();
        let sent = Arc::clone(&kept.0);
        let output = Output::open(&params.publish, vec![Box::new(kept)]).expect("opens");
        let input = "synthetic:room?frames=24&width=64&height=48&speed=3";
        let source = ResetAt {
            inner: open_source::open(input, &params.source, 0).expect("always there"),
            frames_left: 13,
            controls: Arc::clone(&output.handles.controls),
        };
        let job = Job {
            source: Box::new(source),
            params,
            is_live: false,
            stop: Stop::default(),
            out: None,
            output: Some(output),
            engines: Engines::default(),
        };
        let mut outcome = run(job, &mut |_| {}).expect("runs");
        assert!(outcome.publisher.is_some() && outcome.error.is_none());
        assert!(outcome.request_handler.take_calls().is_some());

        let sent = sent.lock().expect("no panic");
        let payloads = |topic: &'static str| {
            let of_topic = sent.iter().filter(move |sample| sample.topic.name == topic);
            of_topic.map(|sample| &*sample.payload)
        };
        let mut map_ids: Vec<[u8; 16]> = payloads("splats/manifest")
            .map(|payload| ros::decode::<SplatManifest>(payload).expect("decodes"))
            .map(|manifest| manifest.map_id)
            .collect();
        map_ids.dedup();
        assert_eq!(map_ids.len(), 2, "one map, then another");
        assert_eq!(map_ids[1], outcome.snapshot.map_id);
        // The stream of the second map remembers the first one, and so says what became of it.
        let corrections: Vec<_> = payloads("correction")
            .map(|payload| ros::decode::<MapCorrectionMsg>(payload).expect("decodes"))
            .collect();
        assert_eq!(corrections.len(), 1);
        assert_eq!(
            (corrections[0].map_id, corrections[0].reason),
            (map_ids[1], 2)
        );
    }
}

#[test]
fn the_last_status_counts_what_selection_took() {
    let mut settings = Settings::shipped();
    for setting in [
        "source.max_side=64",
        "train.steps=4",
        "backend=cpu",
        "geometry=ground_truth",
    ] {
        settings.merge_setting(setting).expect("known");
    }
    let params = settings.params().expect("fits");
    let kept = Kept::default();
    let sent = Arc::clone(&kept.0);
    let input = "synthetic:room?frames=24&width=64&height=48&speed=3";
    let job = Job {
        source: open_source::open(input, &params.source, 0).expect("always there"),
        output: Some(Output::open(&params.publish, vec![Box::new(kept)]).expect("opens")),
        params,
        is_live: false,
        stop: Stop::default(),
        out: None,
        engines: Engines::default(),
    };
    let outcome = run(job, &mut |_| {}).expect("runs");
    let sent = sent.lock().expect("no panic");
    let last = sent.iter().rfind(|sample| sample.topic.name == "status");
    let status: MapperStatus = ros::decode(&last.expect("sent").payload).expect("decodes");
    assert!(outcome.input.n_selected > 1, "{outcome:?}");
    assert_eq!(
        (status.frames_received, status.keyframes_selected as usize),
        (24, outcome.input.n_selected)
    );
    assert_eq!((status.frames_dropped, status.frames_queued), (0, 0));
}
