//! Warnings: facts that a user should know before trusting a result.

use std::fmt;

use crate::guide::Agreement;
use crate::image::OffScale;
use crate::readings::Quality;

/// Shares of untrusted readings that a user is told about.
const WARN_SHARE: f32 = 0.001;
/// Uncertainty of the guide's position that a user is told about, in pixels.
const WARN_SHIFT: f32 = 1.0;
/// Shift of a guide that is not aligned that a user is told about, in pixels.
const WARN_OFF: f32 = 0.5;

/// A fact that a user should know before trusting a result. Shares are 0 to 1, readings fractions of full scale.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Warning {
    /// The guide shows another scene or nothing of this one; S0 is solved for without it.
    ForeignGuide {
        /// Brightness with which the guide's detail is found in the raw frame, 1 is its own.
        detail: f32,
    },
    /// The scene has too little detail to tell where the guide lies.
    UncertainGuide {
        /// Standard deviation of the position, in pixels.
        pixels: f32,
    },
    /// The readings fit better with the guide in another place, and it is not aligned.
    MisplacedGuide {
        /// About how far right and down of its place the guide's content lies, in pixels.
        off: [f32; 2],
    },
    /// The guide explains nothing of the raw frame; S0 is solved for without it.
    UselessGuide,
    /// The method is a guided one and the frame has no guide; S0 is solved for without it.
    NoGuide,
    /// The guide is taken although it looks foreign: the memory limit does not allow for solving without it.
    ForeignGuideTaken {
        /// Bytes that solving for S0 needs.
        needed: usize,
        /// The limit.
        limit: usize,
    },
    /// Light from beyond the frame reaches the sensor, and the memory limit does not allow for modelling it.
    LightNotModelled {
        /// Bytes that modelling it needs.
        needed: usize,
        /// The limit.
        limit: usize,
    },
    /// The surroundings of the frame are dimmer than the frame, send light onto the sensor, and are not seen by the guide.
    UnseenMargin {
        /// Their brightness over that of the frame, as solved for.
        level: f32,
    },
    /// Readings at or above saturation are ignored.
    Saturated {
        /// Share of the readings.
        share: f32,
    },
    /// The readings contradict the scale of counts that the bundle declares.
    OffScale(OffScale),
    /// Readings that are NaN or infinite are ignored.
    NotFinite {
        /// Share of the readings.
        share: f32,
    },
    /// Readings far from all around them, of dead or hot pixels, are ignored.
    Defective {
        /// Share of the readings.
        share: f32,
    },
    /// No reading is above black.
    Dark,
    /// All readings are equal.
    Blank {
        /// The reading.
        reading: f32,
    },
    /// The PSF has another size than when it was calibrated, by more than the pipeline follows.
    PsfOutOfRange {
        /// Size over the calibrated size.
        scale: f64,
        /// Largest relative change that is followed.
        largest: f64,
    },
    /// The PSF has another size than when it was calibrated, and the memory limit does not allow for following it.
    PsfNotFollowed {
        /// Size over the calibrated size.
        scale: f64,
        /// Bytes that following it needs.
        needed: usize,
        /// The limit.
        limit: usize,
    },
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |share: f32| 100.0 * share;
        match *self {
            Self::ForeignGuide { detail } => write!(
                f,
                "the guide shows another scene or nothing of this one (its detail is found in the raw frame with {:.0} % of its \
                 brightness): S0 was solved for without it",
                percent(detail)
            ),
            Self::UncertainGuide { pixels } => {
                write!(f, "the guide's position is only known to ±{pixels:.1} px: the scene has little detail")
            }
            Self::MisplacedGuide { off: [right, down] } => write!(
                f,
                "the guide is off by about {right:+.1} px (right) and {down:+.1} px (down), so its detail is in the wrong place: turn \
                 registration on"
            ),
            Self::UselessGuide => {
                f.write_str("the guide explains nothing of the raw frame: S0 was solved for without it")
            }
            Self::NoGuide => f.write_str("no guide frame: S0 was solved for without it"),
            Self::ForeignGuideTaken { needed, limit } => write!(
                f,
                "solving for S0 needs {needed} bytes, the limit is {limit}: the guide was taken in spite of that"
            ),
            Self::LightNotModelled { needed, limit } => write!(
                f,
                "light from beyond the frame seems to reach the sensor; modelling it needs {needed} bytes, the limit is {limit}: if it \
                 does, the result is wrong, most of all near the border"
            ),
            Self::UnseenMargin { level } => write!(
                f,
                "surroundings with about {:.0} % of the brightness of the frame send light onto the sensor, and the guide does not see \
                 them: let the guide camera see more than the frame, or fit a field stop",
                percent(level)
            ),
            Self::Saturated { share } => {
                write!(f, "{:.1} % of the raw readings are saturated and were ignored", percent(share))
            }
            Self::OffScale(found) => write!(f, "{found}"),
            Self::NotFinite { share } => {
                write!(f, "{:.3} % of the raw readings are NaN or infinite and were ignored", percent(share))
            }
            Self::Defective { share } => write!(
                f,
                "{:.3} % of the raw readings are far from all around them (dead or hot pixels) and were ignored",
                percent(share)
            ),
            Self::Dark => f.write_str("the raw frame is dark: no reading is above black"),
            Self::Blank { reading } => write!(f, "the raw frame is blank: every reading is {reading:.4}"),
            Self::PsfOutOfRange { scale, largest } => write!(
                f,
                "{}, more than the {:.0} % that are followed: calibrate anew",
                psf_size(scale),
                100.0 * largest
            ),
            Self::PsfNotFollowed { scale, needed, limit } => write!(
                f,
                "{}; following it needs {needed} bytes, the limit is {limit}: calibrate anew",
                psf_size(scale)
            ),
        }
    }
}

/// A sentence on the size of the PSF, `scale` times that of its calibration.
pub(super) fn psf_size(scale: f64) -> String {
    let percent = 100.0 * (scale - 1.0).abs();
    let direction = if scale > 1.0 { "larger" } else { "smaller" };
    format!("the psf seems to be {percent:.1} % {direction} than when it was calibrated")
}

/// The warning about a guide that was compared with the readings.
pub(super) fn of_guide(a: &Agreement) -> Option<Warning> {
    if a.foreign {
        return Some(Warning::ForeignGuide { detail: a.detail });
    }
    if a.dim_margin > 0.0 {
        return Some(Warning::UnseenMargin { level: a.dim_margin });
    }
    if a.off[0].hypot(a.off[1]) > WARN_OFF {
        return Some(Warning::MisplacedGuide { off: a.off });
    }
    (a.uncertainty > WARN_SHIFT).then_some(Warning::UncertainGuide { pixels: a.uncertainty })
}

/// The warnings about a raw frame.
pub(super) fn of_readings(q: &Quality) -> impl Iterator<Item = Warning> {
    let blank = q.peak - q.floor <= 1e-6 * q.peak.abs();
    [
        (q.saturated > WARN_SHARE).then_some(Warning::Saturated { share: q.saturated }),
        q.off_scale.map(Warning::OffScale),
        (q.not_finite > 0.0).then_some(Warning::NotFinite { share: q.not_finite }),
        (q.defective > 0.0).then_some(Warning::Defective { share: q.defective }),
        (q.peak <= 0.0).then_some(Warning::Dark),
        (q.peak > 0.0 && blank).then_some(Warning::Blank { reading: q.peak }),
    ]
    .into_iter()
    .flatten()
}
