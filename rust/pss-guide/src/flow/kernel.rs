//! Evaluation of a trained flow on packed weights; [`crate::kernel`] has the layer.
//!
//! A block of rows goes through all couplings before the next one starts. Masked inputs (always 0) and masked outputs
//! (never used) are left out.

use pulp::{Simd, WithSimd};

use super::weights::{Weights, kept};
use crate::kernel::lanes::Lanes;
use crate::kernel::layer::{Linear, TILE};
use crate::kernel::math::Functions;
use crate::kernel::{ROWS, dispatch};

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
    /// Values per row that the widest layer writes.
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
        dispatch(Pass {
            kernel: self,
            direction,
            x,
            known,
            log_det,
        });
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
        let d = kernel.dims;
        let mut block = vec![Lanes::default(); d + kernel.known];
        let mut scratch = Scratch::new(kernel.width);
        let blocks = x.chunks_mut(d * ROWS).zip(log_det.chunks_mut(ROWS));
        for (first, (x, log_det)) in (0..).step_by(ROWS).zip(blocks) {
            for row in 0..log_det.len() {
                let known = &known[(first + row) * kernel.known..][..kernel.known];
                for (column, &x) in block[d..].iter_mut().zip(known) {
                    column[row] = x;
                }
            }
            for (row, x) in x.chunks_exact(d).enumerate() {
                for (column, &x) in block.iter_mut().zip(x) {
                    column[row] = x;
                }
            }
            let mut det = Lanes::default();
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
                for (column, x) in block.iter().zip(x) {
                    *x = column[row];
                }
            }
            let n = log_det.len();
            log_det.copy_from_slice(&det.0[..n]);
        }
    }
}

/// Activations of one block: input of the networks, two buffers that alternate, and the first result.
struct Scratch {
    input: Vec<Lanes>,
    ping: Vec<Lanes>,
    pong: Vec<Lanes>,
    shift: Vec<Lanes>,
}

impl Scratch {
    fn new(len: usize) -> Self {
        let zeros = || vec![Lanes::default(); len];
        Self {
            input: zeros(),
            ping: zeros(),
            pong: zeros(),
            shift: zeros(),
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
        block: &mut [Lanes],
        det: &mut Lanes,
        scratch: &mut Scratch,
    ) {
        if self.changed.is_empty() {
            return;
        }
        for (input, &column) in scratch.input.iter_mut().zip(&self.seen) {
            *input = block[column];
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
            let (mut x, raw, shift) = (block[column], scratch.ping[i], scratch.shift[i]);
            for r in 0..ROWS {
                let s = s_max * simd.tanh(raw[r] * scale);
                det[r] += s;
                x[r] = match direction {
                    Direction::Generate => simd.fma(x[r], simd.exp(s), shift[r]),
                    Direction::Normalise => (x[r] - shift[r]) * simd.exp(-s),
                };
            }
            block[column] = x;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::options::RealNvpOptions;
    use crate::flow::{Domain, weights::Shape};
    use crate::kernel::Isa;

    #[test]
    fn every_instruction_set_gives_the_same_flow() {
        let options = RealNvpOptions::defaults(Domain::Logit);
        let weights = Weights::random(Shape::new(5, &options), 1);
        let kernel = Kernel::new(&weights, options.s_max);
        let z: Vec<f32> = (0..5 * 37).map(|i| (i as f32).sin()).collect();
        for direction in [Direction::Generate, Direction::Normalise] {
            let run = |isa: Isa| {
                let (mut x, mut log_det) = (z.clone(), vec![0.0; 37]);
                isa.run(Pass {
                    kernel: &kernel,
                    direction,
                    x: &mut x,
                    known: &[],
                    log_det: &mut log_det,
                });
                [x, log_det].concat()
            };
            let portable = run(Isa::Portable);
            let wide = Isa::supported().into_iter().skip(1).map(run);
            let wide: Vec<Vec<f32>> = wide.collect();
            for wide in &wide {
                let close = |(a, b): (&f32, &f32)| (a - b).abs() < 1e-5 * (1.0 + b.abs());
                assert!(
                    wide.iter().zip(&portable).all(close),
                    "{wide:?} {portable:?}"
                );
            }
            assert!(
                wide.windows(2).all(|pair| pair[0] == pair[1]),
                "AVX2 and AVX-512 differ"
            );
        }
    }
}
