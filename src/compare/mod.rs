//! `splat-mapper compare`: one scene mapped in several ways -> a table of what each is worth.

pub mod rows;

pub mod table;

pub mod colmap;

pub mod run;
