//! The table of shaders: one entry per file in `shaders/`, with what a dispatch has to bind; and how their text is put
//! together.

use std::collections::BTreeSet;

/// How a shader uses a binding of group 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    Uniform,
    Read,
    ReadWrite,
}

/// One compute stage; its entry point is `main`.
#[derive(Debug)]
pub struct Kernel {
    /// Of the file, the stage, the label and the twin.
    pub name: &'static str,
    pub source: &'static str,
    /// `None`: as wide as the lanes that a tile is given, see `Lanes`.
    pub workgroup_size: Option<u32>,
    /// In order of the binding index: uniform first, then inputs, then outputs.
    pub bindings: &'static [(&'static str, Access)],
}

/// Threads that share a tile of 256 pixels, and how they add up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lanes {
    /// A divisor of 256.
    pub n: u32,
    /// Whether they are one subgroup, whose sums need no workgroup memory.
    pub are_subgroup: bool,
}

/// Pixels of a tile.
const TILE_PIXELS: u32 = 256;

macro_rules! kernels {
    ($($constant:ident $name:literal $size:tt [$($binding:ident $access:ident),* $(,)?];)*) => {
        $(pub const $constant: Kernel = Kernel {
            name: $name,
            source: include_str!(concat!("../../shaders/", $name, ".wgsl")),
            workgroup_size: size!($size),
            bindings: &[$((stringify!($binding), Access::$access)),*],
        };)*
        pub const ALL: &[&Kernel] = &[$(&$constant),*];
    };
}

macro_rules! size {
    (lanes) => {
        None
    };
    ($n:literal) => {
        Some($n)
    };
}

kernels! {
    VIEW_CAMERA "view_camera" 64 [step Uniform, views ReadWrite, network Read, camera ReadWrite];
    CULL "cull" 256 [step Uniform, camera Read, geometry Read, visible_bits ReadWrite, block_counts ReadWrite];
    SCAN_SUMS "scan_sums" 64 [numbers Read, length Read, block_sums ReadWrite];
    SCAN_BLOCKS "scan_blocks" 64 [length Read, block_sums ReadWrite];
    SCAN_APPLY "scan_apply" 64 [numbers Read, length Read, block_sums Read, sums_before ReadWrite];
    VISIBLE_ARGS "visible_args" 1 [
        step Uniform, block_offsets Read, camera ReadWrite, n_visible ReadWrite, table_length ReadWrite, args ReadWrite,
    ];
    PROJECT "project" 256 [
        step Uniform, camera Read, geometry Read, sh_rest Read, visible_bits Read, block_offsets Read,
        projected ReadWrite, depth_keys ReadWrite, depth_values ReadWrite,
    ];
    SORT_COUNT "sort_count" 32 [sort_pass Uniform, keys Read, length Read, table ReadWrite];
    SORT_SCATTER "sort_scatter" 32 [
        sort_pass Uniform, keys Read, values Read, length Read, offsets Read, sorted_keys ReadWrite, sorted_values ReadWrite,
    ];
    TILE_COUNTS "tile_counts" 256 [camera Read, depth_order Read, projected Read, counts ReadWrite];
    INSTANCE_ARGS "instance_args" 1 [
        step Uniform, first_instances Read, camera ReadWrite, n_instances ReadWrite, table_length ReadWrite,
        args ReadWrite,
    ];
    EMIT "emit" 256 [
        step Uniform, camera Read, depth_order Read, first_instances Read, projected ReadWrite, tile_keys ReadWrite,
        tile_values ReadWrite, owners ReadWrite,
    ];
    RANGES "ranges" 256 [
        step Uniform, camera Read, tile_keys Read, tile_values Read, owners Read, instances ReadWrite,
        places ReadWrite, tile_ranges ReadWrite,
    ];
    RASTER "raster" lanes [
        step Uniform, projected Read, instances Read, tile_ranges Read, picture ReadWrite, depth_sum ReadWrite,
        n_used ReadWrite,
    ];
    SSIM_ROWS "ssim_rows" 64 [step Uniform, camera Read, picture Read, wanted Read, moments ReadWrite];
    SSIM_TERMS "ssim_terms" 64 [step Uniform, moments Read, wanted Read, terms ReadWrite, ssim_sums ReadWrite];
    SSIM_BACK "ssim_back" 64 [step Uniform, terms Read, blurred ReadWrite];
    PHOTO_GRADIENT "photo_gradient" 64 [
        step Uniform, camera Read, picture Read, depth_sum Read, wanted Read, blurred Read, v_picture ReadWrite,
        behind ReadWrite, loss_sums ReadWrite,
    ];
    DEPTH_STRETCH "depth_stretch" 256 [
        step Uniform, picture Read, depth_sum Read, wanted Read, v_picture ReadWrite, behind ReadWrite,
        loss_sums ReadWrite,
    ];
    RASTER_BACKWARD "raster_backward" lanes [
        step Uniform, projected Read, instances Read, tile_ranges Read, n_used Read, v_picture Read, behind_all Read,
        slots ReadWrite,
    ];
    RASTER_BACKWARD_ATOMIC "raster_backward_atomic" lanes [
        step Uniform, projected Read, instances Read, tile_ranges Read, n_used Read, v_picture Read, behind_all Read,
        splat_sums ReadWrite,
    ];
    GATHER "gather" 256 [camera Read, projected Read, places Read, slots Read, splat_sums ReadWrite];
    PROJECT_BACKWARD "project_backward" 256 [
        step Uniform, camera Read, projected Read, splat_sums Read, geometry ReadWrite, moments ReadWrite,
        sh_rest ReadWrite, sh_moments ReadWrite, pose_sums ReadWrite,
    ];
    UPDATE_VIEW "update_view" 64 [
        step Uniform, camera Read, pose_sums Read, loss_sums Read, ssim_sums Read, views ReadWrite, network ReadWrite,
        stats ReadWrite,
    ];
    MOVE_WEIGHTS "move_weights" 256 [
        moves Uniform, geometry Read, sh_rest Read, weights ReadWrite, dead ReadWrite, shares ReadWrite,
    ];
    MOVE_DRAW "move_draw" 256 [
        moves Uniform, starts Read, dead Read, dead_before Read, sources ReadWrite, shares ReadWrite,
    ];
    MOVE_SHARE "move_share" 256 [
        moves Uniform, shares Read, geometry ReadWrite, moments ReadWrite, sh_moments ReadWrite,
    ];
    MOVE_COPY "move_copy" 256 [
        moves Uniform, sources Read, geometry ReadWrite, sh_rest ReadWrite, moments ReadWrite, sh_moments ReadWrite,
        anchors ReadWrite,
    ];
    MVS_COST "mvs_cost" 64 [
        sweep Uniform, luma Read, statistics Read, warps Read, starts Read, costs ReadWrite,
    ];
    MVS_PATHS "mvs_paths" 32 [sweep Uniform, costs Read, penalties Read, sums ReadWrite];
    MVS_WINNER "mvs_winner" 64 [sweep Uniform, costs Read, sums Read, dips ReadWrite];
}

/// The stages of a sweep of the multi-view stereo; all others serve the splats.
pub const SWEEP: &[&Kernel] = &[&MVS_COST, &MVS_PATHS, &MVS_WINNER];

macro_rules! libraries {
    ($($name:literal),* $(,)?) => {
        /// Files of `shaders/lib/`, by the name that `#import` uses.
        pub const LIB: &[(&str, &str)] = &[$(($name, include_str!(concat!("../../shaders/lib/", $name, ".wgsl")))),*];
    };
}

libraries![
    "adam",
    "blend",
    "camera",
    "cleared",
    "depth_map",
    "flat",
    "groups",
    "lane_sum_shared",
    "lane_sum_subgroup",
    "moves",
    "projected",
    "quat",
    "random",
    "refiner",
    "scanning",
    "sh",
    "shape",
    "sorting",
    "ssim",
    "step",
    "sweep",
    "tile_backward",
    "view",
];

impl Kernel {
    /// The whole text for these lanes. `None` when an import is in no library file or a repetition has no end.
    pub fn text(&self, lanes: Lanes) -> Option<String> {
        let mut text = String::new();
        let mut imported = BTreeSet::new();
        import(self.source, lanes, &mut imported, &mut text)?;
        let pixels = TILE_PIXELS / lanes.n;
        let text = repeated(&text, pixels)?;
        if !text.contains("LANES") {
            return Some(text);
        }
        Some(format!("const LANES: u32 = {}u;\n{text}", lanes.n))
    }

    /// Threads of a workgroup.
    pub fn width(&self, lanes: Lanes) -> u32 {
        self.workgroup_size.unwrap_or(lanes.n)
    }
}

/// Replaces each `#import name` line by the library file, once; WGSL lets declarations stand in any order.
fn import(
    source: &str,
    lanes: Lanes,
    imported: &mut BTreeSet<String>,
    text: &mut String,
) -> Option<()> {
    for line in source.lines() {
        let Some(name) = line.strip_prefix("#import ") else {
            text.push_str(line);
            text.push('\n');
            continue;
        };
        let name = match (name.trim(), lanes.are_subgroup) {
            ("lane_sum", true) => "lane_sum_subgroup",
            ("lane_sum", false) => "lane_sum_shared",
            (name, _) => name,
        };
        if imported.insert(name.to_owned()) {
            let (_, library) = LIB.iter().find(|(known, _)| *known == name)?;
            import(library, lanes, imported, text)?;
        }
    }
    Some(())
}

/// Writes what stands between `#repeat i n` and `#end` n times, with `$i` counting from 0 and `$[i+j]` the sum of two
/// counters: arrays that are indexed by constants stay in registers.
fn repeated(text: &str, pixels: u32) -> Option<String> {
    let mut out = String::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let Some(head) = line.strip_prefix("#repeat ") else {
            out.push_str(line);
            out.push('\n');
            continue;
        };
        let (counter, n) = head.trim().split_once(' ')?;
        let n = if n == "PIXELS" {
            pixels
        } else {
            n.parse().ok()?
        };
        let mut body = String::new();
        let mut depth = 1;
        loop {
            let line = lines.next()?;
            depth += i32::from(line.starts_with("#repeat ")) - i32::from(line == "#end");
            if depth == 0 {
                break;
            }
            body.push_str(line);
            body.push('\n');
        }
        for i in 0..n {
            // Sums first: "$j" would take the "$j" of no other name, but "$[j+t]" must lose its j here.
            let counted = body
                .replace(&format!("$[{counter}+"), &format!("$[{i}+"))
                .replace(&format!("+{counter}]"), &format!("+{i}]"))
                .replace(&format!("${counter}"), &i.to_string());
            out.push_str(&repeated(&counted, pixels)?);
        }
    }
    Some(sums(&out))
}

/// Replaces `$[1+2]` by 3.
fn sums(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find("$[") {
        let (before, sum) = rest.split_at(at);
        out.push_str(before);
        let end = sum.find(']').map_or(sum.len(), |end| end + 1);
        let terms = sum[2..end - 1].split_once('+');
        let total = terms.and_then(|(a, b)| Some(a.parse::<u32>().ok()? + b.parse::<u32>().ok()?));
        match total {
            Some(total) => out.push_str(&total.to_string()),
            // A counter of an outer repetition is still to come.
            None => out.push_str(&sum[..end]),
        }
        rest = &sum[end..];
    }
    out.push_str(rest);
    out
}
