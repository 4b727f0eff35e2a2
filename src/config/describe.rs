//! Comments of `launch/params.yaml` -> what a tool can show of each parameter.

use crate::config::range::commented;
use crate::config::{PARAMS_YAML, Range, Settings};

/// What the file says of one parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Description {
    pub range: Range,
    /// The default is a whole number, so values must be too.
    pub is_whole: bool,
    /// The comment behind the range: unit and meaning.
    pub text: String,
}

impl Settings {
    /// `None` for an unknown key.
    pub fn describe(&self, key: &str) -> Option<Description> {
        let (range, is_whole) = self.ranges.get(key)?;
        Some(Description {
            range: range.clone(),
            is_whole: *is_whole,
            text: text_of(key).unwrap_or_default(),
        })
    }
}

/// Text between the range and the end of the line, of the embedded file, which we write ourselves.
fn text_of(key: &str) -> Option<String> {
    let (_, comment) = commented(PARAMS_YAML).into_iter().find(|(k, _)| k == key)?;
    let closing = match comment.chars().next() {
        Some('[') => ']',
        Some('{') => '}',
        _ => ':',
    };
    Some(comment.split_once(closing)?.1.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_parameter_says_what_it_means() {
        let settings = Settings::shipped();
        for (key, _) in settings.entries() {
            let described = settings.describe(key).unwrap();
            assert!(described.text.len() > 1, "{key}: {:?}", described.text);
            assert!(!described.text.starts_with(['[', '{']), "{key}");
        }
    }

    #[test]
    fn the_range_is_apart_from_the_meaning() {
        let described = Settings::shipped().describe("source.max_side").unwrap();
        assert!(
            described.text.starts_with("px. Longer side"),
            "{described:?}"
        );
        assert!(described.is_whole);
        let text = Settings::shipped().describe("geometry").unwrap().text;
        assert!(text.starts_with("sfm, onnx:FILE"), "{text}");
    }
}
