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

mod admm;
mod fista;
mod guided;
mod guided_filter;
mod power;
mod tv;

use std::fmt;
use std::sync::Arc;

use crate::optics::{Coarse, StokesOperator};
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
    /// The camera, one operator for each colour channel; each channel is solved by itself.
    pub operators: &'a [StokesOperator],
    /// The slow modes of each operator's polarized part; the guided method needs them, the others do not look.
    pub coarse: &'a [Arc<Coarse>],
    /// Standard deviation of the noise of one reading, fractions of full scale.
    pub sigma: f32,
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
}

/// A solver left the finite numbers.
#[derive(Clone, Copy, Debug)]
struct Diverged {
    iteration: usize,
    step: f32,
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
    Guided(Vec<guided::Plan>),
    Fista(Vec<fista::Plan>),
    Admm(Vec<admm::Plan>),
}

/// The buffers of one reconstruction at a time, shared by the channels.
#[derive(Debug)]
pub struct Workspace(Buffers);

#[derive(Debug)]
enum Buffers {
    Guided(guided::Workspace),
    Fista(fista::Workspace),
    Admm(admm::Workspace),
}

impl Plan {
    /// Plans a method for one camera. Allocates; estimates step sizes.
    ///
    /// # Errors
    /// [`PlanError`] when the method cannot work with this camera.
    pub fn new(spec: &Spec<'_>) -> Result<Self, PlanError> {
        let Spec { method, iterations, operators, coarse, sigma } = *spec;
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
                let each = each.zip(coarse.iter().cloned());
                Solver::Guided(each.map(|(o, coarse)| guided::Plan::new(o, coarse, iterations, sigma)).collect())
            }
            Method::Fista => Solver::Fista(
                each.map(|o| fista::Plan::new(o.angle_form(), fista::Variant::Exact, iterations)).collect(),
            ),
            Method::FistaPublished => Solver::Fista(
                each.map(|o| fista::Plan::new(o.angle_form(), fista::Variant::Published, iterations)).collect(),
            ),
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

    /// Planes of each channel's result: 3 (Stokes), 1 (S0 alone) or P (angles).
    pub fn planes(&self) -> usize {
        self.planes
    }

    /// Bytes of one [`Workspace`].
    pub fn workspace_bytes(&self) -> usize {
        match &self.solver {
            Solver::Guided(plans) => plans[0].workspace_bytes(),
            Solver::Fista(plans) => plans[0].workspace_bytes(),
            Solver::Admm(plans) => plans[0].workspace_bytes(),
        }
    }

    /// Buffers for [`Self::run`]. Allocates.
    pub fn make_workspace(&self) -> Workspace {
        Workspace(match &self.solver {
            Solver::Guided(plans) => Buffers::Guided(plans[0].make_workspace()),
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
        let channels = input.raw.count();
        assert_eq!((output.count(), output.size()), (channels * self.planes, self.size), "output of another plan");
        let n = self.size.pixels();
        let mut energy = 0.0;
        for (c, out) in output.as_mut_slice().chunks_exact_mut(self.planes * n).enumerate() {
            let (y, weight) = (input.raw.plane(c), input.weight.plane(c));
            let solved = match (&self.solver, &mut workspace.0) {
                (Solver::Guided(plans), Buffers::Guided(w)) => {
                    let guide =
                        input.guide.map_or_else(|| unreachable!("a guided plan without a guide"), |g| g.plane(c));
                    plans[c].run(y, weight, guide, out, w)
                }
                (Solver::Fista(plans), Buffers::Fista(w)) => plans[c].run(y, weight, out, w),
                (Solver::Admm(plans), Buffers::Admm(w)) => plans[c].run(y, weight, out, w),
                _ => unreachable!("a workspace of another plan"),
            };
            energy +=
                solved.map_err(|Diverged { iteration, step }| Divergence { method: self.method, iteration, step })?;
        }
        Ok(Outcome { residual_rms: (energy / (channels * n) as f64).sqrt() as f32 })
    }
}
