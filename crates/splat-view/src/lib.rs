//! The published map -> browsers: one page with everything in it, and a WebSocket that carries what changed (docs/VIEWER.md).
//!
//! Nothing here holds up the mapper: snapshots are taken over as they are, and turned into the wire's form on a thread of their own while somebody looks.

pub mod hash;

pub mod record;

pub mod chunk;

pub mod view_map;

pub mod settings;

pub mod messages;

mod grid_message;

pub mod hub;

pub mod plan_frames;

pub mod sync;

pub mod embedded;

mod session;

pub mod page;

mod access;

mod tls;

pub mod server;

pub mod transport;
