// Forward pass of the shared network, and the increment it stands for. One workgroup of 64 threads.

#import view
#import mlp

fn network_forward(record: u32, lane: u32) {
    workgroupBarrier();
    embedding[lane] = views[record + VIEW_EMBEDDING + lane];
    mlp_forward(0u, N_WIDTH, 9u, lane);
}

// Two vectors that Gram-Schmidt makes the first rows of the rotation; at 0 it is none (Zhou et al. 2019).
fn increment_rows() -> mat2x3<f32> {
    return mat2x3<f32>(
        vec3<f32>(output[3] + 1.0, output[4], output[5]),
        vec3<f32>(output[6], output[7] + 1.0, output[8]),
    );
}

// Rows b1, b2, b3 as columns.
fn orthonormal(a: mat2x3<f32>) -> mat3x3<f32> {
    let b1 = normalize(a[0]);
    let b2 = normalize(a[1] - dot(b1, a[1]) * b1);
    return mat3x3<f32>(b1, b2, cross(b1, b2));
}
