//! The stages of a sweep on a GPU.

splat_gpu::kernels! {
    folder "../../shaders/";
    libraries ["flat", "sweep"];
    MVS_COST "mvs_cost" 64 [
        sweep Uniform, luma Read, statistics Read, warps Read, starts Read, costs ReadWrite,
    ];
    MVS_PATHS "mvs_paths" 32 [sweep Uniform, costs Read, penalties Read, sums ReadWrite];
    MVS_WINNER "mvs_winner" 64 [sweep Uniform, costs Read, sums Read, dips ReadWrite];
}
