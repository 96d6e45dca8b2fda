//! The image so far, at shorter times of a timed render.
//!
//! A snapshot is the last image that was complete when its time was over; `schedule` cuts passes so that one ends shortly
//! before. What making it takes is not charged to the render: the clock is put forward by it.

use std::collections::VecDeque;
use std::time::Instant;

use pss_render::Developed;

use crate::estimator::{Outcome, Run};
use crate::options::Combine;

/// The image so far at one time.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// Seconds that were asked for. [`Outcome::elapsed`] tells what was used: no more than this, unless the very first
    /// image took longer.
    pub time: f64,
    /// What there was. Its passes are the first ones of the whole render, and replay its image.
    pub outcome: Outcome,
}

/// Snapshots to come, and those that were taken.
#[derive(Default)]
pub(crate) struct Snapshots {
    pending: VecDeque<f64>,
    /// The image before the pass that is under way, and how many passes are in it; with weights by variance it is not
    /// developed yet.
    held: Option<(Outcome, usize)>,
    pub(crate) taken: Vec<Snapshot>,
}

impl Snapshots {
    /// None yet; `times` increase.
    pub(crate) fn at(times: &[f64]) -> Self {
        Self {
            pending: times.iter().copied().collect(),
            ..Self::default()
        }
    }

    /// Times to come.
    pub(crate) fn pending(&self) -> impl Iterator<Item = f64> {
        self.pending.iter().copied()
    }
}

impl Run<'_> {
    /// After each pass: takes the snapshots whose time ended with it or in it, and holds the image for the others.
    pub(crate) fn note_image(&mut self) {
        if self.snapshots.pending.is_empty() || !self.has_image() {
            return;
        }
        let start = Instant::now();
        let now = self.clock.elapsed().as_secs_f64();
        while self.snapshots.pending.front().is_some_and(|t| *t < now) {
            if self.snapshots.held.is_none() {
                self.hold(now);
            }
            self.take_snapshot();
        }
        if !self.snapshots.pending.is_empty() {
            self.hold(now);
        }
        self.clock += start.elapsed();
    }

    /// At the end: what is pending gets the last image.
    pub(crate) fn note_end(&mut self) {
        let start = Instant::now();
        while !self.snapshots.pending.is_empty() && self.snapshots.held.is_some() {
            self.take_snapshot();
        }
        self.clock += start.elapsed();
    }

    fn hold(&mut self, now: f64) {
        let film = match self.options.combine {
            Combine::Samples => self.develop(0),
            // Passes kept apart do not change any more, and weighing them takes time.
            Combine::Variance => Developed {
                image: Vec::new(),
                variance: Vec::new(),
                found: Vec::new(),
                nonzero: Vec::new(),
            },
        };
        self.snapshots.held = Some((self.outcome(film, now), self.passes_apart()));
    }

    fn take_snapshot(&mut self) {
        let held = self.snapshots.held.clone();
        let time = self.snapshots.pending.pop_front();
        if let (Some((mut outcome, apart)), Some(time)) = (held, time) {
            if self.options.combine == Combine::Variance {
                outcome.film = self.develop(apart);
                outcome.diagnostics.see(&outcome.film);
            }
            self.snapshots.taken.push(Snapshot { time, outcome });
        }
    }
}
