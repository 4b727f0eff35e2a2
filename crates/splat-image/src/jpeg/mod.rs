//! JPEG files and the images of MJPEG cameras -> RGB.

mod tables;

mod idct;

mod huffman;

mod header;

mod baseline;

pub mod decoder;
