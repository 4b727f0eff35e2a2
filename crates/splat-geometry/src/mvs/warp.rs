//! Where a pixel of the reference image lies in a source image, by its inverse depth.

use crate::mvs::luma::Grey;
use crate::mvs::luma_map::LumaFit;
use crate::mvs::planes::Planes;
use crate::mvs::view::Prepared;

/// Below this angle between the rays, depth from noisy poses is guesswork.
const MIN_ANGLE_RAD: f64 = 0.008;

/// Below this way across the source image, from the near to the far plane, there is nothing to distinguish planes.
const MIN_TRAVEL_PX: f64 = 1.5;

/// The way from reference pixels to source pixels: `pixel_map * (x, y, 1) + inverse_depth * shift`, homogeneous.
#[derive(Debug)]
pub(crate) struct Warp<'a> {
    pub(crate) source: &'a Grey,
    pub(crate) fine: &'a Grey,
    /// Columns for x, y and 1. Pixel index space on both sides: centres at integers.
    pub(crate) pixel_map: [[f64; 3]; 3],
    shift: [f64; 3],
    pub(crate) light: LumaFit,
    /// Luma of the reference as the source shows it: by the light, and by what each part of the image adds.
    pub(crate) shown: Vec<f32>,
}

/// Homogeneous source pixels along one row of the reference.
pub(crate) struct WarpedRow {
    pub(crate) start: [f32; 3],
    pub(crate) step: [f32; 3],
}

impl<'a> Warp<'a> {
    /// `None` without parallax.
    pub(crate) fn new(reference: &Prepared, source: &'a Prepared, planes: &Planes) -> Option<Self> {
        let source_from_reference = source.submap_from_cam.inverse() * reference.submap_from_cam;
        let rotation = source_from_reference.rotation_matrix();
        let (from, to) = (&reference.intrinsics, &source.intrinsics);
        // Half a pixel less on the way out, half a pixel more on the way in.
        let project = |p: glam::DVec3| {
            [
                to.fx * p.x + (to.cx - 0.5) * p.z,
                to.fy * p.y + (to.cy - 0.5) * p.z,
                p.z,
            ]
        };
        let corner = glam::DVec3::new((0.5 - from.cx) / from.fx, (0.5 - from.cy) / from.fy, 1.0);
        let warp = Self {
            source: &source.grey,
            fine: &source.fine,
            pixel_map: [
                project(rotation.x_axis / from.fx),
                project(rotation.y_axis / from.fy),
                project(rotation * corner),
            ],
            shift: project(source_from_reference.translation),
            light: LumaFit::SAME,
            shown: reference.grey.values.clone(),
        };
        let middle = 0.5 * (planes.inverse_near + planes.inverse_far);
        let angle = source_from_reference.translation.length() * middle;
        (angle >= MIN_ANGLE_RAD && warp.travel_px(reference, planes) >= MIN_TRAVEL_PX)
            .then_some(warp)
    }

    /// Longest way of a few test pixels across the source, from the far to the near plane; 0 where both miss it.
    fn travel_px(&self, reference: &Prepared, planes: &Planes) -> f64 {
        let mut longest = 0.0_f64;
        for (share_x, share_y) in [(0.5, 0.5), (0.2, 0.2), (0.8, 0.2), (0.2, 0.8), (0.8, 0.8)] {
            let x = share_x * reference.grey.width as f64;
            let y = share_y * reference.grey.height as f64;
            let far = self.pixel_in_source(x, y, planes.inverse_far);
            let near = self.pixel_in_source(x, y, planes.inverse_near);
            longest = match (far, near) {
                (Some(far), Some(near)) => longest.max((far - near).length()),
                // Behind the source on one end: it moves as far as can be.
                (Some(_), None) | (None, Some(_)) => f64::INFINITY,
                (None, None) => longest,
            };
        }
        longest
    }

    pub(crate) fn homogeneous(&self, x: f64, y: f64, inverse_depth: f64) -> glam::DVec3 {
        let column = |ix: usize| glam::DVec3::from_array(self.pixel_map[ix]);
        column(0) * x
            + column(1) * y
            + column(2)
            + glam::DVec3::from_array(self.shift) * inverse_depth
    }

    pub(crate) fn pixel_in_source(
        &self,
        x: f64,
        y: f64,
        inverse_depth: f64,
    ) -> Option<glam::DVec2> {
        let h = self.homogeneous(x, y, inverse_depth);
        (h.z > 1e-9).then(|| h.truncate() / h.z)
    }

    /// At a pixel of the reference, by its number and its luma.
    pub(crate) fn light_at(&self, pixel: usize, luma: f32) -> LumaFit {
        let gain = self.light.gain;
        LumaFit {
            gain,
            offset: self.shown[pixel] - gain * luma,
        }
    }

    pub(crate) fn row(&self, y: usize, inverse_depth: f64) -> WarpedRow {
        WarpedRow {
            start: self
                .homogeneous(0.0, y as f64, inverse_depth)
                .as_vec3()
                .to_array(),
            step: glam::DVec3::from_array(self.pixel_map[0])
                .as_vec3()
                .to_array(),
        }
    }
}
