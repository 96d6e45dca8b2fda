//! The head of `mixture-net`: outputs of the network as a mixture of normals, each a product over the two numbers, cut to
//! [0, 1) and made to integrate to one there.
//!
//! q(u) = Σ_j π_j Π_i N(u_i; μ_ij, σ_ij) / Z_ij,  Z = Φ((1 − μ)/σ) − Φ(−μ/σ),
//! π = softmax(outputs), μ = ½ + ½ tanh(output), σ = 0.1·exp(3 tanh(output/3)), so in (0.005, 2).
//!
//! Means stay in the square: Z is then at least about a tenth, the sum of two positive terms, and never cancels. A sample
//! takes its component by the first number, which is stretched and used again, and each number from the component's
//! inverse distribution; tails are measured from the end that is nearer, where f32 resolves them.

use super::lanes::{BELOW_ONE, HALF_STEP, LANES, at_least, choose, load, part, softmax, store};
use super::math::{FRAC_1_SQRT_PI, erfc, exp, inverse_erfc, ln, tanh};

/// Least density; where all components are as far away, exp would leave f32's range.
const LEAST: f32 = 1e-37;

/// Outputs of the network and what of them is prepared lie as `[value][row]`, `rows` to a value.
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
    fn new(mean: f32, spread: f32) -> Self {
        let mu = 0.5 + 0.5 * tanh(mean);
        let inv = 7.071_068 * exp(-3.0 * tanh(spread * (1.0 / 3.0)));
        Self {
            mu,
            inv,
            tails: [erfc(mu * inv), erfc((1.0 - mu) * inv)],
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
    fn inverse(&self, v: f32) -> f32 {
        let mass = self.mass();
        let (low, high) = (v * mass, (1.0 - v) * mass);
        let left = low < 1.0 - self.tails[0];
        let c = if left {
            self.tails[0] + low
        } else {
            self.tails[1] + high
        };
        let y = inverse_erfc(c.clamp(1e-30, 1.0)) / self.inv;
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

    /// Floats per row that [`Mixture::sample`] and [`Mixture::density`] work in.
    pub(super) fn scratch(self) -> usize {
        PREPARED * self.components
    }

    /// Per component: share, height, then mean, width and both tails along each number.
    #[inline(always)]
    fn prepare(self, rows: usize, out: &[f32], scratch: &mut [f32]) {
        let n = self.components;
        let (pi, rest) = scratch.split_at_mut(n * rows);
        softmax(n, rows, out, pi);
        let out = &out[n * rows..][..4 * n * rows];
        for j in 0..n {
            let row = |v: usize| part(out, v * n + j, rows);
            let (means, spreads) = ([row(0), row(2)], [row(1), row(3)]);
            let mut height = part(pi, j, rows);
            let mine = &mut rest[9 * j * rows..][..9 * rows];
            for (axis, (mean, spread)) in means.iter().zip(&spreads).enumerate() {
                let mut values = [[0.0; LANES]; 4];
                for r in 0..rows {
                    let a = Axis::new(mean[r], spread[r]);
                    height[r] *= a.peak();
                    (values[0][r], values[1][r]) = (a.mu, a.inv);
                    (values[2][r], values[3][r]) = (a.tails[0], a.tails[1]);
                }
                for (i, lanes) in values.iter().enumerate() {
                    store(mine, 1 + 4 * axis + i, lanes, rows);
                }
            }
            store(mine, 0, &height, rows);
        }
    }

    /// Density from what is prepared.
    #[inline(always)]
    fn evaluate(self, rows: usize, prepared: &[f32], [x0, x1]: [&[f32]; 2], q: &mut [f32]) {
        let n = self.components;
        let (x0, x1) = (load(x0, rows), load(x1, rows));
        let mut sum = [LEAST; LANES];
        for mine in prepared[n * rows..].chunks_exact(9 * rows).take(n) {
            let part = |i| part(mine, i, rows);
            let (height, mu0, inv0, mu1, inv1) = (part(0), part(1), part(2), part(5), part(6));
            for r in 0..rows {
                let (z0, z1) = ((x0[r] - mu0[r]) * inv0[r], (x1[r] - mu1[r]) * inv1[r]);
                sum[r] += height[r] * exp(-(z0 * z0 + z1 * z1));
            }
        }
        store(q, 0, &sum, rows);
    }

    /// Densities of pairs.
    #[inline(always)]
    pub(super) fn density(
        self,
        rows: usize,
        out: &[f32],
        u: [&[f32]; 2],
        q: &mut [f32],
        scratch: &mut [f32],
    ) {
        self.prepare(rows, out, scratch);
        self.evaluate(rows, scratch, u, q);
    }

    /// Turns uniform pairs into guided ones, and gives their densities.
    #[inline(always)]
    pub(super) fn sample(
        self,
        rows: usize,
        out: &[f32],
        [u0, u1]: [&mut [f32]; 2],
        q: &mut [f32],
        scratch: &mut [f32],
    ) {
        self.prepare(rows, out, scratch);
        let n = self.components;
        let (pi, rest) = scratch.split_at(n * rows);
        let (mut x0, mut x1) = (load(u0, rows), load(u1, rows));
        let mut below = [0.0; LANES];
        // What a sample wants of its component: where its interval begins, its share, and all that is prepared but the height.
        let mut chosen = [[0.0; LANES]; 10];
        // The last component whose interval begins no higher than the number; chosen by masks, so that rows stay vectors.
        for (j, component) in rest.chunks_exact(9 * rows).take(n).enumerate() {
            let pi = part(pi, j, rows);
            let mask = at_least(rows, &x0, &below);
            for (i, chosen) in chosen.iter_mut().enumerate() {
                let from = match i {
                    0 => below,
                    1 => pi,
                    _ => part(component, i - 1, rows),
                };
                *chosen = choose(rows, &mask, &from, chosen);
            }
            for r in 0..rows {
                below[r] += pi[r];
            }
        }
        let [low, pi, mu0, inv0, low0, high0, mu1, inv1, low1, high1] = chosen;
        for r in 0..rows {
            let axis = |mu, inv, low, high| Axis {
                mu,
                inv,
                tails: [low, high],
            };
            let v = ((x0[r] + HALF_STEP - low[r]) / pi[r]).clamp(0.0, 1.0);
            x0[r] = axis(mu0[r], inv0[r], low0[r], high0[r]).inverse(v);
            x1[r] = axis(mu1[r], inv1[r], low1[r], high1[r]).inverse(x1[r] + HALF_STEP);
        }
        store(u0, 0, &x0, rows);
        store(u1, 0, &x1, rows);
        self.evaluate(rows, scratch, [u0, u1], q);
    }

    /// ln q of pairs, and its derivative by each output.
    #[inline(always)]
    pub(super) fn learn(
        self,
        rows: usize,
        out: &[f32],
        u: [&[f32]; 2],
        log_q: &mut [f32],
        slope: &mut [f32],
        scratch: &mut [f32],
    ) {
        let n = self.components;
        self.weigh(rows, out, u, log_q, scratch);
        let (pi, weights) = scratch.split_at(n * rows);
        let x = u.map(|u| load(u, rows));
        for j in 0..n {
            let row = |v: usize| part(out, v * n + j, rows);
            let (pi, share) = (part(pi, j, rows), part(weights, j, rows));
            let mut by_share = [0.0; LANES];
            for r in 0..rows {
                by_share[r] = share[r] - pi[r];
            }
            store(slope, j, &by_share, rows);
            for (axis, x) in x.iter().enumerate() {
                let (mean, spread) = (row(1 + 2 * axis), row(2 + 2 * axis));
                let (mut by_mean, mut by_spread) = ([0.0; LANES], [0.0; LANES]);
                for r in 0..rows {
                    let (tm, ts) = (tanh(mean[r]), tanh(spread[r] * (1.0 / 3.0)));
                    let a = Axis::new(mean[r], spread[r]);
                    let z = (x[r] - a.mu) * a.inv;
                    let (near, far) = (a.mu, 1.0 - a.mu);
                    let (y0, y1) = (near * a.inv, far * a.inv);
                    let (e0, e1) = (exp(-y0 * y0), exp(-y1 * y1));
                    let edge = 2.0 * FRAC_1_SQRT_PI * a.inv / a.mass();
                    let d_mean = 2.0 * a.inv * z - edge * (e0 - e1);
                    let d_spread = 2.0 * z * z - 1.0 + edge * (far * e1 + near * e0);
                    by_mean[r] = share[r] * d_mean * 0.5 * (1.0 - tm * tm);
                    by_spread[r] = share[r] * d_spread * (1.0 - ts * ts);
                }
                store(slope, (1 + 2 * axis) * n + j, &by_mean, rows);
                store(slope, (2 + 2 * axis) * n + j, &by_spread, rows);
            }
        }
    }

    /// Shares π, then each component's share of the density at u, and ln q.
    #[inline(always)]
    fn weigh(
        self,
        rows: usize,
        out: &[f32],
        [x0, x1]: [&[f32]; 2],
        log_q: &mut [f32],
        scratch: &mut [f32],
    ) {
        let n = self.components;
        let x = [load(x0, rows), load(x1, rows)];
        let (pi, weights) = scratch.split_at_mut(n * rows);
        softmax(n, rows, out, pi);
        let mut sum = [LEAST; LANES];
        for j in 0..n {
            let row = |v: usize| part(out, v * n + j, rows);
            let (mut weight, mut fall) = (part(pi, j, rows), [0.0; LANES]);
            for (axis, x) in x.iter().enumerate() {
                let (mean, spread) = (row(1 + 2 * axis), row(2 + 2 * axis));
                for r in 0..rows {
                    let a = Axis::new(mean[r], spread[r]);
                    weight[r] *= a.peak();
                    fall[r] += a.fall(x[r]);
                }
            }
            for r in 0..rows {
                weight[r] *= exp(-fall[r]);
                sum[r] += weight[r];
            }
            store(weights, j, &weight, rows);
        }
        store(log_q, 0, &sum, rows);
        let log_q = &mut log_q[..rows];
        for weight in weights.chunks_exact_mut(rows).take(n) {
            for (weight, q) in weight.iter_mut().zip(log_q.iter()) {
                *weight /= q;
            }
        }
        log_q.iter_mut().for_each(|q| *q = ln(*q));
    }
}
