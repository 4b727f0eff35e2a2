//! What a camera offers and what is wanted -> which of it to ask for, the best first.

use crate::camera::driver::Coding;
use crate::params::CameraParams;
use splat_image::pixel_format::{PixelFormat, YuvColour};

/// A pixel format that can be decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Format {
    /// As parameters call it.
    pub name: &'static str,
    pub fourcc: [u8; 4],
    pub coding: Coding,
}

const fn raw(name: &'static str, fourcc: &[u8; 4], format: PixelFormat) -> Format {
    let colour = YuvColour {
        matrix: splat_image::pixel_format::YuvMatrix::Bt601,
        is_full_range: false,
    };
    Format {
        name,
        fourcc: *fourcc,
        coding: Coding::Raw(format, colour),
    }
}

const fn jpeg(fourcc: &[u8; 4]) -> Format {
    Format {
        name: "mjpeg",
        fourcc: *fourcc,
        coding: Coding::Mjpeg,
    }
}

/// Codes as `linux/videodev2.h` has them.
pub const FORMATS: [Format; 12] = [
    jpeg(b"MJPG"),
    jpeg(b"JPEG"),
    raw("yuyv", b"YUYV", PixelFormat::Yuyv),
    raw("nv12", b"NV12", PixelFormat::Nv12),
    raw("uyvy", b"UYVY", PixelFormat::Uyvy),
    raw("rgb24", b"RGB3", PixelFormat::Rgb),
    raw("bgr24", b"BGR3", PixelFormat::Bgr),
    raw("grey", b"GREY", PixelFormat::Grey),
    raw("bayer", b"RGGB", PixelFormat::BayerRggb),
    raw("bayer", b"GRBG", PixelFormat::BayerGrbg),
    raw("bayer", b"GBRG", PixelFormat::BayerGbrg),
    raw("bayer", b"BA81", PixelFormat::BayerBggr),
];

/// A rate that is met but for rounding: 29.97 is 30.
const RATE_SLACK: f64 = 0.99;

/// One size of one format, and the intervals (seconds, images) at it; none where the driver lists none.
#[derive(Debug, Clone, PartialEq)]
pub struct Offer {
    pub format: Format,
    pub width_px: u32,
    pub height_px: u32,
    pub intervals: Vec<(u32, u32)>,
}

/// What is asked of the driver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mode {
    pub format: Format,
    pub width_px: u32,
    pub height_px: u32,
    /// Seconds, images.
    pub interval: Option<(u32, u32)>,
}

pub fn hz((secs, images): (u32, u32)) -> f64 {
    f64::from(images) / f64::from(secs.max(1))
}

impl std::fmt::Display for Mode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} {}x{}",
            self.format.name, self.width_px, self.height_px
        )?;
        match self.interval {
            Some(interval) => write!(f, " at {:.4} Hz", hz(interval)),
            None => Ok(()),
        }
    }
}

/// Size class, pixels off, whether it is too slow, place in the order of formats, thousandths of a Hz off.
type Key = (u8, u64, bool, usize, u64);

/// Modes to try, the best first: the size nearest to the wanted one and no smaller, else the largest; of that size
/// those that reach the rate; of those the first by `formats`; of that the rate nearest above.
pub fn ranked(offers: &[Offer], wish: &CameraParams) -> Vec<Mode> {
    let order: Vec<&str> = names(&wish.formats).collect();
    let mut modes: Vec<(Key, Mode)> = offers
        .iter()
        .filter_map(|offer| {
            let preference = order.iter().position(|name| *name == offer.format.name)?;
            let interval = nearest_interval(&offer.intervals, wish.rate);
            let rate = interval.map(hz);
            let is_too_slow = rate.is_some_and(|rate| rate < wish.rate * RATE_SLACK);
            let (class, area) = misfit((offer.width_px, offer.height_px), wish);
            let off = rate.map_or(0.0, |rate| (rate - wish.rate).abs());
            let key = (class, area, is_too_slow, preference, (off * 1e3) as u64);
            Some((
                key,
                Mode {
                    format: offer.format,
                    width_px: offer.width_px,
                    height_px: offer.height_px,
                    interval,
                },
            ))
        })
        .collect();
    modes.sort_by_key(|(key, _)| *key);
    modes.into_iter().map(|(_, mode)| mode).collect()
}

/// The names in a list by commas.
pub fn names(list: &str) -> impl Iterator<Item = &str> {
    list.split(',')
        .map(str::trim)
        .filter(|name| !name.is_empty())
}

/// 0 for the wanted size and for larger ones, 1 for smaller ones; then how many pixels it is off.
fn misfit((width, height): (u32, u32), wish: &CameraParams) -> (u8, u64) {
    let area = |w: u32, h: u32| u64::from(w) * u64::from(h);
    let is_smaller = width < wish.width || height < wish.height;
    let off = area(width, height).abs_diff(area(wish.width, wish.height));
    (u8::from(is_smaller), off)
}

/// The slowest that reaches the rate, else the fastest.
fn nearest_interval(intervals: &[(u32, u32)], rate: f64) -> Option<(u32, u32)> {
    let by_rate = |a: &&(u32, u32), b: &&(u32, u32)| hz(**a).total_cmp(&hz(**b));
    let reaching = intervals.iter().filter(|i| hz(**i) >= rate * RATE_SLACK);
    let found = reaching.min_by(by_rate);
    found.or_else(|| intervals.iter().max_by(by_rate)).copied()
}

/// The side within a range of steps that is nearest to the wanted one and no smaller.
pub fn stepped(wanted: u32, [min, max, step]: [u32; 3]) -> u32 {
    let (step, max) = (step.max(1), max.max(min));
    let above = wanted.clamp(min, max) - min;
    let side = u64::from(min) + u64::from(above.div_ceil(step)) * u64::from(step);
    // The largest may lie between two steps.
    let last = min + (max - min) / step * step;
    u32::try_from(side).map_or(last, |side| side.min(last))
}

/// The interval for a rate within the shortest and the longest.
pub fn interval_between(rate: f64, shortest: (u32, u32), longest: (u32, u32)) -> (u32, u32) {
    if rate >= hz(shortest) {
        return shortest;
    }
    if rate <= hz(longest) {
        return longest;
    }
    (1000, (rate * 1000.0).round() as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wish() -> CameraParams {
        CameraParams::default()
    }

    fn offer(name: &str, (width_px, height_px): (u32, u32), rates: &[u32]) -> Offer {
        Offer {
            format: *FORMATS.iter().find(|f| f.name == name).unwrap(),
            width_px,
            height_px,
            intervals: rates.iter().map(|&rate| (1, rate)).collect(),
        }
    }

    fn best(offers: &[Offer], wish: &CameraParams) -> String {
        ranked(offers, wish)[0].to_string()
    }

    #[test]
    fn size_goes_before_rate_and_rate_before_the_order_of_formats() {
        let offers = [
            offer("mjpeg", (640, 480), &[15]),
            offer("nv12", (640, 480), &[60, 30, 5]),
            offer("yuyv", (640, 480), &[5, 30]),
            offer("mjpeg", (1280, 720), &[30]),
            offer("mjpeg", (320, 240), &[120]),
        ];
        assert_eq!(best(&offers, &wish()), "yuyv 640x480 at 30.0000 Hz");
        let large = CameraParams {
            width: 800,
            height: 600,
            ..wish()
        };
        assert_eq!(best(&offers, &large), "mjpeg 1280x720 at 30.0000 Hz");
        let huge = CameraParams {
            width: 4000,
            height: 3000,
            ..wish()
        };
        assert_eq!(best(&offers, &huge), "mjpeg 1280x720 at 30.0000 Hz");
        let slow = CameraParams {
            rate: 10.0,
            ..wish()
        };
        assert_eq!(best(&offers, &slow), "mjpeg 640x480 at 15.0000 Hz");
        let grey = CameraParams {
            formats: "grey".to_owned(),
            ..wish()
        };
        assert!(ranked(&offers, &grey).is_empty());
        let own = CameraParams {
            formats: " nv12, yuyv".to_owned(),
            ..wish()
        };
        assert_eq!(best(&offers, &own), "nv12 640x480 at 30.0000 Hz");
    }

    #[test]
    fn a_driver_without_rates_is_taken_as_it_is() {
        let offers = [offer("yuyv", (640, 480), &[])];
        assert_eq!(best(&offers, &wish()), "yuyv 640x480");
    }

    #[test]
    fn steps_end_at_the_last_whole_one() {
        assert_eq!(stepped(640, [16, 4096, 16]), 640);
        assert_eq!(stepped(641, [16, 4096, 16]), 656);
        assert_eq!(stepped(9999, [2, 1001, 2]), 1000);
        assert_eq!(stepped(1, [32, 64, 0]), 32);
        assert_eq!(stepped(u32::MAX, [1, u32::MAX, 2]), u32::MAX);
        assert_eq!(stepped(5, [10, 3, 1]), 10);
        assert_eq!(interval_between(25.0, (1, 60), (1, 5)), (1000, 25_000));
        assert_eq!(interval_between(90.0, (1, 60), (1, 5)), (1, 60));
        assert_eq!(interval_between(1.0, (1, 60), (1, 5)), (1, 5));
    }
}
