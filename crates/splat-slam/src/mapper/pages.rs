//! Where splats and images go that memory has no room for.

use splat_types::pages::{Page, PageStore};

/// A page store that may be missing or full.
#[derive(Debug, Default)]
pub(crate) struct Paging {
    store: Option<Box<dyn PageStore>>,
    has_warned: bool,
}

impl Paging {
    pub(crate) fn to(store: Box<dyn PageStore>) -> Self {
        Self {
            store: Some(store),
            has_warned: false,
        }
    }

    /// Writes a record; `None`, warned of once, where that is not possible.
    pub(crate) fn put(&mut self, bytes: &[u8]) -> Option<Box<dyn Page>> {
        let put = self.store.as_ref().map(|store| store.put(bytes));
        let reason = match put {
            Some(Ok(Some(page))) => return Some(page),
            Some(Ok(None)) => "map.max_page_file_mib is used up".to_owned(),
            Some(Err(e)) => e.to_string(),
            None => "the map was given no page store".to_owned(),
        };
        if !self.has_warned {
            let store = self.store.as_ref().map(|store| store.describe());
            tracing::warn!(
                "what memory has no room for is lost: {reason}; warned of once: {}",
                store.unwrap_or_default()
            );
            self.has_warned = true;
        }
        None
    }
}
