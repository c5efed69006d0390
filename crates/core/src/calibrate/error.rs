//! The ways in which a calibration step fails.

use super::{Remedy, Step};
use crate::image::Size;
use crate::optics::MaskError;
use crate::pipeline::{PlanError, ProcessError};
use crate::polarization::Angle;

/// A calibration step that failed. `Display` gives the facts: the step, the value found and what is allowed;
/// [`remedy`](Self::remedy) gives what to do.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// Not enough frames to tell signal from noise.
    #[error("{step}: {found} frame(s), allowed: at least {needed}")]
    FewFrames {
        /// The step that failed.
        step: Step,
        /// Frames given.
        found: usize,
        /// Least number of frames.
        needed: usize,
    },
    /// Frames of different shapes, or of another shape than the sensor's.
    #[error("{step}: a frame has {found_channels} channel(s) of {found} pixels, allowed: {channels} of {size}")]
    Shape {
        /// The step that failed.
        step: Step,
        /// Channels of the frame.
        found_channels: usize,
        /// Size of the frame.
        found: Size,
        /// Expected channels.
        channels: usize,
        /// Expected size.
        size: Size,
    },
    /// The result of an earlier step is missing.
    #[error("{step}: the device has no {} yet", .first.result())]
    MissingStep {
        /// The step that failed.
        step: Step,
        /// The step that makes what is missing.
        first: Step,
    },
    /// Light in frames that should be dark.
    #[error("dark: the frames show light, {percent:.1} % of full scale, allowed: {allowed:.1} %")]
    NotDark {
        /// Spread of local medians, or the median itself, in percent of full scale.
        percent: f64,
        /// Largest value that is allowed, in percent of full scale.
        allowed: f64,
    },
    /// No light in frames that should have some.
    #[error("{step}: no light: the signal{} is {:.4} of full scale, allowed: at least {needed:.4}", at(*.angle), .signal.max(0.0))]
    NoLight {
        /// The step that failed.
        step: Step,
        /// Signal found, fraction of full scale.
        signal: f32,
        /// Least signal, fraction of full scale.
        needed: f32,
        /// Angle of the polarizer, where one is used.
        angle: Option<Angle>,
    },
    /// Clipped readings.
    #[error("{step}: {percent:.2} % of the readings are saturated{}, allowed: {allowed:.2} %", at(*.angle))]
    Saturated {
        /// The step that failed.
        step: Step,
        /// Share of the readings, or of the PSF's support, in percent.
        percent: f64,
        /// Largest share that is allowed, in percent.
        allowed: f64,
        /// Angle of the polarizer, where one is used.
        angle: Option<Angle>,
    },
    /// A point source that drowns in noise.
    #[error("psf: the point source is too weak: its peak is {snr:.1} times the noise, allowed: at least {needed}")]
    WeakSource {
        /// Peak over noise.
        snr: f64,
        /// Least peak over noise.
        needed: f64,
    },
    /// Light all over the frame instead of one spot with dark around it.
    #[error("psf: light fills {percent:.0} % of the frame, allowed: {allowed:.0} %")]
    NotAPoint {
        /// Support in percent of the frame.
        percent: f64,
        /// Largest support that is allowed, in percent of the frame.
        allowed: f64,
    },
    /// An image that moved between frames.
    #[error("{step}: the image moved by {pixels:.2} pixels between frames, allowed: {allowed}")]
    Moved {
        /// The step that failed.
        step: Step,
        /// Displacement of the last half of the frames against the first, in pixels.
        pixels: f64,
        /// Largest displacement that is allowed, in pixels.
        allowed: f64,
    },
    /// A polarizer angle that is infinite or not a number.
    #[error("{step}: polarizer at {angle}, allowed: finite angles")]
    Angle {
        /// The step that failed.
        step: Step,
        /// The angle given.
        angle: Angle,
    },
    /// Too few different polarizer angles.
    #[error(
        "{step}: polarizer at {}: {distinct} differ by 5° or more (modulo 180°), allowed: at least {needed}",
        list(.angles)
    )]
    FewAngles {
        /// The step that failed.
        step: Step,
        /// The angles given.
        angles: Vec<Angle>,
        /// How many of them differ.
        distinct: usize,
        /// Least number of different angles.
        needed: usize,
    },
    /// Readings that do not change with the polarizer.
    #[error(
        "{step}: the readings do not change with the polarizer's angle: {found:.3} of what the angles demand, allowed: at least {needed}"
    )]
    NotTurned {
        /// The step that failed.
        step: Step,
        /// Modulation, or spread of the measured angles over that of the given ones; 1 is ideal.
        found: f64,
        /// Least value.
        needed: f64,
    },
    /// Two views were given for each other.
    #[error(
        "{step}: the views at {first} and {second} seem to be swapped: as given the angles are wrong by up to {worst:.1}°, exchanged within {left:.1}°"
    )]
    Swapped {
        /// The step that failed.
        step: Step,
        /// Given angles of the two views.
        first: Angle,
        /// The other one.
        second: Angle,
        /// Largest error of an angle as given, in degrees.
        worst: f64,
        /// Largest error when the two views are exchanged, in degrees.
        left: f64,
    },
    /// Readings that no polarizer at the given angles passes.
    #[error("mask: the readings differ from Malus's law by {percent:.1} %, most at {angle}, allowed: {allowed} %")]
    NotMalus {
        /// Root mean square in percent of the mean reading.
        percent: f64,
        /// Largest difference that is allowed, in percent of the mean reading.
        allowed: f64,
        /// The view that differs most.
        angle: Angle,
    },
    /// Stripes at other angles than those described.
    #[error("mask: the stripes are {off:.0}° (rms) off their description, allowed: {allowed:.0}°")]
    OtherMask {
        /// Root mean square of the differences, in degrees.
        off: f64,
        /// Largest difference that is allowed, in degrees.
        allowed: f64,
    },
    /// A guide that shows something else than the reconstruction.
    #[error(
        "align: {inliers} of {places} places of the guide match the reconstruction, allowed: at least half and {needed}"
    )]
    OtherScene {
        /// Places that match.
        inliers: usize,
        /// Places with texture.
        places: usize,
        /// Least number of places that match.
        needed: usize,
    },
    /// A mask that cannot measure polarization.
    #[error("mask: {0}")]
    Mask(#[from] MaskError),
    /// A reconstruction that cannot be planned.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// A frame that cannot be reconstructed.
    #[error(transparent)]
    Process(#[from] ProcessError),
}

impl CalibrateError {
    /// The action that makes the step succeed. None for a failed reconstruction: its own error tells.
    pub fn remedy(&self) -> Option<Remedy> {
        Some(match self {
            Self::FewFrames { .. } => Remedy::MoreFrames,
            Self::Shape { .. } => Remedy::OneMode,
            Self::MissingStep { first, .. } => Remedy::RunFirst(*first),
            Self::NotDark { .. } => Remedy::CoverLens,
            Self::NoLight { .. } => Remedy::SwitchLampOn,
            Self::Saturated { .. } => Remedy::ExposeShorter,
            Self::WeakSource { .. } => Remedy::ExposeLonger,
            Self::NotAPoint { .. } => Remedy::OnePointSource,
            Self::Moved { .. } => Remedy::HoldStill,
            Self::Angle { .. } => Remedy::FiniteAngles,
            Self::FewAngles { .. } | Self::NotTurned { .. } => Remedy::TurnPolarizer,
            Self::NotMalus { angle, .. } => Remedy::CheckAngle(*angle),
            Self::Swapped { first, second, .. } => Remedy::ExchangeViews(*first, *second),
            Self::OtherMask { .. }
            | Self::Mask(MaskError::Angles { .. } | MaskError::Overlap { .. } | MaskError::Stripes { .. }) => {
                Remedy::DescribeMask
            }
            Self::Mask(_) => Remedy::Repeat(Step::Mask),
            Self::OtherScene { .. } => Remedy::ShowSameTarget,
            Self::Plan(_) | Self::Process(_) => return None,
        })
    }
}

fn at(angle: Option<Angle>) -> String {
    angle.map_or_else(String::new, |angle| format!(" at {angle}"))
}

/// The angles, separated by commas.
pub(super) fn list(angles: &[Angle]) -> String {
    angles.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}
