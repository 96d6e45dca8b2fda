//! Networks and the head that reads their outputs: densities and samples of blocks of rows, and what training needs.

use pulp::{Simd, WithSimd};

use super::mixture::Mixture;
use super::mlp::{FEATURES, Mlp, Place};
use super::options::Options;
use super::spline::Spline;
use crate::Context;
use crate::flow::kernel::{Linear, TILE};

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
    fn sample(
        self,
        stage: usize,
        rows: usize,
        out: &[f32],
        u: [&mut [f32]; 2],
        q: &mut [f32],
        scratch: &mut [f32],
    ) {
        match self {
            Self::Mixture(m) => m.sample(rows, out, u, q, scratch),
            Self::Spline(s) => s.sample(rows, out, u[stage], q, scratch),
        }
    }

    #[inline(always)]
    fn density(
        self,
        stage: usize,
        rows: usize,
        out: &[f32],
        u: [&[f32]; 2],
        q: &mut [f32],
        scratch: &mut [f32],
    ) {
        match self {
            Self::Mixture(m) => m.density(rows, out, u, q, scratch),
            Self::Spline(s) => s.density(rows, out, u[stage], q, scratch),
        }
    }

    #[inline(always)]
    fn learn(
        self,
        stage: usize,
        rows: usize,
        out: &[f32],
        u: [&[f32]; 2],
        [log_q, slope]: [&mut [f32]; 2],
        scratch: &mut [f32],
    ) {
        match self {
            Self::Mixture(m) => m.learn(rows, out, u, log_q, slope, scratch),
            Self::Spline(s) => s.learn(rows, out, u[stage], log_q, slope, scratch),
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

/// Runs `op` with the widest vectors that the heads were written for.
fn dispatch<O: WithSimd>(op: O) -> O::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return Simd::vectorize(simd, op);
    }
    pulp::Arch::new().dispatch(op)
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
    fn with_simd<S: Simd>(self, _: S) {
        let (rows, n) = (2 * S::F32_LANES, self.head.outputs());
        let mut block = vec![0.0; n * rows];
        let mut slope = vec![0.0; n * rows];
        let mut scratch = vec![0.0; self.head.scratch() * rows];
        let (mut u, mut q) = ([vec![0.5; rows], vec![0.5; rows]], vec![0.0; rows]);
        let blocks = self.out.chunks_mut(n * rows).zip(self.u.chunks(2 * rows));
        for ((out, pairs), log_q) in blocks.zip(self.log_q.chunks_mut(rows)) {
            for (r, (out, pair)) in out.chunks_exact(n).zip(pairs.chunks_exact(2)).enumerate() {
                for (o, &value) in out.iter().enumerate() {
                    block[o * rows + r] = value;
                }
                (u[0][r], u[1][r]) = (pair[0], pair[1]);
            }
            let pair = [&u[0][..], &u[1][..]];
            let to = [&mut q[..], &mut slope[..]];
            self.head
                .learn(self.stage, rows, &block, pair, to, &mut scratch);
            for (r, out) in out.chunks_exact_mut(n).enumerate() {
                for (o, value) in out.iter_mut().enumerate() {
                    *value = slope[o * rows + r];
                }
            }
            log_q.iter_mut().zip(&q).for_each(|(to, q)| *to += q);
        }
    }
}

/// A model packed for evaluation. Rows never mix, and each sees the same operations in the same order.
#[derive(Clone, Debug)]
pub(super) struct Packed {
    head: Head,
    place: Place,
    nets: Vec<Vec<Linear>>,
    /// Floats per row that the widest layer takes, its padding included.
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
        let (rows, model) = (2 * S::F32_LANES, self.model);
        let nowhere = Context::default();
        // Values of a block lie one after another: value = block[column * rows + row].
        let mut inputs = vec![0.0; (FEATURES + 2) * rows];
        let mut ping = vec![0.0; model.width * rows];
        let mut pong = ping.clone();
        let mut scratch = vec![0.0; model.head.scratch() * rows];
        let (mut u0, mut u1) = (vec![0.5; rows], vec![0.5; rows]);
        let mut density = vec![0.0; rows];
        let mut first = 0;
        for (pairs, q) in self.u.chunks_mut(2 * rows).zip(self.q.chunks_mut(rows)) {
            for (r, pair) in pairs.chunks_exact(2).enumerate() {
                (u0[r], u1[r]) = (pair[0], pair[1]);
                let c = self.contexts.get(first + r).unwrap_or(&nowhere);
                for (i, x) in model.place.features(c).into_iter().enumerate() {
                    inputs[i * rows + r] = x;
                }
            }
            first += rows;
            q.fill(1.0);
            for (stage, net) in model.nets.iter().enumerate() {
                for seen in 0..stage {
                    let to = &mut inputs[(FEATURES + seen) * rows..][..rows];
                    to.copy_from_slice(if seen == 0 { &u0 } else { &u1 });
                }
                for (i, layer) in net.iter().enumerate() {
                    let input = if i == 0 { &inputs } else { &ping };
                    layer.apply(simd, input, &mut pong, i + 1 < net.len());
                    std::mem::swap(&mut ping, &mut pong);
                }
                if self.draw {
                    let u = [&mut u0[..], &mut u1[..]];
                    model
                        .head
                        .sample(stage, rows, &ping, u, &mut density, &mut scratch);
                } else {
                    let u = [&u0[..], &u1[..]];
                    model
                        .head
                        .density(stage, rows, &ping, u, &mut density, &mut scratch);
                }
                q.iter_mut().zip(&density).for_each(|(q, d)| *q *= d);
            }
            if self.draw {
                for (r, pair) in pairs.chunks_exact_mut(2).enumerate() {
                    (pair[0], pair[1]) = (u0[r], u1[r]);
                }
            }
        }
    }
}
