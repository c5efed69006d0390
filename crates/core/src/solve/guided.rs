//! `guided`: the unknown of one channel beside a guide.
//!
//! Behind a mask the unknown is L, with S0 = gain × guide; without one it is S0 itself. A cold frame starts from the slow modes
//! (`direct_start.rs`); a frame of a video goes on from the last one's state. Constants follow from noise, brightness and misfit.

use num_complex::Complex32;

use super::Diverged;
use super::admm::{Extrapolation, Iterate, Iteration, Penalties, Plan, Prox, State, Workspace, spread_intensity};
use super::direct_start::Direct;
use super::problem::{NOISE_POWER, RADIUS, limit_dolp};
use super::statistics::{edge_weights, guide_noise, rms};
use super::warm_start::WarmStart;
use crate::optics::lanes::{Lanes, at, spread};

/// ρ in units of the mean squared response.
const RHO: f32 = 0.12;
/// t = PRIOR·(noise / misfit)^NOISE_POWER within PRIOR_RANGE, in units of four mean squared responses (1 for ideal stripes). τ = t.
const PRIOR: f32 = 1e-3;
const PRIOR_RANGE: (f32, f32) = (2e-5, 0.2);
/// Threshold of total variation over misfit.
const THRESHOLD: f32 = 7.0;
/// t begins at this fraction of its final value and reaches it after RAMP iterations.
const FIRST_PRIOR: f32 = 0.25;
const RAMP: f32 = 6.0;
/// Iterations of the ramp that a moving frame skips. A still frame skips all.
const RAMP_SKIPPED: usize = 3;
/// Share of the multipliers of prior and total variation that a moving frame keeps.
const KEPT_MULTIPLIERS: f32 = 0.5;
/// Extrapolation of the answer: steps of the last iteration for each iteration before, and at most.
const OUTPUT_STEPS: f32 = 0.4;
const MOST_OUTPUT_STEPS: f32 = 4.0;
/// Extrapolation of the state in a cold start: its iteration, its steps, and the iterations that must follow. A warm start begins near the
/// answer, with too few iterations to settle.
const STATE_AT: usize = 3;
const STATE_STEPS: f32 = 3.0;
const STATE_SETTLES: usize = 6;
/// Contrast below which a guide of unit root mean square counts as flat in the filter.
const FLAT: f32 = 0.01;
/// Contrast of a guide of unit root mean square that halves total variation.
const EDGE: f32 = 0.012;

/// Result of the polarized solution of a channel beside a guide.
#[derive(Clone, Copy, Debug)]
pub(super) enum Solved {
    /// The readings show no polarization above their noise.
    Unpolarized {
        /// Gain of the guide.
        gain: f32,
    },
    /// L is in the main unknown.
    Polarized {
        /// Gain of the guide.
        gain: f32,
        /// Weighted sum of squares of the residual.
        energy: f64,
    },
}

/// One channel's state between two frames of a video.
#[derive(Debug)]
pub(super) struct TemporalState {
    /// None where the camera has one channel: its state stays in the workspace.
    state: Option<State>,
    /// Gain of the guide.
    pub(super) gain: f32,
    /// This channel's share of the polarization, where the channels have one in common.
    pub(super) share: f32,
    misfit: f32,
    /// t of the last iteration.
    prior: f32,
}

impl TemporalState {
    /// Takes the state into the workspace's iterate, or puts it back.
    pub(super) fn exchange(&mut self, main: &mut Iterate) {
        self.state.iter_mut().for_each(|state| std::mem::swap(state, &mut main.state));
    }

    /// Keeps the state that iterations ended with.
    pub(super) fn keep(&mut self, schedule: Schedule, prior: f32, main: &mut Iterate) {
        (self.misfit, self.prior) = (schedule.misfit, prior);
        self.exchange(main);
    }
}

/// The last frame of a video, for the next one of the same channel.
pub(super) struct Previous<'a> {
    pub(super) start: WarmStart,
    pub(super) state: &'a mut TemporalState,
}

/// Constants of a frame's iterations.
#[derive(Clone, Copy, Debug)]
pub(super) struct Schedule {
    /// t in the end.
    prior: f32,
    /// Root mean square of the part of the start that is no local affine function of the guide.
    misfit: f32,
    /// Iterations of the ramp of t that are skipped.
    skipped: usize,
    /// t that the multipliers are scaled to.
    scaled_to: f32,
}

impl Plan {
    /// Memory of a channel between frames; `alone` if it is the camera's only one. Allocates.
    pub(super) fn make_temporal_state(&self, alone: bool) -> TemporalState {
        let state = (!alone).then(|| State::new(&self.operator.convolver));
        TemporalState { state, gain: 1.0, share: 1.0, misfit: 0.0, prior: 0.0 }
    }

    /// Bytes of a [`TemporalState`].
    pub(super) fn temporal_bytes(&self, alone: bool) -> usize {
        if alone { 0 } else { State::bytes(&self.operator.convolver) }
    }

    /// L with S0 from the guide in `w.guide`, or the finding that there is none. In a video L goes on from the last frame's; `spare`
    /// (`[H, W]`) is a buffer for that.
    pub(super) fn solve_polarized(
        &self,
        weight: &[f32],
        sigma: f32,
        iterations: usize,
        mut previous: Option<Previous<'_>>,
        spare: &mut [f32],
        w: &mut Workspace,
    ) -> Result<Solved, Diverged> {
        // The guide's share of the readings, in a buffer that is free until the tables are made.
        self.operator.forward_s0(&w.guide, &mut w.edges, &mut w.scratch);
        let start = previous.as_ref().map_or(WarmStart::Cold, |previous| previous.start);
        let (gain, schedule) = match &mut previous {
            Some(previous) if start != WarmStart::Cold => self.start_warm(previous, sigma, spare, w),
            _ => {
                let Direct { gain, polarized } = self.start_directly(sigma, w);
                self.take_guide(gain, w);
                if !polarized {
                    return Ok(Solved::Unpolarized { gain });
                }
                (gain, self.begin(sigma, limit_dolp, w))
            }
        };
        let (energy, prior) = self.iterate_guided(weight, schedule, start.iterations(iterations), Prox::Filtered, w)?;
        if let Some(Previous { state, .. }) = previous {
            state.gain = gain;
            state.keep(schedule, prior, &mut w.main);
        }
        Ok(Solved::Polarized { gain, energy })
    }

    /// S0 without a mask, locally an affine function of the guide. Returns the residual's sum of squares.
    pub(super) fn solve_guided_intensity(
        &self,
        weight: &[f32],
        sigma: f32,
        iterations: usize,
        w: &mut Workspace,
    ) -> Result<f64, Diverged> {
        self.start_intensity(sigma, w);
        let schedule = self.begin(sigma, |s0, _| Complex32::from(s0.re.max(0.0)), w);
        self.iterate_guided(weight, schedule, iterations, Prox::FilteredPositive, w).map(|(energy, _)| energy)
    }

    /// The guide filtered by itself over 3×3, as strongly as its own noise asks for, into `w.guide`.
    pub(super) fn denoise(&self, guide: &[f32], w: &mut Workspace) {
        let (size, workers) = (self.operator.convolver.size(), self.operator.convolver.workers());
        let noise = guide_noise(guide, size, &mut w.samples);
        w.filter.set_guide(guide, 1, noise * noise, workers, &mut w.streams);
        let row = |y: usize| y * size.width..(y + 1) * size.width;
        let load = |y: usize, line: &mut [Lanes]| spread_intensity(&guide[row(y)], line);
        let store = |_, line: &[Lanes], out: &mut [f32]| {
            out.iter_mut().enumerate().for_each(|(x, g)| *g = at(line, x).re.max(0.0));
        };
        w.filter.run(guide, workers, &mut w.streams, load, &mut w.guide, store);
    }

    /// The guide's gain, and a start from the last frame's state.
    fn start_warm(
        &self,
        previous: &mut Previous<'_>,
        sigma: f32,
        explained: &mut [f32],
        w: &mut Workspace,
    ) -> (f32, Schedule) {
        let Previous { start, state } = previous;
        state.exchange(&mut w.main);
        let gain = if *start == WarmStart::Moving {
            self.explain(explained, w);
            // The direct start looks for the slow modes of the rest alone.
            without(explained, 1.0, w, |w| self.start_directly(sigma, w).gain)
        } else {
            state.gain
        };
        self.take_guide(gain, w);
        (gain, self.go_on(state, *start, sigma, w))
    }

    /// A start from the last frame's state in `w.main`, with `w.image` added where the scene moves.
    pub(super) fn go_on(&self, last: &TemporalState, start: WarmStart, sigma: f32, w: &mut Workspace) -> Schedule {
        match start {
            WarmStart::Still => w.image.fill(Complex32::ZERO),
            _ => w.main.state.fade(KEPT_MULTIPLIERS),
        }
        let brightness = rms(&w.guide).max(f32::MIN_POSITIVE);
        self.set_tables(brightness, w);
        self.resume(w);
        let next = self.schedule(last.misfit, sigma, brightness);
        match start {
            // A smaller t than the multipliers have settled with would let noise in faster than two iterations can take it
            // out again, although averaged readings ask for it.
            WarmStart::Still => Schedule { prior: last.prior, skipped: RAMP as usize, scaled_to: last.prior, ..next },
            _ => Schedule { skipped: RAMP_SKIPPED, scaled_to: last.prior, ..next },
        }
    }

    /// The part of the readings that the last frame's L, in `w.main`, explains.
    pub(super) fn explain(&self, explained: &mut [f32], w: &mut Workspace) {
        let (c, e) = (&self.operator.convolver, self.operator.response.polarized());
        let width = c.size().width;
        w.image.fill(Complex32::ZERO);
        self.resume(w);
        w.main.blurred_rows(c, &mut w.rows[0], |y, row| {
            let at_row = y * width..(y + 1) * width;
            explained[at_row.clone()].iter_mut().zip(&e[at_row]).enumerate().for_each(|(x, (v, e))| {
                let blurred = at(row, x);
                *v = e.re * blurred.re + e.im * blurred.im;
            });
        });
        w.main.give_back(&mut w.scratch);
    }

    /// Makes the guide's tables, takes `w.image` as the start once `restrict(image, guide)` has made it feasible, and finds the constants.
    pub(super) fn begin(
        &self,
        sigma: f32,
        restrict: impl Fn(Complex32, f32) -> Complex32,
        w: &mut Workspace,
    ) -> Schedule {
        let c = &self.operator.convolver;
        let brightness = rms(&w.guide).max(f32::MIN_POSITIVE);
        self.set_tables(brightness, w);
        let Workspace { filter, guide, image, energies, streams, .. } = w;
        let row = |y: usize| y * c.size().width..(y + 1) * c.size().width;
        let load = |y: usize, line: &mut [Lanes]| spread(&image[row(y)], line);
        let store = |y: usize, line: &[Lanes], energy: &mut [f32]| {
            let square = |(x, v): (usize, &Complex32)| (v - at(line, x)).norm_sqr();
            energy[0] = image[row(y)].iter().enumerate().map(square).sum();
        };
        filter.run(guide, c.workers(), streams, load, energies, store);
        let energy: f64 = energies.iter().map(|v| f64::from(*v)).sum();
        let misfit = ((energy / image.len() as f64).sqrt() as f32).max(1e-4 * brightness);
        image.iter_mut().zip(&*guide).for_each(|(v, g)| *v = restrict(*v, *g));
        self.start(w);
        self.schedule(misfit, sigma, brightness)
    }

    /// Tables of filter and edges for a guide of root mean square `brightness`.
    fn set_tables(&self, brightness: f32, w: &mut Workspace) {
        let c = &self.operator.convolver;
        w.filter.set_guide(&w.guide, RADIUS, (FLAT * brightness).powi(2), c.workers(), &mut w.streams);
        edge_weights(&w.guide, c.size(), brightness, EDGE, &mut w.edges);
    }

    /// Constants of a cold start.
    fn schedule(&self, misfit: f32, sigma: f32, brightness: f32) -> Schedule {
        let noise = self.seen_noise(sigma, brightness);
        let prior = (PRIOR * (noise / misfit).powf(NOISE_POWER)).clamp(PRIOR_RANGE.0, PRIOR_RANGE.1) * 4.0 * self.power;
        Schedule { prior, misfit, skipped: 0, scaled_to: FIRST_PRIOR * prior }
    }

    /// The iterations on one unknown. Returns the residual's sum of squares and the last t.
    pub(super) fn iterate_guided(
        &self,
        weight: &[f32],
        schedule: Schedule,
        iterations: usize,
        prox: Prox,
        w: &mut Workspace,
    ) -> Result<(f64, f32), Diverged> {
        let Schedule { prior, misfit, skipped, mut scaled_to } = schedule;
        let ramp = |i: usize| prior * FIRST_PRIOR.powf((1.0 - i as f32 / RAMP).max(0.0));
        let mut energy = f64::INFINITY;
        for number in 0..iterations {
            let t = ramp(skipped + number);
            let penalties = Penalties { blur: RHO * self.power, prior: t, gradient: t, rescale: scaled_to / t };
            scaled_to = t;
            let extrapolation = match (iterations - number - 1, skipped) {
                (0, _) => Extrapolation::Output((OUTPUT_STEPS * number as f32).min(MOST_OUTPUT_STEPS)),
                (STATE_SETTLES.., 0) if number == STATE_AT => Extrapolation::State(STATE_STEPS),
                _ => Extrapolation::NONE,
            };
            let iteration = Iteration { penalties, prox, threshold: THRESHOLD * misfit, extrapolation };
            energy = self.iterate(number, weight, iteration, w)?;
        }
        Ok((energy, scaled_to))
    }
}

/// Does `work` with the readings less `share` of the part of them that is explained.
pub(super) fn without<T>(
    explained: &[f32],
    share: f32,
    w: &mut Workspace,
    work: impl FnOnce(&mut Workspace) -> T,
) -> T {
    w.target.iter_mut().zip(explained).for_each(|(t, e)| *t -= share * e);
    let done = work(w);
    w.target.iter_mut().zip(explained).for_each(|(t, e)| *t += share * e);
    done
}
