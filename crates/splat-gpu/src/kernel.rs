//! What a shader is to the host: its text with all that it imports, and what a dispatch has to bind. Whoever has shaders
//! keeps a table of them with `kernels!`; the stages that all share (`scan`, `sort`) are here.

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
    /// Of the file, the stage, the label and the reference implementation.
    pub name: &'static str,
    pub source: &'static str,
    /// Files of `shaders/lib/` that it may import: (name in `#import`, text).
    pub libraries: &'static [(&'static str, &'static str)],
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

/// A table of shaders, one entry per file: constant, file, threads of a workgroup (or `lanes`) and bindings. Also makes
/// `ALL`, every entry, and `LIBRARIES`, the files that they may import. `$folder` as seen from the file of the table.
#[macro_export]
macro_rules! kernels {
    (
        folder $folder:literal;
        libraries [$($library:literal),* $(,)?] $(and [$($made:literal = $text:expr),* $(,)?])?;
        $($constant:ident $name:literal $size:tt [$($binding:ident $access:ident),* $(,)?];)*
    ) => {
        /// Files of `shaders/lib/`, and texts that the host makes, by the name that `#import` uses.
        pub const LIBRARIES: &[(&str, &str)] = &[
            $(($library, include_str!(concat!($folder, "lib/", $library, ".wgsl"))),)*
            $($(($made, $text),)*)?
        ];
        $(pub const $constant: $crate::kernel::Kernel = $crate::kernel::Kernel {
            name: $name,
            source: include_str!(concat!($folder, $name, ".wgsl")),
            libraries: LIBRARIES,
            workgroup_size: $crate::kernels!(@size $size),
            bindings: &[$((stringify!($binding), $crate::kernel::Access::$access)),*],
        };)*
        pub const ALL: &[&$crate::kernel::Kernel] = &[$(&$constant),*];
    };
    (@size lanes) => {
        None
    };
    (@size $n:literal) => {
        Some($n)
    };
}

crate::kernels! {
    folder "../shaders/";
    libraries ["flat", "scanning", "sorting"];
    SCAN_SUMS "scan_sums" 64 [numbers Read, length Read, block_sums ReadWrite];
    SCAN_BLOCKS "scan_blocks" 64 [length Read, block_sums ReadWrite];
    SCAN_APPLY "scan_apply" 64 [numbers Read, length Read, block_sums Read, sums_before ReadWrite];
    SORT_COUNT "sort_count" 32 [sort_pass Uniform, keys Read, length Read, table ReadWrite];
    SORT_SCATTER "sort_scatter" 32 [
        sort_pass Uniform, keys Read, values Read, length Read, offsets Read, sorted_keys ReadWrite, sorted_values ReadWrite,
    ];
}

impl Kernel {
    /// The whole text for these lanes. `None` when an import is in no library file or a repetition has no end.
    pub fn text(&self, lanes: Lanes) -> Option<String> {
        let mut text = String::new();
        let mut imported = BTreeSet::new();
        import(self.source, self.libraries, lanes, &mut imported, &mut text)?;
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
    libraries: &[(&str, &str)],
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
            let (_, library) = libraries.iter().find(|(known, _)| *known == name)?;
            import(library, libraries, lanes, imported, text)?;
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
