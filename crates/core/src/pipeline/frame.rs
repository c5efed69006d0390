//! One frame from readings to result and report.

use std::num::NonZeroUsize;
use std::time::{Duration, Instant};

use super::{
    Budget, Field, FrameReport, Pipeline, PlanError, Polarization, PrepareError, ProcessError, Warning, report, warning,
};
use crate::diagnose::Figures;
use crate::guide::mend::Mended;
use crate::guide::{self, PsfSize};
use crate::image::Planes;
use crate::polarization;
use crate::readings::{Readings, Unit};
use crate::refine;
use crate::solve::{self, Method};

/// Pixels whose S0 lies below this fraction of the frame's peak reading carry no usable polarization.
const DARK: f32 = 0.02;

/// Iterations after which the guided solver explains the readings of a right set-up, if it does not before.
const SETTLED: usize = 5;

/// Share of the mean reading to which a model of a camera is exact, whatever the noise.
const EXACT: f32 = 0.002;

/// A solved frame: facts for its report. The images are in the pipeline's result.
struct SolvedFrame {
    summary: guide::Summary,
    outcome: solve::Outcome,
    light_from_beyond: f32,
    fusion: Option<refine::Report>,
    warnings: Vec<Warning>,
    /// Time of preparation without the alignment of the guide, which is in the summary.
    prepare: Duration,
    recon: Duration,
    fusion_time: Duration,
}

impl Pipeline {
    /// Processes one frame and reports on it.
    pub(super) fn process_planes(
        &mut self,
        raw: Planes<'_>,
        unit: Unit,
        guide: Option<Mended<'_>>,
        budget: Budget,
    ) -> Result<FrameReport, ProcessError> {
        let SolvedFrame { summary, outcome, light_from_beyond, fusion, warnings, prepare, recon, fusion_time } =
            self.solve_frame(raw, unit, guide, budget)?;
        self.mark_valid();
        let channels = raw.count();
        let Polarization { stokes, errors, .. } = &mut self.result;
        let beyond = !self.fields[0].field().margin().is_none();
        self.uncertainty.estimate(stokes, channels, (outcome.modelled, beyond), outcome.residual_rms, errors);
        let valid = &self.result.valid;
        let errors = self.uncertainty.summarize(&self.result.stokes, &self.result.errors, valid);
        let count = valid.iter().filter(|v| **v).count();
        let noise = outcome.sigma.unwrap_or(self.device.noise.read);
        let quality = &self.readings.quality;
        let asked = budget.iterations.map(NonZeroUsize::get).or(self.settings.iterations);
        let usual = self.fields[0].solver.iterations;
        let usual = if self.method() == Method::Guided { usual.min(SETTLED) } else { usual };
        let figures = Figures {
            residual_over_noise: outcome.residual_rms / noise.max(EXACT * quality.mean).max(f32::MIN_POSITIVE),
            settled: outcome.sigma.is_some() && asked.is_none_or(|n| n >= usual),
            // few counts show less noise than there is
            light_over_noise: quality.mean / noise.max(self.device.noise.read).max(f32::MIN_POSITIVE),
            saturated: quality.saturated,
            foreign_guide: guide.is_some()
                && self.method == Method::Guided
                && summary.agreement.is_none_or(|a| a.foreign),
        };
        let margin = self.fields[0].field().margin();
        Ok(FrameReport {
            method: self.method(),
            noise,
            figures,
            field: Field {
                margin,
                light_from_beyond,
                why: report::why_margin(self.method(), margin, !self.device.margin.is_none()),
            },
            iterations: outcome.iterations,
            modelled: outcome.modelled,
            why: report::why(outcome.modelled, self.method, guide.is_some(), &summary),
            course: outcome.start,
            averaged: outcome.averaged,
            residual_rms: outcome.residual_rms,
            gain: summary.gain.iter().flat_map(|g| (0..channels).map(|c| g[c] * outcome.gain[c])).collect(),
            mean_dolp: (!self.angles.is_empty())
                .then(|| polarization::mean_dolp(self.result.stokes.as_slice(), valid))
                .flatten(),
            errors,
            valid_fraction: count as f32 / valid.len() as f32,
            shift_px: summary.shift,
            local_shift_px: summary.local_shift,
            guide_weights: summary.weights,
            guide_replaced: summary.replaced,
            psf_scale: self.fields[0].psf_scale as f32,
            prepare,
            register: summary.register,
            recon,
            fusion,
            fusion_time,
            warnings,
            notices: std::mem::take(&mut self.notices),
        })
    }

    /// Takes one frame from raw values to the result.
    fn solve_frame(
        &mut self,
        raw: Planes<'_>,
        unit: Unit,
        guide: Option<Mended<'_>>,
        budget: Budget,
    ) -> Result<SolvedFrame, ProcessError> {
        let start = Instant::now();
        if !self.settings.video {
            self.begin_anew()?;
            self.outliers = None;
        }
        self.normalization.run(raw, unit, &mut self.readings).map_err(PrepareError::from)?;
        let mut warnings = Vec::new();
        let (summary, guide) = self.prepare_mended(guide, &mut warnings)?;
        let mut prepare = start.elapsed().saturating_sub(summary.register);
        let method = self.choose_method(&summary, guide.is_some(), &mut warnings);
        let start = Instant::now();
        let iterations = budget.iterations.map(NonZeroUsize::get).or(self.settings.iterations);
        let mut outcome = self.solve(method, &summary, iterations, &mut warnings)?;
        if self.tells_of_light(&outcome) && self.model_margin(self.device.margin, &mut warnings)? {
            let again = Instant::now();
            self.prepare_on_field(guide, PsfSize::Given, false, &mut warnings)?;
            prepare += again.elapsed();
            outcome = self.solve(method, &summary, iterations, &mut warnings)?;
        }
        let light_from_beyond = self.fields[0].cut_out(&self.polarization, &mut self.result.stokes);
        let recon = start.elapsed();
        warnings.extend(warning::of_readings(&self.readings.quality));
        warnings.extend(warning::of_replaced(summary.replaced));
        self.complete();
        let start = Instant::now();
        let fusion = self.refine(outcome.sigma.unwrap_or(self.device.noise.read), budget.refine);
        let fusion_time = start.elapsed();
        Ok(SolvedFrame { summary, outcome, light_from_beyond, fusion, warnings, prepare, recon, fusion_time })
    }

    /// Prepares one frame with the guide that explains its readings best: with its outliers, which are light then, or without them. Returns
    /// that guide too. In a video the outliers of one frame decide for the next ones, until there are twice as many: a decision prepares the
    /// frame anew, without what earlier frames told.
    fn prepare_mended<'a>(
        &mut self,
        guide: Option<Mended<'a>>,
        warnings: &mut Vec<Warning>,
    ) -> Result<(guide::Summary, Option<Planes<'a>>), ProcessError> {
        let Some(Mended { given, smoothed, missing, outliers }) = guide else {
            return Ok((self.prepare(None, warnings)?, None));
        };
        let replaced = |share: f32, summary: guide::Summary| guide::Summary { replaced: share, ..summary };
        let known = self.outliers.filter(|(share, _)| outliers <= 2.0 * share);
        let Some(smoothed) = smoothed.filter(|_| known.is_none_or(|(_, light)| !light)) else {
            return Ok((replaced(missing, self.prepare(Some(given), warnings)?), Some(given)));
        };
        let mut light = false;
        if known.is_none() {
            // A video keeps to its field, which takes turns by what its frames tell.
            let again = |pipeline: &mut Self| {
                if pipeline.settings.video { pipeline.forget() } else { pipeline.begin_anew() }
            };
            let with = self.prepare(Some(given), &mut Vec::new())?;
            again(self)?;
            let mut told = Vec::new();
            let without = self.prepare(Some(smoothed), &mut told)?;
            light = with.explains_better_than(&without);
            self.outliers = Some((outliers, light));
            if !light {
                warnings.append(&mut told);
                return Ok((replaced(missing + outliers, without), Some(smoothed)));
            }
            again(self)?;
        }
        let (used, share) = if light { (given, missing) } else { (smoothed, missing + outliers) };
        Ok((replaced(share, self.prepare(Some(used), warnings)?), Some(used)))
    }

    /// The method that a prepared frame is solved with: that of the settings, or another one where its guide is of no use.
    fn choose_method(&self, summary: &guide::Summary, has_guide: bool, warnings: &mut Vec<Warning>) -> Method {
        let mut method = self.method;
        if method == Method::Guided && summary.gain.is_none() {
            warnings.push(if has_guide { Warning::UselessGuide } else { Warning::NoGuide });
            method = Method::Stokes;
        }
        if let Some(agreement) = summary.agreement {
            warnings.extend(warning::of_guide(&agreement));
            if agreement.foreign {
                method = Method::Stokes;
            }
        }
        method
    }

    /// Solves the prepared frame on the present field.
    fn solve(
        &mut self,
        method: Method,
        summary: &guide::Summary,
        iterations: Option<usize>,
        warnings: &mut Vec<Warning>,
    ) -> Result<solve::Outcome, ProcessError> {
        match self.take_turns(method) {
            Err(PlanError::Memory { total, limit, .. }) if summary.gain.is_some() => {
                warnings.push(Warning::ForeignGuideTaken { needed: total, limit });
            }
            outcome => outcome?,
        }
        Ok(self.fields[0].solve(summary.gain.is_some(), iterations, &mut self.result.stokes)?)
    }

    /// Computes angle images from Stokes images or Stokes images from angle images, whichever the method did not solve for.
    fn complete(&mut self) {
        let Polarization { stokes, angles, .. } = &mut self.result;
        let field = self.fields[0].field();
        match (&self.fields[0].solver.output, angles) {
            (Some(solved), angles) => {
                if field.margin().is_none() {
                    self.polarization.to_stokes_images(solved, stokes);
                }
                angles.iter_mut().for_each(|angles| field.crop_planes(solved, angles));
            }
            (None, Some(angles)) => self.polarization.to_angle_images(stokes, angles),
            (None, None) => {}
        }
    }

    /// Marks the pixels that are neither dark nor read through a pixel that could not be trusted.
    fn mark_valid(&mut self) {
        let Readings { weight, quality, .. } = &self.readings;
        let per_channel = self.result.stokes.count() / weight.count();
        self.result.valid.fill(true);
        for (c, weight) in weight.planes().enumerate() {
            let s0 = self.result.stokes.plane(c * per_channel);
            let pixels = self.result.valid.iter_mut().zip(s0.iter().zip(weight));
            pixels.for_each(|(valid, (s0, weight))| *valid &= *weight > 0.0 && *s0 > DARK * quality.peak);
        }
    }
}
