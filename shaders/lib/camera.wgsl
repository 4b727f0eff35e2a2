// A pinhole at a pose, and how the image is compared. Written by `camera` or by the host. Mirrored by splat/wgpu/types.rs.

struct Camera {
    // Columns of the rotation of cam_from_world; w unused.
    rotation_x: vec4<f32>,
    rotation_y: vec4<f32>,
    rotation_z: vec4<f32>,
    // Translation of cam_from_world; w unused.
    translation: vec4<f32>,
    // Of the camera in the map; w unused.
    center: vec4<f32>,
    // fx, fy, cx, cy in pixels; the first pixel's centre is at 0.5.
    pinhole: vec4<f32>,
    // Bounds of x/z and y/z in the Jacobian: x min, y min, x max, y max.
    slope_bounds: vec4<f32>,
    // Colour that is compared = gain * rendered + offset; w unused.
    gain: vec4<f32>,
    offset: vec4<f32>,
    n_visible: u32,
    n_instances: u32,
    // 1 once a step needed more instances than there is room for; steps do nothing until the host has grown it.
    is_full: u32,
    n_wanted: u32,
    // Images since the host last looked that had room.
    n_done: u32,
    padding_0: u32,
    padding_1: u32,
    padding_2: u32,
}

fn rotation_of_camera(camera: Camera) -> mat3x3<f32> {
    return mat3x3<f32>(camera.rotation_x.xyz, camera.rotation_y.xyz, camera.rotation_z.xyz);
}
