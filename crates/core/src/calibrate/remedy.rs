//! The steps of calibration, and what a person can do when one of them fails or could be better.

use std::fmt;

use serde::Serialize;

use crate::polarization::Angle;

/// A step of calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Step {
    /// Black level, dark frame and read noise of the covered sensor.
    Dark,
    /// Response of every pixel to polarized light.
    Mask,
    /// Image of a point source on the sensor.
    Psf,
    /// Gains of the colour channels.
    White,
    /// Homography from the scene to the guide camera.
    Align,
    /// Malus's test of the whole device.
    Verify,
}

impl Step {
    /// Name in lower case: `dark`, `mask`, `psf`, `white`, `align`, `verify`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Dark => "dark",
            Self::Mask => "mask",
            Self::Psf => "psf",
            Self::White => "white",
            Self::Align => "align",
            Self::Verify => "verify",
        }
    }

    /// The thing that the step measures, as a noun.
    pub const fn result(self) -> &'static str {
        match self {
            Self::Dark => "dark frame",
            Self::Mask => "polarizer mask",
            Self::Psf => "point spread function",
            Self::White => "white balance",
            Self::Align => "guide alignment",
            Self::Verify => "Malus test",
        }
    }
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

/// The action that makes a failed or poor step succeed. `Display` gives it as an imperative sentence without capital and full stop,
/// free of the terms of any user interface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Remedy {
    /// Average more frames.
    MoreFrames,
    /// Take all frames with one camera in one mode.
    OneMode,
    /// Take an earlier step first.
    RunFirst(Step),
    /// Take a step again, and those after it, which use its result.
    Repeat(Step),
    /// Keep light off the sensor.
    CoverLens,
    /// Lower the sensor's noise.
    CoolSensor,
    /// Give light to the sensor.
    SwitchLampOn,
    /// Give the sensor less light.
    ExposeShorter,
    /// Give the sensor more light.
    ExposeLonger,
    /// Show one small source.
    OnePointSource,
    /// Move the point source to the middle of the view.
    CentreSource,
    /// Keep camera and scene at rest.
    HoldStill,
    /// Give the angles of the polarizer as finite numbers.
    FiniteAngles,
    /// Turn the polarizer between views.
    TurnPolarizer,
    /// Compare the polarizer with the angle that was given for one view.
    CheckAngle(Angle),
    /// Give these two views in the other order.
    ExchangeViews(Angle, Angle),
    /// Use one zero of the polarizer's dial in all steps.
    SameZero,
    /// Take the diffuser off and let no light in but through the polarizer.
    RemoveDiffuser,
    /// Describe the mask's stripes and the zero of the polarizer as they are.
    DescribeMask,
    /// Light the surface with white light.
    WhiteLight,
    /// Show one printed target to both cameras.
    ShowSameTarget,
    /// Show a target with more and finer structure.
    SharperTarget,
}

impl fmt::Display for Remedy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::MoreFrames => "take more frames",
            Self::OneMode => "use one camera in one mode",
            Self::RunFirst(step) => return write!(f, "take the {step} step first"),
            Self::Repeat(step) => return write!(f, "repeat the {step} step and those after it"),
            Self::CoverLens => "cover the lens",
            Self::CoolSensor => "cool the sensor or lower its gain",
            Self::SwitchLampOn => "switch the lamp on and uncover the lens",
            Self::ExposeShorter => "expose shorter or dim the lamp",
            Self::ExposeLonger => "expose longer, brighten the source or average more frames",
            Self::OnePointSource => "use one small source in a dark room",
            Self::CentreSource => "bring the source to the middle or use a larger frame",
            Self::HoldStill => "fix camera and target, and repeat the step",
            Self::FiniteAngles => "give every angle of the polarizer as a number of degrees",
            Self::TurnPolarizer => {
                "turn the polarizer between views by 5° or more, and see that it stands in front of the lamp"
            }
            Self::CheckAngle(angle) => {
                return write!(
                    f,
                    "see that the polarizer was at {angle} and that neither device nor lamp changed, and repeat the step"
                );
            }
            Self::ExchangeViews(first, second) => {
                return write!(f, "exchange the views at {first} and {second}, or their angles");
            }
            Self::SameZero => "repeat the mask step with the zero of the polarizer that is used here",
            Self::RemoveDiffuser => "take the diffuser off and let light in through the polarizer alone",
            Self::DescribeMask => "describe the mask's stripes and angles, and the polarizer's zero, as they are",
            Self::WhiteLight => "use white light",
            Self::ShowSameTarget => {
                "show both cameras the same well-lit printed target, and see that nothing moved since the psf step"
            }
            Self::SharperTarget => "use a larger, sharper print with more light",
        })
    }
}
