//! Contents of the sections of a `.splatmap` file <-> bytes. Whatever comes from a file may be made up.

use std::io::{self, Write};

use byteorder::{LittleEndian, ReadBytesExt};
use glam::{DQuat, DVec3};

use crate::camera::Intrinsics;
use crate::clock::Stamp;
use crate::map::layout;
use crate::map::regions::Evicted;
use crate::map::saved_view::{Content, SavedView};
use crate::map::snapshot::KeyframePose;
use crate::pose::Rigid;
use crate::splat::Splats;

/// Bytes of one keyframe: id, stamp, quaternion, translation, picture size, focal lengths, principal point.
const KEYFRAME_BYTES: usize = 4 + 8 + 4 * 8 + 3 * 8 + 2 * 4 + 4 * 8;
/// Bytes before a view's picture: id, flags, length.
const VIEW_HEAD_BYTES: u64 = 12;
const IS_HELD_OUT: u32 = 1;

pub(super) fn keyframe_bytes(poses: &[KeyframePose]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(poses.len() * KEYFRAME_BYTES);
    for pose in poses {
        let (q, t, k) = (
            pose.map_from_cam.rotation,
            pose.map_from_cam.translation,
            &pose.intrinsics,
        );
        bytes.extend_from_slice(&pose.keyframe_id.to_le_bytes());
        bytes.extend_from_slice(&pose.stamp.nanos.to_le_bytes());
        for number in [q.w, q.x, q.y, q.z, t.x, t.y, t.z] {
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

pub(super) fn parse_keyframes(content: &[u8]) -> Result<Vec<KeyframePose>, String> {
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
        let lengths_fit = (pose.map_from_cam.rotation.length() - 1.0).abs() < 1e-6;
        if !pose.map_from_cam.is_finite() || !lengths_fit || !pose.intrinsics.is_plausible() {
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
    let mut numbers = [0.0; 7];
    row.read_f64_into::<LittleEndian>(&mut numbers)?;
    let [w, x, y, z, tx, ty, tz] = numbers;
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
        map_from_cam: Rigid::new(DQuat::from_xyzw(x, y, z, w), DVec3::new(tx, ty, tz)),
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

pub(super) fn splat_bytes(splats: &Splats) -> Vec<u8> {
    let mut bytes =
        Vec::with_capacity(4 + splats.len() * layout::bytes_per_splat(splats.sh_degree));
    bytes.extend_from_slice(&u32::from(splats.sh_degree).to_le_bytes());
    layout::encode(splats, 0..splats.len(), &mut bytes);
    bytes
}

pub(super) fn parse_splats(content: &[u8]) -> Result<Splats, String> {
    let (head, run) = content.split_first_chunk::<4>().ok_or("no SH degree")?;
    parse_run(parse_degree(u32::from_le_bytes(*head))?, run)
}

fn parse_degree(word: u32) -> Result<u8, String> {
    u8::try_from(word)
        .ok()
        .filter(|degree| *degree <= layout::MAX_SH_DEGREE)
        .ok_or_else(|| format!("SH degree {word}, expected 0 to {}", layout::MAX_SH_DEGREE))
}

fn parse_run(sh_degree: u8, run: &[u8]) -> Result<Splats, String> {
    let mut splats = Splats {
        sh_degree,
        ..Splats::default()
    };
    layout::decode(run, &mut splats)
        .ok_or_else(|| format!("{} bytes are no whole number of splats", run.len()))?;
    layout::fault(&splats).map_or(Ok(splats), Err)
}

/// Of the splats in their order.
pub(super) fn age_bytes(ages: &[u16]) -> Vec<u8> {
    ages.iter().flat_map(|age| age.to_le_bytes()).collect()
}

pub(super) fn parse_ages(content: &[u8]) -> Result<Vec<u16>, String> {
    let (ages, rest) = content.as_chunks::<2>();
    if !rest.is_empty() {
        return Err(format!(
            "{} bytes are no whole number of ages",
            content.len()
        ));
    }
    Ok(ages.iter().map(|age| u16::from_le_bytes(*age)).collect())
}

/// Pictures of keyframes, at most so many bytes: where all would take more, they are taken evenly.
pub(super) fn view_bytes(views: &[SavedView], max_bytes: u64) -> io::Result<Vec<u8>> {
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

pub(super) fn parse_views(content: &[u8]) -> Result<Vec<SavedView>, String> {
    let mut rest = content;
    let mut views = Vec::new();
    while !rest.is_empty() {
        let mut word = || rest.read_u32::<LittleEndian>().map_err(|e| e.to_string());
        let (keyframe_id, flags, n_bytes) = (word()?, word()?, word()? as usize);
        let (packed, after) = rest
            .split_at_checked(n_bytes)
            .ok_or_else(|| format!("the picture of keyframe {keyframe_id} is cut off"))?;
        rest = after;
        views.push(SavedView {
            keyframe_id,
            is_held_out: flags & IS_HELD_OUT != 0,
            content: Content::Packed(packed.to_vec().into()),
        });
    }
    Ok(views)
}

/// Splats of a part of the map, with their ages.
pub(super) fn region_bytes(splats: &Splats, ages: &[u16]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(region_len(splats.len(), splats.sh_degree));
    bytes.extend_from_slice(&u32::from(splats.sh_degree).to_le_bytes());
    bytes.extend_from_slice(&(splats.len() as u32).to_le_bytes());
    let age = |ix: usize| ages.get(ix).copied().unwrap_or(0);
    bytes.extend((0..splats.len()).flat_map(|ix| age(ix).to_le_bytes()));
    layout::encode(splats, 0..splats.len(), &mut bytes);
    bytes
}

fn region_len(n: usize, sh_degree: u8) -> usize {
    8 + n * (2 + layout::bytes_per_splat(sh_degree))
}

/// Takes one part off the front.
pub(super) fn take_region(rest: &mut &[u8]) -> Result<(Splats, Vec<u16>), String> {
    let mut word = || rest.read_u32::<LittleEndian>().map_err(|e| e.to_string());
    let (sh_degree, n) = (word()?, word()? as usize);
    let sh_degree = parse_degree(sh_degree)?;
    let (ages, after) = rest
        .split_at_checked(2 * n)
        .ok_or_else(|| format!("{n} splats are announced, the section ends"))?;
    let (run, after) = after
        .split_at_checked(n * layout::bytes_per_splat(sh_degree))
        .ok_or_else(|| format!("{n} splats are announced, the section ends"))?;
    *rest = after;
    Ok((parse_run(sh_degree, run)?, parse_ages(ages)?))
}

/// Bytes of all parts together.
pub(super) fn regions_len(regions: &[Evicted]) -> u64 {
    let of = |region: &Evicted| region_len(region.n_splats, region.sh_degree) as u64;
    regions.iter().map(of).sum()
}

/// One part after the other, each only as long in memory as it is written.
pub(super) fn write_regions(regions: &[Evicted], file: &mut dyn Write) -> io::Result<()> {
    for region in regions {
        let (splats, ages) = region.splats()?;
        file.write_all(&region_bytes(&splats, &ages))?;
    }
    Ok(())
}

pub(super) fn parse_regions(mut content: &[u8]) -> Result<Vec<(Splats, Vec<u16>)>, String> {
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
