// Forward pass of the appearance network. One workgroup of 64 threads. Equations: docs/GRADIENTS.md, section 9.

#import view
#import mlp

// Twentyfold, and the whole range of colour: answers beyond are cut.
const MAX_GAIN: f32 = 3.0;
const MAX_OFFSET: f32 = 1.0;

fn max_abs_exposure(i: u32) -> f32 {
    return select(MAX_OFFSET, MAX_GAIN, i < 3u);
}

fn appearance_forward(record: u32, lane: u32) {
    workgroupBarrier();
    if lane < N_APPEARANCE {
        embedding[lane] = views[record + VIEW_APPEARANCE + lane];
    }
    mlp_forward(APPEARANCE_NET, N_APPEARANCE, 6u, lane);
}
