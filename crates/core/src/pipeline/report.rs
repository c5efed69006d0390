//! The report of one frame.

use std::fmt;
use std::time::Duration;

use super::warning::{Warning, psf_size};
use crate::diagnose::Figures;
use crate::guide::Summary;
use crate::optics::Margin;
use crate::refine;
use crate::solve::{Method, Modelled, WarmStart};
use crate::uncertainty;

/// Figures and warnings of one frame.
#[derive(Clone, Debug)]
pub struct FrameReport {
    /// Method that ran.
    pub method: Method,
    /// Iterations that ran.
    pub iterations: usize,
    /// Unknowns that were solved for.
    pub modelled: Modelled,
    /// Reason for these unknowns, as a sentence.
    pub why: &'static str,
    /// Part of the scene that was modelled.
    pub field: Field,
    /// Start of the iterations: from nothing, or from the last frame of a video.
    pub course: WarmStart,
    /// Frames whose readings were averaged.
    pub averaged: usize,
    /// Residual A·x − y, root mean square, fractions of full scale; of averaged readings where frames were averaged.
    pub residual_rms: f32,
    /// Standard deviation of the noise of a reading, as measured in the frame, fractions of full scale.
    pub noise: f32,
    /// Figures from which the verdict on this frame comes.
    pub figures: Figures,
    /// Shift of the guide against the frame that was undone, in pixels: right, down.
    pub shift_px: [f32; 2],
    /// Length of the longest local shift of the guide that was undone beside it, in pixels: objects at other distances lie differently in
    /// the guide camera. 0 without any.
    pub local_shift_px: f32,
    /// Weights of a colour guide's channels beside a mono sensor, as found from the readings, of sum 1; none for other guides.
    pub guide_weights: Option<[f32; 3]>,
    /// Share of the guide's values that were replaced by what is around them: missing ones, and those of dead or hot pixels. 0 to 1.
    pub guide_replaced: f32,
    /// Size of the PSF over its calibrated size.
    pub psf_scale: f32,
    /// Sensor units per guide unit, one for each channel; empty without a guide. Of fixed capacity, so that no frame allocates.
    pub gain: heapless::Vec<f32, 3>,
    /// Mean DoLP of the valid pixels; none without a mask or valid pixels.
    pub mean_dolp: Option<f32>,
    /// Medians of the standard errors; none without a mask or valid pixels.
    pub errors: Option<uncertainty::Summary>,
    /// Share of valid pixels.
    pub valid_fraction: f32,
    /// Time of prepare, registration apart.
    pub prepare: Duration,
    /// Time of aligning the guide.
    pub register: Duration,
    /// Time of the solver.
    pub recon: Duration,
    /// Tiles of stage II; none without a network.
    pub fusion: Option<refine::Report>,
    /// Time of stage II.
    pub fusion_time: Duration,
    /// Facts to know before trusting the result.
    pub warnings: Vec<Warning>,
    /// Changes that the pipeline made to itself while it worked on this frame.
    pub notices: Vec<Notice>,
}

/// The part of the scene that was modelled, and the light that came from outside of the frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Field {
    /// Pixels around the frame that were solved for; none where the scene was taken to end with the frame.
    pub margin: Margin,
    /// Share of the light on the sensor that came from there, 0 to 1.
    pub light_from_beyond: f32,
    /// Reason for the margin, as a sentence.
    pub why: &'static str,
}

/// The reason for the margin that a method solved for, as a sentence. `may_see` says whether the device lets light in from beyond the frame.
pub(super) fn why_margin(method: Method, margin: Margin, may_see: bool) -> &'static str {
    match method {
        Method::FistaPublished | Method::FistaPublishedScaled => {
            "the published code solves for twice the sides of the frame"
        }
        Method::FistaPublishedFrame => "the method solves for the frame alone",
        _ if !may_see => "the bundle says that no light comes from beyond the frame",
        Method::Fista | Method::Admm | Method::AdmmPublished => {
            "the bundle says that light may come from there, and this method cannot tell whether it does"
        }
        Method::Guided | Method::Stokes if margin.is_none() => "the readings show no light from beyond the frame",
        Method::Guided | Method::Stokes => "the readings show light from beyond the frame",
    }
}

/// A change that a pipeline makes to itself, in force from then on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Notice {
    /// The PSF is taken for this many times as large as when it was calibrated.
    PsfRefitted {
        /// Size of the PSF over its calibrated size.
        scale: f64,
    },
    /// The file of the PSF stood on a pedestal, which was taken off.
    PsfPedestal {
        /// Share of the file's light that was the pedestal, 0 to 1.
        share: f64,
    },
}

impl fmt::Display for Notice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::PsfRefitted { scale } => write!(f, "{}: refitted", psf_size(*scale)),
            Self::PsfPedestal { share } => write!(
                f,
                "{:.1} % of the light of the psf is a constant background (a pedestal): taken off; subtract a frame taken with the point \
                 source off when the psf is measured",
                100.0 * share
            ),
        }
    }
}

/// The reason for the unknowns that were solved for, as a sentence.
pub(super) fn why(modelled: Modelled, asked: Method, guided: bool, summary: &Summary) -> &'static str {
    match modelled {
        Modelled::Nothing => "the guide gives s0, and the readings show no polarization above their noise",
        Modelled::Polarized => "the guide gives s0",
        Modelled::Shared => "the guide gives s0, and the colours share one polarization",
        Modelled::Intensity if guided => "no mask; s0 looks like the guide",
        Modelled::Intensity => "no mask and no guide",
        Modelled::Angles => "the method asked for",
        Modelled::Interpolated => {
            "no guide of this scene, and the psf is a point: the readings are interpolated between the polarizers"
        }
        Modelled::Both if !guided => "no guide",
        Modelled::Both if asked == Method::Stokes => "the method asked for",
        Modelled::Both if summary.gain.is_none() => "the guide explains nothing of the raw frame",
        Modelled::Both => "the guide is of another scene",
    }
}
