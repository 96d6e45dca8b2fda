//! Matrix product for training: C = A · B with A of any strides.
//!
//! The layers' products are small and many. candle's own `matmul` asks the system for its number of
//! cores at every call (it reads `/proc/cpuinfo`), which costs more than the product itself.
//! The forward product, Xᵀ·G and G·Wᵀ are all this one function. Each element is summed in order of k,
//! so that results do not depend on the number of rows.

use pulp::{Simd, WithSimd};

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
    super::dispatch(Product { c, m, k, n, a, b });
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
        let mut panel = Vec::new();
        let mut first = 0;
        while first < self.n {
            // 2 × 5 or 10 × 1 vectors of sums: both fit sixteen registers. 40 units are one panel of AVX.
            if self.n - first > S::F32_LANES {
                self.panel::<S, 2, 5>(simd, &mut panel, first);
                first += 5 * S::F32_LANES;
            } else {
                self.panel::<S, 10, 1>(simd, &mut panel, first);
                first += S::F32_LANES;
            }
        }
    }
}

impl Product<'_, '_> {
    /// Columns `first ..` of C, V vectors of them, R rows at a time.
    #[inline(always)]
    fn panel<S: Simd, const R: usize, const V: usize>(
        &mut self,
        simd: S,
        panel: &mut Vec<f32>,
        first: usize,
    ) {
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
        let mut rows = vec![[0.0; R]; self.k];
        let (b, _) = pulp::as_arrays::<V, _>(S::as_simd_f32s(panel).0);
        for top in (0..self.m).step_by(R) {
            let mut sum = [[simd.splat_f32s(0.0); V]; R];
            // Rows beyond the last repeat it; their sums are not stored.
            for r in 0..R {
                let start = (top + r).min(self.m - 1) * self.a.row;
                let row = self.a.values[start..].iter().step_by(self.a.column);
                rows.iter_mut()
                    .zip(row)
                    .for_each(|(to, &from)| to[r] = from);
            }
            for (a, b) in rows.iter().zip(b) {
                for (sum, &a) in sum.iter_mut().zip(a) {
                    let a = simd.splat_f32s(a);
                    for (sum, &b) in sum.iter_mut().zip(b) {
                        *sum = simd.mul_add_e_f32s(a, b, *sum);
                    }
                }
            }
            for (r, sum) in sum.iter().enumerate().take(self.m - top) {
                let c = &mut self.c[(top + r) * self.n + first..][..used];
                let (whole, rest) = S::as_mut_simd_f32s(c);
                let full = whole.len();
                whole.copy_from_slice(&sum[..full]);
                if let Some(last) = sum.get(full) {
                    let last = [*last];
                    let floats: &[f32] = pulp::bytemuck::cast_slice(&last);
                    rest.copy_from_slice(&floats[..rest.len()]);
                }
            }
        }
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
