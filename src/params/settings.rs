//! Defaults, preset, file and `--set` -> checked values by dotted key -> `Params`.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::params::aliases::{OLD_KEYS, new_key, new_value};
use crate::params::error::ParamsError;
use crate::params::file::{flatten, parse_file};
use crate::params::params::Params;
use crate::params::schema::{allows, descriptors};
use splat_ros::ros2::parameter_store::Range;

/// Named sets of values in `launch/presets`.
const PRESETS: [(&str, &str); 2] = [
    ("paper", include_str!("../../launch/presets/paper.yaml")),
    ("3dgs", include_str!("../../launch/presets/3dgs.yaml")),
];

/// Values by dotted key; every parameter is there.
#[derive(Debug, Clone)]
pub struct Settings {
    values: BTreeMap<String, Value>,
    /// Old names that were used, with what replaces them.
    warnings: BTreeSet<String>,
    reported: BTreeSet<String>,
}

impl Settings {
    /// The defaults.
    pub fn shipped() -> Self {
        Self {
            values: defaults(),
            warnings: BTreeSet::new(),
            reported: BTreeSet::new(),
        }
    }

    /// Applies one of the shipped presets over what is there.
    pub fn merge_preset(&mut self, name: &str) -> Result<(), ParamsError> {
        let preset = PRESETS.iter().find(|(known, _)| *known == name);
        let (_, text) = preset.ok_or_else(|| ParamsError::Preset {
            found: name.to_owned(),
            known: PRESETS.map(|(known, _)| known).join(", "),
        })?;
        self.merge_text(text, &PathBuf::from(name))
    }

    /// Applies a user's parameter file over what is there.
    pub fn merge_file(&mut self, path: &Path) -> Result<(), ParamsError> {
        let text = std::fs::read_to_string(path).map_err(|e| ParamsError::Read {
            reason: e.to_string(),
            path: path.to_owned(),
        })?;
        self.merge_text(&text, path)
    }

    /// `path` is for the error only.
    fn merge_text(&mut self, text: &str, path: &Path) -> Result<(), ParamsError> {
        let tree = parse_file(text).map_err(|reason| ParamsError::Form {
            reason,
            path: path.to_owned(),
        })?;
        let mut values = BTreeMap::new();
        flatten("", &tree, &mut values);
        let mut changes = values.into_iter();
        changes.try_for_each(|(key, value)| self.set(&key, value))
    }

    /// Applies one `key=value` of the command line; the value is YAML.
    pub fn merge_setting(&mut self, setting: &str) -> Result<(), ParamsError> {
        let fail = || ParamsError::Setting {
            found: setting.to_owned(),
        };
        let (key, text) = setting.split_once('=').ok_or_else(fail)?;
        let key = key.trim();
        let known = new_key(key).unwrap_or_else(|| key.to_owned());
        let is_text = descriptors()
            .get(&known)
            .is_some_and(|found| matches!(found.range, Range::Text | Range::Choice(_)));
        let value = if is_text {
            Value::String(text.trim().to_owned())
        } else {
            serde_saphyr::from_str(text).unwrap_or_else(|_| Value::String(text.to_owned()))
        };
        self.set(key, value)
    }

    /// Sets one key, by its old or new name, after checking it against its range.
    pub fn set(&mut self, key: &str, value: Value) -> Result<(), ParamsError> {
        let (key, value) = self.renamed(key, value);
        let Some(descriptor) = descriptors().get(&key) else {
            let nearest = self.nearest_key(&key);
            return Err(ParamsError::UnknownKey { key, nearest });
        };
        let range = &descriptor.range;
        if !allows(range, &value) {
            return Err(ParamsError::OutOfRange {
                key,
                found: value.to_string(),
                expected: range.to_string(),
            });
        }
        // 500.0 means 500 where a whole number is asked for; serde would refuse it.
        let is_whole = matches!(range, Range::Number { is_whole: true, .. });
        let value = match value.as_f64() {
            Some(v) if is_whole => Value::from(v as i64),
            _ => value,
        };
        self.values.insert(key, value);
        Ok(())
    }

    /// The names of this version; a warning is kept for each that has changed.
    fn renamed(&mut self, key: &str, value: Value) -> (String, Value) {
        let known = match new_key(key).filter(|new| descriptors().contains_key(new)) {
            None => key.to_owned(),
            Some(new) => {
                let warning = format!("parameter {key} is now called {new}; use the new name");
                self.warnings.insert(warning);
                new
            }
        };
        match value.as_str().and_then(|old| new_value(&known, old)) {
            None => (known, value),
            Some(new) => {
                let warning =
                    format!("parameter {known} = {value} is now called {new}; use the new value");
                self.warnings.insert(warning);
                (known, new.into())
            }
        }
    }

    /// Old names that were used since the last call; each is returned once.
    pub fn take_warnings(&mut self) -> Vec<String> {
        let fresh: Vec<_> = self.warnings.difference(&self.reported).cloned().collect();
        self.reported.extend(fresh.iter().cloned());
        fresh
    }

    /// Logs what `take_warnings` returns.
    pub fn log_warnings(&mut self) {
        for warning in self.take_warnings() {
            tracing::warn!("{warning}");
        }
    }

    pub fn value(&self, key: &str) -> Option<&Value> {
        self.values.get(key)
    }

    /// All keys with their values, for logs and reports.
    pub fn entries(&self) -> impl Iterator<Item = (&str, &Value)> {
        self.values.iter().map(|(key, value)| (key.as_str(), value))
    }

    /// The checked structs.
    pub fn params(&self) -> Result<Params, ParamsError> {
        let mut root = serde_json::Map::new();
        for (key, value) in &self.values {
            insert(&mut root, key, value);
        }
        let params: Params =
            serde_json::from_value(Value::Object(root)).expect("each value fits its descriptor");
        let select = &params.select;
        if select.batch_overlap >= select.batch_size {
            return Err(ParamsError::Overlap {
                overlap: select.batch_overlap,
                size: select.batch_size,
            });
        }
        if params.densify.enabled && params.mcmc.enabled {
            return Err(ParamsError::TwoGrowths);
        }
        Ok(params)
    }

    /// One of the same last part, else one that holds it; of several the one that begins most alike. An old key stands for
    /// its new one.
    fn nearest_key(&self, key: &str) -> Option<String> {
        let last = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
        let tail = last(key);
        let alike = |(known, _): &(&str, &str)| {
            let pairs = known.bytes().zip(key.bytes());
            Reverse(pairs.take_while(|(a, b)| a == b).count())
        };
        let keys = || {
            let present = self.values.keys().map(|key| (key.as_str(), key.as_str()));
            present.chain(OLD_KEYS)
        };
        let same = keys().filter(|(known, _)| last(known) == tail);
        let holding = keys().filter(|(known, _)| known.contains(&tail));
        let nearest = same.min_by_key(alike).or_else(|| holding.min_by_key(alike));
        nearest.map(|(_, new)| new.to_owned())
    }
}

/// Values of `Params::default()` by dotted key.
pub fn defaults() -> BTreeMap<String, Value> {
    // By text, since `to_value` widens f32: 0.2 would become 0.20000000298.
    let text = serde_json::to_string(&Params::default()).expect("parameters are plain data");
    let tree: Value = serde_json::from_str(&text).expect("serde_json reads what it wrote");
    let mut values = BTreeMap::new();
    flatten("", &tree, &mut values);
    values
}

/// A value by dotted key, into the groups that the key names.
fn insert(root: &mut serde_json::Map<String, Value>, key: &str, value: &Value) {
    let Some((group, rest)) = key.split_once('.') else {
        root.insert(key.to_owned(), value.clone());
        return;
    };
    let group = root
        .entry(group)
        .or_insert_with(|| Value::Object(serde_json::Map::new()));
    if let Value::Object(group) = group {
        insert(group, rest, value);
    }
}

#[cfg(test)]
mod tests;
