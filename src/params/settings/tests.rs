//! Parameters keep their ranges, and errors say which.

use std::path::Path;

use serde_json::Value;

use crate::params::error::ParamsError;
use crate::params::params::Params;
use crate::params::schema::{allows, descriptors};
use crate::params::settings::{Settings, defaults};
use splat_ros::ros2::parameter_store::Range;

#[test]
fn defaults_fit_their_own_ranges_and_the_structs() {
    let settings = Settings::shipped();
    assert_eq!(settings.entries().count(), descriptors().len());
    for (key, value) in settings.entries() {
        let range = &descriptors()[key].range;
        assert!(allows(range, value), "{key} = {value} is outside {range}");
    }
    assert_eq!(settings.params().unwrap(), Params::default());
}

#[test]
fn every_numeric_bound_can_be_set_and_read_back() {
    for (key, descriptor) in descriptors() {
        let mut settings = Settings::shipped();
        if let Range::Number { min, max, .. } = descriptor.range {
            settings.set(key, Value::from(min)).unwrap();
            settings.set(key, Value::from(max)).unwrap();
            let fits = settings.params();
            assert!(
                matches!(fits, Ok(_) | Err(ParamsError::Overlap { .. })),
                "{key}: {fits:?}"
            );
            settings.set(key, Value::from(max + 1.0)).unwrap_err();
        }
    }
}

#[test]
fn errors_name_key_value_and_range() {
    let mut settings = Settings::shipped();
    let message = |e: ParamsError| e.to_string();
    let high = message(settings.merge_setting("train.sh_degree=4").unwrap_err());
    assert_eq!(
        high,
        "parameter train.sh_degree = 4 is out of range, expected a number in [0, 3] (whole)"
    );
    let unknown = message(settings.merge_setting("train.step=4").unwrap_err());
    assert!(
        unknown.contains("\"train.step\"") && unknown.contains("train.steps"),
        "{unknown}"
    );
    assert!(message(settings.merge_setting("steps").unwrap_err()).contains("key=value"));
    assert!(settings.merge_setting("backend=cuda").is_err());
}

#[test]
fn a_whole_number_is_fine_where_a_fraction_may_stand() {
    let mut settings = Settings::shipped();
    settings.merge_setting("select.min_flow=1").unwrap();
    settings.merge_setting("publish.namespace=7").unwrap();
    settings.merge_setting("train.steps=5e2").unwrap();
    let params = settings.params().unwrap();
    assert_eq!((params.select.min_flow, params.train.steps), (1.0, 500));
}

#[test]
fn every_preset_is_shipped_and_names_known_keys() {
    for entry in std::fs::read_dir("launch/presets").unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        Settings::shipped().merge_preset(&name).unwrap();
    }
    let error = Settings::shipped().merge_preset("papr").unwrap_err();
    assert_eq!(
        error.to_string(),
        "\"papr\" is no preset, expected paper, 3dgs"
    );
}

#[test]
fn two_ways_to_grow_are_one_too_many() {
    let mut settings = Settings::shipped();
    settings.merge_preset("3dgs").unwrap();
    settings.params().unwrap();
    settings.merge_setting("mcmc.enabled=true").unwrap();
    let error = settings.params().unwrap_err().to_string();
    assert!(
        error.contains("densify.enabled") && error.contains("mcmc.enabled"),
        "{error}"
    );
}

#[test]
fn settings_go_over_a_preset_and_a_preset_over_the_defaults() {
    let mut settings = Settings::shipped();
    let seed = settings.params().unwrap().seed;
    settings.merge_preset("paper").unwrap();
    settings.merge_setting("train.steps=70").unwrap();
    let params = settings.params().unwrap();
    assert_eq!(
        (params.train.steps, params.train.sh_degree, params.seed),
        (70, 3, seed)
    );
}

/// Keys whose default is another one since version 0.1.0.
const NEW_DEFAULTS: [&str; 11] = [
    "geometry",
    "map.max_splats",
    "map.snapshot_secs",
    "mcmc.noise",
    "train.lr_mean",
    "train.lr_opacity",
    "train.lr_quat",
    "train.lr_scale",
    "train.lr_sh",
    "train.seeds_per_keyframe",
    "train.sh_degree",
];

#[test]
fn a_whole_file_of_version_0_1_0_reads_as_the_same_defaults() {
    let mut settings = Settings::shipped();
    let path = Path::new("src/params/params_0_1_0.yaml");
    settings.merge_file(path).unwrap();
    for key in NEW_DEFAULTS {
        let default = &defaults()[key];
        assert_ne!(
            settings.value(key),
            Some(default),
            "{key} is no new default"
        );
        settings.set(key, default.clone()).unwrap();
    }
    for (key, value) in settings.entries() {
        let default = &defaults()[key];
        let same = value == default || value.as_f64().is_some_and(|v| Some(v) == default.as_f64());
        assert!(same, "{key}: {value}, now {default}");
    }
    assert_eq!(settings.params().unwrap(), Params::default());
    // 71 keys; and of the values `direct` and `image`, which were defaults.
    let warnings = settings.take_warnings();
    assert_eq!(warnings.len(), 71 + 2, "{warnings:#?}");
    assert!(settings.take_warnings().is_empty());
}

#[test]
fn the_nearest_key_of_an_old_one_is_the_new_one() {
    let error = Settings::shipped().merge_setting("map.step=3").unwrap_err();
    assert!(error.to_string().contains("train.steps"), "{error}");
}
