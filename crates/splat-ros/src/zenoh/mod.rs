//! The same topics and services over zenoh, with the keys of rmw_zenoh.

#[cfg(feature = "zenoh")]
mod names;

#[cfg(feature = "zenoh")]
mod session;

#[cfg(feature = "zenoh")]
pub mod transport;

#[cfg(feature = "zenoh")]
pub mod subscriber;

#[cfg(feature = "zenoh")]
pub mod source;
