//! What shaders share with the host: structs have the same layout, constants the same value. Needs no GPU.

use std::mem::{offset_of, size_of};

use naga::{Module, ScalarKind, TypeInner};

use crate::shaders::{LANES, kernels, module};
use splat_engine::loss_weights::LossWeights;
use splat_engine::wgpu::kernels::PROJECT;
use splat_engine::wgpu::types::{self, Camera, Moves, Projected, Step};
use splat_geometry::mvs::gpu_types::{self, Dip, Sweep, Warp};
use splat_gpu::kernel::Kernel;
use splat_gpu::types::{SCAN_BLOCK, SORT_BLOCK, SortPass};

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
fn the_step_has_the_layout_of_the_host() {
    let mut step: Layout = host_layout!(
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
        lr_mean_decay,
        lr_scale,
        lr_quat,
        lr_opacity,
        lr_sh0,
        lr_sh_rest,
        lr_rotation,
        lr_translation,
        lr_pose_network,
        lr_focal,
        lr_exposure,
        lr_appearance,
        noise,
        noise_seed,
        ssim_weight,
        ssim_share,
        ssim_margin,
        near,
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
    let weights = LossWeights::NAMES.iter().enumerate().map(|(ix, name)| {
        let offset = offset_of!(Step, weights) + ix * size_of::<f32>();
        ((*name).to_owned(), offset, f32::NAME.to_owned())
    });
    step.0.extend(weights);
    step.0.sort_by_key(|(_, offset, _)| *offset);
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
        by_image,
        keeps_age,
        padding_1
    );
    assert_eq!(layout_in("Moves", &kernel("move_draw")), moves);
}

#[test]
fn structs_of_a_sweep_have_the_layout_of_the_host() {
    let sweep: Layout = host_layout!(
        Sweep,
        width_px,
        height_px,
        n_planes,
        n_words,
        n_sources,
        small_step,
        noise_variance,
        unseen_zncc,
        own_share,
        most_off,
        padding_0,
        padding_1
    );
    assert_eq!(layout_in("Sweep", &kernel("mvs_cost")), sweep);
    let warp: Layout = host_layout!(Warp, step_x, step_y, width_px, height_px, first, shown);
    assert_eq!(layout_in("Warp", &kernel("mvs_cost")), warp);
    let dip: Layout = host_layout!(Dip, plane, cost, before_at, after_second);
    assert_eq!(layout_in("Dip", &kernel("mvs_winner")), dip);
}

fn kernel(name: &str) -> Kernel {
    let found = kernels().find(|kernel| kernel.name == name).unwrap();
    Kernel { ..*found }
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
    check("sort_count", "SORT_BLOCK", u64::from(SORT_BLOCK));
    check("scan_sums", "SCAN_BLOCK", u64::from(SCAN_BLOCK));
    check("project", "TILE_PX", u64::from(types::TILE_PX));
    check(
        "mvs_paths",
        "MAX_SWEEP_PLANES",
        u64::from(gpu_types::MAX_SWEEP_PLANES),
    );
    for (constant, expected) in [
        ("SWEEP_WINDOW", gpu_types::SWEEP_WINDOW),
        ("SWEEP_TILE_X", gpu_types::SWEEP_TILE_X),
        ("SWEEP_TILE_Y", gpu_types::SWEEP_TILE_Y),
    ] {
        check("mvs_cost", constant, u64::from(expected));
    }
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
        ("VIEW_APPEARANCE", types::VIEW_APPEARANCE),
        ("VIEW_STRIDE", types::VIEW_STRIDE),
        ("NET_SIZE", types::NET_SIZE),
        ("LOG_FOCAL", types::LOG_FOCAL),
        ("APPEARANCE_NET", types::APPEARANCE_NET),
    ] {
        check("update_view", constant, expected as u64);
    }
    for (constant, expected) in [
        ("FLAG_TRAIN_SPLATS", types::FLAG_TRAIN_SPLATS),
        ("FLAG_GRADIENTS", types::FLAG_GRADIENTS),
        ("FLAG_POSE_DIRECT", types::FLAG_POSE_DIRECT),
        ("FLAG_POSE_SHARED", types::FLAG_POSE_SHARED),
        ("FLAG_DEPTH", types::FLAG_DEPTH),
        ("FLAG_POSE_NETWORK", types::FLAG_POSE_NETWORK),
        ("FLAG_SCREEN_GRADIENTS", types::FLAG_SCREEN_GRADIENTS),
        ("FLAG_APPEARANCE", types::FLAG_APPEARANCE),
    ] {
        check("update_view", constant, u64::from(expected));
    }
}
