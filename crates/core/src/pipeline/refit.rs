//! Refitting the size of the PSF: everything that was computed from the PSF is computed again.

use std::sync::Arc;

use super::reconstruction::Reconstruction;
use super::solver::{distinct_bytes, polarized_modes, slow_modes};
use super::{Notice, Pipeline, PlanError, Warning};
use crate::optics::{Coarse, Psf};
use crate::parallel::Workers;
use crate::solve::Method;

/// Largest change of the PSF's size that is followed: beyond, it is another diffuser, or at another place.
const LARGEST_GROWTH: f64 = 0.06;

impl Pipeline {
    /// Whether the size of the PSF is refitted.
    pub(super) fn refits_psf(&self) -> bool {
        // The image of a point behind a lens is smaller than what could be told of its size.
        self.settings.refit_psf && self.method == Method::Guided && !self.device.psf.is_of_lens()
    }

    /// Takes the PSF to be `growth` times as large as until now and computes everything from it again. Returns a warning where that is not
    /// possible. Allocates.
    pub(super) fn refit_psf(&mut self, growth: f64) -> Result<Option<Warning>, PlanError> {
        let scale = self.fields[0].psf_scale * growth;
        if (scale - 1.0).abs() > LARGEST_GROWTH {
            return Ok(Some(Warning::PsfOutOfRange { scale, largest: LARGEST_GROWTH }));
        }
        let total =
            self.fields[0].bytes_again(self.device.psf.count()) + self.stages().map(|(_, bytes)| bytes).sum::<usize>();
        let limit = self.settings.memory_limit_bytes;
        if total > limit {
            return Ok(Some(Warning::PsfNotFollowed { scale, needed: total, limit }));
        }
        self.notices.push(Notice::PsfRefitted { scale });
        let psf = self.device.psf.scaled(scale);
        self.set_psf(&psf, scale)?;
        Ok(None)
    }

    /// Takes `psf`, of `scale` times the calibrated size, for the present field and stage II. Allocates.
    pub(super) fn set_psf(&mut self, psf: &Psf, scale: f64) -> Result<(), PlanError> {
        self.fields[0].set_psf(psf, scale)?;
        match &mut self.fusion {
            Some(fusion) if self.fields[0].field().margin().is_none() => {
                fusion.plan.set_optics(&self.fields[0].operators);
            }
            Some(fusion) => fusion.plan.set_psf(psf),
            None => {}
        }
        Ok(())
    }
}

impl Reconstruction {
    /// Bytes that computing everything again for another of `count` PSFs takes, beside what is held.
    fn bytes_again(&self, count: usize) -> usize {
        let convolver = &self.operators[0].convolver;
        let threads = convolver.workers().threads();
        let frame = convolver.field().frame();
        // The scaled PSF, and the line that is stretched.
        let psf = (count * frame.pixels() + 2 * frame.width.max(frame.height)) * size_of::<f32>();
        psf + self.operators[0].kernel.bytes() * count
            + distinct_bytes(&self.guided_modes)
            + Coarse::planning_bytes(convolver.size(), threads)
            + threads * convolver.on(Arc::new(Workers::new(1))).scratch_bytes()
    }

    /// Computes everything from another PSF, of `scale` times the calibrated size. Allocates.
    pub(super) fn set_psf(&mut self, psf: &Psf, scale: f64) -> Result<(), PlanError> {
        let operators = self.operators[0].behind(psf, self.operators.len());
        let guided_modes = if self.guided_modes.is_empty() { Vec::new() } else { slow_modes(&operators) };
        self.prepare.set_optics(&operators, &guided_modes);
        self.prepared.forget();
        self.spare = None;
        self.solver.set_optics(&operators, &polarized_modes(&guided_modes))?;
        (self.operators, self.guided_modes, self.psf_scale) = (operators, guided_modes, scale);
        Ok(())
    }
}
