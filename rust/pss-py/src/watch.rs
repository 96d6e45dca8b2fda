//! Long work beside Python: another thread works, this one shows progress and listens for Ctrl-C.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::mpsc;
use std::time::Duration;

use pssflow::{Phase, Progress};
use pyo3::prelude::*;

/// How often Python is asked for signals and told of progress.
const TICK: Duration = Duration::from_millis(50);

/// What the worker shares with its watcher.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    cancelled: AtomicBool,
    /// Phase in the two low bits, thousandths done above them.
    state: AtomicU32,
}

impl Shared {
    /// Tells the worker to stop.
    pub(crate) fn cancel(&self) {
        self.cancelled.store(true, Ordering::Relaxed);
    }

    fn state(&self) -> (&'static str, f32) {
        let state = self.state.load(Ordering::Relaxed);
        let phase = match state & 3 {
            0 => Phase::Pilot,
            1 => Phase::Fit,
            _ => Phase::Render,
        };
        (phase.name(), (state >> 2) as f32 / 1000.0)
    }
}

impl Progress for Shared {
    fn update(&self, phase: Phase, done: f32) {
        let phase = match phase {
            Phase::Pilot => 0,
            Phase::Fit => 1,
            Phase::Render => 2,
        };
        let thousandths = (done.clamp(0.0, 1.0) * 1000.0) as u32;
        self.state
            .store(thousandths << 2 | phase, Ordering::Relaxed);
    }

    fn cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }
}

/// Runs `work` on a thread of its own, without the GIL.
///
/// Python's error (a signal, or what `progress` raised) wins over the result.
pub(crate) fn watched<T: Send>(
    py: Python<'_>,
    progress: Option<&Py<PyAny>>,
    work: impl FnOnce(&Shared) -> T + Send,
) -> PyResult<T> {
    let shared = &Shared::default();
    let (done, finished) = mpsc::channel();
    let watched = py.detach(move || {
        std::thread::scope(|scope| {
            let named = std::thread::Builder::new().name("pssflow-work".to_owned());
            // Not `scope.spawn`, which panics where the system has no memory for another thread's stack.
            let worker = named.spawn_scoped(scope, move || {
                let result = work(shared);
                // The watcher only leaves after this thread, so somebody listens.
                let _ = done.send(());
                result
            })?;
            let mut interrupt = None;
            // A panic drops the sender and ends the wait as well.
            while finished.recv_timeout(TICK) == Err(mpsc::RecvTimeoutError::Timeout) {
                if interrupt.is_some() {
                    continue;
                }
                let heard = Python::attach(|py| {
                    py.check_signals()?;
                    match progress {
                        Some(callback) => callback.call1(py, shared.state()).map(drop),
                        None => Ok(()),
                    }
                });
                if let Err(error) = heard {
                    shared.cancel();
                    interrupt = Some(error);
                }
            }
            Ok((worker.join(), interrupt))
        })
    });
    let (result, interrupt) = watched.map_err(|e: std::io::Error| {
        pyo3::exceptions::PyRuntimeError::new_err(format!("cannot start a thread: {e}"))
    })?;
    match (result, interrupt) {
        (_, Some(error)) => Err(error),
        (Ok(result), None) => Ok(result),
        (Err(_), None) => Err(pyo3::exceptions::PyRuntimeError::new_err(
            "internal error in the renderer: please report it with the scene and the command",
        )),
    }
}
