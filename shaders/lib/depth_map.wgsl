// Depth that is wanted at a pixel: the nearest pixel of the depth map that lies behind the photo in `wanted`.

#import step

// A pixel that is mostly see-through has no depth to speak of.
const MIN_ALPHA_FOR_DEPTH: f32 = 0.5;

// Depth, 0 where there is none, and its confidence, 0 where nothing verified it.
fn depth_and_confidence(x: u32, y: u32) -> vec2<f32> {
    let map_x = (2u * x + 1u) * step.depth_width / (2u * step.width_px);
    let map_y = (2u * y + 1u) * step.depth_height / (2u * step.height_px);
    let at = step.width_px * step.height_px + 2u * (map_y * step.depth_width + map_x);
    return vec2<f32>(bitcast<f32>(wanted[at]), bitcast<f32>(wanted[at + 1u]));
}
