//! The network that all views share: a view's embedding -> a motion of its camera, and the way back (3R-GS).
//!
//! Knows nothing of images. Equations: docs/GRADIENTS.md, section 8.

use std::f32::consts::TAU;

use glam::{DMat3, DQuat, DVec3};

use crate::mlp::{Layers, Mlp, MlpGradient, Moments, Rates};
use crate::settings::{FirstEmbedding, PoseNetworkSettings};
use splat_types::transform::{Rigid, skew};

/// Numbers of a view's embedding, and of each hidden layer (3R-GS).
pub const WIDTH: usize = 64;
/// Three of translation, six of rotation.
pub const N_OUTPUTS: usize = 9;

/// Three of translation, six of rotation: three numbers in units of `camera_scale`, then what is added to the first two rows of the identity
/// (Zhou et al. 2019).
pub type PoseMlp = Mlp<WIDTH, WIDTH, N_OUTPUTS>;
/// What the layers of one forward pass answered.
pub type PoseLayers = Layers<WIDTH, WIDTH, N_OUTPUTS>;

/// Views in the shortest wave of an embedding: shorter ones would follow the noise of single views.
const FIRST_WAVE: usize = 16;
/// The longest is 2,048 views long.
const N_WAVES: usize = 8;
/// Half the width of the hidden layers' first values: 1/sqrt(64), the usual start of a linear layer.
const FIRST_BOUND: f32 = 0.125;
/// Shorter rows of the rotation have no direction: the network has left all sense, and the rotation is none.
const MIN_ROW: f64 = 1e-6;
/// Rows that the six numbers are added to, so that zero means no rotation.
const FIRST_ROWS: [f64; 6] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// Numbers that stand for one view; trained along with the network.
pub type Embedding = [f32; WIDTH];

/// What is known of a view at its start: its place in the order of arrival, as waves from `FIRST_WAVE` views long, each twice
/// as long as the one before. So the network's motions are smooth along the way, as drift is; with zeros (3R-GS) all views would
/// have to move alike until they had been distinguished.
pub fn first_embedding(kind: FirstEmbedding, view_ix: usize) -> Embedding {
    let mut embedding = [0.0; WIDTH];
    if kind == FirstEmbedding::Zero {
        return embedding;
    }
    let (waves, _) = embedding.as_chunks_mut::<2>();
    let mut length = FIRST_WAVE;
    for wave in &mut waves[..N_WAVES] {
        let (sin, cos) = (TAU * (view_ix % length) as f32 / length as f32).sin_cos();
        *wave = [sin, cos];
        length *= 2;
    }
    embedding
}

/// The shared network and its optimiser.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseNetwork {
    /// From a view's embedding to the nine numbers of its motion.
    pub mlp: PoseMlp,
    /// World units that an output of 1 moves a camera by.
    pub camera_scale: f64,
    /// What embeddings of new views are at first.
    pub embedding: FirstEmbedding,
}

impl PoseNetwork {
    /// Hidden layers are random, the last one is zero: every camera starts where it is.
    pub fn new(settings: &PoseNetworkSettings) -> Self {
        Self {
            mlp: Mlp::new(settings.seed ^ 0x5eed_0003, FIRST_BOUND),
            camera_scale: f64::from(settings.camera_scale),
            embedding: settings.embedding,
        }
    }

    /// The layers' answers for one view.
    pub fn forward(&self, embedding: &Embedding) -> PoseLayers {
        self.mlp.forward(embedding)
    }

    /// `base_from_cam`: the camera's own motion, `world_from_cam = world_from_base * base_from_cam`.
    pub fn motion(&self, output: &[f64; N_OUTPUTS]) -> Rigid {
        let rows = Rows::new(output);
        let rotation = rows.map_or(DQuat::IDENTITY, |rows| {
            DQuat::from_mat3(&rows.matrix()).normalize()
        });
        let [x, y, z, ..] = *output;
        Rigid::new(rotation, DVec3::new(x, y, z) * self.camera_scale)
    }

    /// `cam_from_world` of the camera whose base pose and embedding are given.
    pub fn apply(&self, cam_from_base_world: &Rigid, embedding: &Embedding) -> Rigid {
        let motion = self.motion(&self.forward(embedding).output);
        (motion.inverse() * *cam_from_base_world).renormalized()
    }

    /// `pose_gradient` is that of (rho, theta) in `exp([rho; theta]) * cam_from_world`, at the moved camera.
    pub fn backward(&self, layers: &PoseLayers, pose_gradient: [f64; 6]) -> MlpGradient<WIDTH> {
        let g_output = output_gradient(&layers.output, self.camera_scale, pose_gradient);
        self.mlp.backward(layers, &g_output)
    }

    /// One update of the network and of the view's embedding. false: the gradient is not finite, nothing changed.
    pub fn update(
        &mut self,
        embedding: &mut Embedding,
        moments: &mut Moments,
        gradient: &MlpGradient<WIDTH>,
        rate: f32,
    ) -> bool {
        let rates = Rates {
            parameters: rate,
            input: rate,
            decay: 0.0,
        };
        self.mlp.update(embedding, moments, gradient, &rates)
    }
}

/// Six numbers made orthonormal (Gram and Schmidt; Zhou et al. 2019), and what the way back needs.
struct Rows {
    a1: DVec3,
    a2: DVec3,
    b1: DVec3,
    b2: DVec3,
    b3: DVec3,
    /// Length of the part of `a2` across `b1`.
    across: f64,
}

impl Rows {
    fn new(output: &[f64; N_OUTPUTS]) -> Option<Self> {
        let r: [f64; 6] = std::array::from_fn(|k| output[3 + k] + FIRST_ROWS[k]);
        let (a1, a2) = (DVec3::new(r[0], r[1], r[2]), DVec3::new(r[3], r[4], r[5]));
        if a1.length().is_nan() || a1.length() < MIN_ROW {
            return None;
        }
        let b1 = a1 / a1.length();
        let rest = a2 - b1 * b1.dot(a2);
        let across = rest.length();
        if across.is_nan() || across < MIN_ROW {
            return None;
        }
        let b2 = rest / across;
        Some(Self {
            a1,
            a2,
            b1,
            b2,
            b3: b1.cross(b2),
            across,
        })
    }

    fn matrix(&self) -> DMat3 {
        DMat3::from_cols(self.b1, self.b2, self.b3).transpose()
    }

    /// From the gradient of the matrix's rows to that of the six numbers.
    fn backward(&self, rows: [DVec3; 3]) -> [f64; 6] {
        let Self { a1, a2, b1, b2, .. } = *self;
        let [mut h1, mut h2, h3] = rows;
        h1 += b2.cross(h3);
        h2 += h3.cross(b1);
        let u2 = (h2 - b2 * h2.dot(b2)) / self.across;
        let g_a2 = u2 - b1 * u2.dot(b1);
        h1 -= a2 * u2.dot(b1) + u2 * b1.dot(a2);
        let g_a1 = (h1 - b1 * h1.dot(b1)) / a1.length();
        [g_a1.x, g_a1.y, g_a1.z, g_a2.x, g_a2.y, g_a2.z]
    }
}

/// From the gradient of the left-multiplied increment of `cam_from_world` to that of the network's output.
fn output_gradient(
    output: &[f64; N_OUTPUTS],
    camera_scale: f64,
    pose_gradient: [f64; 6],
) -> [f64; N_OUTPUTS] {
    // A motion of the camera in its own axes is the inverse of one of the map before it.
    let [rho_x, rho_y, rho_z, theta_x, theta_y, theta_z] = pose_gradient;
    let e_r = -DVec3::new(rho_x, rho_y, rho_z);
    let e_t = -DVec3::new(theta_x, theta_y, theta_z);
    let Some(rows) = Rows::new(output) else {
        let g = e_r * camera_scale;
        return [g.x, g.y, g.z, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    };
    let rotation = rows.matrix();
    let g_dx = rotation * e_r * camera_scale;
    let g_rows = (rotation * skew(e_t) * 0.5).transpose();
    let g_dr = rows.backward([g_rows.x_axis, g_rows.y_axis, g_rows.z_axis]);
    let mut g = [0.0; N_OUTPUTS];
    g[..3].copy_from_slice(&g_dx.to_array());
    g[3..].copy_from_slice(&g_dr);
    g
}
