//! Refitting the size of the PSF: everything that was computed from the PSF is computed again.

use super::solver::{distinct_bytes, polarized_modes, slow_modes};
use super::{Notice, Pipeline, PlanError, Warning};
use crate::optics::Coarse;

/// Largest change of the PSF's size that is followed: beyond, it is another diffuser, or at another place.
const LARGEST_GROWTH: f64 = 0.06;

impl Pipeline {
    /// Takes the PSF to be `growth` times as large as until now and computes everything from it again. Returns a warning where that is not
    /// possible. Allocates.
    pub(super) fn refit_psf(&mut self, growth: f64) -> Result<Option<Warning>, PlanError> {
        let Some(psf) = &self.psf else { return Ok(None) };
        let scale = self.psf_scale * growth;
        if (scale - 1.0).abs() > LARGEST_GROWTH {
            return Ok(Some(Warning::PsfOutOfRange { scale, largest: LARGEST_GROWTH }));
        }
        let again = self.operators[0].kernel.bytes() * psf.count()
            + distinct_bytes(&self.guided_modes)
            + self.operators[0].convolver.scratch_bytes()
            + Coarse::planning_bytes(self.size());
        let total = again + self.stages().map(|(_, bytes)| bytes).sum::<usize>();
        let limit = self.settings.memory_limit_bytes;
        if total > limit {
            return Ok(Some(Warning::PsfNotFollowed { scale, needed: total, limit }));
        }
        self.notices.push(Notice::PsfRefitted { scale });
        let operators = self.operators[0].behind(&psf.scaled(scale), self.operators.len());
        let guided_modes = if self.guided_modes.is_empty() { Vec::new() } else { slow_modes(&operators) };
        self.prepare.set_optics(&operators, &guided_modes);
        self.prepared.forget();
        self.spare = None;
        self.solver.set_optics(&operators, &polarized_modes(&guided_modes))?;
        self.fusion.iter_mut().for_each(|fusion| fusion.plan.set_optics(&operators));
        (self.operators, self.guided_modes, self.psf_scale) = (operators, guided_modes, scale);
        Ok(None)
    }
}
