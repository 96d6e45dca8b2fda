//! Evaluation of a trained flow: own code on packed weights, because the graph of a tensor library costs
//! more than the arithmetic of 40-unit layers.
//!
//! A block of 2·lanes rows goes through all couplings before the next block starts, so that activations
//! stay in the first-level cache. A linear layer keeps 5 outputs × 2 vectors in registers. Rows never
//! mix, and every row sees the same operations in the same order: results do not depend on the batch.
//! Masked inputs (always 0) and masked outputs (never used) are left out.

use pulp::{Simd, WithSimd};

use super::weights::{Weights, kept};

/// Slope of LeakyReLU below zero.
pub(crate) const SLOPE: f32 = 0.01;

/// Outputs of a linear layer that are accumulated together; a multiple of it divides 40.
pub(crate) const TILE: usize = 5;

/// A linear layer, outputs padded with zeros to whole tiles.
#[derive(Clone, Debug)]
pub(crate) struct Linear {
    inputs: usize,
    /// `[tile][input][output of the tile]`
    weights: Vec<[f32; TILE]>,
    /// `[tile][output of the tile]`
    bias: Vec<[f32; TILE]>,
}

/// y_a = x_a, y_b = x_b ⊙ exp(s(x_a)) + t(x_a).
#[derive(Clone, Debug)]
struct Coupling {
    /// Columns that the networks look at: those kept, then what is known.
    seen: Vec<usize>,
    changed: Vec<usize>,
    /// Networks of s and t.
    nets: [Vec<Linear>; 2],
}

/// Packed weights of a flow, and the two directions of evaluation.
#[derive(Clone, Debug)]
pub(crate) struct Kernel {
    dims: usize,
    known: usize,
    /// Floats per row of the block that the widest layer writes.
    width: usize,
    s_max: f32,
    couplings: Vec<Coupling>,
}

/// Which way through the flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    /// z → x, sampling.
    Generate,
    /// x → z, density.
    Normalise,
}

impl Kernel {
    pub(crate) fn new(weights: &Weights, s_max: f64) -> Self {
        let shape = weights.shape;
        let couplings = (0..shape.couplings)
            .map(|c| {
                let (mut seen, change): (Vec<_>, Vec<_>) =
                    (0..shape.dims).partition(|&i| kept(c, i));
                seen.extend(shape.dims..shape.row());
                let net = |which: usize| {
                    (0..shape.linear())
                        .map(|layer| {
                            let (inputs, outputs) = shape.widths(layer);
                            let all = |n: usize| (0..n).collect::<Vec<_>>();
                            let rows = if layer == 0 {
                                seen.clone()
                            } else {
                                all(inputs)
                            };
                            let columns = if layer == shape.layers {
                                change.clone()
                            } else {
                                all(outputs)
                            };
                            let (weight, bias) = weights.linear(c, layer);
                            let weight = &weight[which * inputs * outputs..][..inputs * outputs];
                            Linear::pack(
                                weight,
                                &bias[which * outputs..][..outputs],
                                &rows,
                                &columns,
                            )
                        })
                        .collect()
                };
                Coupling {
                    nets: [net(0), net(1)],
                    seen,
                    changed: change,
                }
            })
            .collect();
        let width = shape.hidden.max(shape.row());
        Self {
            dims: shape.dims,
            known: shape.known,
            width: width.next_multiple_of(TILE),
            s_max: s_max as f32,
            couplings,
        }
    }

    /// Maps the rows of `x` (n, dims) in place, given those of `known` (n, known), and writes Σ s per row: ln |∂x/∂z|,
    /// for both directions.
    pub(crate) fn run(
        &self,
        direction: Direction,
        x: &mut [f32],
        known: &[f32],
        log_det: &mut [f32],
    ) {
        let pass = Pass {
            kernel: self,
            direction,
            x,
            known,
            log_det,
        };
        #[cfg(target_arch = "x86_64")]
        if let Some(simd) = pulp::x86::V3::try_new() {
            return Simd::vectorize(simd, pass);
        }
        pulp::Arch::new().dispatch(pass);
    }
}

impl Linear {
    pub(crate) fn pack(weight: &[f32], bias: &[f32], rows: &[usize], columns: &[usize]) -> Self {
        let outputs = bias.len();
        let tile = |f: &dyn Fn(usize) -> f32, columns: &[usize]| {
            let mut tile = [0.0; TILE];
            for (t, &c) in tile.iter_mut().zip(columns) {
                *t = f(c);
            }
            tile
        };
        let mut packed = Self {
            inputs: rows.len(),
            weights: Vec::new(),
            bias: Vec::new(),
        };
        for columns in columns.chunks(TILE) {
            packed.bias.push(tile(&|c| bias[c], columns));
            packed.weights.extend(
                rows.iter()
                    .map(|&r| tile(&|c| weight[r * outputs + c], columns)),
            );
        }
        packed
    }

    /// `output[j] = activation(Σ_i w[i][j] · input[i] + b[j])` for one block; `leaky`: LeakyReLU, else none.
    #[inline(always)]
    pub(crate) fn apply<S: Simd>(&self, simd: S, input: &[f32], output: &mut [f32], leaky: bool) {
        let (input, _) = pulp::as_arrays::<2, _>(S::as_simd_f32s(input).0);
        let (output, _) = pulp::as_arrays_mut::<2, _>(S::as_mut_simd_f32s(output).0);
        let input = &input[..self.inputs];
        let slope = simd.splat_f32s(SLOPE);
        for ((tile, bias), out) in self
            .bias
            .iter()
            .enumerate()
            .zip(output.chunks_exact_mut(TILE))
        {
            let mut sum = [[simd.splat_f32s(0.0); 2]; TILE];
            for (sum, &b) in sum.iter_mut().zip(bias) {
                *sum = [simd.splat_f32s(b); 2];
            }
            let weights = &self.weights[tile * self.inputs..][..self.inputs];
            for (w, x) in weights.iter().zip(input) {
                for (sum, &w) in sum.iter_mut().zip(w) {
                    let w = simd.splat_f32s(w);
                    sum[0] = simd.mul_add_e_f32s(w, x[0], sum[0]);
                    sum[1] = simd.mul_add_e_f32s(w, x[1], sum[1]);
                }
            }
            for (out, sum) in out.iter_mut().zip(sum) {
                *out = if leaky {
                    sum.map(|s| simd.max_f32s(s, simd.mul_f32s(s, slope)))
                } else {
                    sum
                };
            }
        }
    }
}

/// All rows of one call; implements the loop once for every instruction set.
struct Pass<'a> {
    kernel: &'a Kernel,
    direction: Direction,
    x: &'a mut [f32],
    known: &'a [f32],
    log_det: &'a mut [f32],
}

impl WithSimd for Pass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self {
            kernel,
            direction,
            x,
            known,
            log_det,
        } = self;
        let (d, rows) = (kernel.dims, 2 * S::F32_LANES);
        // Columns of the block lie one after another: value = block[column * rows + row].
        let mut block = vec![0.0f32; (d + kernel.known) * rows];
        let mut det = vec![0.0f32; rows];
        let mut scratch = Scratch::new(kernel.width * rows);
        let blocks = x.chunks_mut(d * rows).zip(log_det.chunks_mut(rows));
        for (first, (x, log_det)) in (0..).step_by(rows).zip(blocks) {
            for row in 0..log_det.len() {
                let known = &known[(first + row) * kernel.known..][..kernel.known];
                for (column, &x) in (d..).zip(known) {
                    block[column * rows + row] = x;
                }
            }
            for (row, x) in x.chunks_exact(d).enumerate() {
                for (column, &x) in x.iter().enumerate() {
                    block[column * rows + row] = x;
                }
            }
            det.fill(0.0);
            let n = kernel.couplings.len();
            for i in 0..n {
                let c = &kernel.couplings[if direction == Direction::Generate {
                    i
                } else {
                    n - 1 - i
                }];
                c.apply(
                    simd,
                    kernel.s_max,
                    direction,
                    &mut block,
                    &mut det,
                    &mut scratch,
                );
            }
            for (row, x) in x.chunks_exact_mut(d).enumerate() {
                for (column, x) in x.iter_mut().enumerate() {
                    *x = block[column * rows + row];
                }
            }
            let n = log_det.len();
            log_det.copy_from_slice(&det[..n]);
        }
    }
}

/// Activations of one block: input of the networks, two buffers that alternate, and the two results.
struct Scratch {
    input: Vec<f32>,
    ping: Vec<f32>,
    pong: Vec<f32>,
    shift: Vec<f32>,
}

impl Scratch {
    fn new(len: usize) -> Self {
        Self {
            input: vec![0.0; len],
            ping: vec![0.0; len],
            pong: vec![0.0; len],
            shift: vec![0.0; len],
        }
    }
}

impl Coupling {
    #[inline(always)]
    fn apply<S: Simd>(
        &self,
        simd: S,
        s_max: f32,
        direction: Direction,
        block: &mut [f32],
        det: &mut [f32],
        scratch: &mut Scratch,
    ) {
        if self.changed.is_empty() {
            return;
        }
        let rows = det.len();
        for (input, &column) in scratch.input.chunks_exact_mut(rows).zip(&self.seen) {
            input.copy_from_slice(&block[column * rows..][..rows]);
        }
        for (which, net) in self.nets.iter().enumerate().rev() {
            for (i, layer) in net.iter().enumerate() {
                let (input, output) = if i == 0 {
                    (&scratch.input, &mut scratch.ping)
                } else if i % 2 == 1 {
                    (&scratch.ping, &mut scratch.pong)
                } else {
                    (&scratch.pong, &mut scratch.ping)
                };
                layer.apply(simd, input, output, i + 1 < net.len());
            }
            if net.len().is_multiple_of(2) {
                std::mem::swap(&mut scratch.ping, &mut scratch.pong);
            }
            if which == 1 {
                std::mem::swap(&mut scratch.ping, &mut scratch.shift);
            }
        }
        let scale = 1.0 / s_max;
        for (i, &column) in self.changed.iter().enumerate() {
            let x = &mut block[column * rows..][..rows];
            let raw = &scratch.ping[i * rows..][..rows];
            let shift = &scratch.shift[i * rows..][..rows];
            for (((x, det), &raw), &t) in x.iter_mut().zip(det.iter_mut()).zip(raw).zip(shift) {
                let s = s_max * tanh(raw * scale);
                *det += s;
                *x = match direction {
                    Direction::Generate => *x * exp(s) + t,
                    Direction::Normalise => (*x - t) * exp(-s),
                };
            }
        }
    }
}

/// Cut to [−1, 1]; what is not a number becomes −1, as every other number would do.
#[inline(always)]
pub(crate) fn inside(x: f32) -> f32 {
    // In this order they drop NaN, which `clamp` would keep.
    #[allow(clippy::manual_clamp, reason = "a number comes out whatever goes in")]
    x.max(-1.0).min(1.0)
}

/// exp in f32, relative error below 3e-7, argument clamped to ±87; branch-free, so that loops vectorise.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    // Adding 1.5·2²³ rounds to an integer that then sits in the low bits of the sum.
    const MAGIC: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 87.0);
    let k = x * std::f32::consts::LOG2_E + MAGIC;
    let n = k - MAGIC;
    // ln 2 in two parts, the first with few enough bits that n · it is exact.
    let r = (x - n * 0.693_359_4) - n * -2.121_944_4e-4;
    let p = 1.0 / 5040.0;
    let p = p * r + 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = p * r + 1.0;
    let p = p * r + 1.0;
    p * f32::from_bits((k.to_bits() << 23).wrapping_add(0x3f80_0000))
}

/// tanh in f32, absolute error below 3e-7.
#[inline(always)]
pub(crate) fn tanh(x: f32) -> f32 {
    1.0 - 2.0 / (1.0 + exp(2.0 * x))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_and_tanh_keep_their_stated_errors() {
        for i in -870_000..=870_000 {
            let x = i as f32 * 1e-4;
            let want = f64::from(x).exp();
            assert!(
                (f64::from(exp(x)) / want - 1.0).abs() < 3e-7,
                "exp({x}) = {}",
                exp(x)
            );
            let want = f64::from(x).tanh();
            assert!(
                (f64::from(tanh(x)) - want).abs() < 3e-7,
                "tanh({x}) = {}",
                tanh(x)
            );
        }
        assert!(exp(1e9).is_finite() && exp(-1e9) > 0.0);
        assert_eq!(tanh(1e9), 1.0);
        assert_eq!(tanh(-1e9), -1.0);
    }

    #[test]
    fn every_instruction_set_gives_the_same_flow() {
        use crate::flow::options::RealNvpOptions;
        use crate::flow::{Domain, weights::Shape};
        let options = RealNvpOptions::defaults(Domain::Logit);
        let weights = Weights::random(Shape::new(5, &options), 1);
        let kernel = Kernel::new(&weights, options.s_max);
        let z: Vec<f32> = (0..5 * 37).map(|i| (i as f32).sin()).collect();
        for direction in [Direction::Generate, Direction::Normalise] {
            let (mut fast, mut det) = (z.clone(), vec![0.0; 37]);
            kernel.run(direction, &mut fast, &[], &mut det);
            let (mut slow, mut slow_det) = (z.clone(), vec![0.0; 37]);
            let pass = Pass {
                kernel: &kernel,
                direction,
                x: &mut slow,
                known: &[],
                log_det: &mut slow_det,
            };
            Simd::vectorize(pulp::Scalar, pass);
            let close = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-5 * (1.0 + b.abs());
            assert!(fast.iter().zip(&slow).all(close), "{fast:?} {slow:?}");
            assert!(det.iter().zip(&slow_det).all(close), "{det:?} {slow_det:?}");
        }
    }
}
