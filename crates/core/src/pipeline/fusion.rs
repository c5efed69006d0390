//! Stage II: planning it, adding it later, and running it on the result of stage I.

use super::solver::check_memory;
use super::{Pipeline, PlanError, Polarization};
use crate::image::{Size, Stack};
use crate::refine;

/// Stage II with its buffers.
#[derive(Debug)]
pub(super) struct Fusion {
    pub(super) plan: refine::Plan,
    workspace: refine::Workspace,
    /// Angles of stage I alone, `[C, P, H, W]`.
    pub(super) stage1: Stack<f32>,
}

impl Pipeline {
    /// Adds stage II where it fits into `limit` bytes beside all other stages, modelling of light from beyond the frame included. Otherwise
    /// the pipeline stays as it is. The pipeline keeps to the lower one of `limit` and its memory limit from then on. Allocates.
    ///
    /// # Errors
    /// [`PlanError::Memory`] where it does not fit, or why the network cannot be run.
    ///
    /// # Panics
    /// For a pipeline that has a stage II, and for a device without a mask: there is no polarization to refine.
    pub fn add_fusion(&mut self, network: &refine::Network, limit: usize) -> Result<(), PlanError> {
        assert!(self.fusion.is_none(), "there is a stage II already");
        let operators = self.fields[0].frame_operators(&self.device, &self.settings, &self.workers)?;
        let plan = refine::Plan::new(network, &operators)?;
        let (planes, size) = (self.device.sensor.channels * self.angles.len(), self.size());
        let stage = ("fusion", Fusion::bytes(&plan, planes, size));
        let beside = [stage, ("the other field", self.field_bytes())];
        let limit = limit.min(self.settings.memory_limit_bytes);
        check_memory(self.stages().chain(beside), limit)?;
        self.fusion = Some(Fusion::new(plan, planes, size)?);
        self.fixed.push(stage);
        self.settings.fusion = Some(network.clone());
        self.settings.memory_limit_bytes = limit;
        Ok(())
    }

    /// Runs stage II if `run` says so; `sigma` is the noise of the readings. The result of stage I is kept in any case.
    pub(super) fn refine(&mut self, sigma: f32, run: bool) -> Option<refine::Report> {
        let Fusion { plan, workspace, stage1 } = self.fusion.as_mut()?;
        let Polarization { stokes, angles, .. } = &mut self.result;
        let field = self.fields[0].field();
        match &self.fields[0].solver.output {
            Some(solved) => field.crop_planes(solved, stage1),
            None => self.polarization.to_angle_images(stokes, stage1),
        }
        if !run {
            return None;
        }
        let input = refine::Input { raw: self.fields[0].raw(), weight: &self.readings.weight, sigma };
        let report = plan.run(&input, stokes, workspace);
        if let Some(angles) = angles.as_mut().filter(|_| report.is_learned()) {
            self.polarization.to_angle_images(stokes, angles);
        }
        Some(report)
    }
}

impl Fusion {
    pub(super) fn new(plan: refine::Plan, planes: usize, size: Size) -> Result<Self, PlanError> {
        Ok(Self { workspace: plan.make_workspace()?, plan, stage1: Stack::zeros(planes, size) })
    }

    /// Bytes of everything.
    pub(super) fn bytes(plan: &refine::Plan, planes: usize, size: Size) -> usize {
        plan.bytes() + plan.workspace_bytes() + planes * size.pixels() * size_of::<f32>()
    }
}
