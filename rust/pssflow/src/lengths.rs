//! A whole image as a sum of path lengths: how a budget is divided among them.
//!
//! Emission (k = 0), direct light (k = 1) and light of k = 2, 3, … bounces are rendered apart, each with a guide of its
//! own, and added. With V_k the variance of a sample, c_k its cost and n_k samples per pixel, Σ V_k ÷ n_k is smallest at a
//! given Σ n_k·c_k where n_k ∝ sqrt(V_k ÷ c_k) (Neyman's allocation). V and c come from a probe of uniform paths through
//! a grid of pixels whose seed is fixed: one scene always gets one answer, and no path of the probe is in the image. So
//! the shares are fixed before sampling, and the sum is as unbiased as its parts.

use pss_render::{EmitterStrategy, Parametrisation, Scene, Tracer};
use serde::Serialize;

use crate::error::RenderError;
use crate::estimator::thread_pool;
use crate::strategy::{SAMPLES, probe_paths};

/// No length gets less than this share of what it would get if all got the same: the probe may have missed its light, and
/// a guide has its variance lowered by more than others.
const LEAST_SHARE: f64 = 1.0 / 8.0;

/// What a probe saw of one path length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Length {
    /// Bounces; 0 for emitters that the camera sees.
    pub k: usize,
    /// Mean over pixels of the variance of a sample ÷ (mean of all lengths² + ε), ε = (0.1 · image mean)².
    pub variance: f64,
    /// Rays of a path.
    pub rays: f64,
    /// Share of the paths that carry light.
    pub lit: f64,
    /// Mean luminance.
    pub mean: f64,
}

/// Probes all `lengths` with the strategy of each.
///
/// # Errors
/// [`RenderError`] for a k out of range, or if threads cannot be started.
pub fn probe_lengths(
    scene: &Scene,
    lengths: &[(usize, EmitterStrategy)],
    parametrisation: Parametrisation,
    threads: usize,
) -> Result<Vec<Length>, RenderError> {
    let tracers = lengths
        .iter()
        .map(|&(k, strategy)| match k {
            0 => Ok(Tracer::emission(scene)),
            k => Tracer::new(scene, k, parametrisation, strategy),
        })
        .collect::<Result<Vec<_>, _>>()?;
    let probed =
        thread_pool(threads)?.install(|| -> Vec<_> { tracers.iter().map(probe_paths).collect() });
    let n = SAMPLES as usize;
    let paths = probed.first().map_or(0, |(seen, _)| seen.len());
    let mut means = vec![0.0; paths / n];
    for (seen, _) in &probed {
        for (mean, pixel) in means.iter_mut().zip(seen.chunks_exact(n)) {
            *mean += pixel.iter().sum::<f64>() / n as f64;
        }
    }
    let pixels = means.len().max(1) as f64;
    let epsilon = (0.1 * means.iter().sum::<f64>() / pixels).powi(2);
    let length = |(i, (seen, rays)): (usize, &(Vec<f64>, u64))| {
        let spread = |(mean, pixel): (&f64, &[f64])| {
            let own = pixel.iter().sum::<f64>() / n as f64;
            let variance = pixel.iter().map(|x| (x - own).powi(2)).sum::<f64>() / (n - 1) as f64;
            variance / (mean.powi(2) + epsilon).max(f64::MIN_POSITIVE)
        };
        Length {
            k: lengths[i].0,
            variance: means
                .iter()
                .zip(seen.chunks_exact(n))
                .map(spread)
                .sum::<f64>()
                / pixels,
            rays: (*rays as f64 / paths.max(1) as f64).max(1.0),
            lit: seen.iter().filter(|x| **x > 0.0).count() as f64 / paths.max(1) as f64,
            mean: seen.iter().sum::<f64>() / paths.max(1) as f64,
        }
    };
    Ok(probed.iter().enumerate().map(length).collect())
}

/// Samples per pixel of each length, as fractions: together they cost what `spp` of each would.
///
/// No length gets less than an eighth of `spp`; where nothing varies all get the same.
pub fn allot(lengths: &[Length], spp: f64) -> Vec<f64> {
    let least = spp * LEAST_SHARE;
    let wanted: Vec<f64> = lengths
        .iter()
        .map(|l| (l.variance / l.rays).max(0.0).sqrt())
        .collect();
    let mut raised = vec![false; lengths.len()];
    loop {
        let sum = |of: &dyn Fn(usize) -> f64, at_least: bool| -> f64 {
            (0..lengths.len())
                .filter(|&i| raised[i] == at_least)
                .map(of)
                .sum()
        };
        let all: f64 = lengths.iter().map(|l| l.rays * spp).sum();
        let left = all - sum(&|i| lengths[i].rays * least, true);
        let weight = sum(&|i| lengths[i].rays * wanted[i], false);
        if weight <= 0.0 || !weight.is_finite() {
            return vec![spp; lengths.len()];
        }
        let share = |i: usize| {
            if raised[i] {
                least
            } else {
                wanted[i] * left / weight
            }
        };
        let shares: Vec<f64> = (0..lengths.len()).map(share).collect();
        // Raising one lowers all others, so that more may fall below.
        match (0..lengths.len()).find(|&i| !raised[i] && shares[i] < least) {
            Some(_) => {
                for i in 0..lengths.len() {
                    raised[i] |= shares[i] < least;
                }
            }
            None => return shares,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn length(k: usize, variance: f64, rays: f64) -> Length {
        Length {
            k,
            variance,
            rays,
            lit: 1.0,
            mean: 1.0,
        }
    }

    #[test]
    fn the_budget_is_spent_where_it_lowers_the_error_most() {
        let lengths = [
            length(0, 0.01, 1.0),
            length(1, 1.0, 3.0),
            length(2, 16.0, 4.0),
            length(3, 9.0, 5.0),
        ];
        let shares = allot(&lengths, 64.0);
        let cost = |n: &[f64]| -> f64 { lengths.iter().zip(n).map(|(l, n)| l.rays * n).sum() };
        assert!(
            (cost(&shares) / cost(&[64.0; 4]) - 1.0).abs() < 1e-9,
            "{shares:?}"
        );
        assert!(shares.iter().all(|n| *n >= 8.0 - 1e-9), "{shares:?}");
        assert!((shares[0] - 8.0).abs() < 1e-9, "{shares:?}");
        let error = |n: &[f64]| -> f64 { lengths.iter().zip(n).map(|(l, n)| l.variance / n).sum() };
        // No exchange between two lengths at equal cost lowers the error.
        for (i, j) in [(1, 2), (2, 1), (2, 3), (3, 1)] {
            let mut other = shares.clone();
            other[i] += 0.1 / lengths[i].rays;
            other[j] -= 0.1 / lengths[j].rays;
            assert!(error(&other) > error(&shares), "{i} {j}");
        }
    }

    #[test]
    fn where_nothing_varies_all_get_the_same() {
        let lengths = [length(0, 0.0, 1.0), length(1, 0.0, 3.0)];
        assert_eq!(allot(&lengths, 16.0), vec![16.0; 2]);
        let lengths = [length(0, 0.0, 1.0), length(1, 2.0, 3.0)];
        let shares = allot(&lengths, 16.0);
        assert_eq!(shares[0], 2.0);
        assert!((shares[1] - (16.0 + 14.0 / 3.0)).abs() < 1e-9);
    }
}
