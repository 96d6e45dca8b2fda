//! What holds for any weights; what holds after training is in `tests/guide`.
#![allow(clippy::unwrap_used)]

use candle_core::{D, DType, Device, Result, Tensor, Var};
use pss_rng::{Purpose, Stream};
use pulp::Scalar;
use serde_json::json;

use super::Kind;
use super::mlp::{FEATURES, Place};
use super::model::{Head, Model, Packed};
use super::options::Options;
use super::spline::Spline;
use super::train::{self, Data};
use crate::Context;
use crate::kernel::ROWS;
use crate::kernel::lanes::Lanes;
use crate::kernel::layer::SLOPE;

const KINDS: [Kind; 2] = [Kind::Mixture, Kind::Spline];

/// Sizes that are no multiple of any vector length among them.
const SIZES: [(usize, usize, usize); 3] = [(6, 32, 2), (1, 5, 1), (3, 13, 3)];

fn uniform(n: usize, stream: u32) -> Vec<f32> {
    let mut numbers = Stream::new(41, Purpose::Test).sequence(stream, 0);
    (0..n).map(|_| numbers.next_f32()).collect()
}

fn lanes(values: &[f32]) -> Lanes {
    Lanes(values.try_into().unwrap())
}

fn options(kind: Kind, (parts, hidden, layers): (usize, usize, usize)) -> Options {
    let mut given = json!({ "hidden": hidden, "layers": layers });
    match kind {
        Kind::Mixture => given["components"] = json!(parts),
        Kind::Spline => given["bins"] = json!(parts + 1),
    }
    Options::parse(kind, given.as_object().unwrap()).unwrap()
}

/// A model with weights that are larger than any start of training, so that every layer bends.
fn model(options: &Options) -> Model {
    let mut model = Model::random(options, 5);
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

    /// Softmax with the least share added.
    fn sizes(logits: &Tensor) -> Result<Tensor> {
        let n = logits.dim(1)? as f64;
        let shares = logits.exp()?;
        let shares = shares.broadcast_div(&shares.sum_keepdim(D::Minus1)?)?;
        (shares * (1.0 - 1e-3 * n))? + 1e-3
    }

    /// The formula of `spline`, the bin picked by masks.
    fn spline(out: &Tensor, x: &Tensor) -> Result<Tensor> {
        let bins = (out.dim(1)? - 1) / 3;
        let part = |i: usize| out.narrow(1, i * bins, bins);
        let (w, h) = (sizes(&part(0)?)?, sizes(&part(1)?)?);
        let c = 1000f64.ln();
        let slope = ((out.narrow(1, 2 * bins, bins + 1)? / c)?.tanh()? * c)?.exp()?;
        let (mut at, mut before) = (Vec::new(), Vec::new());
        for (w, x) in w.to_vec2::<f64>()?.iter().zip(x.to_vec2::<f64>()?) {
            let mut begin = 0.0;
            let begins = w.iter().map(|w| {
                begin += w;
                begin - w
            });
            let begins: Vec<f64> = begins.collect();
            let bin = begins.iter().rposition(|b| x[0] >= *b).unwrap_or(0);
            at.extend((0..bins).map(|j| f64::from(u8::from(j == bin))));
            before.extend((0..bins).map(|j| f64::from(u8::from(j < bin))));
        }
        let mask = |m: Vec<f64>| Tensor::from_vec(m, (out.dim(0)?, bins), &Device::Cpu);
        let (at, before) = (mask(at)?, mask(before)?);
        let pick = |values: &Tensor, by: &Tensor| (values * by)?.sum_keepdim(D::Minus1);
        let (width, s) = (pick(&w, &at)?, (pick(&h, &at)? / pick(&w, &at)?)?);
        let xi = ((x - pick(&w, &before)?)? / width)?;
        let rest = (xi.neg()? + 1.0)?;
        let d = |from: usize| pick(&slope.narrow(1, from, bins)?, &at);
        let (d0, d1, e) = (d(0)?, d(1)?, (&xi * &rest)?);
        let n = (((&d1 * xi.sqr()?)? + ((&s * &e)? * 2.0)?)? + (&d0 * rest.sqr()?)?)?;
        let t = ((d0 + d1)? - (&s * 2.0)?)?;
        let m = (&s + (t * e)?)?;
        let log = ((s.log()? * 2.0)? + n.log()?)?;
        (log - (m.log()? * 2.0)?)?.squeeze(1)
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
                Head::Spline(_) => spline(&out, &u.narrow(1, stage, 1)?)?,
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
                let options = options(kind, size);
                let (model, data) = (model(&options), data(150, vertices));
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
            let options = options(kind, size);
            let model = model(&options);
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
        let options = options(kind, (4, 8, 1));
        let packed = Packed::new(&model(&options), PLACE);
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

/// F and ln q of one number, in f64 and straight from the paper's eqs. 4 and 5: the bin's x_k, y_k, δ_k by running sums.
fn exact_spline(out: &[f64], x: f64) -> (f64, f64) {
    let n = (out.len() - 1) / 3;
    let sizes = |logits: &[f64]| -> Vec<f64> {
        let sum: f64 = logits.iter().map(|l| l.exp()).sum();
        let size = |l: &f64| 1e-3 + (1.0 - 1e-3 * n as f64) * l.exp() / sum;
        logits.iter().map(size).collect()
    };
    let (w, h) = (sizes(&out[..n]), sizes(&out[n..2 * n]));
    let c = 1000f64.ln();
    let slope = |k: usize| (c * (out[2 * n + k] / c).tanh()).exp();
    let (mut k, mut begin, mut below) = (0, 0.0, 0.0);
    while k + 1 < n && begin + w[k] <= x {
        begin += w[k];
        below += h[k];
        k += 1;
    }
    let (s, xi) = (h[k] / w[k], (x - begin) / w[k]);
    let (d0, d1) = (slope(k), slope(k + 1));
    let top = d1 * xi * xi + 2.0 * s * xi * (1.0 - xi) + d0 * (1.0 - xi).powi(2);
    let bottom = s + (d1 + d0 - 2.0 * s) * xi * (1.0 - xi);
    let share = (s * xi * xi + d0 * xi * (1.0 - xi)) / bottom;
    (below + h[k] * share, (s * s * top / (bottom * bottom)).ln())
}

/// Claim: ln q of a spline and its derivative by every output agree with central differences in f64 to 1e-4 of 1 + |·|,
/// for outputs so large that bins are as narrow and slopes as steep as they may be, and at both ends of the interval.
/// Where bins begin is a sum in f32: x may be taken for one 3e-7 away.
#[test]
fn a_splines_derivatives_are_central_differences() {
    for (bins, gain) in [(2, 1.0), (5, 3.0), (8, 6.0), (16, 12.0)] {
        let spline = Spline { bins };
        let n = spline.outputs();
        let mut x = uniform(ROWS, 20);
        (x[0], x[1], x[2]) = (0.0, 1.0 - f32::EPSILON / 2.0, f32::MIN_POSITIVE);
        let number = |u: &f32| gain * (2.0 * u - 1.0);
        let out: Vec<f32> = uniform(n * ROWS, 21).iter().map(number).collect();
        let out: Vec<Lanes> = out.chunks_exact(ROWS).map(lanes).collect();
        let mut slope = vec![Lanes::default(); n];
        let mut scratch = vec![Lanes::default(); spline.scratch()];
        let log = spline.learn(Scalar, &out, &lanes(&x), &mut slope, &mut scratch);
        for (r, &x) in x.iter().enumerate() {
            let mut own: Vec<f64> = (0..n).map(|o| f64::from(out[o][r])).collect();
            let near = [-3e-7, 0.0, 3e-7].map(|by| f64::from(x) + by);
            let close = |a: f32, b: [f64; 3]| {
                let low = b.into_iter().fold(f64::INFINITY, f64::min);
                let high = b.into_iter().fold(f64::NEG_INFINITY, f64::max);
                let slack = 1e-4 * (1.0 + b[1].abs());
                (low - slack..=high + slack).contains(&f64::from(a))
            };
            let want = near.map(|x| exact_spline(&own, x).1);
            assert!(
                close(log[r], want),
                "{bins} bins at {x}: {} {want:?}",
                log[r]
            );
            for o in 0..n {
                let value = own[o];
                let numeric = near.map(|x| {
                    let mut moved = |by: f64| {
                        own[o] = value + by;
                        exact_spline(&own, x).1
                    };
                    (moved(1e-6) - moved(-1e-6)) / 2e-6
                });
                own[o] = value;
                let ours = slope[o][r];
                assert!(
                    close(ours, numeric),
                    "{bins} bins at {x}, output {o}: {ours}, not {numeric:?}"
                );
            }
        }
    }
}

/// Claim: for steep and flat splines alike the distribution function of a sample is the number that it was made of, to 2e-6
/// and what a step of 3e-7 in x changes (f32's in the sums over bins); its slope is the density reported.
#[test]
fn a_splines_samples_invert_its_distribution_function() {
    for (bins, gain) in [(2, 1.0), (8, 3.0), (16, 12.0)] {
        let spline = Spline { bins };
        let n = spline.outputs();
        let number = |u: &f32| gain * (2.0 * u - 1.0);
        let one: Vec<f32> = uniform(n, 22).iter().map(number).collect();
        let out: Vec<Lanes> = one.iter().map(|&o| Lanes::all(o)).collect();
        let own: Vec<f64> = one.iter().map(|&o| f64::from(o)).collect();
        let mut scratch = vec![Lanes::default(); spline.scratch()];
        let even: Vec<f32> = (0..400).map(|i| i as f32 / 400.0).collect();
        let before = [&even[..], &[1.0 - f32::EPSILON / 2.0; ROWS]].concat();
        let (mut all, mut q) = (before.clone(), vec![0.0; before.len()]);
        for (u, q) in all.chunks_exact_mut(ROWS).zip(q.chunks_exact_mut(ROWS)) {
            let mut x = lanes(u);
            let density = spline.sample(Scalar, &out, &mut x, &mut scratch);
            let again = spline.density(Scalar, &out, &x, &mut scratch);
            u.copy_from_slice(&x.0);
            q.copy_from_slice(&density.0);
            for (a, b) in q.iter().zip(&again.0) {
                assert!((a / b - 1.0).abs() < 1e-4, "{a} {b}");
            }
        }
        assert!(all.is_sorted() && all.iter().all(|x| (0.0..1.0).contains(x)));
        for ((&x, &v), &q) in all.iter().zip(&before).zip(&q) {
            let at = |by: f64| exact_spline(&own, f64::from(x) + by).0;
            let want = f64::from(v) + 2f64.powi(-25);
            let slack = 2e-6 + at(3e-7) - at(-3e-7);
            assert!(
                (at(0.0) - want).abs() < slack,
                "{bins} bins: F({x}) = {}, not {want}",
                at(0.0)
            );
            let near = [-3e-7, 0.0, 3e-7].map(|by| (at(by + 1e-8) - at(by - 1e-8)) / 2e-8);
            let low = near.into_iter().fold(f64::INFINITY, f64::min);
            let high = near.into_iter().fold(0.0, f64::max);
            assert!(
                (0.999 * low..=1.001 * high).contains(&f64::from(q)),
                "{bins} bins at {x}: {q} {near:?}"
            );
        }
    }
}
