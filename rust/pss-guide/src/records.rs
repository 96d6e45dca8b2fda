//! Pilot paths as training data.

use std::ops::Range;

use pss_rng::{Purpose, Stream};
use rayon::prelude::*;

use crate::{Context, Decision, Guide, GuideError};

/// An emitter as guides see it: how the emitter's number chooses it, and what kind of light it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Emitter {
    /// Upper end of the interval of [0, 1) that chooses it; the lower end is the emitter's before it.
    pub cdf: f32,
    /// Whether it surrounds the scene, so that what of it is seen depends on the surface's normal.
    pub environment: bool,
}

/// Paths to learn from, one row each.
///
/// | field      | shape      | meaning                                                                        |
/// |------------|------------|--------------------------------------------------------------------------------|
/// | `u`        | `(n, d)`   | primary numbers, row-major                                                     |
/// | `f`        | `n`        | luminance of the undivided contribution, both terms                            |
/// | `f_bsdf`   | `n` or 0   | the part of it that the emitter's and the light's numbers do not decide        |
/// | `f_max`    | `n`        | its largest RGB component                                                      |
/// | `ray`      | `n` or 0   | the two numbers of the BSDF-sampled ray at x_k                                 |
/// | `g`        | `n`        | density that `u` was drawn from, times the share of such paths that was kept   |
/// | `g_bsdf`   | `n` or 0   | the same for the numbers that f_bsdf uses: the directions' and the ray's       |
/// | `g_both`   | `n` or 0   | the same for all numbers                                                       |
/// | `contexts` | `(n, k)` or 0 | x₁ … x_k; the last one's `emitter` is the one chosen                        |
/// | `pixel`    | `n` or 0   | film position in [0, 1)²                                                       |
///
/// Where `g_bsdf` or `g_both` is empty it is `g`, as of uniform numbers. Only non-zero paths need be given: zeros carry no gradient and are counted in `zeros`, so that the mean of f is
/// Σ f/g ÷ (n + zeros). `Default` has no path.
#[derive(Clone, Copy, Debug, Default)]
pub struct Records<'a> {
    /// Numbers per path.
    pub dims: usize,
    /// Primary numbers, `n · dims`.
    pub u: &'a [f32],
    /// Luminances, `n`.
    pub f: &'a [f32],
    /// Luminances of the BSDF-sampled term, `n` (or none where there is no such term).
    pub f_bsdf: &'a [f32],
    /// Largest RGB components, `n`.
    pub f_max: &'a [f32],
    /// Numbers of the BSDF-sampled ray, `n` (or none).
    pub ray: &'a [[f32; 2]],
    /// Densities of `u`, `n`.
    pub g: &'a [f32],
    /// Densities of the numbers that the BSDF-sampled term uses, `n` (or none: the same as `g`).
    pub g_bsdf: &'a [f32],
    /// Densities of all numbers, `n` (or none: the same as `g`).
    pub g_both: &'a [f32],
    /// Vertices, `n · k` (or none).
    pub contexts: &'a [Context],
    /// Film positions, `n` (or none).
    pub pixel: &'a [[f32; 2]],
    /// The scene's emitters in the order of the emitter's number (or none: one, of area).
    pub emitters: &'a [Emitter],
    /// Paths drawn that are not given: those without light, and those that thinning left out.
    pub zeros: u64,
}

/// What [`Records`] borrows, row by row; columns as there.
#[derive(Clone, Debug, Default)]
pub struct OwnedRecords {
    /// As in [`Records`].
    pub u: Vec<f32>,
    /// As in [`Records`].
    pub f: Vec<f32>,
    /// As in [`Records`].
    pub f_bsdf: Vec<f32>,
    /// As in [`Records`].
    pub f_max: Vec<f32>,
    /// As in [`Records`].
    pub ray: Vec<[f32; 2]>,
    /// As in [`Records`].
    pub g: Vec<f32>,
    /// As in [`Records`].
    pub g_bsdf: Vec<f32>,
    /// As in [`Records`].
    pub g_both: Vec<f32>,
    /// As in [`Records`].
    pub contexts: Vec<Context>,
    /// As in [`Records`].
    pub pixel: Vec<[f32; 2]>,
}

impl OwnedRecords {
    /// What a guide learns from: these rows of so many numbers each, and `zeros` paths that are not given.
    pub fn view<'a>(&'a self, dims: usize, emitters: &'a [Emitter], zeros: u64) -> Records<'a> {
        Records {
            dims,
            u: &self.u,
            f: &self.f,
            f_bsdf: &self.f_bsdf,
            f_max: &self.f_max,
            ray: &self.ray,
            g: &self.g,
            g_bsdf: &self.g_bsdf,
            g_both: &self.g_both,
            contexts: &self.contexts,
            pixel: &self.pixel,
            emitters,
            zeros,
        }
    }

    /// Copies a row.
    pub(crate) fn push(&mut self, records: &Records<'_>, row: usize) {
        let (d, k) = (records.dims, records.bounces());
        self.u.extend_from_slice(&records.u[row * d..][..d]);
        self.f.push(records.f[row]);
        self.f_max.push(records.f_max[row]);
        self.g.push(records.g[row]);
        self.f_bsdf.extend(records.f_bsdf.get(row));
        self.ray.extend(records.ray.get(row));
        self.g_bsdf.extend(records.g_bsdf.get(row));
        self.g_both.extend(records.g_both.get(row));
        let vertices = records.contexts.get(row * k..(row + 1) * k);
        self.contexts.extend(vertices.unwrap_or_default());
        self.pixel.extend(records.pixel.get(row));
    }
}

/// One path's luminances and the densities of the numbers that each term uses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Terms {
    pub(crate) f_nee: f64,
    pub(crate) f_bsdf: f64,
    pub(crate) g: f64,
    pub(crate) g_bsdf: f64,
    pub(crate) g_both: f64,
}

impl Terms {
    /// Estimate of ∫f_nee² over all numbers.
    pub(crate) fn nee_square(&self) -> f64 {
        self.f_nee * self.f_nee / self.g
    }

    /// Estimate of ∫f_bsdf² over the directions' numbers and the ray's.
    pub(crate) fn bsdf_square(&self) -> f64 {
        self.f_bsdf * self.f_bsdf / self.g_bsdf
    }

    /// Estimate of ∫2 f_nee f_bsdf, which needs all numbers.
    pub(crate) fn product(&self) -> f64 {
        2.0 * self.f_nee * self.f_bsdf / self.g_both
    }

    /// Estimate of ∫f².
    pub(crate) fn square(&self) -> f64 {
        self.nee_square() + self.bsdf_square() + self.product()
    }

    /// Estimate of ∫f.
    pub(crate) fn value(&self) -> f64 {
        self.f_nee / self.g + self.f_bsdf / self.g_bsdf
    }
}

/// Reused buffers of a chunk of rows.
#[derive(Default)]
struct Scratch {
    u: Vec<f32>,
    contexts: Vec<Context>,
    each: Vec<f32>,
}

/// Rows that survive cleaning.
#[derive(Debug)]
pub(crate) struct Usable {
    /// Indices of the rows.
    pub(crate) rows: Vec<usize>,
    /// Resampling weight f_max/g of each.
    pub(crate) weights: Vec<f64>,
    /// Rows that were not finite.
    pub(crate) nonfinite: usize,
    /// Rows above the quantile.
    pub(crate) outliers: usize,
}

impl Records<'_> {
    /// Bounces k of paths with 2k + 1 numbers.
    pub fn bounces(&self) -> usize {
        self.dims.saturating_sub(1) / 2
    }

    /// A row's terms: f_nee, f_bsdf, and the densities that belong to them.
    pub(crate) fn terms(&self, row: usize) -> Terms {
        let f_bsdf = self.f_bsdf.get(row).map_or(0.0, |&f| f64::from(f).max(0.0));
        let [g, g_bsdf, g_both] = self.densities(row).map(f64::from);
        Terms {
            f_nee: (f64::from(self.f[row]) - f_bsdf).max(0.0),
            f_bsdf,
            g,
            g_bsdf,
            g_both,
        }
    }

    /// A row's `g`, `g_bsdf` and `g_both`.
    pub(crate) fn densities(&self, row: usize) -> [f32; 3] {
        let g = self.g[row];
        [self.g, self.g_bsdf, self.g_both].map(|all| *all.get(row).unwrap_or(&g))
    }

    /// The numbers of a decision whose columns are `columns`.
    pub(crate) fn numbers(&self, decision: Decision, row: usize, columns: Range<usize>) -> &[f32] {
        match decision {
            Decision::Ray => &self.ray[row],
            _ => &self.u[row * self.dims..][columns],
        }
    }

    /// A path's vertex, counted from 0; the default where no vertices are known.
    pub(crate) fn context(&self, row: usize, vertex: usize) -> Context {
        let at = row * self.bounces() + vertex;
        self.contexts.get(at).copied().unwrap_or_default()
    }

    /// A path's film position; the corner where none is known.
    pub(crate) fn pixel(&self, row: usize) -> [f32; 2] {
        self.pixel.get(row).copied().unwrap_or_default()
    }

    /// What is known where a decision is taken: of a whole path the film position alone.
    pub(crate) fn known(&self, decision: Decision, row: usize, vertex: usize) -> Context {
        if decision == Decision::Path {
            return Context {
                pixel: self.pixel(row),
                ..Context::default()
            };
        }
        self.context(row, vertex)
    }

    /// Whether all that a row holds is finite, its densities positive and its numbers in the cube.
    pub(crate) fn is_sound(&self, row: usize) -> bool {
        self.f[row].is_finite()
            && self.f_max[row].is_finite()
            && self.f_bsdf.get(row).is_none_or(|f| f.is_finite())
            && self
                .densities(row)
                .iter()
                .all(|&g| g.is_finite() && g > 0.0)
            && self
                .ray
                .get(row)
                .is_none_or(|u| u.iter().all(|u| (0.0..1.0).contains(u)))
            && self.u[row * self.dims..(row + 1) * self.dims]
                .iter()
                .all(|u| (0.0..1.0).contains(u))
    }

    /// Paths drawn, those without light among them.
    pub(crate) fn paths(&self) -> f64 {
        self.f.len() as f64 + self.zeros as f64
    }

    /// The columns of a decision, for each vertex where it is taken; those of the ray are counted by themselves, and it is
    /// taken nowhere where no path has it.
    pub(crate) fn columns(
        &self,
        decision: Decision,
    ) -> impl Iterator<Item = (usize, Range<usize>)> + use<> {
        let (k, dims) = (self.bounces(), self.dims);
        let last = k.saturating_sub(1)..k;
        let vertices = match decision {
            Decision::Path => 0..1,
            Decision::Direction => 0..k.saturating_sub(1),
            Decision::Ray if self.ray.is_empty() => k..k,
            Decision::Emitter | Decision::Light | Decision::Ray => last,
        };
        let at = move |vertex: usize| match decision {
            Decision::Path => 0..dims,
            Decision::Direction => vertex * 2..vertex * 2 + 2,
            Decision::Emitter => 2 * k - 2..2 * k - 1,
            Decision::Light => 2 * k - 1..2 * k + 1,
            Decision::Ray => 0..2,
        };
        vertices.map(move |vertex| (vertex, at(vertex)))
    }

    /// Multiplies into `q` the guide's density of one decision.
    pub(crate) fn multiply_density(&self, guide: &dyn Guide, decision: Decision, q: &mut [f32]) {
        const CHUNK: usize = 4096;
        for (vertex, columns) in self.columns(decision) {
            let chunks = q.par_chunks_mut(CHUNK).enumerate();
            chunks.for_each_init(Scratch::default, |scratch, (i, q)| {
                let Scratch { u, contexts, each } = scratch;
                let rows = i * CHUNK..i * CHUNK + q.len();
                u.clear();
                contexts.clear();
                for row in rows.clone() {
                    u.extend_from_slice(self.numbers(decision, row, columns.clone()));
                }
                if guide.looks_at_contexts(decision) {
                    contexts.extend(rows.map(|row| self.known(decision, row, vertex)));
                }
                each.clear();
                each.resize(q.len(), 1.0);
                guide.density(decision, contexts, u, each);
                q.iter_mut().zip(each).for_each(|(q, each)| *q *= *each);
            });
        }
    }

    /// Drops zeros, what is not finite, and what is brighter than the quantile `keep` of the rest.
    pub(crate) fn usable(&self, keep: f64) -> Result<Usable, GuideError> {
        let rows = self.f_max.len();
        let shape = |array, found, expected| {
            if found == expected {
                return Ok(());
            }
            Err(GuideError::Shape {
                array,
                found,
                expected,
                rows,
                dims: self.dims,
            })
        };
        shape("u", self.u.len(), rows.saturating_mul(self.dims))?;
        shape("f", self.f.len(), rows)?;
        shape("g", self.g.len(), rows)?;
        for (array, found, expected) in [
            ("pixel", self.pixel.len(), rows),
            ("f_bsdf", self.f_bsdf.len(), rows),
            ("ray", self.ray.len(), rows),
            ("g_bsdf", self.g_bsdf.len(), rows),
            ("g_both", self.g_both.len(), rows),
            ("contexts", self.contexts.len(), rows * self.bounces()),
        ] {
            if found > 0 {
                shape(array, found, expected)?;
            }
        }

        let (mut kept, mut nonfinite) = (Vec::with_capacity(rows), 0);
        for r in 0..rows {
            if !self.is_sound(r) {
                nonfinite += 1;
            } else if self.f_max[r] > 0.0 {
                kept.push(r);
            }
        }

        let before = kept.len();
        if let Some(limit) = quantile(kept.iter().map(|&r| self.f_max[r]), keep) {
            kept.retain(|&r| self.f_max[r] <= limit);
        }
        if kept.len() < 2 {
            return Err(GuideError::TooFewPaths {
                usable: kept.len(),
                given: rows,
                nonfinite,
                zeros: self.zeros,
            });
        }
        let weights = kept
            .iter()
            .map(|&r| f64::from(self.f_max[r]) / f64::from(self.g[r]))
            .collect();
        Ok(Usable {
            outliers: before - kept.len(),
            rows: kept,
            weights,
            nonfinite,
        })
    }
}

impl Usable {
    /// `n` rows drawn with replacement in proportion to their weights.
    pub(crate) fn resample(&self, n: usize, seed: u64) -> Vec<usize> {
        let mut sum = 0.0;
        let cumulative: Vec<f64> = self
            .weights
            .iter()
            .map(|w| {
                sum += w;
                sum
            })
            .collect();
        let mut numbers = Stream::new(seed, Purpose::Training).sequence(0, 0);
        (0..n)
            .map(|_| {
                let x = numbers.next_f64() * sum;
                let at = cumulative.partition_point(|&c| c <= x);
                self.rows[at.min(self.rows.len() - 1)]
            })
            .collect()
    }
}

/// Rows with their weights in training, none of which counts more than a quantile of all.
#[derive(Debug)]
pub(crate) struct Clipped {
    /// Rows and weights in (0, `limit`].
    pub(crate) rows: Vec<(usize, f64)>,
    /// The quantile; 1 where there is no row.
    pub(crate) limit: f64,
    /// Rows that weighed more.
    pub(crate) count: usize,
}

impl Clipped {
    /// Of `rows` those whose weight is positive and finite.
    pub(crate) fn new(
        rows: impl Iterator<Item = usize>,
        weight: impl Fn(usize) -> f64,
        clip: f64,
    ) -> Self {
        let mut rows: Vec<(usize, f64)> = rows.map(|row| (row, weight(row))).collect();
        rows.retain(|r| r.1 > 0.0 && r.1.is_finite());
        let limit = quantile(rows.iter().map(|r| r.1), clip).unwrap_or(1.0);
        let mut count = 0;
        for (_, weight) in rows.iter_mut().filter(|r| r.1 > limit) {
            *weight = limit;
            count += 1;
        }
        Self { rows, limit, count }
    }
}

/// The value that a share `p` of all values does not exceed.
pub(crate) fn quantile<T: PartialOrd + Copy>(values: impl Iterator<Item = T>, p: f64) -> Option<T> {
    let mut values: Vec<T> = values.collect();
    if values.is_empty() {
        return None;
    }
    let at = ((p * values.len() as f64).ceil() as usize).clamp(1, values.len()) - 1;
    let order = |a: &T, b: &T| a.partial_cmp(b).unwrap_or(std::cmp::Ordering::Equal);
    Some(*values.select_nth_unstable_by(at, order).1)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn records<'a>(u: &'a [f32], f: &'a [f32], g: &'a [f32]) -> Records<'a> {
        Records {
            dims: 1,
            u,
            f,
            f_max: f,
            g,
            zeros: 3,
            ..Records::default()
        }
    }

    #[test]
    fn rows_that_are_not_finite_are_dropped_and_counted() {
        let u = [0.1, 0.2, 0.3, 1.0, 0.5, 0.6, 0.7];
        let f = [1.0, f32::NAN, 2.0, 1.0, f32::INFINITY, 0.0, 1.0];
        let g = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0];
        let usable = records(&u, &f, &g).usable(1.0).unwrap();
        assert_eq!(usable.rows, [0, 2]);
        assert_eq!(usable.nonfinite, 4);
    }

    #[test]
    fn outliers_are_the_brightest_rows() {
        let u = vec![0.5; 1000];
        let f: Vec<f32> = (1..=1000).map(|i| i as f32).collect();
        let g = vec![1.0; 1000];
        let usable = records(&u, &f, &g).usable(0.999).unwrap();
        assert_eq!(usable.outliers, 1);
        assert_eq!(usable.rows.last(), Some(&998));
    }

    #[test]
    fn one_path_is_too_few_and_the_error_says_what_to_do() {
        let error = records(&[0.5], &[1.0], &[1.0]).usable(1.0).unwrap_err();
        assert_eq!(
            error.to_string(),
            "1 usable non-zero paths among 1 given (0 not finite, 3 zeros): a guide needs at least 2. \
             Give the pilot more samples, or render with guide `none`"
        );
    }

    #[test]
    fn arrays_of_different_length_are_refused() {
        let error = records(&[0.5, 0.6], &[1.0, 1.0], &[1.0])
            .usable(1.0)
            .unwrap_err();
        assert_eq!(
            error.to_string(),
            "records: `g` holds 1 values, but 2 belong to 2 paths of 1 numbers"
        );
    }

    #[test]
    fn resampling_is_in_proportion_to_the_weights() {
        let u = [0.1, 0.2, 0.3];
        let f = [1.0, 2.0, 3.0];
        let g = [1.0, 1.0, 0.5];
        let rows = records(&u, &f, &g).usable(1.0).unwrap().resample(90_000, 4);
        // Weights 1 : 2 : 6; binomial counts within five standard errors.
        for (row, share) in [1.0f64 / 9.0, 2.0 / 9.0, 6.0 / 9.0].into_iter().enumerate() {
            let count = rows.iter().filter(|&&r| r == row).count() as f64;
            let se = (90_000.0 * share * (1.0 - share)).sqrt();
            assert!(
                (count - 90_000.0 * share).abs() < 5.0 * se,
                "row {row}: {count}"
            );
        }
    }
}
