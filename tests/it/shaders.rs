//! Every shader parses, validates and agrees with the host's table: files, bindings and workgroups.
//! Needs no GPU.

use std::collections::BTreeSet;

use naga::valid::{Capabilities, ShaderStages, SubgroupOperationSet, ValidationFlags, Validator};
use naga::{AddressSpace, Module, StorageAccess};

use splat_engine::wgpu::kernels as splats;
use splat_engine::wgpu::kernels::{PROJECT, RASTER_BACKWARD_ATOMIC};
use splat_geometry::mvs::kernels as sweep;
use splat_gpu::kernel as shared;
use splat_gpu::kernel::{Access, Kernel, Lanes};

/// Without and with subgroups, one and several, as adapters have them.
pub const LANES: [Lanes; 5] = [
    Lanes {
        n: 32,
        subgroup: None,
    },
    Lanes {
        n: 8,
        subgroup: Some(8),
    },
    Lanes {
        n: 32,
        subgroup: Some(32),
    },
    Lanes {
        n: 64,
        subgroup: Some(64),
    },
    Lanes {
        n: 256,
        subgroup: Some(32),
    },
];
/// Texts to import that are no files.
const MADE_BY_THE_HOST: [&str; 1] = ["loss_weights"];
/// What WebGPU guarantees to every stage, and to a uniform.
const MAX_STORAGE_BINDINGS: usize = 8;

/// The tables of all that have shaders.
pub fn kernels() -> impl Iterator<Item = &'static Kernel> {
    [shared::ALL, splats::ALL, sweep::ALL].concat().into_iter()
}

pub fn module(kernel: &Kernel, lanes: Lanes) -> Result<Module, String> {
    let text = kernel
        .text(lanes)
        .ok_or("an #import names no file of shaders/lib, or a #repeat has no end")?;
    let module = naga::front::wgsl::parse_str(&text).map_err(|e| e.emit_to_string(&text))?;
    let mut capabilities = Capabilities::SUBGROUP;
    // The one that engines compile only where the adapter has float atomics.
    let is_atomic = kernel.name == RASTER_BACKWARD_ATOMIC.name;
    capabilities.set(Capabilities::SHADER_FLOAT32_ATOMIC, is_atomic);
    let mut validator = Validator::new(ValidationFlags::all(), capabilities);
    if lanes.subgroup.is_some() {
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

#[test]
fn every_shader_is_valid_and_as_the_table_says() {
    for lanes in LANES {
        for kernel in kernels().filter(|kernel| kernel.suits(lanes)) {
            faults(kernel, lanes)
                .unwrap_or_else(|e| panic!("shaders/{}.wgsl, {lanes:?}: {e}", kernel.name));
        }
    }
}

#[test]
fn the_tables_list_every_file_once() {
    let files = |folder: &str| -> BTreeSet<String> {
        let entries = std::fs::read_dir(folder)
            .unwrap()
            .map(|e| e.unwrap().path());
        entries
            .filter(|p| p.is_file())
            .map(|p| p.file_stem().unwrap().to_str().unwrap().to_owned())
            .collect()
    };
    let names: BTreeSet<String> = kernels().map(|k| k.name.to_owned()).collect();
    assert_eq!(files("shaders"), names);
    assert_eq!(kernels().count(), names.len(), "a shader is in two tables");
    let libraries = [shared::LIBRARIES, splats::LIBRARIES, sweep::LIBRARIES].concat();
    let is_file = |name: &&str| !MADE_BY_THE_HOST.contains(name);
    let listed = libraries.iter().map(|(name, _)| *name).filter(is_file);
    assert_eq!(files("shaders/lib"), listed.map(str::to_owned).collect());
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
