// The way back through the network of `mlp.wgsl`, and Adam on its parameters. Moments stand behind the parameters, `size` numbers each.

var<workgroup> g_output: array<f32, 9>;
var<workgroup> g_hidden_2: array<f32, 64>;
var<workgroup> g_hidden_1: array<f32, 64>;

// Updates of the network so far with this one, rate, and the share of each number that is added to its gradient.
struct MlpRates {
    age: u32,
    rate: f32,
    decay: f32,
}

fn update_parameter(at: u32, size: u32, gradient: f32, rates: MlpRates, correction: vec2<f32>) {
    let g = gradient + rates.decay * network[at];
    let m = BETA_1 * network[size + at] + (1.0 - BETA_1) * g;
    let v = BETA_2 * network[2u * size + at] + (1.0 - BETA_2) * g * g;
    network[size + at] = m;
    network[2u * size + at] = v;
    network[at] -= rates.rate * adam_direction(m, v, correction, VIEW_EPS);
}

// `g_output` -> one update of all parameters. Returns the gradient of `embedding[lane]`.
fn mlp_update(at: u32, n_in: u32, n_out: u32, rates: MlpRates, lane: u32) -> f32 {
    let places = layers_of(at, n_in, n_out);
    let size = places.b3 + n_out - at;
    workgroupBarrier();
    var sum = 0.0;
    for (var o = 0u; o < n_out; o += 1u) {
        sum += network[places.w3 + o * N_WIDTH + lane] * g_output[o];
    }
    g_hidden_2[lane] = select(0.0, sum, hidden_2[lane] > 0.0);
    workgroupBarrier();
    sum = 0.0;
    for (var i = 0u; i < N_WIDTH; i += 1u) {
        sum += network[places.w2 + i * N_WIDTH + lane] * g_hidden_2[i];
    }
    g_hidden_1[lane] = select(0.0, sum, hidden_1[lane] > 0.0);
    workgroupBarrier();
    var g_embedding = 0.0;
    if lane < n_in {
        for (var i = 0u; i < N_WIDTH; i += 1u) {
            g_embedding += network[places.w1 + i * n_in + lane] * g_hidden_1[i];
        }
    }
    // All have read the old parameters before any is written.
    workgroupBarrier();
    storageBarrier();
    let correction = corrections(rates.age);
    for (var i = 0u; i < n_in; i += 1u) {
        update_parameter(places.w1 + lane * n_in + i, size, g_hidden_1[lane] * embedding[i], rates, correction);
    }
    for (var i = 0u; i < N_WIDTH; i += 1u) {
        update_parameter(places.w2 + lane * N_WIDTH + i, size, g_hidden_2[lane] * hidden_1[i], rates, correction);
    }
    for (var o = 0u; o < n_out; o += 1u) {
        update_parameter(places.w3 + o * N_WIDTH + lane, size, g_output[o] * hidden_2[lane], rates, correction);
    }
    update_parameter(places.b1 + lane, size, g_hidden_1[lane], rates, correction);
    update_parameter(places.b2 + lane, size, g_hidden_2[lane], rates, correction);
    if lane < n_out {
        update_parameter(places.b3 + lane, size, g_output[lane], rates, correction);
    }
    return g_embedding;
}

// One update of a number of a view's embedding; its moments stand at `m_at` and `v_at`.
fn update_embedding(at: u32, m_at: u32, v_at: u32, gradient: f32, rates: MlpRates) {
    let g = gradient + rates.decay * views[at];
    let m = BETA_1 * views[m_at] + (1.0 - BETA_1) * g;
    let v = BETA_2 * views[v_at] + (1.0 - BETA_2) * g * g;
    views[m_at] = m;
    views[v_at] = v;
    views[at] -= rates.rate * adam_direction(m, v, corrections(rates.age), VIEW_EPS);
}
