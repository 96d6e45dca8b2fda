//! The head of `mixture-net`: outputs of the network as a mixture of normals, each a product over the two numbers, cut to
//! [0, 1) and made to integrate to one there.
//!
//! q(u) = Σ_j π_j Π_i N(u_i; μ_ij, σ_ij) / Z_ij,  Z = Φ((1 − μ)/σ) − Φ(−μ/σ),
//! π = softmax(outputs), μ = ½ + ½ tanh(output), σ = 0.1·exp(3 tanh(output/3)), so in (0.005, 2).
//!
//! Means stay in the square: Z is then at least about a tenth, the sum of two positive terms, and never cancels. A sample
//! takes its component by the first number, which is stretched and used again, and each number from the component's
//! inverse distribution; tails are measured from the end that is nearer, where f32 resolves them.

use pulp::Simd;

use crate::kernel::ROWS;
use crate::kernel::lanes::{BELOW_ONE, HALF_STEP, Lanes, at_least, choose, softmax};
use crate::kernel::math::{FRAC_1_SQRT_PI, Functions};

/// Least density; where all components are as far away, exp would leave f32's range.
const LEAST: f32 = 1e-37;

/// Outputs of the network, and what of them is prepared, are blocks of rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Mixture {
    pub(super) components: usize,
}

/// A component along one of the numbers.
struct Axis {
    mu: f32,
    /// 1/(σ√2).
    inv: f32,
    /// erfc of the distances of 0 and of 1 from μ: twice the mass that is cut off.
    tails: [f32; 2],
}

impl Axis {
    #[inline(always)]
    fn new<S: Simd>(simd: S, mean: f32, spread: f32) -> Self {
        let mu = 0.5 + 0.5 * simd.tanh(mean);
        let inv = 7.071_068 * simd.exp(-3.0 * simd.tanh(spread * (1.0 / 3.0)));
        Self {
            mu,
            inv,
            tails: [simd.erfc(mu * inv), simd.erfc((1.0 - mu) * inv)],
        }
    }

    /// Twice the mass inside.
    #[inline(always)]
    fn mass(&self) -> f32 {
        (1.0 - self.tails[0]) + (1.0 - self.tails[1])
    }

    /// Density at the mean.
    #[inline(always)]
    fn peak(&self) -> f32 {
        2.0 * FRAC_1_SQRT_PI * self.inv / self.mass()
    }

    /// −ln of the density at x relative to the mean's.
    #[inline(always)]
    fn fall(&self, x: f32) -> f32 {
        let z = (x - self.mu) * self.inv;
        z * z
    }

    /// The number below which a share v of the mass lies.
    #[inline(always)]
    fn inverse<S: Simd>(&self, simd: S, v: f32) -> f32 {
        let mass = self.mass();
        let (low, high) = (v * mass, (1.0 - v) * mass);
        let left = low < 1.0 - self.tails[0];
        let c = if left {
            self.tails[0] + low
        } else {
            self.tails[1] + high
        };
        let y = simd.inverse_erfc(c.clamp(1e-30, 1.0)) / self.inv;
        (self.mu + if left { -y } else { y }).clamp(0.0, BELOW_ONE)
    }
}

/// Prepared values of a component, by the order in which they are kept.
const PREPARED: usize = 10;

impl Mixture {
    /// Outputs: logits, then means and spreads along the first number, then along the second.
    pub(super) fn outputs(self) -> usize {
        5 * self.components
    }

    /// Biases that training starts from: components apart and broad, their sum nearly uniform.
    pub(super) fn start(self) -> Vec<f32> {
        let n = self.components;
        let mut bias = vec![0.0; self.outputs()];
        for j in 0..n {
            let first = (j as f32 + 0.5) / n as f32;
            let second = (j as f32 * 0.618_034 + 0.5).fract();
            for (axis, mu) in [first, second].into_iter().enumerate() {
                bias[(1 + 2 * axis) * n + j] = (1.6 * mu - 0.8).atanh();
                bias[(2 + 2 * axis) * n + j] = 1.15; // σ = 0.3
            }
        }
        bias
    }

    /// Values per row that [`Mixture::sample`] and [`Mixture::density`] work in.
    pub(super) fn scratch(self) -> usize {
        PREPARED * self.components
    }

    /// Per component: share, then for each its height and mean, width and both tails along each number.
    #[inline(always)]
    fn prepare<S: Simd>(self, simd: S, out: &[Lanes], scratch: &mut [Lanes]) {
        let n = self.components;
        let (pi, rest) = scratch.split_at_mut(n);
        softmax(simd, &out[..n], pi);
        for (j, mine) in rest.chunks_exact_mut(PREPARED - 1).enumerate() {
            let row = |v: usize| out[v * n + j];
            let (means, spreads) = ([row(1), row(3)], [row(2), row(4)]);
            let mut height = pi[j];
            for (axis, (mean, spread)) in means.iter().zip(&spreads).enumerate() {
                let mut values = [Lanes::default(); 4];
                for r in 0..ROWS {
                    let a = Axis::new(simd, mean[r], spread[r]);
                    height[r] *= a.peak();
                    (values[0][r], values[1][r]) = (a.mu, a.inv);
                    (values[2][r], values[3][r]) = (a.tails[0], a.tails[1]);
                }
                mine[1 + 4 * axis..][..4].copy_from_slice(&values);
            }
            mine[0] = height;
        }
    }

    /// Density from what is prepared.
    #[inline(always)]
    fn evaluate<S: Simd>(self, simd: S, prepared: &[Lanes], [x0, x1]: &[Lanes; 2]) -> Lanes {
        let mut sum = Lanes::all(LEAST);
        for mine in prepared[self.components..].chunks_exact(PREPARED - 1) {
            let (height, mu0, inv0, mu1, inv1) = (mine[0], mine[1], mine[2], mine[5], mine[6]);
            for r in 0..ROWS {
                let (z0, z1) = ((x0[r] - mu0[r]) * inv0[r], (x1[r] - mu1[r]) * inv1[r]);
                sum[r] += height[r] * simd.exp(-simd.fma(z0, z0, z1 * z1));
            }
        }
        sum
    }

    /// Densities of pairs.
    #[inline(always)]
    pub(super) fn density<S: Simd>(
        self,
        simd: S,
        out: &[Lanes],
        u: &[Lanes; 2],
        scratch: &mut [Lanes],
    ) -> Lanes {
        self.prepare(simd, out, scratch);
        self.evaluate(simd, scratch, u)
    }

    /// Turns uniform pairs into guided ones, and gives their densities.
    #[inline(always)]
    pub(super) fn sample<S: Simd>(
        self,
        simd: S,
        out: &[Lanes],
        u: &mut [Lanes; 2],
        scratch: &mut [Lanes],
    ) -> Lanes {
        self.prepare(simd, out, scratch);
        let (pi, rest) = scratch.split_at(self.components);
        let [mut x0, mut x1] = *u;
        let mut below = Lanes::default();
        // What a sample wants of its component: where its interval begins, its share, and all that is prepared but the height.
        let mut chosen = [Lanes::default(); 10];
        // The last component whose interval begins no higher than the number; chosen by masks, so that rows stay vectors.
        for (pi, component) in pi.iter().zip(rest.chunks_exact(PREPARED - 1)) {
            let mask = at_least(&x0, &below);
            for (i, chosen) in chosen.iter_mut().enumerate() {
                let from = match i {
                    0 => &below,
                    1 => pi,
                    _ => &component[i - 1],
                };
                *chosen = choose(&mask, from, chosen);
            }
            for r in 0..ROWS {
                below[r] += pi[r];
            }
        }
        let [low, pi, mu0, inv0, low0, high0, mu1, inv1, low1, high1] = chosen;
        for r in 0..ROWS {
            let axis = |mu, inv, low, high| Axis {
                mu,
                inv,
                tails: [low, high],
            };
            let v = ((x0[r] + HALF_STEP - low[r]) / pi[r]).clamp(0.0, 1.0);
            x0[r] = axis(mu0[r], inv0[r], low0[r], high0[r]).inverse(simd, v);
            x1[r] = axis(mu1[r], inv1[r], low1[r], high1[r]).inverse(simd, x1[r] + HALF_STEP);
        }
        *u = [x0, x1];
        self.evaluate(simd, scratch, u)
    }

    /// ln q of pairs, and its derivative by each output.
    #[inline(always)]
    pub(super) fn learn<S: Simd>(
        self,
        simd: S,
        out: &[Lanes],
        u: &[Lanes; 2],
        slope: &mut [Lanes],
        scratch: &mut [Lanes],
    ) -> Lanes {
        let n = self.components;
        let log_q = self.weigh(simd, out, u, scratch);
        let (pi, rest) = scratch.split_at(n);
        let (shares, axes) = rest.split_at(n);
        for j in 0..n {
            let (pi, share) = (pi[j], shares[j]);
            let mut by_share = Lanes::default();
            for r in 0..ROWS {
                by_share[r] = share[r] - pi[r];
            }
            slope[j] = by_share;
            for (axis, x) in u.iter().enumerate() {
                let [mu, inv, mass] = [0, 1, 2].map(|i| axes[6 * j + 3 * axis + i]);
                let spread = out[(2 + 2 * axis) * n + j];
                let (mut by_mean, mut by_spread) = (Lanes::default(), Lanes::default());
                for r in 0..ROWS {
                    // μ = ½ + ½ tanh(output), so that 1 − tanh² is 4 μ (1 − μ).
                    let (near, far) = (mu[r], 1.0 - mu[r]);
                    let ts = simd.tanh(spread[r] * (1.0 / 3.0));
                    let z = (x[r] - mu[r]) * inv[r];
                    let (y0, y1) = (near * inv[r], far * inv[r]);
                    let (e0, e1) = (simd.exp(-y0 * y0), simd.exp(-y1 * y1));
                    let edge = 2.0 * FRAC_1_SQRT_PI * inv[r] / mass[r];
                    let d_mean = 2.0 * inv[r] * z - edge * (e0 - e1);
                    let d_spread = 2.0 * z * z - 1.0 + edge * (far * e1 + near * e0);
                    by_mean[r] = share[r] * d_mean * 2.0 * near * far;
                    by_spread[r] = share[r] * d_spread * (1.0 - ts * ts);
                }
                slope[(1 + 2 * axis) * n + j] = by_mean;
                slope[(2 + 2 * axis) * n + j] = by_spread;
            }
        }
        log_q
    }

    /// Shares π, then each component's share of the density at u, then its μ, width and mass along each number; gives ln q.
    #[inline(always)]
    fn weigh<S: Simd>(
        self,
        simd: S,
        out: &[Lanes],
        u: &[Lanes; 2],
        scratch: &mut [Lanes],
    ) -> Lanes {
        let n = self.components;
        let (pi, rest) = scratch.split_at_mut(n);
        let (weights, axes) = rest.split_at_mut(n);
        softmax(simd, &out[..n], pi);
        let mut sum = Lanes::all(LEAST);
        for j in 0..n {
            let (mut weight, mut fall) = (pi[j], Lanes::default());
            for (axis, x) in u.iter().enumerate() {
                let (mean, spread) = (out[(1 + 2 * axis) * n + j], out[(2 + 2 * axis) * n + j]);
                let mut kept = [Lanes::default(); 3];
                for r in 0..ROWS {
                    let a = Axis::new(simd, mean[r], spread[r]);
                    weight[r] *= a.peak();
                    fall[r] += a.fall(x[r]);
                    (kept[0][r], kept[1][r], kept[2][r]) = (a.mu, a.inv, a.mass());
                }
                axes[6 * j + 3 * axis..][..3].copy_from_slice(&kept);
            }
            for r in 0..ROWS {
                weight[r] *= simd.exp(-fall[r]);
                sum[r] += weight[r];
            }
            weights[j] = weight;
        }
        for weight in weights.iter_mut() {
            for r in 0..ROWS {
                weight[r] /= sum[r];
            }
        }
        let mut log_q = Lanes::default();
        for r in 0..ROWS {
            log_q[r] = simd.ln(sum[r]);
        }
        log_q
    }
}
