//! What drivers answer when they are asked what they can do.

use splat_image::pixel_format::{YuvColour, YuvMatrix};

/// What a device says of itself.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Caps {
    pub driver: String,
    pub card: String,
    pub bus: String,
    pub flags: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sizes {
    Fixed {
        width: u32,
        height: u32,
    },
    /// Smallest, largest and step, of width and of height.
    Stepwise {
        width: [u32; 3],
        height: [u32; 3],
    },
}

/// Seconds per image, as a fraction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Intervals {
    Fixed((u32, u32)),
    /// Shortest and longest.
    Between((u32, u32), (u32, u32)),
}

/// A format as the driver took it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Taken {
    pub fourcc: u32,
    pub width: u32,
    pub height: u32,
    pub step: u32,
    pub field: u32,
    pub colorspace: u32,
    pub ycbcr_enc: u32,
    pub quantization: u32,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Control {
    pub id: u32,
    pub name: String,
    pub kind: u32,
    pub min: i32,
    pub max: i32,
    pub flags: u32,
}

impl Taken {
    /// Whether whole images come, not one field at a time.
    pub(crate) fn is_whole(&self) -> bool {
        // Top, bottom, one after the other in a buffer, alternating: linux/videodev2.h, enum v4l2_field.
        !matches!(self.field, 2 | 3 | 5 | 6 | 7)
    }

    /// What YUV numbers mean, by the rules of linux/videodev2.h where the driver says "default".
    pub(crate) fn colour(&self) -> YuvColour {
        const REC709: u32 = 3;
        const JPEG: u32 = 7;
        const BT2020: u32 = 10;
        const DCI_P3: u32 = 12;
        let matrix = match (self.ycbcr_enc, self.colorspace) {
            (2 | 4, _) | (0, REC709 | DCI_P3) => YuvMatrix::Bt709,
            (6 | 7, _) | (0, BT2020) => YuvMatrix::Bt2020,
            _ => YuvMatrix::Bt601,
        };
        let is_full_range =
            self.quantization == 1 || (self.quantization == 0 && self.colorspace == JPEG);
        YuvColour {
            matrix,
            is_full_range,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn taken(colorspace: u32, ycbcr_enc: u32, quantization: u32) -> Taken {
        Taken {
            fourcc: 0,
            width: 640,
            height: 480,
            step: 1280,
            field: 1,
            colorspace,
            ycbcr_enc,
            quantization,
        }
    }

    #[test]
    fn colours_follow_what_the_driver_says() {
        let colour = |c: Taken| (c.colour().matrix, c.colour().is_full_range);
        // sRGB with defaults is what webcams send.
        assert_eq!(colour(taken(8, 0, 0)), (YuvMatrix::Bt601, false));
        assert_eq!(colour(taken(3, 0, 0)), (YuvMatrix::Bt709, false));
        assert_eq!(colour(taken(3, 1, 1)), (YuvMatrix::Bt601, true));
        assert_eq!(colour(taken(7, 0, 0)), (YuvMatrix::Bt601, true));
        assert_eq!(colour(taken(10, 0, 2)), (YuvMatrix::Bt2020, false));
    }

    #[test]
    fn fields_are_no_images() {
        let with = |field| Taken {
            field,
            ..taken(8, 0, 0)
        };
        assert!(with(1).is_whole() && with(4).is_whole() && with(0).is_whole());
        assert!(!with(2).is_whole() && !with(7).is_whole());
    }
}
