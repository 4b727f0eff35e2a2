//! A small network of two hidden layers with ReLU: an input -> an output, the way back, and Adam on its parameters.
//!
//! Parameters stand in one flat array that every backend shares, and so does `shaders/lib/mlp.wgsl`; the arithmetic here is f64. Equations:
//! docs/GRADIENTS.md, sections 8 and 9.

use std::ops::Range;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Decay of Adam's first moment.
pub const BETA_1: f64 = 0.9;
/// Decay of Adam's second moment.
pub const BETA_2: f64 = 0.999;
/// Added to the root of Adam's second moment.
pub const EPS: f64 = 1e-8;

/// Adam's state of an array of parameters.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Moments {
    first: Vec<f32>,
    second: Vec<f32>,
    age: u32,
}

/// The network and its optimiser.
#[derive(Debug, Clone, PartialEq)]
pub struct Mlp<const IN: usize, const HIDDEN: usize, const OUT: usize> {
    /// `N_PARAMETERS` numbers: weights of a layer, then its biases; matrices row by row, one row per output.
    pub parameters: Vec<f32>,
    moments: Moments,
}

/// What the layers of one forward pass answered; hidden ones after the ReLU.
#[derive(Debug, Clone, PartialEq)]
pub struct Layers<const IN: usize, const HIDDEN: usize, const OUT: usize> {
    /// As given.
    pub input: [f64; IN],
    /// First hidden layer.
    pub hidden_1: [f64; HIDDEN],
    /// Second hidden layer.
    pub hidden_2: [f64; HIDDEN],
    /// What the network answers.
    pub output: [f64; OUT],
}

/// Gradient of a loss with respect to all parameters and the input.
#[derive(Debug, Clone, PartialEq)]
pub struct MlpGradient<const IN: usize> {
    /// In the order of [`Mlp::parameters`].
    pub parameters: Vec<f64>,
    /// Of the view that the loss is of.
    pub input: [f64; IN],
}

/// How fast the parameters and the input move in an update.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Adam rate of the parameters.
    pub parameters: f32,
    /// Adam rate of the input.
    pub input: f32,
    /// Share of each number that is added to its gradient (weight decay as in the first Adam).
    pub decay: f64,
}

impl<const IN: usize, const HIDDEN: usize, const OUT: usize> Mlp<IN, HIDDEN, OUT> {
    /// Where the first layer's weights stand in the flat parameters.
    pub const W1: Range<usize> = 0..HIDDEN * IN;
    /// First layer's biases.
    pub const B1: Range<usize> = Self::W1.end..Self::W1.end + HIDDEN;
    /// Second layer's weights.
    pub const W2: Range<usize> = Self::B1.end..Self::B1.end + HIDDEN * HIDDEN;
    /// Second layer's biases.
    pub const B2: Range<usize> = Self::W2.end..Self::W2.end + HIDDEN;
    /// Last layer's weights.
    pub const W3: Range<usize> = Self::B2.end..Self::B2.end + OUT * HIDDEN;
    /// Last layer's biases.
    pub const B3: Range<usize> = Self::W3.end..Self::W3.end + OUT;
    /// All parameters.
    pub const N_PARAMETERS: usize = Self::B3.end;

    /// Hidden layers are random within `bound` of 0, the last one is zero: it answers zeros.
    pub fn new(seed: u64, bound: f32) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut parameters = vec![0.0; Self::N_PARAMETERS];
        for value in &mut parameters[..Self::B2.end] {
            *value = rng.random_range(-bound..bound);
        }
        Self {
            parameters,
            moments: Moments::default(),
        }
    }

    /// The layers' answers.
    pub fn forward(&self, input: &[f32; IN]) -> Layers<IN, HIDDEN, OUT> {
        let p = &self.parameters;
        let input = input.map(f64::from);
        let relu = |v: f64| v.max(0.0);
        let hidden_1 = linear::<IN, HIDDEN>(&p[Self::W1], &p[Self::B1], &input).map(relu);
        let hidden_2 = linear::<HIDDEN, HIDDEN>(&p[Self::W2], &p[Self::B2], &hidden_1).map(relu);
        Layers {
            output: linear::<HIDDEN, OUT>(&p[Self::W3], &p[Self::B3], &hidden_2),
            input,
            hidden_1,
            hidden_2,
        }
    }

    /// From the gradient of the output to that of everything.
    pub fn backward(
        &self,
        layers: &Layers<IN, HIDDEN, OUT>,
        g_output: &[f64; OUT],
    ) -> MlpGradient<IN> {
        let p = &self.parameters;
        let mut parameters = vec![0.0; Self::N_PARAMETERS];
        let mut step = |weights: Range<usize>, biases: Range<usize>, input: &[f64], g: &[f64]| {
            parameters[biases].copy_from_slice(g);
            for (row, g) in parameters[weights].chunks_exact_mut(input.len()).zip(g) {
                row.iter_mut().zip(input).for_each(|(w, x)| *w = g * x);
            }
        };
        step(Self::W3, Self::B3, &layers.hidden_2, g_output);
        let g_hidden_2 = before_relu(transposed(&p[Self::W3], g_output), &layers.hidden_2);
        step(Self::W2, Self::B2, &layers.hidden_1, &g_hidden_2);
        let g_hidden_1 = before_relu(transposed(&p[Self::W2], &g_hidden_2), &layers.hidden_1);
        step(Self::W1, Self::B1, &layers.input, &g_hidden_1);
        MlpGradient {
            input: transposed(&p[Self::W1], &g_hidden_1),
            parameters,
        }
    }

    /// One update of the network and of the input. false: the gradient is not finite, nothing changed.
    pub fn update(
        &mut self,
        input: &mut [f32; IN],
        moments: &mut Moments,
        gradient: &MlpGradient<IN>,
        rates: &Rates,
    ) -> bool {
        let parts = [&gradient.parameters[..], &gradient.input];
        if parts.iter().any(|part| part.iter().any(|g| !g.is_finite())) {
            return false;
        }
        let of_parameters = (rates.parameters, rates.decay);
        self.moments
            .update(&mut self.parameters, &gradient.parameters, of_parameters);
        moments.update(input, &gradient.input, (rates.input, rates.decay));
        true
    }
}

impl Moments {
    fn update(&mut self, values: &mut [f32], gradient: &[f64], (rate, decay): (f32, f64)) {
        self.first.resize(values.len(), 0.0);
        self.second.resize(values.len(), 0.0);
        self.age = self.age.saturating_add(1);
        let unbias_1 = 1.0 - BETA_1.powf(f64::from(self.age));
        let unbias_2 = 1.0 - BETA_2.powf(f64::from(self.age));
        let moments = self.first.iter_mut().zip(&mut self.second);
        for ((value, g), (first, second)) in values.iter_mut().zip(gradient).zip(moments) {
            let g = g + decay * f64::from(*value);
            let m = BETA_1 * f64::from(*first) + (1.0 - BETA_1) * g;
            let v = BETA_2 * f64::from(*second) + (1.0 - BETA_2) * g * g;
            (*first, *second) = (m as f32, v as f32);
            let direction = m / unbias_1 / ((v / unbias_2).sqrt() + EPS);
            *value = (f64::from(*value) - f64::from(rate) * direction) as f32;
        }
    }
}

fn linear<const IN: usize, const ROWS: usize>(
    weights: &[f32],
    biases: &[f32],
    input: &[f64; IN],
) -> [f64; ROWS] {
    std::array::from_fn(|row| {
        let products = weights[row * IN..(row + 1) * IN]
            .iter()
            .zip(input)
            .map(|(w, x)| f64::from(*w) * x);
        f64::from(biases[row]) + products.sum::<f64>()
    })
}

fn transposed<const IN: usize>(weights: &[f32], g: &[f64]) -> [f64; IN] {
    let mut out = [0.0; IN];
    for (row, g) in weights.chunks_exact(IN).zip(g) {
        out.iter_mut()
            .zip(row)
            .for_each(|(out, w)| *out += f64::from(*w) * g);
    }
    out
}

fn before_relu<const N: usize>(mut g: [f64; N], after: &[f64; N]) -> [f64; N] {
    for (g, after) in g.iter_mut().zip(after) {
        if *after <= 0.0 {
            *g = 0.0;
        }
    }
    g
}
