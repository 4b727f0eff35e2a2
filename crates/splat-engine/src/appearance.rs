//! The appearance network that all views share: a view's embedding -> gain and offset of its colours, and the way back.
//!
//! A camera's exposure and white balance change along the way; what neighbouring views have in common is learnt by one network, and what each
//! has for itself by its own exposure. The sizes and rates are those of the appearance module of gsplat, which FastSplatting takes over
//! (embedding 16, two hidden layers of 64, rate 1e-3 and ten times that for embeddings, weight decay 1e-6); that module also sees features of each
//! splat, this one does not, so that a map is drawn without it. Equations: docs/GRADIENTS.md, section 9.

use crate::mlp::{Layers, Mlp, MlpGradient, Moments, Rates};
use crate::pose_network::first_embedding;
use crate::settings::FirstEmbedding;

/// Numbers of a view's embedding.
pub const N_EMBEDDING: usize = 16;
/// Numbers of each hidden layer.
pub const N_HIDDEN: usize = 64;
/// Log gain of r, g, b, then their offsets.
pub const N_OUTPUTS: usize = 6;
/// Embeddings move so many times as fast as the network.
pub const EMBEDDING_RATE: f32 = 10.0;
/// Weight decay of parameters and embeddings.
pub const DECAY: f64 = 1e-6;
/// Twentyfold, and the whole range of colour: answers beyond are cut.
pub const MAX_ABS: [f64; 2] = [3.0, 1.0];

const SEED: u64 = 0x5eed_0009;
/// Half the width of the hidden layers' first values: 1/sqrt(64).
const FIRST_BOUND: f32 = 0.125;

/// Numbers that stand for one view; trained along with the network.
pub type AppearanceEmbedding = [f32; N_EMBEDDING];
/// From an embedding to gains and offsets.
pub type AppearanceMlp = Mlp<N_EMBEDDING, N_HIDDEN, N_OUTPUTS>;
/// What the layers of one forward pass answered.
pub type AppearanceLayers = Layers<N_EMBEDDING, N_HIDDEN, N_OUTPUTS>;

/// The view's place in the order of arrival, as waves: neighbours along the way look alike.
pub fn first_appearance(view_ix: usize) -> AppearanceEmbedding {
    let waves = first_embedding(FirstEmbedding::Order, view_ix);
    std::array::from_fn(|i| waves[i])
}

/// The shared network and its optimiser.
#[derive(Debug, Clone, PartialEq)]
pub struct AppearanceNetwork {
    /// From a view's embedding to gains and offsets.
    pub mlp: AppearanceMlp,
}

impl Default for AppearanceNetwork {
    /// Changes no colour.
    fn default() -> Self {
        Self {
            mlp: Mlp::new(SEED, FIRST_BOUND),
        }
    }
}

impl AppearanceNetwork {
    /// Log gain of r, g, b, then their offsets, of one view.
    pub fn exposure(&self, embedding: &AppearanceEmbedding) -> [[f32; 3]; 2] {
        exposure_of(&self.mlp.forward(embedding))
    }

    /// One update of the network and of the view's embedding by the gradient of gain and offset. false: it is not finite, nothing changed.
    pub fn update(
        &mut self,
        embedding: &mut AppearanceEmbedding,
        moments: &mut Moments,
        gradient: [[f64; 3]; 2],
        rate: f32,
    ) -> bool {
        let layers = self.mlp.forward(embedding);
        let gradient = self.backward(&layers, gradient);
        let rates = Rates {
            parameters: rate,
            input: EMBEDDING_RATE * rate,
            decay: DECAY,
        };
        self.mlp.update(embedding, moments, &gradient, &rates)
    }

    /// From the gradient of gain and offset to that of parameters and embedding. Where an answer was cut it is 0.
    pub fn backward(
        &self,
        layers: &AppearanceLayers,
        gradient: [[f64; 3]; 2],
    ) -> MlpGradient<N_EMBEDDING> {
        let g_output = std::array::from_fn(|i| {
            let is_cut = layers.output[i].abs() > MAX_ABS[i / 3];
            if is_cut { 0.0 } else { gradient[i / 3][i % 3] }
        });
        self.mlp.backward(layers, &g_output)
    }
}

fn exposure_of(layers: &AppearanceLayers) -> [[f32; 3]; 2] {
    std::array::from_fn(|kind| {
        std::array::from_fn(|channel| {
            let answer = layers.output[3 * kind + channel];
            answer.clamp(-MAX_ABS[kind], MAX_ABS[kind]) as f32
        })
    })
}
