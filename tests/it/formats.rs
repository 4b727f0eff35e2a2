//! Map files: what is written reads back, what is damaged is an error.

use std::io::{Seek, SeekFrom, Write};
use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec3};

use splat_mapper::node::save_map::{MapFile, save_map};
use splat_slam::mapper::map_file::checkpoint::{self, Checkpoint, CheckpointError};
use splat_types::camera::Intrinsics;
use splat_types::map_frame::MapFrame;
use splat_types::snapshot::{KeyframePose, Scale, Snapshot};
use splat_types::splats::ply;
use splat_types::splats::splats::Splats;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// xorshift64*; tests need variety, not quality.
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    pub(crate) fn roll(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    pub(crate) fn below(&mut self, end: usize) -> usize {
        (self.roll() >> 11) as usize % end
    }

    fn number(&mut self) -> f32 {
        (self.roll() >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

pub(crate) fn random_splats(n: usize, sh_degree: u8, seed: u64) -> Splats {
    let mut dice = Dice(seed + 1);
    let sh_stride = 3 * (usize::from(sh_degree) + 1).pow(2);
    Splats {
        means: (0..n)
            .map(|_| [0; 3].map(|_| 10.0 * dice.number()))
            .collect(),
        log_scales: (0..n)
            .map(|_| [0; 3].map(|_| dice.number() - 4.0))
            .collect(),
        quats: (0..n).map(|_| [0; 4].map(|_| dice.number())).collect(),
        opacity_logits: (0..n).map(|_| 5.0 * dice.number()).collect(),
        sh: (0..n * sh_stride).map(|_| dice.number()).collect(),
        sh_degree,
        anchors: (0..n).map(|_| dice.below(40) as u32).collect(),
    }
}

pub(crate) fn random_snapshot(
    n_splats: usize,
    n_keyframes: usize,
    sh_degree: u8,
    revision: u32,
) -> Snapshot {
    let mut dice = Dice(u64::from(revision) + 77);
    let mut number = move || f64::from(dice.number());
    let poses = (0..n_keyframes).map(|ix| KeyframePose {
        keyframe_id: 3 * ix as u32,
        stamp: Stamp::from_nanos(1_700_000_000_123_456_789 + 100_000_000 * ix as i64),
        world_from_cam: Rigid::new(
            DQuat::from_xyzw(number(), number(), number(), 1.0).normalize(),
            DVec3::new(number(), number(), number()),
        ),
        intrinsics: Intrinsics {
            width_px: 640,
            height_px: 480,
            fx: 500.0 + number(),
            fy: 500.0 + number(),
            cx: 320.0 + number(),
            cy: 240.0 + number(),
        },
    });
    let poses: Vec<KeyframePose> = poses.collect();
    Snapshot {
        map_id: *b"map of the tests",
        epoch: 2,
        revision,
        stamp: poses.last().map_or(Stamp::default(), |pose| pose.stamp),
        scale: Scale::GIVEN,
        poses,
        splats: Arc::new(random_splats(n_splats, sh_degree, u64::from(revision))),
        splat_ids: Arc::new((0..n_splats as u32).collect()),
    }
}

fn checkpoint(n_splats: usize, sh_degree: u8) -> Checkpoint {
    Checkpoint {
        landmarks: vec![7; 33],
        update_counts: (0..n_splats as u16).collect(),
        map_frame: Some(MapFrame {
            world_from_cam: Rigid::new(DQuat::from_rotation_x(0.3), DVec3::new(1.0, -2.0, 0.5)),
            map_from_camera: Rigid::new(DQuat::from_rotation_z(-0.7), DVec3::new(0.0, 3.0, 1.2)),
        }),
        ..Checkpoint::of(random_snapshot(n_splats, 5, sh_degree, 9), 11, 3000)
    }
}

fn read_bytes(folder: &Path, bytes: &[u8]) -> Result<Checkpoint, CheckpointError> {
    let path = folder.join("damaged.splatmap");
    std::fs::write(&path, bytes).unwrap();
    checkpoint::read(&path)
}

#[test]
fn a_checkpoint_reads_back_equal_for_every_sh_degree() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.splatmap");
    for (n_splats, sh_degree) in [(0, 0), (1, 0), (300, 1), (50, 2), (50, 3)] {
        let written = checkpoint(n_splats, sh_degree);
        save_map(MapFile::Checkpoint(&written), &path).unwrap();
        let back = checkpoint::read(&path).unwrap();
        assert!(
            back.snapshot == written.snapshot,
            "{n_splats} splats of degree {sh_degree}"
        );
        assert_eq!((back.seed, back.steps), (11, 3000));
        assert_eq!(back.landmarks, written.landmarks);
        assert_eq!(back.update_counts, written.update_counts);
        assert_eq!(back.map_frame, written.map_frame);
    }
    // Older files have no such section, and a map of a run that published nothing an empty one.
    let written = Checkpoint {
        map_frame: None,
        ..checkpoint(10, 0)
    };
    save_map(MapFile::Checkpoint(&written), &path).unwrap();
    assert_eq!(checkpoint::read(&path).unwrap().map_frame, None);
    let broken = Checkpoint {
        map_frame: Some(MapFrame {
            world_from_cam: Rigid::IDENTITY,
            map_from_camera: Rigid::new(DQuat::IDENTITY, DVec3::NAN),
        }),
        ..checkpoint(10, 0)
    };
    save_map(MapFile::Checkpoint(&broken), &path).unwrap();
    let refused = checkpoint::read(&path).unwrap_err().to_string();
    assert!(refused.contains("MFRM"), "{refused}");
}

#[test]
fn a_checkpoint_cut_anywhere_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.splatmap");
    save_map(MapFile::Checkpoint(&checkpoint(200, 1)), &path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let mut boundaries = vec![0, 8, 12, 16, 20];
    let mut end = 20;
    while end < bytes.len() {
        let n = u64::from_le_bytes(bytes[end + 4..end + 12].try_into().unwrap()) as usize;
        boundaries.extend([end + 4, end + 12, end + 12 + n, end + 16 + n]);
        end += 16 + n;
    }
    assert_eq!(boundaries.pop(), Some(bytes.len()));
    assert_eq!(boundaries.len(), 5 + 4 * 8 - 1);
    let mut dice = Dice(5);
    boundaries.extend((0..200).map(|_| dice.below(bytes.len())));
    for cut in boundaries {
        // Without the map itself, which fills screens when this fails.
        let fault = read_bytes(folder.path(), &bytes[..cut])
            .map(|_| "half a map was read")
            .unwrap_err();
        assert!(
            matches!(fault, CheckpointError::Damaged { .. }),
            "cut at {cut}: {fault}"
        );
    }
    assert!(read_bytes(folder.path(), &[&bytes[..], &[0]].concat()).is_err());
}

#[test]
fn a_flipped_bit_anywhere_in_a_checkpoint_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.splatmap");
    save_map(MapFile::Checkpoint(&checkpoint(10, 0)), &path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let mut file = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
    // Whole files written anew 2600 times would take ten seconds of disk.
    let mut put = |ix: usize, byte: u8| {
        file.seek(SeekFrom::Start(ix as u64)).unwrap();
        file.write_all(&[byte]).unwrap();
    };
    let mut dice = Dice(6);
    let headers = 0..200 * 8;
    for bit in headers.chain((0..1000).map(|_| dice.below(8 * bytes.len()))) {
        put(bit / 8, bytes[bit / 8] ^ 1 << (bit % 8));
        assert!(checkpoint::read(&path).is_err(), "bit {bit} is not missed");
        put(bit / 8, bytes[bit / 8]);
    }
    checkpoint::read(&path).unwrap();
}

#[test]
fn lengths_that_a_checkpoint_makes_up_ask_for_no_memory() {
    let folder = tempfile::tempdir().unwrap();
    for length in [1_000_000_000_u64, u64::MAX, u64::MAX - 15, 1 << 40] {
        let mut bytes = b"SPLATMAP".to_vec();
        bytes.extend([1_u32, 1].map(u32::to_le_bytes).as_flattened());
        bytes.extend(crc32c::crc32c(&bytes).to_le_bytes());
        bytes.extend(b"SPLT");
        bytes.extend(length.to_le_bytes());
        bytes.extend([0; 100]);
        let fault = read_bytes(folder.path(), &bytes).unwrap_err().to_string();
        assert!(fault.contains(&length.to_string()), "{fault}");
    }
}

#[test]
fn a_checkpoint_of_a_later_version_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = b"SPLATMAP".to_vec();
    bytes.extend([2_u32, 0].map(u32::to_le_bytes).as_flattened());
    bytes.extend(crc32c::crc32c(&bytes).to_le_bytes());
    let fault = read_bytes(folder.path(), &bytes).unwrap_err().to_string();
    assert!(fault.contains("version 2"), "{fault}");
    let fault = read_bytes(folder.path(), b"ply\nformat binary_little_endian 1.0\n")
        .unwrap_err()
        .to_string();
    assert!(fault.contains("no .splatmap"), "{fault}");
}

#[test]
fn a_section_of_the_future_is_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.splatmap");
    let written = checkpoint(20, 1);
    save_map(MapFile::Checkpoint(&written), &path).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[12] += 1;
    let crc = crc32c::crc32c(&bytes[..16]).to_le_bytes();
    bytes[16..20].copy_from_slice(&crc);
    let section = [
        b"NEXT".to_vec(),
        3_u64.to_le_bytes().to_vec(),
        b"abc".to_vec(),
    ]
    .concat();
    bytes.extend(&section);
    bytes.extend(crc32c::crc32c(&section).to_le_bytes());
    assert!(read_bytes(folder.path(), &bytes).unwrap().snapshot == written.snapshot);
}

#[test]
fn a_number_that_is_not_finite_stays_out_although_the_checksums_fit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.splatmap");
    let mut bad = checkpoint(20, 1);
    Arc::make_mut(&mut bad.snapshot.splats).means[7][1] = f32::NAN;
    save_map(MapFile::Checkpoint(&bad), &path).unwrap();
    let fault = checkpoint::read(&path).unwrap_err().to_string();
    assert!(fault.contains("means of splat 7 is NaN"), "{fault}");
}

#[test]
fn a_ply_reads_back_equal_for_every_sh_degree() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.ply");
    for (n_splats, sh_degree) in [(0, 0), (1, 3), (1500, 0), (1024, 1), (1025, 2), (300, 3)] {
        let mut splats = random_splats(n_splats, sh_degree, 4);
        save_map(MapFile::Ply(&splats), &path).unwrap();
        let back = ply::read(&path).unwrap();
        splats.anchors.fill(0);
        assert!(back == splats, "{n_splats} splats of degree {sh_degree}");
    }
}

#[test]
fn a_ply_has_the_header_and_row_that_viewers_expect() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.ply");
    let sh: Vec<f32> = (0..12).map(|ix| ix as f32).collect();
    let splats = Splats {
        means: vec![[100.0, 101.0, 102.0]],
        log_scales: vec![[-1.0, -2.0, -3.0]],
        quats: vec![[0.5, 0.25, 0.125, 0.0625]],
        opacity_logits: vec![7.5],
        sh,
        sh_degree: 1,
        anchors: vec![3],
    };
    save_map(MapFile::Ply(&splats), &path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\n\
        property float x\nproperty float y\nproperty float z\n\
        property float nx\nproperty float ny\nproperty float nz\n\
        property float f_dc_0\nproperty float f_dc_1\nproperty float f_dc_2\n\
        property float f_rest_0\nproperty float f_rest_1\nproperty float f_rest_2\n\
        property float f_rest_3\nproperty float f_rest_4\nproperty float f_rest_5\n\
        property float f_rest_6\nproperty float f_rest_7\nproperty float f_rest_8\n\
        property float opacity\nproperty float scale_0\nproperty float scale_1\nproperty float scale_2\n\
        property float rot_0\nproperty float rot_1\nproperty float rot_2\nproperty float rot_3\nend_header\n";
    assert_eq!(std::str::from_utf8(&bytes[..header.len()]).unwrap(), header);
    let row: Vec<f32> = bytes[header.len()..]
        .chunks(4)
        .map(|word| f32::from_le_bytes(word.try_into().unwrap()))
        .collect();
    // Red of the three coefficients, then green, then blue.
    let expected = [
        100.0, 101.0, 102.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 6.0, 9.0, 4.0, 7.0, 10.0, 5.0, 8.0,
        11.0, 7.5, -1.0, -2.0, -3.0, 0.5, 0.25, 0.125, 0.0625,
    ];
    assert_eq!(row, expected);
}

#[test]
fn a_ply_of_another_program_reads_with_its_own_order_and_extras() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("other.ply");
    let names = "rot_0 rot_1 rot_2 rot_3 confidence opacity scale_2 scale_1 scale_0 f_dc_2 f_dc_1 f_dc_0 z y x";
    let mut text =
        "ply\r\ncomment made elsewhere\nformat binary_little_endian 1.0\nelement vertex 2\n"
            .to_owned();
    names
        .split(' ')
        .for_each(|name| text.push_str(&format!("property float32 {name}\n")));
    text.push_str("element face 0\nproperty list uchar int vertex_indices\nend_header\n");
    let mut bytes = text.into_bytes();
    (0..30).for_each(|ix| bytes.extend((ix as f32).to_le_bytes()));
    std::fs::write(&path, &bytes).unwrap();
    let splats = ply::read(&path).unwrap();
    assert_eq!(splats.means, [[14.0, 13.0, 12.0], [29.0, 28.0, 27.0]]);
    assert_eq!(splats.log_scales[1], [23.0, 22.0, 21.0]);
    assert_eq!(splats.quats[1], [15.0, 16.0, 17.0, 18.0]);
    assert_eq!(
        (splats.opacity_logits[0], &splats.sh[..3]),
        (5.0, &[11.0, 10.0, 9.0][..])
    );
}

#[test]
fn a_hostile_ply_is_an_error_that_says_why() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("hostile.ply");
    save_map(MapFile::Ply(&random_splats(4, 0, 1)), &path).unwrap();
    let good = std::fs::read(&path).unwrap();
    let header_end = good.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8(good[..header_end].to_vec()).unwrap();
    let check = |bytes: &[u8], says: &str| {
        std::fs::write(&path, bytes).unwrap();
        let fault = ply::read(&path).unwrap_err().to_string();
        assert!(fault.contains(says), "{says:?} is not in: {fault}");
    };
    let with_header =
        |from: &str, to: &str| [header.replace(from, to).as_bytes(), &good[header_end..]].concat();
    check(b"", "end_header");
    check(b"glTF....", "end_header");
    check(b"solid cube\n", "begins with");
    check(&vec![b'a'; 1 << 20], "first 65536 bytes");
    check(
        &[b"ply\n".to_vec(), vec![b'\n'; 1 << 20]].concat(),
        "first 65536 bytes",
    );
    check(&with_header("vertex 4", "vertex 5"), "promises 5 vertices");
    check(
        &with_header("vertex 4", "vertex 18446744073709551615"),
        "promises",
    );
    check(
        &with_header("vertex 4", "vertex 18446744073709551616"),
        "counts nothing",
    );
    check(&with_header("vertex 4", "vertex -4"), "counts nothing");
    check(
        &with_header("binary_little_endian", "ascii"),
        "binary_little_endian",
    );
    check(
        &with_header("float opacity", "double opacity"),
        "not of type float",
    );
    check(
        &with_header("float rot_3", "float rot_4"),
        "no property rot_3",
    );
    check(
        &with_header(
            "property float x\n",
            "property float x\nproperty float f_rest_0\n",
        ),
        "expected 0, 9, 24 or 45",
    );
    check(
        &with_header("element vertex", "element face 3\nelement vertex"),
        "before the vertices",
    );
    check(&good[..good.len() - 1], "promises 4 vertices");
    let mut nan = good.clone();
    nan[header_end..header_end + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    check(&nan, "means of splat 0 is NaN");
}
