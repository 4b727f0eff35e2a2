//! Runs inside the machine that scripts/v4l2_test boots, where the kernel's vivid driver makes cameras: holds what
//! docs/CAMERAS.md promises against them. `camera_check /dev/video0` captures from a real camera and stops there.

#![allow(clippy::print_stdout, reason = "a program for a log")]

#[cfg(target_os = "linux")]
mod capture;
#[cfg(target_os = "linux")]
mod faults;
#[cfg(target_os = "linux")]
mod tape;
#[cfg(all(target_os = "linux", feature = "camera-nokhwa"))]
mod webcam;

#[cfg(target_os = "linux")]
fn main() -> std::process::ExitCode {
    use std::path::PathBuf;
    use std::process::ExitCode;

    tracing_subscriber::fmt()
        .without_time()
        .with_target(false)
        .with_ansi(false)
        .init();
    let device = std::env::args().nth(1).filter(|arg| !arg.is_empty());
    let is_vivid = device.is_none();
    let device = PathBuf::from(device.unwrap_or_else(|| "/dev/video0".to_owned()));
    let mut checks: Vec<(&str, Check)> = vec![
        ("cameras are listed with what they offer", capture::listing),
        ("each format gives its images", capture::each_format),
    ];
    if is_vivid {
        checks.extend(faults::ALL);
        checks.extend(tape::ALL);
        #[cfg(feature = "camera-nokhwa")]
        checks.extend(webcam::ALL);
    }
    let mut n_failed = 0;
    for (name, check) in checks {
        let watch = splat_types::time::Stopwatch::start();
        println!("CHECK {name}");
        let verdict = match check(&device, is_vivid) {
            Ok(()) => "ok".to_owned(),
            Err(reason) => {
                n_failed += 1;
                format!("FAILED: {reason:#}")
            }
        };
        println!("CHECK {name}: {verdict} ({:.1} s)", watch.secs());
    }
    println!("CHECKS failed: {n_failed}");
    if n_failed == 0 {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

/// Device, and whether it is vivid.
#[cfg(target_os = "linux")]
type Check = fn(&std::path::Path, bool) -> anyhow::Result<()>;

#[cfg(not(target_os = "linux"))]
fn main() {
    println!("Video4Linux is there on Linux only");
}
