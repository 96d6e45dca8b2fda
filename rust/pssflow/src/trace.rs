//! Given samples rendered, and rays timed: what studies ask of the tracer beside whole images.

use std::time::Instant;

use pss_guide::Guide;
use pss_render::steps::Steps;
use pss_render::{Paths, Tracer, Uniform};
use pss_rng::{Purpose, Stream};
use rayon::prelude::*;

use crate::error::RenderError;
use crate::estimator::thread_pool;
use crate::mixture::Mixture;
use crate::numbers::GuidedNumbers;
use crate::pass::{BLOCK, path_numbers};

/// Uniform paths of `spp` samples a pixel, rows and pixels in order, not yet traced. The numbers are those
/// that a render with the same seed uses.
pub fn uniform_paths(tracer: &Tracer<'_>, seed: u64, spp: u32) -> Paths {
    let scene = tracer.scene();
    let [width, height] = scene.film().crop_size();
    let columns = tracer.columns();
    let stream = Stream::new(seed, Purpose::Path);
    let mut paths = Paths::new(columns);
    for y in 0..height {
        for x in 0..width {
            for sample in 0..spp {
                path_numbers(&stream, scene, [x, y], sample, columns.width(), &mut paths);
            }
        }
    }
    paths
}

/// Traces paths in blocks, in parallel, and records their contexts; the blocks come back in order.
///
/// # Errors
/// [`RenderError::Threads`].
pub fn trace_blocks(
    tracer: &Tracer<'_>,
    paths: &Paths,
    threads: usize,
) -> Result<Vec<Paths>, RenderError> {
    let width = tracer.columns().width();
    let pool = thread_pool(threads)?;
    let blocks = pool.install(|| {
        paths
            .film
            .par_chunks(BLOCK)
            .zip(paths.u.par_chunks(BLOCK * width))
            .enumerate()
            .map(|(i, (film, u))| {
                let mut block = Paths::new(tracer.columns());
                block.record = true;
                block.film.extend_from_slice(film);
                block.u.extend_from_slice(u);
                let lens = paths.lens.chunks(BLOCK).nth(i).unwrap_or_default();
                block.lens.extend_from_slice(lens);
                tracer.trace(&mut block, &mut Uniform);
                block
            })
            .collect()
    });
    Ok(blocks)
}

/// Draws `spp` samples a pixel as a render's pass does, from the mixture or uniformly, and keeps what every decision came
/// to; rows, pixels and samples in order, in blocks. Their m is the mixture's density of `q_nee` and `q_bsdf`.
///
/// # Errors
/// [`RenderError::Threads`].
pub fn drawn_blocks(
    tracer: &Tracer<'_>,
    guide: Option<(&dyn Guide, Mixture)>,
    seed: u64,
    (first_sample, spp): (u32, u32),
    threads: usize,
) -> Result<Vec<Paths>, RenderError> {
    let scene = tracer.scene();
    let width = scene.film().crop_size()[0];
    let columns = tracer.columns();
    let stream = Stream::new(seed, Purpose::Path);
    let total = scene.film().pixels() * spp as usize;
    let pool = thread_pool(threads)?;
    let starts: Vec<usize> = (0..total).step_by(BLOCK).collect();
    let block = |&start: &usize| {
        let mut paths = Paths::new(columns);
        paths.record = true;
        paths.steps = Some(Steps::default());
        let mut coins = Vec::with_capacity(BLOCK);
        for i in start..total.min(start + BLOCK) {
            let (pixel, sample) = (i / spp as usize, first_sample + (i % spp as usize) as u32);
            let at = [pixel as u32 % width, pixel as u32 / width];
            let [coin, _] = path_numbers(&stream, scene, at, sample, columns.width(), &mut paths);
            coins.push(coin);
        }
        match guide {
            Some((guide, mixture)) => {
                let mut numbers = GuidedNumbers::new(guide);
                numbers.toss(coins.into_iter(), mixture);
                tracer.trace(&mut paths, &mut numbers);
            }
            None => tracer.trace(&mut paths, &mut Uniform),
        }
        paths
    };
    Ok(pool.install(|| starts.par_iter().map(block).collect()))
}

/// The time of a set of rays.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RayTiming {
    /// Wall time of the queries alone.
    pub seconds: f64,
    /// Queries: nearest hits and shadow rays.
    pub rays: u64,
    /// Paths that asked for them.
    pub paths: u64,
}

/// Renders `spp` uniform samples a pixel while noting every ray, then times these rays alone: the floor
/// under the time of a path.
///
/// # Errors
/// [`RenderError::Threads`].
pub fn rays_alone(tracer: &Tracer<'_>, spp: u32, threads: usize) -> Result<RayTiming, RenderError> {
    let pool = thread_pool(threads)?;
    let paths = uniform_paths(tracer, 0, spp);
    let width = tracer.columns().width();
    let logs: Vec<pss_render::paths::RayLog> = pool.install(|| {
        paths
            .film
            .par_chunks(BLOCK)
            .zip(paths.u.par_chunks(BLOCK * width))
            .enumerate()
            .map(|(i, (film, u))| {
                let mut block = Paths::new(tracer.columns());
                block.rays = Some(Default::default());
                block.film.extend_from_slice(film);
                block.u.extend_from_slice(u);
                let lens = paths.lens.chunks(BLOCK).nth(i).unwrap_or_default();
                block.lens.extend_from_slice(lens);
                tracer.trace(&mut block, &mut Uniform);
                block.rays.unwrap_or_default()
            })
            .collect()
    });
    let accel = tracer.scene().accel();
    let start = Instant::now();
    let rays = pool.install(|| {
        logs.par_iter()
            .map(|log| std::hint::black_box(log.replay(accel)))
            .sum::<u64>()
    });
    let seconds = start.elapsed().as_secs_f64();
    let _ = rays;
    Ok(RayTiming {
        seconds,
        rays: logs
            .iter()
            .map(pss_render::paths::RayLog::len)
            .sum::<usize>() as u64,
        paths: paths.len() as u64,
    })
}
