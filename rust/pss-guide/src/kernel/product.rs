//! Matrix product for training: C = A · B with A of any strides.
//!
//! The layers' products are small and many. candle's own `matmul` asks the system for its number of
//! cores at every call (it reads `/proc/cpuinfo`), which costs more than the product itself.
//! The forward product, Xᵀ·G and G·Wᵀ are all this one function. Each element is summed in order of k,
//! so that results do not depend on the number of rows.

use pulp::{Simd, WithSimd};

use super::dispatch;

/// A matrix seen through strides: element (i, j) is `values[i * row + j * column]`.
#[derive(Clone, Copy)]
pub(crate) struct Strided<'a> {
    pub(crate) values: &'a [f32],
    pub(crate) row: usize,
    pub(crate) column: usize,
}

impl<'a> Strided<'a> {
    /// A row-major matrix with `columns` columns.
    pub(crate) fn rows(values: &'a [f32], columns: usize) -> Self {
        Self {
            values,
            row: columns,
            column: 1,
        }
    }

    /// The transpose of a row-major matrix with `columns` columns.
    pub(crate) fn transposed(values: &'a [f32], columns: usize) -> Self {
        Self {
            values,
            row: 1,
            column: columns,
        }
    }
}

/// C (m, n) = A (m, k) · B (k, n), C row-major.
pub(crate) fn multiply(c: &mut [f32], [m, k, n]: [usize; 3], a: Strided<'_>, b: Strided<'_>) {
    dispatch(Product { c, m, k, n, a, b });
}

struct Product<'a, 'c> {
    c: &'c mut [f32],
    m: usize,
    k: usize,
    n: usize,
    a: Strided<'a>,
    b: Strided<'a>,
}

impl WithSimd for Product<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        let (mut panel, mut tile) = (Vec::new(), vec![0.0; 16 * S::F32_LANES]);
        let (panel, tile) = (&mut panel, &mut tile);
        let mut first = 0;
        while first < self.n {
            // Sums, the vectors of B and a number of A together fit 32 registers of AVX-512, and 16 elsewhere.
            let vectors = (self.n - first).div_ceil(S::F32_LANES);
            first += S::F32_LANES
                * match (S::F32_LANES, vectors) {
                    (16, 3..) => self.panel::<S, 5, 3>(simd, panel, tile, first),
                    (16, 2) => self.panel::<S, 8, 2>(simd, panel, tile, first),
                    (_, 2..) => self.panel::<S, 5, 2>(simd, panel, tile, first),
                    _ => self.panel::<S, 10, 1>(simd, panel, tile, first),
                };
        }
    }
}

impl Product<'_, '_> {
    /// Columns `first ..` of C, V vectors of them, R rows at a time. Returns V.
    #[inline(always)]
    #[allow(
        clippy::needless_range_loop,
        clippy::manual_memcpy,
        reason = "indices are inlined wherever this is compiled, iterators only where the compiler likes"
    )]
    fn panel<S: Simd, const R: usize, const V: usize>(
        &mut self,
        simd: S,
        panel: &mut Vec<f32>,
        tile: &mut [f32],
        first: usize,
    ) -> usize {
        let width = V * S::F32_LANES;
        let used = width.min(self.n - first);
        panel.clear();
        panel.resize(self.k * width, 0.0);
        for (i, row) in panel.chunks_exact_mut(width).enumerate() {
            let start = i * self.b.row + first * self.b.column;
            if self.b.column == 1 {
                row[..used].copy_from_slice(&self.b.values[start..start + used]);
            } else {
                let column = self.b.values[start..].iter().step_by(self.b.column);
                row[..used]
                    .iter_mut()
                    .zip(column)
                    .for_each(|(to, &from)| *to = from);
            }
        }
        let (b, _) = pulp::as_arrays::<V, _>(S::as_simd_f32s(panel).0);
        let b = &b[..self.k];
        for top in (0..self.m).step_by(R) {
            let mut sum = [[simd.splat_f32s(0.0); V]; R];
            // Rows beyond the last repeat it; their sums are not stored.
            let mut rows = [self.a.values; R];
            for r in 0..R {
                rows[r] = &self.a.values[(top + r).min(self.m - 1) * self.a.row..];
            }
            for i in 0..self.k {
                let b = b[i];
                for r in 0..R {
                    // No check that may fail: with one the sums would have to be in memory.
                    let a = rows[r].get(i * self.a.column).copied();
                    let a = simd.splat_f32s(a.unwrap_or_default());
                    for v in 0..V {
                        sum[r][v] = simd.mul_add_e_f32s(a, b[v], sum[r][v]);
                    }
                }
            }
            // By way of a buffer: sums that a variable picks would have to be in memory from the start.
            let (stored, _) = pulp::as_arrays_mut::<V, _>(S::as_mut_simd_f32s(tile).0);
            for r in 0..R {
                stored[r] = sum[r];
            }
            for (r, row) in tile
                .chunks_exact(width)
                .take(R.min(self.m - top))
                .enumerate()
            {
                self.c[(top + r) * self.n + first..][..used].copy_from_slice(&row[..used]);
            }
        }
        V
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pss_rng::{Purpose, Stream};

    #[test]
    fn products_of_all_shapes_agree_with_the_definition() {
        let mut numbers = Stream::new(3, Purpose::Test).sequence(0, 0);
        for m in [1, 2, 3, 9, 10, 11, 23] {
            for k in [1, 2, 5, 40] {
                for n in [1, 3, 5, 8, 9, 16, 40, 41, 83] {
                    let mut random =
                        |n| (0..n).map(|_| numbers.next_f32() - 0.5).collect::<Vec<_>>();
                    let (a, b, mut c) = (random(m * k), random(k * n), random(m * n));
                    for (at, bt) in [(false, false), (true, false), (false, true)] {
                        let view = |v, t, rows: usize, columns: usize| {
                            if t {
                                Strided::transposed(v, rows)
                            } else {
                                Strided::rows(v, columns)
                            }
                        };
                        let (sa, sb) = (view(&a, at, m, k), view(&b, bt, k, n));
                        multiply(&mut c, [m, k, n], sa, sb);
                        for (i, j) in (0..m).flat_map(|i| (0..n).map(move |j| (i, j))) {
                            let get = |s: Strided<'_>, i, j| {
                                f64::from(s.values[i * s.row + j * s.column])
                            };
                            let want: f64 = (0..k).map(|l| get(sa, i, l) * get(sb, l, j)).sum();
                            let error = (f64::from(c[i * n + j]) - want).abs();
                            // Rounding: k additions of numbers below 1/4.
                            assert!(
                                error < 1e-6 * k as f64,
                                "{m}×{k}×{n} at ({i}, {j}): off by {error}"
                            );
                        }
                    }
                }
            }
        }
    }
}
