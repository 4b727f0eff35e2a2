//! The shared pose network: the reference's gradient against central differences, the engine's against the reference implementation.

use glam::{DQuat, DVec3};
use nalgebra::{DVector, Matrix3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use crate::reference::pose_network::{Network, output_gradient};
use splat_engine::mlp::Moments;
use splat_engine::pose_network::{Embedding, PoseMlp, PoseNetwork, WIDTH};
use splat_engine::settings::{FirstEmbedding, PoseNetworkSettings};
use splat_types::transform::Rigid;

/// Central differences in f64 with step 1e-5 lose some ten digits of a smooth function.
const REFERENCE_TOLERANCE: f64 = 1e-5;
const ENGINE_TOLERANCE: f64 = 1e-3;
const STEP: f64 = 1e-5;

fn random_network(seed: u64) -> (PoseNetwork, Embedding) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let settings = PoseNetworkSettings {
        embedding: FirstEmbedding::Order,
        seed,
        camera_scale: 0.7,
    };
    let mut pose_network = PoseNetwork::new(&settings);
    for value in &mut pose_network.mlp.parameters[PoseMlp::W3.start..] {
        *value = rng.random_range(-0.1..0.1);
    }
    (
        pose_network,
        std::array::from_fn(|_| rng.random_range(-0.5..0.5)),
    )
}

fn base() -> Rigid {
    Rigid::exp(DVec3::new(0.4, -0.2, 1.5), DVec3::new(0.3, -0.8, 0.2))
}

/// A smooth function of the moved camera: where it sees three points. Value and gradient of (rho, theta).
fn loss(rotation: &Matrix3<f64>, translation: &Vector3<f64>) -> (f64, [f64; 6]) {
    let (mut value, mut gradient) = (0.0, [0.0; 6]);
    for (n, point) in [[0.5, 0.2, 3.0], [-1.0, 0.4, 2.0], [0.3, -0.9, 2.5]]
        .iter()
        .enumerate()
    {
        let p = rotation * Vector3::from(*point) + translation;
        let wanted = Vector3::new(0.1 * n as f64, 0.3, 2.0);
        let d = p - wanted;
        value += d.norm_squared();
        let turned = p.cross(&(d * 2.0));
        for k in 0..3 {
            gradient[k] += 2.0 * d[k];
            gradient[3 + k] += turned[k];
        }
    }
    (value, gradient)
}

/// Rotation and translation of `cam_from_world` behind the network.
fn moved(network: &Network, embedding: &DVector<f64>) -> (Matrix3<f64>, Vector3<f64>) {
    let (rotation, translation) = network.motion(embedding);
    let base = base();
    let base_rotation = Matrix3::from_column_slice(&base.rotation_matrix().to_cols_array());
    let back = rotation.transpose();
    (
        back * base_rotation,
        back * (Vector3::from(base.translation.to_array()) - translation),
    )
}

fn assert_close(name: &str, found: f64, wanted: f64, scale: f64, tolerance: f64) {
    let error = (found - wanted).abs() / wanted.abs().max(1e-3 * scale);
    assert!(
        error < tolerance,
        "{name}: {found:e}, wanted {wanted:e}, error {error:e}"
    );
}

#[test]
fn the_references_output_gradient_agrees_with_differences() {
    let out = [0.3, -0.2, 0.1, 0.05, -0.2, 0.15, 0.1, -0.1, 0.25];
    let scale = 0.7;
    let at = |out: &[f64]| {
        let (rotation, translation) = crate::reference::pose_network::motion_of(out, scale);
        loss(
            &rotation.transpose(),
            &(-rotation.transpose() * translation),
        )
    };
    let found = output_gradient(&out, scale, at(&out).1);
    for k in 0..9 {
        let (mut high, mut low) = (out, out);
        high[k] += STEP;
        low[k] -= STEP;
        let wanted = (at(&high).0 - at(&low).0) / (2.0 * STEP);
        assert_close(
            &format!("output {k}"),
            found[k],
            wanted,
            1.0,
            REFERENCE_TOLERANCE,
        );
    }
}

#[test]
fn the_references_whole_chain_agrees_with_differences() {
    let (pose_network, embedding) = random_network(3);
    let flat: Vec<f64> = pose_network
        .mlp
        .parameters
        .iter()
        .copied()
        .map(f64::from)
        .collect();
    let embedding = DVector::from_iterator(WIDTH, embedding.iter().copied().map(f64::from));
    let network = Network::new(&flat, pose_network.camera_scale);
    let (rotation, translation) = moved(&network, &embedding);
    let (g_flat, g_embedding) = network.backward(&embedding, loss(&rotation, &translation).1);
    let value = |flat: &[f64], embedding: &DVector<f64>| {
        let network = Network::new(flat, pose_network.camera_scale);
        let (rotation, translation) = moved(&network, embedding);
        (
            loss(&rotation, &translation).0,
            network.decisions(embedding),
        )
    };
    let largest = |g: &[f64]| g.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
    let mut n_skipped = 0;
    let mut check =
        |name: String, high: (f64, Vec<bool>), low: (f64, Vec<bool>), found: f64, scale: f64| {
            if high.1 != low.1 {
                n_skipped += 1;
                return;
            }
            let wanted = (high.0 - low.0) / (2.0 * STEP);
            assert_close(&name, found, wanted, scale, REFERENCE_TOLERANCE);
        };
    // Every seventh reaches all rows and columns of all layers; each costs two passes.
    for k in (0..PoseMlp::N_PARAMETERS)
        .step_by(7)
        .chain(PoseMlp::W3.start..PoseMlp::N_PARAMETERS)
    {
        let at = |delta: f64| {
            let mut flat = flat.clone();
            flat[k] += delta;
            value(&flat, &embedding)
        };
        check(
            format!("parameter {k}"),
            at(STEP),
            at(-STEP),
            g_flat[k],
            largest(&g_flat),
        );
    }
    for k in 0..WIDTH {
        let at = |delta: f64| {
            let mut embedding = embedding.clone();
            embedding[k] += delta;
            value(&flat, &embedding)
        };
        check(
            format!("embedding {k}"),
            at(STEP),
            at(-STEP),
            g_embedding[k],
            largest(&g_embedding),
        );
    }
    assert!(n_skipped < 20, "{n_skipped} differences cross a ReLU");
}

#[test]
fn forward_and_backward_agree_with_the_reference() {
    for seed in 0..20 {
        let (pose_network, embedding) = random_network(seed);
        let flat: Vec<f64> = pose_network
            .mlp
            .parameters
            .iter()
            .copied()
            .map(f64::from)
            .collect();
        let network = Network::new(&flat, pose_network.camera_scale);
        let reference_embedding =
            DVector::from_iterator(WIDTH, embedding.iter().copied().map(f64::from));
        let (rotation, translation) = moved(&network, &reference_embedding);
        let pose = pose_network.apply(&base(), &embedding);
        let wanted = glam::DMat3::from_cols_slice(rotation.as_slice());
        assert!(pose.rotation.angle_between(DQuat::from_mat3(&wanted)) < 1e-7);
        assert!((pose.translation - DVec3::from_slice(translation.as_slice())).length() < 1e-9);

        let g_pose = loss(&rotation, &translation).1;
        let found = pose_network.backward(&pose_network.forward(&embedding), g_pose);
        let (g_flat, g_embedding) = network.backward(&reference_embedding, g_pose);
        for (found, wanted) in [
            (&found.parameters[..], &g_flat),
            (&found.input[..], &g_embedding),
        ] {
            let error: f64 = found.iter().zip(wanted).map(|(a, b)| (a - b).powi(2)).sum();
            let norm: f64 = wanted.iter().map(|v| v * v).sum();
            assert!((error / norm).sqrt() < ENGINE_TOLERANCE, "seed {seed}");
        }
    }
}

#[test]
fn a_fresh_network_moves_nothing_and_its_first_step_moves_all_alike() {
    let mut pose_network = PoseNetwork::new(&PoseNetworkSettings {
        embedding: FirstEmbedding::Order,
        seed: 1,
        camera_scale: 2.0,
    });
    let mut embedding = [0.0; WIDTH];
    assert_eq!(
        pose_network.apply(&Rigid::IDENTITY, &embedding),
        Rigid::IDENTITY
    );
    let gradient = pose_network.backward(
        &pose_network.forward(&embedding),
        [1.0, 0.0, 0.0, 0.0, 2.0, 0.0],
    );
    assert!(gradient.input.iter().all(|g| *g == 0.0));
    assert!(
        gradient.parameters[..PoseMlp::W3.start]
            .iter()
            .all(|g| *g == 0.0)
    );
    let mut moments = Moments::default();
    assert!(pose_network.update(&mut embedding, &mut moments, &gradient, 1e-3));
    assert_eq!(embedding, [0.0; WIDTH]);
    let pose = pose_network.apply(&Rigid::IDENTITY, &embedding);
    assert!(pose.translation.x < 0.0, "against the gradient");
    assert!(pose.rotation.y < 0.0, "against the gradient");
}

#[test]
fn a_gradient_that_is_not_finite_changes_nothing() {
    let (mut pose_network, mut embedding) = random_network(5);
    let before = (pose_network.clone(), embedding);
    let mut pose = [0.0; 6];
    pose[4] = f64::NAN;
    let gradient = pose_network.backward(&pose_network.forward(&embedding), pose);
    assert!(!pose_network.update(&mut embedding, &mut Moments::default(), &gradient, 1e-3));
    assert_eq!((pose_network, embedding), before);
}
