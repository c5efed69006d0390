//! Names of the methods.

use std::fmt;
use std::str::FromStr;

/// Method of stage I.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// S1 and S2 with S0 from the guide camera.
    Guided,
    /// S0, S1 and S2 without a guide; S0 alone without a mask.
    Stokes,
    /// The paper's FISTA over angle intensities with exact step and standard momentum.
    Fista,
    /// The paper's FISTA as its published code runs it: on a field of twice the frame's sides, with that code's constants.
    FistaPublished,
    /// As [`Self::FistaPublished`], with the threshold read in units of the sensor's readings, which regularizes.
    FistaPublishedScaled,
    /// As [`Self::FistaPublishedScaled`], on the frame alone.
    FistaPublishedFrame,
    /// The paper's ADMM with exact splitting.
    Admm,
    /// The paper's ADMM with inner conjugate gradients.
    AdmmPublished,
}

impl Method {
    /// All methods.
    pub const ALL: [Self; 8] = [
        Self::Guided,
        Self::Stokes,
        Self::Fista,
        Self::FistaPublished,
        Self::FistaPublishedScaled,
        Self::FistaPublishedFrame,
        Self::Admm,
        Self::AdmmPublished,
    ];

    /// Whether the result is one intensity for each angle rather than Stokes components.
    pub fn solves_angles(self) -> bool {
        !matches!(self, Self::Guided | Self::Stokes)
    }
}

/// A name that no method has.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{found}` is no method, allowed: {}", Method::ALL.map(|method| method.to_string()).join(", "))]
pub struct MethodNameError {
    /// The text found.
    pub found: String,
}

impl FromStr for Method {
    type Err = MethodNameError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let named = Self::ALL.into_iter().find(|method| method.to_string() == text);
        named.ok_or_else(|| MethodNameError { found: text.to_owned() })
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Guided => "guided",
            Self::Stokes => "stokes",
            Self::Fista => "fista",
            Self::FistaPublished => "fista-published",
            Self::FistaPublishedScaled => "fista-published-scaled",
            Self::FistaPublishedFrame => "fista-published-frame",
            Self::Admm => "admm",
            Self::AdmmPublished => "admm-published",
        })
    }
}
