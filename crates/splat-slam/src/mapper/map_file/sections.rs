//! Contents of the sections of a `.splatmap` file <-> bytes. Whatever comes from a file may be arbitrary.

use std::io::{self, Write};

use byteorder::{LittleEndian, ReadBytesExt};
use glam::{DQuat, DVec3};

use crate::mapper::keyframes::image_codec::{Content, SavedView};
use crate::mapper::splats::region_codec::{
    parse_degree, parse_run, region_bytes, region_len, take_region,
};
use crate::mapper::splats::regions::Evicted;
use splat_types::camera::Intrinsics;
use splat_types::map_frame::MapFrame;
use splat_types::snapshot::KeyframePose;
use splat_types::splats::layout;
use splat_types::splats::splats::Splats;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

/// Bytes of one keyframe: id, stamp, quaternion, translation, image size, focal lengths, principal point.
const KEYFRAME_BYTES: usize = 4 + 8 + 4 * 8 + 3 * 8 + 2 * 4 + 4 * 8;
/// Bytes before a view's image: id, flags, length.
const VIEW_HEAD_BYTES: u64 = 12;
const IS_HELD_OUT: u32 = 1;

/// Empty where there is none.
pub(crate) fn map_frame_bytes(frame: Option<MapFrame>) -> Vec<u8> {
    let poses = frame.map(|frame| [frame.world_from_cam, frame.map_from_camera]);
    let numbers = poses.iter().flatten().flat_map(numbers_of);
    numbers.flat_map(f64::to_le_bytes).collect()
}

pub(crate) fn parse_map_frame(mut content: &[u8]) -> Result<Option<MapFrame>, String> {
    if content.is_empty() {
        return Ok(None);
    }
    let found = content.len();
    let (Ok(world_from_cam), Ok(map_from_camera), []) =
        (read_pose(&mut content), read_pose(&mut content), content)
    else {
        return Err(format!("{found} bytes, two poses have 112"));
    };
    let frame = MapFrame {
        world_from_cam,
        map_from_camera,
    };
    if is_sound(&frame.world_from_cam) && is_sound(&frame.map_from_camera) {
        Ok(Some(frame))
    } else {
        Err("its poses are none".to_owned())
    }
}

/// Quaternion from w on, then the translation.
fn numbers_of(pose: &Rigid) -> [f64; 7] {
    let (q, t) = (pose.rotation, pose.translation);
    [q.w, q.x, q.y, q.z, t.x, t.y, t.z]
}

fn read_pose(bytes: &mut &[u8]) -> io::Result<Rigid> {
    let mut numbers = [0.0; 7];
    bytes.read_f64_into::<LittleEndian>(&mut numbers)?;
    let [w, x, y, z, tx, ty, tz] = numbers;
    let rotation = DQuat::from_xyzw(x, y, z, w);
    Ok(Rigid::new(rotation, DVec3::new(tx, ty, tz)))
}

fn is_sound(pose: &Rigid) -> bool {
    pose.is_finite() && (pose.rotation.length() - 1.0).abs() < 1e-6
}

pub(crate) fn keyframe_bytes(poses: &[KeyframePose]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(poses.len() * KEYFRAME_BYTES);
    for pose in poses {
        let k = &pose.intrinsics;
        bytes.extend_from_slice(&pose.keyframe_id.to_le_bytes());
        bytes.extend_from_slice(&pose.stamp.nanos.to_le_bytes());
        for number in numbers_of(&pose.world_from_cam) {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
        bytes.extend_from_slice(&k.width_px.to_le_bytes());
        bytes.extend_from_slice(&k.height_px.to_le_bytes());
        for number in [k.fx, k.fy, k.cx, k.cy] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
    }
    bytes
}

pub(crate) fn parse_keyframes(content: &[u8]) -> Result<Vec<KeyframePose>, String> {
    let (rows, rest) = content.as_chunks::<KEYFRAME_BYTES>();
    if !rest.is_empty() {
        return Err(format!(
            "{} bytes are no whole number of keyframes of {KEYFRAME_BYTES}",
            content.len()
        ));
    }
    let mut poses = Vec::with_capacity(rows.len());
    for row in rows {
        let pose = parse_keyframe(row).map_err(|e| e.to_string())?;
        if !is_sound(&pose.world_from_cam) || !pose.intrinsics.is_plausible() {
            return Err(format!(
                "keyframe {} has no usable pose or intrinsics",
                pose.keyframe_id
            ));
        }
        poses.push(pose);
    }
    Ok(poses)
}

fn parse_keyframe(mut row: &[u8]) -> io::Result<KeyframePose> {
    let keyframe_id = row.read_u32::<LittleEndian>()?;
    let stamp = Stamp::from_nanos(row.read_i64::<LittleEndian>()?);
    let world_from_cam = read_pose(&mut row)?;
    let (width_px, height_px) = (
        row.read_u32::<LittleEndian>()?,
        row.read_u32::<LittleEndian>()?,
    );
    let mut numbers = [0.0; 4];
    row.read_f64_into::<LittleEndian>(&mut numbers)?;
    let [fx, fy, cx, cy] = numbers;
    Ok(KeyframePose {
        keyframe_id,
        stamp,
        world_from_cam,
        intrinsics: Intrinsics {
            width_px,
            height_px,
            fx,
            fy,
            cx,
            cy,
        },
    })
}

pub(crate) fn splat_bytes(splats: &Splats) -> Vec<u8> {
    let mut bytes =
        Vec::with_capacity(4 + splats.len() * layout::bytes_per_splat(splats.sh_degree));
    bytes.extend_from_slice(&u32::from(splats.sh_degree).to_le_bytes());
    layout::encode(splats, 0..splats.len(), &mut bytes);
    bytes
}

pub(crate) fn parse_splats(content: &[u8]) -> Result<Splats, String> {
    let (head, run) = content.split_first_chunk::<4>().ok_or("no SH degree")?;
    parse_run(parse_degree(u32::from_le_bytes(*head))?, run)
}

/// Images of keyframes, at most so many bytes: where all would take more, they are taken evenly.
pub(crate) fn view_bytes(views: &[SavedView], max_bytes: u64) -> io::Result<Vec<u8>> {
    let mut chosen: Vec<(usize, Vec<u8>)> = Vec::new();
    let mut n_bytes = 0;
    for ix in evenly(views.len()) {
        let packed = views[ix].packed()?;
        n_bytes += VIEW_HEAD_BYTES + packed.len() as u64;
        if n_bytes > max_bytes {
            break;
        }
        chosen.push((ix, packed));
    }
    chosen.sort_by_key(|(ix, _)| *ix);
    let mut bytes = Vec::new();
    for (ix, packed) in chosen {
        let view = &views[ix];
        let flags = if view.is_held_out { IS_HELD_OUT } else { 0 };
        for word in [view.keyframe_id, flags, packed.len() as u32] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        bytes.extend_from_slice(&packed);
    }
    Ok(bytes)
}

/// The numbers below `n` so that any first few lie evenly among all: by their bits in reverse.
fn evenly(n: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by_key(|ix| ix.reverse_bits());
    order
}

pub(crate) fn parse_views(content: &[u8]) -> Result<Vec<SavedView>, String> {
    let mut rest = content;
    let mut views = Vec::new();
    while !rest.is_empty() {
        let mut word = || rest.read_u32::<LittleEndian>().map_err(|e| e.to_string());
        let (keyframe_id, flags, n_bytes) = (word()?, word()?, word()? as usize);
        let (packed, after) = rest
            .split_at_checked(n_bytes)
            .ok_or_else(|| format!("the image of keyframe {keyframe_id} is cut off"))?;
        rest = after;
        views.push(SavedView {
            keyframe_id,
            is_held_out: flags & IS_HELD_OUT != 0,
            content: Content::Packed(packed.to_vec().into()),
        });
    }
    Ok(views)
}

/// Bytes of all parts together.
pub(crate) fn regions_len(regions: &[Evicted]) -> u64 {
    let of = |region: &Evicted| region_len(region.n_splats, region.sh_degree) as u64;
    regions.iter().map(of).sum()
}

/// One part after the other, each only as long in memory as it is written.
pub(crate) fn write_regions(regions: &[Evicted], file: &mut dyn Write) -> io::Result<()> {
    for region in regions {
        let (splats, update_counts) = region.splats()?;
        file.write_all(&region_bytes(&splats, &update_counts))?;
    }
    Ok(())
}

pub(crate) fn parse_regions(mut content: &[u8]) -> Result<Vec<(Splats, Vec<u16>)>, String> {
    let mut regions = Vec::new();
    while !content.is_empty() {
        regions.push(take_region(&mut content)?);
    }
    Ok(regions)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_few_of_many_lie_evenly() {
        assert_eq!(evenly(8)[..4], [0, 4, 2, 6]);
        let mut first: Vec<usize> = evenly(100)[..10].to_vec();
        first.sort_unstable();
        let widest = first.windows(2).map(|two| two[1] - two[0]).max();
        assert!(widest < Some(30), "{first:?}");
        assert!(evenly(0).is_empty());
    }
}
