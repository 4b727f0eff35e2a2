//! Parameters keep their ranges, and errors say which.

use super::*;

#[test]
fn shipped_values_fit_their_own_ranges_and_the_structs() {
    let settings = Settings::shipped();
    for (key, value) in &settings.values {
        let (range, whole) = &settings.ranges[key];
        assert!(
            range.allows(value, *whole),
            "{key} = {value} is outside {range}"
        );
    }
    settings.params().unwrap();
}

#[test]
fn every_numeric_bound_can_be_set_and_read_back() {
    for key in Settings::shipped().values.keys() {
        let mut settings = Settings::shipped();
        if let (Range::Number { min, max }, _) = settings.ranges[key].clone() {
            settings.set(key, Value::from(min)).unwrap();
            settings.set(key, Value::from(max)).unwrap();
            let fits = settings.params();
            assert!(
                matches!(fits, Ok(_) | Err(ConfigError::Overlap { .. })),
                "{key}: {fits:?}"
            );
            settings.set(key, Value::from(max + 1.0)).unwrap_err();
        }
    }
}

#[test]
fn errors_name_key_value_and_range() {
    let mut settings = Settings::shipped();
    let message = |e: ConfigError| e.to_string();
    let high = message(settings.merge_setting("map.sh_degree=4").unwrap_err());
    assert_eq!(
        high,
        "parameter map.sh_degree = 4 is out of range, expected a number in [0, 3] (whole)"
    );
    let unknown = message(settings.merge_setting("map.step=4").unwrap_err());
    assert!(
        unknown.contains("\"map.step\"") && unknown.contains("map.steps"),
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
    settings.merge_setting("map.steps=5e2").unwrap();
    let params = settings.params().unwrap();
    assert_eq!((params.select.min_flow, params.map.steps), (1.0, 500));
}

#[test]
fn every_preset_is_shipped_and_names_known_keys() {
    for entry in std::fs::read_dir("launch/presets").unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        Settings::shipped().merge_preset(&name).unwrap();
    }
    let error = Settings::shipped().merge_preset("papr").unwrap_err();
    assert_eq!(error.to_string(), "\"papr\" is no preset, expected paper");
}

#[test]
fn settings_go_over_a_preset_and_a_preset_over_the_defaults() {
    let mut settings = Settings::shipped();
    let seed = settings.params().unwrap().seed;
    settings.merge_preset("paper").unwrap();
    settings.merge_setting("map.steps=70").unwrap();
    let params = settings.params().unwrap();
    assert_eq!(
        (params.map.steps, params.map.sh_degree, params.seed),
        (70, 3, seed)
    );
}
