//! Stage I: one frame of a lensless polarization camera, and a guide, become Stokes or angle images.
//!
//! Input: readings `[C, H, W]`, f32, fractions of full scale, black level removed; a weight of 0 (ignore) or 1 for each; the
//! guide `[C, H, W]` in the readings' units. Output: Stokes `[C, 3, H, W]` (`[C, 1, H, W]` without a mask) or angle
//! intensities `[C, P, H, W]`, finite, S0 ≥ 0. Every method runs a fixed number of iterations, given with the frame.
//!
//! - `problem.rs`: what is minimised, with all symbols.
//! - `admm/`: the ADMM of `guided` and `stokes`: state, data step, prior step, image step, and the pass over rows that fuses the
//!   first two. Each step stands there in a plain scalar form too, beside the vector form that is tested against it.
//! - `direct_start.rs`, `guided.rs`, `unguided.rs`: constants from the data, start and order of the iterations in each mode.
//! - `interpolated.rs`: `stokes` for polarizers on single pixels behind a lens.
//! - `joint_colors.rs`, `channels.rs`, `video.rs`: colour channels of a frame, frames of a video.
//! - `reference/`: the paper's solvers, for comparison.
//!
//! Allocation: [`Plan::new`], [`Plan::make_workspace`] and [`Plan::make_continuation`] allocate, [`Plan::run`] and
//! [`Plan::run_next`] do not. The content of a workspace is of no use after a run, except in a video: the next frame needs both the
//! [`Continuation`] and the workspace.

mod admm;
mod channels;
mod direct_start;
mod guided;
mod guided_filter;
mod interpolated;
mod joint_colors;
mod method;
mod problem;
mod reference;
mod statistics;
mod unguided;
mod video;
mod warm_start;

use std::any::Any;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

pub use method::{Method, MethodNameError};
pub use video::Continuation;
pub use warm_start::WarmStart;

use crate::image::{Size, Stack};
use crate::optics::{Coarse, Field, Scratch, StokesOperator};
use reference::admm as reference_admm;
use reference::fista::{self, Threshold};

/// Everything that a [`Plan`] is made from.
#[derive(Clone, Debug)]
pub struct Spec<'a> {
    /// Method.
    pub method: Method,
    /// The camera, one operator for each colour channel; each channel is solved by itself.
    pub operators: &'a [StokesOperator],
    /// Normal equations of the slow modes of each operator's polarized part, for `guided` behind a mask. Missing ones are made, once for
    /// channels that share their PSF.
    pub coarse: &'a [Arc<Coarse>],
}

/// A reconstruction that cannot be planned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PlanError {
    /// An angle method without angles.
    #[error(
        "method {method} solves for polarizer angles, the bundle's mask is of kind \"none\"; allowed: stokes, guided"
    )]
    NoMask {
        /// The method asked for.
        method: Method,
    },
}

/// Values that are not finite: the step of the iteration is too long for this camera.
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

/// Unknowns that were solved for in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Modelled {
    /// None: S0 is the guide's, and the readings show no polarization above their noise.
    Nothing,
    /// S0.
    Intensity,
    /// S1 and S2; S0 is the guide's.
    Polarized,
    /// S1 and S2 once for all colours, which share one polarization; S0 is the guide's.
    Shared,
    /// S0, S1 and S2.
    Both,
    /// S0, S1 and S2, interpolated between polarizers on single pixels behind a lens.
    Interpolated,
    /// The intensity behind each angle.
    Angles,
}

impl Modelled {
    /// Names of the unknown images.
    pub fn unknowns(self) -> &'static [&'static str] {
        match self {
            Self::Nothing => &[],
            Self::Intensity => &["s0"],
            Self::Polarized | Self::Shared => &["s1", "s2"],
            Self::Both | Self::Interpolated => &["s0", "s1", "s2"],
            Self::Angles => &["angles"],
        }
    }
}

/// Account of a run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// Unknowns that were solved for; those of the channel that has most.
    pub modelled: Modelled,
    /// Iterations that were run; 0 where nothing was solved for, or without any.
    pub iterations: usize,
    /// How the frame started.
    pub start: WarmStart,
    /// Frames whose readings were averaged, 1 without a video.
    pub averaged: usize,
    /// Root mean square of the weighted residual A·x − b over all channels, fractions of full scale.
    pub residual_rms: f32,
    /// Factor by which the guide was corrected, for each channel; 1 without a guide.
    pub gain: [f32; 3],
    /// Standard deviation of the readings' noise as measured in the frame, the largest of the channels'. The angle methods do not measure
    /// it.
    pub sigma: Option<f32>,
}

impl Outcome {
    /// Outcome of a frame by itself. `energy` is the sum of squares of the residual over its readings, those of `channels` frames of `field`.
    fn cold(modelled: Modelled, iterations: usize, energy: f64, channels: usize, field: Field) -> Self {
        let readings = channels * field.frame().pixels();
        Self {
            modelled,
            iterations: if matches!(modelled, Modelled::Nothing | Modelled::Interpolated) { 0 } else { iterations },
            start: WarmStart::Cold,
            averaged: 1,
            residual_rms: (energy / readings as f64).sqrt() as f32,
            gain: [1.0; 3],
            sigma: None,
        }
    }
}

/// One frame to solve.
#[derive(Clone, Copy, Debug)]
pub struct Input<'a> {
    /// Readings `[C, H, W]`, fractions of full scale; where the weight is 0, an estimate of what would have been read.
    pub raw: &'a Stack<f32>,
    /// 0 or 1 for each reading: 0 for saturated, dead or unreadable pixels.
    pub weight: &'a Stack<f32>,
    /// The registered guide `[C, H, W]`, in the readings' units.
    pub guide: Option<&'a Stack<f32>>,
}

/// An iteration whose values are not finite.
#[derive(Clone, Copy, Debug)]
struct Diverged {
    iteration: usize,
    step: f32,
}

/// A method planned for all colour channels of one camera.
trait Solver: fmt::Debug + Send + Sync {
    /// Buffers of one frame at a time. Allocates.
    fn make_workspace(&self) -> Box<dyn Buffers>;

    /// Parts of a workspace, in bytes. Allocates.
    fn workspace_parts(&self) -> Vec<(&'static str, usize)>;

    /// Bytes held beside the camera's.
    fn bytes(&self) -> usize {
        0
    }

    /// Memory between the frames of a video; empty where each frame is solved by itself. Allocates.
    fn make_continuation(&self) -> Continuation {
        Continuation::new(Vec::new(), Size::new(0, 0), 1)
    }

    /// Bytes of a [`Continuation`].
    fn continuation_bytes(&self) -> usize {
        0
    }

    /// Reconstructs a frame into `output`, `[C, planes, H, W]`; in a video it may go on from the last frame.
    fn run(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut [f32],
        workspace: &mut dyn Buffers,
        video: Option<&mut Continuation>,
    ) -> Result<Outcome, Diverged>;
}

/// The buffers of a [`Solver`].
trait Buffers: Any + fmt::Debug + Send + Sync {
    /// Buffers of the convolutions.
    fn scratch(&self) -> &Scratch;

    /// Buffers of the convolutions, whole, for use between two runs.
    fn scratch_mut(&mut self) -> &mut Scratch;

    /// Forgets what earlier runs left for later ones.
    fn forget(&mut self) {}

    /// The shortest iteration of the latest run, where it is measured.
    fn shortest_iteration(&self) -> Option<Duration> {
        None
    }
}

/// The workspace of the solver that asks for it.
///
/// # Panics
/// When it is one of another solver.
fn own<W: Buffers>(workspace: &mut dyn Buffers) -> &mut W {
    let own = (workspace as &mut dyn Any).downcast_mut();
    own.unwrap_or_else(|| panic!("a workspace of another plan"))
}

/// A planned reconstruction.
#[derive(Debug)]
pub struct Plan {
    method: Method,
    size: Size,
    solver: Box<dyn Solver>,
    /// Planes of one channel's result.
    planes: usize,
}

/// The buffers of one reconstruction at a time, shared by the channels.
#[derive(Debug)]
pub struct Workspace(Box<dyn Buffers>);

impl Workspace {
    /// The shortest iteration of the latest run of `guided` or `stokes`: the cost of an iteration on an otherwise idle machine.
    pub fn shortest_iteration(&self) -> Option<Duration> {
        self.0.shortest_iteration()
    }

    /// Makes the next run independent of earlier ones. Otherwise a factor of nearly the same equations is used again.
    pub fn forget(&mut self) {
        self.0.forget();
    }

    /// Complex 2-D FFTs of the padded size done so far.
    pub fn transforms(&self) -> usize {
        self.0.scratch().transforms()
    }

    /// Buffers of the convolutions, for use between two runs.
    pub fn scratch(&mut self) -> &mut Scratch {
        self.0.scratch_mut()
    }
}

impl Plan {
    /// Plans a method for one camera. Allocates; estimates step sizes.
    ///
    /// # Errors
    /// [`PlanError`] when the method cannot work with this camera.
    pub fn new(spec: &Spec<'_>) -> Result<Self, PlanError> {
        let Spec { method, operators, coarse } = *spec;
        let response = &operators[0].response;
        if method.solves_angles() && !response.is_polarized() {
            return Err(PlanError::NoMask { method });
        }
        let planes = match (response.is_polarized(), method.solves_angles()) {
            (false, _) => 1,
            (true, false) => 3,
            (true, true) => response.angles().len(),
        };
        let angles = || operators.iter().map(StokesOperator::angle_form);
        let solver: Box<dyn Solver> = match method {
            Method::Guided => Box::new(channels::Channels::new(operators, true, coarse)),
            Method::Stokes => match interpolated::Interpolation::new(operators) {
                Some(interpolation) => Box::new(interpolation),
                None => Box::new(channels::Channels::new(operators, false, coarse)),
            },
            Method::Fista => Box::new(fista::Plan::exact_for_channels(operators)),
            Method::FistaPublished => Box::new(fista::Plan::published_for_channels(operators, Threshold::Published)),
            Method::FistaPublishedScaled | Method::FistaPublishedFrame => {
                Box::new(fista::Plan::published_for_channels(operators, Threshold::Scaled))
            }
            Method::Admm => Box::new(angles().map(reference_admm::Exact::new).collect::<Vec<_>>()),
            Method::AdmmPublished => Box::new(angles().map(reference_admm::Published::new).collect::<Vec<_>>()),
        };
        Ok(Self { method, size: operators[0].convolver.size(), solver, planes })
    }

    /// The method.
    pub fn method(&self) -> Method {
        self.method
    }

    /// Planes of each channel's result: 3 (Stokes), 1 (S0 alone) or P (angles).
    pub fn planes(&self) -> usize {
        self.planes
    }

    /// Bytes of one [`Workspace`].
    pub fn workspace_bytes(&self) -> usize {
        self.workspace_parts().iter().map(|(_, bytes)| bytes).sum()
    }

    /// Parts of one [`Workspace`], in bytes. Allocates.
    pub fn workspace_parts(&self) -> Vec<(&'static str, usize)> {
        self.solver.workspace_parts()
    }

    /// Bytes the plan itself holds beside its camera.
    pub fn bytes(&self) -> usize {
        self.solver.bytes()
    }

    /// Buffers for [`Self::run`]. Allocates.
    pub fn make_workspace(&self) -> Workspace {
        Workspace(self.solver.make_workspace())
    }

    /// Reconstructs one frame into `output`, `[C, planes, H, W]`, with this many iterations. Allocates nothing.
    ///
    /// # Errors
    /// [`Divergence`]; the content of `output` is then of no use.
    ///
    /// # Panics
    /// When shapes or the workspace are not those of the plan, for 0 iterations, or when a guided plan is given no guide.
    pub fn run(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut Stack<f32>,
        workspace: &mut Workspace,
    ) -> Result<Outcome, Divergence> {
        self.run_frame(input, iterations, output, workspace, None)
    }

    /// Memory between the frames of a video, for [`Self::run_next`]. Allocates.
    pub fn make_continuation(&self) -> Continuation {
        self.solver.make_continuation()
    }

    /// Bytes of a [`Continuation`].
    pub fn continuation_bytes(&self) -> usize {
        self.solver.continuation_bytes()
    }

    /// Reconstructs the next frame of a video into `output`, a cold one with this many iterations. `guided` behind a mask goes on from the
    /// last result: two iterations where nothing has changed beyond noise, with readings and guide averaged over the frames since; six
    /// where something has; all of them in another scene. Any other method solves each frame by itself. `workspace` must be that of the
    /// last frame: the state of a camera of one channel lies in it. Allocates nothing.
    ///
    /// # Errors
    /// [`Divergence`]; the content of `output` is then of no use and the next frame is solved by itself.
    ///
    /// # Panics
    /// As [`Self::run`], and when `last` is of another plan.
    pub fn run_next(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut Stack<f32>,
        workspace: &mut Workspace,
        last: &mut Continuation,
    ) -> Result<Outcome, Divergence> {
        self.run_frame(input, iterations, output, workspace, Some(last))
    }

    fn run_frame(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut Stack<f32>,
        workspace: &mut Workspace,
        video: Option<&mut Continuation>,
    ) -> Result<Outcome, Divergence> {
        assert!(iterations > 0, "no iterations");
        let planes = input.raw.count() * self.planes;
        assert_eq!((output.count(), output.size()), (planes, self.size), "output of another plan");
        let solved = self.solver.run(input, iterations, output.as_mut_slice(), &mut *workspace.0, video);
        solved.map_err(|Diverged { iteration, step }| Divergence { method: self.method, iteration, step })
    }
}
