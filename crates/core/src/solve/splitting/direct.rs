//! The direct start: the guide's gain and the slow modes of L, in one least-squares solution.

use num_complex::Complex32;

use super::constants::{GAIN_RIDGE, REST, RIDGE, SURPRISE};
use super::{Plan, Start, Workspace, dot, rms, shorten};
use crate::optics::{CoarseWorkspace, Scratch};

/// What the direct start finds beside the slow modes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Direct {
    /// The guide's gain.
    pub(super) gain: f32,
    /// Whether the readings show more than an unpolarized scene and noise.
    pub(super) polarized: bool,
}

impl Plan {
    /// Slow modes of L into `w.image`, and the guide's gain, whose share of the readings is in `w.edges`.
    pub(super) fn start_directly(&self, sigma: f32, w: &mut Workspace) -> Direct {
        let scale = rms(&w.target) / rms(&w.edges).max(f32::MIN_POSITIVE) * rms(&w.guide);
        self.factor(sigma, scale, w);

        // Gain and slow modes together: leaving either out would let polarization pass for gain.
        let [qa, xa, qy, xy] = &mut w.rhs;
        self.project(&w.edges, qa, &mut w.image, &mut w.coarse, &mut w.scratch);
        xa.copy_from_slice(qa);
        self.coarse.solve(xa, &w.coarse);
        self.project(&w.target, qy, &mut w.image, &mut w.coarse, &mut w.scratch);
        xy.copy_from_slice(qy);
        self.coarse.solve(xy, &w.coarse);
        let aa = dot(&w.edges, &w.edges);
        let ay = dot(&w.edges, &w.target);
        let inner = |q: &[f64], x: &[f64]| q.iter().zip(x).map(|(q, x)| q * x).sum::<f64>();
        let (qaxa, qaxy) = (inner(qa, xa), inner(qa, xy));
        let gain = (ay - qaxy + GAIN_RIDGE * ay) / ((aa - qaxa).max(0.0) + GAIN_RIDGE * aa).max(f64::MIN_POSITIVE);
        let gain = if gain.is_finite() { gain.max(0.0) } else { 0.0 };

        // What the guide alone leaves, and how much of that slow polarization explains, against what noise does.
        let alone = ay / aa.max(f64::MIN_POSITIVE);
        let explained = inner(qy, xy) - 2.0 * alone * qaxy + alone * alone * qaxa;
        let left = dot(&w.target, &w.target) - alone * ay;
        let (variance, unknowns) = (f64::from(sigma).powi(2), xy.len() as f64);
        let noise_alone = explained <= variance * (unknowns + SURPRISE * (2.0 * unknowns).sqrt())
            && left <= REST * variance * w.target.len() as f64;
        if noise_alone && alone > 0.0 {
            return Direct { gain: alone as f32, polarized: false };
        }
        xy.iter_mut().zip(&*xa).for_each(|(y, a)| *y -= gain * a);
        let (re, im) = xy.split_at(self.coarse.modes());
        self.coarse.synthesize(re, im, &mut w.image, &mut w.coarse);
        Direct { gain: gain as f32, polarized: true }
    }

    /// Slow modes of L into `w.image`, where `w.target` holds nothing but L's share of the readings.
    pub(super) fn slow_modes(&self, sigma: f32, w: &mut Workspace) {
        self.factor(sigma, rms(&w.guide).max(f32::MIN_POSITIVE), w);
        let [.., x] = &mut w.rhs;
        self.project(&w.target, x, &mut w.image, &mut w.coarse, &mut w.scratch);
        self.coarse.solve(x, &w.coarse);
        let (re, im) = x.split_at(self.coarse.modes());
        self.coarse.synthesize(re, im, &mut w.image, &mut w.coarse);
    }

    /// Sets the equations of the slow modes up for a scene of brightness `scale`.
    fn factor(&self, sigma: f32, scale: f32, w: &mut Workspace) {
        let noise = self.seen_noise(sigma, scale);
        self.coarse.factor([RIDGE * f64::from(noise / scale).powf(1.5); 3], &mut w.coarse);
    }

    /// Their right-hand side for readings.
    fn project(
        &self,
        values: &[f32],
        rhs: &mut [f64],
        image: &mut [Complex32],
        coarse: &mut CoarseWorkspace,
        scratch: &mut Scratch,
    ) {
        self.operator.adjoint_polarized(values, image, scratch);
        let (re, im) = rhs.split_at_mut(self.coarse.modes());
        self.coarse.project(image, re, im, coarse);
    }

    /// Scales the guide and leaves to `w.target` what it does not explain.
    pub(super) fn take_guide(&self, gain: f32, w: &mut Workspace) {
        w.guide.iter_mut().for_each(|g| *g *= gain);
        w.target.iter_mut().zip(&w.edges).for_each(|(t, a)| *t -= gain * a);
    }

    pub(super) fn begin_from_slow_modes(&self, gain: f32, sigma: f32, w: &mut Workspace) -> Start {
        self.take_guide(gain, w);
        self.begin(rms(&w.guide), sigma, |i, image, guide| image[i] = shorten(image[i], guide[i]), w)
    }
}
