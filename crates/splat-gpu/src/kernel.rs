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
    pub threads: Threads,
    /// In order of the binding index: uniform first, then inputs, then outputs.
    pub bindings: &'static [(&'static str, Access)],
}

/// Threads of a workgroup.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Threads {
    Fixed(u32),
    /// The lanes that a tile is given.
    Lanes,
    /// So many subgroups: for adapters that have them.
    Subgroups(u32),
}

/// Threads that share a tile of 256 pixels, and how they add up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lanes {
    /// A divisor of 256.
    pub n: u32,
    /// Lanes of a subgroup, a divisor of `n`; `None`: sums go through workgroup memory alone.
    pub subgroup: Option<u32>,
}

/// Lanes that answer a ballot in one word.
const MAX_BALLOT: u32 = 32;
/// Pixels of a tile.
const TILE_PIXELS: u32 = 256;

/// A table of shaders, one entry per file: constant, file, threads of a workgroup (or `lanes`, or `(8 subgroups)`)
/// and bindings. Also makes
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
            threads: $crate::kernels!(@size $size),
            bindings: &[$((stringify!($binding), $crate::kernel::Access::$access)),*],
        };)*
        pub const ALL: &[&$crate::kernel::Kernel] = &[$(&$constant),*];
    };
    (@size lanes) => {
        $crate::kernel::Threads::Lanes
    };
    (@size ($n:literal subgroups)) => {
        $crate::kernel::Threads::Subgroups($n)
    };
    (@size $n:literal) => {
        $crate::kernel::Threads::Fixed($n)
    };
}

crate::kernels! {
    folder "../shaders/";
    libraries ["flat", "scanning", "scattering", "sorting"];
    SCAN_SUMS "scan_sums" 256 [numbers Read, length Read, block_sums ReadWrite];
    SCAN_BLOCKS "scan_blocks" 256 [length Read, block_sums ReadWrite];
    SCAN_APPLY "scan_apply" 256 [numbers Read, length Read, block_sums Read, sums_before ReadWrite];
    SORT_COUNT "sort_count" 256 [sort_pass Uniform, keys Read, length Read, table ReadWrite];
    SORT_ROWS "sort_rows" 32 [table Read, length Read, offsets ReadWrite, totals ReadWrite];
    SORT_SCATTER "sort_scatter" 32 [
        sort_pass Uniform, keys Read, values Read, length Read, offsets Read, totals Read, sorted_keys ReadWrite,
        sorted_values ReadWrite,
    ];
    SORT_SCATTER_SUBGROUPS "sort_scatter_subgroups" (8 subgroups) [
        sort_pass Uniform, keys Read, values Read, length Read, offsets Read, totals Read, sorted_keys ReadWrite,
        sorted_values ReadWrite,
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
        if !text.contains("LANES") && !text.contains("SUBGROUP") {
            return Some(text);
        }
        let subgroup = lanes.subgroup.unwrap_or(lanes.n);
        Some(format!(
            "const LANES: u32 = {}u;\nconst SUBGROUP: u32 = {subgroup}u;\n{text}",
            lanes.n
        ))
    }

    /// Threads of a workgroup.
    pub fn width(&self, lanes: Lanes) -> u32 {
        match self.threads {
            Threads::Fixed(n) => n,
            Threads::Lanes => lanes.n,
            Threads::Subgroups(n) => n * lanes.subgroup.unwrap_or(lanes.n),
        }
    }

    /// Whether adapters with these lanes can run it.
    pub fn suits(&self, lanes: Lanes) -> bool {
        match self.threads {
            Threads::Subgroups(_) => lanes.subgroup.is_some_and(|n| n <= MAX_BALLOT),
            Threads::Fixed(_) | Threads::Lanes => true,
        }
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
        let name = match (name.trim(), lanes.subgroup) {
            ("lane_sum", Some(n)) if n == lanes.n => "lane_sum_subgroup",
            ("lane_sum", Some(_)) => "lane_sum_subgroups",
            ("lane_sum", None) => "lane_sum_shared",
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
