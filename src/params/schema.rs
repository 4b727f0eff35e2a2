//! The JSON schema of `Params` -> one descriptor per dotted key, and the check of each value against it.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use schemars::schema_for;
use serde_json::Value;

use crate::params::params::Params;
use splat_ros::ros2::parameter_store::{Descriptor, LiveRos2Params, Range};

static DESCRIPTORS: LazyLock<BTreeMap<String, Descriptor>> = LazyLock::new(|| {
    let schema = schema_for!(Params).to_value();
    let mut found = BTreeMap::new();
    flatten(&schema, "", &schema, &mut found);
    found
});

/// Every parameter by its key.
pub fn descriptors() -> &'static BTreeMap<String, Descriptor> {
    &DESCRIPTORS
}

/// `node` is the schema of what `prefix` leads to.
fn flatten(root: &Value, prefix: &str, node: &Value, out: &mut BTreeMap<String, Descriptor>) {
    let Some(fields) = resolved(root, node)["properties"].as_object() else {
        let described = descriptor(root, prefix, node);
        out.insert(prefix.to_owned(), described);
        return;
    };
    for (name, field) in fields {
        let key = if prefix.is_empty() {
            name.clone()
        } else {
            format!("{prefix}.{name}")
        };
        flatten(root, &key, field, out);
    }
}

/// The definition that a node refers to, or itself.
fn resolved<'a>(root: &'a Value, node: &'a Value) -> &'a Value {
    let target = node["$ref"].as_str().and_then(|path| {
        let pointer = path.strip_prefix('#')?;
        root.pointer(pointer)
    });
    target.unwrap_or(node)
}

fn descriptor(root: &Value, key: &str, node: &Value) -> Descriptor {
    let text = node["description"].as_str().unwrap_or_default();
    let words: Vec<&str> = text.split_whitespace().collect();
    Descriptor {
        key: key.to_owned(),
        range: range(resolved(root, node)),
        unit: node["unit"].as_str().map(str::to_owned),
        text: words.join(" "),
        is_live: LiveRos2Params::KEYS.contains(&key),
    }
}

fn range(node: &Value) -> Range {
    let names = choices(node);
    if !names.is_empty() {
        return Range::Choice(names);
    }
    let kind = node["type"].as_str().unwrap_or_default();
    let bound = |name: &str, none: f64| node[name].as_f64().unwrap_or(none);
    match kind {
        "boolean" => Range::Flag,
        "integer" | "number" => Range::Number {
            min: bound("minimum", f64::NEG_INFINITY),
            max: bound("maximum", f64::INFINITY),
            is_whole: kind == "integer",
        },
        _ => Range::Text,
    }
}

/// Variants with and without a description stand apart in the schema: `oneOf` of `const`s and `enum`s.
fn choices(node: &Value) -> Vec<String> {
    let alone = node["const"].as_str().map(str::to_owned);
    let listed = node["enum"].as_array().into_iter().flatten();
    let listed = listed.filter_map(|name| name.as_str().map(str::to_owned));
    let parts = node["oneOf"].as_array().into_iter().flatten();
    let mut names: Vec<String> = alone.into_iter().chain(listed).collect();
    names.extend(parts.flat_map(choices));
    names
}

/// Whether a value is of the right kind and within its bounds.
pub fn allows(range: &Range, value: &Value) -> bool {
    match range {
        Range::Number { min, max, is_whole } => value
            .as_f64()
            .is_some_and(|v| v >= *min && v <= *max && !(*is_whole && v.fract() != 0.0)),
        Range::Choice(names) => value
            .as_str()
            .is_some_and(|v| names.iter().any(|name| name == v)),
        Range::Flag => value.is_boolean(),
        Range::Text => value.is_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use splat_engine::loss_weights::LossWeights;

    #[test]
    fn every_parameter_has_a_text_and_every_number_both_bounds() {
        assert!(descriptors().len() > 180, "{}", descriptors().len());
        for (key, descriptor) in descriptors() {
            assert!(descriptor.text.len() > 1, "{key}: {descriptor:?}");
            if let Range::Number { min, max, .. } = descriptor.range {
                assert!(min.is_finite() && max.is_finite(), "{key}: {descriptor:?}");
                assert!(min < max, "{key}: {descriptor:?}");
            }
        }
    }

    #[test]
    fn type_range_unit_choices_and_text_stand_at_the_fields() {
        let side = &descriptors()["source.max_side"];
        assert!(side.text.starts_with("Longer side"), "{side:?}");
        assert_eq!(side.unit.as_deref(), Some("px"));
        assert_eq!(
            side.range,
            Range::Number {
                min: 32.0,
                max: 4096.0,
                is_whole: true
            }
        );
        let jump = &descriptors()["ros2.on_time_jump"];
        let names = ["end", "reset", "ignore"].map(str::to_owned).to_vec();
        assert_eq!(jump.range, Range::Choice(names));
        assert!(jump.is_live && !side.is_live);
        let names = ["auto", "wgpu", "cpu"].map(str::to_owned).to_vec();
        assert_eq!(descriptors()["backend"].range, Range::Choice(names));
        assert_eq!(descriptors()["geometry"].range, Range::Text);
        assert_eq!(descriptors()["sequential"].range, Range::Flag);
    }

    #[test]
    fn every_weight_of_the_loss_is_a_parameter() {
        for name in LossWeights::NAMES {
            let keys = ["train", "mcmc"].map(|group| format!("{group}.{name}"));
            let found = keys.iter().filter(|key| descriptors().contains_key(*key));
            assert_eq!(found.count(), 1, "{name}");
        }
    }

    #[test]
    fn every_live_key_is_a_parameter() {
        for key in LiveRos2Params::KEYS {
            assert!(descriptors().contains_key(key), "{key}");
        }
    }
}
