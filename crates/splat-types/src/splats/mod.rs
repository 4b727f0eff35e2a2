//! 3D Gaussian splats as arrays, and as bytes: the rows that messages and map files hold, and PLY files.

pub mod splats;

pub mod layout;

pub mod ply;

pub mod rows;
