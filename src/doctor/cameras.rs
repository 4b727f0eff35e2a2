//! The cameras of this machine, what they offer, and what is in the way of those that cannot be opened.

use crate::doctor::check::Check;

#[cfg(all(feature = "camera-v4l", target_os = "linux"))]
pub(crate) fn cameras() -> Check {
    check_of(&splat_io::v4l2::list::list())
}

#[cfg(not(all(feature = "camera-v4l", target_os = "linux")))]
pub(crate) fn cameras() -> Check {
    Check::optional(
        "camera",
        "this build reads no v4l2: cameras",
        "build with --features camera-v4l on Linux; elsewhere use webcam:0",
    )
}

#[cfg(all(feature = "camera-v4l", target_os = "linux"))]
use found::check_of;

#[cfg(all(feature = "camera-v4l", target_os = "linux"))]
mod found {
    use std::path::PathBuf;

    use crate::doctor::check::{Check, State};
    use splat_io::camera::modes::Offer;
    use splat_io::camera::modes::hz;
    use splat_io::camera_error::CameraError;
    use splat_io::v4l2::list::Found;

    const NONE_FIX: &str = "plug a camera in; in a container, pass it on with --device /dev/video0";

    type Listed = (PathBuf, Result<Found, CameraError>);

    pub(crate) fn check_of(cameras: &[Listed]) -> Check {
        if cameras.is_empty() {
            return Check::optional(
                "camera",
                "no camera: nothing for v4l2:/dev/video0",
                NONE_FIX,
            );
        }
        let is_ready = cameras.iter().any(|(_, found)| found.is_ok());
        let is_locked = |(_, found): &Listed| matches!(found, Err(CameraError::Permission { .. }));
        let fix = cameras.iter().any(is_locked).then(|| {
            "sudo usermod -aG video $USER, then log in again; in a container, --device /dev/video0"
                .to_owned()
        });
        let lines: Vec<String> = cameras.iter().flat_map(lines_of).collect();
        Check {
            name: "camera",
            state: if is_ready { State::Ok } else { State::Optional },
            found: lines.join("\n"),
            fix,
        }
    }

    fn lines_of((path, found): &Listed) -> Vec<String> {
        let found = match found {
            Ok(found) => found,
            Err(CameraError::Permission { .. }) => {
                return vec![format!("{}: no permission to open it", path.display())];
            }
            Err(error) => return vec![error.to_string()],
        };
        let mut lines = vec![format!(
            "v4l2:{}: {} ({}, driver {})",
            path.display(),
            found.card,
            found.bus,
            found.driver
        )];
        for format in found.offers.chunk_by(|a, b| a.format == b.format) {
            let name = format[0].format.name;
            let sizes: Vec<String> = format.iter().map(size_of).collect();
            lines.push(format!("  {name}: {}", sizes.join(", ")));
        }
        if found.offers.is_empty() {
            lines.push("  no format that this version decodes".to_owned());
        }
        if !found.others.is_empty() {
            lines.push(format!("  not decoded: {}", found.others.join(" ")));
        }
        if !found.controls.is_empty() {
            lines.push(format!("  controls: {}", found.controls.join(" ")));
        }
        lines
    }

    /// `640x480 at 5 10 30 Hz`.
    fn size_of(offer: &Offer) -> String {
        let size = format!("{}x{}", offer.width_px, offer.height_px);
        if offer.intervals.is_empty() {
            return size;
        }
        let mut rates: Vec<f64> = offer.intervals.iter().map(|i| hz(*i)).collect();
        rates.sort_by(f64::total_cmp);
        let rates = rates.iter().map(|rate| {
            let rounded = (rate * 100.0).round() / 100.0;
            rounded.to_string()
        });
        let mut rates: Vec<String> = rates.collect();
        rates.dedup();
        format!("{size} at {} Hz", rates.join(" "))
    }

    #[cfg(test)]
    mod tests {
        use super::*;
        use splat_io::camera::modes::FORMATS;

        #[test]
        fn cameras_are_listed_with_what_they_offer_and_what_is_in_the_way() {
            assert_eq!(check_of(&[]).state, State::Optional);
            let path = PathBuf::from("/dev/video2");
            let locked = CameraError::Permission { path: path.clone() };
            let check = check_of(&[(path.clone(), Err(locked))]);
            assert_eq!(check.state, State::Optional);
            assert!(check.fix.unwrap().contains("usermod -aG video"));
            let offer = |ix: usize, width_px, rates: &[u32]| Offer {
                format: FORMATS[ix],
                width_px,
                height_px: 480,
                intervals: rates.iter().map(|rate| (1, *rate)).collect(),
            };
            let found = Found {
                path: path.clone(),
                card: "Eye".to_owned(),
                bus: "usb-1".to_owned(),
                driver: "uvcvideo".to_owned(),
                offers: vec![
                    offer(0, 640, &[30, 5]),
                    offer(0, 1280, &[]),
                    offer(2, 640, &[15]),
                ],
                others: vec!["H264".to_owned()],
                controls: vec!["gain=0..255".to_owned()],
            };
            let check = check_of(&[(path, Ok(found))]);
            assert_eq!(check.state, State::Ok);
            assert_eq!(
                check.found,
                "v4l2:/dev/video2: Eye (usb-1, driver uvcvideo)\n  mjpeg: 640x480 at 5 30 Hz, 1280x480\n  yuyv: 640x480 at 15 Hz\n  not decoded: H264\n  controls: gain=0..255"
            );
        }
    }
}
