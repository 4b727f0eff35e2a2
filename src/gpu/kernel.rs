//! The table of shaders: one entry per file in `shaders/`, with what a dispatch has to bind.

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
    pub workgroup_size: [u32; 3],
    /// In order of the binding index: uniform first, then inputs, then outputs.
    pub bindings: &'static [(&'static str, Access)],
}

pub const PROJECT: Kernel = Kernel {
    name: "project",
    source: include_str!("../../shaders/project.wgsl"),
    workgroup_size: [256, 1, 1],
    bindings: &[
        ("camera", Access::Uniform),
        ("means", Access::Read),
        ("log_scales", Access::Read),
        ("quats", Access::Read),
        ("sh_base", Access::Read),
        ("projected", Access::ReadWrite),
    ],
};

pub const ALL: [&Kernel; 1] = [&PROJECT];

/// Files of `shaders/lib/`, by the name that `#import` uses.
pub const LIB: [(&str, &str); 2] = [
    ("camera", include_str!("../../shaders/lib/camera.wgsl")),
    ("quat", include_str!("../../shaders/lib/quat.wgsl")),
];

/// Replaces each `#import name` line by the library file; WGSL lets declarations stand in any order.
/// `None` when a name is in no library file.
pub fn expand(source: &str) -> Option<String> {
    let mut text = String::with_capacity(source.len());
    for line in source.lines() {
        match line.strip_prefix("#import ") {
            None => text.push_str(line),
            Some(name) => text.push_str(LIB.iter().find(|(known, _)| *known == name.trim())?.1),
        }
        text.push('\n');
    }
    Some(text)
}
