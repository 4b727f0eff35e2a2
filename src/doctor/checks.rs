//! What this machine has for splat-mapper, and for what is missing the line that fixes it.
//!
//! Looks at files, the environment and sockets only: it starts no GPU and changes nothing but one file that it removes.

use std::net::{Ipv4Addr, UdpSocket};
use std::path::{Path, PathBuf};

use crate::doctor::cameras::cameras;
use crate::doctor::check::{Check, State};
use crate::machine::memory::free_mib;
use crate::machine::probe::{cpu_features, free_disk_mib, icd_files};
use splat_geometry::inference::{ONNX_RUNTIME_FIX, Provider};
use splat_geometry::shared_library::{entries, find_library, library_folders};

/// A run over some hundred keyframes stays below this.
const NEEDED_MEMORY_MIB: f64 = 2048.0;
/// A run directory of a long recording, map and renders included.
const NEEDED_DISK_MIB: f64 = 1024.0;
/// Where zenoh looks for peers by default.
const ZENOH_SCOUTING_GROUP: Ipv4Addr = Ipv4Addr::new(224, 0, 0, 224);

/// All checks, needed things first. Relative paths, such as `out/`, are meant from the current folder.
pub fn doctor() -> Vec<Check> {
    let here = Path::new(".");
    let named_onnx_runtime = std::env::var_os("ORT_DYLIB_PATH").map(PathBuf::from);
    #[cfg_attr(
        not(feature = "ros2"),
        expect(unused_mut, reason = "ROS 2 adds its own")
    )]
    let mut checks = vec![
        cpu(),
        memory(free_mib()),
        write_access(here),
        disk(free_disk_mib()),
        vulkan_loader(&library_folders()),
        vulkan_driver(&icd_files()),
        ros2(std::env::var("ROS_DISTRO").ok(), Path::new("/opt/ros")),
        cameras(),
        onnx_runtime(named_onnx_runtime, &library_folders()),
        multicast(),
    ];
    #[cfg(feature = "ros2")]
    checks.extend(ros2_images());
    checks
}

/// One line a check and one a fix, and a last line with the verdict.
pub fn format_checks(checks: &[Check]) -> String {
    let width = checks
        .iter()
        .map(|check| check.name.len())
        .max()
        .unwrap_or_default();
    let mut text = String::new();
    for check in checks {
        let mark = match check.state {
            State::Ok => "ok      ",
            State::Optional => "optional",
            State::Missing => "MISSING ",
        };
        let mut lines = check.found.lines();
        let first = lines.next().unwrap_or_default();
        text.push_str(&format!("{mark}  {:width$}  {first}\n", check.name));
        for line in lines {
            text.push_str(&format!("          {:width$}  {line}\n", ""));
        }
        if let Some(fix) = &check.fix {
            text.push_str(&format!("          {:width$}  fix: {fix}\n", ""));
        }
    }
    let n_missing = checks
        .iter()
        .filter(|check| check.state == State::Missing)
        .count();
    text.push_str(&match n_missing {
        0 => "ready to map\n".to_owned(),
        1 => "1 thing is missing\n".to_owned(),
        n => format!("{n} things are missing\n"),
    });
    text
}

fn cpu() -> Check {
    let n_threads = std::thread::available_parallelism().map_or(1, usize::from);
    let features = cpu_features();
    let found = format!(
        "{n_threads} threads, {}",
        if features.is_empty() {
            "no SIMD".to_owned()
        } else {
            features.join(" ")
        }
    );
    if cfg!(target_arch = "x86_64") && !features.contains(&"avx2") {
        return Check::optional(
            "cpu",
            format!("{found}; the cpu engine is several times slower"),
            "use a CPU with AVX2 (since 2013), or a GPU",
        );
    }
    Check::ok("cpu", found)
}

fn memory(free_mib: Option<f64>) -> Check {
    match free_mib {
        None => Check::ok("memory", "unknown (no /proc/meminfo)"),
        Some(mib) if mib < NEEDED_MEMORY_MIB => Check::optional(
            "memory",
            format!("{mib:.0} MiB free; larger maps need {NEEDED_MEMORY_MIB:.0} MiB"),
            "close other programs, or lower map.max_splats and source.max_side",
        ),
        Some(mib) => Check::ok("memory", format!("{:.1} GiB free", mib / 1024.0)),
    }
}

fn write_access(folder: &Path) -> Check {
    let probe = folder.join(format!(".splat-mapper-doctor-{}", std::process::id()));
    let written = std::fs::write(&probe, b"x");
    std::fs::remove_file(&probe).ok();
    match written {
        Ok(()) => Check::ok("write access", "the current folder is writable"),
        Err(e) => Check::missing(
            "write access",
            format!("the current folder is not writable: {e}"),
            "cd to a folder of yours, or name one with --out",
        ),
    }
}

fn disk(free_mib: Option<f64>) -> Check {
    match free_mib {
        None => Check::ok("disk", "unknown (df gave no answer)"),
        Some(mib) if mib < NEEDED_DISK_MIB => Check::missing(
            "disk",
            format!("{mib:.0} MiB free here; a run needs up to {NEEDED_DISK_MIB:.0} MiB"),
            "free some space, or name another place with --out",
        ),
        Some(mib) => Check::ok("disk", format!("{:.1} GiB free here", mib / 1024.0)),
    }
}

fn vulkan_loader(folders: &[PathBuf]) -> Check {
    match find_library(folders, "libvulkan.so.1") {
        Some(path) => Check::ok("vulkan", path.display().to_string()),
        None => Check::optional(
            "vulkan",
            "no libvulkan.so.1; this version maps on the CPU and needs none, a later --backend wgpu will",
            "sudo apt install libvulkan1",
        ),
    }
}

fn vulkan_driver(icd_files: &[PathBuf]) -> Check {
    let name = |path: &PathBuf| {
        path.file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    };
    let names: Vec<String> = icd_files.iter().map(name).collect();
    let is_software = |name: &String| {
        name.contains("lvp") || name.contains("swrast") || name.contains("swiftshader")
    };
    if names.is_empty() {
        let fix = "sudo apt install mesa-vulkan-drivers (AMD, Intel, tests) or the driver of the GPU's maker";
        return Check::optional(
            "vulkan driver",
            "none; this version maps on the CPU and needs none, a later --backend wgpu will",
            fix,
        );
    }
    if names.iter().all(is_software) {
        let found = format!(
            "software only ({}): enough for the shader tests, the cpu engine maps",
            names.join(", ")
        );
        return Check::optional(
            "vulkan driver",
            found,
            "on a machine with a GPU, install the driver of its maker",
        );
    }
    Check::ok("vulkan driver", names.join(", "))
}

/// `sourced`: the distribution in the environment. `root`: where distributions are installed.
fn ros2(sourced: Option<String>, root: &Path) -> Check {
    let sourced = sourced.filter(|distro| !distro.is_empty());
    let build = "cargo build --release --features ros2 where ROS 2 is sourced (docs/ROS2.md)";
    match (sourced, entries(root).first()) {
        (Some(distro), _) if cfg!(feature = "ros2") => Check::ok(
            "ros 2",
            format!("{distro} is sourced, and this build speaks it"),
        ),
        (Some(distro), _) => Check::optional(
            "ros 2",
            format!("{distro} is sourced; this build reads recordings and speaks zenoh only"),
            build,
        ),
        (None, Some(installed)) => Check::optional(
            "ros 2",
            "installed, not sourced; recordings and zenoh work without",
            format!("source {}/setup.bash, then {build}", installed.display()),
        ),
        (None, None) => Check::optional(
            "ros 2",
            "none; recordings and zenoh work without",
            "install a ROS 2 distribution (docs.ros.org) and source its setup.bash",
        ),
    }
}

/// What there is to subscribe to, and whether images will come through.
#[cfg(feature = "ros2")]
fn ros2_images() -> Vec<Check> {
    let topics = match splat_ros::ros2::topic_watch::look_around() {
        Ok(topics) if topics.is_empty() => Check::optional(
            "ros 2 images",
            "nobody publishes images here",
            "start the camera's driver, with the same ROS_DOMAIN_ID",
        ),
        Ok(topics) => Check::ok("ros 2 images", topics.join(", ")),
        Err(e) => Check::optional("ros 2 images", e.to_string(), "source ROS 2 once more"),
    };
    let names = [
        "FASTRTPS_DEFAULT_PROFILES_FILE",
        "FASTDDS_DEFAULT_PROFILES_FILE",
    ];
    let is_profiled = names
        .into_iter()
        .any(|name| std::env::var_os(name).is_some_and(|file| Path::new(&file).is_file()));
    let is_fast_dds =
        std::env::var("RMW_IMPLEMENTATION").map_or(true, |name| name.contains("fastrtps"));
    let profile = if is_profiled || !is_fast_dds {
        Check::ok("ros 2 transport", "fit for images")
    } else {
        Check::optional(
            "ros 2 transport",
            "Fast DDS by its defaults loses most best-effort images",
            "export FASTRTPS_DEFAULT_PROFILES_FILE=launch/fastdds.xml here and for the camera's driver",
        )
    };
    vec![topics, profile]
}

fn onnx_runtime(named: Option<PathBuf>, folders: &[PathBuf]) -> Check {
    let is_named = named.is_some();
    match named.or_else(|| find_library(folders, "libonnxruntime.so")) {
        Some(path) if path.is_file() => {
            let providers = providers_beside(&path).join(", ");
            Check::ok(
                "onnx runtime",
                format!("{}, for {providers}", path.display()),
            )
        }
        Some(path) if is_named => Check::optional(
            "onnx runtime",
            format!("ORT_DYLIB_PATH names no file: {}", path.display()),
            ONNX_RUNTIME_FIX,
        ),
        _ => Check::optional(
            "onnx runtime",
            "none; onnx:FILE geometry, eval.lpips_model and xfeat features need it",
            ONNX_RUNTIME_FIX,
        ),
    }
}

/// What the library can compute on: each provider but the CPU is a library of its own beside it.
fn providers_beside(library: &Path) -> Vec<&'static str> {
    let folder = library.parent().unwrap_or(Path::new("."));
    let has = |name: &str| find_library(&[folder.to_owned()], name).is_some();
    Provider::ALL
        .into_iter()
        .map(Provider::name)
        .filter(|name| *name == "cpu" || has(&format!("libonnxruntime_providers_{name}.so")))
        .collect()
}

/// Joins zenoh's scouting group and leaves it again; nothing is sent.
fn multicast() -> Check {
    let joined = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))
        .and_then(|socket| socket.join_multicast_v4(&ZENOH_SCOUTING_GROUP, &Ipv4Addr::UNSPECIFIED));
    match joined {
        Ok(()) => Check::ok(
            "multicast",
            format!("{ZENOH_SCOUTING_GROUP} joined: zenoh peers find each other"),
        ),
        Err(e) => Check::optional(
            "multicast",
            format!("{ZENOH_SCOUTING_GROUP} refused ({e}); zenoh cannot find peers by itself"),
            "--set publish.zenoh_connect=tcp/HOST:7447",
        ),
    }
}

#[cfg(test)]
mod tests;
