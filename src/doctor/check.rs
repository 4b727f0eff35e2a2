//! One thing that a machine needs, whether it is there, and the line that mends it.

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    Ok,
    /// Works without; `found` says what it would be for.
    Optional,
    /// Mapping fails without.
    Missing,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Check {
    pub name: &'static str,
    pub state: State,
    pub found: String,
    /// The line that mends it.
    pub fix: Option<String>,
}

impl Check {
    pub(crate) fn ok(name: &'static str, found: impl Into<String>) -> Self {
        Self {
            name,
            state: State::Ok,
            found: found.into(),
            fix: None,
        }
    }

    pub(crate) fn optional(
        name: &'static str,
        found: impl Into<String>,
        fix: impl Into<String>,
    ) -> Self {
        Self {
            name,
            state: State::Optional,
            found: found.into(),
            fix: Some(fix.into()),
        }
    }

    pub(crate) fn missing(
        name: &'static str,
        found: impl Into<String>,
        fix: impl Into<String>,
    ) -> Self {
        Self {
            name,
            state: State::Missing,
            found: found.into(),
            fix: Some(fix.into()),
        }
    }
}
