//! A whole image as a sum of path lengths: how a budget is divided among them.
//!
//! Emission (k = 0), direct light (k = 1) and light of k = 2, 3, … bounces are rendered apart, each with a guide of its
//! own, and added. With V_k the variance of a sample, c_k its cost and n_k samples per pixel, Σ V_k ÷ n_k is smallest at a
//! given Σ n_k·c_k where n_k ∝ sqrt(V_k ÷ c_k) (Neyman's allocation). V and c come from a probe of uniform paths through
//! a grid of pixels whose seed is fixed: one scene always gets one answer, and no path of the probe is in the image. So
//! the shares are fixed before sampling, and the sum is as unbiased as its parts.
//!
//! Russian roulette as a walk that adds light at every vertex has it, ending paths by their throughput, has no place here:
//! a render of one k needs its paths to arrive, and where all fade alike ending some would only draw fewer of them, which
//! the allotment does without noise. What it is for, that long paths need not all be traced, is had by shares of less than
//! one sample a pixel ([`allot`], `Options::survival`).

use pss_render::{EmitterStrategy, Parametrisation, Scene, Tracer};
use serde::Serialize;

use crate::error::RenderError;
use crate::estimator::thread_pool;
use crate::strategy::{SAMPLES, probe_paths};

/// No length gets less than this share of what it would get if all got the same: the probe may have missed its light, and
/// a guide has its variance lowered by more than others.
const LEAST_SHARE: f64 = 1.0 / 8.0;

/// What a probe saw of one path length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Length {
    /// Bounces; 0 for emitters that the camera sees.
    pub k: usize,
    /// Mean over pixels of the variance of a sample ÷ (mean of all lengths² + ε), ε = (0.1 · image mean)².
    pub variance: f64,
    /// Mean over pixels of the length's mean² ÷ the same.
    pub square: f64,
    /// Rays of a path.
    pub rays: f64,
    /// Share of the paths that carry light.
    pub lit: f64,
    /// Mean luminance.
    pub mean: f64,
}

/// Lengths behind `rr_depth` that are probed, too; those behind them are foretold from the last two.
const PROBED_BEHIND: usize = 2;

/// The longest length that is probed where roulette begins behind `rr_depth`.
pub fn last_probed(rr_depth: usize) -> usize {
    rr_depth + PROBED_BEHIND
}

/// Probes `lengths`, which increase, with the strategy of each. Of those far behind `rr_depth`, on which little is spent, it
/// is foretold what they are like: looking would cost more than it brings.
///
/// # Errors
/// [`RenderError`] for a k out of range, or if threads cannot be started.
pub fn probe_lengths(
    scene: &Scene,
    lengths: &[(usize, EmitterStrategy)],
    parametrisation: Parametrisation,
    rr_depth: Option<usize>,
    threads: usize,
) -> Result<Vec<Length>, RenderError> {
    let last = rr_depth.map_or(usize::MAX, last_probed);
    let near = lengths.partition_point(|&(k, _)| k <= last);
    let tracers = lengths[..near]
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
            // The square of a mean of n holds a part of the variance.
            let square = (own.powi(2) - variance / n as f64).max(0.0);
            [variance, square].map(|v| v / (mean.powi(2) + epsilon).max(f64::MIN_POSITIVE))
        };
        let moments = means.iter().zip(seen.chunks_exact(n)).map(spread);
        let [variance, square] = moments.fold([0.0; 2], |[a, b], [v, s]| [a + v, b + s]);
        Length {
            k: lengths[i].0,
            variance: variance / pixels,
            square: square / pixels,
            rays: (*rays as f64 / paths.max(1) as f64).max(1.0),
            lit: seen.iter().filter(|x| **x > 0.0).count() as f64 / paths.max(1) as f64,
            mean: seen.iter().sum::<f64>() / paths.max(1) as f64,
        }
    };
    let mut found: Vec<Length> = probed.iter().enumerate().map(length).collect();
    for &(k, _) in &lengths[near..] {
        found.push(foretold(k, &found));
    }
    Ok(found)
}

/// A length that goes on as the two before it: light fades by a constant factor, and rays grow by a constant number.
fn foretold(k: usize, before: &[Length]) -> Length {
    let [.., a, b] = before else {
        // Nothing to go by: as the one before it, or a path of k bounces that finds light.
        let like = before.last().copied().unwrap_or_default();
        let rays = (k + 2) as f64;
        return Length { k, rays, ..like };
    };
    let fades = |a: f64, b: f64| b * if a > 0.0 { (b / a).min(1.0) } else { 1.0 };
    Length {
        k,
        variance: fades(a.variance, b.variance),
        square: fades(a.square, b.square),
        rays: b.rays + (b.rays - a.rays).max(0.0),
        lit: b.lit,
        mean: fades(a.mean, b.mean),
    }
}

/// Samples per pixel of each length, as fractions: together they cost what `spp` of each would.
///
/// No length gets less than an eighth of `spp`; where nothing varies all get the same. With `rr_depth` this `spp` halves with
/// each bounce from k = `rr_depth` on, as Russian roulette with even odds would have it, so that the cost of all lengths
/// stays finite: of long paths, which hold little light each, there may be less than one to a pixel. Which pixels have one
/// is left to chance, and that varies, too: there n_k ∝ sqrt(E[f²] ÷ c_k).
pub fn allot(lengths: &[Length], spp: f64, rr_depth: Option<usize>) -> Vec<f64> {
    let beyond = |l: &Length| rr_depth.map_or(0, |depth| (l.k + 1).saturating_sub(depth.max(1)));
    let usual: Vec<f64> = lengths
        .iter()
        .map(|l| spp * 0.5f64.powi(beyond(l) as i32))
        .collect();
    let wanted: Vec<f64> = lengths
        .iter()
        .map(|l| {
            let chance = if beyond(l) > 0 { l.square } else { 0.0 };
            ((l.variance + chance) / l.rays).max(0.0).sqrt()
        })
        .collect();
    let least = |i: usize| LEAST_SHARE * usual[i];
    let mut raised = vec![false; lengths.len()];
    loop {
        let sum = |of: &dyn Fn(usize) -> f64, at_least: bool| -> f64 {
            (0..lengths.len())
                .filter(|&i| raised[i] == at_least)
                .map(of)
                .sum()
        };
        let all: f64 = lengths.iter().zip(&usual).map(|(l, n)| l.rays * n).sum();
        let left = all - sum(&|i| lengths[i].rays * least(i), true);
        let weight = sum(&|i| lengths[i].rays * wanted[i], false);
        if weight <= 0.0 || !weight.is_finite() {
            return usual;
        }
        let share = |i: usize| {
            if raised[i] {
                least(i)
            } else {
                wanted[i] * left / weight
            }
        };
        let shares: Vec<f64> = (0..lengths.len()).map(share).collect();
        // Raising one lowers all others, so that more may fall below.
        let low = |i: &usize| !raised[*i] && shares[*i] < least(*i);
        let fallen: Vec<usize> = (0..lengths.len()).filter(low).collect();
        if fallen.is_empty() {
            return shares;
        }
        fallen.into_iter().for_each(|i| raised[i] = true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn length(k: usize, variance: f64, rays: f64) -> Length {
        Length {
            k,
            variance,
            square: 1.0,
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
        let shares = allot(&lengths, 64.0, None);
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
        assert_eq!(allot(&lengths, 16.0, None), vec![16.0; 2]);
        let lengths = [length(0, 0.0, 1.0), length(1, 2.0, 3.0)];
        let shares = allot(&lengths, 16.0, None);
        assert_eq!(shares[0], 2.0);
        assert!((shares[1] - (16.0 + 14.0 / 3.0)).abs() < 1e-9);
    }
    #[test]
    fn behind_the_depth_of_roulette_the_cost_stays_finite() {
        let deep = |n: usize| -> Vec<Length> {
            (0..n)
                .map(|k| {
                    let fades = 0.25f64.powi(k as i32);
                    Length {
                        square: fades,
                        ..length(k, fades, (k + 2) as f64)
                    }
                })
                .collect()
        };
        let cost = |n: usize| -> f64 {
            let lengths = deep(n);
            let shares = allot(&lengths, 16.0, Some(4));
            lengths.iter().zip(&shares).map(|(l, s)| l.rays * s).sum()
        };
        let shares = allot(&deep(30), 16.0, Some(4));
        assert!(shares[29] < 0.01 && shares[29] > 0.0, "{shares:?}");
        assert!(cost(30) < 1.05 * cost(15), "{} {}", cost(30), cost(15));
        // Shorter paths than that are dealt with as without it.
        assert_eq!(allot(&deep(4), 16.0, Some(4)), allot(&deep(4), 16.0, None));
    }

    #[test]
    fn what_is_foretold_goes_on_as_what_was_seen() {
        let seen = [length(3, 4.0, 5.0), length(4, 2.0, 6.0)];
        let next = foretold(5, &seen);
        assert_eq!((next.k, next.variance, next.rays), (5, 1.0, 7.0));
        // Of one length alone nothing can be told.
        assert_eq!(foretold(5, &seen[..1]).variance, 4.0);
    }
}
