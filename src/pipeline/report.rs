//! What is said of a frame, and what [`output`] writes of it.

use std::time::Duration;

use super::Pipeline;
use crate::prepare::Summary;
use crate::recon::{Course, Method, Modelled};
use crate::{fusion, output};

/// What there is to say of one frame.
#[derive(Clone, Debug)]
pub struct FrameReport {
    /// The method that ran.
    pub method: Method,
    /// Its iterations.
    pub iterations: usize,
    /// What was solved for.
    pub modelled: Modelled,
    /// Why just that.
    pub why: &'static str,
    /// How the frame was solved beside the last one.
    pub course: Course,
    /// Frames whose readings were averaged.
    pub averaged: usize,
    /// Residual A·x − y, root mean square, fractions of full scale; of averaged readings where frames were averaged.
    pub residual_rms: f32,
    /// Shift of the guide against the frame that was undone, in pixels: right, down.
    pub shift_px: [f32; 2],
    /// How many times as large as calibrated the PSF was taken for.
    pub psf_scale: f32,
    /// Sensor units per guide unit, one for each channel; empty without a guide. Of fixed capacity, so that no frame allocates.
    pub gain: heapless::Vec<f32, 3>,
    /// Mean DoLP of the valid pixels; none without a mask or valid pixels.
    pub mean_dolp: Option<f32>,
    /// Share of valid pixels.
    pub valid_fraction: f32,
    /// Time of prepare, registration apart.
    pub prepare: Duration,
    /// Time of aligning the guide.
    pub register: Duration,
    /// Time of the solver.
    pub recon: Duration,
    /// What the fusion model did; none without one.
    pub fusion: Option<fusion::Report>,
    /// Its time.
    pub fusion_time: Duration,
    /// What a user should know before trusting the result.
    pub warnings: Vec<String>,
}

/// Why that was solved for, for people.
pub(super) fn why(modelled: Modelled, asked: Method, guided: bool, summary: &Summary) -> &'static str {
    match modelled {
        Modelled::Nothing => "the guide gives s0, and the readings show no polarization above their noise",
        Modelled::Polarized => "the guide gives s0",
        Modelled::Shared => "the guide gives s0, and the colours share one polarization",
        Modelled::Intensity if guided => "no mask; s0 looks like the guide",
        Modelled::Intensity => "no mask and no guide",
        Modelled::Angles => "the method asked for",
        Modelled::Both if !guided => "no guide",
        Modelled::Both if asked == Method::Stokes => "the method asked for",
        Modelled::Both if summary.gain.is_none() => "the guide explains nothing of the raw frame",
        Modelled::Both => "the guide is of another scene",
    }
}

impl Pipeline {
    /// What `report.json` says of the latest frame, which took `load` to read and `total` altogether.
    pub fn report(&self, frame: &FrameReport, load: Duration, total: Duration) -> output::Report {
        output::Report {
            method: frame.method.to_string(),
            iterations: frame.iterations,
            modelled: output::Modelled { unknowns: frame.modelled.unknowns(), why: frame.why },
            course: frame.course.to_string(),
            averaged: frame.averaged,
            size: [self.size().width, self.size().height],
            seconds: output::Seconds {
                load: load.as_secs_f64(),
                prepare: frame.prepare.as_secs_f64(),
                register: frame.register.as_secs_f64(),
                recon: frame.recon.as_secs_f64(),
                fusion: frame.fusion_time.as_secs_f64(),
                total: total.as_secs_f64(),
            },
            residual_rms: f64::from(frame.residual_rms),
            gain: frame.gain.iter().copied().map(f64::from).collect(),
            shift_px: frame.shift_px.map(f64::from),
            psf_scale: f64::from(frame.psf_scale),
            mean_dolp: frame.mean_dolp.map(f64::from),
            valid_fraction: f64::from(frame.valid_fraction),
            workspace_bytes: self.workspace_bytes(),
            peak_rss_bytes: output::peak_rss_bytes(),
            calibration: self.digest.clone(),
            model: self.fusion.as_ref().map(|f| f.plan.network().model().name.clone()),
            fusion: self.fusion.as_ref().zip(frame.fusion).map(|(f, r)| output::Fusion {
                result: if r.is_learned() { "learned" } else { "physics" },
                precision: f.plan.network().precision().to_string(),
                tiles: r.tiles,
                run: r.run,
                kept: r.kept,
                quiet: r.quiet,
                refused: r.refused,
                detail_shift_px: r.detail_shift_px,
            }),
            warnings: frame.warnings.clone(),
        }
    }

    /// The latest result as [`output`] writes it.
    pub fn images(&self) -> output::ResultImages<'_> {
        output::ResultImages {
            size: self.size(),
            channels: self.prepared.raw.count(),
            angles: self.result.angles.as_ref(),
            angle_list: &self.angles,
            stokes: &self.result.stokes,
            valid: &self.result.valid,
            stage1: self.stage1(),
        }
    }
}
