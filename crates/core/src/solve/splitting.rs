//! The default solvers `guided` and `stokes`: splitting with a direct start.
//!
//! What is solved for follows from what is known:
//!
//! | mask | guide | unknown | prior |
//! |---|---|---|---|
//! | yes | yes | L = S1 + i·S2; S0 is the guide times a fitted gain | like the guide, \|L\| ≤ S0 |
//! | no | yes | S0 | like the guide, S0 ≥ 0 |
//! | yes | no | S0 and L | L like the present S0, \|L\| ≤ S0 |
//! | no | no | S0 | S0 ≥ 0 |
//!
//! "Like" is a guided filter as proximal step; total variation, weak across the edges of the guide, catches what is not in
//! it. The steps of an iteration are in `field.rs`: this file chooses constants from the data and puts them in order. All
//! constants are relative to the scene's brightness, the noise of the readings and the size of the responses, so that the
//! scale of readings, PSF and guide does not matter.

mod direct;
mod shared;

use std::sync::Arc;
use std::time::{Duration, Instant};

use num_complex::Complex32;

use super::field::{Ahead, Band, Field, Laplacian, Penalties, Pull, State, Surroundings, row_steps};
use super::guided_filter::{GuidedFilter, Stream};
use super::statistics::{edge_weights, guide_noise};
use super::video::Course;
use super::{Diverged, Modelled, Solved};
use crate::image::noise::{SAMPLES, reading_noise};
use crate::optics::lanes::{LANES, Lanes, at, spread};
use crate::optics::{Coarse, CoarseWorkspace, Scratch, StokesOperator};
use crate::parallel::Shared;
use direct::Direct;
pub(super) use shared::Common;

/// Constants, found on procedural and real scenes; halving or doubling one costs less than 0.3 dB.
mod constants {
    /// ρ of ν = k * x, in units of the mean squared response.
    pub(super) const RHO: f32 = 0.12;
    /// t of z = x: T·(noise / misfit)^T_POWER, in units of four mean squared responses (1 for ideal stripes).
    pub(super) const T: f32 = 1e-3;
    pub(super) const T_POWER: f32 = 1.3;
    pub(super) const T_RANGE: (f32, f32) = (2e-5, 0.2);
    /// TV threshold over misfit: how far the start is from being affine in the guide.
    pub(super) const THRESHOLD: f32 = 7.0;
    /// t begins at a fraction of its final value and reaches it after so many iterations.
    pub(super) const WARM: f32 = 0.25;
    pub(super) const WARM_ITERATIONS: f32 = 6.0;
    /// Iterations of that schedule that a frame leaves out which goes on from a changed one; from an unchanged one, all.
    pub(super) const AGAIN: usize = 3;
    /// What such a frame keeps of the multipliers of prior and TV.
    pub(super) const FADED: f32 = 0.5;
    /// Steps that the answer is ahead of the last iteration, for each iteration before, and at most.
    pub(super) const AHEAD: f32 = 0.4;
    pub(super) const FARTHEST: f32 = 4.0;
    /// The iteration of a cold start that leaps, by how many of its steps, and how many have to follow: what goes on from a frame before
    /// begins near its answer, with too few iterations to settle.
    pub(super) const LEAP_AT: usize = 3;
    pub(super) const LEAP: f32 = 3.0;
    pub(super) const SETTLED: usize = 6;
    /// Guided filter: radius, and the contrast below which a guide of unit root mean square counts as flat.
    pub(super) const RADIUS: usize = 4;
    pub(super) const FLAT: f32 = 0.01;
    /// Contrast of a guide of unit root mean square that halves the TV.
    pub(super) const EDGE: f32 = 0.012;
    /// Ridge of the direct start: RIDGE·(noise / scene)^1.5.
    pub(super) const RIDGE: f64 = 0.018;
    /// What pulls the gain to the plain fit where polarization and gain cannot be told apart.
    pub(super) const GAIN_RIDGE: f64 = 2e-5;
    /// Without polarization the slow modes explain as much noise as there are modes, within so many standard deviations,
    pub(super) const SURPRISE: f64 = 4.0;
    /// and the guide leaves no more than so many times the noise.
    pub(super) const REST: f64 = 1.2;
    /// What the colours may differ by beyond their noise and still share one polarization, in units of the noise's energy.
    pub(super) const SHARED: f64 = 0.15;

    // Without a guide.
    /// ρ, in the same units.
    pub(super) const FREE_RHO: f32 = 0.12;
    /// Ridge of S0, relative to that of L: intensity has more structure.
    pub(super) const FREE_RIDGE: f64 = 0.1;
    /// τ of the gradient and t of z at the noise FREE_NOISE (relative to the scene); both grow with noise^T_POWER.
    pub(super) const FREE_GRADIENT: f32 = 1e-3;
    pub(super) const FREE_PRIOR: f32 = 2e-4;
    pub(super) const FREE_NOISE: f32 = 0.006;
    /// τ of S0 without a mask, over that beside L: with the threshold kept, TV weighs as much more.
    pub(super) const ALONE_GRADIENT: f32 = 3.0;
    /// λ of TV over scene brightness at FREE_NOISE.
    pub(super) const FREE_LAMBDA: f32 = 6e-5;
    /// The present S0 guides L: filter contrast, edge contrast, and how often it is looked at anew.
    pub(super) const FREE_FLAT: f32 = 0.05;
    pub(super) const FREE_EDGE: f32 = 0.09;
    pub(super) const FREE_REFRESH: usize = 5;
}
use constants::*;

/// What is solved for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Unknown {
    /// L, S0 being the guide.
    Polarized,
    /// S0.
    Intensity,
    /// S0 and L.
    Both,
}

#[derive(Debug)]
pub(super) struct Plan {
    operator: StokesOperator,
    coarse: Arc<Coarse>,
    laplacian: Laplacian,
    unknown: Unknown,
    guided: bool,
    pub(super) iterations: usize,
    /// Mean squared response of the unknowns.
    power: f32,
}

#[derive(Debug)]
pub(super) struct Workspace {
    /// Readings, less the guide's share once its gain is known.
    target: Vec<f32>,
    /// The denoised guide in units of the readings, or the present S0.
    guide: Vec<f32>,
    /// TV weights.
    edges: Vec<f32>,
    /// L, or S0 where L is not solved for.
    main: Field,
    /// S0 beside L.
    intensity: Option<Field>,
    filter: GuidedFilter,
    streams: Vec<Stream>,
    bands: Vec<Band>,
    /// An image between adjoint, direct start and field.
    image: Vec<Complex32>,
    /// Right-hand sides of the direct start: of the readings, and of the guide's share of them.
    rhs: [Vec<f64>; 4],
    coarse: CoarseWorkspace,
    samples: Vec<f32>,
    energies: Vec<f32>,
    pub(super) scratch: Scratch,
    /// The shortest iteration of the latest run.
    pub(super) shortest: Duration,
}

impl Workspace {
    /// Buffers of the convolutions, whole.
    pub(super) fn scratch(&mut self) -> &mut Scratch {
        self.main.give_back(&mut self.scratch);
        &mut self.scratch
    }
}

/// What is kept of one channel of a video's last frame.
#[derive(Debug)]
pub(super) struct Kept {
    /// Readings and guide, averaged since they last changed; set before a run.
    pub(super) raw: Vec<f32>,
    pub(super) guide: Vec<f32>,
    /// Rows after which the mask repeats.
    pub(super) row_period: usize,
    /// None where the camera has one channel: its state stays where it is, in the workspace.
    state: Option<State>,
    gain: f32,
    misfit: f32,
    /// t of the last iteration.
    t: f32,
    /// This channel's share of the polarization, where the channels share one.
    share: f32,
}

impl Plan {
    /// Plans `guided` or, without a guide, `stokes`. `coarse` are the direct start's equations, where they were made before.
    /// Allocates; builds them otherwise.
    pub(super) fn new(operator: StokesOperator, guided: bool, iterations: usize, coarse: Option<Arc<Coarse>>) -> Self {
        let response = &operator.response;
        let unknown = match (response.is_polarized(), guided) {
            (true, true) => Unknown::Polarized,
            (true, false) => Unknown::Both,
            (false, _) => Unknown::Intensity,
        };
        let mut responses = Vec::new();
        if unknown != Unknown::Polarized {
            responses.push(response.unpolarized().to_vec());
        }
        if unknown != Unknown::Intensity {
            responses.extend(operator.polarized_responses());
        }
        let squares: f64 = responses.iter().flatten().map(|m| f64::from(*m).powi(2)).sum();
        let power = (squares / response.size().pixels() as f64) as f32;
        let coarse = coarse.unwrap_or_else(|| Arc::new(Coarse::new(&operator, &responses)));
        let laplacian = Laplacian::new(operator.convolver.padded());
        Self { operator, coarse, laplacian, unknown, guided, iterations, power: power.max(f32::MIN_POSITIVE) }
    }

    /// What a workspace consists of, in bytes.
    pub(super) fn workspace_parts(&self) -> Vec<(&'static str, usize)> {
        let c = &self.operator.convolver;
        let n = c.size().pixels();
        let second = if self.unknown == Unknown::Both { Field::bytes(c, false) } else { 0 };
        let start = 4 * self.coarse.unknowns() * size_of::<f64>() + n * size_of::<Complex32>();
        vec![
            ("unknown images and multipliers", Field::bytes(c, true) + second),
            ("transforms", c.scratch_bytes()),
            ("readings, guide and edges", (3 * n + SAMPLES + c.size().height) * size_of::<f32>()),
            ("guided filter", GuidedFilter::bytes(c.size())),
            ("rows of each thread", c.workers().threads() * Stream::bytes(c.size().width) + Band::bytes(c)),
            ("direct start", start + self.coarse.workspace_bytes()),
        ]
    }

    /// The direct start's equations, if another channel of this camera has the same.
    pub(super) fn coarse_for(&self, operator: &StokesOperator) -> Option<Arc<Coarse>> {
        let own = &self.operator;
        let same = Arc::ptr_eq(&own.kernel, &operator.kernel) && Arc::ptr_eq(&own.response, &operator.response);
        same.then(|| Arc::clone(&self.coarse))
    }

    /// Whether another channel's plan uses the same equations.
    pub(super) fn shares_with(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.coarse, &other.coarse)
    }

    /// Bytes the plan itself holds beside the camera's: the direct start's equations.
    pub(super) fn bytes(&self) -> usize {
        self.coarse.bytes()
    }

    pub(super) fn make_workspace(&self) -> Workspace {
        let c = &self.operator.convolver;
        let n = c.size().pixels();
        let reals = || vec![0.0; n];
        let unknowns = || vec![0.0; self.coarse.unknowns()];
        Workspace {
            target: reals(),
            guide: reals(),
            edges: reals(),
            main: Field::new(c, true),
            intensity: (self.unknown == Unknown::Both).then(|| Field::new(c, false)),
            filter: GuidedFilter::new(c.size()),
            streams: (0..c.workers().threads()).map(|_| Stream::new(c.size().width)).collect(),
            bands: Band::for_threads(c),
            image: vec![Complex32::ZERO; n],
            rhs: [unknowns(), unknowns(), unknowns(), unknowns()],
            coarse: self.coarse.make_workspace(),
            samples: Vec::with_capacity(SAMPLES),
            energies: vec![0.0; c.size().height],
            scratch: c.make_scratch(),
            shortest: Duration::MAX,
        }
    }

    /// `alone`: the camera has no other channel. Allocates.
    pub(super) fn make_kept(&self, alone: bool) -> Kept {
        let c = &self.operator.convolver;
        let n = c.size().pixels();
        let state = (!alone).then(|| State::new(c));
        let row_period = self.operator.response.row_period();
        let (raw, guide) = (vec![0.0; n], vec![0.0; n]);
        Kept { raw, guide, row_period, state, gain: 1.0, misfit: 0.0, t: 0.0, share: 1.0 }
    }

    /// Bytes of a [`Kept`].
    pub(super) fn kept_bytes(&self, alone: bool) -> usize {
        let c = &self.operator.convolver;
        c.size().pixels() * 2 * size_of::<f32>() + if alone { 0 } else { State::bytes(c) }
    }

    /// A frame of a video, [`Self::run`] otherwise: readings and guide are those that were kept. Behind a mask alone.
    pub(super) fn run_next(
        &self,
        weight: &[f32],
        (kept, course): (&mut Kept, Course),
        out: &mut [f32],
        w: &mut Workspace,
    ) -> Result<Solved, Diverged> {
        let size = self.operator.convolver.size();
        w.main.give_back(&mut w.scratch);
        w.shortest = Duration::MAX;
        let sigma = reading_noise(&kept.raw, weight, size, kept.row_period, &mut w.samples);
        w.target.copy_from_slice(&kept.raw);
        self.denoise(&kept.guide, w);
        let spare = &mut out[..size.pixels()];
        let polarized = self.run_polarized(weight, sigma, Some((kept, course, spare)), w)?;
        Ok(self.finish(polarized, sigma, weight, out, w))
    }

    /// Reconstructs one channel into `out`: `[3, H, W]`, or `[1, H, W]` without a mask. `guide` is in units near the readings'.
    pub(super) fn run(
        &self,
        y: &[f32],
        weight: &[f32],
        guide: Option<&[f32]>,
        out: &mut [f32],
        w: &mut Workspace,
    ) -> Result<Solved, Diverged> {
        let size = self.operator.convolver.size();
        w.main.give_back(&mut w.scratch);
        w.shortest = Duration::MAX;
        let sigma = reading_noise(y, weight, size, self.operator.response.row_period(), &mut w.samples);
        // Untrusted readings hold an estimate: good enough for the direct start, and without weight in the iterations.
        w.target.copy_from_slice(y);
        if let Some(guide) = guide {
            self.denoise(guide, w);
        }
        let (energy, modelled) = match self.unknown {
            Unknown::Polarized => {
                let polarized = self.run_polarized(weight, sigma, None, w)?;
                return Ok(self.finish(polarized, sigma, weight, out, w));
            }
            Unknown::Intensity => (self.run_intensity(weight, sigma, w)?, Modelled::Intensity),
            Unknown::Both => (self.run_both(weight, sigma, w)?, Modelled::Both),
        };
        self.store(out, w);
        Ok(Solved { energy, gain: 1.0, sigma, modelled })
    }

    /// Stores what was found of L, or that there is none.
    fn finish(
        &self,
        (gain, energy): (f32, Option<f64>),
        sigma: f32,
        weight: &[f32],
        out: &mut [f32],
        w: &mut Workspace,
    ) -> Solved {
        if let Some(energy) = energy {
            self.store(out, w);
            return Solved { energy, gain, sigma, modelled: Modelled::Polarized };
        }
        let (s0, polarized) = out.split_at_mut(w.guide.len());
        s0.copy_from_slice(&w.guide);
        polarized.fill(0.0);
        let left = w.target.iter().zip(weight).map(|(t, w)| f64::from(t * w).powi(2)).sum();
        Solved { energy: left, gain, sigma, modelled: Modelled::Nothing }
    }

    /// The guide filtered by itself over 3×3, as strongly as its own noise asks for, into `w.guide`.
    fn denoise(&self, guide: &[f32], w: &mut Workspace) {
        let (size, workers) = (self.operator.convolver.size(), self.operator.convolver.workers());
        let noise = guide_noise(guide, size, &mut w.samples);
        w.filter.set_guide(guide, 1, noise * noise, workers, &mut w.streams);
        let row = |y: usize| y * size.width..(y + 1) * size.width;
        let out = Shared::new(&mut w.guide);
        let load = |y: usize, line: &mut [Lanes]| spread_intensity(&guide[row(y)], line);
        let store = |y: usize, line: &[Lanes]| {
            // SAFETY: each row is stored once.
            #[allow(unsafe_code)]
            let out = unsafe { out.slice(row(y)) };
            out.iter_mut().enumerate().for_each(|(x, g)| *g = at(line, x).re.max(0.0));
        };
        w.filter.run(guide, workers, &mut w.streams, load, store);
    }

    /// L with S0 from the guide; returns the gain and the residual's energy, or none where the readings show no polarization above
    /// their noise. In a video L goes on from the last frame's; a plane of the result serves as a buffer.
    fn run_polarized(
        &self,
        weight: &[f32],
        sigma: f32,
        video: Option<(&mut Kept, Course, &mut [f32])>,
        w: &mut Workspace,
    ) -> Result<(f32, Option<f64>), Diverged> {
        let op = &self.operator;
        // The guide's share of the readings; `edges` is free until the constants are set.
        op.forward_s0(&w.guide, &mut w.edges, &mut w.scratch);
        let (kept, course, gain, start) = match video {
            Some((kept, course, explained)) if course != Course::Cold => {
                let (gain, start) = self.start_from_last(kept, course, sigma, explained, w);
                (Some(kept), course, gain, start)
            }
            first => {
                let Direct { gain, polarized } = self.start_directly(sigma, w);
                if !polarized {
                    self.take_guide(gain, w);
                    return Ok((gain, None));
                }
                let start = self.begin_from_slow_modes(gain, sigma, w);
                (first.map(|(kept, ..)| kept), Course::Cold, gain, start)
            }
        };
        let (energy, t) = self.iterate(weight, start, course.iterations(self.iterations), Pull::Filtered, w)?;
        if let Some(kept) = kept {
            (kept.gain, kept.misfit, kept.t) = (gain, start.misfit, t);
            kept.state.iter_mut().for_each(|state| w.main.exchange(state));
        }
        Ok((gain, Some(energy)))
    }

    /// The guide's gain, and a start from the last frame's state.
    fn start_from_last(
        &self,
        kept: &mut Kept,
        course: Course,
        sigma: f32,
        explained: &mut [f32],
        w: &mut Workspace,
    ) -> (f32, Start) {
        kept.state.iter_mut().for_each(|state| w.main.exchange(state));
        let gain = if course == Course::Moving { self.start_from_rest(sigma, explained, w) } else { kept.gain };
        self.take_guide(gain, w);
        (gain, self.go_on(kept, course, sigma, w))
    }

    /// A start from the last frame's state in `w.main`, with `w.image` added where the scene moves.
    fn go_on(&self, kept: &Kept, course: Course, sigma: f32, w: &mut Workspace) -> Start {
        match course {
            Course::Still => w.image.fill(Complex32::ZERO),
            _ => w.main.fade(FADED),
        }
        let brightness = rms(&w.guide).max(f32::MIN_POSITIVE);
        self.set_tables(brightness, w);
        self.resume(w);
        let next = self.constants(kept.misfit, sigma, brightness);
        match course {
            // A smaller t than the multipliers have settled with would let noise in faster than two iterations can take it
            // out again, although averaged readings ask for it.
            Course::Still => Start { t: kept.t, first: WARM_ITERATIONS as usize, before: kept.t, ..next },
            _ => Start { first: AGAIN, before: kept.t, ..next },
        }
    }

    /// Only the slow modes of what the last frame's L does not explain are looked for; the gain.
    fn start_from_rest(&self, sigma: f32, explained: &mut [f32], w: &mut Workspace) -> f32 {
        self.explain(explained, w);
        beyond(explained, 1.0, w, |w| self.start_directly(sigma, w).gain)
    }

    /// The share of the readings that the last frame's L, in `w.main`, explains.
    fn explain(&self, explained: &mut [f32], w: &mut Workspace) {
        let (c, e) = (&self.operator.convolver, self.operator.response.polarized());
        let width = c.size().width;
        w.image.fill(Complex32::ZERO);
        self.resume(w);
        w.main.blurred_rows(c, &mut w.bands[0], |y, row| {
            let at_row = y * width..(y + 1) * width;
            explained[at_row.clone()].iter_mut().zip(&e[at_row]).enumerate().for_each(|(x, (v, e))| {
                let blurred = at(row, x);
                *v = e.re * blurred.re + e.im * blurred.im;
            });
        });
        w.main.give_back(&mut w.scratch);
    }

    /// The last frame's L with `w.image` added to it.
    fn resume(&self, w: &mut Workspace) {
        w.main.borrow(&mut w.scratch);
        w.main.resume(&w.image, &self.operator.convolver, &self.operator.kernel, &mut w.bands, &mut w.scratch);
    }

    /// S0 alone, with or without a guide.
    fn run_intensity(&self, weight: &[f32], sigma: f32, w: &mut Workspace) -> Result<f64, Diverged> {
        let op = &self.operator;
        op.adjoint_s0(&w.target, &mut w.edges, &mut w.scratch);
        w.image.iter_mut().zip(&w.edges).for_each(|(v, s)| *v = Complex32::from(*s));
        let scale = rms(&w.target) / self.power.sqrt();
        let noise = self.seen_noise(sigma, scale);
        self.coarse
            .factor([RIDGE * FREE_RIDGE * f64::from(noise / scale.max(f32::MIN_POSITIVE)).powf(1.5); 3], &mut w.coarse);
        let [rhs, ..] = &mut w.rhs;
        self.coarse.project(&w.image, rhs, &mut [], &mut w.coarse);
        self.coarse.solve(rhs, &w.coarse);
        self.coarse.synthesize(rhs, &[], &mut w.image, &mut w.coarse);
        let positive = |z: Complex32| Complex32::from(z.re.max(0.0));
        if self.guided {
            // The filter needs a guide near the image's scale only for its flatness, which is relative; keep it as it is.
            let p = self.begin(rms(&w.guide), sigma, |i, image, _| image[i] = positive(image[i]), w);
            return self.iterate(weight, p, self.iterations, Pull::FilteredPositive, w).map(|(energy, _)| energy);
        }
        let c = &op.convolver;
        w.image.iter_mut().for_each(|v| *v = positive(*v));
        w.main.borrow(&mut w.scratch);
        w.main.start(&w.image, c, &op.kernel, &mut w.bands, &mut w.scratch);
        let (p, threshold) = self.free_penalties(noise, scale);
        let p = Penalties { gradient: ALONE_GRADIENT * p.gradient, ..p };
        let mut energy = f64::INFINITY;
        for iteration in 0..self.iterations {
            self.row_steps(weight, p, Pull::Positive, threshold, w);
            w.main.solve(p, Ahead::NONE, &self.laplacian, c, &op.kernel, &mut w.scratch);
            energy = self.energy(iteration, p, w)?;
        }
        Ok(energy)
    }

    /// S0 and L without a guide.
    fn run_both(&self, weight: &[f32], sigma: f32, w: &mut Workspace) -> Result<f64, Diverged> {
        let op = &self.operator;
        let (c, modes) = (&op.convolver, self.coarse.modes());
        let scale = rms(&w.target) / rms(op.response.unpolarized());
        let noise = self.seen_noise(sigma, scale);
        let ridge = RIDGE * f64::from(noise / scale.max(f32::MIN_POSITIVE)).powf(1.5);
        self.coarse.factor([ridge * FREE_RIDGE, ridge, ridge], &mut w.coarse);
        let [x, ..] = &mut w.rhs;
        let (x0, xl) = x.split_at_mut(modes);
        op.adjoint_s0(&w.target, &mut w.edges, &mut w.scratch);
        w.image.iter_mut().zip(&w.edges).for_each(|(v, s)| *v = Complex32::from(*s));
        self.coarse.project(&w.image, x0, &mut [], &mut w.coarse);
        op.adjoint_polarized(&w.target, &mut w.image, &mut w.scratch);
        let (x1, x2) = xl.split_at_mut(modes);
        self.coarse.project(&w.image, x1, x2, &mut w.coarse);
        self.coarse.solve(x, &w.coarse);
        let (x0, xl) = x.split_at(modes);
        let Some(intensity) = &mut w.intensity else { return Ok(f64::INFINITY) };
        self.coarse.synthesize(x0, &[], &mut w.image, &mut w.coarse);
        w.image.iter_mut().zip(&mut w.guide).for_each(|(v, g)| {
            *g = v.re.max(0.0);
            *v = Complex32::from(*g);
        });
        intensity.start(&w.image, c, &op.kernel, &mut w.bands, &mut w.scratch);
        let (x1, x2) = xl.split_at(modes);
        self.coarse.synthesize(x1, x2, &mut w.image, &mut w.coarse);
        w.image.iter_mut().zip(&w.guide).for_each(|(v, g)| *v = shorten(*v, *g));
        w.main.borrow(&mut w.scratch);
        w.main.start(&w.image, c, &op.kernel, &mut w.bands, &mut w.scratch);

        let (p, threshold) = self.free_penalties(noise, scale);
        let size = c.size();
        let mut energy = f64::INFINITY;
        for iteration in 0..self.iterations {
            let Some(intensity) = &mut w.intensity else { break };
            if iteration % FREE_REFRESH == 0 {
                let guide = &mut w.guide;
                intensity.rows(c, &mut w.bands[0], |y, row| {
                    let guide = &mut guide[y * size.width..(y + 1) * size.width];
                    guide.iter_mut().enumerate().for_each(|(x, g)| *g = at(row, x).re.max(0.0));
                });
                let brightness = rms(&w.guide);
                let flat = (FREE_FLAT * brightness).powi(2);
                w.filter.set_guide(&w.guide, RADIUS, flat, c.workers(), &mut w.streams);
                edge_weights(&w.guide, size, brightness, FREE_EDGE, &mut w.edges);
            }
            self.row_steps(weight, p, Pull::Cone, threshold, w);
            let Some(intensity) = &mut w.intensity else { break };
            intensity.solve(p, Ahead::NONE, &self.laplacian, c, &op.kernel, &mut w.scratch);
            w.main.solve(p, Ahead::NONE, &self.laplacian, c, &op.kernel, &mut w.scratch);
            energy = self.energy(iteration, p, w)?;
        }
        Ok(energy)
    }

    /// The data, prior and TV steps of one iteration.
    fn row_steps(&self, weight: &[f32], p: Penalties, pull: Pull, threshold: f32, w: &mut Workspace) {
        let (c, response) = (&self.operator.convolver, &self.operator.response);
        let width = c.size().width;
        let around = Surroundings {
            convolver: c,
            target: &w.target,
            weight,
            filter: &w.filter,
            guide: &w.guide,
            edges: &w.edges,
            pull,
            threshold,
        };
        let (e, m0) = (response.polarized(), response.unpolarized());
        let polarized = |y: usize, row: &mut [Lanes]| spread(&e[y * width..(y + 1) * width], row);
        let unpolarized = |y: usize, row: &mut [Lanes]| spread_intensity(&m0[y * width..(y + 1) * width], row);
        let buffers = (&mut *w.bands, &mut *w.streams);
        match (self.unknown, &mut w.intensity) {
            (Unknown::Both, Some(intensity)) => {
                let both = |k: usize, y: usize, row: &mut [Lanes]| match k {
                    0 => unpolarized(y, row),
                    _ => polarized(y, row),
                };
                row_steps([intensity, &mut w.main], around, p, both, buffers, &mut w.energies);
            }
            (Unknown::Intensity, _) => {
                row_steps(
                    [&mut w.main],
                    around,
                    p,
                    |_, y, row: &mut [Lanes]| unpolarized(y, row),
                    buffers,
                    &mut w.energies,
                );
            }
            _ => row_steps(
                [&mut w.main],
                around,
                p,
                |_, y, row: &mut [Lanes]| polarized(y, row),
                buffers,
                &mut w.energies,
            ),
        }
    }

    /// Noise of the readings as the unknowns see it, in units of the scene; never zero.
    fn seen_noise(&self, sigma: f32, scale: f32) -> f32 {
        (sigma.max(1e-4 * scale) / (2.0 * self.power.sqrt())).max(f32::MIN_POSITIVE)
    }

    /// Penalties and TV threshold without a guide.
    fn free_penalties(&self, noise: f32, scale: f32) -> (Penalties, f32) {
        let relative = (noise / scale.max(f32::MIN_POSITIVE) / FREE_NOISE).powf(T_POWER).clamp(1e-3, 1e3);
        let gradient = FREE_GRADIENT * relative;
        let p = Penalties { blur: FREE_RHO * self.power, prior: FREE_PRIOR * relative, gradient, rescale: 1.0 };
        (p, FREE_LAMBDA * scale * relative / gradient)
    }

    /// Sets the guide's tables, takes `w.image` as the start once `restrict` made it feasible, and finds t and the threshold.
    fn begin(
        &self,
        brightness: f32,
        sigma: f32,
        restrict: impl Fn(usize, &mut [Complex32], &[f32]),
        w: &mut Workspace,
    ) -> Start {
        let c = &self.operator.convolver;
        let brightness = brightness.max(f32::MIN_POSITIVE);
        self.set_tables(brightness, w);
        let Workspace { filter, guide, image, energies, .. } = w;
        let width = c.size().width;
        let off = Shared::new(energies);
        let load = |y: usize, row: &mut [Lanes]| spread(&image[y * width..(y + 1) * width], row);
        let store = |y: usize, row: &[Lanes]| {
            let square = |(x, v): (usize, &Complex32)| (v - at(row, x)).norm_sqr();
            // SAFETY: each row is stored once.
            #[allow(unsafe_code)]
            let off = unsafe { &mut off.slice(y..y + 1)[0] };
            *off = image[y * width..(y + 1) * width].iter().enumerate().map(square).sum();
        };
        filter.run(guide, c.workers(), &mut w.streams, load, store);
        let off: f64 = energies.iter().map(|v| f64::from(*v)).sum();
        let misfit = ((off / image.len() as f64).sqrt() as f32).max(1e-4 * brightness);
        (0..image.len()).for_each(|i| restrict(i, image, guide));
        w.main.borrow(&mut w.scratch);
        w.main.start(&w.image, c, &self.operator.kernel, &mut w.bands, &mut w.scratch);
        self.constants(misfit, sigma, brightness)
    }

    /// The tables of a guide of root mean square `brightness`.
    fn set_tables(&self, brightness: f32, w: &mut Workspace) {
        let c = &self.operator.convolver;
        w.filter.set_guide(&w.guide, RADIUS, (FLAT * brightness).powi(2), c.workers(), &mut w.streams);
        edge_weights(&w.guide, c.size(), brightness, EDGE, &mut w.edges);
    }

    /// The constants of a cold start.
    fn constants(&self, misfit: f32, sigma: f32, brightness: f32) -> Start {
        let noise = self.seen_noise(sigma, brightness);
        let t = (T * (noise / misfit).powf(T_POWER)).clamp(T_RANGE.0, T_RANGE.1) * 4.0 * self.power;
        Start { t, misfit, first: 0, before: WARM * t }
    }

    /// The iterations on one unknown beside a guide; returns the residual's energy and the last t.
    fn iterate(
        &self,
        weight: &[f32],
        Start { t, misfit, first, mut before }: Start,
        iterations: usize,
        pull: Pull,
        w: &mut Workspace,
    ) -> Result<(f64, f32), Diverged> {
        let c = &self.operator.convolver;
        let penalty = |i: usize| t * WARM.powf((1.0 - i as f32 / WARM_ITERATIONS).max(0.0));
        let mut energy = f64::INFINITY;
        for iteration in 0..iterations {
            let start = Instant::now();
            let now = penalty(first + iteration);
            let p = Penalties { blur: RHO * self.power, prior: now, gradient: now, rescale: before / now };
            before = now;
            self.row_steps(weight, p, pull, THRESHOLD * misfit, w);
            let ahead = match (iterations - iteration - 1, first) {
                (0, _) => Ahead::Shown((AHEAD * iteration as f32).min(FARTHEST)),
                (SETTLED.., 0) if iteration == LEAP_AT => Ahead::Leap(LEAP),
                _ => Ahead::NONE,
            };
            w.main.solve(p, ahead, &self.laplacian, c, &self.operator.kernel, &mut w.scratch);
            energy = self.energy(iteration, p, w)?;
            w.shortest = w.shortest.min(start.elapsed());
        }
        Ok((energy, before))
    }

    /// Energy of the residual the iteration began with.
    fn energy(&self, iteration: usize, p: Penalties, w: &Workspace) -> Result<f64, Diverged> {
        let energy: f64 = w.energies.iter().map(|e| f64::from(*e)).sum();
        if energy.is_finite() { Ok(energy) } else { Err(Diverged { iteration: iteration + 1, step: p.prior }) }
    }

    fn store(&self, out: &mut [f32], w: &mut Workspace) {
        let c = &self.operator.convolver;
        let (n, width) = (c.size().pixels(), c.size().width);
        let Workspace { main, intensity, guide, bands, .. } = w;
        let band = &mut bands[0];
        if self.unknown == Unknown::Intensity {
            main.rows(c, band, |y, row| {
                out[y * width..(y + 1) * width].iter_mut().enumerate().for_each(|(x, s)| *s = at(row, x).re.max(0.0));
            });
            return;
        }
        let (s0, rest) = out.split_at_mut(n);
        let (s1, s2) = rest.split_at_mut(n);
        match intensity {
            Some(field) => field.rows(c, band, |y, row| {
                s0[y * width..(y + 1) * width].iter_mut().enumerate().for_each(|(x, s)| *s = at(row, x).re);
            }),
            None => s0.copy_from_slice(guide),
        }
        main.rows(c, band, |y, row| {
            for x in 0..width {
                let i = y * width + x;
                let l = at(row, x);
                let l = match intensity {
                    Some(_) => {
                        let (nearest, l) = cone(s0[i], l);
                        s0[i] = nearest;
                        l
                    }
                    None => shorten(l, s0[i]),
                };
                (s1[i], s2[i]) = (l.re, l.im);
            }
        });
    }
}

/// What the data say the constants are, and where the iterations begin.
#[derive(Clone, Copy, Debug)]
struct Start {
    /// t in the end.
    t: f32,
    /// How far the slow modes are from being affine in the guide.
    misfit: f32,
    /// Iterations of the schedule of t that are left out.
    first: usize,
    /// t that the multipliers are scaled to.
    before: f32,
}

/// Does `work` with the readings less `share` of what is explained of them.
fn beyond<T>(explained: &[f32], share: f32, w: &mut Workspace, work: impl FnOnce(&mut Workspace) -> T) -> T {
    w.target.iter_mut().zip(explained).for_each(|(t, e)| *t -= share * e);
    let done = work(w);
    w.target.iter_mut().zip(explained).for_each(|(t, e)| *t += share * e);
    done
}

fn spread_intensity(values: &[f32], row: &mut [Lanes]) {
    for (v, values) in row.iter_mut().zip(values.chunks(LANES)) {
        *v = Lanes::ZERO;
        v.re[..values.len()].copy_from_slice(values);
    }
}

/// DoLP ≤ 1: L·min(1, S0/|L|).
fn shorten(l: Complex32, s0: f32) -> Complex32 {
    let square = l.norm_sqr();
    if square <= s0 * s0 { l } else { l * (s0 / square.sqrt()) }
}

/// The nearest point of the cone |L| ≤ S0.
fn cone(s0: f32, l: Complex32) -> (f32, Complex32) {
    let length = l.norm();
    if length <= s0 {
        (s0, l)
    } else if length <= -s0 {
        (0.0, Complex32::ZERO)
    } else {
        let middle = 0.5 * (s0 + length);
        (middle, l * (middle / length))
    }
}

fn rms(values: &[f32]) -> f32 {
    (dot(values, values) / values.len() as f64).sqrt() as f32
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}
