//! What holds for any weights; what holds after training is in `tests/guide`.
#![allow(clippy::unwrap_used)]

use candle_core::{D, DType, Device, Result, Tensor, Var};
use pss_rng::{Purpose, Stream};
use serde_json::json;

use super::Kind;
use super::mlp::{FEATURES, Place};
use super::model::{Head, Model, Packed};
use super::options::MixtureNetOptions;
use super::train::{self, Data};
use crate::Context;
use crate::flow::kernel::SLOPE;

const KINDS: [Kind; 1] = [Kind::Mixture];

/// Sizes that are no multiple of any vector length among them.
const SIZES: [(usize, usize, usize); 3] = [(6, 32, 2), (1, 5, 1), (3, 13, 3)];

fn uniform(n: usize, stream: u32) -> Vec<f32> {
    let mut numbers = Stream::new(41, Purpose::Test).sequence(stream, 0);
    (0..n).map(|_| numbers.next_f32()).collect()
}

fn options((components, hidden, layers): (usize, usize, usize)) -> MixtureNetOptions {
    let given = json!({ "components": components, "hidden": hidden, "layers": layers });
    MixtureNetOptions::parse(Kind::Mixture, given.as_object().unwrap()).unwrap()
}

/// A model with weights that are larger than any start of training, so that every layer bends.
fn model(kind: Kind, options: &MixtureNetOptions) -> Model {
    let mut model = Model::random(Head::new(kind, options), options, 5);
    for (i, net) in model.nets.iter_mut().enumerate() {
        let last = net.tensors.len() - 2;
        let mut noise = uniform(1 << 16, 60 + i as u32).into_iter();
        for w in net.tensors[last..].iter_mut().flatten() {
            *w += 0.6 * (noise.next().unwrap() - 0.5);
        }
    }
    model
}

/// `n` paths of `vertices` decisions at random places.
fn data(n: usize, vertices: usize) -> Data {
    let inputs = uniform(n * vertices * FEATURES, 1);
    Data {
        vertices,
        inputs: inputs.iter().map(|x| 2.0 * x - 1.0).collect(),
        u: uniform(n * vertices * 2, 2),
        weights: uniform(n, 3).iter().map(|w| 4.0 * w * w).collect(),
    }
}

/// Everything once more as candle's graph in f64: ln q of each decision.
mod oracle {
    use super::*;

    fn network(tensors: &[Var], inputs: Tensor) -> Result<Tensor> {
        let mut y = inputs;
        for (layer, pair) in tensors.chunks(2).enumerate() {
            y = y.matmul(&pair[0])?.broadcast_add(&pair[1])?;
            if 2 * layer + 2 < tensors.len() {
                y = (y.relu()? - (y.neg()?.relu()? * f64::from(SLOPE))?)?;
            }
        }
        Ok(y)
    }

    fn mixture(out: &Tensor, u: &Tensor) -> Result<Tensor> {
        let n = out.dim(1)? / 5;
        let part = |i: usize| out.narrow(1, i * n, n);
        let logits = part(0)?;
        let most = logits.max_keepdim(D::Minus1)?.detach();
        let shifted = logits.broadcast_sub(&most)?;
        let sum = shifted.exp()?.sum_keepdim(D::Minus1)?;
        let mut log = shifted.broadcast_sub(&sum.log()?)?;
        for axis in 0..2 {
            let mu = ((part(1 + 2 * axis)?.tanh()? * 0.5)? + 0.5)?;
            let sigma = (((part(2 + 2 * axis)? / 3.0)?.tanh()? * 3.0)?.exp()? * 0.1)?;
            let wide = (&sigma * 2f64.sqrt())?;
            let z = (u.narrow(1, axis, 1)?.broadcast_sub(&mu)? / &wide)?;
            let mass = (((mu.neg()? + 1.0)? / &wide)?.erf()? + (&mu / &wide)?.erf()?)?;
            let peak = (mass * &wide)?.log()?.neg()?;
            log = ((log - z.sqr()?)? + peak)?;
            log = (log + (2.0 / std::f64::consts::PI.sqrt()).ln())?;
        }
        let most = log.max_keepdim(D::Minus1)?.detach();
        let sum = log.broadcast_sub(&most)?.exp()?.sum_keepdim(D::Minus1)?;
        (sum.log()? + most)?.squeeze(1)
    }

    fn tensor(values: &[f32], shape: (usize, usize)) -> Result<Tensor> {
        let values: Vec<f64> = values.iter().map(|&x| f64::from(x)).collect();
        Tensor::from_vec(values, shape, &Device::Cpu)
    }

    pub(super) fn vars(model: &Model) -> Result<Vec<Vec<Var>>> {
        let net = |net: &super::super::mlp::Mlp| {
            let widths = net.widths.windows(2);
            let mut vars = Vec::new();
            for (w, pair) in widths.zip(net.tensors.chunks(2)) {
                vars.push(Var::from_tensor(&tensor(&pair[0], (w[0], w[1]))?)?);
                vars.push(Var::from_tensor(&tensor(&pair[1], (1, w[1]))?)?);
            }
            Ok(vars)
        };
        model.nets.iter().map(net).collect()
    }

    pub(super) fn log_density(
        model: &Model,
        vars: &[Vec<Var>],
        inputs: &[f32],
        u: &[f32],
    ) -> Result<Tensor> {
        let n = u.len() / 2;
        let (inputs, u) = (tensor(inputs, (n, FEATURES))?, tensor(u, (n, 2))?);
        let mut sum = Tensor::zeros(n, DType::F64, &Device::Cpu)?;
        for (stage, tensors) in vars.iter().enumerate() {
            let seen = Tensor::cat(&[&inputs, &u.narrow(1, 0, stage)?], 1)?;
            let out = network(tensors, if stage == 0 { inputs.clone() } else { seen })?;
            let log = match model.head {
                Head::Mixture(_) => mixture(&out, &u)?,
            };
            sum = (sum + log)?;
        }
        Ok(sum)
    }

    /// The loss's sum over all paths of `data`.
    pub(super) fn loss(model: &Model, vars: &[Vec<Var>], data: &Data, a: f64) -> Result<Tensor> {
        let n = data.weights.len();
        let log = log_density(model, vars, &data.inputs, &data.u)?;
        let q = log.reshape((n, data.vertices))?.sum(1)?.exp()?;
        let m = ((q * (1.0 - a))? + a)?;
        (tensor(&data.weights, (n, 1))?.squeeze(1)? / m)?.sum_all()
    }
}

/// Claim: loss and every derivative agree with candle's in f64 to 1e-4 of the tensor's largest, for one decision a path and
/// for three.
#[test]
fn gradients_agree_with_candle() {
    for kind in KINDS {
        for size in SIZES {
            for vertices in [1, 3] {
                let options = options(size);
                let (model, data) = (model(kind, &options), data(150, vertices));
                let paths: Vec<u32> = (0..150).collect();
                let ours = train::gradient(&model, &data, &paths, 0.1);
                let vars = oracle::vars(&model).unwrap();
                let loss = oracle::loss(&model, &vars, &data, 0.1).unwrap();
                let value = loss.to_scalar::<f64>().unwrap();
                assert!(
                    (ours.loss / value - 1.0).abs() < 1e-5,
                    "{} {value}",
                    ours.loss
                );
                let gradients = loss.backward().unwrap();
                for (i, (var, ours)) in vars.iter().flatten().zip(&ours.tensors).enumerate() {
                    let theirs = gradients.get(var).unwrap().flatten_all().unwrap();
                    let theirs = theirs.to_vec1::<f64>().unwrap();
                    let largest = theirs.iter().fold(0.0f64, |m, g| m.max(g.abs()));
                    assert!(largest > 0.0);
                    for (a, b) in ours.iter().zip(&theirs) {
                        assert!(
                            (f64::from(*a) - b).abs() < 1e-4 * largest,
                            "{kind:?} {size:?}, tensor {i}: {a}, not {b} (largest {largest})"
                        );
                    }
                }
            }
        }
    }
}

fn contexts(n: usize) -> Vec<Context> {
    let numbers = uniform(9 * n, 8);
    let at = |x: &[f32]| [2.0 * x[0] - 1.0, 2.0 * x[1] - 1.0, 2.0 * x[2] - 1.0];
    let context = |x: &[f32]| Context {
        position: at(x),
        normal: at(&x[3..]),
        outgoing: at(&x[6..]),
        bounce: 1,
        ..Context::default()
    };
    numbers.chunks_exact(9).map(context).collect()
}

const PLACE: Place = Place {
    origin: [-1.0; 3],
    scale: [0.5; 3],
    bounces: 2,
};

/// Claim: the density of the packed network is candle's to 2e-5 + 2e-6 z², in any batch, down to a density of 1e-30.
#[test]
fn evaluation_agrees_with_candle_in_any_batch() {
    for kind in KINDS {
        for size in SIZES {
            let options = options(size);
            let model = model(kind, &options);
            let packed = Packed::new(&model, PLACE);
            let n = 203;
            let (contexts, u) = (contexts(n), uniform(2 * n, 9));
            let inputs: Vec<f32> = contexts.iter().flat_map(|c| PLACE.features(c)).collect();
            let vars = oracle::vars(&model).unwrap();
            let log = oracle::log_density(&model, &vars, &inputs, &u).unwrap();
            let mut q = vec![0.0; n];
            packed.density(&contexts, &u, &mut q);
            for (q, log) in q.iter().zip(log.to_vec1::<f64>().unwrap()) {
                let error = (f64::from(*q).ln() - log).abs();
                assert!(
                    error < 2e-5 + 2e-6 * log.abs() || log < -69.0,
                    "{kind:?} {size:?}: ln q = {}, not {log}",
                    q.ln()
                );
            }
            for first in [1, 7, 100] {
                let mut again = vec![0.0; n - first];
                packed.density(&contexts[first..], &u[2 * first..], &mut again);
                assert_eq!(again, q[first..], "{kind:?} {size:?}");
            }
        }
    }
}

/// The share of samples below x is the integral of the density: a distribution function by quadrature, for a component that is
/// narrow and one that is cut off, and the ends of the interval.
#[test]
fn samples_invert_the_distribution_function() {
    for kind in KINDS {
        let options = options((4, 8, 1));
        let packed = Packed::new(&model(kind, &options), PLACE);
        let context = contexts(1)[0];
        let n = 1000;
        // At a fixed first number the second one's map is monotone; its slope is 1 ÷ the conditional density.
        for first in [0.0, 0.3, 0.77, 1.0 - f32::EPSILON / 2.0] {
            let mut u: Vec<f32> = (0..n).flat_map(|i| [first, i as f32 / n as f32]).collect();
            let mut q = vec![0.0; n];
            packed.sample(&vec![context; n], &mut u, &mut q);
            assert!(u.iter().all(|x| (0.0..1.0).contains(x)), "{u:?}");
            assert!(q.iter().all(|q| q.is_finite() && *q > 0.0), "{q:?}");
            let seconds: Vec<f32> = u.chunks_exact(2).map(|u| u[1]).collect();
            assert!(seconds.is_sorted(), "{kind:?}: {seconds:?}");
        }
    }
}
