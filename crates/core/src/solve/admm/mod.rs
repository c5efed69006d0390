//! The ADMM of `guided` and `stokes` for one colour channel; [`super::problem`] says what it minimises.
//!
//! An iteration is a pass over rows (`rows.rs`), which does the data step (`data_step.rs`) and the prior step (`prior_step.rs`), and one
//! over columns, which does the image step (`image_step.rs`). The constants come from the caller.

mod buffers;
mod data_step;
mod image_step;
mod prior_step;
mod rows;
mod state;

use std::sync::Arc;
use std::time::{Duration, Instant};

use num_complex::Complex32;

use super::guided_filter::{GuidedFilter, Stream};
use super::problem::{Unknowns, limit_dolp, project_on_cone};
use super::{Buffers, Diverged};
use crate::image::noise::SAMPLES;
use crate::optics::lanes::{LANES, Lanes, at, spread};
use crate::optics::{Coarse, CoarseWorkspace, Scratch, StokesOperator};
use buffers::RowBuffers;
pub(super) use image_step::Extrapolation;
use image_step::Laplacian;
pub(super) use prior_step::Prox;
use rows::{RowContext, row_pass};
pub(super) use state::{Iterate, State};

/// Penalties of one iteration.
#[derive(Clone, Copy, Debug)]
pub(super) struct Penalties {
    /// ρ of ν = k * x.
    pub(super) blur: f32,
    /// t of z = x.
    pub(super) prior: f32,
    /// τ of d = ∇x.
    pub(super) gradient: f32,
    /// Old over new t and τ. Multipliers are scaled by their penalty, so they change with it.
    pub(super) rescale: f32,
}

/// Constants of one iteration.
#[derive(Clone, Copy, Debug)]
pub(super) struct Iteration {
    pub(super) penalties: Penalties,
    pub(super) prox: Prox,
    /// Threshold of total variation, λ/τ.
    pub(super) threshold: f32,
    pub(super) extrapolation: Extrapolation,
}

/// `guided` or `stokes` planned for one channel.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) operator: StokesOperator,
    /// Normal equations of the direct start.
    pub(super) coarse: Arc<Coarse>,
    laplacian: Laplacian,
    pub(super) unknowns: Unknowns,
    pub(super) guided: bool,
    /// Mean squared response of the unknowns.
    pub(super) power: f32,
}

/// Buffers of one channel at a time.
#[derive(Debug)]
pub(super) struct Workspace {
    /// Readings, less the guide's share once its gain is known.
    pub(super) target: Vec<f32>,
    /// The denoised guide in units of the readings, or the present S0.
    pub(super) guide: Vec<f32>,
    /// Weights of total variation.
    pub(super) edges: Vec<f32>,
    /// L, or S0 where L is not solved for.
    pub(super) main: Iterate,
    /// S0, where L is solved for as well.
    pub(super) intensity: Option<Iterate>,
    pub(super) filter: GuidedFilter,
    pub(super) streams: Vec<Stream>,
    pub(super) rows: Vec<RowBuffers>,
    /// An image between adjoint, direct start and iterate.
    pub(super) image: Vec<Complex32>,
    /// Right-hand sides and solutions of the direct start, of the guide's share of the readings and of the readings.
    pub(super) rhs: [Vec<f64>; 4],
    pub(super) coarse: CoarseWorkspace,
    pub(super) samples: Vec<f32>,
    /// A sum of squares for each row.
    pub(super) energies: Vec<f32>,
    pub(super) scratch: Scratch,
    /// The shortest iteration of the latest run.
    shortest: Duration,
}

impl Buffers for Workspace {
    fn scratch(&self) -> &Scratch {
        &self.scratch
    }

    fn scratch_mut(&mut self) -> &mut Scratch {
        self.main.give_back(&mut self.scratch);
        &mut self.scratch
    }

    fn forget(&mut self) {
        self.coarse.forget();
    }

    fn shortest_iteration(&self) -> Option<Duration> {
        Some(self.shortest).filter(|t| *t < Duration::MAX)
    }
}

impl Workspace {
    /// Makes ready for another run.
    pub(super) fn begin(&mut self) {
        self.main.give_back(&mut self.scratch);
        self.shortest = Duration::MAX;
    }
}

impl Plan {
    /// Plans `guided` or, without a guide, `stokes`. `coarse` are the direct start's equations, if they are there already. Allocates;
    /// makes them otherwise.
    pub(super) fn new(operator: StokesOperator, guided: bool, coarse: Option<Arc<Coarse>>) -> Self {
        let unknowns = Unknowns::new(&operator.response, guided);
        let responses = unknowns.responses(&operator);
        let squares: f64 = responses.iter().flatten().map(|m| f64::from(*m).powi(2)).sum();
        let power = (squares / operator.field().frame().pixels() as f64) as f32;
        let coarse = coarse.unwrap_or_else(|| Arc::new(Coarse::new(&operator, &responses)));
        let laplacian = Laplacian::new(operator.convolver.padded());
        Self { operator, coarse, laplacian, unknowns, guided, power: power.max(f32::MIN_POSITIVE) }
    }

    /// Parts of a workspace, in bytes. Allocates.
    pub(super) fn workspace_parts(&self) -> Vec<(&'static str, usize)> {
        let c = &self.operator.convolver;
        let n = c.size().pixels();
        let second = if self.unknowns == Unknowns::Both { Iterate::bytes(c, false) } else { 0 };
        let start = 4 * self.coarse.unknowns() * size_of::<f64>() + n * size_of::<Complex32>();
        vec![
            ("unknown images and multipliers", Iterate::bytes(c, true) + second),
            ("transforms", c.scratch_bytes()),
            ("readings, guide and edges", (3 * n + SAMPLES + c.size().height) * size_of::<f32>()),
            ("guided filter", GuidedFilter::bytes(c.size())),
            ("rows of each thread", c.workers().threads() * Stream::bytes(c.size().width) + RowBuffers::bytes(c)),
            ("direct start", start + self.coarse.workspace_bytes()),
        ]
    }

    /// Allocates.
    pub(super) fn make_workspace(&self) -> Workspace {
        let c = &self.operator.convolver;
        let n = c.size().pixels();
        let reals = || vec![0.0; n];
        let unknowns = || vec![0.0; self.coarse.unknowns()];
        Workspace {
            target: reals(),
            guide: reals(),
            edges: reals(),
            main: Iterate::new(c, true),
            intensity: (self.unknowns == Unknowns::Both).then(|| Iterate::new(c, false)),
            filter: GuidedFilter::new(c.size()),
            streams: (0..c.workers().threads()).map(|_| Stream::new(c.size().width)).collect(),
            rows: RowBuffers::for_threads(c),
            image: vec![Complex32::ZERO; n],
            rhs: [unknowns(), unknowns(), unknowns(), unknowns()],
            coarse: self.coarse.make_workspace(),
            samples: Vec::with_capacity(SAMPLES),
            energies: vec![0.0; c.size().height],
            scratch: c.make_scratch(),
            shortest: Duration::MAX,
        }
    }

    /// Iteration number `number`, from 0. Returns the weighted sum of squares of the residual that it began with.
    pub(super) fn iterate(
        &self,
        number: usize,
        weight: &[f32],
        iteration: Iteration,
        w: &mut Workspace,
    ) -> Result<f64, Diverged> {
        let start = Instant::now();
        self.data_and_prior_steps(weight, iteration, w);
        let (c, kernel, laplacian) = (&self.operator.convolver, &self.operator.kernel, &self.laplacian);
        let Iteration { penalties, extrapolation, .. } = iteration;
        for unknown in w.intensity.iter_mut().chain([&mut w.main]) {
            unknown.image_step(penalties, extrapolation, laplacian, c, kernel, &mut w.scratch);
        }
        w.shortest = w.shortest.min(start.elapsed());
        let energy: f64 = w.energies.iter().map(|e| f64::from(*e)).sum();
        if energy.is_finite() { Ok(energy) } else { Err(Diverged { iteration: number + 1, step: penalties.prior }) }
    }

    fn data_and_prior_steps(&self, weight: &[f32], iteration: Iteration, w: &mut Workspace) {
        let (c, response) = (&self.operator.convolver, &self.operator.response);
        let width = c.size().width;
        let Iteration { penalties, prox, threshold, .. } = iteration;
        let Workspace { target, guide, edges, filter, streams, rows, energies, .. } = w;
        let context = RowContext { convolver: c, target, weight, filter, guide, edges, prox, threshold };
        let (e, m0) = (response.polarized(), response.unpolarized());
        let polarized = |y: usize, row: &mut [Lanes]| spread(&e[y * width..(y + 1) * width], row);
        let unpolarized = |y: usize, row: &mut [Lanes]| spread_intensity(&m0[y * width..(y + 1) * width], row);
        let buffers = (&mut rows[..], &mut streams[..]);
        match (self.unknowns, &mut w.intensity) {
            (Unknowns::Both, Some(intensity)) => {
                let both = |k: usize, y: usize, row: &mut [Lanes]| match k {
                    0 => unpolarized(y, row),
                    _ => polarized(y, row),
                };
                row_pass([intensity, &mut w.main], context, penalties, both, buffers, energies);
            }
            (Unknowns::Intensity, _) => {
                let one = |_: usize, y: usize, row: &mut [Lanes]| unpolarized(y, row);
                row_pass([&mut w.main], context, penalties, one, buffers, energies);
            }
            _ => {
                let one = |_: usize, y: usize, row: &mut [Lanes]| polarized(y, row);
                row_pass([&mut w.main], context, penalties, one, buffers, energies);
            }
        }
    }

    /// Takes `w.image` (`[H, W]`) as the main unknown, with multipliers of zero.
    pub(super) fn start(&self, w: &mut Workspace) {
        let StokesOperator { convolver, kernel, .. } = &self.operator;
        w.main.start(&w.image, convolver, kernel, &mut w.rows, &mut w.scratch);
    }

    /// Adds `w.image` to the main unknown, whose multipliers stay.
    pub(super) fn resume(&self, w: &mut Workspace) {
        let StokesOperator { convolver, kernel, .. } = &self.operator;
        w.main.resume(&w.image, convolver, kernel, &mut w.rows, &mut w.scratch);
    }

    /// Stores the Stokes images of the unknowns, and of the guide where S0 is not one, into `out`: `[3, H, W]`, or `[1, H, W]` without a
    /// mask.
    pub(super) fn store(&self, out: &mut [f32], w: &mut Workspace) {
        let c = &self.operator.convolver;
        let (n, width) = (c.size().pixels(), c.size().width);
        let Workspace { main, intensity, guide, rows, .. } = w;
        let buffers = &mut rows[0];
        if self.unknowns == Unknowns::Intensity {
            main.rows(c, buffers, |y, row| {
                out[y * width..(y + 1) * width].iter_mut().enumerate().for_each(|(x, s)| *s = at(row, x).re.max(0.0));
            });
            return;
        }
        let (s0, rest) = out.split_at_mut(n);
        let (s1, s2) = rest.split_at_mut(n);
        match intensity {
            Some(intensity) => intensity.rows(c, buffers, |y, row| {
                s0[y * width..(y + 1) * width].iter_mut().enumerate().for_each(|(x, s)| *s = at(row, x).re);
            }),
            None => s0.copy_from_slice(guide),
        }
        main.rows(c, buffers, |y, row| {
            for x in 0..width {
                let (i, l) = (y * width + x, at(row, x));
                let (s, l) = match intensity {
                    Some(_) => project_on_cone(s0[i], l),
                    None => (s0[i], limit_dolp(l, s0[i])),
                };
                (s0[i], s1[i], s2[i]) = (s, l.re, l.im);
            }
        });
    }
}

/// Copies real values into the beginning of a row as real parts.
pub(super) fn spread_intensity(values: &[f32], row: &mut [Lanes]) {
    for (v, values) in row.iter_mut().zip(values.chunks(LANES)) {
        *v = Lanes::ZERO;
        v.re[..values.len()].copy_from_slice(values);
    }
}

/// Random numbers and a small camera for the tests of the steps.
#[cfg(test)]
mod testing {
    use std::sync::Arc;

    use num_complex::Complex32;
    use proptest::prelude::*;

    use super::Penalties;
    use crate::image::Size;
    use crate::optics::lanes::Lanes;
    use crate::optics::{Convolver, FftBackend, Field, Reach};
    use crate::parallel::Workers;

    pub(super) const SIZE: Size = Size::new(21, 19);

    pub(super) fn lanes() -> impl Strategy<Value = Lanes> {
        let numbers = || proptest::array::uniform8(-1.0f32..1.0);
        (numbers(), numbers()).prop_map(|(re, im)| Lanes { re, im })
    }

    pub(super) fn penalties() -> impl Strategy<Value = Penalties> {
        (0.1f32..2.0, 0.1f32..2.0, 0.1f32..2.0, 0.5f32..2.0).prop_map(|(blur, prior, gradient, rescale)| Penalties {
            blur,
            prior,
            gradient,
            rescale,
        })
    }

    pub(super) fn convolver(threads: usize) -> Convolver {
        let reach = Reach { rows: (3, 3), columns: (4, 4) };
        Convolver::new(Field::of_frame(SIZE), reach, FftBackend::Batched, Arc::new(Workers::new(threads))).unwrap()
    }

    pub(super) fn noise(n: usize, seed: u32) -> Vec<f32> {
        let mut s = seed;
        let mut next = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32 - 0.5
        };
        (0..n).map(|_| next()).collect()
    }

    pub(super) fn complex(seed: u32) -> Vec<Complex32> {
        noise(2 * SIZE.pixels(), seed).chunks(2).map(|v| Complex32::new(v[0], v[1])).collect()
    }
}
