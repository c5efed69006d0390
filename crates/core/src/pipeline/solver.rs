//! A pipeline's solver with its buffers, and taking turns between two where S0 has to be solved for all of a sudden.

use std::sync::Arc;

use super::{Pipeline, PlanError, Settings};
use crate::image::Stack;
use crate::optics::{Coarse, StokesOperator};
use crate::solve::{self, Method};

/// Iterations when none are asked for.
const ITERATIONS: [(Method, usize); 6] = [
    (Method::Guided, 20),
    (Method::Stokes, 60),
    (Method::Fista, 300),
    (Method::FistaPublished, 500),
    (Method::Admm, 200),
    (Method::AdmmPublished, 200),
];

/// A planned method.
#[derive(Debug)]
pub(super) struct Solver {
    pub(super) plan: solve::Plan,
    /// Iterations where the settings give none.
    pub(super) iterations: usize,
    pub(super) workspace: solve::Workspace,
    /// Of the last frame of a video.
    pub(super) last: Option<solve::Continuation>,
    /// Result of an angle method, before polar; a Stokes method writes into the result itself.
    pub(super) output: Option<Stack<f32>>,
}

impl Solver {
    /// Bytes of the workspace, and of what is kept of a video's last frame.
    pub(super) fn bytes(&self) -> usize {
        self.plan.workspace_bytes() + self.last.as_ref().map_or(0, |_| self.plan.continuation_bytes())
    }

    /// Plans and allocates a method, if it fits beside the `fixed` stages.
    pub(super) fn plan(
        operators: &[StokesOperator],
        coarse: &[Arc<Coarse>],
        norms: &[f32],
        method: Method,
        settings: &Settings,
        fixed: &[(&'static str, usize)],
    ) -> Result<Self, PlanError> {
        if settings.iterations == Some(0) {
            return Err(PlanError::NoIterations);
        }
        let iterations = ITERATIONS.iter().find(|(m, _)| *m == method).map_or(1, |(_, n)| *n);
        let plan = solve::Plan::new(&solve::Spec { method, operators, coarse, norms })?;
        let kept = if settings.video { plan.continuation_bytes() } else { 0 };
        let stages: Vec<_> =
            fixed.iter().copied().chain([("recon", plan.workspace_bytes() + plan.bytes() + kept)]).collect();
        let total = stages.iter().map(|(_, bytes)| bytes).sum();
        if total > settings.memory_limit_bytes {
            return Err(PlanError::Memory { stages, total, limit: settings.memory_limit_bytes });
        }
        let size = operators[0].convolver.size();
        let output = method.solves_angles().then(|| Stack::zeros(operators.len() * plan.planes(), size));
        let last = settings.video.then(|| plan.make_continuation());
        Ok(Self { workspace: plan.make_workspace(), last, plan, iterations, output })
    }

    /// Solves behind another PSF from now on. What was made for the last one goes. Allocates.
    pub(super) fn set_optics(&mut self, operators: &[StokesOperator], coarse: &[Arc<Coarse>]) -> Result<(), PlanError> {
        let method = self.plan.method();
        self.plan = solve::Plan::new(&solve::Spec { method, operators, coarse, norms: &[] })?;
        self.last.iter_mut().for_each(solve::Continuation::forget);
        Ok(())
    }
}

impl Pipeline {
    /// Makes the solver of `method` the present one. Allocates the first time, and again whenever both do not fit.
    pub(super) fn take_turns(&mut self, method: Method) -> Result<(), PlanError> {
        if method == self.solver.plan.method() {
            return Ok(());
        }
        if let Some(spare) = self.spare.as_mut().filter(|s| s.plan.method() == method) {
            std::mem::swap(&mut self.solver, spare);
            return Ok(());
        }
        let plan = |fixed: &[(&'static str, usize)]| {
            Solver::plan(&self.operators, &polarized_modes(&self.beside), &[], method, &self.settings, fixed)
        };
        let present = self.solver.bytes() + self.solver.plan.bytes();
        let mut both = self.fixed.to_vec();
        both.push(("recon, present", present));
        match plan(&both) {
            Ok(new) => self.spare = Some(std::mem::replace(&mut self.solver, new)),
            Err(PlanError::Memory { .. }) => self.solver = plan(&self.fixed)?,
            Err(other) => return Err(other),
        }
        Ok(())
    }
}

/// The slow modes beside a guide of each operator; channels that share a PSF share them. Allocates.
pub(super) fn slow_modes(operators: &[StokesOperator]) -> Vec<Arc<Coarse>> {
    let mut all: Vec<Arc<Coarse>> = Vec::with_capacity(operators.len());
    for (c, operator) in operators.iter().enumerate() {
        let same = operators[..c].iter().position(|o| Arc::ptr_eq(&o.kernel, &operator.kernel));
        all.push(same.map_or_else(|| Arc::new(Coarse::beside_guide(operator)), |i| Arc::clone(&all[i])));
    }
    all
}

/// Those of the polarized part alone, shared in the same way.
pub(super) fn polarized_modes(beside: &[Arc<Coarse>]) -> Vec<Arc<Coarse>> {
    let mut all: Vec<Arc<Coarse>> = Vec::with_capacity(beside.len());
    for (c, coarse) in beside.iter().enumerate() {
        let same = beside[..c].iter().position(|b| Arc::ptr_eq(b, coarse));
        all.push(same.map_or_else(|| Arc::new(coarse.leading(2)), |i| Arc::clone(&all[i])));
    }
    all
}

/// What they hold, shared ones counted once.
pub(super) fn distinct_bytes(modes: &[Arc<Coarse>]) -> usize {
    let shared = |c: usize| modes[..c].iter().any(|earlier| Arc::ptr_eq(earlier, &modes[c]));
    (0..modes.len()).filter(|c| !shared(*c)).map(|c| modes[c].bytes()).sum()
}
