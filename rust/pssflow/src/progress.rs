//! How a render tells what it is doing, and how it is told to stop.

/// What is going on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// Random paths, kept for training.
    Pilot,
    /// Learning.
    Fit,
    /// Paths from the guide (or random ones where there is none).
    Render,
}

impl Phase {
    /// The name shown to users and used as a key of timings.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pilot => "pilot",
            Self::Fit => "fit",
            Self::Render => "render",
        }
    }
}

/// Listens to a render. Called from several threads.
pub trait Progress: Sync {
    /// `done` of the phase is finished, in [0, 1].
    fn update(&self, phase: Phase, done: f32);

    /// Whether to stop; asked every few milliseconds of work.
    fn cancelled(&self) -> bool;
}

/// Says nothing and never stops.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Progress for Silent {
    fn update(&self, _phase: Phase, _done: f32) {}

    fn cancelled(&self) -> bool {
        false
    }
}
