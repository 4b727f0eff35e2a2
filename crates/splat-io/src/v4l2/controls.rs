//! Exposure, gain, focus and controls by name -> the camera. What it lacks is said and left out.

use crate::camera::modes::names;
use crate::params::CameraParams;
use crate::v4l2::answers::Control;
use crate::v4l2::sys::Device;

// Ids of linux/v4l2-controls.h.
const AUTO_GAIN: u32 = 0x0098_0912;
const GAIN: u32 = 0x0098_0913;
const EXPOSURE_AUTO: u32 = 0x009a_0901;
const EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
const FOCUS_ABSOLUTE: u32 = 0x009a_090a;
const FOCUS_AUTO: u32 = 0x009a_090c;
/// A value of `EXPOSURE_AUTO`.
const MANUAL: i32 = 1;
/// The unit of `EXPOSURE_ABSOLUTE`.
const EXPOSURE_UNIT_SECS: f64 = 1e-4;

const IS_DISABLED: u32 = 0x1;
const IS_READ_ONLY: u32 = 0x4;
const KIND_INTEGER: u32 = 1;
const KIND_BOOLEAN: u32 = 2;
const KIND_MENU: u32 = 3;
const KIND_BUTTON: u32 = 4;
const KIND_INTEGER_MENU: u32 = 9;

/// Sets what the parameters ask for.
pub(crate) fn apply(device: &Device, wish: &CameraParams) {
    let offered = device.controls();
    let put = |what: &str, id: u32, value: i32| {
        let found = offered.iter().find(|control| control.id == id);
        let done = found.ok_or_else(|| "the camera has no such control".to_owned());
        if let Err(reason) = done.and_then(|control| set_one(device, control, value)) {
            tracing::warn!("{what} is left as it is: {reason}");
        }
    };
    let has = |id: u32| offered.iter().any(|control| control.id == id);
    if wish.exposure > 0.0 {
        if has(EXPOSURE_AUTO) {
            put("automatic exposure", EXPOSURE_AUTO, MANUAL);
        }
        let units = (wish.exposure / EXPOSURE_UNIT_SECS).round() as i32;
        put("source.camera.exposure", EXPOSURE_ABSOLUTE, units.max(1));
    }
    if wish.gain >= 0 {
        if has(AUTO_GAIN) {
            put("automatic gain", AUTO_GAIN, 0);
        }
        put("source.camera.gain", GAIN, wish.gain);
    }
    if wish.lock_focus || wish.focus >= 0 {
        put("automatic focus", FOCUS_AUTO, 0);
    }
    if wish.focus >= 0 {
        put("source.camera.focus", FOCUS_ABSOLUTE, wish.focus);
    }
    for pair in names(&wish.controls) {
        let value = pair.split_once('=').and_then(|(name, value)| {
            let value = value.trim().parse::<i32>().ok()?;
            Some((name, value))
        });
        let done = match value {
            Some((name, value)) => set_named(device, &offered, name, value),
            None => Err("expected NAME=WHOLE NUMBER".to_owned()),
        };
        if let Err(reason) = done {
            tracing::warn!("{pair:?} of source.camera.controls is left out: {reason}");
        }
    }
}

pub(crate) fn set(device: &Device, name: &str, value: i32) -> Result<(), String> {
    set_named(device, &device.controls(), name, value)
}

fn set_named(device: &Device, offered: &[Control], name: &str, value: i32) -> Result<(), String> {
    let control = offered.iter().find(|c| key(&c.name) == key(name));
    let control = control.ok_or_else(|| {
        let known: Vec<String> = offered
            .iter()
            .filter(|c| is_set_by_number(c))
            .map(|c| key(&c.name))
            .collect();
        format!(
            "the camera has no control {:?}, but {}",
            key(name),
            known.join(", ")
        )
    })?;
    set_one(device, control, value)
}

fn set_one(device: &Device, control: &Control, value: i32) -> Result<(), String> {
    if control.kind != KIND_BUTTON && !(control.min..=control.max).contains(&value) {
        let (min, max) = (control.min, control.max);
        return Err(format!("{value} is outside {min} to {max}"));
    }
    device
        .set_control(control.id, value)
        .map_err(|e| format!("{}: {e}", control.name))
}

/// `Exposure Time, Absolute` -> `exposure_time_absolute`.
fn key(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric());
    let words: Vec<String> = words
        .filter(|w| !w.is_empty())
        .map(str::to_ascii_lowercase)
        .collect();
    words.join("_")
}

fn is_set_by_number(control: &Control) -> bool {
    matches!(
        control.kind,
        KIND_INTEGER | KIND_BOOLEAN | KIND_MENU | KIND_BUTTON | KIND_INTEGER_MENU
    ) && control.flags & (IS_DISABLED | IS_READ_ONLY) == 0
}

/// `name=min..max` of those that can be set.
pub(crate) fn listing(controls: &[Control]) -> Vec<String> {
    controls
        .iter()
        .filter(|control| is_set_by_number(control))
        .map(|control| format!("{}={}..{}", key(&control.name), control.min, control.max))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn controls_are_named_as_a_parameter_can_be_typed() {
        assert_eq!(key("Exposure Time, Absolute"), "exposure_time_absolute");
        assert_eq!(key(" White balance (auto)"), "white_balance_auto");
        assert_eq!(key("power_line_frequency"), "power_line_frequency");
    }
}
