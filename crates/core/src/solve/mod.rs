//! L2: stage I. One frame of a lensless polarization camera (and a guide) → Stokes or angle images.
//!
//! Input: readings `[C, H, W]`, f32, fractions of full scale, black level removed; a weight of 0 (ignore) or 1 for each; the
//! guide `[C, H, W]` in the readings' units. Output: Stokes `[C, 3, H, W]` (`[C, 1, H, W]` without a mask) or angle
//! intensities `[C, P, H, W]`, finite, S0 ≥ 0. Every method runs a fixed number of iterations.
//!
//! Allocation: [`Plan::new`], [`Plan::make_workspace`] and [`Plan::make_continuation`] allocate, [`Plan::run`] and
//! [`Plan::run_next`] do not. Workspaces are garbage between runs, except in a video: what its next frame needs is in a
//! [`Continuation`] and in the workspace.
//! Imports: [`crate::image`], [`crate::parallel`], [`crate::optics`].
//!
//! *The solver step*: `splitting.rs` with `field.rs` and `field/rows.rs` (`guided` and `stokes`, the default), `fista.rs` and
//! `admm.rs` (the paper's).

mod admm;
mod field;
mod fista;
mod guided_filter;
mod power;
mod splitting;
mod statistics;
mod tv;
mod video;

pub use video::{Continuation, Course, Step};

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use crate::image::{Size, Stack};
use crate::optics::{Coarse, Scratch, StokesOperator};

/// How stage I solves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Deserialize, serde::Serialize)]
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
    /// The camera, one operator for each colour channel; each channel is solved by itself.
    pub operators: &'a [StokesOperator],
    /// The slow modes of each operator's polarized part, for `guided` behind a mask; where they are missing they are
    /// made, once for channels that share their PSF.
    pub coarse: &'a [Arc<Coarse>],
    /// ‖A‖² of each operator in angle form, for `fista`; where they are missing they are found.
    pub norms: &'a [f32],
}

/// Why a reconstruction cannot be planned.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlanError {
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

/// What was solved for in a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Modelled {
    /// Nothing: S0 is the guide's, and the readings show no polarization above their noise.
    Nothing,
    /// S0.
    Intensity,
    /// S1 and S2; S0 is the guide's.
    Polarized,
    /// The same once for all colours, which share one polarization.
    Shared,
    /// S0, S1 and S2.
    Both,
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
            Self::Both => &["s0", "s1", "s2"],
            Self::Angles => &["angles"],
        }
    }
}

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// What was solved for; the most of any channel.
    pub modelled: Modelled,
    /// Root mean square of the weighted residual A·x − y over all channels, fractions of full scale.
    pub residual_rms: f32,
    /// For each channel, the factor by which the guide was corrected; 1 without one.
    pub gain: [f32; 3],
    /// Standard deviation of the readings' noise as measured in the frame, the largest of the channels'; none for the angle
    /// methods, which do not look at it.
    pub sigma: Option<f32>,
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

/// A solver left the finite numbers.
#[derive(Clone, Copy, Debug)]
struct Diverged {
    iteration: usize,
    step: f32,
}

/// One channel's outcome.
#[derive(Clone, Copy, Debug)]
struct Solved {
    /// Sum of squares of the residual.
    energy: f64,
    gain: f32,
    sigma: f32,
    modelled: Modelled,
}

/// residual ← weight ⊙ (residual − y); its sum of squares.
fn subtract(residual: &mut [f32], y: &[f32], weight: &[f32]) -> f64 {
    let mut energy = 0.0;
    for (r, (y, w)) in residual.iter_mut().zip(y.iter().zip(weight)) {
        *r = w * (*r - y);
        energy += f64::from(*r * *r);
    }
    energy
}

/// ‖A‖² of a camera in angle form by power iteration from a fixed seed, slightly over-estimated: what [`Spec::norms`] takes.
/// Allocates.
pub fn norm_squared(operator: &StokesOperator) -> f32 {
    fista::Plan::new(operator.angle_form(), fista::Variant::Published, 1, None).norm_squared()
}

/// A planned reconstruction.
#[derive(Debug)]
pub struct Plan {
    method: Method,
    size: Size,
    solver: Solver,
    /// Planes of one channel's result.
    planes: usize,
}

/// One plan for each channel.
#[derive(Debug)]
enum Solver {
    Splitting(Vec<splitting::Plan>),
    Fista(Vec<fista::Plan>),
    Admm(Vec<admm::Plan>),
}

/// The buffers of one reconstruction at a time, shared by the channels.
#[derive(Debug)]
pub struct Workspace(Buffers);

#[derive(Debug)]
enum Buffers {
    Splitting(Box<splitting::Workspace>),
    Fista(fista::Workspace),
    Admm(admm::Workspace),
}

impl Workspace {
    /// The shortest iteration of the latest run beside a guide: what an iteration costs while nothing else does.
    pub fn shortest_iteration(&self) -> Option<std::time::Duration> {
        match &self.0 {
            Buffers::Splitting(w) => Some(w.shortest).filter(|t| *t < std::time::Duration::MAX),
            Buffers::Fista(_) | Buffers::Admm(_) => None,
        }
    }

    /// Complex 2-D FFTs of the padded size done so far.
    pub fn transforms(&self) -> usize {
        match &self.0 {
            Buffers::Splitting(w) => &w.scratch,
            Buffers::Fista(w) => &w.scratch,
            Buffers::Admm(w) => &w.scratch,
        }
        .transforms()
    }

    /// Buffers of the convolutions, for who works between two runs.
    pub fn scratch(&mut self) -> &mut Scratch {
        match &mut self.0 {
            Buffers::Splitting(w) => w.scratch(),
            Buffers::Fista(w) => &mut w.scratch,
            Buffers::Admm(w) => &mut w.scratch,
        }
    }
}

impl Plan {
    /// Plans a method for one camera. Allocates; estimates step sizes.
    ///
    /// # Errors
    /// [`PlanError`] when the method cannot work with this camera.
    pub fn new(spec: &Spec<'_>) -> Result<Self, PlanError> {
        let Spec { method, iterations, operators, coarse, norms } = *spec;
        let response = &operators[0].response;
        if iterations == 0 {
            return Err(PlanError::NoIterations);
        }
        if method.solves_angles() && !response.is_polarized() {
            return Err(PlanError::NoMask { method });
        }
        let planes = match (response.is_polarized(), method.solves_angles()) {
            (false, _) => 1,
            (true, false) => 3,
            (true, true) => response.angles().len(),
        };
        let each = operators.iter().cloned();
        let solver = match method {
            Method::Guided | Method::Stokes => {
                let guided = method == Method::Guided;
                let mut plans: Vec<splitting::Plan> = Vec::with_capacity(operators.len());
                for (c, operator) in each.enumerate() {
                    let given = coarse.get(c).filter(|_| guided && response.is_polarized()).cloned();
                    let coarse = given.or_else(|| plans.iter().find_map(|plan| plan.coarse_for(&operator)));
                    plans.push(splitting::Plan::new(operator, guided, iterations, coarse));
                }
                Solver::Splitting(plans)
            }
            Method::Fista | Method::FistaPublished => {
                let exact = method == Method::Fista;
                let variant = if exact { fista::Variant::Exact } else { fista::Variant::Published };
                let plan = |(c, o): (usize, StokesOperator)| {
                    fista::Plan::new(o.angle_form(), variant, iterations, norms.get(c).copied())
                };
                Solver::Fista(each.enumerate().map(plan).collect())
            }
            Method::Admm => Solver::Admm(each.map(|o| admm::Plan::new(o.angle_form(), false, iterations)).collect()),
            Method::AdmmPublished => {
                Solver::Admm(each.map(|o| admm::Plan::new(o.angle_form(), true, iterations)).collect())
            }
        };
        Ok(Self { method, size: operators[0].convolver.size(), solver, planes })
    }

    /// The method.
    pub fn method(&self) -> Method {
        self.method
    }

    /// Runs this many iterations from now on, at least one. Nothing is planned anew: buffers do not depend on it.
    pub fn set_iterations(&mut self, iterations: usize) {
        let n = iterations.max(1);
        match &mut self.solver {
            Solver::Splitting(plans) => plans.iter_mut().for_each(|plan| plan.iterations = n),
            Solver::Fista(plans) => plans.iter_mut().for_each(|plan| plan.iterations = n),
            Solver::Admm(plans) => plans.iter_mut().for_each(|plan| plan.iterations = n),
        }
    }

    /// Planes of each channel's result: 3 (Stokes), 1 (S0 alone) or P (angles).
    pub fn planes(&self) -> usize {
        self.planes
    }

    /// Bytes of one [`Workspace`].
    pub fn workspace_bytes(&self) -> usize {
        self.workspace_parts().iter().map(|(_, bytes)| bytes).sum()
    }

    /// What one [`Workspace`] consists of, in bytes. Allocates.
    pub fn workspace_parts(&self) -> Vec<(&'static str, usize)> {
        match &self.solver {
            Solver::Splitting(plans) => plans[0].workspace_parts(),
            Solver::Fista(plans) => vec![("fista", plans[0].workspace_bytes())],
            Solver::Admm(plans) => vec![("admm", plans[0].workspace_bytes())],
        }
    }

    /// Bytes the plan itself holds beside its camera.
    pub fn bytes(&self) -> usize {
        match &self.solver {
            Solver::Splitting(plans) => {
                let shared = |c: usize| plans[..c].iter().any(|earlier| earlier.shares_with(&plans[c]));
                (0..plans.len()).filter(|c| !shared(*c)).map(|c| plans[c].bytes()).sum()
            }
            Solver::Fista(_) | Solver::Admm(_) => 0,
        }
    }

    /// Buffers for [`Self::run`]. Allocates.
    pub fn make_workspace(&self) -> Workspace {
        Workspace(match &self.solver {
            Solver::Splitting(plans) => Buffers::Splitting(Box::new(plans[0].make_workspace())),
            Solver::Fista(plans) => Buffers::Fista(plans[0].make_workspace()),
            Solver::Admm(plans) => Buffers::Admm(plans[0].make_workspace()),
        })
    }

    /// Reconstructs one frame into `output`, `[C, planes, H, W]`.
    ///
    /// # Errors
    /// [`Divergence`]; `output` is then garbage.
    ///
    /// # Panics
    /// When shapes or the workspace are not those of the plan, or a guided plan is given no guide.
    pub fn run(
        &self,
        input: &Input<'_>,
        output: &mut Stack<f32>,
        workspace: &mut Workspace,
    ) -> Result<Outcome, Divergence> {
        self.run_frame(input, output, workspace, None)
    }

    /// Whether a video's frames can go on from each other: S1 and S2 beside a guide.
    fn continues(&self) -> bool {
        self.method == Method::Guided && self.planes == 3
    }

    /// What is kept between the frames of a video, for [`Self::run_next`]. Allocates.
    pub fn make_continuation(&self) -> Continuation {
        let kept = match &self.solver {
            Solver::Splitting(plans) if self.continues() => {
                plans.iter().map(|plan| plan.make_kept(plans.len() == 1)).collect()
            }
            _ => Vec::new(),
        };
        Continuation::new(kept, self.size)
    }

    /// Bytes of a [`Continuation`].
    pub fn continuation_bytes(&self) -> usize {
        match &self.solver {
            Solver::Splitting(plans) if self.continues() => {
                plans.iter().map(|plan| plan.kept_bytes(plans.len() == 1)).sum()
            }
            _ => 0,
        }
    }

    /// Reconstructs the next frame of a video into `output`. Beside a guide it goes on from the last one's result: two iterations
    /// where nothing has changed beyond noise, with readings and guide averaged over the frames since; six where something has;
    /// all of them in another scene. Any other method solves each frame by itself. `workspace` is that of the last frame: the state
    /// of a camera of one channel lies in it.
    ///
    /// # Errors
    /// [`Divergence`]; `output` is then garbage and the next frame is solved by itself.
    ///
    /// # Panics
    /// As [`Self::run`], and when `last` is of another plan.
    pub fn run_next(
        &self,
        input: &Input<'_>,
        output: &mut Stack<f32>,
        workspace: &mut Workspace,
        last: &mut Continuation,
    ) -> Result<(Outcome, Step), Divergence> {
        let mut step = Step { averaged: 1, ..Step::default() };
        let mut video = None;
        if self.continues() {
            step = last.advance(input);
            video = Some((&mut *last, &mut step.course));
        }
        let outcome = self.run_frame(input, output, workspace, video).inspect_err(|_| last.forget())?;
        if outcome.modelled == Modelled::Nothing {
            // No state was made that the next frame could go on from.
            last.forget();
            return Ok((outcome, Step { averaged: 1, ..Step::default() }));
        }
        step.iterations = match &self.solver {
            Solver::Splitting(plans) => step.course.iterations(plans[0].iterations),
            Solver::Fista(plans) => plans[0].iterations,
            Solver::Admm(plans) => plans[0].iterations,
        };
        Ok((outcome, step))
    }

    fn run_frame(
        &self,
        input: &Input<'_>,
        output: &mut Stack<f32>,
        workspace: &mut Workspace,
        mut video: Option<(&mut Continuation, &mut Course)>,
    ) -> Result<Outcome, Divergence> {
        let channels = input.raw.count();
        assert_eq!((output.count(), output.size()), (channels * self.planes, self.size), "output of another plan");
        let n = self.size.pixels();
        let failed = |Diverged { iteration, step }| Divergence { method: self.method, iteration, step };
        if let Some(shared) = self.run_shared(input, output, workspace, &mut video).map_err(failed)? {
            return Ok(Outcome {
                modelled: Modelled::Shared,
                residual_rms: (shared.energy / (channels * n) as f64).sqrt() as f32,
                gain: shared.gain,
                sigma: Some(shared.sigma),
            });
        }
        let (mut energy, mut gain, mut sigma) = (0.0, [1.0; 3], None::<f32>);
        let mut modelled = if self.method.solves_angles() { Modelled::Angles } else { Modelled::Nothing };
        for (c, out) in output.as_mut_slice().chunks_exact_mut(self.planes * n).enumerate() {
            let (y, weight, guide) = (input.raw.plane(c), input.weight.plane(c), input.guide.map(|g| g.plane(c)));
            let solved = match (&self.solver, &mut workspace.0) {
                (Solver::Splitting(plans), Buffers::Splitting(w)) => {
                    assert!(guide.is_some() || self.method != Method::Guided, "a guided plan without a guide");
                    let guide = guide.filter(|_| self.method == Method::Guided);
                    let solved = match &mut video {
                        Some((last, course)) => plans[c].run_next(weight, (last.channel(c), **course), out, w),
                        None => plans[c].run(y, weight, guide, out, w),
                    };
                    solved.map(|solved| {
                        gain[c] = solved.gain;
                        sigma = Some(sigma.map_or(solved.sigma, |s| s.max(solved.sigma)));
                        if solved.modelled != Modelled::Nothing {
                            modelled = solved.modelled;
                        }
                        solved.energy
                    })
                }
                (Solver::Fista(plans), Buffers::Fista(w)) => plans[c].run(y, weight, out, w),
                (Solver::Admm(plans), Buffers::Admm(w)) => plans[c].run(y, weight, out, w),
                _ => unreachable!("a workspace of another plan"),
            };
            energy += solved.map_err(failed)?;
        }
        Ok(Outcome { modelled, residual_rms: (energy / (channels * n) as f64).sqrt() as f32, gain, sigma })
    }
    /// All channels at once, where they share one polarization. Whether they do is asked by every frame that is solved by itself;
    /// a frame that no longer does is one.
    fn run_shared(
        &self,
        input: &Input<'_>,
        output: &mut Stack<f32>,
        workspace: &mut Workspace,
        video: &mut Option<(&mut Continuation, &mut Course)>,
    ) -> Result<Option<splitting::Common>, Diverged> {
        let (Solver::Splitting(plans), Buffers::Splitting(w)) = (&self.solver, &mut workspace.0) else {
            return Ok(None);
        };
        let asked = video.as_ref().is_none_or(|(last, course)| last.shared || **course == Course::Cold);
        if !self.continues() || !asked || !splitting::Plan::may_share(plans) {
            return Ok(None);
        }
        let frames = video.as_mut().map(|(last, course)| (last.channels(), **course));
        let shared = plans[0].run_shared(input, frames, output.as_mut_slice(), w)?;
        if let Some((last, course)) = video {
            last.shared = shared.is_some();
            if shared.is_none() {
                **course = Course::Cold;
            }
        }
        Ok(shared)
    }
}
