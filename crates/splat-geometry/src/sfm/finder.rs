//! Frame -> features, and what a depth camera or a second camera says of their distances.

use crate::error::GeometryError;
use crate::features::descriptor::{Features, working_image};
use crate::features::extractor::FeatureExtractor;
use crate::sfm::feature_depths::{FeatureDepths, OfCamera};
use crate::sfm::params::SfmParams;
use splat_types::camera::Intrinsics;
use splat_types::frame::Frame;
use splat_types::image::RgbImage;

/// What was found in a keyframe.
pub(crate) struct Found {
    pub(crate) features: Features,
    /// Of the working image, whose pixels the features have.
    pub(crate) size: (u32, u32),
    pub(crate) measured: Option<FeatureDepths>,
}

/// Looks at frames, each apart from all others.
#[derive(Debug)]
pub(crate) struct Finder {
    extractor: FeatureExtractor,
    max_side: u32,
    /// Standard deviation of a depth camera, in 1/m.
    depth_noise: f64,
    /// Depth and second images of frames count.
    pub(crate) uses_sensors: bool,
}

impl Finder {
    /// An error where the parameters insist on a network that is not there.
    pub(crate) fn new(params: &SfmParams) -> Result<Self, GeometryError> {
        Ok(Self {
            extractor: FeatureExtractor::new(&params.features())?,
            max_side: params.max_side,
            depth_noise: params.depth_noise,
            uses_sensors: false,
        })
    }

    /// Features of a frame, and what was measured of their distances; `with_second`: by the second camera, too, if there is one.
    pub(crate) fn look_at(&self, frame: &Frame, max_features: usize, with_second: bool) -> Found {
        let look = |image: &RgbImage| {
            let image = working_image(image, self.max_side);
            let size = (image.width as u32, image.height as u32);
            (self.extractor.features(&image, max_features), size)
        };
        let known = frame.intrinsics.filter(Intrinsics::is_plausible);
        let depth = frame.sensor_depth.as_ref().filter(|_| self.uses_sensors);
        let second = frame.second.as_ref().filter(|_| self.uses_sensors);
        let second = second.filter(|_| with_second && depth.is_none()).zip(known);
        let ((features, size), beside) = rayon::join(
            || look(&frame.image),
            || {
                let (second, lens) = second?;
                let decoded = second.decoded()?;
                Some((second, lens, decoded, look(&decoded.image)))
            },
        );
        let of_pair = beside.and_then(|(second, lens, decoded, (others, other_size))| {
            let first = OfCamera {
                features: &features,
                lens: lens.resized(size.0, size.1),
            };
            let other = OfCamera {
                features: &others,
                lens: decoded.intrinsics.resized(other_size.0, other_size.1),
            };
            FeatureDepths::of_pair(&first, &other, &second.second_from_first)
        });
        let of_depth = || FeatureDepths::new(&features.pixels, size, depth?, self.depth_noise);
        Found {
            measured: of_pair.or_else(of_depth),
            features,
            size,
        }
    }
}
