//! Where goes what memory has no room for. Libraries know no files: whoever runs them brings a store.

use std::io;

/// Keeps records outside of memory.
pub trait PageStore: Send + std::fmt::Debug {
    /// Writes one record. `None`: the store's limit is reached.
    fn put(&self, bytes: &[u8]) -> io::Result<Option<Box<dyn Page>>>;

    /// The place and its limit, for the warning that it cannot be used.
    fn describe(&self) -> String;
}

/// One record in a store. Its space is free again when it is dropped.
pub trait Page: Send + Sync + std::fmt::Debug {
    fn n_bytes(&self) -> u64;

    /// Reads the whole record; a damaged one is an error.
    fn read(&self) -> io::Result<Vec<u8>>;
}
