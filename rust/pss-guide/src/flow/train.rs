//! Maximum likelihood by Adam (Kingma and Ba 2015, arXiv:1412.6980) on candle's graph.
//!
//! Weights live in plain vectors; each step builds the graph from fresh tensors of them, asks candle for
//! the gradients and updates the vectors. A batch is cut into parts of fixed size, each with a graph of its own, that any
//! number of rayon's threads may compute; their sums are added in order, so that the same seed gives the same weights for
//! any number of threads. Parts are small enough that candle's own thread pool stays out: it takes elementwise work on more
//! than 65,536 numbers, spins, and collapses when other work wants the cores.
//!
//! With the cargo feature `cuda` the graph is built on the first CUDA device that there is, a whole batch at once and of
//! candle's own operations (`plain`). That was compiled and run nowhere so far but on the processor, where the tests compare
//! the two graphs.

use candle_core::{Device, Result as TensorResult, Tensor, Var};
use pss_rng::{Purpose, Stream};
use rayon::prelude::*;

use super::Domain;
use super::ops::{Affine, Condition, Linear, NegLogLikelihood, with};
use super::options::RealNvpOptions;
use super::plain;
use super::weights::Weights;
use crate::{EpochLoss, GuideError};

/// Most activations of a layer in one part of a batch.
const ACTIVATIONS: usize = 32_768;

/// Most rows of one part: half of the usual batch, for two threads. Each part costs a gradient of all weights.
const PART: usize = 128;

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
        device: device(),
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
    device: Device,
}

/// Where training computes.
fn device() -> Device {
    #[cfg(feature = "cuda")]
    if let Ok(device) = Device::new_cuda(0) {
        return device;
    }
    Device::Cpu
}

impl Trainer<'_> {
    /// One step on the given rows; returns the loss before it. A loss that is not finite changes nothing.
    fn step(&mut self, rows: &[u32]) -> TensorResult<f64> {
        let (options, weights) = (self.options, &self.weights);
        let (loss, gradients) = if self.device.is_cpu() {
            gradients(options, weights, self.x, rows)?
        } else {
            plain_gradients(options, weights, self.x, rows, &self.device)?
        };
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
    let vars = variables(weights, &Device::Cpu)?;
    let most = ACTIVATIONS / shape.hidden.max(shape.dims);
    let parts: Vec<_> = rows
        .par_chunks(most.clamp(1, PART))
        .map(|part| {
            let share = part.len() as f64 / rows.len() as f64;
            let loss = loss(options, weights, &vars, x, part)?;
            let value = f64::from(loss.to_scalar::<f32>()?);
            let gradients = match value.is_finite() {
                true => Some(loss.backward()?),
                false => None,
            };
            Ok((share, value, gradients))
        })
        .collect::<TensorResult<_>>()?;
    let value = parts.iter().map(|(share, value, _)| share * value).sum();
    if !f64::is_finite(value) {
        return Ok((value, Vec::new()));
    }
    let mut sums: Vec<Vec<f32>> = weights.tensors.iter().map(|t| vec![0.0; t.len()]).collect();
    for (share, _, gradients) in &parts {
        let share = *share as f32;
        for (var, sum) in vars.iter().zip(&mut sums) {
            let Some(gradient) = gradients.as_ref().and_then(|all| all.get(var)) else {
                continue;
            };
            with([gradient], |[gradient]| {
                let pairs = sum.iter_mut().zip(gradient);
                pairs.for_each(|(sum, g)| *sum += share * g);
            })?;
        }
    }
    Ok((value, sums))
}

/// All parameters, as nodes of a graph.
fn variables(weights: &Weights, device: &Device) -> TensorResult<Vec<Var>> {
    let shapes = weights.shape.tensors().into_iter();
    let var = |((_, size), values): ((String, Vec<usize>), &Vec<f32>)| {
        Var::from_slice(values, size, device)
    };
    shapes.zip(&weights.tensors).map(var).collect()
}

/// [`gradients`] by candle's own operations on any device.
pub(super) fn plain_gradients(
    options: &RealNvpOptions,
    weights: &Weights,
    x: &[f32],
    rows: &[u32],
    device: &Device,
) -> TensorResult<(f64, Vec<Vec<f32>>)> {
    let shape = weights.shape;
    let vars = variables(weights, device)?;
    let row = |&row: &u32| &x[row as usize * shape.row()..][..shape.row()];
    let batch: Vec<f32> = rows.iter().flat_map(row).copied().collect();
    let batch = Tensor::from_vec(batch, (rows.len(), shape.row()), device)?;
    let tensors: Vec<Tensor> = vars.iter().map(|var| var.as_tensor().clone()).collect();
    let loss = plain::loss(options, shape, &tensors, &batch)?;
    let value = f64::from(loss.to_scalar::<f32>()?);
    if !value.is_finite() {
        return Ok((value, Vec::new()));
    }
    let gradients = loss.backward()?;
    let gradient = |var: &Var| match gradients.get(var) {
        Some(gradient) => gradient.flatten_all()?.to_vec1::<f32>(),
        None => Ok(vec![0.0; var.elem_count()]),
    };
    let all = vars.iter().map(gradient).collect::<TensorResult<_>>()?;
    Ok((value, all))
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
