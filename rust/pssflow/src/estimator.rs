//! Pilot → fit → render.

use std::sync::Arc;
use std::time::Instant;

use pss_guide::{Guide, GuideError, Records};
use pss_render::{Accumulator, Developed, Scene, Tracer};
use serde::Serialize;

use crate::error::RenderError;
use crate::mixture::Mixture;
use crate::options::{Budget, GuideChoice, Options, PassKind, PassPlan};
use crate::pass::{Pass, PassContext, PilotRecords};
use crate::progress::{Phase, Progress};
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
#[derive(Debug)]
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
    /// Wall time.
    pub seconds: Seconds,
    /// Threads that rendered.
    pub threads: usize,
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

/// Share of a time budget that the pilot may take.
const PILOT_TIME: f64 = 1.0 / 7.0;
/// Under `--spp`, one sample in so many is the pilot's.
const PILOT_DIVISOR: u32 = 4;

/// Share of a time budget that training is planned to take; what takes longer than the whole is given up.
const TRAINING_TIME: f64 = 0.3;
/// Samples per pixel that a timed pilot's memory for records is planned for.
const TIMED_PILOT_SPP: u32 = 64;

/// Renders the k-bounce indirect light of `scene`.
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
    let tracer = Tracer::new(scene, options.k, options.parametrisation, options.strategy)?;
    let pool = thread_pool(options.threads)?;
    let context = PassContext {
        tracer,
        seed: options.seed,
        progress,
        pool: &pool,
    };
    let mut run = Run {
        context,
        options,
        clock: Instant::now(),
        image: Accumulator::whole(scene.film()),
        next_sample: 0,
        passes: Vec::new(),
        pilot: Statistics::default(),
        rendered: Statistics::default(),
        seconds: Seconds::default(),
        notes: Vec::new(),
        training: serde_json::Value::Null,
    };

    let guide = match &options.guide {
        GuideChoice::Learn(learner) => {
            let dims = run.context.tracer.columns().learned();
            let records = run.pilot(learner.seconds_per_path(dims))?;
            run.fit(learner.as_ref(), &records)?
        }
        ready => {
            // A recorded pilot is part of the image, also where its guide is at hand already.
            if matches!(options.budget, Budget::Replay(_)) {
                run.pilot(0.0)?;
            }
            match ready {
                GuideChoice::Ready(guide) => Some(Arc::clone(guide)),
                _ => None,
            }
        }
    };
    if let Some(guide) = &guide {
        run.check_dimensions(guide.as_ref())?;
    }
    run.paths(guide.as_deref())?;
    Ok(run.finish(guide))
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

/// A render under way.
struct Run<'a> {
    context: PassContext<'a>,
    options: &'a Options,
    clock: Instant,
    image: Accumulator,
    next_sample: u32,
    passes: Vec<PassPlan>,
    pilot: Statistics,
    rendered: Statistics,
    seconds: Seconds,
    notes: Vec<String>,
    training: serde_json::Value,
}

impl Run<'_> {
    /// Random paths; they stay in the image unless the preset discards them.
    fn pilot(&mut self, seconds_per_path: f64) -> Result<PilotRecords, RenderError> {
        let start = Instant::now();
        let mut records = PilotRecords::default();
        match (self.options.budget.clone(), self.options.pilot_spp) {
            (Budget::Replay(passes), _) => {
                let pilots = passes.iter().filter(|p| p.kind == PassKind::Pilot);
                let total: u32 = pilots.clone().map(|p| p.spp).sum();
                let mut done = 0;
                for pass in pilots {
                    let share = |n: u32| n as f32 / total as f32;
                    let span = (share(done), share(done + pass.spp));
                    self.pilot_pass(pass.spp, pass.record, span, &mut records)?;
                    done += pass.spp;
                }
            }
            (Budget::Spp(_), Some(spp)) => {
                self.pilot_pass(spp, self.record_share(spp), (0.0, 1.0), &mut records)?;
            }
            (Budget::Spp(spp), None) => {
                let spp = (spp / PILOT_DIVISOR).max(1);
                self.pilot_pass(spp, self.record_share(spp), (0.0, 1.0), &mut records)?;
            }
            (Budget::Time(time), spp) => {
                self.timed_pilot(time, spp, seconds_per_path, &mut records)?;
            }
        }
        self.seconds.pilot = start.elapsed().as_secs_f64();
        Ok(records)
    }

    /// One sample a pixel, then as many more as its measured speed allows (or as were asked for), of which no
    /// more paths are kept than the guide can be trained on in its share of the time.
    fn timed_pilot(
        &mut self,
        time: f64,
        spp: Option<u32>,
        seconds_per_path: f64,
        records: &mut PilotRecords,
    ) -> Result<(), RenderError> {
        let start = Instant::now();
        let pixels = self.context.tracer.scene().film().pixels() as f64;
        let affordable = time * TRAINING_TIME / seconds_per_path.max(f64::MIN_POSITIVE);
        // How many paths carry light is not known yet; a quarter of all is on the high side.
        let first = (4.0 * affordable / pixels).min(1.0) as f32;
        let first = first.min(self.record_share(TIMED_PILOT_SPP));
        self.pilot_pass(1, first, (0.0, 0.1), records)?;
        let each = start.elapsed().as_secs_f64();
        let more = match spp {
            Some(spp) => spp - 1,
            None => ((time * PILOT_TIME - each) / each).clamp(0.0, f64::from(1 << 20)) as u32,
        };
        if more == 0 {
            return Ok(());
        }
        let nonzero = self.pilot.counts.nonzero as f64 * f64::from(more);
        let left = (affordable - records.f.len() as f64).max(0.0);
        let record = (left / nonzero.max(1.0)).min(1.0) as f32;
        let record = record.min(self.record_share(more.max(TIMED_PILOT_SPP)));
        self.pilot_pass(more, record, (0.1, 1.0), records)
    }

    /// Share of the light-carrying paths to keep so that a pilot of `spp` fits the memory for records, even
    /// if every path carries light. At random, since every other rule would prefer a part of the image.
    fn record_share(&self, spp: u32) -> f32 {
        let paths = self.context.tracer.scene().film().pixels() as f64 * f64::from(spp);
        (self.options.max_records as f64 / paths).min(1.0) as f32
    }

    fn pilot_pass(
        &mut self,
        spp: u32,
        record: f32,
        span: (f32, f32),
        records: &mut PilotRecords,
    ) -> Result<(), RenderError> {
        let pass = Pass {
            phase: Phase::Pilot,
            first_sample: self.next_sample,
            spp,
            guide: None,
            record,
            span,
        };
        let mut discarded;
        let image = if self.options.keep_pilot {
            &mut self.image
        } else {
            discarded = Accumulator::whole(self.context.tracer.scene().film());
            &mut discarded
        };
        let mut result = self.context.render(&pass, image)?;
        let zeros = result.statistics.counts.camera_rays - result.statistics.counts.nonzero;
        result.records.zeros = (zeros as f64 * f64::from(record)) as u64;
        records.append(&mut result.records);
        self.pilot.add(&result.statistics);
        self.next_sample += spp;
        self.passes.push(PassPlan {
            kind: PassKind::Pilot,
            spp,
            record,
        });
        Ok(())
    }

    /// Learns from the pilot. `None`, with a note, where there is nothing to learn from or no time left.
    fn fit(
        &mut self,
        learner: &dyn crate::options::Learner,
        records: &PilotRecords,
    ) -> Result<Option<Arc<dyn Guide>>, RenderError> {
        let replayed_without = matches!(&self.options.budget, Budget::Replay(passes)
            if !passes.iter().any(|p| p.kind == PassKind::Guided));
        if replayed_without {
            return Ok(None);
        }
        let start = Instant::now();
        let deadline = match self.options.budget {
            Budget::Time(time) => time,
            _ => f64::INFINITY,
        };
        let (clock, progress) = (self.clock, self.context.progress);
        let mut late = false;
        let mut report = |done: f32| {
            progress.update(Phase::Fit, done);
            late = clock.elapsed().as_secs_f64() > deadline;
            !late && !progress.cancelled()
        };
        let training = Records {
            dims: self.context.tracer.columns().learned(),
            u: &records.u,
            f: &records.f,
            f_max: &records.f_max,
            g: &records.g,
            pixel: &records.pixel,
            zeros: records.zeros,
            ..Records::default()
        };
        let fit = learner.fit(&training, self.options.seed, &mut report);
        self.seconds.fit = start.elapsed().as_secs_f64();
        match fit {
            Ok(fit) => {
                self.training = serde_json::json!({
                    "loss": fit.history,
                    "seconds": fit.seconds,
                    "dropped_nonfinite": fit.dropped_nonfinite,
                    "outliers_removed": fit.outliers_removed,
                    "trained_on": fit.trained_on,
                    "samples": fit.samples,
                    "guide": fit.guide.describe(),
                });
                Ok(Some(Arc::from(fit.guide)))
            }
            Err(GuideError::Cancelled) if late => {
                self.notes
                    .push("training did not end within the time; none is used".to_owned());
                Ok(None)
            }
            Err(GuideError::Cancelled) => Err(RenderError::Cancelled),
            Err(e @ GuideError::TooFewPaths { .. }) => {
                self.notes.push(format!("{e}; none is used"));
                Ok(None)
            }
            Err(e) => Err(e.into()),
        }
    }

    fn check_dimensions(&self, guide: &dyn Guide) -> Result<(), RenderError> {
        let expected = self.context.tracer.columns().learned();
        let whole_path = guide.models().contains(&pss_guide::Decision::Path);
        if whole_path && guide.dims() != expected {
            return Err(RenderError::Dimensions {
                name: guide.name().to_owned(),
                found: guide.dims(),
                expected,
                k: self.options.k,
                guide_k: guide.dims().saturating_sub(1) / 2,
            });
        }
        Ok(())
    }

    /// The passes after the pilot.
    fn paths(&mut self, guide: Option<&dyn Guide>) -> Result<(), RenderError> {
        let start = Instant::now();
        match self.options.budget.clone() {
            Budget::Spp(spp) => {
                let left = spp.saturating_sub(self.next_sample);
                if left > 0 {
                    self.pass(left, guide, (0.0, 1.0))?;
                }
            }
            Budget::Replay(passes) => {
                let rest = passes.iter().filter(|p| p.kind != PassKind::Pilot);
                let total: u32 = rest.clone().map(|p| p.spp).sum();
                let mut done = 0;
                for pass in rest {
                    let share = |n: u32| n as f32 / total as f32;
                    let guide = guide.filter(|_| pass.kind == PassKind::Guided);
                    self.pass(pass.spp, guide, (share(done), share(done + pass.spp)))?;
                    done += pass.spp;
                }
            }
            Budget::Time(time) => self.timed_paths(time, guide)?,
        }
        self.seconds.render = start.elapsed().as_secs_f64();
        Ok(())
    }

    /// Passes that double, the last one cut to what the measured speed leaves time for. At least one
    /// sample a pixel is rendered, however short the time.
    fn timed_paths(&mut self, time: f64, guide: Option<&dyn Guide>) -> Result<(), RenderError> {
        let start = Instant::now();
        let (mut spp, mut rendered) = (1u32, 0u32);
        let begin = self.clock.elapsed().as_secs_f64();
        loop {
            let now = self.clock.elapsed().as_secs_f64();
            if rendered > 0 {
                let each = start.elapsed().as_secs_f64() / f64::from(rendered);
                let left = ((time - now) / each).clamp(0.0, f64::from(1 << 20)) as u32;
                spp = (2 * spp)
                    .min(left)
                    .min(Options::MOST_SPP.saturating_sub(self.next_sample));
                if spp == 0 {
                    break;
                }
            } else if !self.passes.is_empty() && self.options.keep_pilot && now >= time {
                break;
            }
            let share = |t: f64| ((t - begin) / (time - begin).max(1e-9)).clamp(0.0, 1.0) as f32;
            let span = (
                share(now),
                share(now).max(0.99f32.min(share(now) * 2.0 + 0.01)),
            );
            self.pass(spp, guide, span)?;
            rendered += spp;
        }
        Ok(())
    }

    fn pass(
        &mut self,
        spp: u32,
        guide: Option<&dyn Guide>,
        span: (f32, f32),
    ) -> Result<(), RenderError> {
        let mixture = Mixture {
            uniform_fraction: self.options.uniform_fraction,
        };
        let pass = Pass {
            phase: Phase::Render,
            first_sample: self.next_sample,
            spp,
            guide: guide.map(|g| (g, mixture)),
            record: 0.0,
            span,
        };
        let result = self.context.render(&pass, &mut self.image)?;
        self.rendered.add(&result.statistics);
        self.next_sample += spp;
        let kind = if guide.is_some() {
            PassKind::Guided
        } else {
            PassKind::Uniform
        };
        self.passes.push(PassPlan {
            kind,
            spp,
            record: 1.0,
        });
        Ok(())
    }

    fn finish(mut self, guide: Option<Arc<dyn Guide>>) -> Outcome {
        // A guide that was learned just as the time ran out drew nothing, and is not what was rendered with.
        let drawn = self.passes.iter().any(|p| p.kind == PassKind::Guided);
        if let Some(unused) = guide.as_ref().filter(|_| !drawn) {
            let name = unused.name();
            self.notes.push(format!(
                "{name}: the time was out after training; none is used"
            ));
        }
        let guide = guide.filter(|_| drawn);
        let [width, height] = self.context.tracer.scene().film().crop_size();
        let film = self.image.develop();
        let mut all = self.pilot;
        all.add(&self.rendered);
        if all.counts.non_finite > 0 {
            self.notes.push(format!(
                "{} paths were not finite and count as zero",
                all.counts.non_finite
            ));
        }
        if all.counts.nonzero == 0 {
            let why = if self.context.tracer.scene().emitters().is_empty() {
                "the scene has no emitter"
            } else if all.counts.paths_found == 0 {
                "no path found all its vertices"
            } else {
                "no path carried light"
            };
            self.notes.push(format!("the image is black: {why}"));
        }
        Outcome {
            width,
            height,
            film,
            chosen: guide
                .as_ref()
                .map_or_else(|| "none".to_owned(), |g| g.name().to_owned()),
            uniform_fraction: if guide.is_some() {
                self.options.uniform_fraction
            } else {
                1.0
            },
            guide,
            notes: self.notes,
            training: self.training,
            passes: self.passes,
            pilot: self.pilot,
            rendered: self.rendered,
            in_image: if self.options.keep_pilot {
                all
            } else {
                self.rendered
            },
            seconds: self.seconds,
            threads: self.context.pool.current_num_threads(),
        }
    }
}
