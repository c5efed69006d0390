//! Settings that can be changed while the service runs.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

/// Most iterations that can be set at run time.
pub(super) const MAX_ITERATIONS: usize = 1000;
/// Reason why results are not refined by a fusion model.
pub(super) const NO_MODEL: &str = "no fusion model is loaded";

/// Settings of the solver, shared between threads.
#[derive(Debug)]
pub(super) struct Controls {
    /// Whether watchers may change anything.
    pub(super) allowed: bool,
    /// Whether there is a fusion model.
    pub(super) model: bool,
    iterations: AtomicUsize,
    fused: AtomicBool,
}

impl Controls {
    /// Settings at the start. A fusion model runs if there is one.
    pub(super) fn new(allowed: bool, iterations: usize, model: bool) -> Self {
        Self { allowed, model, iterations: AtomicUsize::new(iterations), fused: AtomicBool::new(model) }
    }

    /// Whether the fusion model is to refine results.
    pub(super) fn fused(&self) -> bool {
        self.fused.load(Ordering::Relaxed)
    }

    pub(super) fn set_fused(&self, fused: bool) {
        self.fused.store(fused, Ordering::Relaxed);
    }

    /// Iterations that the user asks for.
    pub(super) fn iterations(&self) -> usize {
        self.iterations.load(Ordering::Relaxed)
    }

    pub(super) fn set_iterations(&self, iterations: usize) {
        self.iterations.store(iterations, Ordering::Relaxed);
    }
}
