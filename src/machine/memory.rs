//! How much memory is free, and how much this program has used, as Linux says.

use std::path::Path;

/// Of the machine, or of the container where that has less.
pub fn free_mib() -> Option<f64> {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    free_of(
        &read("/proc/meminfo"),
        &read("/sys/fs/cgroup/memory.max"),
        &read("/sys/fs/cgroup/memory.current"),
    )
}

/// Of the first NVIDIA GPU, as its driver says.
pub fn free_gpu_mib() -> Option<f64> {
    let output = std::process::Command::new("nvidia-smi")
        .args(["--query-gpu=memory.free", "--format=csv,noheader,nounits"])
        .output()
        .ok()?;
    String::from_utf8_lossy(&output.stdout)
        .lines()
        .next()?
        .trim()
        .parse()
        .ok()
}

/// The most memory this process ever had, where the system reports (Linux).
pub fn peak_rss_mib() -> Option<f64> {
    mib_of_status(
        &std::fs::read_to_string("/proc/self/status").ok()?,
        "VmHWM:",
    )
}

/// The memory that this process has now, where the system reports (Linux).
pub fn rss_mib() -> Option<f64> {
    mib_of_status(
        &std::fs::read_to_string("/proc/self/status").ok()?,
        "VmRSS:",
    )
}

/// What `peak_rss_mib` says counts from here. Returns whether the system allows it.
pub fn forget_peak() -> bool {
    // "5" resets the peak alone (proc(5)).
    std::fs::write(Path::new("/proc/self/clear_refs"), "5").is_ok()
}

fn free_of(meminfo: &str, cgroup_max: &str, cgroup_used: &str) -> Option<f64> {
    let line = meminfo
        .lines()
        .find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let available_kib: f64 = line.split_ascii_whitespace().next()?.parse().ok()?;
    // The file holds `max` where the container has no limit.
    let bytes = |text: &str| text.trim().parse::<f64>().ok();
    let in_container_kib = bytes(cgroup_max)
        .zip(bytes(cgroup_used))
        .map(|(max, used)| (max - used).max(0.0) / 1024.0);
    Some(in_container_kib.map_or(available_kib, |limit| limit.min(available_kib)) / 1024.0)
}

fn mib_of_status(status: &str, name: &str) -> Option<f64> {
    let line = status.lines().find_map(|line| line.strip_prefix(name))?;
    let kib: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib / 1024.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_that_of_the_container_when_less() {
        let meminfo = "MemTotal:  16000000 kB\nMemAvailable:  8388608 kB\n";
        assert_eq!(free_of(meminfo, "max\n", "5"), Some(8192.0));
        assert_eq!(free_of(meminfo, "4294967296\n", "0\n"), Some(4096.0));
        assert_eq!(free_of(meminfo, "1073741824", "536870912"), Some(512.0));
        assert_eq!(free_of(meminfo, "5", "7"), Some(0.0));
        assert_eq!(free_of("", "", ""), None);
    }

    #[test]
    fn peak_memory_is_read_from_the_status_file() {
        assert_eq!(
            mib_of_status("Name:\tx\nVmHWM:\t    2048 kB\nVmRSS:\t 1 kB\n", "VmHWM:"),
            Some(2.0)
        );
        assert_eq!(mib_of_status("Name:\tx\n", "VmHWM:"), None);
        assert_eq!(mib_of_status("VmHWM:\t many kB\n", "VmHWM:"), None);
    }
}
