//! Looking at the machine: files, folders, the environment. Knows nothing of what is good or bad.

use std::path::PathBuf;

use crate::machine::memory::{free_gpu_mib, free_mib};
use splat_geometry::inference::Provider;
use splat_geometry::shared_library::entries;

const MIB: f64 = (1 << 20) as f64;

#[cfg(target_arch = "x86_64")]
pub fn cpu_features() -> Vec<&'static str> {
    let has = [
        ("sse4.2", std::arch::is_x86_feature_detected!("sse4.2")),
        ("avx2", std::arch::is_x86_feature_detected!("avx2")),
        ("fma", std::arch::is_x86_feature_detected!("fma")),
        ("avx512f", std::arch::is_x86_feature_detected!("avx512f")),
    ];
    has.into_iter()
        .filter_map(|(name, is_there)| is_there.then_some(name))
        .collect()
}

#[cfg(not(target_arch = "x86_64"))]
pub fn cpu_features() -> Vec<&'static str> {
    if cfg!(target_feature = "neon") {
        vec!["neon"]
    } else {
        Vec::new()
    }
}

/// Vulkan's driver manifests, where its loader looks for them.
pub fn icd_files() -> Vec<PathBuf> {
    let named =
        std::env::var_os("VK_DRIVER_FILES").or_else(|| std::env::var_os("VK_ICD_FILENAMES"));
    if let Some(named) = named {
        return std::env::split_paths(&named)
            .filter(|path| path.is_file())
            .collect();
    }
    let folders = ["/usr/local/etc", "/usr/local/share", "/etc", "/usr/share"].map(PathBuf::from);
    let home = std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".local/share"));
    let is_manifest = |path: &PathBuf| {
        path.extension()
            .is_some_and(|extension| extension == "json")
    };
    folders
        .into_iter()
        .chain(home)
        .flat_map(|folder| entries(&folder.join("vulkan/icd.d")))
        .filter(is_manifest)
        .collect()
}

/// In the current folder, as `df` says: the standard library does not know.
pub fn free_disk_mib() -> Option<f64> {
    let output = std::process::Command::new("df")
        .args(["-Pk", "."])
        .output()
        .ok()?;
    free_disk_of(&String::from_utf8_lossy(&output.stdout))
}

/// Bytes that are free where the provider computes.
pub fn free_bytes(provider: Provider) -> Option<f64> {
    let free_mib = match provider {
        Provider::Cpu => free_mib(),
        Provider::TensorRt | Provider::Cuda => free_gpu_mib(),
    };
    free_mib.map(|mib| mib * MIB)
}

/// Last line of `df -Pk`: device, size, used, available in KiB.
fn free_disk_of(df: &str) -> Option<f64> {
    let available_kib: f64 = df
        .lines()
        .last()?
        .split_ascii_whitespace()
        .nth(3)?
        .parse()
        .ok()?;
    Some(available_kib / 1024.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disk_space_is_the_fourth_column() {
        let df =
            "Filesystem 1024-blocks Used Available Capacity Mounted on\noverlay 1 2 2097152 4% /\n";
        assert_eq!(free_disk_of(df), Some(2048.0));
        assert_eq!(
            (free_disk_of(""), free_disk_of("df: no such file")),
            (None, None)
        );
    }
}
