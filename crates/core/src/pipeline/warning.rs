//! Warnings: facts that a user should know before trusting a result.

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
// The derived `Display` keeps each sentence beside its variant.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Warning {
    /// The guide shows another scene or nothing of this one; S0 is solved for without it.
    #[error(
        "the guide shows another scene or nothing of this one (its detail is found in the raw frame with {:.0} % of its brightness): S0 was \
         solved for without it",
        percent(*detail)
    )]
    ForeignGuide {
        /// Brightness with which the guide's detail is found in the raw frame, 1 is its own.
        detail: f32,
    },
    /// The scene has too little detail to tell where the guide lies.
    #[error("the guide's position is only known to ±{pixels:.1} px: the scene has little detail")]
    UncertainGuide {
        /// Standard deviation of the position, in pixels.
        pixels: f32,
    },
    /// The readings fit better with the guide in another place, and it is not aligned.
    #[error(
        "the guide is off by about {:+.1} px (right) and {:+.1} px (down), so its detail is in the wrong place: turn registration on",
        off[0],
        off[1]
    )]
    MisplacedGuide {
        /// About how far right and down of its place the guide's content lies, in pixels.
        off: [f32; 2],
    },
    /// The guide explains nothing of the raw frame; S0 is solved for without it.
    #[error("the guide explains nothing of the raw frame: S0 was solved for without it")]
    UselessGuide,
    /// The method is a guided one and the frame has no guide; S0 is solved for without it.
    #[error("no guide frame: S0 was solved for without it")]
    NoGuide,
    /// The guide is taken although it looks foreign: the memory limit does not allow for solving without it.
    #[error("solving for S0 needs {needed} bytes, the limit is {limit}: the guide was taken in spite of that")]
    ForeignGuideTaken {
        /// Bytes that solving for S0 needs.
        needed: usize,
        /// The limit.
        limit: usize,
    },
    /// Light from beyond the frame reaches the sensor, and the memory limit does not allow for modelling it.
    #[error(
        "light from beyond the frame seems to reach the sensor; modelling it needs {needed} bytes, the limit is {limit}: if it does, the \
         result is wrong, most of all near the border"
    )]
    LightNotModelled {
        /// Bytes that modelling it needs.
        needed: usize,
        /// The limit.
        limit: usize,
    },
    /// The surroundings of the frame are dimmer than the frame, send light onto the sensor, and are not seen by the guide.
    #[error(
        "surroundings with about {:.0} % of the brightness of the frame send light onto the sensor, and the guide does not see them: let \
         the guide camera see more than the frame, or fit a field stop",
        percent(*level)
    )]
    UnseenMargin {
        /// Their brightness over that of the frame, as solved for.
        level: f32,
    },
    /// The readings show light from beyond the frame that the guide does not see, or an error of the guide's brightness, and do not tell which.
    /// The latter was corrected.
    #[error(
        "light from beyond the frame, which the guide does not see, or an error of the guide's brightness: the readings do not tell which, \
         and the latter was corrected; let the guide camera see more than the frame, or fit a field stop"
    )]
    LightOrBrightness,
    /// Readings at or above saturation are ignored.
    #[error("{:.1} % of the raw readings are saturated and were ignored", percent(*share))]
    Saturated {
        /// Share of the readings.
        share: f32,
    },
    /// The readings contradict the scale of counts that the bundle declares.
    #[error("{0}")]
    OffScale(OffScale),
    /// Readings that are NaN or infinite are ignored.
    #[error("{:.3} % of the raw readings are NaN or infinite and were ignored", percent(*share))]
    NotFinite {
        /// Share of the readings.
        share: f32,
    },
    /// Readings far from all around them, of dead or hot pixels, are ignored.
    #[error(
        "{:.3} % of the raw readings are far from all around them (dead or hot pixels) and were ignored",
        percent(*share)
    )]
    Defective {
        /// Share of the readings.
        share: f32,
    },
    /// Many pixels of the guide were replaced.
    #[error(
        "{:.2} % of the guide's pixels have no value or are dead or hot, and were replaced by what is around them: look at the guide camera",
        percent(*share)
    )]
    GuideReplaced {
        /// Share of the pixels.
        share: f32,
    },
    /// No reading is above black.
    #[error("the raw frame is dark: no reading is above black")]
    Dark,
    /// All readings are equal.
    #[error("the raw frame is blank: every reading is {reading:.4}")]
    Blank {
        /// The reading.
        reading: f32,
    },
    /// The PSF has another size than when it was calibrated, by more than the pipeline follows.
    #[error("{}, more than the {:.0} % that are followed: calibrate anew", psf_size(*scale), 100.0 * largest)]
    PsfOutOfRange {
        /// Size over the calibrated size.
        scale: f64,
        /// Largest relative change that is followed.
        largest: f64,
    },
    /// The PSF has another size than when it was calibrated, and the memory limit does not allow for following it.
    #[error(
        "{}; following it needs {needed} bytes, the limit is {limit}: calibrate anew",
        psf_size(*scale)
    )]
    PsfNotFollowed {
        /// Size over the calibrated size.
        scale: f64,
        /// Bytes that following it needs.
        needed: usize,
        /// The limit.
        limit: usize,
    },
}

/// A share in percent.
fn percent(share: f32) -> f32 {
    100.0 * share
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

/// The warning about a guide of whose values this share was replaced.
pub(super) fn of_replaced(share: f32) -> Option<Warning> {
    (share > WARN_SHARE).then_some(Warning::GuideReplaced { share })
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
