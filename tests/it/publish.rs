//! Snapshots over the wire: what a client puts together equals what was published.

use crate::formats::{Dice, random_snapshot};
use splat_msgs::client::assembler::{Assembler, Counts};
use splat_msgs::map_messages::{self, KeyframeArray, Messages, SplatChunk, SplatManifest};
use splat_msgs::ros;
use splat_msgs::type_hash::dds_type_name;
use splat_types::snapshot::Snapshot;

const MAX_BYTES: usize = 64 << 20;
const FRAME: &str = "splat_map";

/// One message of any kind.
#[derive(Clone)]
enum Piece {
    Manifest(SplatManifest),
    Keyframes(KeyframeArray),
    Chunk(SplatChunk),
}

fn pieces(snapshot: &Snapshot, chunk_bytes: usize) -> Vec<Piece> {
    let messages = Messages::new(snapshot, FRAME, chunk_bytes);
    let mut pieces = vec![Piece::Manifest(messages.manifest())];
    pieces.extend(messages.keyframes().map(Piece::Keyframes));
    pieces.extend(messages.chunks().map(Piece::Chunk));
    pieces
}

fn add(assembler: &mut Assembler, piece: Piece) -> Option<Snapshot> {
    match piece {
        Piece::Manifest(manifest) => assembler.add_manifest(manifest),
        Piece::Keyframes(array) => assembler.add_keyframes(array),
        Piece::Chunk(chunk) => assembler.add_chunk(chunk),
    }
}

fn shuffle<T>(items: &mut [T], dice: &mut Dice) {
    (1..items.len()).for_each(|ix| items.swap(ix, dice.below(ix + 1)));
}

#[test]
fn pieces_in_any_order_and_twice_give_the_snapshot_once() {
    let mut dice = Dice(3);
    for (n_splats, n_keyframes, sh_degree) in [
        (1000, 25, 1),
        (400, 1, 3),
        (700, 60, 0),
        (0, 4, 1),
        (0, 0, 0),
        (5, 0, 2),
    ] {
        let snapshot = random_snapshot(n_splats, n_keyframes, sh_degree, 4);
        let mut sent = pieces(&snapshot, 2048);
        sent.extend(sent.clone());
        shuffle(&mut sent, &mut dice);
        let n_sent = sent.len() as u64;
        let mut assembler = Assembler::new(MAX_BYTES);
        let received: Vec<Snapshot> = sent
            .into_iter()
            .filter_map(|piece| add(&mut assembler, piece))
            .collect();
        assert_eq!(received.len(), 1);
        assert!(received[0] == snapshot);
        let half = n_sent / 2;
        assert_eq!(
            assembler.counts(),
            Counts {
                used: half,
                superfluous: half,
                ..Counts::default()
            }
        );
    }
}

#[test]
fn one_lost_piece_of_any_kind_holds_a_snapshot_back_until_it_comes_again() {
    let snapshot = random_snapshot(300, 40, 1, 4);
    let sent = pieces(&snapshot, 2048);
    assert!(sent.len() > 10, "{} pieces test little", sent.len());
    for lost in 0..sent.len() {
        let mut assembler = Assembler::new(MAX_BYTES);
        for (ix, piece) in sent.iter().enumerate().filter(|(ix, _)| *ix != lost) {
            assert!(
                add(&mut assembler, piece.clone()).is_none(),
                "complete with {ix} although {lost} is missing"
            );
        }
        assert!(add(&mut assembler, sent[lost].clone()).as_ref() == Some(&snapshot));
    }
}

#[test]
fn interleaved_revisions_come_out_whole_and_never_backwards() {
    let snapshots =
        [1, 2, 3].map(|revision| random_snapshot(200 * revision as usize, 5, 1, revision));
    let mut dice = Dice(8);
    for _ in 0..20 {
        let mut sent: Vec<Piece> = snapshots
            .iter()
            .flat_map(|snapshot| pieces(snapshot, 2048))
            .collect();
        shuffle(&mut sent, &mut dice);
        let mut assembler = Assembler::new(MAX_BYTES);
        let received: Vec<Snapshot> = sent
            .into_iter()
            .filter_map(|piece| add(&mut assembler, piece))
            .collect();
        assert!(received.iter().all(|snapshot| snapshots.contains(snapshot)));
        assert!(received.is_sorted_by_key(|snapshot| snapshot.revision));
        assert!(received.last() == Some(&snapshots[2]));
    }
}

#[test]
fn a_new_map_begins_again_at_a_lower_revision() {
    let (old, mut new) = (random_snapshot(50, 2, 0, 9), random_snapshot(50, 2, 0, 1));
    new.map_id[0] ^= 1;
    let mut assembler = Assembler::new(MAX_BYTES);
    for snapshot in [&old, &new] {
        let last = pieces(snapshot, 2048)
            .into_iter()
            .filter_map(|piece| add(&mut assembler, piece))
            .last();
        assert!(last.as_ref() == Some(snapshot));
    }
}

#[test]
fn a_corrupted_chunk_is_counted_and_the_sound_one_still_completes() {
    let snapshot = random_snapshot(100, 2, 1, 4);
    let changes: [fn(&mut SplatChunk); 8] = [
        |c| c.data[17] ^= 1,
        |c| c.crc32c ^= 1,
        |c| c.data.truncate(c.data.len() - 1),
        |c| c.data.clear(),
        |c| c.chunk_ix = c.n_chunks,
        |c| c.first_splat = c.n_splats,
        |c| c.sh_degree = 4,
        |c| c.data = vec![0; 2 << 20],
    ];
    for (ix, change) in changes.iter().enumerate() {
        let mut assembler = Assembler::new(MAX_BYTES);
        for piece in pieces(&snapshot, 2048) {
            if let Piece::Chunk(chunk) = &piece {
                let mut bad = chunk.clone();
                change(&mut bad);
                assert!(assembler.add_chunk(bad).is_none());
            }
            let complete = add(&mut assembler, piece);
            assert!(complete.is_none_or(|complete| complete == snapshot));
        }
        let counts = assembler.counts();
        assert!(counts.rejected >= 3, "change {ix}: {counts:?}");
        assert_eq!(counts.abandoned, 0);
    }
}

#[test]
fn a_forged_chunk_with_a_fitting_crc_never_becomes_a_map() {
    let snapshot = random_snapshot(100, 2, 1, 4);
    let sent = pieces(&snapshot, 2048);
    let mut assembler = Assembler::new(MAX_BYTES);
    for piece in sent.clone() {
        let piece = match piece {
            Piece::Chunk(mut chunk) if chunk.chunk_ix == 1 => {
                chunk.data[3] ^= 0x40;
                chunk.crc32c = crc32c::crc32c(&chunk.data);
                Piece::Chunk(chunk)
            }
            other => other,
        };
        assert!(add(&mut assembler, piece).is_none());
    }
    assert_eq!(assembler.counts().rejected, sent.len() as u64);
    // Nothing of it sticks: the same revision completes when it is sent again.
    let again = sent
        .into_iter()
        .filter_map(|piece| add(&mut assembler, piece))
        .last();
    assert!(again == Some(snapshot));
}

#[test]
fn synthetic_counts_and_endless_revisions_stay_within_the_byte_bound() {
    let max_bytes = 1 << 20;
    let mut assembler = Assembler::new(max_bytes);
    let snapshot = random_snapshot(1000, 2, 1, 4);
    let chunk = Messages::new(&snapshot, FRAME, 64 << 10)
        .chunks()
        .next()
        .unwrap();
    for ix in 0..20_000_u32 {
        let forged = SplatChunk {
            n_splats: u32::MAX,
            n_chunks: u32::MAX,
            chunk_ix: ix,
            first_splat: ix,
            revision: if ix % 2 == 0 { ix } else { 5 },
            ..chunk.clone()
        };
        assert!(assembler.add_chunk(forged).is_none());
        let empty = KeyframeArray {
            n_keyframes: u32::MAX,
            first_ix: ix,
            revision: 5,
            ..KeyframeArray::default()
        };
        assert!(assembler.add_keyframes(empty).is_none());
    }
    let counts = assembler.counts();
    // What is neither rejected nor abandoned is held.
    let held = counts.used - counts.abandoned;
    assert!(
        counts.used > 30_000 && held * 128 <= max_bytes as u64,
        "{counts:?}"
    );
}

#[test]
fn payloads_of_noise_are_rejected_one_by_one() {
    let mut dice = Dice(12);
    let mut assembler = Assembler::new(1 << 20);
    let snapshot = random_snapshot(200, 5, 1, 4);
    let messages = Messages::new(&snapshot, FRAME, 4096);
    let good = [
        (
            dds_type_name::<SplatChunk>(),
            map_messages::payload(&messages.chunks().next().unwrap()).unwrap(),
        ),
        (
            dds_type_name::<SplatManifest>(),
            map_messages::payload(&messages.manifest()).unwrap(),
        ),
        (
            dds_type_name::<KeyframeArray>(),
            map_messages::payload(&messages.keyframes().next().unwrap()).unwrap(),
        ),
    ];
    let mut n_sent = 0;
    for round in 0..3000 {
        let (dds_type, payload) = &good[round % 3];
        let mut payload = payload.clone();
        match round % 4 {
            0 => payload.truncate(dice.below(payload.len())),
            1 => (0..8).for_each(|_| payload[dice.below(200) % 60] = dice.roll() as u8),
            2 => payload
                .iter_mut()
                .for_each(|byte| *byte = dice.roll() as u8),
            _ => payload = vec![0xff; dice.below(64)],
        }
        assert!(assembler.add_payload(dds_type, &payload).is_none());
        n_sent += 1;
    }
    assert!(
        assembler
            .add_payload("std_msgs::msg::dds_::String_", &good[0].1)
            .is_none()
    );
    let counts = assembler.counts();
    assert_eq!(
        counts.used + counts.superfluous + counts.rejected,
        n_sent + 1,
        "{counts:?}"
    );
}

#[test]
fn messages_keep_their_size_bounds() {
    let snapshot = random_snapshot(20_000, 5000, 1, 4);
    for chunk_bytes in [1024, 196_608, 262_144, usize::MAX] {
        let messages = Messages::new(&snapshot, FRAME, chunk_bytes);
        for chunk in messages.chunks() {
            assert!(chunk.data.len() <= chunk_bytes.min(512 << 10));
        }
        let largest = messages
            .keyframes()
            .map(|array| map_messages::payload(&array).unwrap().len())
            .max()
            .unwrap();
        assert!(
            largest
                <= chunk_bytes
                    .saturating_add(200)
                    .min(map_messages::MAX_MESSAGE_BYTES),
            "{largest} at {chunk_bytes}"
        );
    }
}

#[test]
fn messages_survive_cdr() {
    let snapshot = random_snapshot(100, 3, 1, 4);
    let messages = Messages::new(&snapshot, FRAME, 4096);
    let chunk = messages.chunks().nth(1).unwrap();
    assert_eq!(
        ros::decode::<SplatChunk>(&map_messages::payload(&chunk).unwrap()).unwrap(),
        chunk
    );
    let array = messages.keyframes().next().unwrap();
    assert_eq!(
        ros::decode::<KeyframeArray>(&map_messages::payload(&array).unwrap()).unwrap(),
        array
    );
    assert_eq!(array.header.frame_id, FRAME);
    // Outside, the centre of the first pixel is 0.
    assert_eq!(array.keyframes[0].cx, snapshot.poses[0].intrinsics.cx - 0.5);
}
