//! The paper's solver: accelerated proximal gradient (FISTA) over angle intensities with 3-D TV.
//!
//! min ½‖w ⊙ (A x − y)‖² + λ·TV(x), x ≥ 0, x = `[P, H, W]`: z − (1/L) Aᵀ(A z − y), prox, momentum. `fista` takes the exact
//! L = ‖A‖² and the standard momentum; `fista-published` repeats the published code's scale, L, momentum and weights.

use super::Diverged;
use super::power::norm_squared;
use super::tv::{Thresholds, haar_3d};
use crate::optics::{AngleOperator, Scratch};

/// λ of `fista`, for images in units of full scale and a PSF of unit sum.
const LAMBDA: f32 = 1.5e-5;
/// How much less the polarization axis is smoothed than the spatial ones: angles differ more than neighbours.
const POLARIZATION_WEIGHT: f32 = 0.5;
/// λ and λ_w of the publication for synthetic data.
const PUBLISHED_LAMBDA: f32 = 5e-5;
/// The publication's factor on the norm of one forward blur, for synthetic data.
const PUBLISHED_C: f32 = 45.0;

/// Growth of the residual's energy over its start that no overshoot reaches.
const DIVERGED: f64 = 100.0;

/// Which constants are used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Variant {
    Exact,
    Published,
}

#[derive(Debug)]
pub(super) struct Plan {
    operator: AngleOperator,
    variant: Variant,
    pub(super) iterations: usize,
    step: f32,
    thresholds: Thresholds,
}

#[derive(Debug)]
pub(super) struct Workspace {
    /// Momentum point.
    z: Vec<f32>,
    /// Gradient, then the point before the prox.
    v: Vec<f32>,
    residual: Vec<f32>,
    /// Two interleaved angles.
    pair: Vec<f32>,
    pub(super) scratch: Scratch,
}

impl Plan {
    /// `norm` is ‖A‖² where it is known; the exact variant needs it.
    pub(super) fn new(operator: AngleOperator, variant: Variant, iterations: usize, norm: Option<f32>) -> Self {
        let mut plan = Self {
            operator,
            variant,
            iterations,
            step: 1.0,
            thresholds: Thresholds { spatial: 0.0, polarization: 0.0 },
        };
        let (step, spatial, polarization) = match variant {
            Variant::Exact => {
                let step = norm.unwrap_or_else(|| plan.norm_squared()).recip();
                (step, step * LAMBDA, step * LAMBDA * POLARIZATION_WEIGHT)
            }
            Variant::Published => {
                // The published code scales the PSF to unit ℓ2 norm and takes L = 45 × the norm of one blur, which for a
                // non-negative kernel is its sum, 1/‖k‖₂ times that of our unit-sum kernel. In our scale that is a step of
                // ‖k‖₂²/L. λ/L is taken as λ times that step, for images in units of full scale; in the published code's own
                // scale of images it would be λ/45, which hardly regularizes and lets 500 iterations fit the noise.
                let l2 = plan.operator.kernel.l2_norm();
                let l = PUBLISHED_C / l2;
                let step = (l * l2 * l2).recip();
                (step, step * PUBLISHED_LAMBDA, step * PUBLISHED_LAMBDA * PUBLISHED_LAMBDA)
            }
        };
        plan.step = step;
        plan.thresholds = Thresholds { spatial, polarization };
        plan
    }

    /// ‖A‖², slightly over-estimated. Allocates.
    pub(super) fn norm_squared(&self) -> f32 {
        let mut w = self.make_workspace();
        norm_squared(w.z.len(), |x| {
            self.operator.forward(x, &mut w.residual, &mut w.scratch);
            self.operator.adjoint(&w.residual, x, &mut w.pair, &mut w.scratch);
        })
    }

    fn values(&self) -> usize {
        self.operator.weights.as_slice().len()
    }

    pub(super) fn workspace_bytes(&self) -> usize {
        let n = self.operator.convolver.size().pixels();
        (2 * self.values() + 3 * n) * size_of::<f32>() + self.operator.convolver.scratch_bytes()
    }

    pub(super) fn make_workspace(&self) -> Workspace {
        let n = self.operator.convolver.size().pixels();
        Workspace {
            z: vec![0.0; self.values()],
            v: vec![0.0; self.values()],
            residual: vec![0.0; n],
            pair: vec![0.0; 2 * n],
            scratch: self.operator.convolver.make_scratch(),
        }
    }

    /// Reconstructs one channel from zero into `x`, `[P, H, W]`; returns the energy of the residual.
    pub(super) fn run(&self, y: &[f32], weight: &[f32], x: &mut [f32], w: &mut Workspace) -> Result<f64, Diverged> {
        let (size, count) = (self.operator.convolver.size(), self.operator.weights.count());
        x.fill(0.0);
        w.z.fill(0.0);
        let mut t = 1.0f32;
        let start = self.residual(y, weight, w);
        let mut energy = start;
        for iteration in 0..self.iterations {
            self.operator.adjoint(&w.residual, &mut w.v, &mut w.pair, &mut w.scratch);
            w.v.iter_mut().zip(&w.z).for_each(|(v, z)| *v = z - self.step * *v);
            let t_next = match self.variant {
                Variant::Exact => 0.5 * (1.0 + (1.0 + 4.0 * t * t).sqrt()),
                Variant::Published => 1.0 + 0.5 * (1.0 + 4.0 * t * t).sqrt(),
            };
            let beta = (t - 1.0) / t_next;
            t = t_next;
            let (z, v) = (&mut w.z, &w.v);
            haar_3d(v, count, size, self.thresholds, |i, smooth| {
                let next = match self.variant {
                    Variant::Exact => smooth.max(0.0),
                    Variant::Published => 0.5 * (v[i].max(0.0) + smooth),
                };
                z[i] = next + beta * (next - x[i]);
                x[i] = next;
            });
            energy = self.residual(y, weight, w);
            // From zero a stable iteration never makes the residual worse than no image at all; momentum overshoots a little.
            if energy.is_nan() || energy > DIVERGED * start {
                return Err(Diverged { iteration: iteration + 1, step: self.step });
            }
        }
        // The published prox lets half of a negative value pass; intensities are not negative.
        x.iter_mut().for_each(|x| *x = x.max(0.0));
        Ok(energy)
    }

    /// weight ⊙ (A z − y) into `w.residual`; its sum of squares.
    fn residual(&self, y: &[f32], weight: &[f32], w: &mut Workspace) -> f64 {
        self.operator.forward(&w.z, &mut w.residual, &mut w.scratch);
        super::subtract(&mut w.residual, y, weight)
    }
}
