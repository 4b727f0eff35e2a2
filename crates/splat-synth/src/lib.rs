//! Synthetic scenes -> rendered frames with exact poses and depth, for demos and tests.

mod geometry;

mod noise;

mod glyphs;

mod paint;

pub mod settings;

pub mod endless;

mod light;

mod ornaments;

mod prints;

mod paintings;

mod lens;

mod options;

mod surfaces;

mod joinery;

mod textures;

mod solid;

mod props;

mod clutter;

mod furniture;

mod scene;

mod lighting;

mod corridor;

mod hallway;

mod house;

mod room;

mod street;

mod facade;

mod trajectory;

mod movers;

pub mod take;

mod odometry;

pub mod imu;

pub mod record;

pub mod layouts;

pub mod source;
