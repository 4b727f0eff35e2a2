//! Trains and renders 3D Gaussian splats, with gradients for camera poses, on the CPU and on any GPU that wgpu reaches.
//!
//! A caller adds *views* (image, pinhole intrinsics, pose, optional depth and pixel weights) and *splats*, makes optimiser steps, and reads splats
//! and poses back or renders. The engine knows no keyframes, no schedule, no files and no threads of its caller; it needs neither CUDA nor a GPU.
//!
//! ```
//! use std::sync::Arc;
//!
//! use splat_engine::cpu::engine::CpuEngine;
//! use splat_engine::settings::StepSettings;
//! use splat_engine::traits::{Renderer, SplatBuffers, Trainer, ViewStore};
//! use splat_engine::view::TrainingView;
//! use splat_types::{camera::Intrinsics, image::RgbImage, splats::splats::Splats, transform::Rigid};
//!
//! # fn main() -> Result<(), splat_engine::error::EngineError> {
//! // An orange disc before a blue wall, 32x32.
//! let side = 32_i32;
//! let pixels = (0..side * side).flat_map(|p| {
//!     let (x, y) = (p % side, p / side);
//!     let is_disc = (x - 16).pow(2) + (y - 16).pow(2) < 64;
//!     if is_disc { [255, 140, 0] } else { [30, 60, 120] }
//! });
//! let image = RgbImage { width_px: 32, height_px: 32, pixels: pixels.collect() };
//! let intrinsics = Intrinsics { width_px: 32, height_px: 32, fx: 32.0, fy: 32.0, cx: 16.0, cy: 16.0 };
//! let cam_from_world = Rigid::IDENTITY;
//!
//! // 16x16 grey splats on the plane z = 2, which the camera sees from x, y = -1 to 1.
//! let mut splats = Splats { sh_degree: 0, ..Splats::default() };
//! for ix in 0..256 {
//!     let along = |n: i32| (n as f32 + 0.5) / 8.0 - 1.0;
//!     splats.means.push([along(ix % 16), along(ix / 16), 2.0]);
//!     splats.log_scales.push([0.07_f32.ln(); 3]);
//!     splats.quats.push([1.0, 0.0, 0.0, 0.0]);
//!     splats.opacity_logits.push(0.0);
//!     splats.sh.extend([0.0; 3]);
//!     splats.anchors.push(0);
//! }
//!
//! let mut engine = CpuEngine::new();
//! engine.append(&splats)?;
//! let view_ix = engine.add_view(TrainingView::new(Arc::new(image), intrinsics, cam_from_world))?;
//! let settings = StepSettings {
//!     lr_mean: 1e-3, lr_scale: 5e-3, lr_quat: 1e-3, lr_opacity: 5e-2, lr_sh0: 5e-2,
//!     ssim_weight: 0.2, train_splats: true, ..StepSettings::default()
//! };
//! engine.step(view_ix, &settings)?;
//! let first = engine.take_stats()?;
//! for _ in 0..100 {
//!     engine.step(view_ix, &settings)?;
//! }
//! engine.take_stats()?;
//! engine.step(view_ix, &settings)?;
//! let last = engine.take_stats()?;
//! assert!(last.l1 < 0.25 * first.l1, "L1 {} -> {}", first.l1, last.l1);
//!
//! let rendering = engine.render(&intrinsics, &cam_from_world, 0)?;
//! let centre = &rendering.rgb[3 * (16 * 32 + 16)..][..3];
//! assert!(centre[0] > 0.8 && centre[2] < 0.2, "orange: {centre:?}");
//! # Ok(())
//! # }
//! ```
//!
//! `examples/train_fox.rs` trains a scene of photos from its `transforms.json`.
//!
//! # Conventions
//!
//! - A pose is `cam_from_world`: it takes points of the world to the camera, whose axes are x right, y down, z forward. `world` is the one frame that
//!   splats and cameras share, in any unit.
//! - Pixel centres lie at +0.5; `cx = width / 2` is the middle of the image.
//! - [`Splats`](splat_types::splats::splats::Splats) hold numbers before activation: log-scales, opacity logits, quaternions w x y z (normalised on
//!   use), spherical harmonics of degree 0 to 3. The colour is `0.5 + SH_C0 * sh` for degree 0, cut at 0.
//! - Images are 8-bit; colour is compared as stored, without gamma. The background is black.
//!
//! # Roles
//!
//! An engine implements five traits, which [`traits::Engine`] unites; a caller needs only those that it uses.
//!
//! | trait | what it does |
//! |---|---|
//! | [`traits::Device`] | names the adapter, says whether it is lost, counts memory |
//! | [`traits::SplatBuffers`] | appends, retains, replaces and reads splats |
//! | [`traits::ViewStore`] | holds views; reads refined poses, focal scale and exposures |
//! | [`traits::Renderer`] | splats and a camera -> colour, alpha, depth |
//! | [`traits::Trainer`] | optimiser steps, MCMC relocation and growth, the shared pose network |
//!
//! Two backends exist: [`cpu::engine::CpuEngine`] (rayon, SIMD) and [`wgpu::engine::WgpuEngine`] (compute shaders). Both are tested against one plain f64
//! reference, whose gradients are proven by central differences; `docs/GRADIENTS.md` of the project has the equations.
//!
//! # Errors
//!
//! Calls that touch the device return [`error::EngineError`]. A step may return `Ok` for work that fails later: the next call reports it, and no read answers
//! after a fault. `DeviceLost` stays; what the device held is gone, so a caller that must go on keeps its last [`traits::SplatBuffers::read`]. After
//! `OutOfMemory` nothing was changed. Sizes that do not fit each other (an image and its intrinsics, flags and splats) are mistakes of the caller and panic.
//!
//! # Repetition
//!
//! The CPU engine gives the same bits for the same calls, whatever the number of threads. So does the wgpu engine on one adapter, unless it is opened to
//! add floats in any order.
#![deny(missing_docs)]

pub(crate) mod sh;

pub mod error;

pub mod gradients;

pub mod mcmc;

pub mod densify;

pub mod loss_weights;

pub mod settings;

pub mod mlp;

pub mod pose_network;

pub mod appearance;

pub mod sh_rotation;

pub mod view;

pub mod random_start;

pub mod epipolar;

pub mod traits;

pub mod cpu;

pub mod wgpu;
