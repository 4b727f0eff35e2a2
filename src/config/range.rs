//! Comments of `launch/params.yaml` -> what each value may be.

use std::collections::BTreeMap;

use serde_json::Value;

/// What a value may be, read from the comment behind its default.
#[derive(Debug, Clone, PartialEq)]
pub enum Range {
    Number { min: f64, max: f64 },
    Choice(Vec<String>),
    Flag,
    Text,
}

impl Range {
    fn of_comment(comment: &str) -> Option<Self> {
        if let Some(rest) = comment.strip_prefix('[') {
            let (min, max) = rest.split_once(']')?.0.split_once(',')?;
            return Some(Self::Number {
                min: min.trim().parse().ok()?,
                max: max.trim().parse().ok()?,
            });
        }
        if let Some(rest) = comment.strip_prefix('{') {
            let names = rest.split_once('}')?.0.split(',');
            return Some(Self::Choice(
                names.map(|name| name.trim().to_owned()).collect(),
            ));
        }
        if comment.starts_with("flag") {
            return Some(Self::Flag);
        }
        comment.starts_with("text").then_some(Self::Text)
    }

    /// `whole`: the default is an integer, so values must be too.
    pub(super) fn allows(&self, value: &Value, whole: bool) -> bool {
        match self {
            Self::Number { min, max } => value
                .as_f64()
                .is_some_and(|v| v >= *min && v <= *max && !(whole && v.fract() != 0.0)),
            Self::Choice(names) => value
                .as_str()
                .is_some_and(|v| names.iter().any(|name| name == v)),
            Self::Flag => value.is_boolean(),
            Self::Text => value.is_string(),
        }
    }
}

impl std::fmt::Display for Range {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Number { min, max } => write!(f, "a number in [{min}, {max}]"),
            Self::Choice(names) => write!(f, "one of {}", names.join(", ")),
            Self::Flag => write!(f, "true or false"),
            Self::Text => write!(f, "text"),
        }
    }
}

/// Reads the ranges out of the comments of the embedded file, which we write ourselves: two spaces a level.
pub(super) fn ranges_of_comments(text: &str) -> BTreeMap<String, Range> {
    let ranged = |(key, comment): (String, &str)| Some((key, Range::of_comment(comment)?));
    commented(text).into_iter().filter_map(ranged).collect()
}

/// Every parameter of the file with the comment behind its default; groups have none.
pub(super) fn commented(text: &str) -> Vec<(String, &str)> {
    let mut groups: Vec<&str> = Vec::new();
    let mut found = Vec::new();
    for line in text.lines() {
        let trimmed = line.trim_start();
        let indent = line.len() - trimmed.len();
        let Some((name, rest)) = trimmed.split_once(':') else {
            continue;
        };
        if indent < 4 || trimmed.starts_with('#') {
            continue;
        }
        groups.truncate((indent - 4) / 2);
        let key = [groups.as_slice(), &[name]].concat().join(".");
        match rest.split_once(" # ") {
            Some((_, comment)) => found.push((key, comment.trim())),
            None => groups.push(name),
        }
    }
    found
}
