//! A real device that is lost: every call of the engine after it is an error, and none an empty answer.

use std::sync::Arc;

use crate::gpu::gpu_engine;
use crate::reference::random::{SMALL, Scene, scene};
use splat_engine::error::EngineError;
use splat_engine::traits::{Engine, SplatBuffers as _};

/// Every kind of call that can fail.
type Call = fn(&mut dyn Engine, &Scene) -> Result<(), EngineError>;

fn calls() -> Vec<(&'static str, Call)> {
    vec![
        ("status", |e, _| e.status()),
        ("append", |e, s| e.append(&s.splats)),
        ("retain", |e, _| e.retain(&vec![true; e.len()])),
        ("replace", |e, s| e.replace(&s.splats)),
        ("read", |e, _| e.read().map(drop)),
        ("update_counts", |e, _| e.update_counts().map(drop)),
        ("set_update_counts", |e, _| e.set_update_counts(0, &[1, 2])),
        ("add_view", |e, s| e.add_view(s.view.clone()).map(drop)),
        ("unload_view", |e, _| e.unload_view(1)),
        ("set_image", |e, s| {
            e.set_image(0, Arc::clone(&s.view.image), &s.view.intrinsics)
        }),
        ("set_depth", |e, s| e.set_depth(0, s.view.depth.clone())),
        ("set_mask", |e, _| e.set_mask(0, None)),
        ("set_correspondences", |e, _| e.set_correspondences(0, &[])),
        ("set_pose", |e, s| e.set_pose(0, s.view.cam_from_world)),
        ("set_intrinsics", |e, s| {
            e.set_intrinsics(0, &s.view.intrinsics)
        }),
        ("transform_cameras", |e, s| {
            e.transform_cameras(&s.view.cam_from_world)
        }),
        ("poses", |e, _| e.poses().map(drop)),
        ("focal_scale", |e, _| e.focal_scale().map(drop)),
        ("exposures", |e, _| e.exposures().map(drop)),
        ("render", |e, s| {
            e.render(&s.view.intrinsics, &s.view.cam_from_world, 1)
                .map(drop)
        }),
        ("step", |e, _| {
            e.step(0, &crate::reference::random::settings())
        }),
        ("take_stats", |e, _| e.take_stats().map(drop)),
        ("relocate_and_grow", |e, _| {
            e.relocate_and_grow(&crate::relocation::MOVES).map(drop)
        }),
        ("start_pose_network", |e, _| {
            e.start_pose_network(&crate::shared_poses::NETWORK)
        }),
    ]
}

#[test]
fn after_a_real_loss_every_call_is_an_error() {
    let small = scene(11, &SMALL);
    // The first call after the loss is another one each time, with steps on their way and without.
    for (first, (name, call)) in calls().into_iter().enumerate() {
        let mut engine = gpu_engine(true);
        engine_ready(&mut engine, &small, first % 2 == 0);
        engine.lose_device();
        let found = call(&mut engine, &small);
        // Those that read nothing may return while steps are on their way; what follows them may not.
        let may_return = ["step", "status", "set_correspondences"].contains(&name);
        assert!(
            may_return || matches!(found, Err(EngineError::DeviceLost { .. })),
            "{name} right after the loss: {found:?}"
        );
        // A read waits for all that is on its way.
        engine.read().unwrap_err();
        if first % 6 == 0 {
            for (name, call) in calls() {
                let found = call(&mut engine, &small);
                assert!(
                    matches!(found, Err(EngineError::DeviceLost { .. })),
                    "{name}: {found:?}"
                );
            }
        }
    }
}

fn engine_ready(engine: &mut dyn Engine, small: &Scene, has_steps: bool) {
    for (name, call) in calls() {
        let is_later = ["retain", "replace", "unload_view", "relocate_and_grow"].contains(&name);
        if !is_later {
            call(engine, small).unwrap();
        }
    }
    engine.add_view(small.view.clone()).unwrap();
    if has_steps {
        for _ in 0..3 {
            engine
                .step(0, &crate::reference::random::settings())
                .unwrap();
        }
    }
}
