//! The stages of a training step and of a rendering on a GPU.

splat_gpu::kernels! {
    folder "../../shaders/";
    libraries [
        "adam",
        "appearance",
        "batch",
        "blend",
        "camera",
        "cleared",
        "depth_map",
        "flat",
        "groups",
        "lane_sum_shared",
        "lane_sum_subgroup",
        "lane_sum_subgroups",
        "mlp",
        "mlp_update",
        "moves",
        "pose_network",
        "projected",
        "quat",
        "random",
        "sh",
        "shape",
        "sorting",
        "splat_update",
        "ssim",
        "ssim_maps_blur",
        "ssim_maps_load",
        "step",
        "subgroup_sums",
        "tile_backward",
        "view",
    ] and ["loss_weights" = crate::loss_weights::WGSL_FIELDS];
    VIEW_CAMERA "view_camera" 64 [step Uniform, views ReadWrite, network Read, camera ReadWrite];
    CULL "cull" 256 [step Uniform, camera Read, geometry Read, visible_bits ReadWrite, block_counts ReadWrite];
    VISIBLE_ARGS "visible_args" 1 [
        step Uniform, block_offsets Read, camera ReadWrite, n_visible ReadWrite, args ReadWrite,
    ];
    PROJECT "project" 256 [
        step Uniform, camera Read, geometry Read, sh_rest Read, visible_bits Read, block_offsets Read,
        projected ReadWrite, depth_keys ReadWrite, depth_values ReadWrite,
    ];
    TILE_COUNTS "tile_counts" 256 [camera Read, depth_order Read, projected Read, counts ReadWrite];
    INSTANCE_ARGS "instance_args" 1 [
        step Uniform, first_instances Read, camera ReadWrite, n_instances ReadWrite,
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
        step Uniform, projected Read, instances Read, tile_ranges Read, image ReadWrite, depth_sum ReadWrite,
        n_used ReadWrite,
    ];
    SSIM_ROWS "ssim_rows" 64 [step Uniform, camera Read, image Read, wanted Read, moments ReadWrite];
    SSIM_TERMS "ssim_terms" 64 [step Uniform, moments Read, wanted Read, terms ReadWrite, ssim_sums ReadWrite];
    SSIM_BACK "ssim_back" 64 [step Uniform, maps Read, blurred ReadWrite];
    PHOTO_GRADIENT "photo_gradient" 64 [
        step Uniform, camera Read, image Read, depth_sum Read, wanted Read, maps Read, v_image ReadWrite,
        behind ReadWrite, loss_sums ReadWrite,
    ];
    DEPTH_STRETCH "depth_stretch" 256 [
        step Uniform, image Read, depth_sum Read, wanted Read, v_image ReadWrite, behind ReadWrite,
        loss_sums ReadWrite,
    ];
    RASTER_BACKWARD "raster_backward" lanes [
        step Uniform, projected Read, instances Read, tile_ranges Read, n_used Read, v_image Read, behind_all Read,
        slots ReadWrite,
    ];
    RASTER_BACKWARD_ATOMIC "raster_backward_atomic" lanes [
        step Uniform, projected Read, instances Read, tile_ranges Read, n_used Read, v_image Read, behind_all Read,
        splat_sums ReadWrite,
    ];
    GATHER "gather" 256 [camera Read, projected Read, places Read, slots Read, splat_sums ReadWrite];
    PROJECT_BACKWARD "project_backward" 256 [
        step Uniform, camera Read, projected Read, splat_sums Read, geometry ReadWrite, moments ReadWrite,
        sh_rest ReadWrite, sh_moments ReadWrite, pose_sums ReadWrite,
    ];
    UPDATE_UNSEEN "update_unseen" 256 [
        step Uniform, camera Read, geometry ReadWrite, moments ReadWrite, sh_rest ReadWrite, sh_moments ReadWrite,
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
}
