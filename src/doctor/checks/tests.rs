//! Synthetic machines and this one.

use crate::doctor::checks::*;

#[test]
fn too_little_disk_is_a_fault_too_little_memory_a_warning() {
    assert_eq!(
        (
            disk(Some(1.0)).state,
            disk(Some(2048.0)).state,
            disk(None).state
        ),
        (State::Missing, State::Ok, State::Ok)
    );
    assert_eq!(
        (
            memory(Some(1.0)).state,
            memory(Some(8192.0)).state,
            memory(None).state
        ),
        (State::Optional, State::Ok, State::Ok)
    );
}

#[test]
fn software_vulkan_alone_is_no_gpu() {
    let check =
        |names: &[&str]| vulkan_driver(&names.iter().map(PathBuf::from).collect::<Vec<_>>()).state;
    assert_eq!(check(&[]), State::Optional);
    assert_eq!(check(&["/x/lvp_icd.x86_64.json"]), State::Optional);
    assert_eq!(
        check(&["/x/lvp_icd.x86_64.json", "/x/radeon_icd.x86_64.json"]),
        State::Ok
    );
}

#[test]
fn libraries_are_found_by_name_or_version_but_not_by_prefix() {
    let folder = tempfile::tempdir().unwrap();
    let folders = [folder.path().to_owned()];
    std::fs::write(folder.path().join("libvulkan.so.10"), "").unwrap();
    std::fs::write(folder.path().join("libonnxruntime.so.1.31.1"), "").unwrap();
    assert_eq!(vulkan_loader(&folders).state, State::Optional);
    assert_eq!(onnx_runtime(None, &folders).state, State::Ok);
    std::fs::write(folder.path().join("libvulkan.so.1"), "").unwrap();
    assert_eq!(vulkan_loader(&folders).state, State::Ok);
    assert_eq!(
        onnx_runtime(Some(folder.path().join("gone.so")), &folders).state,
        State::Optional
    );
}

#[test]
fn an_installed_ros_is_named_with_its_line_to_source() {
    let root = tempfile::tempdir().unwrap();
    assert!(ros2(None, root.path()).found.starts_with("none"));
    std::fs::create_dir(root.path().join("jazzy")).unwrap();
    let fix = ros2(None, root.path()).fix.unwrap();
    assert!(
        fix.starts_with("source ") && fix.contains("jazzy/setup.bash"),
        "{fix}"
    );
    let sourced = ros2(Some("jazzy".to_owned()), root.path());
    let is_spoken = cfg!(feature = "ros2");
    assert_eq!(sourced.state == State::Ok, is_spoken, "{sourced:?}");
}

#[test]
fn no_write_access_is_a_fault_with_a_fix() {
    let check = write_access(Path::new("/nowhere/at/all"));
    assert_eq!(check.state, State::Missing);
    let text = format_checks(&[check, Check::ok("cpu", "2 threads")]);
    assert!(
        text.contains("MISSING ")
            && text.contains("fix: ")
            && text.ends_with("1 thing is missing\n"),
        "{text}"
    );
}

#[test]
fn this_machine_can_be_examined() {
    let checks = doctor();
    for check in &checks {
        assert_eq!(check.state == State::Ok, check.fix.is_none(), "{check:?}");
    }
    assert!(format_checks(&checks).lines().count() > checks.len());
}
