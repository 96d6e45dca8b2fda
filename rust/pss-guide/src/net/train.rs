//! Training by Adam (Kingma and Ba 2015, arXiv:1412.6980) with a hand-written backward pass; the tests compare it with
//! candle's. The loss is what the guide is for: the second moment of the mixture's estimate,
//! mean of w / (a + (1 − a) Π_b q_b), w = f²/g scaled to mean 1, so that uniform numbers have loss 1 (Müller et al. 2019,
//! doi:10.1145/3341156, minimise the variance likewise).
//!
//! A batch is cut into parts of fixed size that any number of threads may compute; their sums are added in order.

use pss_rng::{Purpose, Stream};
use rayon::prelude::*;

use super::mlp::FEATURES;
use super::model::Model;
use super::options::NetOptions;
use crate::{EpochLoss, GuideError};

/// Decisions in one part of a batch.
const PART: usize = 256;

/// Longest step of a batch's gradient.
const MOST_GRADIENT: f32 = 1.0;

/// Adam's decay of the moments, and what keeps its quotient finite.
const BETA: [f32; 2] = [0.9, 0.999];
const EPSILON: f32 = 1e-8;

/// Paths to learn from.
pub(super) struct Data {
    /// Decisions of a path, k − 1.
    pub(super) vertices: usize,
    /// What the network sees at each, `(n · vertices, FEATURES)`.
    pub(super) inputs: Vec<f32>,
    /// The numbers drawn there, `(n · vertices, 2)`.
    pub(super) u: Vec<f32>,
    /// Weights of the paths, `n`.
    pub(super) weights: Vec<f32>,
}

/// Loss and derivatives of some paths, each a sum over them.
#[derive(Clone, Debug, Default)]
pub(super) struct Gradient {
    pub(super) loss: f64,
    /// By every tensor of every network.
    pub(super) tensors: Vec<Vec<f32>>,
}

/// Trains `model`; `progress` gets the share done and returns false to cancel.
pub(super) fn train(
    guide: &str,
    options: &NetOptions,
    model: &mut Model,
    data: &Data,
    seed: u64,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Vec<EpochLoss>, GuideError> {
    let rows = data.weights.len();
    let (epochs, batches) = (options.epochs(rows), rows.div_ceil(options.batch));
    let steps = epochs * batches;
    let mut order: Vec<u32> = (0..rows as u32).collect();
    let mut adam = Adam::new(model);
    let mut history = Vec::with_capacity(epochs);
    for epoch in 0..epochs {
        shuffle(&mut order, seed, epoch);
        let mut sum = 0.0;
        for (batch, paths) in order.chunks(options.batch).enumerate() {
            let done = (epoch * batches + batch) as f64 / steps as f64;
            if !progress(done as f32) {
                return Err(GuideError::Cancelled);
            }
            let mut gradient = gradient(model, data, paths, options.loss_fraction as f32);
            if !(gradient.loss.is_finite() && gradient.scale(paths.len())) {
                return Err(GuideError::Diverged {
                    guide: guide.to_owned(),
                    epoch: epoch + 1,
                    batch: batch + 1,
                    loss: gradient.loss,
                });
            }
            let rate = options.learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * done).cos());
            adam.step(model, &gradient, rate as f32);
            sum += gradient.loss;
        }
        history.push(EpochLoss {
            epoch: epoch + 1,
            loss: sum / rows as f64,
        });
    }
    Ok(history)
}

/// Fisher–Yates from the identity, so that an epoch's order depends on seed and epoch alone.
fn shuffle(order: &mut [u32], seed: u64, epoch: usize) {
    let mut numbers = Stream::new(seed, Purpose::Training).sequence(1, epoch as u32);
    order.iter_mut().zip(0..).for_each(|(o, i)| *o = i);
    for i in (1..order.len()).rev() {
        order.swap(i, numbers.below(i as u32 + 1) as usize);
    }
}

impl Gradient {
    fn add(&mut self, other: &Self) {
        self.loss += other.loss;
        for (sum, part) in self.tensors.iter_mut().zip(&other.tensors) {
            sum.iter_mut().zip(part).for_each(|(s, p)| *s += p);
        }
    }

    /// From the sum over `n` paths to their mean, no longer than [`MOST_GRADIENT`]; whether it is finite.
    fn scale(&mut self, n: usize) -> bool {
        let squares = self.tensors.iter().flatten().map(|g| f64::from(*g).powi(2));
        let norm = squares.sum::<f64>().sqrt() / n as f64;
        let shrink = (f64::from(MOST_GRADIENT) / norm.max(1e-30)).min(1.0);
        let factor = (shrink / n as f64) as f32;
        self.tensors.iter_mut().flatten().for_each(|g| *g *= factor);
        norm.is_finite()
    }
}

/// The sum of the loss over `paths`, and its derivatives.
pub(super) fn gradient(model: &Model, data: &Data, paths: &[u32], a: f32) -> Gradient {
    let part = (PART / data.vertices).max(1);
    let parts: Vec<Gradient> = paths
        .par_chunks(part)
        .map_init(Vec::new, |work, paths| {
            let empty = model.nets.iter().flat_map(|net| &net.tensors);
            let mut sums = Gradient {
                loss: 0.0,
                tensors: empty.map(|t| vec![0.0; t.len()]).collect(),
            };
            add_part(model, data, paths, a, work, &mut sums);
            sums
        })
        .collect();
    let mut parts = parts.into_iter();
    let mut sum = parts.next().unwrap_or_default();
    parts.for_each(|part| sum.add(&part));
    sum
}

/// Activations of each network, reused.
type Work = Vec<Vec<Vec<f32>>>;

fn add_part(
    model: &Model,
    data: &Data,
    paths: &[u32],
    a: f32,
    work: &mut Work,
    sums: &mut Gradient,
) {
    let k = data.vertices;
    let n = paths.len() * k;
    let decisions = || {
        let first = |&path: &u32| path as usize * k;
        paths.iter().map(first).flat_map(|first| first..first + k)
    };
    let mut u = Vec::with_capacity(2 * n);
    for i in decisions() {
        u.extend_from_slice(&data.u[2 * i..2 * i + 2]);
    }
    work.resize(model.nets.len(), Vec::new());
    let mut log_q = vec![0.0; n];
    for (stage, (net, acts)) in model.nets.iter().zip(work.iter_mut()).enumerate() {
        acts.resize(net.widths.len(), Vec::new());
        acts[0].clear();
        for (i, u) in decisions().zip(u.chunks_exact(2)) {
            acts[0].extend_from_slice(&data.inputs[FEATURES * i..][..FEATURES]);
            acts[0].extend_from_slice(&u[..stage]);
        }
        net.forward(n, acts);
        if let Some(out) = acts.last_mut() {
            model.learn(stage, out, &u, &mut log_q);
        }
    }
    // d/d ln q of w/m is −w (1 − a) q/m², the same for each decision of a path.
    let mut by_log = vec![0.0; n];
    let paths = paths.iter().zip(log_q.chunks_exact(k));
    for ((&path, log_q), by_log) in paths.zip(by_log.chunks_exact_mut(k)) {
        let w = data.weights[path as usize];
        let q = log_q.iter().sum::<f32>().min(80.0).exp();
        let m = a + (1.0 - a) * q;
        sums.loss += f64::from(w / m);
        by_log.fill(-w * (1.0 - a) * q / m / m);
    }
    let mut tensors = &mut sums.tensors[..];
    for (net, acts) in model.nets.iter().zip(work.iter_mut()) {
        let outputs = net.widths[net.widths.len() - 1];
        let mut slope = acts.pop().unwrap_or_default();
        for (slope, by_log) in slope.chunks_exact_mut(outputs).zip(&by_log) {
            slope.iter_mut().for_each(|s| *s *= by_log);
        }
        let (own, rest) = tensors.split_at_mut(net.tensors.len());
        net.backward(n, acts, &mut slope, own);
        tensors = rest;
    }
}

/// Moments of every tensor of every network.
struct Adam {
    powers: [f32; 2],
    moments: Vec<[Vec<f32>; 2]>,
}

impl Adam {
    fn new(model: &Model) -> Self {
        let tensors = model.nets.iter().flat_map(|net| &net.tensors);
        let zeros = |t: &Vec<f32>| [vec![0.0; t.len()], vec![0.0; t.len()]];
        Self {
            powers: [1.0; 2],
            moments: tensors.map(zeros).collect(),
        }
    }

    fn step(&mut self, model: &mut Model, gradient: &Gradient, rate: f32) {
        self.powers = [self.powers[0] * BETA[0], self.powers[1] * BETA[1]];
        let step = rate / (1.0 - self.powers[0]);
        let correction = 1.0 / (1.0 - self.powers[1]).sqrt();
        let tensors = model.nets.iter_mut().flat_map(|net| &mut net.tensors);
        for ((values, gradient), [first, second]) in
            tensors.zip(&gradient.tensors).zip(&mut self.moments)
        {
            let moments = first.iter_mut().zip(second);
            for ((w, &g), (m, v)) in values.iter_mut().zip(gradient).zip(moments) {
                *m = BETA[0] * *m + (1.0 - BETA[0]) * g;
                *v = BETA[1] * *v + (1.0 - BETA[1]) * g * g;
                *w -= step * *m / (v.sqrt() * correction + EPSILON);
            }
        }
    }
}
