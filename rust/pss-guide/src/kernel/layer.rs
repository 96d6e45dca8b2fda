//! A linear layer for blocks of rows.

use pulp::Simd;

use super::ROWS;
use super::lanes::Lanes;

/// Slope of LeakyReLU below zero.
pub(crate) const SLOPE: f32 = 0.01;

/// Outputs whose weights lie together; a multiple of it divides 40.
pub(crate) const TILE: usize = 5;

/// Weights and biases, outputs padded with zeros to whole tiles. Inputs that are always 0 and outputs that nobody uses can
/// be left out.
#[derive(Clone, Debug)]
pub(crate) struct Linear {
    inputs: usize,
    /// `[tile][input][output of the tile]`
    weights: Vec<[f32; TILE]>,
    /// `[tile][output of the tile]`
    bias: Vec<[f32; TILE]>,
}

impl Linear {
    /// Packs the rows and columns named of `weight`, (inputs, outputs) row-major.
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
    pub(crate) fn apply<S: Simd>(
        &self,
        simd: S,
        input: &[Lanes],
        output: &mut [Lanes],
        leaky: bool,
    ) {
        // Ten vectors of sums hide the latency of a multiplication and addition, and fit sixteen registers.
        match S::F32_LANES {
            16 => self.tiles::<S, 1, 2>(simd, input, output, leaky),
            8 => self.tiles::<S, 2, 1>(simd, input, output, leaky),
            4 => self.tiles::<S, 4, 1>(simd, input, output, leaky),
            _ => self.tiles::<S, ROWS, 1>(simd, input, output, leaky),
        }
    }

    /// V vectors make a block; G tiles are summed together.
    #[inline(always)]
    fn tiles<S: Simd, const V: usize, const G: usize>(
        &self,
        simd: S,
        input: &[Lanes],
        output: &mut [Lanes],
        leaky: bool,
    ) {
        let input = &input[..self.inputs];
        let mut first = 0;
        while first + G <= self.bias.len() {
            self.sum::<S, V, G>(simd, first, input, output, leaky);
            first += G;
        }
        for last in first..self.bias.len() {
            self.sum::<S, V, 1>(simd, last, input, output, leaky);
        }
    }

    #[inline(always)]
    #[allow(
        clippy::needless_range_loop,
        reason = "indices are inlined wherever this is compiled, iterators only where the compiler likes"
    )]
    fn sum<S: Simd, const V: usize, const G: usize>(
        &self,
        simd: S,
        first: usize,
        input: &[Lanes],
        output: &mut [Lanes],
        leaky: bool,
    ) {
        let n = input.len();
        let mut weights = [&self.weights[..0]; G];
        for g in 0..G {
            weights[g] = &self.weights[(first + g) * n..][..n];
        }
        let mut sums = [[[simd.splat_f32s(0.0); V]; TILE]; G];
        for g in 0..G {
            for t in 0..TILE {
                sums[g][t] = [simd.splat_f32s(self.bias[first + g][t]); V];
            }
        }
        for i in 0..n {
            let x = input[i].vectors::<S, V>();
            for g in 0..G {
                for t in 0..TILE {
                    let w = simd.splat_f32s(weights[g][i][t]);
                    for v in 0..V {
                        sums[g][t][v] = simd.mul_add_e_f32s(w, x[v], sums[g][t][v]);
                    }
                }
            }
        }
        let slope = simd.splat_f32s(SLOPE);
        let output = &mut output[first * TILE..][..G * TILE];
        for g in 0..G {
            for t in 0..TILE {
                let to = output[g * TILE + t].vectors_mut::<S, V>();
                for v in 0..V {
                    let sum = sums[g][t][v];
                    to[v] = if leaky {
                        simd.max_f32s(sum, simd.mul_f32s(sum, slope))
                    } else {
                        sum
                    };
                }
            }
        }
    }
}
