//! Parameters that may change while the node runs, and those that say why they may not.

use std::sync::{Mutex, MutexGuard, PoisonError};

use serde_json::Value;

use crate::config::{ConfigError, Settings};

/// What is looked at again and again; all else is read once, at the start.
const LIVE_KEYS: [&str; 4] = [
    "ros2.silence_secs",
    "ros2.calibration_secs",
    "ros2.odometry_secs",
    "ros2.on_time_jump",
];

/// Settings that several threads read and one changes.
#[derive(Debug)]
pub struct Live {
    settings: Mutex<Settings>,
}

impl Live {
    pub fn new(settings: Settings) -> Self {
        Self {
            settings: Mutex::new(settings),
        }
    }

    pub fn is_live(key: &str) -> bool {
        LIVE_KEYS.contains(&key)
    }

    /// All changes or none.
    pub fn set(&self, changes: &[(String, Value)]) -> Result<(), ConfigError> {
        let mut settings = self.lock();
        let mut changed = settings.clone();
        for (key, value) in changes {
            changed.set(key, value.clone())?;
            // To set what is set already is no change: parameter tools write whole files.
            let is_same = changed.value(key) == settings.value(key);
            if !is_same && !Self::is_live(key) {
                return Err(ConfigError::Fixed { key: key.clone() });
            }
        }
        *settings = changed;
        Ok(())
    }

    pub fn value(&self, key: &str) -> Option<Value> {
        self.lock().value(key).cloned()
    }

    /// All keys in order.
    pub fn keys(&self) -> Vec<String> {
        self.lock()
            .entries()
            .map(|(key, _)| key.to_owned())
            .collect()
    }

    /// Of a key that params.yaml has as a number.
    pub fn number(&self, key: &str) -> f64 {
        let value = self.lock().value(key).and_then(Value::as_f64);
        value.expect("params.yaml has this key as a number")
    }

    /// Of a key that params.yaml has as a choice or text.
    pub fn choice<T: serde::de::DeserializeOwned>(&self, key: &str) -> T {
        let value = self.value(key).expect("params.yaml has this key");
        serde_json::from_value(value).expect("ranges allow nothing else")
    }

    fn lock(&self) -> MutexGuard<'_, Settings> {
        // Settings are exchanged whole: a panic leaves the old ones.
        self.settings.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(key: &str, value: impl Into<Value>) -> (String, Value) {
        (key.to_owned(), value.into())
    }

    #[test]
    fn live_parameters_change_and_others_say_why_not() {
        let live = Live::new(Settings::shipped());
        live.set(&[change("ros2.silence_secs", 7.5)]).unwrap();
        assert_eq!(live.number("ros2.silence_secs"), 7.5);
        let refused = live.set(&[change("map.steps", 7)]).unwrap_err();
        assert!(refused.to_string().contains("start"), "{refused}");
        let out = live.set(&[change("ros2.silence_secs", -1.0)]).unwrap_err();
        assert!(out.to_string().contains("out of range"), "{out}");
        live.set(&[change("map.steps", live.value("map.steps").unwrap())])
            .unwrap();
    }

    #[test]
    fn of_several_changes_all_are_made_or_none() {
        let live = Live::new(Settings::shipped());
        let before = live.number("ros2.silence_secs");
        live.set(&[change("ros2.silence_secs", 9.0), change("seed", 12_345)])
            .unwrap_err();
        assert_eq!(live.number("ros2.silence_secs"), before);
    }

    #[test]
    fn every_live_key_is_in_params_yaml() {
        let settings = Settings::shipped();
        for key in LIVE_KEYS {
            assert!(settings.value(key).is_some(), "{key}");
        }
    }
}
