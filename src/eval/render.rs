//! Images of a map from given poses, as `splat-mapper render` writes them.
//!
//! The caller loads the map and picks the engine; here are the file formats on both sides.

use std::path::Path;

use serde::Deserialize;

use crate::eval::error::{EvalError, read_text, write_atomically};
use crate::eval::images::{depth_png, png};
use splat_engine::traits::Engine;
use splat_types::camera::Intrinsics;
use splat_types::rendering::Rendering;
use splat_types::splats::splats::Splats;
use splat_types::time::Stamp;
use splat_types::transform::Rigid;

const MAX_FILE_BYTES: u64 = 1 << 20;

/// Pixels of one image: 100 Mpx are 2 GB of buffers in the engine, more is a mistake in the file.
const MAX_PIXELS: f64 = 1e8;

/// Renders `map` from each `world_from_cam` into `out/000000.png`, and depth into `out/depth/000000.png`: 16 bits,
/// 1000 steps a map unit, 0 = nothing there. `out/images.txt` lists stamps and files, so that `images:` sources read
/// the folder. `engine` holds no splats yet. Returns how many poses were rendered.
pub fn render_poses(
    splats: &Splats,
    engine: &mut dyn Engine,
    poses: &[(Stamp, Rigid)],
    intrinsics: &Intrinsics,
    out: &Path,
    depth: bool,
) -> Result<usize, EvalError> {
    assert_eq!(
        engine.len(),
        0,
        "the engine renders this map and nothing else"
    );
    let depth_out = out.join("depth");
    let folder = if depth { &depth_out } else { out };
    std::fs::create_dir_all(folder)
        .map_err(|e| EvalError::writing("the folder of renders", &e, folder))?;
    engine.append(splats)?;
    let mut list = "# timestamp filename\n".to_owned();
    for (ix, (stamp, world_from_cam)) in poses.iter().enumerate() {
        let rendering = engine.render(intrinsics, &world_from_cam.inverse(), splats.sh_degree)?;
        let name = format!("{ix:06}.png");
        write_image(&rendering, &out.join(&name))?;
        if depth {
            write_depth(&rendering, &depth_out.join(&name))?;
        }
        list.push_str(&format!("{stamp} {name}\n"));
    }
    write_atomically(
        "the list of renders",
        list.as_bytes(),
        &out.join("images.txt"),
    )?;
    Ok(poses.len())
}

/// A pinhole as JSON: `width`, `height`, `fx`, `fy`, `cx`, `cy` in pixels, where integer coordinates are pixel
/// centres as in OpenCV and ROS. Other keys are ignored, but a lens model other than a pinhole is refused.
pub fn read_intrinsics(path: &Path) -> Result<Intrinsics, EvalError> {
    let text = read_text("the intrinsics", MAX_FILE_BYTES, path)?;
    let file: IntrinsicsFile =
        serde_json::from_str(&text).map_err(|e| EvalError::reading("the intrinsics", &e, path))?;
    let wrong = |problem: &'static str, found: String| EvalError::Intrinsics {
        problem,
        found,
        path: path.to_owned(),
    };
    if let Some(model) = file
        .model
        .as_deref()
        .filter(|model| !model.eq_ignore_ascii_case("pinhole"))
    {
        return Err(wrong(
            "the lens has another model; rectify first",
            format!("{model:?}"),
        ));
    }
    let side = |value: f64| {
        ((1.0..=MAX_PIXELS).contains(&value) && value.fract() == 0.0).then_some(value as u32)
    };
    let (Some(width_px), Some(height_px)) = (side(file.width), side(file.height)) else {
        return Err(wrong(
            "width and height are no whole numbers of pixels",
            format!("{} x {}", file.width, file.height),
        ));
    };
    if file.width * file.height > MAX_PIXELS {
        return Err(wrong(
            "the image is larger than 100 megapixels",
            format!("{width_px} x {height_px}"),
        ));
    }
    let intrinsics = Intrinsics {
        width_px,
        height_px,
        fx: file.fx,
        fy: file.fy,
        cx: file.cx + 0.5,
        cy: file.cy + 0.5,
    };
    if !intrinsics.is_plausible() {
        let found = format!(
            "fx {}, fy {}, cx {}, cy {} at {width_px} x {height_px}",
            file.fx, file.fy, file.cx, file.cy
        );
        return Err(wrong(
            "no camera has such a focal length or principal point",
            found,
        ));
    }
    Ok(intrinsics)
}

#[derive(Deserialize)]
struct IntrinsicsFile {
    // f64, so that 540.0 counts as a width and -3 gets our error rather than the parser's.
    width: f64,
    height: f64,
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    model: Option<String>,
}

fn write_image(rendering: &Rendering, path: &Path) -> Result<(), EvalError> {
    let bytes = png(&rendering.to_rgb()).map_err(|e| EvalError::writing("a render", &e, path))?;
    write_atomically("a render", &bytes, path)
}

fn write_depth(rendering: &Rendering, path: &Path) -> Result<(), EvalError> {
    let bytes = depth_png(rendering).map_err(|e| EvalError::writing("a depth render", &e, path))?;
    write_atomically("a depth render", &bytes, path)
}
