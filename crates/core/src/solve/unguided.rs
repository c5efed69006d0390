//! `stokes`: the unknowns of one channel without a guide.
//!
//! Behind a mask S0 and L are unknown, and the present S0 guides L; without one S0 alone. Constants follow from the noise relative to the
//! scene's brightness.

use super::Diverged;
use super::admm::{Extrapolation, Iteration, Penalties, Plan, Prox, Workspace};
use super::direct_start::Scene;
use super::problem::{NOISE_POWER, RADIUS};
use super::statistics::{edge_weights, rms};
use crate::optics::lanes::at;

/// ρ in units of the mean squared response.
const RHO: f32 = 0.12;
/// τ and t at the relative noise NOISE; both grow with noise^NOISE_POWER.
const GRADIENT: f32 = 1e-3;
const PRIOR: f32 = 2e-4;
const NOISE: f32 = 0.006;
/// τ of S0 without a mask, over that of S0 and L. The threshold stays, so that total variation weighs as much more.
const GRADIENT_OF_S0: f32 = 3.0;
/// λ of total variation over the scene's brightness at NOISE.
const LAMBDA: f32 = 6e-5;
/// Contrast below which a present S0 of unit root mean square counts as flat in the filter.
const FLAT: f32 = 0.05;
/// Contrast of a present S0 of unit root mean square that halves the total variation of L.
const EDGE: f32 = 0.09;
/// Iterations between two looks at the present S0.
const REFRESH: usize = 5;

impl Plan {
    /// S0 without a mask. Returns the residual's sum of squares.
    pub(super) fn solve_intensity(
        &self,
        weight: &[f32],
        sigma: f32,
        iterations: usize,
        w: &mut Workspace,
    ) -> Result<f64, Diverged> {
        let scene = self.start_intensity(sigma, w);
        w.image.iter_mut().for_each(|v| *v = v.re.max(0.0).into());
        self.start(w);
        let iteration = self.unguided(scene, Prox::Positive);
        let gradient = GRADIENT_OF_S0 * iteration.penalties.gradient;
        let iteration = Iteration { penalties: Penalties { gradient, ..iteration.penalties }, ..iteration };
        let mut energy = f64::INFINITY;
        for number in 0..iterations {
            energy = self.iterate(number, weight, iteration, w)?;
        }
        Ok(energy)
    }

    /// S0 and L. Returns the residual's sum of squares.
    pub(super) fn solve_both(
        &self,
        weight: &[f32],
        sigma: f32,
        iterations: usize,
        w: &mut Workspace,
    ) -> Result<f64, Diverged> {
        let iteration = self.unguided(self.start_both(sigma, w), Prox::Cone);
        let mut energy = f64::INFINITY;
        for number in 0..iterations {
            if number % REFRESH == 0 {
                self.guide_by_intensity(w);
            }
            energy = self.iterate(number, weight, iteration, w)?;
        }
        Ok(energy)
    }

    /// Takes the present S0 as the guide of L.
    fn guide_by_intensity(&self, w: &mut Workspace) {
        let c = &self.operator.convolver;
        let width = c.size().width;
        let Workspace { intensity, guide, rows, .. } = w;
        intensity.iter().for_each(|intensity| {
            intensity.rows(c, &mut rows[0], |y, row| {
                let guide = &mut guide[y * width..(y + 1) * width];
                guide.iter_mut().enumerate().for_each(|(x, g)| *g = at(row, x).re.max(0.0));
            });
        });
        let brightness = rms(&w.guide);
        w.filter.set_guide(&w.guide, RADIUS, (FLAT * brightness).powi(2), c.workers(), &mut w.streams);
        edge_weights(&w.guide, c.size(), brightness, EDGE, &mut w.edges);
    }

    /// Constants of all iterations.
    fn unguided(&self, Scene { noise, brightness }: Scene, prox: Prox) -> Iteration {
        let relative = (noise / brightness.max(f32::MIN_POSITIVE) / NOISE).powf(NOISE_POWER).clamp(1e-3, 1e3);
        let gradient = GRADIENT * relative;
        let penalties = Penalties { blur: RHO * self.power, prior: PRIOR * relative, gradient, rescale: 1.0 };
        let threshold = LAMBDA * brightness * relative / gradient;
        Iteration { penalties, prox, threshold, extrapolation: Extrapolation::NONE }
    }
}
