//! The head of `spline-net`: the distribution function of each number as a monotone rational-quadratic spline (Gregory and
//! Delbourgo 1982, doi:10.1093/imanum/2.2.123; in flows: Durkan et al. 2019, arXiv:1906.04032, eqs. 4 to 8).
//!
//! A network says widths w, heights h and slopes δ at the borders of K bins of [0, 1). In a bin that begins at
//! (x_k, y_k), with s = h/w, ξ = (x − x_k)/w and ε = ξ(1 − ξ),
//!
//! ```text
//! F(x) = y_k + h (s ξ² + δ_k ε) / M,       M = s (1 − 2ε) + (δ_k + δ_{k+1}) ε
//! q(x) = F'(x) = s² (δ_{k+1} ξ² + 2 s ε + δ_k (1 − ξ)²) / M²
//! w, h = 10⁻³ + (1 − 10⁻³ K) softmax(outputs),   δ = exp(c tanh(output / c)),   c = ln 10³
//! ```
//!
//! The first network decides u₀, the second, which sees u₀, decides u₁: q(u) = q₀(u₀) q₁(u₁ | u₀), an autoregressive
//! coupling. F is the way back, so that densities and training need no root; a sample solves the quadratic equation
//! F(x) = v. The slope is bounded on both sides, where the paper takes softplus and bounds it below: its logarithm then
//! learns at the same rate for sharp and for flat densities.
//!
//! Coordinates are bounded, not periodic: a number is an azimuth in few places only (the first of a whole sphere under the
//! parametrisation `uniform`, the second of some microfacets). A hemisphere takes both through the concentric map of the
//! disk, and under `bsdf` a layered surface spends part of the first on the choice of its lobe.

use pulp::Simd;

use crate::kernel::ROWS;
use crate::kernel::lanes::{BELOW_ONE, HALF_STEP, Lanes, at_least, choose, softmax};
use crate::kernel::math::Functions;

/// Least width and height of a bin.
const LEAST: f32 = 1e-3;

/// ln of the largest slope; that of the smallest is its negative.
const STEEPEST: f32 = 6.907_755;

/// Outputs: logits of widths, logits of heights, slopes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Spline {
    pub(super) bins: usize,
}

/// The bin of each row.
#[derive(Default)]
struct Bin {
    index: Lanes,
    x: Lanes,
    y: Lanes,
    /// Shares of all bins' widths and heights, before the least is added.
    share_w: Lanes,
    share_h: Lanes,
    /// Outputs for the slopes at both borders.
    raw: [Lanes; 2],
}

/// What decides which bin.
#[derive(Clone, Copy, PartialEq, Eq)]
enum By {
    /// A number of the cube.
    X,
    /// A value of its distribution function.
    Y,
}

/// Slope of an output.
#[inline(always)]
fn steep<S: Simd>(simd: S, raw: f32) -> f32 {
    simd.exp(STEEPEST * simd.tanh(raw * (1.0 / STEEPEST)))
}

/// A bin along one row.
#[derive(Clone, Copy)]
struct Piece {
    /// Width, and mean slope.
    w: f32,
    s: f32,
    /// Slopes at its borders.
    d: [f32; 2],
}

impl Piece {
    #[inline(always)]
    fn xi(&self, x: f32) -> f32 {
        (x / self.w).clamp(0.0, 1.0)
    }

    /// N and M of q = s² N / M².
    #[inline(always)]
    fn fraction(&self, xi: f32) -> (f32, f32) {
        let (e, rest) = (xi * (1.0 - xi), 1.0 - xi);
        let n = self.d[1] * xi * xi + 2.0 * self.s * e + self.d[0] * rest * rest;
        let m = self.s * (1.0 - 2.0 * e) + (self.d[0] + self.d[1]) * e;
        (n, m)
    }

    #[inline(always)]
    fn density(&self, x: f32) -> f32 {
        let (n, m) = self.fraction(self.xi(x));
        let ratio = self.s / m;
        ratio * ratio * n
    }

    /// Where the share η of the bin's height is reached: the root of a ξ² + b ξ − s η with a = s − b. Either form of
    /// it adds terms of one sign, as the sign of b decides.
    #[inline(always)]
    fn inverse(&self, eta: f32) -> f32 {
        let b = self.d[0] - eta * (self.d[0] + self.d[1] - 2.0 * self.s);
        let (a, c) = (self.s - b, self.s * eta);
        let root = (b * b + 4.0 * a * c).max(0.0).sqrt();
        let (above, below) = if b > 0.0 {
            (2.0 * c, b + root)
        } else {
            (root - b, 2.0 * a)
        };
        (above / below).clamp(0.0, 1.0)
    }
}

impl Spline {
    pub(super) fn outputs(self) -> usize {
        3 * self.bins + 1
    }

    /// Biases that training starts from: the uniform density.
    pub(super) fn start(self) -> Vec<f32> {
        vec![0.0; self.outputs()]
    }

    /// Values per row that the functions below work in.
    pub(super) fn scratch(self) -> usize {
        2 * self.bins
    }

    /// Width or height of a bin with this share.
    #[inline(always)]
    fn size(self, share: f32) -> f32 {
        LEAST + (1.0 - LEAST * self.bins as f32) * share
    }

    /// The last bin that begins no higher than `at`; chosen by masks, so that rows stay vectors. Leaves the shares in `scratch`.
    #[inline(always)]
    fn find<S: Simd>(
        self,
        simd: S,
        by: By,
        out: &[Lanes],
        at: &Lanes,
        scratch: &mut [Lanes],
    ) -> Bin {
        let n = self.bins;
        let (widths, heights) = scratch.split_at_mut(n);
        softmax(simd, &out[..n], widths);
        softmax(simd, &out[n..2 * n], heights);
        let (mut x, mut y) = (Lanes::default(), Lanes::default());
        let mut bin = Bin::default();
        for j in 0..n {
            let (w, h) = (widths[j], heights[j]);
            let (raw0, raw1) = (out[2 * n + j], out[2 * n + j + 1]);
            let mask = at_least(at, if by == By::X { &x } else { &y });
            bin = Bin {
                index: choose(&mask, &Lanes::all(j as f32), &bin.index),
                x: choose(&mask, &x, &bin.x),
                y: choose(&mask, &y, &bin.y),
                share_w: choose(&mask, &w, &bin.share_w),
                share_h: choose(&mask, &h, &bin.share_h),
                raw: [
                    choose(&mask, &raw0, &bin.raw[0]),
                    choose(&mask, &raw1, &bin.raw[1]),
                ],
            };
            for r in 0..ROWS {
                x[r] += self.size(w[r]);
                y[r] += self.size(h[r]);
            }
        }
        bin
    }

    #[inline(always)]
    fn piece<S: Simd>(self, simd: S, bin: &Bin, r: usize) -> Piece {
        let w = self.size(bin.share_w[r]);
        Piece {
            w,
            s: self.size(bin.share_h[r]) / w,
            d: [steep(simd, bin.raw[0][r]), steep(simd, bin.raw[1][r])],
        }
    }

    /// Densities of one number of each row.
    #[inline(always)]
    pub(super) fn density<S: Simd>(
        self,
        simd: S,
        out: &[Lanes],
        x: &Lanes,
        scratch: &mut [Lanes],
    ) -> Lanes {
        let x = *x;
        let bin = self.find(simd, By::X, out, &x, scratch);
        let mut density = Lanes::default();
        for r in 0..ROWS {
            density[r] = self.piece(simd, &bin, r).density(x[r] - bin.x[r]);
        }
        density
    }

    /// Turns uniform numbers into guided ones, and gives their densities.
    #[inline(always)]
    pub(super) fn sample<S: Simd>(
        self,
        simd: S,
        out: &[Lanes],
        u: &mut Lanes,
        scratch: &mut [Lanes],
    ) -> Lanes {
        let mut x = *u;
        for x in &mut x.0 {
            *x += HALF_STEP;
        }
        let bin = self.find(simd, By::Y, out, &x, scratch);
        let mut density = Lanes::default();
        for r in 0..ROWS {
            let piece = self.piece(simd, &bin, r);
            let eta = (x[r] - bin.y[r]) / self.size(bin.share_h[r]);
            let to = bin.x[r] + piece.w * piece.inverse(eta.clamp(0.0, 1.0));
            x[r] = to.clamp(0.0, BELOW_ONE);
            // That of the number as rounded: it is what the caller gets.
            density[r] = piece.density(x[r] - bin.x[r]);
        }
        *u = x;
        density
    }

    /// ln q of one number of each row, and its derivative by each output.
    #[inline(always)]
    pub(super) fn learn<S: Simd>(
        self,
        simd: S,
        out: &[Lanes],
        x: &Lanes,
        slope: &mut [Lanes],
        scratch: &mut [Lanes],
    ) -> Lanes {
        let n = self.bins;
        let rest = 1.0 - LEAST * n as f32;
        let x = *x;
        let bin = self.find(simd, By::X, out, &x, scratch);
        let (mut log, zero) = (Lanes::default(), Lanes::default());
        // By the bin's width, by its height, by where it begins, and by the outputs for both slopes.
        let (mut by_w, mut by_h, mut by_x, mut by_raw) = (zero, zero, zero, [zero; 2]);
        // Means of the derivatives by widths and by heights, weighted by the shares.
        let (mut mean_w, mut mean_h) = (zero, zero);
        for r in 0..ROWS {
            let piece = self.piece(simd, &bin, r);
            let Piece { w, s, d } = piece;
            let xi = piece.xi(x[r] - bin.x[r]);
            let (a, b) = piece.fraction(xi);
            let (e, rest_xi) = (xi * (1.0 - xi), 1.0 - xi);
            let (ia, ib) = (1.0 / a, 2.0 / b);
            log[r] = 2.0 * simd.ln(s / b) + simd.ln(a);
            let by_s = 2.0 / s + 2.0 * e * ia - (1.0 - 2.0 * e) * ib;
            let by_xi = 2.0 * (d[1] * xi + s * (1.0 - 2.0 * xi) - d[0] * rest_xi) * ia
                - (d[0] + d[1] - 2.0 * s) * (1.0 - 2.0 * xi) * ib;
            by_raw[0][r] = (rest_xi * rest_xi * ia - e * ib) * d[0];
            by_raw[1][r] = (xi * xi * ia - e * ib) * d[1];
            for (by, raw) in by_raw.iter_mut().zip(&bin.raw) {
                let t = simd.tanh(raw[r] * (1.0 / STEEPEST));
                by[r] *= 1.0 - t * t;
            }
            let iw = 1.0 / w;
            by_h[r] = by_s * iw;
            by_w[r] = -(by_s * s + by_xi * xi) * iw;
            by_x[r] = -by_xi * iw;
            let below = (bin.x[r] - LEAST * bin.index[r]) / rest;
            mean_w[r] = by_x[r] * below + by_w[r] * bin.share_w[r];
            mean_h[r] = by_h[r] * bin.share_h[r];
        }
        let (widths, heights) = scratch.split_at(n);
        for j in 0..=n {
            let at = j as f32;
            if j < n {
                let (w, h) = (widths[j], heights[j]);
                let (mut own_w, mut own_h) = (zero, zero);
                for r in 0..ROWS {
                    let here = at == bin.index[r];
                    let before = if at < bin.index[r] { by_x[r] } else { 0.0 };
                    let moved = if here { by_w[r] } else { before };
                    let raised = if here { by_h[r] } else { 0.0 };
                    own_w[r] = rest * w[r] * (moved - mean_w[r]);
                    own_h[r] = rest * h[r] * (raised - mean_h[r]);
                }
                slope[j] = own_w;
                slope[n + j] = own_h;
            }
            let mut own = zero;
            for r in 0..ROWS {
                let left = if at == bin.index[r] {
                    by_raw[0][r]
                } else {
                    0.0
                };
                own[r] = if at == bin.index[r] + 1.0 {
                    by_raw[1][r]
                } else {
                    left
                };
            }
            slope[2 * n + j] = own;
        }
        log
    }
}
