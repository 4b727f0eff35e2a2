use std::sync::mpsc::{Receiver as Signals, SyncSender as Signal, sync_channel};

use crate::node::engines::Engines;
use crate::node::open_source;
use crate::node::pipeline::*;
use crate::node::stop::Stop;
use crate::params::settings::Settings;
use splat_geometry::answer::GeometryBatch;

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
        publisher: None,
        engines: Engines::default(),
    };
    let ((entered_tx, entered), (release, released)) = (sync_channel(4), sync_channel(0));
    let model = Box::new(Stuck {
        entered: entered_tx,
        released,
    });
    let (done_tx, done) = sync_channel(1);
    spawn("run", move || {
        let end = run_with(model, Scale::UP_TO_SCALE, job, None, &mut |_| {});
        let outcome = end.map(|end| end.into_outcome(None, true));
        done_tx.send(outcome.map(|o| (o.error, o.n_selected))).ok();
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
