//! Reference implementation of the shared pose network: forward, and its gradient by the chain rule, in matrices. GRADIENTS.md section 8.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

pub const WIDTH: usize = 64;

/// The layers apart, read from the flat order that backends share: w1, b1, w2, b2, w3, b3.
#[derive(Debug, Clone)]
pub struct Network {
    pub weights: [DMatrix<f64>; 3],
    pub biases: [DVector<f64>; 3],
    pub camera_scale: f64,
}

impl Network {
    pub fn new(parameters: &[f64], camera_scale: f64) -> Self {
        let mut rest = parameters;
        let mut take = |n: usize| {
            let (head, tail) = rest.split_at(n);
            rest = tail;
            head.to_vec()
        };
        let sizes = [WIDTH, WIDTH, 9];
        let layers = sizes.map(|rows| {
            let w = DMatrix::from_row_slice(rows, WIDTH, &take(rows * WIDTH));
            (w, DVector::from_vec(take(rows)))
        });
        assert!(rest.is_empty(), "8905 numbers in all");
        Self {
            weights: layers.clone().map(|l| l.0),
            biases: layers.map(|l| l.1),
            camera_scale,
        }
    }

    /// Values before each ReLU, and the output.
    fn sums(&self, embedding: &DVector<f64>) -> [DVector<f64>; 3] {
        let relu = |v: &DVector<f64>| v.map(|x| x.max(0.0));
        let first = &self.weights[0] * embedding + &self.biases[0];
        let second = &self.weights[1] * relu(&first) + &self.biases[1];
        let out = &self.weights[2] * relu(&second) + &self.biases[2];
        [first, second, out]
    }

    /// Whether each hidden unit is on: a difference across a change of these is no derivative.
    pub fn decisions(&self, embedding: &DVector<f64>) -> Vec<bool> {
        let [first, second, _] = self.sums(embedding);
        first
            .iter()
            .chain(second.iter())
            .map(|v| *v > 0.0)
            .collect()
    }

    /// Rotation and translation of `base_from_cam`.
    pub fn motion(&self, embedding: &DVector<f64>) -> (Matrix3<f64>, Vector3<f64>) {
        let [_, _, out] = self.sums(embedding);
        motion_of(out.as_slice(), self.camera_scale)
    }

    /// From the gradient of (rho, theta) of the moved camera, to (flat parameters, embedding).
    pub fn backward(&self, embedding: &DVector<f64>, pose: [f64; 6]) -> (Vec<f64>, Vec<f64>) {
        let [first, second, out] = self.sums(embedding);
        let relu = |v: &DVector<f64>| v.map(|x| x.max(0.0));
        let gate =
            |g: DVector<f64>, v: &DVector<f64>| g.zip_map(v, |g, v| if v > 0.0 { g } else { 0.0 });
        let g3 =
            DVector::from_column_slice(&output_gradient(out.as_slice(), self.camera_scale, pose));
        let g2 = gate(self.weights[2].transpose() * &g3, &second);
        let g1 = gate(self.weights[1].transpose() * &g2, &first);
        let g0 = self.weights[0].transpose() * &g1;
        let mut flat = Vec::new();
        for (g, input) in [
            (&g1, embedding.clone()),
            (&g2, relu(&first)),
            (&g3, relu(&second)),
        ] {
            // nalgebra stores columns: the transposed product reads out row by row.
            flat.extend((g * input.transpose()).transpose().iter());
            flat.extend(g.iter());
        }
        (flat, g0.iter().copied().collect())
    }
}

/// Gram and Schmidt on the six numbers plus (1,0,0, 0,1,0), rows of the rotation.
pub fn motion_of(out: &[f64], camera_scale: f64) -> (Matrix3<f64>, Vector3<f64>) {
    let a1 = Vector3::new(out[3] + 1.0, out[4], out[5]);
    let a2 = Vector3::new(out[6], out[7] + 1.0, out[8]);
    let b1 = a1.normalize();
    let b2 = (a2 - b1 * b1.dot(&a2)).normalize();
    let rotation = Matrix3::from_rows(&[b1.transpose(), b2.transpose(), b1.cross(&b2).transpose()]);
    (
        rotation,
        Vector3::new(out[0], out[1], out[2]) * camera_scale,
    )
}

/// By differentiating `motion_of` along each output with dual numbers in place of rules for Gram-Schmidt:
/// d(base_from_cam) = base_from_cam [e]^, and the loss falls by (rho, theta) . e for a camera that moves by e.
pub fn output_gradient(out: &[f64], camera_scale: f64, pose: [f64; 6]) -> Vec<f64> {
    let a1 = Vector3::new(out[3] + 1.0, out[4], out[5]);
    let a2 = Vector3::new(out[6], out[7] + 1.0, out[8]);
    let (rotation, _) = motion_of(out, camera_scale);
    let unit = |v: Vector3<f64>, dv: Vector3<f64>| {
        let u = v.normalize();
        (u, (dv - u * u.dot(&dv)) / v.norm())
    };
    (0..9)
        .map(|k| {
            let one = |ix: usize| if ix == k { 1.0 } else { 0.0 };
            let (da1, da2) = (
                Vector3::new(one(3), one(4), one(5)),
                Vector3::new(one(6), one(7), one(8)),
            );
            let (b1, db1) = unit(a1, da1);
            let across = a2 - b1 * b1.dot(&a2);
            let d_across = da2 - db1 * b1.dot(&a2) - b1 * (db1.dot(&a2) + b1.dot(&da2));
            let (b2, db2) = unit(across, d_across);
            let db3 = db1.cross(&b2) + b1.cross(&db2);
            let dr = Matrix3::from_rows(&[db1.transpose(), db2.transpose(), db3.transpose()]);
            let turn = rotation.transpose() * dr;
            let e_t = Vector3::new(turn[(2, 1)], turn[(0, 2)], turn[(1, 0)]);
            let e_r = rotation.transpose() * Vector3::new(one(0), one(1), one(2)) * camera_scale;
            -(0..3)
                .map(|i| pose[i] * e_r[i] + pose[3 + i] * e_t[i])
                .sum::<f64>()
        })
        .collect()
}
