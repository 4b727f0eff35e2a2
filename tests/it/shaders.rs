//! Every shader parses, validates and agrees with the host: table, bindings, workgroups and shared structs.
//! Needs no GPU.

use std::collections::BTreeSet;
use std::mem::{offset_of, size_of};

use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::{AddressSpace, Module, ScalarKind, StorageAccess, TypeInner};
use splat_mapper::gpu::kernel::{ALL, Access, Kernel, LIB, PROJECT, expand};
use splat_mapper::gpu::types::{Camera, ProjectedSplat};

fn module(source: &str) -> Result<Module, String> {
    let text = expand(source).ok_or("an #import names no file of shaders/lib")?;
    let module = naga::front::wgsl::parse_str(&text).map_err(|e| e.emit_to_string(&text))?;
    Validator::new(ValidationFlags::all(), Capabilities::empty())
        .validate(&module)
        .map_err(|e| e.emit_to_string(&text))?;
    Ok(module)
}

/// What a shader differs in from its entry in the table.
fn faults(kernel: &Kernel) -> Result<(), String> {
    let module = module(kernel.source)?;
    let [entry] = &module.entry_points[..] else {
        return Err("one entry point expected".into());
    };
    if entry.name != "main" || entry.workgroup_size != kernel.workgroup_size {
        return Err(format!(
            "{} {:?}, table has {:?}",
            entry.name, entry.workgroup_size, kernel.workgroup_size
        ));
    }
    let mut found: Vec<(u32, String, Access)> = Vec::new();
    for (_, variable) in module.global_variables.iter() {
        let Some(binding) = &variable.binding else {
            continue;
        };
        let access = match variable.space {
            AddressSpace::Uniform => Access::Uniform,
            AddressSpace::Storage { access } if access.contains(StorageAccess::STORE) => {
                Access::ReadWrite
            }
            AddressSpace::Storage { .. } => Access::Read,
            other => return Err(format!("{other:?} is no binding")),
        };
        if binding.group != 0 {
            return Err("group 0 only".into());
        }
        found.push((
            binding.binding,
            variable.name.clone().unwrap_or_default(),
            access,
        ));
    }
    found.sort_by_key(|(index, ..)| *index);
    let expected: Vec<(u32, String, Access)> = kernel
        .bindings
        .iter()
        .zip(0..)
        .map(|((name, access), i)| (i, (*name).to_owned(), *access))
        .collect();
    if found == expected {
        Ok(())
    } else {
        Err(format!("bindings {found:?}, table has {expected:?}"))
    }
}

/// (name, offset, WGSL type) of each field, and the size.
type Layout = (Vec<(String, usize, String)>, usize);

fn wgsl_layout(module: &Module, name: &str) -> Layout {
    let (_, ty) = module
        .types
        .iter()
        .find(|(_, ty)| ty.name.as_deref() == Some(name))
        .unwrap();
    let TypeInner::Struct { members, span } = &ty.inner else {
        panic!("{name} is no struct")
    };
    let fields = members.iter().map(|member| {
        let ty = match &module.types[member.ty].inner {
            TypeInner::Scalar(scalar) => scalar_name(scalar.kind).to_owned(),
            TypeInner::Vector { size, scalar } => {
                format!("{}x{}", scalar_name(scalar.kind), *size as u8)
            }
            other => panic!("{other:?} is not shared with the host"),
        };
        (member.name.clone().unwrap(), member.offset as usize, ty)
    });
    (fields.collect(), *span as usize)
}

fn scalar_name(kind: ScalarKind) -> &'static str {
    match kind {
        ScalarKind::Float => "f32",
        ScalarKind::Uint => "u32",
        ScalarKind::Sint => "i32",
        other => panic!("{other:?} is not shared with the host"),
    }
}

/// The WGSL type of a host type.
trait Wgsl {
    const NAME: &'static str;
}
impl Wgsl for f32 {
    const NAME: &'static str = "f32";
}
impl Wgsl for u32 {
    const NAME: &'static str = "u32";
}
impl Wgsl for [f32; 2] {
    const NAME: &'static str = "f32x2";
}
impl Wgsl for [f32; 4] {
    const NAME: &'static str = "f32x4";
}

fn type_of<S, T: Wgsl>(_: fn(&S) -> &T) -> String {
    T::NAME.to_owned()
}

macro_rules! host_layout {
    ($ty:ty, $($field:ident),+) => {
        (vec![$((stringify!($field).to_owned(), offset_of!($ty, $field), type_of(|s: &$ty| &s.$field))),+], size_of::<$ty>())
    };
}

#[test]
fn every_shader_is_valid_and_as_the_table_says() {
    for kernel in ALL {
        faults(kernel).unwrap_or_else(|e| panic!("shaders/{}.wgsl: {e}", kernel.name));
    }
}

#[test]
fn the_table_lists_every_file() {
    let files = |folder: &str| -> BTreeSet<String> {
        let entries = std::fs::read_dir(folder)
            .unwrap()
            .map(|e| e.unwrap().path());
        entries
            .filter(|p| p.is_file())
            .map(|p| p.file_stem().unwrap().to_str().unwrap().to_owned())
            .collect()
    };
    assert_eq!(
        files("shaders"),
        ALL.iter().map(|k| k.name.to_owned()).collect()
    );
    assert_eq!(
        files("shaders/lib"),
        LIB.iter().map(|(name, _)| (*name).to_owned()).collect()
    );
}

#[test]
fn shared_structs_have_the_layout_of_the_host() {
    let module = module(PROJECT.source).unwrap();
    let camera: Layout = host_layout!(
        Camera,
        rotation_x,
        rotation_y,
        rotation_z,
        translation,
        pinhole,
        width_px,
        height_px,
        n_splats,
        sh_degree
    );
    assert_eq!(wgsl_layout(&module, "Camera"), camera);
    let projected: Layout = host_layout!(
        ProjectedSplat,
        mean_px,
        depth,
        opacity,
        conic,
        colour,
        extent_px,
        padding
    );
    assert_eq!(wgsl_layout(&module, "ProjectedSplat"), projected);
}

#[test]
fn seeded_faults_are_seen() {
    let seeded = |from: &str, to: &str| {
        assert!(
            PROJECT.source.contains(from),
            "{from:?} is not in the shader"
        );
        let source: &'static str = Box::leak(PROJECT.source.replace(from, to).into_boxed_str());
        faults(&Kernel { source, ..PROJECT }).unwrap_err()
    };
    seeded("@workgroup_size(256)", "@workgroup_size(64)");
    seeded(
        "@binding(2) var<storage, read> log_scales",
        "@binding(2) var<storage, read> scales",
    );
    seeded("let p = cam_from_map(camera, ", "let p = cam_from_map(");
    seeded("#import quat", "#import quaternion");
    seeded(
        "var<storage, read_write> projected",
        "var<storage, read> projected",
    );
}
