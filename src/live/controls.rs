//! Settings that can be changed while the service runs.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crate::model::Selection;

/// Most iterations that can be set at run time.
pub(super) const MAX_ITERATIONS: usize = 1000;

/// Settings of the solver, shared between threads.
#[derive(Debug)]
pub(super) struct Controls {
    /// Whether watchers may change anything.
    pub(super) allowed: bool,
    /// The fusion model, and why it is this one.
    pub(super) selection: Selection,
    iterations: AtomicUsize,
    fused: AtomicBool,
}

impl Controls {
    /// Settings at the start. A fusion model runs if there is one.
    pub(super) fn new(allowed: bool, iterations: usize, selection: Selection) -> Self {
        let fused = AtomicBool::new(selection.model.is_some());
        Self { allowed, selection, iterations: AtomicUsize::new(iterations), fused }
    }

    /// Whether there is a fusion model.
    pub(super) fn has_model(&self) -> bool {
        self.selection.model.is_some()
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
