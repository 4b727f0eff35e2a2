//! The volume and the splats near a place -> what planners in three dimensions keep clear of: ellipsoids, occupied voxels.

use glam::{DVec3, IVec3};

use crate::shared_volume::SharedVolume;
use crate::transport::{Delivery, Topic};
use splat_msgs::ellipsoid_message::EllipsoidArray;
use splat_msgs::ros::Header;
use splat_msgs::ros::standard::{PointCloud2, PointField};
use splat_types::snapshot::Snapshot;
use splat_volume::blocks::SIDE;
use splat_volume::ellipsoids::{
    K_SIGMA, MIN_OBSERVATIONS, MIN_OPACITY, Region, ellipsoids, keep_nearest,
};
use splat_volume::voxels::State;

pub static ELLIPSOIDS: Topic =
    Topic::of::<EllipsoidArray>("ellipsoids", Delivery::Latched { depth: 1 });
pub static VOXELS: Topic = Topic::of::<PointCloud2>("voxels", Delivery::Latched { depth: 1 });
pub static TOPICS: [&Topic; 2] = [&ELLIPSOIDS, &VOXELS];

/// Of one message: 640 kB.
pub(crate) const MAX_ELLIPSOIDS: usize = 10_000;
/// Of one message: 960 kB.
const MAX_VOXELS: usize = 80_000;

/// Ellipsoids of the splats in a region, at most `n`, the nearest to its middle.
pub(crate) fn ellipsoid_array(
    volume: &SharedVolume,
    snapshot: &Snapshot,
    region: &Region,
    n: usize,
) -> EllipsoidArray {
    let (splats, ids) = (&snapshot.splats, &snapshot.splat_ids);
    let mut found = ellipsoids(
        &volume.scene(),
        splats,
        ids,
        &volume.level_from_world,
        region,
    );
    let left_out = keep_nearest(&mut found, region.middle(), n.min(MAX_ELLIPSOIDS));
    let triples = |of: fn(&splat_volume::ellipsoids::Ellipsoid) -> DVec3| {
        let values = found.iter().map(of);
        values.flat_map(|v| v.as_vec3().to_array()).collect()
    };
    EllipsoidArray {
        header: Header::new(snapshot.stamp, &volume.frames.level),
        map_id: snapshot.map_id,
        epoch: snapshot.epoch,
        revision: snapshot.revision,
        k_sigma: K_SIGMA as f32,
        min_opacity: MIN_OPACITY as f32,
        min_observations: MIN_OBSERVATIONS,
        low: region.low.as_vec3().to_array(),
        high: region.high.as_vec3().to_array(),
        n_left_out: left_out.n as u32,
        complete_within: left_out.from as f32,
        ids: found.iter().map(|e| e.splat_id).collect(),
        means: triples(|e| e.mean),
        rotations: found
            .iter()
            .flat_map(|e| e.rotation.as_quat().to_array())
            .collect(),
        semi_axes: triples(|e| e.semi_axes),
        opacities: found.iter().map(|e| e.opacity as f32).collect(),
        observations: found.iter().map(|e| e.observations).collect(),
        last_keyframes: found.iter().map(|e| e.last_keyframe).collect(),
        position_sigmas: found.iter().map(|e| e.position_sigma as f32).collect(),
    }
}

/// Middles of voxels that a surface goes through, in a region: of too many those nearest to its middle.
pub(crate) fn voxel_cloud(volume: &SharedVolume, region: &Region, header: Header) -> PointCloud2 {
    let voxels = &volume.voxels;
    let mut middles: Vec<DVec3> = Vec::new();
    for block in voxels.indices_in(region.low, region.high, 0) {
        let Some(view) = voxels.block(block) else {
            continue;
        };
        for (x, y) in (0..SIDE).flat_map(|x| (0..SIDE).map(move |y| (x, y))) {
            let states = view.states(x, y).into_iter();
            let surface = states.enumerate().filter(|(_, s)| *s == State::Surface);
            middles.extend(surface.map(|(z, _)| {
                let at = block * SIDE + IVec3::new(x, y, z as i32);
                (at.as_dvec3() + 0.5) * voxels.size
            }));
        }
    }
    if middles.len() > MAX_VOXELS {
        let distance = |p: &DVec3| p.distance_squared(region.middle());
        middles.select_nth_unstable_by(MAX_VOXELS, |a, b| distance(a).total_cmp(&distance(b)));
        middles.truncate(MAX_VOXELS);
    }
    points(header, &middles)
}

fn points(header: Header, middles: &[DVec3]) -> PointCloud2 {
    let names = ["x", "y", "z"].iter().enumerate();
    let fields = names.map(|(i, name)| PointField {
        name: (*name).to_owned(),
        offset: 4 * i as u32,
        datatype: PointField::FLOAT32,
        count: 1,
    });
    let data: Vec<u8> = middles
        .iter()
        .flat_map(|p| p.as_vec3().to_array())
        .flat_map(f32::to_le_bytes)
        .collect();
    PointCloud2 {
        header,
        height: 1,
        width: middles.len() as u32,
        fields: fields.collect(),
        is_bigendian: false,
        point_step: 12,
        row_step: data.len() as u32,
        data,
        is_dense: true,
    }
}
