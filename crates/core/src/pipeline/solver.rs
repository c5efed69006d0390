//! The solver of a pipeline with its buffers, and changing to another one for frames without a usable guide.

use std::sync::Arc;

use super::{Pipeline, PlanError, Settings};
use crate::image::Stack;
use crate::optics::{Coarse, StokesOperator};
use crate::solve::{self, Method};

/// Iterations of each method where the settings give none.
const ITERATIONS: [(Method, usize); 8] = [
    (Method::Guided, 20),
    (Method::Stokes, 60),
    (Method::Fista, 300),
    (Method::FistaPublished, 500),
    (Method::FistaPublishedScaled, 500),
    (Method::FistaPublishedFrame, 500),
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
    /// State after the last frame of a video.
    pub(super) last: Option<solve::Continuation>,
    /// Angle images of an angle method; a Stokes method writes into the pipeline's result.
    pub(super) output: Option<Stack<f32>>,
}

impl Solver {
    /// Bytes of the workspace and of the state kept between frames of a video.
    pub(super) fn bytes(&self) -> usize {
        self.plan.workspace_bytes() + self.last.as_ref().map_or(0, |_| self.plan.continuation_bytes())
    }

    /// Plans and allocates a method, if it fits beside the `fixed` stages.
    pub(super) fn plan(
        operators: &[StokesOperator],
        coarse: &[Arc<Coarse>],
        method: Method,
        settings: &Settings,
        fixed: &[(&'static str, usize)],
    ) -> Result<Self, PlanError> {
        if settings.iterations == Some(0) {
            return Err(PlanError::NoIterations);
        }
        let iterations = ITERATIONS.iter().find(|(m, _)| *m == method).map_or(1, |(_, n)| *n);
        let plan = solve::Plan::new(&solve::Spec { method, operators, coarse })?;
        let kept = if settings.video { plan.continuation_bytes() } else { 0 };
        let stages: Vec<_> =
            fixed.iter().copied().chain([("recon", plan.workspace_bytes() + plan.bytes() + kept)]).collect();
        check_memory(stages, settings.memory_limit_bytes)?;
        let size = operators[0].field().size();
        let output = method.solves_angles().then(|| Stack::zeros(operators.len() * plan.planes(), size));
        let last = settings.video.then(|| plan.make_continuation());
        Ok(Self { workspace: plan.make_workspace(), last, plan, iterations, output })
    }

    /// Changes to another PSF and forgets the last frame of a video. Allocates.
    pub(super) fn set_optics(&mut self, operators: &[StokesOperator], coarse: &[Arc<Coarse>]) -> Result<(), PlanError> {
        let method = self.plan.method();
        self.plan = solve::Plan::new(&solve::Spec { method, operators, coarse })?;
        self.last.iter_mut().for_each(solve::Continuation::forget);
        Ok(())
    }
}

impl Pipeline {
    /// Makes the solver of `method` the current one. Allocates the first time, and whenever the memory limit does not allow for both.
    pub(super) fn take_turns(&mut self, method: Method) -> Result<(), PlanError> {
        let (now, others) = self.fields.split_at_mut(1);
        let now = &mut now[0];
        if method == now.solver.plan.method() {
            return Ok(());
        }
        if let Some(spare) = now.spare.as_mut().filter(|s| s.plan.method() == method) {
            std::mem::swap(&mut now.solver, spare);
            return Ok(());
        }
        let other = others.first().map(|other| ("the other field", other.bytes()));
        let fixed: Vec<_> = self.fixed.iter().chain(&now.fixed).copied().chain(other).collect();
        let plan = |fixed: &[(&'static str, usize)]| {
            Solver::plan(&now.operators, &polarized_modes(&now.guided_modes), method, &self.settings, fixed)
        };
        let present = now.solver.bytes() + now.solver.plan.bytes();
        let mut both = fixed.clone();
        both.push(("recon, present", present));
        match plan(&both) {
            Ok(new) => now.spare = Some(std::mem::replace(&mut now.solver, new)),
            Err(PlanError::Memory { .. }) => now.solver = plan(&fixed)?,
            Err(other) => return Err(other),
        }
        Ok(())
    }
}

/// Refuses stages that need more than `limit` bytes together.
pub(super) fn check_memory(
    stages: impl IntoIterator<Item = (&'static str, usize)>,
    limit: usize,
) -> Result<(), PlanError> {
    let stages: Vec<_> = stages.into_iter().collect();
    let total = stages.iter().map(|(_, bytes)| bytes).sum();
    if total > limit { Err(PlanError::Memory { stages, total, limit }) } else { Ok(()) }
}

/// Normal equations of the low-frequency modes and of a guide's gain, for each operator. Channels with one PSF share them. Allocates.
pub(super) fn slow_modes(operators: &[StokesOperator]) -> Vec<Arc<Coarse>> {
    let mut all: Vec<Arc<Coarse>> = Vec::with_capacity(operators.len());
    for (c, operator) in operators.iter().enumerate() {
        let same = operators[..c].iter().position(|o| Arc::ptr_eq(&o.kernel, &operator.kernel));
        all.push(same.map_or_else(|| Arc::new(Coarse::beside_guide(operator)), |i| Arc::clone(&all[i])));
    }
    all
}

/// The equations of the polarized part alone, shared in the same way. Allocates.
pub(super) fn polarized_modes(guided_modes: &[Arc<Coarse>]) -> Vec<Arc<Coarse>> {
    let mut all: Vec<Arc<Coarse>> = Vec::with_capacity(guided_modes.len());
    for (c, coarse) in guided_modes.iter().enumerate() {
        let same = guided_modes[..c].iter().position(|modes| Arc::ptr_eq(modes, coarse));
        all.push(same.map_or_else(|| Arc::new(coarse.leading(2)), |i| Arc::clone(&all[i])));
    }
    all
}

/// Bytes of normal equations; shared ones count once.
pub(super) fn distinct_bytes(modes: &[Arc<Coarse>]) -> usize {
    let shared = |c: usize| modes[..c].iter().any(|earlier| Arc::ptr_eq(earlier, &modes[c]));
    (0..modes.len()).filter(|c| !shared(*c)).map(|c| modes[c].bytes()).sum()
}
