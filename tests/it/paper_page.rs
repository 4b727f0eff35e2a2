//! docs/PAPER.md: every value in its tables is the program's, and no value of the preset is missing.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::Value;
use splat_mapper::params::settings::Settings;

const PAGE: &str = include_str!("../../docs/PAPER.md");

/// (parameter, value in the preset, default) of each row with seven cells whose fourth names a parameter.
fn rows() -> Vec<(&'static str, &'static str, &'static str)> {
    PAGE.lines()
        .filter_map(|line| {
            let cells: Vec<&str> = line.strip_prefix('|')?.split('|').map(str::trim).collect();
            let name = cells.get(3)?.strip_prefix('`')?.strip_suffix('`')?;
            Some((name, *cells.get(4)?, *cells.get(5)?))
        })
        .collect()
}

fn values(settings: &Settings) -> BTreeMap<String, Value> {
    let entries = settings.entries();
    entries
        .map(|(key, value)| (key.to_owned(), value.clone()))
        .collect()
}

/// Numbers as numbers: 0.00015 is 1.5e-4.
fn is_same(cell: &str, value: &Value) -> bool {
    match (value, cell.parse::<f64>()) {
        (Value::String(text), _) => text == cell,
        (Value::Number(number), Ok(written)) => {
            let number = number.as_f64().unwrap();
            (number - written).abs() <= 1e-6 * written.abs()
        }
        (Value::Bool(on), _) => cell == if *on { "true" } else { "false" },
        _ => false,
    }
}

#[test]
fn the_page_has_the_values_of_the_preset_and_the_defaults() {
    let shipped = values(&Settings::shipped());
    let mut settings = Settings::shipped();
    settings.merge_preset("paper").unwrap();
    let preset = values(&settings);
    let rows = rows();
    assert!(rows.len() > 40, "{} rows", rows.len());
    for (name, of_preset, default) in &rows {
        let (Some(in_preset), Some(shipped)) = (preset.get(*name), shipped.get(*name)) else {
            panic!("docs/PAPER.md: {name} is no parameter");
        };
        assert!(
            is_same(of_preset, in_preset),
            "{name}: {of_preset}, but the preset has {in_preset}"
        );
        assert!(
            is_same(default, shipped),
            "{name}: {default}, but the default is {shipped}"
        );
    }
    let named: BTreeSet<&str> = rows.iter().map(|row| row.0).collect();
    let differing = preset
        .iter()
        .filter(|(key, value)| shipped[*key] != **value);
    for (key, _) in differing {
        assert!(
            named.contains(key.as_str()),
            "docs/PAPER.md has no row of {key}"
        );
    }
}
