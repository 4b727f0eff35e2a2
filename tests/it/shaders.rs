//! Every shader parses, validates and agrees with the host: table, bindings, workgroups and shared structs.
//! Needs no GPU.

use std::collections::BTreeSet;
use std::mem::{offset_of, size_of};

use naga::valid::{Capabilities, ValidationFlags, Validator};
use naga::valid::{ShaderStages, SubgroupOperationSet};
use naga::{AddressSpace, Module, ScalarKind, StorageAccess, TypeInner};
use splat_mapper::gpu::kernel::{self, ALL, Access, Kernel, LIB, Lanes, PROJECT};
use splat_mapper::gpu::types::{self, Camera, Moves, Projected, SortPass, Step};

/// Without and with subgroups, as adapters have them.
const LANES: [Lanes; 4] = [
    Lanes {
        n: 32,
        are_subgroup: false,
    },
    Lanes {
        n: 8,
        are_subgroup: true,
    },
    Lanes {
        n: 32,
        are_subgroup: true,
    },
    Lanes {
        n: 64,
        are_subgroup: true,
    },
];
/// What WebGPU guarantees to every stage, and to a uniform.
const MAX_STORAGE_BINDINGS: usize = 8;

fn module(kernel: &Kernel, lanes: Lanes) -> Result<Module, String> {
    let text = kernel
        .text(lanes)
        .ok_or("an #import names no file of shaders/lib, or a #repeat has no end")?;
    let module = naga::front::wgsl::parse_str(&text).map_err(|e| e.emit_to_string(&text))?;
    let mut capabilities = Capabilities::SUBGROUP;
    // The one that engines compile only where the adapter has float atomics.
    let is_atomic = kernel.name == kernel::RASTER_BACKWARD_ATOMIC.name;
    capabilities.set(Capabilities::SHADER_FLOAT32_ATOMIC, is_atomic);
    let mut validator = Validator::new(ValidationFlags::all(), capabilities);
    if lanes.are_subgroup {
        validator
            .subgroup_stages(ShaderStages::COMPUTE)
            .subgroup_operations(SubgroupOperationSet::all());
    }
    validator
        .validate(&module)
        .map_err(|e| e.emit_to_string(&text))?;
    Ok(module)
}

/// What a shader differs in from its entry in the table.
fn faults(kernel: &Kernel, lanes: Lanes) -> Result<(), String> {
    let module = module(kernel, lanes)?;
    let [entry] = &module.entry_points[..] else {
        return Err("one entry point expected".into());
    };
    let workgroup_size = [kernel.width(lanes), 1, 1];
    if entry.name != "main" || entry.workgroup_size != workgroup_size {
        return Err(format!(
            "{} {:?}, table has {workgroup_size:?}",
            entry.name, entry.workgroup_size
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
    let n_storage = expected
        .iter()
        .filter(|(.., access)| *access != Access::Uniform)
        .count();
    if n_storage > MAX_STORAGE_BINDINGS {
        return Err(format!("{n_storage} storage buffers"));
    }
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
    for lanes in LANES {
        for kernel in ALL {
            faults(kernel, lanes)
                .unwrap_or_else(|e| panic!("shaders/{}.wgsl, {lanes:?}: {e}", kernel.name));
        }
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
fn the_step_has_the_layout_of_the_host() {
    let step: Layout = host_layout!(
        Step,
        width_px,
        height_px,
        n_tiles_x,
        n_tiles_y,
        n_splats,
        max_instances,
        view_ix,
        n_steps,
        sh_degree,
        sh_stored,
        sh_interval,
        flags,
        depth_mode,
        depth_width,
        depth_height,
        lr_mean,
        lr_scale,
        lr_quat,
        lr_opacity,
        lr_sh0,
        lr_sh_rest,
        lr_rotation,
        lr_translation,
        lr_refiner,
        lr_focal,
        lr_exposure,
        noise,
        noise_seed,
        ssim_weight,
        depth_weight,
        opacity_reg,
        scale_reg,
        mask_sum,
        confidence_sum,
        camera_scale,
        epipolar_rho_x,
        epipolar_rho_y,
        epipolar_rho_z,
        epipolar_theta_x,
        epipolar_theta_y,
        epipolar_theta_z
    );
    assert_eq!(layout_in("Step", &PROJECT), step);
}

fn layout_in(name: &str, kernel: &Kernel) -> Layout {
    wgsl_layout(&module(kernel, LANES[0]).unwrap(), name)
}

#[test]
fn other_shared_structs_have_the_layout_of_the_host() {
    let camera: Layout = host_layout!(
        Camera,
        rotation_x,
        rotation_y,
        rotation_z,
        translation,
        center,
        pinhole,
        slope_bounds,
        gain,
        offset,
        n_visible,
        n_instances,
        is_full,
        n_wanted,
        n_done,
        padding_0,
        padding_1,
        padding_2
    );
    assert_eq!(layout_in("Camera", &PROJECT), camera);
    let projected: Layout = host_layout!(
        Projected,
        center_px,
        depth,
        opacity,
        conic_a,
        conic_b,
        conic_c,
        splat_ix,
        red,
        green,
        blue,
        cut,
        extent_px,
        n_tiles,
        first_instance
    );
    assert_eq!(layout_in("Projected", &PROJECT), projected);
    let sort_pass: Layout = host_layout!(SortPass, shift, padding_0, padding_1, padding_2);
    assert_eq!(layout_in("SortPass", &kernel("sort_count")), sort_pass);
    let moves: Layout = host_layout!(
        Moves,
        n_splats,
        n_added,
        seed,
        kind,
        weight_bits,
        active_steps,
        n_steps,
        sh_stored,
        min_opacity,
        padding_0,
        padding_1,
        padding_2
    );
    assert_eq!(layout_in("Moves", &kernel("move_draw")), moves);
}

fn kernel(name: &str) -> Kernel {
    let found = ALL.iter().find(|kernel| kernel.name == name).unwrap();
    Kernel { ..**found }
}

#[test]
fn shared_numbers_are_those_of_the_host() {
    let check = |name: &str, constant: &str, expected: u64| {
        let module = module(&kernel(name), LANES[0]).unwrap();
        let found = module
            .constants
            .iter()
            .find(|(_, found)| found.name.as_deref() == Some(constant))
            .map(|(_, found)| &module.global_expressions[found.init]);
        let Some(naga::Expression::Literal(naga::Literal::U32(found))) = found else {
            panic!("{constant} of {name} is {found:?}");
        };
        assert_eq!(u64::from(*found), expected, "{constant}");
    };
    check("sort_count", "SORT_BLOCK", u64::from(types::SORT_BLOCK));
    check("scan_sums", "SCAN_BLOCK", u64::from(types::SCAN_BLOCK));
    check("project", "TILE_PX", u64::from(types::TILE_PX));
    for (constant, expected) in [
        ("ARGS_VISIBLE", types::ARGS_VISIBLE),
        ("ARGS_SORT_VISIBLE", types::ARGS_SORT_VISIBLE),
        ("ARGS_INSTANCES", types::ARGS_INSTANCES),
        ("ARGS_SORT_INSTANCES", types::ARGS_SORT_INSTANCES),
    ] {
        check("instance_args", constant, expected);
    }
    for (constant, expected) in [
        ("VIEW_QUAT", types::VIEW_QUAT),
        ("VIEW_TRANSLATION", types::VIEW_TRANSLATION),
        ("VIEW_PINHOLE", types::VIEW_PINHOLE),
        ("VIEW_EXPOSURE", types::VIEW_EXPOSURE),
        ("VIEW_POSE_M", types::VIEW_POSE_M),
        ("VIEW_POSE_AGE", types::VIEW_POSE_AGE),
        ("VIEW_EMBEDDING_AGE", types::VIEW_EMBEDDING_AGE),
        ("VIEW_EMBEDDING", types::VIEW_EMBEDDING),
        ("VIEW_STRIDE", types::VIEW_STRIDE),
        ("NET_SIZE", types::NET_SIZE),
        ("LOG_FOCAL", types::LOG_FOCAL),
    ] {
        check("update_view", constant, expected as u64);
    }
    for (constant, expected) in [
        ("FLAG_TRAIN_SPLATS", types::FLAG_TRAIN_SPLATS),
        ("FLAG_GRADIENTS", types::FLAG_GRADIENTS),
        ("FLAG_POSE_DIRECT", types::FLAG_POSE_DIRECT),
        ("FLAG_POSE_SHARED", types::FLAG_POSE_SHARED),
        ("FLAG_DEPTH", types::FLAG_DEPTH),
        ("FLAG_REFINER", types::FLAG_REFINER),
    ] {
        check("update_view", constant, u64::from(expected));
    }
}

#[test]
fn seeded_faults_are_seen() {
    let seeded = |from: &str, to: &str| {
        assert!(
            PROJECT.source.contains(from),
            "{from:?} is not in the shader"
        );
        let source: &'static str = Box::leak(PROJECT.source.replace(from, to).into_boxed_str());
        faults(&Kernel { source, ..PROJECT }, LANES[0]).unwrap_err()
    };
    seeded("@workgroup_size(256)", "@workgroup_size(64)");
    seeded(
        "@binding(2) var<storage, read> geometry",
        "@binding(2) var<storage, read> shapes",
    );
    seeded("shape_of(camera, mean, ", "shape_of(camera, ");
    seeded("#import shape", "#import shapes");
    seeded(
        "var<storage, read_write> projected",
        "var<storage, read> projected",
    );
}
