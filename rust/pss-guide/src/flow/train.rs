//! Maximum likelihood by Adam (Kingma and Ba 2015, arXiv:1412.6980) on candle's graph.
//!
//! Weights live in plain vectors; each step builds the graph from fresh tensors of them, asks candle for
//! the gradients and updates the vectors. A large batch goes through the graph in parts, because candle
//! hands elementwise work on more than 65,536 numbers to a spinning thread pool, which collapses when
//! other work wants the cores. So training stays on the caller's thread, and the same seed gives the same
//! weights for any number of threads.

use candle_core::{Device, Result as TensorResult, Tensor, Var};
use pss_rng::{Purpose, Stream};

use super::Domain;
use super::ops::{Affine, Condition, Linear, NegLogLikelihood};
use super::options::RealNvpOptions;
use super::weights::Weights;
use crate::{EpochLoss, GuideError};

/// Most activations of a layer in one part of a batch.
const PART: usize = 32_768;

/// Weights after the last epoch, and the loss of each.
pub(super) struct Trained {
    pub(super) weights: Weights,
    pub(super) history: Vec<EpochLoss>,
}

/// Trains on the rows of `x` (n, dims + known); `progress` gets the share done and returns false to cancel.
pub(super) fn train(
    domain: Domain,
    options: &RealNvpOptions,
    weights: Weights,
    x: &[f32],
    seed: u64,
    progress: &mut dyn FnMut(f32) -> bool,
) -> Result<Trained, GuideError> {
    let guide = domain.name();
    let tensor = |message: String| GuideError::Tensor {
        guide: guide.to_owned(),
        message,
    };
    let rows = x.len() / weights.shape.row();
    let batches = rows.div_ceil(options.batch);
    let mut order: Vec<u32> = (0..rows as u32).collect();
    let mut trainer = Trainer {
        adam: Adam::new(&weights, options.learning_rate),
        options,
        weights,
        x,
    };
    let mut history = Vec::with_capacity(options.epochs);
    for epoch in 0..options.epochs {
        shuffle(&mut order, seed, epoch);
        let mut sum = 0.0;
        for (batch, rows) in order.chunks(options.batch).enumerate() {
            if !progress((epoch * batches + batch) as f32 / (options.epochs * batches) as f32) {
                return Err(GuideError::Cancelled);
            }
            let loss = trainer.step(rows).map_err(|e| tensor(e.to_string()))?;
            if !loss.is_finite() {
                return Err(GuideError::Diverged {
                    guide: guide.to_owned(),
                    epoch: epoch + 1,
                    batch: batch + 1,
                    loss,
                });
            }
            sum += loss * rows.len() as f64;
        }
        history.push(EpochLoss {
            epoch: epoch + 1,
            loss: sum / rows as f64,
        });
    }
    progress(1.0);
    if !trainer.weights.is_finite() {
        return Err(GuideError::Diverged {
            guide: guide.to_owned(),
            epoch: options.epochs,
            batch: batches,
            loss: f64::NAN,
        });
    }
    Ok(Trained {
        weights: trainer.weights,
        history,
    })
}

/// Fisher–Yates from the identity, so that an epoch's order depends on seed and epoch alone.
fn shuffle(order: &mut [u32], seed: u64, epoch: usize) {
    let mut numbers = Stream::new(seed, Purpose::Training).sequence(1, epoch as u32);
    order.iter_mut().zip(0..).for_each(|(o, i)| *o = i);
    for i in (1..order.len()).rev() {
        order.swap(i, numbers.below(i as u32 + 1) as usize);
    }
}

struct Trainer<'a> {
    options: &'a RealNvpOptions,
    weights: Weights,
    adam: Adam,
    x: &'a [f32],
}

impl Trainer<'_> {
    /// One step on the given rows; returns the loss before it. A loss that is not finite changes nothing.
    fn step(&mut self, rows: &[u32]) -> TensorResult<f64> {
        let (loss, gradients) = gradients(self.options, &self.weights, self.x, rows)?;
        if loss.is_finite() {
            self.adam.begin();
            for (index, gradient) in gradients.iter().enumerate() {
                self.adam
                    .update(index, &mut self.weights.tensors[index], gradient);
            }
        }
        Ok(loss)
    }
}

/// Mean −ln q of rows of `x`, and its derivative by every tensor (none if the loss is not finite).
pub(super) fn gradients(
    options: &RealNvpOptions,
    weights: &Weights,
    x: &[f32],
    rows: &[u32],
) -> TensorResult<(f64, Vec<Vec<f32>>)> {
    let shape = weights.shape;
    let vars: Vec<Var> = shape
        .tensors()
        .into_iter()
        .zip(&weights.tensors)
        .map(|((_, size), values)| Var::from_slice(values, size, &Device::Cpu))
        .collect::<TensorResult<_>>()?;
    let mut sums: Vec<Vec<f32>> = weights.tensors.iter().map(|t| vec![0.0; t.len()]).collect();
    let mut value = 0.0;
    for part in rows.chunks((PART / shape.hidden.max(shape.dims)).max(1)) {
        let share = part.len() as f64 / rows.len() as f64;
        let loss = loss(options, weights, &vars, x, part)?;
        value += share * f64::from(loss.to_scalar::<f32>()?);
        if !value.is_finite() {
            return Ok((value, Vec::new()));
        }
        let gradients = loss.backward()?;
        for (var, sum) in vars.iter().zip(&mut sums) {
            if let Some(gradient) = gradients.get(var) {
                let gradient = gradient.flatten_all()?.to_vec1::<f32>()?;
                sum.iter_mut()
                    .zip(&gradient)
                    .for_each(|(s, g)| *s += share as f32 * g);
            }
        }
    }
    Ok((value, sums))
}

/// Mean −ln q of rows of `x`, as a node of the graph.
fn loss(
    options: &RealNvpOptions,
    weights: &Weights,
    vars: &[Var],
    x: &[f32],
    rows: &[u32],
) -> TensorResult<Tensor> {
    let shape = weights.shape;
    let d = shape.row();
    let mut state = Vec::with_capacity(rows.len() * (d + 1));
    for &row in rows {
        state.extend_from_slice(&x[row as usize * d..][..d]);
        state.push(0.0);
    }
    let mut state = Tensor::from_vec(state, (rows.len(), d + 1), &Device::Cpu)?;
    for coupling in (0..shape.couplings).rev() {
        let mut y = state.apply_op1(Condition {
            coupling,
            dims: shape.dims,
        })?;
        for layer in 0..shape.linear() {
            let at = (coupling * shape.linear() + layer) * 2;
            let leaky = layer < shape.layers;
            y = y.apply_op3(
                vars[at].as_tensor(),
                vars[at + 1].as_tensor(),
                Linear { leaky },
            )?;
        }
        state = state.apply_op2(
            &y,
            Affine {
                coupling,
                s_max: options.s_max as f32,
            },
        )?;
    }
    state.apply_op1(NegLogLikelihood {
        prior: options.prior,
        dims: shape.dims,
    })
}

/// Adam with β = (0.9, 0.999), ε = 1e-8 and bias correction.
struct Adam {
    rate: f64,
    /// β₁^t and β₂^t.
    powers: [f64; 2],
    /// First and second moments per tensor.
    moments: Vec<[Vec<f32>; 2]>,
}

const BETA: [f64; 2] = [0.9, 0.999];
const EPSILON: f32 = 1e-8;

impl Adam {
    fn new(weights: &Weights, rate: f64) -> Self {
        let moments = weights
            .tensors
            .iter()
            .map(|t| [vec![0.0; t.len()], vec![0.0; t.len()]])
            .collect();
        Self {
            rate,
            powers: [1.0; 2],
            moments,
        }
    }

    fn begin(&mut self) {
        self.powers = [self.powers[0] * BETA[0], self.powers[1] * BETA[1]];
    }

    fn update(&mut self, tensor: usize, values: &mut [f32], gradient: &[f32]) {
        let step = (self.rate / (1.0 - self.powers[0])) as f32;
        let correction = (1.0 / (1.0 - self.powers[1]).sqrt()) as f32;
        let [b1, b2] = BETA.map(|b| b as f32);
        let [first, second] = &mut self.moments[tensor];
        for (((w, &g), m), v) in values.iter_mut().zip(gradient).zip(first).zip(second) {
            *m = b1 * *m + (1.0 - b1) * g;
            *v = b2 * *v + (1.0 - b2) * g * g;
            *w -= step * *m / (v.sqrt() * correction + EPSILON);
        }
    }
}
