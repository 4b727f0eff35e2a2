//! Deltas: a client that follows holds what the publisher says, bit for bit, and receives little.

use std::sync::Arc;

use crate::formats::{Dice, random_snapshot};
use splat_msgs::client::follower::{Followed, Follower};
use splat_msgs::map_messages::{
    self, KeyframeArray, MAX_MESSAGE_BYTES, Messages, SplatChunk, SplatDelta, SplatManifest,
};
use splat_msgs::type_hash::dds_type_name;
use splat_ros::map_stream::{PublishedMap, Update};
use splat_types::snapshot::Snapshot;
use splat_types::splats::layout;
use splat_types::splats::splats::Splats;

const FRAME: &str = "splat_map";
const CHUNK_BYTES: usize = 8192;
const MAX_BYTES: usize = 64 << 20;

/// (type, payload) of a whole snapshot.
pub fn whole(snapshot: &Snapshot) -> Vec<(String, Vec<u8>)> {
    let messages = Messages::new(snapshot, FRAME, CHUNK_BYTES);
    let mut sent = vec![(
        dds_type_name::<SplatManifest>(),
        map_messages::payload(&messages.manifest()).unwrap(),
    )];
    let keyframes = messages
        .keyframes()
        .map(|m| map_messages::payload(&m).unwrap());
    sent.extend(keyframes.map(|p| (dds_type_name::<KeyframeArray>(), p)));
    let chunks = messages
        .chunks()
        .map(|m| map_messages::payload(&m).unwrap());
    sent.extend(chunks.map(|p| (dds_type_name::<SplatChunk>(), p)));
    sent
}

fn pieces(update: &Update, held: &Snapshot) -> Vec<SplatDelta> {
    match update {
        Update::Whole => panic!("a whole snapshot where a delta was due"),
        Update::Delta(delta) => {
            let after = Messages::new(held, FRAME, CHUNK_BYTES);
            delta.messages(&after).collect()
        }
    }
}

fn follow(follower: &mut Follower, pieces: &[SplatDelta]) -> Followed {
    let mut steps = pieces.iter().map(|piece| {
        let payload = map_messages::payload(piece).unwrap();
        assert!(payload.len() <= MAX_MESSAGE_BYTES);
        follower.add_payload(&dds_type_name::<SplatDelta>(), &payload)
    });
    steps
        .find(|step| *step != Followed::Nothing)
        .unwrap_or(Followed::Nothing)
}

/// The next revision: some splats gone, all others moved a little, a few much, and new ones behind.
pub fn next(of: &Snapshot, dice: &mut Dice) -> Snapshot {
    let mut splats = Splats {
        sh_degree: of.splats.sh_degree,
        ..Splats::default()
    };
    let mut ids = Vec::new();
    for (ix, id) in of.splat_ids.iter().enumerate() {
        if dice.below(20) == 0 {
            continue;
        }
        splats.push(&of.splats, ix);
        ids.push(*id);
        let by = if dice.below(10) == 0 { 0.5 } else { 1e-5 };
        splats.means.last_mut().unwrap()[0] += by;
    }
    let more = random_snapshot(
        of.splats.len() / 20,
        1,
        of.splats.sh_degree,
        of.revision + 50,
    );
    let newest = of.splat_ids.last().copied().unwrap_or(0);
    for ix in 0..more.splats.len() {
        splats.push(&more.splats, ix);
        ids.push(newest + 1 + ix as u32);
    }
    Snapshot {
        revision: of.revision + 1,
        splats: Arc::new(splats),
        splat_ids: Arc::new(ids),
        ..of.clone()
    }
}

#[test]
fn who_follows_and_who_joins_late_hold_the_published_map() {
    let mut dice = Dice(7);
    let (mut published, mut follower) = (PublishedMap::default(), Follower::new(MAX_BYTES));
    let mut newest = Arc::new(random_snapshot(4000, 6, 1, 1));
    assert!(matches!(
        published.update(&newest, false, 0.3),
        Update::Whole
    ));
    for (dds_type, payload) in whole(&newest) {
        follower.add_payload(&dds_type, &payload);
    }
    assert_eq!(follower.held(), Some(&*newest));
    for _ in 0..6 {
        newest = Arc::new(next(&newest, &mut dice));
        let update = published.update(&newest, false, 0.3);
        let held = Arc::clone(published.held().unwrap());
        let sent = pieces(&update, &held);
        assert_eq!(follow(&mut follower, &sent), Followed::Advanced);
        let followed = follower.held().unwrap();
        assert_eq!(
            layout::digest(&followed.splats),
            layout::digest(&held.splats)
        );
        assert_eq!(followed.splat_ids, held.splat_ids);
        let mut late = Follower::new(MAX_BYTES);
        for (dds_type, payload) in whole(&held) {
            late.add_payload(&dds_type, &payload);
        }
        assert_eq!(late.held().unwrap().splats, held.splats);
        // What moved by less than can be seen was not sent, what moved much was.
        let bytes: usize = sent.iter().map(|piece| piece.data.len()).sum();
        let all = newest.splats.len() * layout::bytes_per_splat(1);
        assert!(bytes < all / 5, "{bytes} of {all}");
        assert_eq!(held.splats.len(), newest.splats.len());
    }
    let last = Snapshot {
        revision: newest.revision + 1,
        ..(*newest).clone()
    };
    assert!(matches!(
        published.update(&Arc::new(last), true, 0.3),
        Update::Whole
    ));
    assert_eq!(published.held().unwrap().splats, newest.splats);
}

#[test]
fn a_delta_stays_below_its_share_and_the_rest_comes_later() {
    let mut dice = Dice(9);
    let mut published = PublishedMap::default();
    let first = Arc::new(random_snapshot(3000, 2, 0, 1));
    published.update(&first, false, 0.05);
    let second = next(&first, &mut dice);
    let mut newest = Arc::new(second);
    for round in 0..12 {
        let update = published.update(&newest, false, 0.05);
        let held = Arc::clone(published.held().unwrap());
        let n_sent: usize = pieces(&update, &held).iter().map(|p| p.ids.len()).sum();
        assert!(
            n_sent <= newest.splats.len() / 20,
            "{n_sent} in round {round}"
        );
        newest = Arc::new(Snapshot {
            revision: newest.revision + 1,
            ..(*newest).clone()
        });
    }
    let held = published.held().unwrap();
    assert_eq!(held.splat_ids, newest.splat_ids);
    let far = (0..held.splats.len())
        .filter(|ix| (held.splats.means[*ix][0] - newest.splats.means[*ix][0]).abs() > 1e-4)
        .count();
    assert_eq!(far, 0);
}

#[test]
fn a_lost_piece_a_forged_one_and_another_epoch_are_noticed() {
    let mut dice = Dice(5);
    let mut published = PublishedMap::default();
    let first = Arc::new(random_snapshot(3000, 2, 1, 1));
    published.update(&first, false, 1.0);
    let second = Arc::new(next(&first, &mut dice));
    let update = published.update(&second, false, 1.0);
    let sent = pieces(&update, published.held().unwrap());
    assert!(sent.len() > 2);
    let fresh = || {
        let mut follower = Follower::new(MAX_BYTES);
        for (dds_type, payload) in whole(&first) {
            follower.add_payload(&dds_type, &payload);
        }
        follower
    };
    // In any order, and twice.
    let mut follower = fresh();
    let mut mixed = sent.clone();
    mixed.reverse();
    mixed.insert(1, sent[0].clone());
    assert_eq!(follow(&mut follower, &mixed), Followed::Advanced);
    // One is missing, then the next delta comes.
    let mut follower = fresh();
    assert_eq!(follow(&mut follower, &sent[1..]), Followed::Nothing);
    let third = Arc::new(next(&second, &mut dice));
    let update = published.update(&third, false, 1.0);
    let later = pieces(&update, published.held().unwrap());
    assert_eq!(follower.add_delta(later[0].clone()), Followed::Missed);
    // Sound by itself, but not what was published.
    let mut forged = sent.clone();
    forged[0].removed.clear();
    forged[1].removed.clear();
    assert_eq!(follow(&mut fresh(), &forged), Followed::Missed);
    let mut other = sent[0].clone();
    other.epoch += 1;
    assert_eq!(fresh().add_delta(other), Followed::Missed);
    // Noise.
    let mut follower = fresh();
    let good = map_messages::payload(&sent[0]).unwrap();
    for _ in 0..2000 {
        let mut payload = good.clone();
        (0..4).for_each(|_| payload[dice.below(200)] = dice.roll() as u8);
        follower.add_payload(&dds_type_name::<SplatDelta>(), &payload);
    }
    assert_eq!(follower.held().unwrap().revision, 1);
}

#[test]
fn a_new_epoch_or_map_goes_out_whole() {
    let mut published = PublishedMap::default();
    let first = Arc::new(random_snapshot(100, 2, 1, 1));
    published.update(&first, false, 0.1);
    for changed in [
        Snapshot {
            epoch: first.epoch + 1,
            revision: 2,
            ..(*first).clone()
        },
        Snapshot {
            map_id: [9; 16],
            revision: 3,
            ..(*first).clone()
        },
    ] {
        assert!(matches!(
            published.update(&Arc::new(changed), false, 0.1),
            Update::Whole
        ));
    }
}
