//! Submaps on their way out: whole, once for each revision, in a frame of their own, and taken back when they are gone.

use std::sync::Arc;

use crate::formats::random_snapshot;
use crate::sent_corrections::{Sent, output};
use splat_msgs::client::assembler::Assembler;
use splat_msgs::map_messages::{KeyframeArray, SplatChunk, SplatManifest};
use splat_msgs::ros;
use splat_ros::latched::{SUBMAP_MANIFEST, SUBMAP_SPLATS};
use splat_ros::output::Output;
use splat_types::snapshot::Snapshot;

fn submap(id: u8, revision: u32) -> Arc<Snapshot> {
    let mut snapshot = random_snapshot(300, 5, 1, revision);
    snapshot.map_id = [id; 16];
    Arc::new(snapshot)
}

fn publish(output: &mut Output, submaps: &[&Arc<Snapshot>]) {
    let submaps: Vec<Arc<Snapshot>> = submaps.iter().map(|one| Arc::clone(one)).collect();
    let publisher = &output.handles.publisher;
    let sent = output.streams.map.publish_submaps(publisher, &submaps);
    sent.unwrap();
}

fn take(sent: &Sent) -> Vec<(&'static str, Vec<u8>)> {
    std::mem::take(&mut *sent.lock().unwrap())
}

fn manifests(sent: &[(&'static str, Vec<u8>)]) -> Vec<SplatManifest> {
    let of_topic = sent
        .iter()
        .filter(|(topic, _)| *topic == "submaps/manifest");
    of_topic
        .map(|(_, bytes)| ros::decode(bytes).unwrap())
        .collect()
}

/// The snapshots that a client makes of what was sent.
fn assembled(sent: &[(&'static str, Vec<u8>)]) -> Vec<Snapshot> {
    let mut assembler = Assembler::new(1 << 24);
    let pieces = sent.iter().filter_map(|(topic, bytes)| match *topic {
        "submaps/manifest" => assembler.add_manifest(ros::decode::<SplatManifest>(bytes).unwrap()),
        "submaps/keyframes" => {
            assembler.add_keyframes(ros::decode::<KeyframeArray>(bytes).unwrap())
        }
        "submaps/splats" => assembler.add_chunk(ros::decode::<SplatChunk>(bytes).unwrap()),
        other => panic!("{other}"),
    });
    pieces.collect()
}

#[test]
fn a_submap_goes_out_whole_once_for_each_revision() {
    let (mut output, sent) = output();
    let (a, b) = (submap(1, 4), submap(2, 7));
    publish(&mut output, &[&a]);
    assert_eq!(assembled(&take(&sent)), [Snapshot::clone(&a)]);
    publish(&mut output, &[&a]);
    assert!(take(&sent).is_empty(), "clients have it");
    publish(&mut output, &[&a, &b]);
    let both = take(&sent);
    assert_eq!(assembled(&both), [Snapshot::clone(&b)]);
    let changed = submap(1, 5);
    publish(&mut output, &[&changed, &b]);
    let found = take(&sent);
    assert_eq!(assembled(&found), [Snapshot::clone(&changed)]);
    let frames = [&both, &found].map(|sent| manifests(sent)[0].header.frame_id.clone());
    assert_eq!(frames, ["splat_map_02020202", "splat_map_01010101"]);
}

#[test]
fn a_submap_that_is_gone_goes_out_once_more_without_splats() {
    let (mut output, sent) = output();
    let (a, b) = (submap(1, 4), submap(2, 7));
    publish(&mut output, &[&a, &b]);
    take(&sent);
    publish(&mut output, &[&b]);
    let [last] = &manifests(&take(&sent))[..] else {
        panic!("one manifest")
    };
    assert_eq!((last.map_id, last.revision), (a.map_id, 5));
    assert_eq!((last.n_splats, last.n_chunks, last.n_keyframes), (0, 0, 0));
    publish(&mut output, &[&b]);
    assert!(take(&sent).is_empty());
}

#[test]
fn who_joins_late_gets_all_submaps_that_there_are() {
    let (mut output, _) = output();
    let (a, b) = (submap(1, 4), submap(2, 7));
    publish(&mut output, &[&a, &b]);
    let latched = output.handles.publisher.latched();
    let mut late = Vec::new();
    for topic in [&SUBMAP_MANIFEST, &SUBMAP_SPLATS] {
        let mut keep = |sample: &splat_ros::transport::Sample| {
            late.push((sample.topic.name, sample.payload.to_vec()));
            Ok(())
        };
        latched.send_latched(topic, &mut keep).unwrap();
    }
    let ids: Vec<[u8; 16]> = manifests(&late).iter().map(|m| m.map_id).collect();
    assert_eq!(ids, [a.map_id, b.map_id]);
    let chunks = late.iter().filter(|(topic, _)| *topic == "submaps/splats");
    assert_eq!(chunks.count(), 2);
    publish(&mut output, &[&b]);
    let latched = output.handles.publisher.latched();
    let mut n_left = 0;
    let mut count = |_: &splat_ros::transport::Sample| {
        n_left += 1;
        Ok(())
    };
    latched.send_latched(&SUBMAP_MANIFEST, &mut count).unwrap();
    assert_eq!(n_left, 1);
}
