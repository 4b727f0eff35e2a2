//! Questions for a box of the volume -> answers: distances at all voxels, ellipsoids of splats, the mesh.

use glam::{DVec3, IVec3};
use serde::{Deserialize, Serialize};

use crate::distances::{GetDistancesResponse, max_distance, no_volume};
use crate::obstacles::{MAX_ELLIPSOIDS, ellipsoid_array};
use crate::shared_volume::SharedVolume;
use splat_msgs::ellipsoid_message::EllipsoidArray;
use splat_types::snapshot::Snapshot;
use splat_volume::ellipsoids::Region;
use splat_volume::field::box_distances;
use splat_volume::mesh::mesh_in;
use splat_volume::mesh_colour::colours;

/// 1 MB of distances and whether they are known.
const MAX_VOXELS: f64 = 200_000.0;
/// Just under a megabyte with their triangles, about two a vertex.
const MAX_VERTICES: usize = 25_000;
/// Of a box for a mesh: larger ones hold more than that anyhow, metres.
const MAX_MESH_SIDE: f64 = 50.0;

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GetDistanceBoxRequest {
    pub frame_id: String,
    pub low: [f32; 3],
    pub high: [f32; 3],
    pub max_distance: f32,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GetDistanceBoxResponse {
    pub success: bool,
    pub message: String,
    pub frame_id: String,
    pub epoch: u32,
    pub revision: u32,
    pub resolution: f32,
    pub origin: [f32; 3],
    pub size: [u32; 3],
    pub distances: Vec<f32>,
    pub known: Vec<bool>,
}

/// Of ellipsoids and of the mesh.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct BoxRequest {
    pub frame_id: String,
    pub low: [f32; 3],
    pub high: [f32; 3],
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GetEllipsoidsResponse {
    pub success: bool,
    pub message: String,
    pub ellipsoids: EllipsoidArray,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct GetMeshResponse {
    pub success: bool,
    pub message: String,
    pub frame_id: String,
    pub epoch: u32,
    pub revision: u32,
    pub vertices: Vec<f32>,
    pub colors: Vec<u8>,
    pub triangles: Vec<u32>,
}

/// An answer that is none.
pub(crate) trait Refused: Serialize {
    fn refused(message: String) -> Self;
}

macro_rules! refused {
    ($($response:ty),*) => {$(
        impl Refused for $response {
            fn refused(message: String) -> Self {
                Self { message, ..Self::default() }
            }
        }
    )*};
}

refused!(
    GetDistancesResponse,
    GetDistanceBoxResponse,
    GetEllipsoidsResponse,
    GetMeshResponse
);

/// `Err`: why not, as with the others here.
pub(crate) fn distance_box(
    volume: Option<&SharedVolume>,
    asked: &GetDistanceBoxRequest,
) -> Result<GetDistanceBoxResponse, String> {
    let volume = volume.ok_or_else(no_volume)?;
    let region = volume.region(&asked.frame_id, asked.low, asked.high)?;
    let max = max_distance(asked.max_distance)?;
    let voxel = volume.voxels.size;
    // Voxels whose middle is within.
    let low = (region.low / voxel - 0.5).ceil();
    let sides = ((region.high / voxel - 0.5).floor() - low + 1.0).max(DVec3::ZERO);
    let n = sides.x * sides.y * sides.z;
    if n > MAX_VOXELS {
        return Err(format!(
            "{n} voxels of {voxel} m, at most {MAX_VOXELS}: ask for smaller boxes"
        ));
    }
    if low.abs().max_element() > f64::from(i32::MAX / 4) {
        return Err(format!(
            "a box at {} is beyond all that a map can hold",
            region.low
        ));
    }
    let size = if n > 0.0 {
        sides.as_ivec3()
    } else {
        IVec3::ZERO
    };
    let found = box_distances(&volume.voxels, low.as_ivec3(), size, max);
    let found = found.map_err(|e| e.to_string())?;
    Ok(GetDistanceBoxResponse {
        success: true,
        message: String::new(),
        frame_id: volume.frames.level.clone(),
        epoch: volume.epoch,
        revision: volume.revision,
        resolution: voxel as f32,
        origin: ((low + 0.5) * voxel).as_vec3().to_array(),
        size: size.as_uvec3().to_array(),
        distances: found.iter().map(|d| d.metres as f32).collect(),
        known: found.iter().map(|d| d.is_known).collect(),
    })
}

pub(crate) fn ellipsoids(
    volume: Option<&SharedVolume>,
    snapshot: Option<&Snapshot>,
    asked: &BoxRequest,
) -> Result<GetEllipsoidsResponse, String> {
    let (volume, snapshot) = both(volume, snapshot)?;
    let region = volume.region(&asked.frame_id, asked.low, asked.high)?;
    Ok(GetEllipsoidsResponse {
        success: true,
        message: String::new(),
        ellipsoids: ellipsoid_array(volume, snapshot, &region, MAX_ELLIPSOIDS),
    })
}

pub(crate) fn mesh(
    volume: Option<&SharedVolume>,
    snapshot: Option<&Snapshot>,
    asked: &BoxRequest,
) -> Result<GetMeshResponse, String> {
    let (volume, snapshot) = both(volume, snapshot)?;
    let Region { low, high } = volume.region(&asked.frame_id, asked.low, asked.high)?;
    if (high - low).max_element() > MAX_MESH_SIDE {
        return Err(format!(
            "a box of {} m, sides of at most {MAX_MESH_SIDE} m are answered; export MAP out.mesh.ply writes all",
            high - low
        ));
    }
    let mesh = mesh_in(&volume.voxels, low, high);
    let n = mesh.vertices.len().max(mesh.triangles.len().div_ceil(2));
    if n > MAX_VERTICES {
        return Err(format!(
            "a mesh of {n} vertices, at most {MAX_VERTICES}: ask for smaller boxes"
        ));
    }
    let (voxel, place) = (volume.voxels.size, &volume.level_from_world);
    let colours = colours(&mesh, voxel, &snapshot.splats, place);
    Ok(GetMeshResponse {
        success: true,
        message: String::new(),
        frame_id: volume.frames.level.clone(),
        epoch: volume.epoch,
        revision: volume.revision,
        vertices: mesh.vertices.into_iter().flatten().collect(),
        colors: colours.into_iter().flatten().collect(),
        triangles: mesh.triangles.into_iter().flatten().collect(),
    })
}

/// The volume and the map, if splats lie where the volume's keyframes do.
fn both<'a>(
    volume: Option<&'a SharedVolume>,
    snapshot: Option<&'a Snapshot>,
) -> Result<(&'a SharedVolume, &'a Snapshot), String> {
    let volume = volume.ok_or_else(no_volume)?;
    let snapshot = snapshot.ok_or("there is no map yet")?;
    if volume.is_of(snapshot) {
        Ok((volume, snapshot))
    } else {
        Err(
            "the map has just been corrected, and the volume is not there yet; ask again"
                .to_owned(),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shared_volume::tests::empty;
    use glam::DQuat;
    use splat_types::camera::Intrinsics;
    use splat_types::depth::DepthMap;
    use splat_types::transform::Similarity;
    use splat_volume::view::DepthView;
    use splat_volume::voxels::Change;

    const MIDDLE: ([f32; 3], [f32; 3]) = ([-0.2, -0.2, 1.0], [0.2, 0.2, 2.2]);

    /// A wall two metres before a camera that looks along z.
    fn wall() -> SharedVolume {
        let k = Intrinsics {
            width_px: 96,
            height_px: 72,
            fx: 80.0,
            fy: 80.0,
            cx: 48.0,
            cy: 36.0,
        };
        let n = 96 * 72;
        let depth = DepthMap {
            width_px: 96,
            height_px: 72,
            depth: vec![2.0; n],
            confidence: vec![1.0; n],
        };
        let mut volume = empty(DQuat::IDENTITY);
        let view = DepthView::new(&depth, &k);
        let place = Similarity::IDENTITY;
        let changed = volume.voxels.change(&view, &place, 5.0, Change::Add);
        assert!(!changed.unwrap().is_empty());
        volume
    }

    fn snapshot(epoch: u32) -> Snapshot {
        Snapshot {
            map_id: [7; 16],
            epoch,
            revision: 18,
            stamp: splat_types::time::Stamp::from_nanos(5),
            scale: splat_types::snapshot::Scale::GIVEN,
            poses: Vec::new(),
            splats: std::sync::Arc::default(),
            splat_ids: std::sync::Arc::default(),
        }
    }

    fn asked((low, high): ([f32; 3], [f32; 3])) -> BoxRequest {
        BoxRequest {
            frame_id: String::new(),
            low,
            high,
        }
    }

    fn distances_in((low, high): ([f32; 3], [f32; 3])) -> GetDistanceBoxRequest {
        GetDistanceBoxRequest {
            low,
            high,
            ..GetDistanceBoxRequest::default()
        }
    }

    #[test]
    fn a_box_of_distances_lies_where_it_says() {
        let volume = wall();
        let answer = distance_box(Some(&volume), &distances_in(MIDDLE)).unwrap();
        assert!(answer.success);
        assert_eq!((answer.epoch, answer.revision), (3, 17));
        assert_eq!(answer.size, [8, 8, 24]);
        let n = answer.size.iter().product::<u32>() as usize;
        assert_eq!((answer.distances.len(), answer.known.len()), (n, n));
        for (at, found) in answer.distances.iter().enumerate() {
            let z = answer.origin[2] + (at / 64) as f32 * answer.resolution;
            assert!((found - (2.0 - z)).abs() <= 0.05, "{z}: {found}");
        }
        let nothing = distance_box(
            Some(&volume),
            &distances_in(([0.01; 3], [0.011, 0.011, 0.011])),
        );
        let nothing = nothing.unwrap();
        assert_eq!(
            (nothing.size, nothing.distances.len()),
            ([0; 3], 0),
            "no middle of a voxel is within"
        );
    }

    #[test]
    fn a_mesh_is_that_of_its_box() {
        let volume = wall();
        let answer = mesh(Some(&volume), Some(&snapshot(3)), &asked(MIDDLE)).unwrap();
        assert!(answer.success && answer.triangles.len() > 300);
        assert_eq!(answer.colors.len(), answer.vertices.len());
        assert!(answer.colors.iter().all(|c| *c == 128), "no splats");
        let n = (answer.vertices.len() / 3) as u32;
        assert!(answer.triangles.iter().all(|ix| *ix < n));
        let off = answer.vertices.chunks(3).map(|v| (v[2] - 2.0).abs());
        assert!(off.fold(0.0, f32::max) < 0.01);
    }

    #[test]
    fn what_is_too_much_or_of_another_time_is_refused_in_words() {
        let volume = wall();
        let large = ([-50.0; 3], [50.0; 3]);
        let refused = distance_box(Some(&volume), &distances_in(large)).unwrap_err();
        assert!(refused.contains("smaller boxes"), "{refused}");
        let far = ([1e9; 3], [1e9 + 64.0, 1e9 + 64.0, 1e9 + 64.0]);
        assert!(distance_box(Some(&volume), &distances_in(far)).is_err());
        let endless = ([0.0; 3], [f32::INFINITY; 3]);
        assert!(distance_box(Some(&volume), &distances_in(endless)).is_err());
        let refused = mesh(Some(&volume), Some(&snapshot(3)), &asked(large)).unwrap_err();
        assert!(refused.contains("export MAP out.mesh.ply"), "{refused}");
        // The map has been corrected, the volume not yet.
        let refused = ellipsoids(Some(&volume), Some(&snapshot(4)), &asked(MIDDLE)).unwrap_err();
        assert!(refused.contains("ask again"), "{refused}");
        assert!(ellipsoids(Some(&volume), None, &asked(MIDDLE)).is_err());
        let refused = ellipsoids(None, Some(&snapshot(3)), &asked(MIDDLE)).unwrap_err();
        assert!(refused.contains("no volume yet"), "{refused}");
        let none = ellipsoids(Some(&volume), Some(&snapshot(3)), &asked(MIDDLE)).unwrap();
        assert!(none.success && none.ellipsoids.ids.is_empty());
        assert_eq!(none.ellipsoids.header.frame_id, "map");
    }
}
