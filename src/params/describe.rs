//! Defaults and descriptors -> the text of `launch/params.yaml`.

use crate::params::params::Params;
use crate::params::schema::descriptors;
use splat_ros::ros2::parameter_store::{Descriptor, Range};

const HEAD: &str = "\
# Every parameter of splat-mapper: default, range, unit and meaning. Generated from the structs of the parameters by
# `UPDATE_PARAMS=1 cargo test --release params_yaml`; do not edit.
# ROS 2 parameter form; read with and without ROS. Your own file may hold any subset: --params FILE, or --set train.steps=500.
# A comment begins with the range: [min, max] of a number, {a, b} of a choice, \"flag\" or \"text\".
splat_mapper:
  ros__parameters:
";
/// Column of the comments, where the value leaves it free.
const COMMENT_COLUMN: usize = 36;

/// `launch/params.yaml` as it must be.
pub fn params_yaml() -> String {
    let values = serde_saphyr::to_string(&Params::default()).expect("parameters are plain data");
    let mut groups: Vec<&str> = Vec::new();
    let mut text = HEAD.to_owned();
    for line in values.lines() {
        let trimmed = line.trim_start();
        let Some((name, value)) = trimmed.split_once(':') else {
            continue;
        };
        groups.truncate((line.len() - trimmed.len()) / 2);
        let key = [groups.as_slice(), &[name]].concat().join(".");
        let Some(descriptor) = descriptors().get(&key) else {
            groups.push(name);
            text += &format!("    {line}\n");
            continue;
        };
        let indent = " ".repeat(4 + 2 * groups.len());
        let value = value.trim();
        let entry = format!("{indent}{name}: {value}");
        text += &format!("{entry:COMMENT_COLUMN$} # {}\n", comment(descriptor));
    }
    text
}

/// `[min, max] unit. Text`.
fn comment(descriptor: &Descriptor) -> String {
    let text = &descriptor.text;
    let unit = descriptor.unit.as_ref();
    let unit = unit.map(|unit| format!("{unit}. ")).unwrap_or_default();
    match &descriptor.range {
        Range::Number { min, max, .. } => format!("[{min}, {max}] {unit}{text}"),
        Range::Choice(names) => format!("{{{}}} {text}", names.join(", ")),
        Range::Flag => format!("flag: {text}"),
        Range::Text => format!("text: {text}"),
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::params::file::flatten;
    use crate::params::file::parse_file;
    use crate::params::settings::defaults;

    #[test]
    fn params_yaml_is_what_the_structs_say() {
        let path = "launch/params.yaml";
        let wanted = params_yaml();
        if std::env::var_os("UPDATE_PARAMS").is_some() {
            std::fs::write(path, &wanted).unwrap();
        }
        let found = std::fs::read_to_string(path).unwrap();
        assert!(
            found == wanted,
            "{path} is out of date: run this test with UPDATE_PARAMS=1"
        );
    }

    #[test]
    fn the_generated_file_reads_back_as_the_defaults() {
        let mut values = BTreeMap::new();
        flatten("", &parse_file(&params_yaml()).unwrap(), &mut values);
        assert_eq!(values, defaults());
    }

    #[test]
    fn ros_takes_each_number_for_what_it_is() {
        // ROS 2 reports integers from doubles by the point.
        for line in params_yaml().lines() {
            let Some((entry, comment)) = line.split_once(" # [") else {
                continue;
            };
            let (name, value) = entry.trim().split_once(": ").unwrap();
            let has_point = value.trim().contains(['.', 'e']);
            let is_whole = descriptors().values().any(|d| {
                let same_name = d.key == name || d.key.ends_with(&format!(".{name}"));
                let same = same_name
                    && crate::params::describe::comment(d).starts_with(&format!("[{comment}"));
                same && matches!(d.range, Range::Number { is_whole: true, .. })
            });
            assert_ne!(has_point, is_whole, "{line}");
        }
    }
}
