//! Corrections of the map on their way out: one message an epoch, before the first snapshot that shows it.

use std::sync::{Arc, Mutex};

use glam::{DQuat, DVec3};

use crate::formats::random_snapshot;
use crate::sfm::params;
use splat_msgs::correction_message::MapCorrectionMsg;
use splat_msgs::ros;
use splat_ros::error::PublishError;
use splat_ros::output::Output;
use splat_ros::transport::{Sample, Transport};
use splat_types::correction::{MapCorrection, Reason};
use splat_types::snapshot::Snapshot;
use splat_types::transform::Similarity;

pub(crate) type Sent = Arc<Mutex<Vec<(&'static str, Vec<u8>)>>>;

/// Keeps what it is given.
struct Kept(Sent);

impl Transport for Kept {
    fn send(&self, post: &Sample) -> Result<(), PublishError> {
        let sent = (post.topic.name, post.payload.to_vec());
        self.0.lock().unwrap().push(sent);
        Ok(())
    }

    fn close(&self) -> Result<(), PublishError> {
        Ok(())
    }
}

pub(crate) fn output() -> (Output, Sent) {
    let sent = Sent::default();
    let kept = Kept(Arc::clone(&sent));
    let output = Output::open(&params(&[]).publish, vec![Box::new(kept)]);
    (output.unwrap(), sent)
}

fn publish(output: &mut Output, snapshot: &Arc<Snapshot>) {
    let publisher = &output.handles.publisher;
    let sent = output.streams.map.publish(publisher, snapshot, false, 0);
    sent.unwrap();
}

fn queue(output: &Output, correction: MapCorrection) {
    output.handles.reports.correction.add(correction);
}

fn snapshot(revision: u32, epoch: u32) -> Arc<Snapshot> {
    let mut snapshot = random_snapshot(20, 3, 0, revision);
    snapshot.epoch = epoch;
    Arc::new(snapshot)
}

fn moved(epoch: u32, revision: u32) -> MapCorrection {
    MapCorrection {
        epoch,
        revision,
        new_world_from_old_world: Similarity {
            scale: 1.5,
            rotation: DQuat::from_rotation_z(0.3),
            translation: DVec3::new(1.0, 2.0, 3.0),
        },
        translation: 0.7,
        rotation_rad: 0.3,
        ..MapCorrection::identity(Reason::Loop)
    }
}

/// Corrections since, and whether each went out before all other messages of its snapshot.
fn corrections(sent: &Sent) -> Vec<MapCorrectionMsg> {
    let sent = std::mem::take(&mut *sent.lock().unwrap());
    if let Some(at) = sent.iter().position(|(topic, _)| *topic == "correction") {
        assert_eq!(at, 0, "{:?}", sent[0].0);
    }
    let corrections = sent.iter().filter(|(topic, _)| *topic == "correction");
    corrections
        .map(|(_, payload)| ros::decode(payload).unwrap())
        .collect()
}

#[test]
fn a_correction_goes_out_once_with_the_first_snapshot_that_shows_it() {
    let (mut output, sent) = output();
    publish(&mut output, &snapshot(1, 0));
    assert!(corrections(&sent).is_empty());
    queue(&output, moved(1, 3));
    // The map's thread was ahead.
    publish(&mut output, &snapshot(2, 0));
    assert!(corrections(&sent).is_empty());
    publish(&mut output, &snapshot(3, 1));
    let found = corrections(&sent);
    assert_eq!(found.len(), 1);
    assert_eq!(found[0].header.frame_id, "splat_map");
    assert_eq!((found[0].epoch, found[0].revision), (1, 3));
    let t = found[0].new_world_from_old_world.position;
    assert_eq!([t.x, t.y, t.z, found[0].scale], [1.0, 2.0, 3.0, 1.5]);
    assert_eq!((found[0].translation, found[0].rotation_rad), (0.7, 0.3));
    assert_eq!(found[0].reason, 0);
    publish(&mut output, &snapshot(4, 1));
    assert!(corrections(&sent).is_empty());
}

#[test]
fn corrections_of_snapshots_that_nobody_saw_are_sent_as_one() {
    let (mut output, sent) = output();
    publish(&mut output, &snapshot(1, 0));
    assert!(corrections(&sent).is_empty());
    queue(&output, moved(1, 2));
    queue(&output, moved(2, 3));
    publish(&mut output, &snapshot(3, 2));
    let found = corrections(&sent);
    assert_eq!(found.len(), 1);
    assert!((found[0].scale - 2.25).abs() < 1e-12);
    assert_eq!(found[0].epoch, 2);
}

#[test]
fn a_map_that_takes_the_place_of_another_says_why() {
    for (is_loaded, code) in [(false, 2), (true, 3)] {
        let (mut output, sent) = output();
        publish(&mut output, &snapshot(5, 2));
        queue(&output, MapCorrection::restart(is_loaded));
        let mut other = random_snapshot(20, 3, 0, 1);
        other.map_id[0] ^= 1;
        sent.lock().unwrap().clear();
        publish(&mut output, &Arc::new(other));
        let found = corrections(&sent);
        assert_eq!(found.len(), 1, "is_loaded {is_loaded}");
        assert_eq!(found[0].reason, code);
        assert_eq!(found[0].scale, 1.0);
    }
}

#[test]
fn a_merge_that_moves_nothing_begins_no_epoch_and_is_not_sent() {
    let (mut output, sent) = output();
    publish(&mut output, &snapshot(1, 0));
    queue(
        &output,
        MapCorrection {
            revision: 2,
            ..MapCorrection::identity(Reason::Merge)
        },
    );
    publish(&mut output, &snapshot(2, 0));
    assert!(corrections(&sent).is_empty());
}
