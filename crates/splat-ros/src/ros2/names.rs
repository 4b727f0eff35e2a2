//! Names of ROS 2: the part of the command line that rcl reads, and what its remapping rules make of a topic.
//!
//! rcl applies the rules to what the node subscribes and publishes, but not to questions about a topic's publishers.

use std::ffi::OsString;

/// The arguments behind each `--ros-args`, up to `--` or the end, apart from the program's own.
pub fn split_arguments(arguments: impl Iterator<Item = OsString>) -> (Vec<OsString>, Vec<String>) {
    let (mut own, mut ros) = (Vec::new(), Vec::new());
    let mut is_ros = false;
    for argument in arguments {
        match argument.to_str() {
            Some("--ros-args") => is_ros = true,
            Some("--") if is_ros => is_ros = false,
            _ if is_ros => ros.push(argument.to_string_lossy().into_owned()),
            _ => own.push(argument),
        }
    }
    (own, ros)
}

/// Those of this process behind `--ros-args`.
pub fn ros_arguments() -> Vec<String> {
    split_arguments(std::env::args_os()).1
}

/// Rules `-r from:=to` for topics, and where the node stands.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Names {
    /// `/` or `/robot`.
    pub namespace: String,
    pub node: String,
    rules: Vec<(String, String)>,
}

impl Names {
    pub fn new(namespace: &str, node: &str, ros_arguments: &[String]) -> Self {
        let mut names = Self {
            namespace: namespace.to_owned(),
            node: node.to_owned(),
            rules: Vec::new(),
        };
        let mut rest = ros_arguments.iter();
        while let Some(argument) = rest.next() {
            if argument != "-r" && argument != "--remap" {
                continue;
            }
            let Some((from, to)) = rest.next().and_then(|rule| rule.split_once(":=")) else {
                continue;
            };
            // `node:from:=to` counts for that node only; __node and __ns are no topics.
            let from = match from.split_once(':') {
                Some((owner, from)) if owner == node => from,
                Some(_) => continue,
                None => from,
            };
            if !from.starts_with("__") {
                let rule = (names.absolute(from), names.absolute(to));
                names.rules.push(rule);
            }
        }
        names
    }

    /// The topic that rcl makes of a name: `~/x` below the node, `x` below the namespace, then the first rule that fits.
    pub fn resolve(&self, name: &str) -> String {
        let name = self.absolute(name);
        let rule = self.rules.iter().find(|(from, _)| *from == name);
        rule.map_or(name, |(_, to)| to.clone())
    }

    /// `/robot/splat_mapper`.
    pub fn full_name(&self) -> String {
        format!("{}/{}", self.namespace.trim_end_matches('/'), self.node)
    }

    fn absolute(&self, name: &str) -> String {
        let namespace = self.namespace.trim_end_matches('/');
        match name.strip_prefix("~/") {
            Some(rest) => format!("{namespace}/{}/{rest}", self.node),
            None if name.starts_with('/') => name.to_owned(),
            None => format!("{namespace}/{name}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(text: &str) -> Vec<String> {
        text.split_whitespace().map(str::to_owned).collect()
    }

    #[test]
    fn arguments_of_ros_end_at_two_dashes() {
        let line = words("run --source ros2:/a --ros-args -r a:=b -- --out o --ros-args -p x:=1");
        let (own, ros) = split_arguments(line.into_iter().map(OsString::from));
        let expected = words("run --source ros2:/a --out o");
        assert_eq!(
            own,
            expected.into_iter().map(OsString::from).collect::<Vec<_>>()
        );
        assert_eq!(ros, words("-r a:=b -p x:=1"));
    }

    #[test]
    fn names_resolve_as_rcl_does() {
        let rules = words(
            "-r /cam/image:=/left/image --remap pose:=/where -r __ns:=/bot -r other:/x:=/y -r mapper:/x:=/z",
        );
        let names = Names::new("/bot", "mapper", &rules);
        for (name, expected) in [
            ("/cam/image", "/left/image"),
            ("pose", "/where"),
            ("/bot/pose", "/where"),
            ("~/pose", "/bot/mapper/pose"),
            ("image", "/bot/image"),
            ("/x", "/z"),
        ] {
            assert_eq!(names.resolve(name), expected, "{name}");
        }
        assert_eq!(Names::new("/", "n", &[]).resolve("image"), "/image");
        assert_eq!(Names::new("/", "n", &[]).resolve("~/a"), "/n/a");
    }
}
