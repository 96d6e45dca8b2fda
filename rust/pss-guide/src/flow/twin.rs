//! The flow once more, in f64 and one row at a time: what the tests compare with.

use super::options::Prior;
use super::weights::{Shape, Weights, kept};
use crate::kernel::layer::SLOPE;
use crate::normal::LN_SQRT_TAU;

/// All parameters in f64; [`Weights`] has the layout.
#[derive(Clone)]
pub(super) struct Twin {
    shape: Shape,
    pub(super) tensors: Vec<Vec<f64>>,
}

impl From<&Weights> for Twin {
    fn from(weights: &Weights) -> Self {
        let f64s = |t: &Vec<f32>| t.iter().map(|&w| f64::from(w)).collect();
        Self {
            shape: weights.shape,
            tensors: weights.tensors.iter().map(f64s).collect(),
        }
    }
}

/// A row of raw s or t: the network `which` (0: s, 1: t) of a coupling at `x`, behind whose numbers stand those known.
fn network(twin: &Twin, coupling: usize, which: usize, x: &[f64]) -> Vec<f64> {
    let shape = twin.shape;
    let mut y: Vec<f64> = x
        .iter()
        .enumerate()
        .map(|(i, &x)| {
            let seen = i >= shape.dims || kept(coupling, i);
            if seen { x } else { 0.0 }
        })
        .collect();
    for layer in 0..shape.linear() {
        let (inputs, outputs) = shape.widths(layer);
        let tensor = (coupling * shape.linear() + layer) * 2;
        let (weight, bias) = (&twin.tensors[tensor], &twin.tensors[tensor + 1]);
        let at = |i: usize, o: usize| weight[(which * inputs + i) * outputs + o];
        y = (0..outputs)
            .map(|o| {
                let sum: f64 = y.iter().enumerate().map(|(i, y)| y * at(i, o)).sum();
                let sum = sum + bias[which * outputs + o];
                if layer == shape.layers || sum > 0.0 {
                    sum
                } else {
                    f64::from(SLOPE) * sum
                }
            })
            .collect();
    }
    y
}

/// z → (x, Σ s); what is known stays as it is.
pub(super) fn generate(twin: &Twin, s_max: f64, z: &[f64]) -> (Vec<f64>, f64) {
    let (mut x, mut log_det) = (z.to_vec(), 0.0);
    for coupling in 0..twin.shape.couplings {
        let [raw, t] = [0, 1].map(|which| network(twin, coupling, which, &x));
        for i in (0..twin.shape.dims).filter(|&i| !kept(coupling, i)) {
            let s = s_max * (raw[i] / s_max).tanh();
            x[i] = x[i] * s.exp() + t[i];
            log_det += s;
        }
    }
    (x, log_det)
}

/// x → (z, Σ s).
pub(super) fn normalise(twin: &Twin, s_max: f64, x: &[f64]) -> (Vec<f64>, f64) {
    let (mut z, mut log_det) = (x.to_vec(), 0.0);
    for coupling in (0..twin.shape.couplings).rev() {
        let [raw, t] = [0, 1].map(|which| network(twin, coupling, which, &z));
        for i in (0..twin.shape.dims).filter(|&i| !kept(coupling, i)) {
            let s = s_max * (raw[i] / s_max).tanh();
            z[i] = (z[i] - t[i]) * (-s).exp();
            log_det += s;
        }
    }
    (z, log_det)
}

/// ln q(x).
pub(super) fn log_density(twin: &Twin, s_max: f64, prior: Prior, x: &[f64]) -> f64 {
    let (z, log_det) = normalise(twin, s_max, x);
    let z = &z[..twin.shape.dims];
    let prior = match prior {
        Prior::Gaussian => z.iter().map(|z| -0.5 * z * z - LN_SQRT_TAU).sum(),
        Prior::Hypercube if z.iter().all(|z| (0.0..=1.0).contains(z)) => 0.0,
        Prior::Hypercube => f64::NEG_INFINITY,
    };
    prior - log_det
}

/// ln |det ∂f/∂x| by central differences and Gaussian elimination.
pub(super) fn log_det_numeric(f: impl Fn(&[f64]) -> Vec<f64>, x: &[f64]) -> f64 {
    let (n, h) = (x.len(), 1e-6);
    let mut columns: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            let moved = |by: f64| {
                let mut x = x.to_vec();
                x[i] += by;
                f(&x)
            };
            moved(h)
                .iter()
                .zip(moved(-h))
                .map(|(a, b)| (a - b) / (2.0 * h))
                .collect()
        })
        .collect();
    let mut log_det = 0.0;
    for i in 0..n {
        let pivot = (i..n)
            .max_by(|&a, &b| columns[a][i].abs().total_cmp(&columns[b][i].abs()))
            .unwrap_or(i);
        columns.swap(i, pivot);
        log_det += columns[i][i].abs().ln();
        let row = columns[i].clone();
        for other in &mut columns[i + 1..] {
            let factor = other[i] / row[i];
            other
                .iter_mut()
                .zip(&row)
                .for_each(|(o, r)| *o -= factor * r);
        }
    }
    log_det
}
