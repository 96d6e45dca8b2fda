//! Which passes a budget is cut into.

use crate::choice::{GuideChoice, Left};
use crate::error::RenderError;
use crate::estimator::Run;
use crate::options::{Budget, Options, PassKind, PassPlan};

/// Share of a time budget that the pilot may take, for a guide that is trained once and for one that is refined: later
/// passes, of whose paths more carry light, teach the latter, too.
const PILOT_TIME: [f64; 2] = [1.0 / 7.0, 1.0 / 10.0];
/// Under `--spp`, one sample in so many is the pilot's, likewise, and for a guide that is refined at next to no cost.
const PILOT_DIVISOR: [u32; 3] = [4, 8, 32];

/// Share of a time budget that training is planned to take; what takes longer than the whole is given up.
const TRAINING_TIME: f64 = 0.3;
/// Paths that carry light of which a guide that is refined at next to no cost is first learned; a pilot that has found as
/// many ends, and may have taken no more than [`LEAST_PILOT_TIME`].
const ENOUGH_TO_START: f64 = 65_536.0;
const LEAST_PILOT_TIME: f64 = 1.0 / 40.0;

/// Records beyond which room is made as they come, and paths a second beyond which none does.
const MOST_RESERVED: usize = 4_000_000;
const MOST_PATHS_PER_SECOND: f64 = 1e8;

/// How much more light the paths of a pass are taken to carry, at most, than those of the pass before: where the first
/// guide comes between them, and else.
const FIRST_GUIDED: f64 = 4.0;
const NEXT_PASS: f64 = 1.25;

/// Share of the time before a snapshot that a pass is planned to take: one that takes a quarter longer still is in time.
/// The next pass uses the rest.
const BEFORE_SNAPSHOT: f64 = 0.8;

impl Run<'_> {
    /// Passes that follow from the number of samples alone: a pilot, then, while there is something to learn, as many
    /// samples as there are already, and all the rest where less than half as many again would be left.
    pub(crate) fn by_samples(&mut self, total: u32) -> Result<(), RenderError> {
        let refines = self.options.guide.refines();
        if self.options.guide.learns() {
            let cheap = self.refines_cheaply();
            let divisor = PILOT_DIVISOR[usize::from(refines) + usize::from(cheap)];
            let usual = (total / divisor).max(1);
            let spp = self.options.pilot_spp.unwrap_or(usual).min(total);
            let record = self.record_share(PassKind::Pilot, spp);
            self.pass(PassKind::Pilot, spp, record, (0.0, 1.0))?;
        }
        let first = self.next_sample;
        while self.next_sample < total {
            let left = total - self.next_sample;
            self.learn(self.left(f64::from(left), None))?;
            let doubled = self.next_sample.max(1);
            let last = self.current.settled || !refines || left < doubled + doubled.div_ceil(2);
            let spp = if last { left } else { doubled };
            let record = if last {
                0.0
            } else {
                self.record_share(self.kind(), spp)
            };
            let share = |n: u32| (n - first) as f32 / (total - first) as f32;
            let span = (share(self.next_sample), share(self.next_sample + spp));
            self.pass(self.kind(), spp, record, span)?;
        }
        Ok(())
    }

    /// The passes of a record; before each guided one the guide is learned as it was then.
    pub(crate) fn by_record(&mut self, passes: &[PassPlan]) -> Result<(), RenderError> {
        let of = |pilot: bool| {
            let same = passes
                .iter()
                .filter(move |p| (p.kind == PassKind::Pilot) == pilot);
            same.map(|p| p.spp).sum::<u32>() as f32
        };
        let mut done = [0; 2];
        for pass in passes {
            let pilot = pass.kind == PassKind::Pilot;
            if pass.kind == PassKind::Guided {
                self.learn_again(pass)?;
            }
            let done = &mut done[usize::from(pilot)];
            let span = (
                *done as f32 / of(pilot),
                (*done + pass.spp) as f32 / of(pilot),
            );
            *done += pass.spp;
            self.pass(pass.kind, pass.spp, pass.record, span)?;
        }
        Ok(())
    }

    /// A pilot, then passes that double, the last one cut to what the measured speed leaves time for. At least one sample
    /// a pixel is rendered, however short the time.
    pub(crate) fn by_time(&mut self, time: f64) -> Result<(), RenderError> {
        let mut uniform = None;
        if self.options.guide.learns() {
            self.timed_pilot(time)?;
            uniform = Some(self.seconds.pilot / f64::from(self.next_sample));
        }
        let refines = self.options.guide.refines();
        let begin = self.clock.elapsed().as_secs_f64();
        let (mut spp, mut each): (u32, Option<f64>) = (1, None);
        let mut largest = spp;
        loop {
            let now = self.clock.elapsed().as_secs_f64();
            if now >= time && !self.passes.is_empty() && (self.options.keep_pilot || each.is_some())
            {
                break;
            }
            if let Some(uniform) = uniform {
                self.learn(self.left((time - now).max(0.0) / uniform, Some(uniform)))?;
            }
            let now = self.clock.elapsed().as_secs_f64();
            if now >= time && !self.passes.is_empty() && (self.options.keep_pilot || each.is_some())
            {
                break;
            }
            let mut teaches = refines && !self.current.settled;
            if let Some(each) = each {
                // What a snapshot cut short does not slow the doubling down.
                let doubled = if teaches {
                    self.learning_due().saturating_sub(self.next_sample).max(1)
                } else {
                    2 * largest
                };
                // What the rest of the time holds may be too little to learn again.
                teaches &= (time - now) / each >= f64::from(doubled);
                spp = doubled
                    .min(self.affordable(each, time))
                    .min(Options::MOST_SPP.saturating_sub(self.next_sample));
                if spp == 0 {
                    break;
                }
            }
            let record = if teaches {
                self.record_share(self.kind(), spp)
            } else {
                0.0
            };
            let share = |t: f64| ((t - begin) / (time - begin).max(1e-9)).clamp(0.0, 1.0) as f32;
            let span = (
                share(now),
                share(now).max(0.99f32.min(share(now) * 2.0 + 0.01)),
            );
            // By the render's own clock, which snapshots do not run down.
            let start = self.clock.elapsed().as_secs_f64();
            self.pass(self.kind(), spp, record, span)?;
            each = Some((self.clock.elapsed().as_secs_f64() - start) / f64::from(spp));
            largest = largest.max(spp);
        }
        Ok(())
    }

    /// Samples per pixel that are done, at `each` seconds, before the next snapshot, or before the first one that leaves
    /// time for any, or before the end.
    fn affordable(&self, each: f64, end: f64) -> u32 {
        let now = self.clock.elapsed().as_secs_f64();
        let fit = |until: f64| ((until - now) / each).clamp(0.0, f64::from(1 << 20));
        let before = |snapshot: f64| match fit(snapshot) {
            one if one < 2.0 => one as u32,
            many => (many * BEFORE_SNAPSHOT) as u32,
        };
        let mut snapshots = self.snapshots.pending().map(before);
        snapshots
            .find(|spp| *spp > 0)
            .unwrap_or_else(|| fit(end) as u32)
    }

    /// Seconds of training that each path of the guide that was asked for costs.
    fn seconds_per_path(&self) -> f64 {
        let dims = self.context.tracer.columns().learned();
        match &self.options.guide {
            GuideChoice::Learn(learner) => learner.seconds_per_path(dims),
            _ => 0.0,
        }
    }

    /// Whether the guide is refined at next to no cost: then a short pilot will do, since better paths soon teach it.
    fn refines_cheaply(&self) -> bool {
        self.options.guide.refines() && self.seconds_per_path() == 0.0
    }

    /// One sample a pixel, then as many more as its measured speed allows (or as were asked for), of which no
    /// more paths are kept than the guide can be trained on in its share of the time.
    fn timed_pilot(&mut self, time: f64) -> Result<(), RenderError> {
        let seconds_per_path = self.seconds_per_path();
        let refines = self.options.guide.refines();
        let start = self.clock.elapsed().as_secs_f64();
        let pixels = self.context.tracer.scene().film().pixels() as f64;
        let affordable = time * TRAINING_TIME / seconds_per_path.max(f64::MIN_POSITIVE);
        // How many paths carry light is not known yet; a quarter of all is on the high side.
        let first = (4.0 * affordable / pixels).min(1.0) as f32;
        let first = first.min(self.record_share(PassKind::Pilot, 1));
        self.pass(PassKind::Pilot, 1, first, (0.0, 0.1))?;
        let each = self.clock.elapsed().as_secs_f64() - start;
        let lit = self.pilot.counts.nonzero as f64;
        let more = match self.options.pilot_spp {
            Some(spp) => spp - 1,
            None => {
                let within =
                    |share: f64| ((time * share - each) / each).clamp(0.0, f64::from(1 << 20));
                let most = within(PILOT_TIME[usize::from(refines)]);
                let enough = if self.refines_cheaply() {
                    (ENOUGH_TO_START / lit.max(1.0)).max(within(LEAST_PILOT_TIME))
                } else {
                    self.most_kept() as f64 / lit.max(1.0)
                };
                most.min(enough) as u32
            }
        };
        if more == 0 {
            return Ok(());
        }
        let left = (affordable - self.records.len() as f64).max(0.0);
        let record = (left / (lit * f64::from(more)).max(1.0)).min(1.0) as f32;
        let record = record.min(self.record_share(PassKind::Pilot, more));
        let mut left = more;
        while left > 0 {
            let spp = self.affordable(each, f64::INFINITY).clamp(1, left);
            let done = |left: u32| 1.0 - 0.9 * left as f32 / more as f32;
            let span = (done(left), done(left - spp));
            self.pass(PassKind::Pilot, spp, record, span)?;
            left -= spp;
        }
        Ok(())
    }

    /// Makes room for all records at once, as far as so many can come and their number is no wish beyond what memory holds.
    /// Returns the share of them that there is room for.
    pub(crate) fn reserve_records(&mut self) -> f32 {
        let film = self.context.tracer.scene().film().pixels() as f64;
        let paths = match &self.options.budget {
            Budget::Spp(spp) => film * f64::from(*spp),
            Budget::Time(time) => time * MOST_PATHS_PER_SECOND,
            Budget::Replay(passes) => film * passes.iter().map(|p| f64::from(p.spp)).sum::<f64>(),
        };
        let most = self.max_records.min(MOST_RESERVED) as f64;
        let width = self.context.tracer.columns().learned();
        let contexts = self.options.guide.looks_at_contexts();
        let wanted = most.min(paths) as usize;
        let room = self.records.reserve(wanted, width, contexts);
        if room < wanted {
            self.max_records = room;
            self.short_of_memory = true;
        }
        room as f32 / wanted.max(1) as f32
    }

    /// Share of the light-carrying paths of a pass of `spp` to keep, as many as [`Self::most_kept`] if about as many carry
    /// light as in the pass before. At random, since every other rule would prefer a part of the image.
    fn record_share(&self, kind: PassKind, spp: u32) -> f32 {
        let traced = f64::from(spp) * f64::from(self.options.survival);
        let paths = self.context.tracer.scene().film().pixels() as f64 * traced;
        let guided = |p: &PassPlan| p.kind == PassKind::Guided;
        let more = match self.passes.last() {
            None => 1.0,
            Some(last) if kind == PassKind::Guided && !guided(last) => FIRST_GUIDED,
            Some(_) => NEXT_PASS,
        };
        let lit = (more * self.lit).min(1.0) * paths;
        (self.most_kept() as f64 / lit.max(1.0)).min(1.0) as f32
    }

    /// Most paths of one pass that are kept: half of all, if more passes are to teach, whatever there is already gives
    /// way to them.
    pub(crate) fn most_kept(&self) -> usize {
        let most = self.max_records;
        if self.options.guide.refines() {
            most.div_ceil(2)
        } else {
            most.saturating_sub(self.records.len())
        }
    }

    fn kind(&self) -> PassKind {
        match self.current.guide {
            Some(_) => PassKind::Guided,
            None => PassKind::Uniform,
        }
    }

    /// What is left of the budget: samples per pixel, of which roulette lets a share be traced, and the measured seconds of
    /// one on all threads.
    fn left(&self, spp: f64, each: Option<f64>) -> Left {
        let pixels = self.context.tracer.scene().film().pixels() as f64;
        let traced = pixels * f64::from(self.options.survival);
        let threads = self.context.pool.current_num_threads();
        Left {
            paths: spp * traced,
            seconds_per_path: each.map(|each| each * threads as f64 / traced),
            threads,
            found: self.pilot.counts.paths_found as f64
                / (self.pilot.counts.camera_rays as f64).max(1.0),
        }
    }
}
