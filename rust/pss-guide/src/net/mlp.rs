//! A small network: linear layers with LeakyReLU between them, and what it looks at.

use pss_rng::{Purpose, Stream};

use crate::Context;
use crate::kernel::layer::{Linear, SLOPE};
use crate::kernel::math::inside;
use crate::kernel::product::{Strided, multiply};
use crate::table::cells::Grid;

/// Numbers that tell where a vertex is: position, normal, outgoing direction, bounce.
pub(super) const FEATURES: usize = 10;

/// Turns contexts into the network's inputs, all in [−1, 1].
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Place {
    /// The box that holds 99 % of the vertices; positions beyond are moved to its border.
    pub(super) origin: [f32; 3],
    /// 1 ÷ its extent; 0 along an axis in which it is flat.
    pub(super) scale: [f32; 3],
    /// Bounces k of a path: vertices 1 … k − 1 decide a direction.
    pub(super) bounces: usize,
}

impl Place {
    pub(super) fn around(positions: &[[f32; 3]], bounces: usize) -> Self {
        let Grid { origin, scale, .. } = Grid::around(positions, 0);
        Self {
            origin,
            scale,
            bounces,
        }
    }

    #[inline(always)]
    pub(super) fn features(&self, c: &Context) -> [f32; FEATURES] {
        let position: [f32; 3] = std::array::from_fn(|i| {
            if self.scale[i] == 0.0 {
                return 0.0;
            }
            inside(2.0 * (c.position[i] - self.origin[i]) * self.scale[i] - 1.0)
        });
        let ([px, py, pz], [nx, ny, nz], [ox, oy, oz]) =
            (position, c.normal.map(inside), c.outgoing.map(inside));
        let bounce = (c.bounce as f32 - 1.0) / (self.bounces as f32 - 2.0).max(1.0);
        [
            px,
            py,
            pz,
            nx,
            ny,
            nz,
            ox,
            oy,
            oz,
            inside(2.0 * bounce - 1.0),
        ]
    }
}

/// Weights (inputs, outputs) row-major and biases of each layer.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Mlp {
    /// Units of each layer, inputs first.
    pub(super) widths: Vec<usize>,
    /// Weight and bias of each linear layer in turn.
    pub(super) tensors: Vec<Vec<f32>>,
}

impl Mlp {
    /// Weights uniform in ±1/√inputs, the usual start of a linear layer; the last layer's a tenth of that around `bias`.
    pub(super) fn random(widths: Vec<usize>, bias: &[f32], seed: u64, index: u32) -> Self {
        let stream = Stream::new(seed, Purpose::Weights);
        let last = widths.len() - 2;
        let mut tensors = Vec::new();
        for (layer, w) in widths.windows(2).enumerate() {
            let mut numbers = stream.sequence(layer as u32, index);
            let bound = 1.0 / (w[0] as f32).sqrt() * if layer == last { 0.1 } else { 1.0 };
            let mut random = |n| -> Vec<f32> {
                let number = |_| bound * (2.0 * numbers.next_f32() - 1.0);
                (0..n).map(number).collect()
            };
            tensors.push(random(w[0] * w[1]));
            let own = random(w[1]);
            tensors.push(if layer == last { bias.to_vec() } else { own });
        }
        Self { widths, tensors }
    }

    /// Names and shapes of the tensors.
    pub(super) fn names(widths: &[usize], prefix: &str) -> Vec<(String, Vec<usize>)> {
        let each = |(layer, w): (usize, &[usize])| {
            [
                (format!("{prefix}{layer}.weight"), vec![w[0], w[1]]),
                (format!("{prefix}{layer}.bias"), vec![w[1]]),
            ]
        };
        widths.windows(2).enumerate().flat_map(each).collect()
    }

    pub(super) fn parameters(&self) -> usize {
        self.tensors.iter().map(Vec::len).sum()
    }

    /// For evaluation, whole blocks of rows at a time.
    pub(super) fn pack(&self) -> Vec<Linear> {
        let layer = |(w, tensors): (&[usize], &[Vec<f32>])| {
            let all = |n: usize| (0..n).collect::<Vec<_>>();
            Linear::pack(&tensors[0], &tensors[1], &all(w[0]), &all(w[1]))
        };
        self.widths
            .windows(2)
            .zip(self.tensors.chunks(2))
            .map(layer)
            .collect()
    }

    /// Activations of every layer for `n` rows; `acts[0]`, the inputs, is given.
    pub(super) fn forward(&self, n: usize, acts: &mut [Vec<f32>]) {
        let last = self.widths.len() - 2;
        for (layer, w) in self.widths.windows(2).enumerate() {
            let (before, after) = acts.split_at_mut(layer + 1);
            let (x, y) = (&before[layer], &mut after[0]);
            y.resize(n * w[1], 0.0);
            let (weight, bias) = (&self.tensors[2 * layer], &self.tensors[2 * layer + 1]);
            let (a, b) = (Strided::rows(x, w[0]), Strided::rows(weight, w[1]));
            multiply(y, [n, w[0], w[1]], a, b);
            let slope = if layer == last { 1.0 } else { SLOPE };
            for row in y.chunks_exact_mut(w[1]) {
                for (y, b) in row.iter_mut().zip(bias) {
                    let sum = *y + b;
                    *y = sum.max(sum * slope);
                }
            }
        }
    }

    /// Adds to `sums` the derivative by every tensor, `gradient` being that by the outputs. Overwrites the activations.
    pub(super) fn backward(
        &self,
        n: usize,
        acts: &mut [Vec<f32>],
        gradient: &mut Vec<f32>,
        sums: &mut [Vec<f32>],
    ) {
        for (layer, w) in self.widths.windows(2).enumerate().rev() {
            let (before, _) = acts.split_at_mut(layer + 1);
            let x = &mut before[layer];
            multiply(
                &mut sums[2 * layer],
                [w[0], n, w[1]],
                Strided::transposed(x, w[0]),
                Strided::rows(gradient, w[1]),
            );
            let sum = &mut sums[2 * layer + 1];
            sum.fill(0.0);
            for row in gradient.chunks_exact(w[1]) {
                sum.iter_mut().zip(row).for_each(|(s, g)| *s += g);
            }
            if layer == 0 {
                break;
            }
            let mut back = vec![0.0; n * w[0]];
            let weight = Strided::transposed(&self.tensors[2 * layer], w[1]);
            multiply(
                &mut back,
                [n, w[1], w[0]],
                Strided::rows(gradient, w[1]),
                weight,
            );
            // The sign of an activation is that of its sum.
            for (b, &x) in back.iter_mut().zip(x.iter()) {
                *b *= if x > 0.0 { 1.0 } else { SLOPE };
            }
            *gradient = back;
        }
    }
}
