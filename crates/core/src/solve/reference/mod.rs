//! The paper's solvers over angle intensities, for comparison: min ½‖w ⊙ (A x − b)‖² + λ·TV(x) over x ≥ 0, x = `[P, H, W]`.
//!
//! Each channel is solved by itself and from zero.

pub(super) mod admm;
pub(super) mod fista;
mod power;
mod tv;

use std::fmt;

use super::video::Continuation;
use super::{Buffers, Diverged, Input, Modelled, Outcome, Solver, own};
use crate::optics::{AngleOperator, Scratch};

/// A method planned for one channel.
pub(super) trait ChannelSolver: fmt::Debug + Send + Sync {
    /// Name of the workspace in memory reports.
    const NAME: &'static str;

    /// Buffers of one channel at a time.
    type Workspace: Buffers;

    /// The camera.
    fn operator(&self) -> &AngleOperator;

    fn make_workspace(&self) -> Self::Workspace;

    fn workspace_bytes(&self) -> usize;

    /// Reconstructs one channel from zero into `x`, `[P, H, W]`; returns the sum of squares of the weighted residual.
    fn run(
        &self,
        b: &[f32],
        weight: &[f32],
        iterations: usize,
        x: &mut [f32],
        w: &mut Self::Workspace,
    ) -> Result<f64, Diverged>;
}

impl<S: ChannelSolver> Solver for Vec<S> {
    fn make_workspace(&self) -> Box<dyn Buffers> {
        Box::new(self[0].make_workspace())
    }

    fn workspace_parts(&self) -> Vec<(&'static str, usize)> {
        vec![(S::NAME, self[0].workspace_bytes())]
    }

    fn run(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut [f32],
        workspace: &mut dyn Buffers,
        _: Option<&mut Continuation>,
    ) -> Result<Outcome, Diverged> {
        let w = own(workspace);
        let outputs = output.chunks_exact_mut(output.len() / self.len());
        let mut energy = 0.0;
        for (c, (solver, x)) in self.iter().zip(outputs).enumerate() {
            energy += solver.run(input.raw.plane(c), input.weight.plane(c), iterations, x, w)?;
        }
        Ok(Outcome::cold(Modelled::Angles, iterations, energy, self.len(), self[0].operator().convolver.field()))
    }
}

/// residual ← weight ⊙ (A x − b); its sum of squares.
fn residual(
    operator: &AngleOperator,
    x: &[f32],
    (b, weight): (&[f32], &[f32]),
    residual: &mut [f32],
    scratch: &mut Scratch,
) -> f64 {
    operator.forward(x, residual, scratch);
    let mut energy = 0.0;
    for (r, (b, w)) in residual.iter_mut().zip(b.iter().zip(weight)) {
        *r = w * (*r - b);
        energy += f64::from(*r * *r);
    }
    energy
}
