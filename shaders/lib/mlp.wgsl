// A network of two hidden layers of 64 with ReLU: forward. One workgroup of 64 threads, one for each hidden number.
// `at`: where the parameters stand in `network`, in the order of mlp.rs of splat-engine. Up to 64 numbers in, 9 out.

const N_WIDTH: u32 = 64u;

var<workgroup> embedding: array<f32, 64>;
var<workgroup> hidden_1: array<f32, 64>;
var<workgroup> hidden_2: array<f32, 64>;
var<workgroup> output: array<f32, 9>;

// Where a layer's weights or biases stand.
struct Layers {
    w1: u32,
    b1: u32,
    w2: u32,
    b2: u32,
    w3: u32,
    b3: u32,
}

fn layers_of(at: u32, n_in: u32, n_out: u32) -> Layers {
    let b1 = at + N_WIDTH * n_in;
    let b2 = b1 + N_WIDTH + N_WIDTH * N_WIDTH;
    let w3 = b2 + N_WIDTH;
    return Layers(at, b1, b1 + N_WIDTH, b2, w3, w3 + n_out * N_WIDTH);
}

// `embedding` -> `output`.
fn mlp_forward(at: u32, n_in: u32, n_out: u32, lane: u32) {
    let places = layers_of(at, n_in, n_out);
    workgroupBarrier();
    var sum = network[places.b1 + lane];
    for (var i = 0u; i < n_in; i += 1u) {
        sum += network[places.w1 + lane * n_in + i] * embedding[i];
    }
    hidden_1[lane] = max(sum, 0.0);
    workgroupBarrier();
    sum = network[places.b2 + lane];
    for (var i = 0u; i < N_WIDTH; i += 1u) {
        sum += network[places.w2 + lane * N_WIDTH + i] * hidden_1[i];
    }
    hidden_2[lane] = max(sum, 0.0);
    workgroupBarrier();
    if lane < n_out {
        sum = network[places.b3 + lane];
        for (var i = 0u; i < N_WIDTH; i += 1u) {
            sum += network[places.w3 + lane * N_WIDTH + i] * hidden_2[i];
        }
        output[lane] = sum;
    }
    workgroupBarrier();
}
