//! Keys and values of earlier versions: still accepted; a warning names the new one.

/// Groups of keys: old prefix, new prefix.
const GROUPS: [(&str, &str); 1] = [("known.", "ground_truth.")];

/// Old key, new key.
pub const OLD_KEYS: [(&str, &str); 60] = [
    ("source.names", "source.include_prefixes"),
    ("source.held_out_names", "source.holdout_prefixes"),
    ("source.pick", "source.subsample"),
    ("select.all", "select.every_frame"),
    ("select.max_wait", "select.max_blur_wait"),
    ("sfm.old_poses", "sfm.local_ba_prior"),
    ("sfm.max_drift", "sfm.max_loop_correction"),
    ("mvs.n_depths", "mvs.depth_planes"),
    ("mvs.n_sources", "mvs.source_views"),
    ("align.whole", "align.global_ba_keyframes"),
    ("align.join", "align.registration"),
    ("align.history", "align.fixed_keyframes"),
    ("align.max_drift", "align.max_loop_correction"),
    ("align.max_turn_deg", "align.max_rotation_deg"),
    ("track.max_waiting", "track.max_deferred_frames"),
    ("map.load", "map.resume"),
    ("map.save_pictures", "map.save_images_mib"),
    ("map.max_keyframes_in_ram", "map.max_resident_keyframes"),
    ("map.max_disk_mib", "map.max_page_file_mib"),
    ("map.steps", "train.steps"),
    ("map.final_share", "train.final_share"),
    ("map.max_side", "train.max_side"),
    ("map.seeds_per_keyframe", "train.seeds_per_keyframe"),
    ("map.sh_degree", "train.sh_degree"),
    ("map.sh_interval", "train.sh_interval"),
    ("map.ssim_weight", "train.ssim_weight"),
    ("map.depth_weight", "train.depth_weight"),
    ("map.depth_mode", "train.depth_mode"),
    ("map.epipolar_weight", "train.epipolar_weight"),
    ("map.lr_mean", "train.lr_mean"),
    ("map.lr_scale", "train.lr_scale"),
    ("map.lr_quat", "train.lr_quat"),
    ("map.lr_opacity", "train.lr_opacity"),
    ("map.lr_sh", "train.lr_sh"),
    ("map.lr_rotation", "train.lr_rotation"),
    ("map.lr_translation", "train.lr_translation"),
    ("map.lr_focal", "train.lr_focal"),
    ("map.lr_exposure", "train.lr_exposure"),
    ("map.lr_refiner", "train.lr_pose_network"),
    ("map.transient", "train.robust_inlier_fraction"),
    ("map.pose", "train.pose_opt"),
    ("map.mcmc", "mcmc.enabled"),
    ("map.mcmc_every", "mcmc.every"),
    ("map.mcmc_start", "mcmc.start"),
    ("map.growth", "mcmc.growth"),
    ("map.noise", "mcmc.noise"),
    ("map.opacity_reg", "mcmc.opacity_reg"),
    ("map.scale_reg", "mcmc.scale_reg"),
    ("map.min_opacity", "mcmc.min_opacity"),
    ("map.copies", "mcmc.relocation"),
    ("scale.known", "scale.source"),
    ("publish.mount", "publish.base_from_camera"),
    ("publish.folder", "publish.map_directory"),
    ("publish.full_secs", "publish.full_map_period"),
    ("publish.slew_speed", "publish.max_correction_speed"),
    (
        "publish.slew_turn_deg",
        "publish.max_correction_rotation_deg",
    ),
    ("publish.linger_secs", "publish.shutdown_delay"),
    ("ros2.silence_secs", "ros2.image_timeout"),
    ("ros2.calibration_secs", "ros2.camera_info_timeout"),
    ("ros2.odometry_secs", "ros2.odometry_timeout"),
];

/// New key, old value, new value.
const VALUES: [(&str, &str, &str); 7] = [
    ("geometry", "known", "ground_truth"),
    ("sfm.local_ba_prior", "held", "fixed"),
    ("train.pose_opt", "direct", "per_view"),
    ("train.pose_opt", "shared", "network"),
    ("train.pose_opt", "held", "fixed"),
    ("mcmc.relocation", "picture", "image"),
    ("mcmc.relocation", "line", "paper"),
];

/// The new key of an old one; `None` where the key has not changed.
pub fn new_key(key: &str) -> Option<String> {
    let of_group = GROUPS.iter().find_map(|(old, new)| {
        let rest = key.strip_prefix(old)?;
        Some(format!("{new}{rest}"))
    });
    let of_key = || OLD_KEYS.iter().find(|(old, _)| *old == key);
    of_group.or_else(|| of_key().map(|(_, new)| (*new).to_owned()))
}

/// The new value of an old one; `key` is the new key.
pub fn new_value(key: &str, value: &str) -> Option<&'static str> {
    let mut values = VALUES.iter();
    values
        .find(|(of, old, _)| *of == key && *old == value)
        .map(|(_, _, new)| *new)
}

#[cfg(test)]
mod tests {
    use serde_json::Value;

    use super::*;
    use crate::params::schema::descriptors;
    use crate::params::settings::Settings;

    /// All of version 0.1.0 that have changed.
    fn old_keys() -> Vec<(String, String)> {
        let noise = descriptors().keys().filter_map(|key| {
            let rest = key.strip_prefix("ground_truth.")?;
            Some((format!("known.{rest}"), key.clone()))
        });
        let keys = OLD_KEYS.map(|(old, new)| (old.to_owned(), new.to_owned()));
        noise.chain(keys).collect()
    }

    #[test]
    fn each_old_key_sets_the_new_one_and_warns_once() {
        assert_eq!(old_keys().len(), 77);
        for (old, new) in old_keys() {
            let mut settings = Settings::shipped();
            assert!(settings.value(&old).is_none(), "{old} is still a key");
            let value = settings.value(&new).expect(&new).clone();
            settings.set(&old, value.clone()).unwrap();
            settings.set(&old, value.clone()).unwrap();
            assert_eq!(settings.value(&new), Some(&value), "{old}");
            let warnings = settings.take_warnings();
            assert_eq!(warnings.len(), 1, "{warnings:?}");
            assert!(
                warnings[0].contains(&old) && warnings[0].contains(&new),
                "{warnings:?}"
            );
            settings.params().unwrap();
        }
    }

    #[test]
    fn a_value_set_by_an_old_key_arrives() {
        let mut settings = Settings::shipped();
        settings.merge_setting("map.steps=7").unwrap();
        settings.merge_setting("known.depth_noise=0.5").unwrap();
        let params = settings.params().unwrap();
        assert_eq!(
            (params.train.steps, params.ground_truth.depth_noise),
            (7, 0.5)
        );
    }

    #[test]
    fn each_old_value_sets_the_new_one_by_the_old_and_the_new_key() {
        for (key, old, new) in VALUES {
            let renamed = OLD_KEYS.iter().find(|(_, new)| *new == key);
            for name in renamed.map(|(old, _)| *old).into_iter().chain([key]) {
                let mut settings = Settings::shipped();
                settings.merge_setting(&format!("{name}={old}")).unwrap();
                assert_eq!(settings.value(key), Some(&Value::from(new)), "{name}={old}");
                let warnings = settings.take_warnings();
                assert!(
                    warnings.iter().any(|w| w.contains(old) && w.contains(new)),
                    "{warnings:?}"
                );
                settings.params().unwrap();
            }
        }
    }

    #[test]
    fn new_names_are_no_old_names() {
        for (old, new) in OLD_KEYS {
            assert!(new_key(new).is_none(), "{old} -> {new}");
        }
    }
}
