//! Networks and the head that reads their outputs: densities and samples of blocks of rows, and what training needs.

use pulp::{Simd, WithSimd};

use super::mixture::Mixture;
use super::mlp::{FEATURES, Mlp, Place};
use super::options::Options;
use super::spline::Spline;
use crate::Context;
use crate::kernel::lanes::Lanes;
use crate::kernel::layer::{Linear, TILE};
use crate::kernel::{ROWS, dispatch};

/// The density that a network's outputs stand for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Head {
    /// One network, whose outputs decide both numbers.
    Mixture(Mixture),
    /// Two networks, one a number.
    Spline(Spline),
}

impl Head {
    /// Networks, each of which may look at the numbers that those before it decided.
    pub(super) fn stages(self) -> usize {
        match self {
            Self::Mixture(_) => 1,
            Self::Spline(_) => 2,
        }
    }

    pub(super) fn outputs(self) -> usize {
        match self {
            Self::Mixture(m) => m.outputs(),
            Self::Spline(s) => s.outputs(),
        }
    }

    fn start(self) -> Vec<f32> {
        match self {
            Self::Mixture(m) => m.start(),
            Self::Spline(s) => s.start(),
        }
    }

    fn scratch(self) -> usize {
        match self {
            Self::Mixture(m) => m.scratch(),
            Self::Spline(s) => s.scratch(),
        }
    }

    /// Units of the layers of each network.
    pub(super) fn widths(self, hidden: usize, layers: usize) -> Vec<Vec<usize>> {
        let each = |stage| {
            let mut widths = vec![FEATURES + stage];
            widths.extend(std::iter::repeat_n(hidden, layers));
            widths.push(self.outputs());
            widths
        };
        (0..self.stages()).map(each).collect()
    }

    #[inline(always)]
    fn sample<S: Simd>(
        self,
        simd: S,
        stage: usize,
        out: &[Lanes],
        u: &mut [Lanes; 2],
        scratch: &mut [Lanes],
    ) -> Lanes {
        match self {
            Self::Mixture(m) => m.sample(simd, out, u, scratch),
            Self::Spline(s) => s.sample(simd, out, &mut u[stage], scratch),
        }
    }

    #[inline(always)]
    fn density<S: Simd>(
        self,
        simd: S,
        stage: usize,
        out: &[Lanes],
        u: &[Lanes; 2],
        scratch: &mut [Lanes],
    ) -> Lanes {
        match self {
            Self::Mixture(m) => m.density(simd, out, u, scratch),
            Self::Spline(s) => s.density(simd, out, &u[stage], scratch),
        }
    }

    #[inline(always)]
    fn learn<S: Simd>(
        self,
        simd: S,
        stage: usize,
        out: &[Lanes],
        u: &[Lanes; 2],
        slope: &mut [Lanes],
        scratch: &mut [Lanes],
    ) -> Lanes {
        match self {
            Self::Mixture(m) => m.learn(simd, out, u, slope, scratch),
            Self::Spline(s) => s.learn(simd, out, &u[stage], slope, scratch),
        }
    }
}

/// All that training changes.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Model {
    pub(super) head: Head,
    pub(super) nets: Vec<Mlp>,
}

impl Model {
    pub(super) fn random(options: &Options, seed: u64) -> Self {
        let head = options.head;
        let widths = options.widths().into_iter().enumerate();
        Self {
            head,
            nets: widths
                .map(|(i, w)| Mlp::random(w, &head.start(), seed, i as u32))
                .collect(),
        }
    }

    /// Adds to `log_q` ln q of each row of (n, 2) numbers for one stage's (n, outputs), and replaces these by its
    /// derivatives.
    pub(super) fn learn(&self, stage: usize, out: &mut [f32], u: &[f32], log_q: &mut [f32]) {
        dispatch(Learn {
            head: self.head,
            stage,
            out,
            u,
            log_q,
        });
    }
}

struct Learn<'a> {
    head: Head,
    stage: usize,
    out: &'a mut [f32],
    u: &'a [f32],
    log_q: &'a mut [f32],
}

impl WithSimd for Learn<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let n = self.head.outputs();
        let mut block = vec![Lanes::default(); n];
        let mut slope = vec![Lanes::default(); n];
        let mut scratch = vec![Lanes::default(); self.head.scratch()];
        let mut u = [Lanes::all(0.5); 2];
        let blocks = self.out.chunks_mut(n * ROWS).zip(self.u.chunks(2 * ROWS));
        for ((out, pairs), log_q) in blocks.zip(self.log_q.chunks_mut(ROWS)) {
            for (r, (out, pair)) in out.chunks_exact(n).zip(pairs.chunks_exact(2)).enumerate() {
                for (block, &value) in block.iter_mut().zip(out) {
                    block[r] = value;
                }
                (u[0][r], u[1][r]) = (pair[0], pair[1]);
            }
            let log = self
                .head
                .learn(simd, self.stage, &block, &u, &mut slope, &mut scratch);
            for (r, out) in out.chunks_exact_mut(n).enumerate() {
                for (value, slope) in out.iter_mut().zip(&slope) {
                    *value = slope[r];
                }
            }
            log_q
                .iter_mut()
                .zip(&log.0)
                .for_each(|(to, log)| *to += log);
        }
    }
}

/// A model packed for evaluation. Rows never mix, and each sees the same operations in the same order.
#[derive(Clone, Debug)]
pub(super) struct Packed {
    head: Head,
    place: Place,
    nets: Vec<Vec<Linear>>,
    /// Values per row that the widest layer takes, its padding included.
    width: usize,
}

impl Packed {
    pub(super) fn new(model: &Model, place: Place) -> Self {
        let widths = model.nets.iter().flat_map(|net| &net.widths);
        Self {
            head: model.head,
            place,
            nets: model.nets.iter().map(Mlp::pack).collect(),
            width: widths.max().map_or(0, |w| w.next_multiple_of(TILE)),
        }
    }

    /// Turns uniform pairs into guided ones, and gives their densities.
    pub(super) fn sample(&self, contexts: &[Context], u: &mut [f32], q: &mut [f32]) {
        dispatch(Pass {
            model: self,
            contexts,
            u,
            q,
            draw: true,
        });
    }

    /// Densities of pairs.
    pub(super) fn density(&self, contexts: &[Context], u: &[f32], q: &mut [f32]) {
        // One path through the blocks for both: what is written back is what was read.
        let mut u = u[..2 * q.len()].to_vec();
        dispatch(Pass {
            model: self,
            contexts,
            u: &mut u,
            q,
            draw: false,
        });
    }
}

struct Pass<'a> {
    model: &'a Packed,
    contexts: &'a [Context],
    u: &'a mut [f32],
    q: &'a mut [f32],
    draw: bool,
}

impl WithSimd for Pass<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let model = self.model;
        let nowhere = Context::default();
        let mut inputs = [Lanes::default(); FEATURES + 1];
        let mut ping = vec![Lanes::default(); model.width];
        let mut pong = ping.clone();
        let mut scratch = vec![Lanes::default(); model.head.scratch()];
        let mut u = [Lanes::all(0.5); 2];
        let mut first = 0;
        for (pairs, q) in self.u.chunks_mut(2 * ROWS).zip(self.q.chunks_mut(ROWS)) {
            for (r, pair) in pairs.chunks_exact(2).enumerate() {
                (u[0][r], u[1][r]) = (pair[0], pair[1]);
                let c = self.contexts.get(first + r).unwrap_or(&nowhere);
                for (input, x) in inputs.iter_mut().zip(model.place.features(c)) {
                    input[r] = x;
                }
            }
            first += ROWS;
            q.fill(1.0);
            for (stage, net) in model.nets.iter().enumerate() {
                if stage > 0 {
                    inputs[FEATURES] = u[0];
                }
                for (i, layer) in net.iter().enumerate() {
                    let input = if i == 0 { &inputs[..] } else { &ping[..] };
                    layer.apply(simd, input, &mut pong, i + 1 < net.len());
                    std::mem::swap(&mut ping, &mut pong);
                }
                let density = if self.draw {
                    model.head.sample(simd, stage, &ping, &mut u, &mut scratch)
                } else {
                    model.head.density(simd, stage, &ping, &u, &mut scratch)
                };
                q.iter_mut().zip(&density.0).for_each(|(q, d)| *q *= d);
            }
            if self.draw {
                for (r, pair) in pairs.chunks_exact_mut(2).enumerate() {
                    (pair[0], pair[1]) = (u[0][r], u[1][r]);
                }
            }
        }
    }
}
