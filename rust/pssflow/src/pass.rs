//! One pass over the image: every pixel gets the same number of paths, from one frozen source of numbers.
//!
//! The image is cut into tiles and each tile's samples into chunks, the same whatever the number of
//! threads; their sums are merged in that order. So one seed gives one image, bit for bit.

use pss_guide::Guide;
use pss_render::math::Rgb;
use pss_render::{Accumulator, Paths, Scene, Tile, Tracer, Uniform};
use pss_rng::{Purpose, Stream, to_unit};
use rayon::prelude::*;

use crate::error::RenderError;
use crate::mixture::Mixture;
use crate::numbers::GuidedNumbers;
use crate::progress::{Phase, Progress};
use crate::records::PathRecords;
use crate::statistics::Statistics;

/// Edge of a tile in pixels.
const TILE: u32 = 32;
/// Paths of a block that goes through the stages together: large enough for a network's batch, small
/// enough for the cache.
pub(crate) const BLOCK: usize = 1024;
/// Samples of a pixel that one piece of work holds at most.
const CHUNK: u32 = 16;
/// Pieces of work between two merges: bounds the memory of unmerged sums.
const BATCH: usize = 128;
/// Block of a path's numbers that the lens uses, where the camera has one: far behind those of u.
const LENS: u32 = u32::MAX;
/// Block of the number that decides whether a path is traced at all.
const ROULETTE: u32 = u32::MAX - 1;

/// What all passes of a render share.
pub(crate) struct PassContext<'a> {
    /// The tracer.
    pub(crate) tracer: Tracer<'a>,
    /// Seed of the paths' numbers.
    pub(crate) seed: u64,
    /// Probability that a path is traced.
    pub(crate) survival: f32,
    /// Listener.
    pub(crate) progress: &'a dyn Progress,
    /// Threads.
    pub(crate) pool: &'a rayon::ThreadPool,
}

/// Appends the uniform numbers of one path, and its film position, to a block; returns its coin and the
/// number that decides whether it is recorded.
pub(crate) fn path_numbers(
    stream: &Stream,
    scene: &Scene,
    [x, y]: [u32; 2],
    sample: u32,
    width: usize,
    paths: &mut Paths,
) -> [f32; 2] {
    let index = index(scene, [x, y]);
    let block = |group: u32| stream.block(index, sample, group).map(to_unit);
    let [fx, fy, coin, thin] = block(0);
    paths.film.push([x as f32 + fx, y as f32 + fy]);
    let end = paths.u.len() + width;
    let mut group = 1;
    while paths.u.len() < end {
        paths.u.extend(block(group));
        group += 1;
    }
    paths.u.truncate(end);
    if scene.sensor().has_lens() {
        let [x, y, ..] = block(LENS);
        paths.lens.push([x, y]);
    }
    [coin, thin]
}

/// A pixel's number over the whole film: a crop renders the same samples as the full image.
fn index(scene: &Scene, [x, y]: [u32; 2]) -> u32 {
    let film = scene.film();
    let [ox, oy] = film.crop_offset();
    (y + oy) * film.size()[0] + x + ox
}

/// One pass.
#[derive(Clone, Copy)]
pub(crate) struct Pass<'a> {
    pub(crate) phase: Phase,
    /// First sample index; samples of different passes must not overlap.
    pub(crate) first_sample: u32,
    pub(crate) spp: u32,
    /// What a sample counts in the image.
    pub(crate) weight: f64,
    /// `None`: uniform numbers.
    pub(crate) guide: Option<(&'a dyn Guide, Mixture)>,
    /// Share of the light-carrying paths to record, 0 for none.
    pub(crate) record: f32,
    /// Most paths to record: where there are more, half of those so far go, and the share is halved.
    pub(crate) most_records: usize,
    /// Whether their vertices are recorded, too.
    pub(crate) contexts: bool,
    /// Share of the phase that is done before and after this pass, for the progress bar.
    pub(crate) span: (f32, f32),
}

/// What a part of a pass adds up to.
struct Piece {
    sums: Accumulator,
    statistics: Statistics,
    records: PathRecords,
}

impl PassContext<'_> {
    /// Renders `pass`, adds it to `image`, and its paths that are kept to `records`. Also returns how many of these are
    /// older than the pass: fewer than before, where memory ran short and some gave way.
    pub(crate) fn render(
        &self,
        pass: &Pass<'_>,
        image: &mut Accumulator,
        records: &mut PathRecords,
    ) -> Result<(Statistics, usize), RenderError> {
        let pieces = self.pieces(pass);
        let mut total = Statistics::default();
        let (mut pass, mut older) = (*pass, records.len());
        let (start, end) = pass.span;
        for (batch, work) in pieces.chunks(BATCH).enumerate() {
            let done: Vec<Option<Piece>> = self.pool.install(|| {
                work.par_iter()
                    .map(|&(tile, first, spp)| {
                        (!self.progress.cancelled()).then(|| self.piece(&pass, tile, first, spp))
                    })
                    .collect()
            });
            for piece in done {
                let Some(mut piece) = piece else {
                    return Err(RenderError::Cancelled);
                };
                image.merge_weighted(&piece.sums, |_, _| pass.weight);
                total.add(&piece.statistics);
                if !records.append(&mut piece.records, &mut older) {
                    pass.record *= 0.5;
                    pass.most_records = pass.most_records.min(records.len());
                    total.short_of_memory = true;
                }
            }
            while records.len() - older > pass.most_records {
                records.thin(older, [older, (records.len() - older) / 2]);
                pass.record *= 0.5;
            }
            let share = ((batch * BATCH + work.len()) as f32) / pieces.len() as f32;
            self.progress
                .update(pass.phase, start + (end - start) * share);
        }
        Ok((total, older))
    }

    /// The pass cut into (tile, first sample, samples), in the order in which they are merged.
    fn pieces(&self, pass: &Pass<'_>) -> Vec<(Tile, u32, u32)> {
        let [width, height] = self.tracer.scene().film().crop_size();
        let mut pieces = Vec::new();
        for first in (0..pass.spp).step_by(CHUNK as usize) {
            let spp = (pass.spp - first).min(CHUNK);
            for y in (0..height).step_by(TILE as usize) {
                for x in (0..width).step_by(TILE as usize) {
                    let tile = Tile {
                        x,
                        y,
                        width: (width - x).min(TILE),
                        height: (height - y).min(TILE),
                    };
                    pieces.push((tile, pass.first_sample + first, spp));
                }
            }
        }
        pieces
    }

    /// All paths of a tile and a chunk of samples, in blocks.
    fn piece(&self, pass: &Pass<'_>, tile: Tile, first_sample: u32, spp: u32) -> Piece {
        let scene = self.tracer.scene();
        let film = scene.film();
        let columns = self.tracer.columns();
        let stream = Stream::new(self.seed, Purpose::Path);
        let mut piece = Piece {
            sums: Accumulator::new(film, tile),
            statistics: Statistics::default(),
            records: PathRecords::default(),
        };
        let mut paths = Paths::new(columns);
        paths.record = pass.contexts && pass.record > 0.0;
        let mut guided = pass.guide.map(|(guide, _)| GuidedNumbers::new(guide));
        let mixture = pass.guide.map_or(
            Mixture {
                uniform_fraction: 1.0,
            },
            |(_, m)| m,
        );
        let mut coins: Vec<[f32; 2]> = Vec::with_capacity(BLOCK);

        // Samples of a pixel lie next to each other, so that camera rays come in coherent packets.
        let pixels = tile.width * tile.height;
        let total = u64::from(pixels) * u64::from(spp);
        let mut next = 0u64;
        while next < total {
            paths.film.clear();
            paths.lens.clear();
            paths.u.clear();
            coins.clear();
            while next < total && coins.len() < BLOCK {
                let (pixel, sample) = (next / u64::from(spp), next % u64::from(spp));
                let (pixel, sample) = (pixel as u32, first_sample + sample as u32);
                let at = [tile.x + pixel % tile.width, tile.y + pixel / tile.width];
                next += 1;
                if let Some(ended) = self.ended(&stream, at, sample) {
                    piece.sums.add(film, ended, Rgb::ZERO, false);
                    continue;
                }
                coins.push(path_numbers(
                    &stream,
                    scene,
                    at,
                    sample,
                    columns.width(),
                    &mut paths,
                ));
            }

            if coins.is_empty() {
                break;
            }
            match &mut guided {
                Some(numbers) => {
                    numbers.toss(coins.iter().map(|c| c[0]), mixture);
                    self.tracer.trace(&mut paths, numbers);
                }
                None => self.tracer.trace(&mut paths, &mut Uniform),
            }
            self.collect(pass, &paths, &coins, mixture, &mut piece);
        }
        piece
    }

    /// Film position of a path that Russian roulette ends before its first ray.
    #[inline]
    fn ended(&self, stream: &Stream, [x, y]: [u32; 2], sample: u32) -> Option<[f32; 2]> {
        if self.survival >= 1.0 {
            return None;
        }
        let index = index(self.tracer.scene(), [x, y]);
        let [xi, ..] = stream.block(index, sample, ROULETTE).map(to_unit);
        if xi < self.survival {
            return None;
        }
        let [fx, fy, ..] = stream.block(index, sample, 0).map(to_unit);
        Some([x as f32 + fx, y as f32 + fy])
    }

    /// Divides a block by its densities and adds it to the film, the counts and the records.
    fn collect(
        &self,
        pass: &Pass<'_>,
        paths: &Paths,
        coins: &[[f32; 2]],
        mixture: Mixture,
        piece: &mut Piece,
    ) {
        let film = self.tracer.scene().film();
        let columns = self.tracer.columns();
        let statistics = &mut piece.statistics;
        let counts = &mut statistics.counts;
        counts.camera_rays += paths.len() as u64;
        counts.paths_found += paths.found.iter().filter(|&&f| f).count() as u64;
        counts.non_finite += paths.non_finite;
        if pass.guide.is_some() {
            for (i, u) in paths.u.chunks_exact(columns.width()).enumerate() {
                let guided = mixture.is_guided(coins[i][0]);
                statistics.guided += u64::from(guided);
                statistics.squares[usize::from(guided)].paths += 1;
                if u[..columns.learned()]
                    .iter()
                    .all(|x| (0.0..1.0).contains(x))
                {
                    statistics.weights += f64::from(mixture.weight(paths.q_nee[i]));
                } else {
                    counts.outside += 1;
                }
            }
        } else {
            statistics.weights += paths.len() as f64;
        }
        let [width, height] = film.crop_size().map(|n| n as f32);
        for (i, &[coin, thin]) in coins.iter().enumerate() {
            let mut f = paths.f(i);
            let terms = [
                (paths.f_nee[i], paths.q_nee[i]),
                (paths.f_bsdf[i], paths.q_bsdf[i]),
            ];
            let (mut estimate, weight) = mixture.divide(terms);
            if !estimate.is_finite() {
                // Counts as a path without light, here as in the tracer.
                piece.statistics.counts.non_finite += 1;
                (f, estimate) = (Rgb::ZERO, Rgb::ZERO);
            }
            let (at, found) = (paths.film[i], paths.found[i]);
            piece.sums.add(film, at, estimate / self.survival, found);
            if f == Rgb::ZERO {
                continue;
            }
            let statistics = &mut piece.statistics;
            statistics.add_estimate(estimate, weight, mixture.rarity(terms));
            if pass.guide.is_some() {
                let guided = mixture.is_guided(coin);
                statistics.squares[usize::from(guided)].add_value(mixture.square(terms, guided));
            }
            if thin < pass.record {
                let [x, y] = paths.film[i];
                piece.records.push(
                    paths,
                    i,
                    columns.width(),
                    columns.learned(),
                    (mixture, pass.record),
                    [x / width, y / height],
                );
            }
        }
    }
}
