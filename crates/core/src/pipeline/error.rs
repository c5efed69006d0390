//! Errors of planning a pipeline and of processing a frame.

use crate::guide::PrepareError;
use crate::optics::LengthError;
use crate::refine;
use crate::solve::{self, Divergence};

/// A pipeline that cannot be planned.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The frame is too large for the FFT backend.
    #[error(transparent)]
    Length(#[from] LengthError),
    /// The solver cannot work with this camera.
    #[error(transparent)]
    Recon(#[from] solve::PlanError),
    /// The fusion model cannot be run.
    #[error(transparent)]
    Fusion(#[from] refine::PlanError),
    /// A guided method without a guide.
    #[error(
        "method guided needs a guide frame; allowed without one: stokes, and every method that begins with fista or admm"
    )]
    NoGuide,
    /// Zero iterations.
    #[error("iterations = 0, allowed: 1 or more")]
    NoIterations,
    /// The stages need more memory than there is.
    #[error("memory: {} need {total} bytes together, the limit is {limit}", stages.iter().map(|(name, bytes)| format!("{name} {bytes}")).collect::<Vec<_>>().join(" + "))]
    Memory {
        /// Bytes of each stage.
        stages: Vec<(&'static str, usize)>,
        /// Their sum.
        total: usize,
        /// The limit.
        limit: usize,
    },
}

/// A frame that cannot be processed.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// It does not fit the bundle or holds nothing usable.
    #[error(transparent)]
    Prepare(#[from] PrepareError),
    /// The solver diverged.
    #[error(transparent)]
    Recon(#[from] Divergence),
    /// The guide proved useless and S0 cannot be solved for instead.
    #[error(transparent)]
    Plan(#[from] PlanError),
}
