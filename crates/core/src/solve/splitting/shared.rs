//! Colours that share one polarization: L of channel c is w_c·L, as where light is reflected at a surface before any pigment has
//! seen it. Then there is one L to solve for, in readings of less noise, whatever the colours of S0.
//!
//! Whether it is so follows from the readings alone, before anything is solved. With u_c = (y_c − k * (m0 ⊙ S0_c)) / σ_c, the
//! guide's share taken out, the Gram matrix of the channels' u has one eigenvalue of signal and noise and others of noise alone:
//! their sum is what no common L explains, (C − 1)·pixels if there is nothing but noise. The eigenvector holds the w_c / σ_c.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use super::constants::SHARED;
use super::{Diverged, Kept, Plan, Pull, Workspace, at, beyond, reading_noise, rms, shorten};
use crate::solve::Input;
use crate::solve::video::Course;

/// Colour channels.
const COLOURS: usize = 3;

/// A frame whose colours share one polarization.
#[derive(Clone, Copy, Debug)]
pub(in crate::solve) struct Common {
    /// Sum of squares of the residual, all channels together.
    pub(in crate::solve) energy: f64,
    /// Of each channel's guide.
    pub(in crate::solve) gain: [f32; COLOURS],
    /// The largest of the channels'.
    pub(in crate::solve) sigma: f32,
}

/// How the channels' readings add up to one.
#[derive(Clone, Copy, Debug)]
struct Sum {
    /// Of L in each channel; their mean square is 1.
    share: [f32; COLOURS],
    /// What a channel's readings are multiplied by.
    factor: [f32; COLOURS],
    /// Noise of the sum.
    sigma: f32,
    /// What no common L explains, in units of the noise, and what noise alone would leave.
    rest: f64,
    expected: f64,
}

impl Plan {
    /// Whether plans of a camera's channels may share one polarization: they see it alike.
    pub(in crate::solve) fn may_share(plans: &[Self]) -> bool {
        let alike = |plan: &Self| plan.coarse_for(&plans[0].operator).is_some();
        plans.len() == COLOURS && plans.iter().all(alike)
    }

    /// All channels of a frame at once, into `out`, `[C, 3, H, W]`, or nothing if they do not share one polarization; `out`, and
    /// in a video the state of what is kept, are then garbage.
    pub(in crate::solve) fn run_shared(
        &self,
        input: &Input<'_>,
        mut video: Option<(&mut [Kept], Course)>,
        out: &mut [f32],
        w: &mut Workspace,
    ) -> Result<Option<Common>, Diverged> {
        let size = self.operator.convolver.size();
        let n = size.pixels();
        w.main.give_back(&mut w.scratch);
        w.shortest = std::time::Duration::MAX;
        let course = video.as_ref().map_or(Course::Cold, |(_, course)| *course);
        if let Some((kept, _)) = video.as_mut().filter(|_| course != Course::Cold) {
            kept[0].state.iter_mut().for_each(|state| w.main.exchange(state));
            if course == Course::Moving {
                self.explain(&mut out[5 * n..6 * n], w);
            }
        }
        // S0 into each channel's first plane, and what it leaves of the readings into the second. The third ones hold the weights
        // of the sum, and what the last frame's L explains of it.
        let (mut gain, mut sigmas) = ([1.0; COLOURS], [0.0; COLOURS]);
        for c in 0..COLOURS {
            let weight = input.weight.plane(c);
            let (y, guide, last) = match &video {
                Some((kept, _)) => (&kept[c].raw[..], &kept[c].guide[..], Some((kept[c].gain, kept[c].share))),
                None => (input.raw.plane(c), input.guide.map_or(&[][..], |guide| guide.plane(c)), None),
            };
            sigmas[c] = reading_noise(y, weight, size, self.operator.response.row_period(), &mut w.samples);
            w.target.copy_from_slice(y);
            self.denoise(guide, w);
            self.operator.forward_s0(&w.guide, &mut w.edges, &mut w.scratch);
            gain[c] = match (course, last) {
                (Course::Still, Some((gain, _))) => gain,
                (Course::Moving, Some((_, share))) => {
                    beyond(&out[5 * n..6 * n], share, w, |w| self.start_directly(sigmas[c], w).gain)
                }
                _ => {
                    let direct = self.start_directly(sigmas[c], w);
                    if !direct.polarized {
                        return Ok(None);
                    }
                    direct.gain
                }
            };
            self.take_guide(gain[c], w);
            out[3 * n * c..][..n].copy_from_slice(&w.guide);
            out[3 * n * c + n..][..n].copy_from_slice(&w.target);
        }
        let Some(sum) = add_up(out, input, sigmas, n) else { return Ok(None) };
        // The mean of a still scene's frames has little noise and all of what else is wrong.
        if course != Course::Still && sum.rest > (1.0 + SHARED) * sum.expected {
            return Ok(None);
        }
        self.combine(out, input, &sum, w);
        let start = match (course, video.as_ref()) {
            (Course::Still, Some((kept, _))) => self.go_on(&kept[0], course, sum.sigma, w),
            (Course::Moving, Some((kept, _))) => {
                beyond(&out[5 * n..6 * n], 1.0, w, |w| self.slow_modes(sum.sigma, w));
                self.go_on(&kept[0], course, sum.sigma, w)
            }
            _ => {
                self.slow_modes(sum.sigma, w);
                self.begin(rms(&w.guide), sum.sigma, |i, image, guide| image[i] = shorten(image[i], guide[i]), w)
            }
        };
        let weight = &out[2 * n..3 * n];
        let (energy, t) = self.iterate(weight, start, course.iterations(self.iterations), Pull::Filtered, w)?;
        self.distribute(out, &sum, w);
        if let Some((kept, _)) = video {
            for (c, kept) in kept.iter_mut().enumerate() {
                (kept.gain, kept.share) = (gain[c], sum.share[c]);
            }
            (kept[0].misfit, kept[0].t) = (start.misfit, t);
            kept[0].state.iter_mut().for_each(|state| w.main.exchange(state));
        }
        // ‖t_c − w_c·b‖² over all channels, in units of their noise, is the rest and the sum's own residual.
        let unit = f64::from(sigmas.iter().map(|s| s * s).sum::<f32>()) / COLOURS as f64;
        let energy = unit * (sum.rest + energy / f64::from(sum.sigma).powi(2));
        Ok(Some(Common { energy, gain, sigma: sigmas.into_iter().fold(0.0, f32::max) }))
    }

    /// The sum of the channels into `w.target`, the guide in its units into `w.guide`, and its weights into `out`.
    fn combine(&self, out: &mut [f32], input: &Input<'_>, sum: &Sum, w: &mut Workspace) {
        let n = w.target.len();
        let squares: f32 = sum.share.iter().map(|s| s * s).sum();
        for i in 0..n {
            let [mut reading, mut trusted, mut s0] = [0.0f32; 3];
            for c in 0..COLOURS {
                let weight = input.weight.plane(c)[i];
                reading += weight * sum.factor[c] * out[3 * n * c + n + i];
                trusted += weight * sum.factor[c] * sum.share[c];
                s0 += sum.share[c] * out[3 * n * c + i];
            }
            w.target[i] = if trusted > 0.0 { reading / trusted } else { 0.0 };
            w.guide[i] = s0 / squares;
            out[2 * n + i] = if trusted > 0.0 { 1.0 } else { 0.0 };
        }
    }

    /// L into the second and third planes of every channel, whose first holds S0.
    fn distribute(&self, out: &mut [f32], sum: &Sum, w: &mut Workspace) {
        let c = &self.operator.convolver;
        let (n, width) = (c.size().pixels(), c.size().width);
        w.main.rows(c, &mut w.bands[0], |y, row| {
            for x in 0..width {
                let (i, l) = (y * width + x, at(row, x));
                for (channel, share) in out.chunks_exact_mut(3 * n).zip(sum.share) {
                    let l = shorten(l * share, channel[i]);
                    (channel[n + i], channel[2 * n + i]) = (l.re, l.im);
                }
            }
        });
    }
}

/// Shares and noise from the channels' second planes; none where a share is not positive.
fn add_up(out: &[f32], input: &Input<'_>, sigmas: [f32; COLOURS], n: usize) -> Option<Sum> {
    let (mut gram, mut pixels) = (Matrix3::<f64>::zeros(), 0.0);
    let sigma = sigmas.map(|s| s.max(f32::MIN_POSITIVE));
    for i in 0..n {
        if (0..COLOURS).all(|c| input.weight.plane(c)[i] > 0.0) {
            let u = Vector3::from_fn(|c, _| f64::from(out[3 * n * c + n + i] / sigma[c]));
            gram += u * u.transpose();
            pixels += 1.0;
        }
    }
    let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::try_new(gram, 1e-12, 100)?;
    let v = eigenvectors.column(eigenvalues.imax()).into_owned();
    let v = if v.sum() < 0.0 { -v } else { v };
    let physical = Vector3::from_fn(|c, _| v[c] * f64::from(sigma[c]));
    let unit = physical.norm() / (COLOURS as f64).sqrt();
    if v.iter().any(|v| *v <= 0.0) || unit <= 0.0 {
        return None;
    }
    Some(Sum {
        share: std::array::from_fn(|c| (physical[c] / unit) as f32),
        factor: std::array::from_fn(|c| (v[c] * unit / f64::from(sigma[c])) as f32),
        sigma: unit as f32,
        rest: gram.trace() - eigenvalues.max(),
        expected: (COLOURS - 1) as f64 * pixels,
    })
}
