//! Bytes of a camera -> 8-bit RGB images: JPEG, PNG, raw pixel formats; lens distortion removed.

mod demosaic;

pub mod limits;

pub mod pixel_format;

pub mod jpeg;

pub mod codec;

pub mod buffer_pool;

pub mod undistort;
