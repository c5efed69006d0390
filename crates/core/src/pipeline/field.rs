//! The part of the scene that is modelled: the frame alone, or the frame with a margin from which light reaches the sensor. Preparation
//! and, without a guide, the solution decide between the two.

use std::sync::Arc;

use super::reconstruction::Reconstruction;
use super::solver::check_memory;
use super::{Pipeline, PlanError, ProcessError, Settings, Warning};
use crate::device::Device;
use crate::guide::{self, PsfSize};
use crate::image::{Planes, Size};
use crate::optics::{self, Margin};
use crate::parallel::Workers;
use crate::solve::{self, Method};

/// Times that the PSF's size is refitted for one frame, at most.
const REFITS: usize = 3;

/// Frames in which light from beyond is not looked for after it was found to be none.
const QUIET: usize = 64;

impl Reconstruction {
    /// Plans the reconstruction of the first frame, and says whether its field needs no frame to tell about light from beyond. Allocates.
    pub(super) fn first(
        device: &Device,
        method: Method,
        settings: &Settings,
        workers: &Arc<Workers>,
        others: &[(&'static str, usize)],
    ) -> Result<(Self, bool), PlanError> {
        let frame_alone = least_margin(device, method);
        let plan =
            |margin| Self::new(device, (&device.psf, 1.0), margin, method, (settings, Arc::clone(workers)), others);
        // Most scenes go on beyond the frame, so a video begins with a field that does.
        let first = if method == Method::Guided && settings.video { device.margin } else { frame_alone };
        let planned = match plan(first) {
            Err(PlanError::Memory { .. }) if !first.is_none() => plan(frame_alone)?,
            planned => planned?,
        };
        Ok((planned, first == frame_alone))
    }
}

/// Margin of the field where no light from beyond the frame was found. The reference methods have no way to tell whether there is such
/// light; the published code always solves for twice the frame's sides.
fn least_margin(device: &Device, method: Method) -> Margin {
    let Size { width, height } = device.sensor.size;
    match method {
        Method::FistaPublished | Method::FistaPublishedScaled => Margin { columns: width / 2, rows: height / 2 },
        Method::Fista | Method::Admm | Method::AdmmPublished => device.margin,
        Method::FistaPublishedFrame | Method::Guided | Method::Stokes => Margin::default(),
    }
}

impl Pipeline {
    /// Bytes that modelling light from beyond the frame takes beside the stages, from the first frame on that shows such light; an
    /// estimate from the field's area. Zero for a device whose scene ends at the frame, for the methods that do not model it, and where it
    /// is modelled already.
    pub fn field_bytes(&self) -> usize {
        let modelled = self.method.solves_angles() || !self.fields[0].field().margin().is_none();
        if modelled { 0 } else { self.bytes_on_field(self.device.margin) }
    }

    /// Bytes of preparation and solver on a field with this margin, estimated from its area; zero without another field.
    fn bytes_on_field(&self, margin: Margin) -> usize {
        let field = optics::Field::new(self.size(), margin);
        if field == self.fields[0].field() {
            return 0;
        }
        (self.fields[0].bytes() as f64 * field.size().pixels() as f64 / self.fields[0].field().size().pixels() as f64)
            as usize
    }

    /// Forgets everything that earlier frames told: guide, size of the PSF, light from beyond the frame, and factors of nearly the same
    /// equations. Allocates where the PSF had another size.
    pub(super) fn begin_anew(&mut self) -> Result<(), ProcessError> {
        self.quiet = 0;
        if !self.fields[0].field().margin().is_none() {
            if self.fields.len() > 1 {
                self.fields.reverse();
            } else if !self.method.solves_angles() {
                // The frame before took the memory of the frame alone for its field.
                self.model_margin(Margin::default(), &mut Vec::new())?;
            }
        }
        self.forget()
    }

    /// Forgets what earlier frames told of guide, size of the PSF and nearly the same equations. Allocates where the PSF had another size.
    pub(super) fn forget(&mut self) -> Result<(), ProcessError> {
        self.fields.iter_mut().for_each(Reconstruction::forget);
        if self.fields[0].psf_scale.to_bits() != 1.0f64.to_bits() {
            let calibrated = self.device.psf.clone();
            self.set_psf(&calibrated, 1.0)?;
        }
        Ok(())
    }

    /// Whether the solution without a guide leaves light from beyond the frame in the readings.
    pub(super) fn tells_of_light(&mut self, outcome: &solve::Outcome) -> bool {
        let unguided = matches!(outcome.modelled, solve::Modelled::Both | solve::Modelled::Intensity);
        unguided
            && self.fields[0].field().margin().is_none()
            && self.fields[0].leaves_light(&self.result.stokes, outcome.sigma)
    }

    /// Prepares readings and guide for the solver, on the frame alone or with the margin from which light comes.
    pub(super) fn prepare(
        &mut self,
        guide: Option<Planes<'_>>,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        let asked = if self.refits_psf() { PsfSize::Asked } else { PsfSize::Given };
        let told = std::mem::replace(&mut self.told, true);
        if self.fields[0].field().margin().is_none() {
            return self.prepare_frame(guide, asked, warnings);
        }
        let beside = self.prepare_on_field(guide, if told { asked } else { PsfSize::Given }, false, warnings)?;
        if !told && beside.plainly_shows_light() {
            return self.refit_beside_light(beside, guide, asked, warnings);
        }
        if told && self.fields.len() > 1 && beside.leaves_light_open() {
            return self.look_at_frame_alone(beside, guide, asked, warnings);
        }
        if told && !beside.is_dark_beyond() || !self.model_margin(Margin::default(), warnings)? {
            return Ok(beside);
        }
        if !told {
            return self.prepare_frame(guide, asked, warnings);
        }
        self.quiet = QUIET;
        self.prepare_on_field(guide, asked, false, warnings)
    }

    /// Prepares the frame alone now and then, where a margin that the guide does not see may have turned dark. `beside` is the preparation
    /// on the present field.
    fn look_at_frame_alone(
        &mut self,
        beside: guide::Summary,
        guide: Option<Planes<'_>>,
        asked: PsfSize,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        if self.quiet > 0 {
            self.quiet -= 1;
            return Ok(beside);
        }
        self.model_margin(Margin::default(), warnings)?;
        self.fields[0].forget();
        let summary = self.prepare_frame(guide, asked, warnings)?;
        if !self.fields[0].field().margin().is_none() {
            self.quiet = QUIET;
        }
        Ok(summary)
    }

    /// Prepares readings and guide on the frame alone, and beside light from beyond it where they show such light.
    fn prepare_frame(
        &mut self,
        guide: Option<Planes<'_>>,
        asked: PsfSize,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        let look = self.quiet == 0;
        self.quiet = self.quiet.saturating_sub(1);
        self.ambiguous &= !look;
        // Without a guide of this scene the solution tells about light, not the preparation.
        let alone = self.prepare_on_field(guide, asked, look, warnings)?;
        if !alone.suspects_light {
            warnings.extend(self.ambiguous.then_some(Warning::LightOrBrightness));
            return Ok(alone);
        }
        if self.model_margin(self.device.margin, warnings)? {
            let beside = self.prepare_on_field(guide, PsfSize::Given, false, warnings)?;
            if beside.shows_light(&alone) {
                return self.refit_beside_light(beside, guide, asked, warnings);
            }
            self.ambiguous = beside.may_show_light(&alone);
            // No light after all.
            if !self.model_margin(Margin::default(), warnings)? {
                return Ok(beside);
            }
        }
        warnings.extend(self.ambiguous.then_some(Warning::LightOrBrightness));
        self.quiet = QUIET;
        self.prepare_on_field(guide, asked, false, warnings)
    }

    /// Prepares once more with the size of the PSF refitted beside much light from beyond the frame: only where the light is modelled does
    /// it not pass for another size. `beside` is the preparation with the size given.
    fn refit_beside_light(
        &mut self,
        beside: guide::Summary,
        guide: Option<Planes<'_>>,
        asked: PsfSize,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        if asked == PsfSize::Given || !beside.has_much_light() {
            return Ok(beside);
        }
        self.fields[0].prepared.forget();
        self.prepare_on_field(guide, asked, false, warnings)
    }

    /// Prepares readings and guide on the present field, and refits the size of the PSF where they show that it has changed.
    pub(super) fn prepare_on_field(
        &mut self,
        guide: Option<Planes<'_>>,
        mut psf_size: PsfSize,
        look: bool,
        warnings: &mut Vec<Warning>,
    ) -> Result<guide::Summary, ProcessError> {
        let mut refits = 0;
        loop {
            let summary = self.fields[0].prepare(&self.readings, guide, psf_size, look)?;
            let Some(growth) = summary.growth else { return Ok(summary) };
            let why_not = self.refit_psf(growth)?;
            refits += 1;
            psf_size = if why_not.is_none() && refits < REFITS { PsfSize::Refitted } else { PsfSize::Given };
            warnings.extend(why_not);
        }
    }

    /// Makes the reconstruction whose field has this margin the current one. Where the memory limit does not allow for both it replaces the
    /// present one. False, with a warning, where not even that fits. Allocates, unless both were planned before.
    pub(super) fn model_margin(&mut self, margin: Margin, warnings: &mut Vec<Warning>) -> Result<bool, PlanError> {
        let psf_scale = self.fields[0].psf_scale;
        if self.fields.len() == 1 {
            let estimate = [("the other field", self.bytes_on_field(margin))];
            let limit = self.settings.memory_limit_bytes;
            if check_memory(self.stages().chain(estimate), limit).is_err() {
                if let Err(PlanError::Memory { total: needed, .. }) =
                    check_memory(self.fixed.iter().copied().chain(estimate), limit)
                {
                    warnings.push(Warning::LightNotModelled { needed, limit });
                    return Ok(false);
                }
                self.fields.clear();
            }
            let present = self.fields.first().map(|present| ("the other field", present.bytes()));
            let others: Vec<_> = self.fixed.iter().copied().chain(present).collect();
            let psf = self.device.psf.scaled(psf_scale);
            let plan = |margin: Margin| {
                let with = (&self.settings, Arc::clone(&self.workers));
                Reconstruction::new(&self.device, (&psf, psf_scale), margin, self.method, with, &others)
            };
            match plan(margin) {
                Ok(new) => self.fields.push(new),
                Err(PlanError::Memory { total: needed, limit, .. }) => {
                    warnings.push(Warning::LightNotModelled { needed, limit });
                    if self.fields.is_empty() {
                        self.fields.push(plan(Margin::default())?);
                    }
                    return Ok(false);
                }
                Err(error) => return Err(error),
            }
        }
        self.fields.reverse();
        let now = &mut self.fields[0];
        now.prepared.forget();
        now.solver.last.iter_mut().for_each(solve::Continuation::forget);
        if now.psf_scale.to_bits() != psf_scale.to_bits() {
            now.set_psf(&self.device.psf.scaled(psf_scale), psf_scale)?;
        }
        Ok(true)
    }
}
