//! Pilot → fit → render.

use std::sync::Arc;
use std::time::Instant;

use pss_guide::{Emitter, Guide};
use pss_render::{Accumulator, Developed, Scene, Tracer};
use serde::Serialize;

use crate::combine::by_variance;
use crate::diagnostics::{Diagnostics, Evidence, Pools};
use crate::error::RenderError;
use crate::learning::Current;
use crate::mixture::Mixture;
use crate::options::{Budget, Combine, Options, PassKind, PassPlan};
use crate::pass::{Pass, PassContext};
use crate::progress::{Phase, Progress};
use crate::records::PathRecords;
use crate::snapshots::{Snapshot, Snapshots};
use crate::statistics::Statistics;

/// Wall time by phase.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Seconds {
    /// Random paths for training.
    pub pilot: f64,
    /// Learning.
    pub fit: f64,
    /// The rest.
    pub render: f64,
}

/// A rendered image and how it came about.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Radiance (W·sr⁻¹·m⁻²), its variance, and counts per pixel of all paths in the image.
    pub film: Developed,
    /// The guide that was used; `None` for random numbers.
    pub guide: Option<Arc<dyn Guide>>,
    /// Its name, or `none`.
    pub chosen: String,
    /// Why it was not the one asked for, or what else is worth knowing.
    pub notes: Vec<String>,
    /// What a chooser considered last, and why it was taken or not; null where there was nothing to choose.
    pub candidates: serde_json::Value,
    /// What the guide's training reported, JSON.
    pub training: serde_json::Value,
    /// Share of uniform paths that it was mixed with.
    pub uniform_fraction: f32,
    /// Passes, as a plan from which the render can be replayed.
    pub passes: Vec<PassPlan>,
    /// The pilot's paths.
    pub pilot: Statistics,
    /// The paths after it.
    pub rendered: Statistics,
    /// All paths in the image: the rendered ones, and the pilot's where it was kept.
    pub in_image: Statistics,
    /// Whether the variance can be believed.
    pub diagnostics: Diagnostics,
    /// Wall time by phase.
    pub seconds: Seconds,
    /// Wall time of all phases and what lies between them, without what snapshots took.
    pub elapsed: f64,
    /// Threads that rendered.
    pub threads: usize,
    /// The image so far at the times that were asked for.
    pub snapshots: Vec<Snapshot>,
}

impl Outcome {
    /// Mean radiance over the image.
    pub fn mean(&self) -> [f64; 3] {
        let mut mean = [0.0; 3];
        for pixel in self.film.image.chunks_exact(3) {
            for c in 0..3 {
                mean[c] += f64::from(pixel[c]);
            }
        }
        mean.map(|sum| sum / (self.film.image.len() / 3) as f64)
    }

    /// The estimate's own variance in the measure of relMSE: mean over pixels and channels of
    /// var ÷ (mean² + ε), ε = (0.1 · image mean)². `None` for a black image or one sample a pixel.
    pub fn relative_variance(&self) -> Option<f64> {
        let mean = self.film.image.iter().map(|&x| f64::from(x)).sum::<f64>()
            / self.film.image.len() as f64;
        let epsilon = (0.1 * mean).powi(2);
        let terms = self
            .film
            .image
            .iter()
            .zip(&self.film.variance)
            .map(|(&x, &v)| f64::from(v) / (f64::from(x).powi(2) + epsilon));
        let variance = terms.sum::<f64>() / self.film.image.len() as f64;
        variance.is_finite().then_some(variance)
    }
}

/// Renders the k-bounce light of `scene`; at k = 0 the emitters that the camera sees.
///
/// With [`Budget::Spp`] or [`Budget::Replay`], one seed gives one image, bit for bit, for any number of
/// threads. With [`Budget::Time`] the passes depend on the machine; [`Outcome::passes`] replays them.
///
/// # Errors
/// [`RenderError`]: an option out of range, a guide that cannot be fitted, or [`RenderError::Cancelled`].
pub fn render(
    scene: &Scene,
    options: &Options,
    progress: &dyn Progress,
) -> Result<Outcome, RenderError> {
    options.check()?;
    let tracer = match options.k {
        0 => Tracer::emission(scene),
        k => Tracer::new(scene, k, options.parametrisation, options.strategy)?,
    };
    let pool = thread_pool(options.threads)?;
    let context = PassContext {
        tracer,
        seed: options.seed,
        survival: options.survival,
        progress,
        pool: &pool,
    };
    let intervals = scene.emitter_intervals();
    let mut run = Run {
        context,
        options,
        clock: Instant::now(),
        image: Accumulator::whole(scene.film()),
        apart: Vec::new(),
        next_sample: 0,
        records: PathRecords::default(),
        max_records: options.max_records,
        short_of_memory: false,
        lit: 1.0,
        emitters: intervals
            .map(|(cdf, environment)| Emitter { cdf, environment })
            .collect(),
        current: Current::default(),
        drawn: None,
        passes: Vec::new(),
        pilot: Statistics::default(),
        rendered: Statistics::default(),
        pools: Pools::default(),
        seconds: Seconds::default(),
        snapshots: Snapshots::at(&options.snapshots),
    };
    run.take_ready()?;
    match &options.budget {
        Budget::Spp(spp) => run.by_samples(*spp)?,
        Budget::Time(time) => run.by_time(*time)?,
        Budget::Replay(passes) => run.by_record(passes)?,
    }
    Ok(run.finish())
}

pub(crate) fn thread_pool(threads: usize) -> Result<rayon::ThreadPool, RenderError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|i| format!("pssflow-{i}"))
        .build()
        .map_err(|e| RenderError::Threads {
            threads,
            reason: e.to_string(),
        })
}

/// A render under way: `schedule` cuts the budget into passes, `learning` fits guides between them.
pub(crate) struct Run<'a> {
    pub(crate) context: PassContext<'a>,
    pub(crate) options: &'a Options,
    /// When it began; put forward by what snapshots took.
    pub(crate) clock: Instant,
    /// Sums of the passes; with weights by variance, of none.
    image: Accumulator,
    /// Sums of each pass, where these are weighted by variance.
    apart: Vec<Accumulator>,
    /// Samples per pixel so far.
    pub(crate) next_sample: u32,
    pub(crate) records: PathRecords,
    /// As in the options, or as many as memory holds.
    pub(crate) max_records: usize,
    /// Whether it did not hold all.
    pub(crate) short_of_memory: bool,
    /// Share of the last pass's paths that carried light.
    pub(crate) lit: f64,
    pub(crate) emitters: Vec<Emitter>,
    pub(crate) current: Current,
    /// The guide of the last guided pass, its name and its share of uniform paths.
    drawn: Option<(Arc<dyn Guide>, String, f32)>,
    pub(crate) passes: Vec<PassPlan>,
    pub(crate) pilot: Statistics,
    rendered: Statistics,
    pools: Pools,
    pub(crate) seconds: Seconds,
    pub(crate) snapshots: Snapshots,
}

impl Run<'_> {
    /// Renders a pass, keeps a share of its paths for training, and notes it.
    pub(crate) fn pass(
        &mut self,
        kind: PassKind,
        spp: u32,
        record: f32,
        span: (f32, f32),
    ) -> Result<(), RenderError> {
        let start = Instant::now();
        let film = self.context.tracer.scene().film();
        let pilot = kind == PassKind::Pilot;
        let guide = self
            .current
            .guide
            .clone()
            .filter(|_| kind == PassKind::Guided);
        let mixture = Mixture {
            uniform_fraction: self.current.uniform_fraction,
        };
        let mut record = if self.options.guide.learns() {
            record
        } else {
            0.0
        };
        if record > 0.0 {
            // Those of the tiles under way need room, too, until they are merged.
            record *= self.reserve_records();
        }
        let pass = Pass {
            phase: if pilot { Phase::Pilot } else { Phase::Render },
            first_sample: self.next_sample,
            spp,
            weight: self.options.combine.weight(kind),
            guide: guide.as_deref().map(|g| (g, mixture)),
            record,
            most_records: self.most_kept(),
            contexts: self.options.guide.looks_at_contexts(),
            span,
        };
        let discarded = pilot && !self.options.keep_pilot;
        let mut own = None;
        let image = if discarded || self.options.combine == Combine::Variance {
            own.insert(Accumulator::whole(film))
        } else {
            &mut self.image
        };
        let (statistics, older) = self.context.render(&pass, image, &mut self.records)?;
        self.short_of_memory |= statistics.short_of_memory;
        self.apart.extend(own.filter(|_| !discarded));
        if record > 0.0 {
            self.records.count(statistics.counts.camera_rays);
            let newer = self.records.len() - older;
            let rest = self.max_records.saturating_sub(newer);
            self.records.thin(older, [rest, newer]);
        }
        self.lit = statistics.counts.lit_share();
        self.next_sample += spp;
        let seconds = start.elapsed().as_secs_f64();
        if pilot {
            self.pilot.add(&statistics);
            self.seconds.pilot += seconds;
        } else {
            self.rendered.add(&statistics);
            self.seconds.render += seconds;
        }
        let guided = guide.is_some();
        if guided {
            self.pools.add_pass(&statistics);
        }
        let fresh = std::mem::take(&mut self.current.fresh);
        self.passes.push(PassPlan {
            kind: match kind {
                PassKind::Guided if !guided => PassKind::Uniform,
                kind => kind,
            },
            spp,
            record,
            guide: guided.then(|| self.current.name.clone()),
            a: guided.then_some(mixture.uniform_fraction),
            fit: guided && fresh,
        });
        if let Some(guide) = guide {
            let name = self.current.name.clone();
            self.drawn = Some((guide, name, mixture.uniform_fraction));
        }
        self.note_image();
        Ok(())
    }

    fn finish(mut self) -> Outcome {
        self.note_end();
        let elapsed = self.clock.elapsed().as_secs_f64();
        let mut outcome = self.outcome(self.develop(self.apart.len()), elapsed);
        outcome.snapshots = self.snapshots.taken;
        outcome
    }

    /// Whether any path is in the image yet.
    pub(crate) fn has_image(&self) -> bool {
        let pilot = self.options.keep_pilot && self.pilot.counts.camera_rays > 0;
        pilot || self.rendered.counts.camera_rays > 0
    }

    /// Passes in the image, where these are kept apart.
    pub(crate) fn passes_apart(&self) -> usize {
        self.apart.len()
    }

    /// The image of all passes, or of the first `apart` ones where these are weighted by variance.
    pub(crate) fn develop(&self, apart: usize) -> Developed {
        match self.options.combine {
            Combine::Samples => self.image.develop(),
            Combine::Variance => {
                by_variance(self.context.tracer.scene().film(), &self.apart[..apart])
            }
        }
    }

    fn in_image(&self) -> Statistics {
        let mut all = self.rendered.clone();
        if self.options.keep_pilot {
            all.add(&self.pilot);
        }
        all
    }

    /// What there was after `elapsed` seconds, now, with its image.
    pub(crate) fn outcome(&self, film: Developed, elapsed: f64) -> Outcome {
        let scene = self.context.tracer.scene();
        let mut notes = Vec::new();
        match (&self.drawn, &self.current.guide, &self.current.refusal) {
            (None, _, Some(refusal)) => notes.push(refusal.clone()),
            // A guide that was learned just as the time ran out drew nothing, and is not what was rendered with.
            (None, Some(unused), None) => {
                let name = unused.name();
                notes.push(format!(
                    "{name}: the time was out after training; none is used"
                ));
            }
            _ => {}
        }
        notes.extend(self.current.diverged.clone());
        if self.short_of_memory {
            notes.push("memory was short: fewer paths were kept to learn from".to_owned());
        }
        let [width, height] = scene.film().crop_size();
        let mut all = self.pilot.counts;
        all.add(&self.rendered.counts);
        if all.non_finite > 0 {
            notes.push(format!(
                "{} paths were not finite and count as zero",
                all.non_finite
            ));
        }
        if all.nonzero == 0 {
            let why = if scene.emitters().is_empty() {
                "the scene has no emitter"
            } else if all.paths_found == 0 {
                "no path found all its vertices"
            } else {
                "no path carried light"
            };
            notes.push(format!("the image is black: {why}"));
        }
        let (guide, chosen, uniform_fraction) = match &self.drawn {
            Some((guide, name, a)) => (Some(Arc::clone(guide)), name.clone(), *a),
            None => (None, "none".to_owned(), 1.0),
        };
        let in_image = self.in_image();
        let diagnostics = Diagnostics::of(&Evidence {
            in_image: &in_image,
            pilot: &self.pilot,
            rendered: &self.rendered,
            pools: &self.pools,
            mass_outside: guide.as_ref().map(|g| g.mass_outside()),
            film: &film,
        });
        notes.extend(diagnostics.warnings.iter().cloned());
        Outcome {
            width,
            height,
            film,
            guide,
            chosen,
            uniform_fraction,
            candidates: self.current.candidates.clone(),
            notes,
            training: self.current.training.clone(),
            passes: self.passes.clone(),
            pilot: self.pilot.clone(),
            rendered: self.rendered.clone(),
            in_image,
            diagnostics,
            seconds: self.seconds,
            elapsed,
            threads: self.context.pool.current_num_threads(),
            snapshots: Vec::new(),
        }
    }
}
