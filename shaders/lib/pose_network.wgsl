// Forward pass of the shared network, and the increment it stands for. One workgroup of 64 threads.

#import view

var<workgroup> embedding: array<f32, 64>;
var<workgroup> hidden_1: array<f32, 64>;
var<workgroup> hidden_2: array<f32, 64>;
var<workgroup> output: array<f32, 9>;

fn network_forward(record: u32, lane: u32) {
    embedding[lane] = views[record + VIEW_EMBEDDING + lane];
    workgroupBarrier();
    var sum = network[NET_B1 + lane];
    for (var i = 0u; i < N_WIDTH; i += 1u) {
        sum += network[NET_W1 + lane * N_WIDTH + i] * embedding[i];
    }
    hidden_1[lane] = max(sum, 0.0);
    workgroupBarrier();
    sum = network[NET_B2 + lane];
    for (var i = 0u; i < N_WIDTH; i += 1u) {
        sum += network[NET_W2 + lane * N_WIDTH + i] * hidden_1[i];
    }
    hidden_2[lane] = max(sum, 0.0);
    workgroupBarrier();
    if lane < 9u {
        sum = network[NET_B3 + lane];
        for (var i = 0u; i < N_WIDTH; i += 1u) {
            sum += network[NET_W3 + lane * N_WIDTH + i] * hidden_2[i];
        }
        output[lane] = sum;
    }
    workgroupBarrier();
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
