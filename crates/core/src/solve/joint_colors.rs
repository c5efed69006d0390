//! Colours that share one polarization: L of channel c is w_c·L, as where light is reflected at a surface before any pigment has
//! seen it. Then there is one L to solve for, in readings of less noise, whatever the colours of S0.
//!
//! The readings alone tell whether it is so, before anything is solved. With u_c = (b_c − k * (m0 ⊙ S0_c)) / σ_c, the guide's share taken
//! out, the Gram matrix of the channels' u has one eigenvalue of signal and noise and others of noise alone. The sum of those is what no
//! common L explains: (C − 1)·pixels if there is nothing but noise. The eigenvector holds the w_c / σ_c.
//!
//! The result's planes serve as buffers. Of channel c, the first holds S0 and the second what S0 leaves of the readings; the third of
//! channel 0 holds the weights of the sum of the channels, that of channel 1 the part of it that the last frame's L explains.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use super::admm::{Plan, Prox, Workspace};
use super::guided::{Schedule, without};
use super::problem::limit_dolp;
use super::video::Continuation;
use super::warm_start::WarmStart;
use super::{Diverged, Input};
use crate::image::noise::reading_noise;
use crate::optics::lanes::at;

/// Colour channels.
const COLORS: usize = 3;
/// Excess of what no common L explains, over what noise leaves, up to which the colours count as sharing one polarization.
const TOLERATED: f64 = 0.15;

/// Outcome of a frame whose colours share one polarization.
#[derive(Clone, Copy, Debug)]
pub(super) struct JointColors {
    /// Sum of squares of the residual, all channels together.
    pub(super) energy: f64,
    /// Gain of each channel's guide.
    pub(super) gain: [f32; COLORS],
    /// Noise of the readings, the largest of the channels'.
    pub(super) sigma: f32,
}

/// Sum of the channels' readings that holds L with the least noise.
#[derive(Clone, Copy, Debug)]
struct Sum {
    /// w: share of L in each channel; their mean square is 1.
    share: [f32; COLORS],
    /// Factor of each channel's readings.
    factor: [f32; COLORS],
    /// Noise of the sum.
    sigma: f32,
    /// Energy that no common L explains, in units of the noise, and the energy that noise alone would leave.
    rest: f64,
    expected: f64,
}

impl Plan {
    /// Whether a camera's channels, by their plans, may share one polarization: PSF and response are the same.
    pub(super) fn may_join(plans: &[Self]) -> bool {
        let alike = |plan: &Self| plan.coarse_for(&plans[0].operator).is_some();
        plans.len() == COLORS && plans.iter().all(alike)
    }

    /// All channels of a frame at once, into `out`, `[C, 3, H, W]`, or nothing if they do not share one polarization. The content of `out`,
    /// and in a video the states, are then of no use.
    pub(super) fn solve_joint_colors(
        &self,
        input: &Input<'_>,
        iterations: usize,
        mut video: Option<&mut Continuation>,
        out: &mut [f32],
        w: &mut Workspace,
    ) -> Result<Option<JointColors>, Diverged> {
        let n = self.operator.convolver.size().pixels();
        w.begin();
        let start = video.as_ref().map_or(WarmStart::Cold, |video| video.start);
        if let Some(video) = video.as_mut().filter(|_| start != WarmStart::Cold) {
            video.states[0].exchange(&mut w.main);
            if start == WarmStart::Moving {
                self.explain(&mut out[5 * n..6 * n], w);
            }
        }
        let (mut gain, mut sigma) = ([1.0; COLORS], [0.0; COLORS]);
        for c in 0..COLORS {
            let Some(found) = self.take_channel(c, input, video.as_deref(), out, w) else { return Ok(None) };
            (gain[c], sigma[c]) = found;
        }
        let Some(sum) = add_up(out, input, sigma, n) else { return Ok(None) };
        // The mean of a still scene's frames has little noise and all of what else is wrong.
        if start != WarmStart::Still && sum.rest > (1.0 + TOLERATED) * sum.expected {
            return Ok(None);
        }
        self.combine(out, input, &sum, w);
        let schedule = self.start_jointly(video.as_deref(), &out[5 * n..6 * n], sum.sigma, w);
        let iterations = start.iterations(iterations);
        let (energy, prior) = self.iterate_guided(&out[2 * n..3 * n], schedule, iterations, Prox::Filtered, w)?;
        self.distribute(out, &sum, w);
        if let Some(video) = video {
            for (c, state) in video.states.iter_mut().enumerate() {
                (state.gain, state.share) = (gain[c], sum.share[c]);
            }
            video.states[0].keep(schedule, prior, &mut w.main);
        }
        // ‖t_c − w_c·b‖² over all channels, in units of their noise, is the rest and the sum's own residual.
        let unit = f64::from(sigma.iter().map(|s| s * s).sum::<f32>()) / COLORS as f64;
        let energy = unit * (sum.rest + energy / f64::from(sum.sigma).powi(2));
        Ok(Some(JointColors { energy, gain, sigma: sigma.into_iter().fold(0.0, f32::max) }))
    }

    /// S0 and what it leaves of the readings of channel c, into its planes. Returns the guide's gain and the noise, or nothing if the
    /// channel shows no polarization.
    fn take_channel(
        &self,
        c: usize,
        input: &Input<'_>,
        video: Option<&Continuation>,
        out: &mut [f32],
        w: &mut Workspace,
    ) -> Option<(f32, f32)> {
        let (size, row_period) = (self.operator.convolver.size(), self.operator.response.row_period());
        let n = size.pixels();
        let (readings, guide) = match video {
            Some(video) => (&video.averages[c].raw[..], &video.averages[c].guide[..]),
            None => (input.raw.plane(c), input.guide.map_or(&[][..], |guide| guide.plane(c))),
        };
        let sigma = reading_noise(readings, input.weight.plane(c), size, row_period, &mut w.samples);
        w.target.copy_from_slice(readings);
        self.denoise(guide, w);
        self.operator.forward_s0(&w.guide, &mut w.edges, &mut w.scratch);
        let gain = match video.map(|video| (video.start, &video.states[c])) {
            Some((WarmStart::Still, state)) => state.gain,
            Some((WarmStart::Moving, state)) => {
                without(&out[5 * n..6 * n], state.share, w, |w| self.start_directly(sigma, w).gain)
            }
            _ => Some(self.start_directly(sigma, w)).filter(|direct| direct.polarized)?.gain,
        };
        self.take_guide(gain, w);
        out[3 * n * c..][..n].copy_from_slice(&w.guide);
        out[3 * n * c + n..][..n].copy_from_slice(&w.target);
        Some((gain, sigma))
    }

    /// Start of the common L, once the sum of the channels is in the workspace.
    fn start_jointly(
        &self,
        video: Option<&Continuation>,
        explained: &[f32],
        sigma: f32,
        w: &mut Workspace,
    ) -> Schedule {
        match video.map(|video| (video.start, &video.states[0])) {
            Some((start @ WarmStart::Still, state)) => self.go_on(state, start, sigma, w),
            Some((start @ WarmStart::Moving, state)) => {
                without(explained, 1.0, w, |w| self.start_polarized(sigma, w));
                self.go_on(state, start, sigma, w)
            }
            _ => {
                self.start_polarized(sigma, w);
                self.begin(sigma, limit_dolp, w)
            }
        }
    }

    /// The sum of the channels into `w.target`, the guide in its units into `w.guide`, and its weights into `out`.
    fn combine(&self, out: &mut [f32], input: &Input<'_>, sum: &Sum, w: &mut Workspace) {
        let n = w.target.len();
        let squares: f32 = sum.share.iter().map(|s| s * s).sum();
        for i in 0..n {
            let [mut reading, mut trusted, mut s0] = [0.0f32; 3];
            for c in 0..COLORS {
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
        w.main.rows(c, &mut w.rows[0], |y, row| {
            for x in 0..width {
                let (i, l) = (y * width + x, at(row, x));
                for (channel, share) in out.chunks_exact_mut(3 * n).zip(sum.share) {
                    let l = limit_dolp(l * share, channel[i]);
                    (channel[n + i], channel[2 * n + i]) = (l.re, l.im);
                }
            }
        });
    }
}

/// The sum of the channels by their second planes; none where a share is not positive.
fn add_up(out: &[f32], input: &Input<'_>, sigma: [f32; COLORS], n: usize) -> Option<Sum> {
    let (mut gram, mut pixels) = (Matrix3::<f64>::zeros(), 0.0);
    let sigma = sigma.map(|s| s.max(f32::MIN_POSITIVE));
    for i in 0..n {
        if (0..COLORS).all(|c| input.weight.plane(c)[i] > 0.0) {
            let u = Vector3::from_fn(|c, _| f64::from(out[3 * n * c + n + i] / sigma[c]));
            gram += u * u.transpose();
            pixels += 1.0;
        }
    }
    let SymmetricEigen { eigenvalues, eigenvectors } = SymmetricEigen::try_new(gram, 1e-12, 100)?;
    let v = eigenvectors.column(eigenvalues.imax()).into_owned();
    let v = if v.sum() < 0.0 { -v } else { v };
    let physical = Vector3::from_fn(|c, _| v[c] * f64::from(sigma[c]));
    let unit = physical.norm() / (COLORS as f64).sqrt();
    if v.iter().any(|v| *v <= 0.0) || unit <= 0.0 {
        return None;
    }
    Some(Sum {
        share: std::array::from_fn(|c| (physical[c] / unit) as f32),
        factor: std::array::from_fn(|c| (v[c] * unit / f64::from(sigma[c])) as f32),
        sigma: unit as f32,
        rest: gram.trace() - eigenvalues.max(),
        expected: (COLORS - 1) as f64 * pixels,
    })
}
