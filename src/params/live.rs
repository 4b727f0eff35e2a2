//! Parameters of a running node: a few may change, others are refused with the reason.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::Value;

use crate::params::aliases::new_key;
use crate::params::error::ParamsError;
use crate::params::schema::descriptors;
use crate::params::settings::Settings;
use splat_io::latest::Latest;
use splat_ros::ros2::parameter_store::{Descriptor, LiveRos2Params, ParameterStore};

/// Settings that several threads read and one changes.
#[derive(Debug)]
pub struct Live {
    settings: Mutex<Settings>,
    /// What the stages read of them.
    pub ros2: Arc<Latest<LiveRos2Params>>,
}

impl Live {
    pub fn new(settings: Settings) -> Result<Self, ParamsError> {
        let ros2 = LiveRos2Params::of(&settings.params()?.ros2);
        Ok(Self {
            settings: Mutex::new(settings),
            ros2: Arc::new(Latest::new(ros2)),
        })
    }

    /// All changes or none.
    pub fn change(&self, changes: &[(String, Value)]) -> Result<(), ParamsError> {
        let mut settings = self.lock();
        let mut changed = settings.clone();
        for (key, value) in changes {
            changed.set(key, value.clone())?;
            let key = new_key(key).unwrap_or_else(|| key.clone());
            // To set what is set already is no change: parameter tools write whole files.
            let is_same = changed.value(&key) == settings.value(&key);
            if !is_same && !LiveRos2Params::KEYS.contains(&key.as_str()) {
                return Err(ParamsError::Fixed { key });
            }
        }
        self.ros2.set(LiveRos2Params::of(&changed.params()?.ros2));
        changed.log_warnings();
        *settings = changed;
        Ok(())
    }

    fn lock(&self) -> MutexGuard<'_, Settings> {
        // Settings are exchanged whole: a panic leaves the old ones.
        self.settings.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ParameterStore for Live {
    fn list(&self) -> Vec<Descriptor> {
        descriptors().values().cloned().collect()
    }

    fn get(&self, key: &str) -> Option<Value> {
        let key = new_key(key).unwrap_or_else(|| key.to_owned());
        self.lock().value(&key).cloned()
    }

    fn set(&self, changes: &[(String, Value)]) -> Result<(), String> {
        self.change(changes).map_err(|e| e.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(key: &str, value: impl Into<Value>) -> (String, Value) {
        (key.to_owned(), value.into())
    }

    fn live() -> Live {
        Live::new(Settings::shipped()).unwrap()
    }

    #[test]
    fn live_parameters_change_and_others_are_refused_with_the_reason() {
        let live = live();
        live.set(&[change("ros2.image_timeout", 7.5)]).unwrap();
        assert_eq!(live.ros2.get().image_timeout, 7.5);
        let refused = live.set(&[change("train.steps", 7)]).unwrap_err();
        assert!(refused.contains("start"), "{refused}");
        let out = live.set(&[change("ros2.image_timeout", -1.0)]).unwrap_err();
        assert!(out.contains("out of range"), "{out}");
        live.set(&[change("train.steps", live.get("train.steps").unwrap())])
            .unwrap();
    }

    #[test]
    fn an_old_key_reads_and_sets_the_new_one() {
        let live = live();
        live.set(&[change("ros2.silence_secs", 7.5)]).unwrap();
        assert_eq!(live.ros2.get().image_timeout, 7.5);
        assert_eq!(live.get("ros2.silence_secs"), Some(7.5.into()));
        let refused = live.set(&[change("map.steps", 7)]).unwrap_err();
        assert!(refused.contains("train.steps"), "{refused}");
    }

    #[test]
    fn of_several_changes_all_are_made_or_none() {
        let live = live();
        let before = live.ros2.get();
        live.set(&[change("ros2.image_timeout", 9.0), change("seed", 12_345)])
            .unwrap_err();
        assert_eq!(live.ros2.get(), before);
        let kept = live.get("ros2.image_timeout");
        assert_eq!(kept, Some(before.image_timeout.into()));
    }

    #[test]
    fn each_live_key_reaches_the_stages() {
        let values = [
            (5.5.into(), "image_timeout"),
            (6.5.into(), "camera_info_timeout"),
            (7.5.into(), "odometry_timeout"),
            (Value::from("ignore"), "on_time_jump"),
        ];
        assert_eq!(values.len(), LiveRos2Params::KEYS.len());
        for (value, name) in values {
            let live = live();
            let before = live.ros2.get();
            live.set(&[change(&format!("ros2.{name}"), value)]).unwrap();
            assert_ne!(live.ros2.get(), before, "{name}");
        }
    }
}
