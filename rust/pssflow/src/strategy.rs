//! What the emitter strategy `auto` means: the extra BSDF-sampled ray of `mis`, or emitter samples alone.
//!
//! Where no ray can hit an emitter the extra ray finds nothing; where NEE alone would miss light it must stay. In all
//! other scenes a small probe decides: [`SAMPLES`] uniform paths through each pixel of a grid of at most [`GRID`]² are
//! traced with both strategies, and with V = Σ over pixels of s²/(m² + ε), ε = (0.1·mean)² (s² the variance of a sample,
//! m the mean of both strategies) and the rays of a path as its cost, `nee` is taken where
//!
//! V_nee·(k + 1) ≤ 0.9·V_mis·(k + 2).
//!
//! The probe's seed and the costs are fixed, so that one scene always gets one answer, on any number of threads. NEE's
//! variance has a heavy tail where a surface is near a lamp: an answer that hangs on one sample is not trusted.

use pss_render::math::luminance;
use pss_render::paths::RayLog;
use pss_render::{EmitterStrategy, Parametrisation, Paths, Scene, Tracer, Uniform};
use pss_rng::{Purpose, Stream};
use rayon::prelude::*;

use crate::error::RenderError;
use crate::estimator::thread_pool;
use crate::pass::path_numbers;

/// Most pixels along an edge of the probe's grid.
const GRID: u32 = 64;
/// Paths through each pixel of it.
pub(crate) const SAMPLES: u32 = 16;
/// Of the random numbers: another one than renders use by default, so that no image repeats the probe's paths.
const SEED: u64 = 0x5eed_a070;
/// Share of the cost that `nee` must save.
const MARGIN: f64 = 0.9;
/// Largest share of one sample in `nee`'s variance.
const HEAVIEST: f64 = 0.1;

/// The strategy chosen, and why.
#[derive(Clone, Debug, PartialEq)]
pub struct AutoStrategy {
    /// `mis` or `nee`.
    pub strategy: EmitterStrategy,
    /// In words.
    pub reason: String,
    /// V_nee·(k + 1) ÷ (V_mis·(k + 2)): below 1 where emitter samples alone are cheaper for the same error; `None` where
    /// no probe was needed or it found no light.
    pub ratio: Option<f64>,
}

/// Chooses the strategy for light of k bounces.
///
/// # Errors
/// [`RenderError`] for k out of range, or if threads cannot be started.
pub fn auto_strategy(
    scene: &Scene,
    k: usize,
    parametrisation: Parametrisation,
    threads: usize,
) -> Result<AutoStrategy, RenderError> {
    let (mis, nee) = (EmitterStrategy::Mis, EmitterStrategy::Nee);
    let tracers = [
        Tracer::new(scene, k, parametrisation, mis)?,
        Tracer::new(scene, k, parametrisation, nee)?,
    ];
    if let Some((strategy, reason)) = scene.required_strategy() {
        return Ok(AutoStrategy {
            strategy,
            reason: reason.to_owned(),
            ratio: None,
        });
    }
    let probed = thread_pool(threads)?.install(|| Probe::new(&tracers));
    let [v_mis, v_nee] = probed.variance;
    let ratio = v_nee * (k + 1) as f64 / (v_mis * (k + 2) as f64);
    let (strategy, reason) = if !(v_mis > 0.0 && ratio.is_finite()) {
        return Ok(AutoStrategy {
            strategy: mis,
            reason: "the probe found no light".to_owned(),
            ratio: None,
        });
    } else if ratio > MARGIN {
        (
            mis,
            format!("emitter samples alone cost {ratio:.2} times as much for the same error"),
        )
    } else if probed.heaviest > HEAVIEST {
        (
            mis,
            format!(
                "one sample makes {:.0} % of the error of emitter samples alone",
                100.0 * probed.heaviest
            ),
        )
    } else {
        (
            nee,
            format!("emitter samples alone cost {ratio:.2} times as much for the same error"),
        )
    };
    Ok(AutoStrategy {
        strategy,
        reason,
        ratio: Some(ratio),
    })
}

/// Luminances of the probe's paths, [`SAMPLES`] next to each other for each pixel of the grid, and how many rays they took.
pub(crate) fn probe_paths(tracer: &Tracer<'_>) -> (Vec<f64>, u64) {
    let scene = tracer.scene();
    let [width, height] = scene.film().crop_size();
    let places = |n: u32| (0..n).step_by(n.div_ceil(GRID).max(1) as usize);
    let rows: Vec<u32> = places(height).collect();
    // Row by row, merged in their order.
    let done: Vec<(Vec<f64>, u64)> = rows
        .par_iter()
        .map(|&y| {
            let columns = tracer.columns();
            let stream = Stream::new(SEED, Purpose::Path);
            let mut paths = Paths::new(columns);
            paths.rays = Some(RayLog::default());
            for x in places(width) {
                for sample in 0..SAMPLES {
                    let pixel = [x, y];
                    path_numbers(&stream, scene, pixel, sample, columns.width(), &mut paths);
                }
            }
            tracer.trace(&mut paths, &mut Uniform);
            let seen = (0..paths.len()).map(|j| f64::from(luminance(paths.f(j))));
            let rays = paths.rays.as_ref().map_or(0, RayLog::len);
            (seen.collect(), rays as u64)
        })
        .collect();
    let rays = done.iter().map(|(_, rays)| rays).sum();
    (done.into_iter().flat_map(|(seen, _)| seen).collect(), rays)
}

/// What the probe saw.
struct Probe {
    /// V of `mis` and of `nee`.
    variance: [f64; 2],
    /// Share of the largest sample in `nee`'s V.
    heaviest: f64,
}

impl Probe {
    fn new(tracers: &[Tracer<'_>; 2]) -> Self {
        let [mis, nee] = [0, 1].map(|i| probe_paths(&tracers[i]).0);
        let n = SAMPLES as usize;
        let total: f64 = mis.iter().chain(&nee).sum();
        let epsilon = (0.1 * total / (mis.len() + nee.len()).max(1) as f64).powi(2);
        let (mut variance, mut largest) = ([0.0; 2], 0f64);
        for (a, b) in mis.chunks_exact(n).zip(nee.chunks_exact(n)) {
            let mean = |v: &[f64]| v.iter().sum::<f64>() / n as f64;
            let (mean_a, mean_b) = (mean(a), mean(b));
            let scale = 1.0
                / ((n - 1) as f64
                    * ((0.5 * (mean_a + mean_b)).powi(2) + epsilon).max(f64::MIN_POSITIVE));
            let spread = |v: &[f64], m: f64| v.iter().map(|x| (x - m).powi(2)).sum::<f64>() * scale;
            variance[0] += spread(a, mean_a);
            variance[1] += spread(b, mean_b);
            largest = b
                .iter()
                .fold(largest, |l, x| l.max((x - mean_b).powi(2) * scale));
        }
        Self {
            variance,
            heaviest: if variance[1] > 0.0 {
                largest / variance[1]
            } else {
                0.0
            },
        }
    }
}
