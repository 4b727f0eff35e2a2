// A pinhole camera and how splats become visible in it. Mirrored by gpu/types.rs.

struct Camera {
    // Columns of the rotation of cam_from_map; w unused.
    rotation_x: vec4<f32>,
    rotation_y: vec4<f32>,
    rotation_z: vec4<f32>,
    // Translation of cam_from_map; w unused.
    translation: vec4<f32>,
    // fx, fy, cx, cy in pixels; the first pixel's centre is at 0.5.
    pinhole: vec4<f32>,
    width_px: u32,
    height_px: u32,
    n_splats: u32,
    sh_degree: u32,
}

// One splat on the screen.
struct ProjectedSplat {
    // Pixels.
    mean_px: vec2<f32>,
    // z in the camera, map units; 0 marks a splat that is not visible.
    depth: f32,
    opacity: f32,
    // Upper triangle a, b, c of the inverse 2D covariance; w unused.
    conic: vec4<f32>,
    // r, g, b; w unused.
    colour: vec4<f32>,
    // Half sides in pixels of the box outside which alpha stays below 1/255.
    extent_px: vec2<f32>,
    padding: vec2<f32>,
}

fn cam_from_map(camera: Camera, mean_in_map: vec3<f32>) -> vec3<f32> {
    let rotation = mat3x3<f32>(camera.rotation_x.xyz, camera.rotation_y.xyz, camera.rotation_z.xyz);
    return rotation * mean_in_map + camera.translation.xyz;
}
