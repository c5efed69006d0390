//! Accelerated proximal gradient (FISTA) with 3-D total variation, the paper's solver.
//!
//! z − (1/L) Aᵀ(A z − b), prox, momentum. `fista` takes the exact L = ‖A‖² and the standard momentum; `fista-published` and its two
//! variants take the published code's L, momentum and prox (Monakhova et al., Spectral DiffuserCam, `fista_spectral_cupy.py`).

use std::sync::Arc;

use super::tv::{Thresholds, haar_3d};
use super::{ChannelSolver, power, residual};
use crate::optics::{AngleOperator, Scratch, StokesOperator};
use crate::solve::{Buffers, Diverged};

/// λ of `fista`, for images in units of full scale and a PSF of unit sum.
const LAMBDA: f32 = 1.5e-5;
/// Smoothing along the polarization axis over that along the spatial ones: angles differ more than neighbours.
const POLARIZATION_WEIGHT: f32 = 0.5;
/// λ and λ_w of the publication for synthetic data.
const PUBLISHED_LAMBDA: f32 = 5e-5;
/// The publication's factor on the eigenvalue of one blur, for synthetic data.
const PUBLISHED_C: f32 = 45.0;
/// Rounds of the publication's power iteration.
const PUBLISHED_ROUNDS: usize = 10;
/// Growth of the residual's energy over its start that no stable iteration reaches.
const DIVERGED: f64 = 100.0;

/// Prox and momentum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Variant {
    Exact,
    Published,
}

impl Variant {
    /// The next t of the momentum (t − 1) / t_next.
    fn next(self, t: f32) -> f32 {
        match self {
            Self::Exact => 0.5 * (1.0 + (1.0 + 4.0 * t * t).sqrt()),
            Self::Published => 1.0 + 0.5 * (1.0 + 4.0 * t * t).sqrt(),
        }
    }

    /// The constraint x ≥ 0, for a value and its smoothed one.
    fn positive(self, value: f32, smooth: f32) -> f32 {
        match self {
            Self::Exact => smooth.max(0.0),
            Self::Published => 0.5 * (value.max(0.0) + smooth),
        }
    }
}

/// Reading of the published threshold λ/L.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::solve) enum Threshold {
    /// As published: for images in front of a PSF of unit ℓ2 norm. It hardly regularizes, so that many iterations fit the noise.
    Published,
    /// λ times the step, for images in units of full scale.
    Scaled,
}

/// FISTA planned for one channel.
#[derive(Debug)]
pub(in crate::solve) struct Plan {
    operator: AngleOperator,
    variant: Variant,
    /// 1/L.
    step: f32,
    thresholds: Thresholds,
}

/// Buffers of [`Plan`].
#[derive(Debug)]
pub(in crate::solve) struct Workspace {
    /// Momentum point.
    z: Vec<f32>,
    /// Gradient, then the point before the prox.
    v: Vec<f32>,
    residual: Vec<f32>,
    /// Two interleaved angles.
    pair: Vec<f32>,
    scratch: Scratch,
}

impl Buffers for Workspace {
    fn scratch(&self) -> &Scratch {
        &self.scratch
    }

    fn scratch_mut(&mut self) -> &mut Scratch {
        &mut self.scratch
    }
}

/// ‖A‖², slightly over-estimated. Allocates.
fn norm_squared(operator: &AngleOperator) -> f32 {
    let mut w = make_workspace(operator);
    power::norm_squared(w.z.len(), |x| {
        operator.forward(x, &mut w.residual, &mut w.scratch);
        operator.adjoint(&w.residual, x, &mut w.pair, &mut w.scratch);
    })
}

fn make_workspace(operator: &AngleOperator) -> Workspace {
    let (n, values) = (operator.convolver.size().pixels(), operator.weights.as_slice().len());
    Workspace {
        z: vec![0.0; values],
        v: vec![0.0; values],
        residual: vec![0.0; n],
        pair: vec![0.0; 2 * n],
        scratch: operator.convolver.make_scratch(),
    }
}

impl Plan {
    /// `fista` for each channel. Channels of one PSF share their step size.
    pub(in crate::solve) fn exact_for_channels(operators: &[StokesOperator]) -> Vec<Self> {
        let mut plans: Vec<Self> = Vec::with_capacity(operators.len());
        for (c, operator) in operators.iter().enumerate() {
            let same = operators[..c].iter().position(|earlier| Arc::ptr_eq(&earlier.kernel, &operator.kernel));
            let angles = operator.angle_form();
            let step = same.map_or_else(|| norm_squared(&angles).recip(), |earlier| plans[earlier].step);
            plans.push(Self::exact(angles, step));
        }
        plans
    }

    /// `fista` with a step of 1/‖A‖².
    fn exact(operator: AngleOperator, step: f32) -> Self {
        let thresholds = Thresholds { spatial: step * LAMBDA, polarization: step * LAMBDA * POLARIZATION_WEIGHT };
        Self { operator, variant: Variant::Exact, step, thresholds }
    }

    /// `fista-published` and its variants, for each channel. Channels of one PSF share their step size.
    pub(in crate::solve) fn published_for_channels(operators: &[StokesOperator], threshold: Threshold) -> Vec<Self> {
        let mut eigenvalues: Vec<f32> = Vec::with_capacity(operators.len());
        for (c, operator) in operators.iter().enumerate() {
            let same = operators[..c].iter().position(|earlier| Arc::ptr_eq(&earlier.kernel, &operator.kernel));
            eigenvalues
                .push(same.map_or_else(|| blur_eigenvalue(&operator.angle_form()), |earlier| eigenvalues[earlier]));
        }
        let plan = |(operator, eigenvalue): (&StokesOperator, &f32)| {
            Self::published(operator.angle_form(), *eigenvalue, threshold)
        };
        operators.iter().zip(&eigenvalues).map(plan).collect()
    }

    /// The published code scales the PSF to unit ℓ2 norm, which makes its images ‖k‖₂ times ours, and takes L = 45 times the eigenvalue of
    /// one blur, which is 1/‖k‖₂ times that of our unit-sum kernel. In our scale that is a step of 1/(L‖k‖₂²) and a threshold of λ/(L‖k‖₂).
    fn published(operator: AngleOperator, eigenvalue: f32, threshold: Threshold) -> Self {
        let l2 = operator.kernel.l2_norm();
        let l = PUBLISHED_C * eigenvalue / l2;
        let step = (l * l2 * l2).recip();
        let spatial = PUBLISHED_LAMBDA
            * match threshold {
                Threshold::Published => (l * l2).recip(),
                Threshold::Scaled => step,
            };
        let thresholds = Thresholds { spatial, polarization: spatial * PUBLISHED_LAMBDA };
        Self { operator, variant: Variant::Published, step, thresholds }
    }
}

/// Eigenvalue of the blur of a frame that is dark outside, seen through all polarizers together, by power iteration as published. It
/// begins with an even image in place of noise. Allocates.
fn blur_eigenvalue(operator: &AngleOperator) -> f32 {
    let mut w = make_workspace(operator);
    let n = w.residual.len();
    w.residual.fill(1.0);
    let mut eigenvalue = 0.0;
    for _ in 0..=PUBLISHED_ROUNDS {
        let norm = square(&w.residual).sqrt().max(f64::MIN_POSITIVE) as f32;
        for image in w.z.chunks_exact_mut(n) {
            image.iter_mut().zip(&w.residual).for_each(|(z, r)| *z = r / norm);
        }
        operator.forward(&w.z, &mut w.residual, &mut w.scratch);
        eigenvalue = w.z.iter().zip(&w.residual).map(|(z, r)| f64::from(z * r)).sum();
    }
    eigenvalue as f32
}

fn square(v: &[f32]) -> f64 {
    v.iter().map(|v| f64::from(*v).powi(2)).sum()
}

impl ChannelSolver for Plan {
    const NAME: &'static str = "fista";
    type Workspace = Workspace;

    fn operator(&self) -> &AngleOperator {
        &self.operator
    }

    fn make_workspace(&self) -> Workspace {
        make_workspace(&self.operator)
    }

    fn workspace_bytes(&self) -> usize {
        let (c, values) = (&self.operator.convolver, self.operator.weights.as_slice().len());
        (2 * values + 3 * c.size().pixels()) * size_of::<f32>() + c.scratch_bytes()
    }

    fn run(
        &self,
        b: &[f32],
        weight: &[f32],
        iterations: usize,
        x: &mut [f32],
        w: &mut Workspace,
    ) -> Result<f64, Diverged> {
        let (size, count) = (self.operator.convolver.size(), self.operator.weights.count());
        let Workspace { z, v, residual: r, pair, scratch } = w;
        x.fill(0.0);
        z.fill(0.0);
        let mut t = 1.0f32;
        let start = residual(&self.operator, z, (b, weight), r, scratch);
        let mut energy = start;
        for iteration in 0..iterations {
            self.operator.adjoint(r, v, pair, scratch);
            v.iter_mut().zip(&*z).for_each(|(v, z)| *v = z - self.step * *v);
            let t_next = self.variant.next(t);
            let beta = (t - 1.0) / t_next;
            t = t_next;
            haar_3d(v, count, size, self.thresholds, |i, smooth| {
                let next = self.variant.positive(v[i], smooth);
                z[i] = next + beta * (next - x[i]);
                x[i] = next;
            });
            energy = residual(&self.operator, z, (b, weight), r, scratch);
            // From zero a stable iteration never makes the residual worse than no image at all; momentum overshoots a little.
            if energy.is_nan() || energy > DIVERGED * start {
                return Err(Diverged { iteration: iteration + 1, step: self.step });
            }
        }
        // The published prox lets half of a negative value pass; intensities are not negative.
        x.iter_mut().for_each(|x| *x = x.max(0.0));
        Ok(energy)
    }
}
