//! L2: stage I. One frame of a lensless polarization camera (and a guide) → Stokes or angle images.
//!
//! Input: readings `[C, H, W]`, f32, fractions of full scale, black level removed; a weight of 0 (ignore) or 1 for each; the
//! guide `[C, H, W]` in the readings' units. Output: Stokes `[C, 3, H, W]` (`[C, 1, H, W]` without a mask) or angle
//! intensities `[C, P, H, W]`, finite, S0 ≥ 0. Every method runs a fixed number of iterations.
//!
//! Allocation: [`Plan::new`] and [`Plan::make_workspace`] allocate, [`Plan::run`] does not. Workspaces are garbage between runs.
//! Imports: [`crate::plane`], [`crate::parallel`], [`crate::optics`].
//!
//! *The solver step*: `guided.rs` (the default), `fista.rs` and `admm.rs` (the paper's).

mod fista;
mod power;
mod tv;

use std::fmt;
use std::sync::Arc;

use crate::optics::{AngleOperator, Convolver, FftBackend, LengthError, Psf, Response, StokesOperator};
use crate::parallel::Workers;
use crate::plane::{Size, Stack};

/// How stage I solves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Deserialize, serde::Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// S1 and S2 with S0 from the guide camera.
    Guided,
    /// S0, S1 and S2 without a guide; S0 alone without a mask.
    Stokes,
    /// The paper's FISTA over angle intensities with exact step and standard momentum.
    Fista,
    /// The same with the published code's constants.
    FistaPublished,
    /// The paper's ADMM with exact splitting.
    Admm,
    /// The paper's ADMM with inner conjugate gradients.
    AdmmPublished,
}

impl Method {
    /// All methods.
    pub const ALL: [Self; 6] =
        [Self::Guided, Self::Stokes, Self::Fista, Self::FistaPublished, Self::Admm, Self::AdmmPublished];

    /// Whether the result is one intensity for each angle rather than Stokes components.
    pub fn solves_angles(self) -> bool {
        !matches!(self, Self::Guided | Self::Stokes)
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Guided => "guided",
            Self::Stokes => "stokes",
            Self::Fista => "fista",
            Self::FistaPublished => "fista-published",
            Self::Admm => "admm",
            Self::AdmmPublished => "admm-published",
        })
    }
}

/// What a [`Plan`] is made from.
#[derive(Clone, Debug)]
pub struct Spec<'a> {
    /// How to solve.
    pub method: Method,
    /// How many iterations.
    pub iterations: usize,
    /// The diffuser.
    pub psf: &'a Psf,
    /// The mask.
    pub response: &'a Response,
    /// Colour channels: 1 or 3, each solved by itself.
    pub channels: usize,
    /// The FFT library.
    pub fft: FftBackend,
    /// The threads.
    pub workers: Arc<Workers>,
}

/// Why a reconstruction cannot be planned.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// The frame is too large for the FFT backend.
    #[error(transparent)]
    Length(#[from] LengthError),
    /// An angle method without angles.
    #[error(
        "method {method} solves for polarizer angles, the bundle's mask is of kind \"none\"; allowed: stokes, guided"
    )]
    NoMask {
        /// The method asked for.
        method: Method,
    },
    /// Zero iterations.
    #[error("iterations = 0, allowed: 1 or more")]
    NoIterations,
}

/// The iteration left the finite numbers: its step is too long for this camera.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{method} diverged at iteration {iteration} with a step of {step:e}; use another method")]
pub struct Divergence {
    /// The method.
    pub method: Method,
    /// Iteration, from 1.
    pub iteration: usize,
    /// Step size, for a PSF of unit sum.
    pub step: f32,
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// Root mean square of the weighted residual A·x − y over all channels, fractions of full scale.
    pub residual_rms: f32,
}

/// One frame to solve.
#[derive(Clone, Copy, Debug)]
pub struct Input<'a> {
    /// Readings `[C, H, W]`, fractions of full scale.
    pub raw: &'a Stack<f32>,
    /// 0 or 1 for each reading: 0 for saturated, dead or unreadable pixels.
    pub weight: &'a Stack<f32>,
    /// The registered guide `[C, H, W]`, in the readings' units.
    pub guide: Option<&'a Stack<f32>>,
    /// Standard deviation of the noise of one reading.
    pub sigma: f32,
}
