//! The direct start: the slow modes of the unknowns, and the guide's gain, in one least-squares solution.
//!
//! Slow modes are a few cosines a side ([`crate::optics::Coarse`]). A ridge that follows the noise keeps the solution from fitting it.

use num_complex::Complex32;

use super::admm::{Plan, Workspace};
use super::problem::limit_dolp;
use super::statistics::{dot, rms};
use crate::optics::{CoarseWorkspace, Scratch};

/// Ridge: RIDGE·(noise / brightness)^1.5.
const RIDGE: f64 = 0.018;
/// Ridge of S0, relative to that of L. Intensity has more structure.
const RIDGE_OF_S0: f64 = 0.1;
/// Weight of the plain fit of the gain, for scenes in which polarization and gain cannot be told apart.
const GAIN_RIDGE: f64 = 2e-5;
/// Without polarization the slow modes explain as much noise as there are modes, within this many standard deviations.
const SURPRISE: f64 = 4.0;
/// Without polarization the guide leaves no more than this many times the noise.
const REST: f64 = 1.2;

/// Result of a direct start beside a guide.
#[derive(Clone, Copy, Debug)]
pub(super) struct Direct {
    /// Gain of the guide.
    pub(super) gain: f32,
    /// Whether the readings show more than an unpolarized scene and noise.
    pub(super) polarized: bool,
}

/// Noise and brightness of the scene by the readings, in units of the unknowns.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scene {
    /// Standard deviation of the noise.
    pub(super) noise: f32,
    /// Root mean square.
    pub(super) brightness: f32,
}

impl Plan {
    /// Noise of the readings as the unknowns see it, for a scene of this brightness; never zero.
    pub(super) fn seen_noise(&self, sigma: f32, brightness: f32) -> f32 {
        (sigma.max(1e-4 * brightness) / (2.0 * self.power.sqrt())).max(f32::MIN_POSITIVE)
    }

    /// Slow modes of L into `w.image`, and the guide's gain. `w.edges` holds the guide's share of the readings.
    pub(super) fn start_directly(&self, sigma: f32, w: &mut Workspace) -> Direct {
        let brightness = rms(&w.target) / rms(&w.edges).max(f32::MIN_POSITIVE) * rms(&w.guide);
        self.factor(sigma, brightness, w);

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

        // The energy that the guide alone leaves, and the part of it that slow polarization explains, against noise.
        let alone = ay / aa.max(f64::MIN_POSITIVE);
        let explained = inner(qy, xy) - 2.0 * alone * qaxy + alone * alone * qaxa;
        let left = dot(&w.target, &w.target) - alone * ay;
        let (variance, unknowns) = (f64::from(sigma).powi(2), xy.len() as f64);
        let noise_alone = explained <= variance * (unknowns + SURPRISE * (2.0 * unknowns).sqrt())
            && left <= REST * variance * self.frame_pixels();
        if noise_alone && alone > 0.0 {
            return Direct { gain: alone as f32, polarized: false };
        }
        xy.iter_mut().zip(&*xa).for_each(|(y, a)| *y -= gain * a);
        let (re, im) = xy.split_at(self.coarse.modes());
        self.coarse.synthesize(re, im, &mut w.image, &mut w.coarse);
        Direct { gain: gain as f32, polarized: true }
    }

    /// Scales the guide, and takes its share out of `w.target`.
    pub(super) fn take_guide(&self, gain: f32, w: &mut Workspace) {
        w.guide.iter_mut().for_each(|g| *g *= gain);
        w.target.iter_mut().zip(&w.edges).for_each(|(t, a)| *t -= gain * a);
    }

    /// Slow modes of L into `w.image`, where `w.target` holds nothing but L's share of the readings.
    pub(super) fn start_polarized(&self, sigma: f32, w: &mut Workspace) {
        self.factor(sigma, rms(&w.guide).max(f32::MIN_POSITIVE), w);
        let [.., x] = &mut w.rhs;
        self.project(&w.target, x, &mut w.image, &mut w.coarse, &mut w.scratch);
        self.coarse.solve(x, &w.coarse);
        let (re, im) = x.split_at(self.coarse.modes());
        self.coarse.synthesize(re, im, &mut w.image, &mut w.coarse);
    }

    /// Slow modes of S0 into `w.image`, where S0 alone is unknown.
    pub(super) fn start_intensity(&self, sigma: f32, w: &mut Workspace) -> Scene {
        let power = f64::from(self.power) * self.frame_pixels();
        let brightness = (dot(&w.target, &w.target) / power).sqrt() as f32;
        let scene = Scene { noise: self.seen_noise(sigma, brightness), brightness };
        self.coarse.factor([RIDGE * RIDGE_OF_S0 * scene.relative_noise().powf(1.5); 3], 1.0, &mut w.coarse);
        let [x, ..] = &mut w.rhs;
        self.operator.adjoint_s0(&w.target, &mut w.edges, &mut w.scratch);
        w.image.iter_mut().zip(&w.edges).for_each(|(v, s)| *v = Complex32::from(*s));
        self.coarse.project(&w.image, x, &mut [], &mut w.coarse);
        self.coarse.solve(x, &w.coarse);
        self.coarse.synthesize(x, &[], &mut w.image, &mut w.coarse);
        scene
    }

    /// Slow modes of S0 and L, made feasible, as the start of both unknowns; S0 into `w.guide` as well.
    pub(super) fn start_both(&self, sigma: f32, w: &mut Workspace) -> Scene {
        let (operator, modes) = (&self.operator, self.coarse.modes());
        let brightness = rms(&w.target) / rms(operator.response.unpolarized());
        let scene = Scene { noise: self.seen_noise(sigma, brightness), brightness };
        let ridge = RIDGE * scene.relative_noise().powf(1.5);
        self.coarse.factor([ridge * RIDGE_OF_S0, ridge, ridge], 1.0, &mut w.coarse);
        let [x, ..] = &mut w.rhs;
        let (x0, xl) = x.split_at_mut(modes);
        operator.adjoint_s0(&w.target, &mut w.edges, &mut w.scratch);
        w.image.iter_mut().zip(&w.edges).for_each(|(v, s)| *v = Complex32::from(*s));
        self.coarse.project(&w.image, x0, &mut [], &mut w.coarse);
        operator.adjoint_polarized(&w.target, &mut w.image, &mut w.scratch);
        let (x1, x2) = xl.split_at_mut(modes);
        self.coarse.project(&w.image, x1, x2, &mut w.coarse);
        self.coarse.solve(x, &w.coarse);

        self.coarse.synthesize(&x[..modes], &[], &mut w.image, &mut w.coarse);
        w.image.iter_mut().zip(&mut w.guide).for_each(|(v, g)| {
            *g = v.re.max(0.0);
            *v = Complex32::from(*g);
        });
        if let Some(intensity) = &mut w.intensity {
            intensity.start(&w.image, &operator.convolver, &operator.kernel, &mut w.rows, &mut w.scratch);
        }
        let (x1, x2) = x[modes..].split_at(modes);
        self.coarse.synthesize(x1, x2, &mut w.image, &mut w.coarse);
        w.image.iter_mut().zip(&w.guide).for_each(|(v, g)| *v = limit_dolp(*v, *g));
        self.start(w);
        scene
    }

    /// Readings of one channel.
    fn frame_pixels(&self) -> f64 {
        self.operator.field().frame().pixels() as f64
    }

    /// Factors the normal equations of L for a scene of this brightness.
    fn factor(&self, sigma: f32, brightness: f32, w: &mut Workspace) {
        let noise = self.seen_noise(sigma, brightness);
        let level = self.operator.field().level(&w.guide);
        self.coarse.factor([RIDGE * f64::from(noise / brightness).powf(1.5); 3], level, &mut w.coarse);
    }

    /// Right-hand side of the normal equations of L for readings.
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
}

impl Scene {
    fn relative_noise(self) -> f64 {
        f64::from(self.noise / self.brightness.max(f32::MIN_POSITIVE))
    }
}
