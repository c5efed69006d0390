//! One unknown image of a splitting method and the steps of an iteration on it.
//!
//! Scaled ADMM on min ½‖w ⊙ (b − Σ_k Re(ē_k ⊙ ν_k))‖² + prior(z) + λ·TV with ν = k * x (penalty ρ), z = x (penalty t) and the
//! gradient d = ∇x (penalty τ). Data step: one real equation for each pixel, so ν = v + e·r/(Σ|e|² + ρ) with the residual r at
//! v = k * x + u. TV step: isotropic soft shrinkage of ∇x + u, real and imaginary part together. Image step, exact on the
//! padded circle: (ρ|K|² + t + τ|D|²) X = ρ(|K|² X + K̄ F(ν − u − k * x)) + t F(z − u) + τ F(Dᵀ(d − u)).
//!
//! Differences that leave the sensor carry no penalty: their target is their present value.
//!
//! An iteration goes over memory twice. Over rows: inverse FFT, data step, guided filter, prior and TV step, FFT, each row while
//! it lies in the cache ([`row_steps`]). Over columns: FFT, image step, inverse FFT ([`Field::solve`]). Between the two passes an
//! image consists of transformed rows.

use fearless_simd::prelude::*;
use fearless_simd::{Level, f32x8};
use num_complex::Complex32;

use super::guided_filter::{GuidedFilter, Reals, Stream};
use crate::optics::lanes::{LANES, Lanes, Wave, at, clear_from, put, spread, spread_real, vectorize};
use crate::optics::{Convolver, FftScratch, Kernel, Scratch, Way};
use crate::parallel::Shared;
use crate::plane::Size;

/// Penalties of one iteration.
#[derive(Clone, Copy, Debug)]
pub(super) struct Penalties {
    /// ρ of ν = k * x.
    pub(super) blur: f32,
    /// t of z = x.
    pub(super) prior: f32,
    /// τ of d = ∇x.
    pub(super) gradient: f32,
    /// Old over new t and τ: multipliers are scaled, so they change with the penalty.
    pub(super) rescale: f32,
}

/// How much further x is taken than the image step takes it, in units of that step: where iterations come closer to the answer by
/// ever smaller steps of much the same direction, that is where many more would end.
#[derive(Clone, Copy, Debug)]
pub(super) enum Ahead {
    /// The image that is read from the field alone; the state stays where it is.
    Shown(f32),
    /// The state too: iterations have to follow on which the multipliers settle.
    Leap(f32),
}

impl Ahead {
    pub(super) const NONE: Self = Self::Shown(0.0);
}

/// The proximal step of the prior on x + u, for the fields of an iteration. The filtered image is that of the last field.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pull {
    /// x + u, not negative.
    Positive,
    /// The filtered image, not negative.
    FilteredPositive,
    /// The filtered image, no longer than the guide.
    Filtered,
    /// S0 and the filtered image at the nearest point of the cone |L| ≤ S0.
    Cone,
}

/// What the row steps of an iteration work with beside the fields. Planes are `[H, W]`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surroundings<'a> {
    pub(super) convolver: &'a Convolver,
    pub(super) target: &'a [f32],
    pub(super) weight: &'a [f32],
    pub(super) filter: &'a GuidedFilter,
    /// The guide of the filter and of [`Pull::Filtered`].
    pub(super) guide: &'a [f32],
    /// Weights of the TV of the last field beside a guide.
    pub(super) edges: &'a [f32],
    pub(super) pull: Pull,
    /// TV threshold.
    pub(super) threshold: f32,
}

/// Multipliers of z = x and of the two parts of d = ∇x.
#[derive(Clone, Copy, Debug, Default)]
struct Multipliers {
    prior: Lanes,
    across: Lanes,
    down: Lanes,
}

/// One complex image (S1 + i·S2, or S0 as real part) and its state.
#[derive(Debug)]
pub(super) struct Field {
    /// x; within an iteration the right-hand side of the image step. Transformed padded rows.
    image: Vec<Lanes>,
    /// k * x; within an iteration ν − u − k * x. Transformed padded rows; empty while [`Scratch`] has them.
    blurred: Vec<Lanes>,
    /// F(x), eight columns after eight columns.
    spectrum: Vec<Lanes>,
    /// u of ν, in rows of the sensor filled up to whole lanes.
    blur_dual: Vec<Lanes>,
    multipliers: Vec<Multipliers>,
}

/// An image and all its multipliers, to be kept between frames. The image is kept as F(x), for what lies around the sensor
/// belongs to the state: multipliers that meet another x there take many iterations to settle.
#[derive(Debug)]
pub(super) struct State {
    spectrum: Vec<Lanes>,
    blur_dual: Vec<Lanes>,
    multipliers: Vec<Multipliers>,
}

impl State {
    /// Allocates.
    pub(super) fn new(c: &Convolver) -> Self {
        let n = c.size().width.div_ceil(LANES) * c.size().height;
        let spectrum = vec![Lanes::ZERO; c.padded().height * c.row_lanes()];
        Self { spectrum, blur_dual: vec![Lanes::ZERO; n], multipliers: vec![Multipliers::default(); n] }
    }

    pub(super) fn bytes(c: &Convolver) -> usize {
        let pixels = c.size().width.div_ceil(LANES) * c.size().height;
        (pixels + c.padded().height * c.row_lanes()) * size_of::<Lanes>() + pixels * size_of::<Multipliers>()
    }
}

/// Rows of x that are kept: as many as the largest filter is behind, the present one and the next.
const RING: usize = 10;

/// The buffers of one thread's band of rows, for up to two fields.
#[derive(Debug)]
pub(super) struct Band {
    fft: FftScratch,
    /// The latest rows of x, padded.
    ring: [Vec<Lanes>; 2],
    /// The row of x behind the band.
    next: [Vec<Lanes>; 2],
    /// What flows down out of the latest row; at first, out of the row before the band.
    flow: [Vec<Lanes>; 2],
    /// x + u of the rows around the band that the filter reaches: those before, then those behind.
    around: Vec<Lanes>,
    /// x + u of a row.
    input: Vec<Lanes>,
    responses: [Vec<Lanes>; 2],
    reals: [Vec<Reals>; 2],
}

impl Band {
    fn new(c: &Convolver) -> Self {
        let (lanes, blocks) = (c.size().width.div_ceil(LANES), c.row_lanes());
        let rows = |n: usize, width: usize| vec![Lanes::ZERO; n * width];
        let row = || rows(1, lanes);
        Self {
            fft: c.row_fft().make_scratch(),
            ring: [rows(RING, blocks), rows(RING, blocks)],
            next: [rows(1, blocks), rows(1, blocks)],
            flow: [row(), row()],
            around: rows(2 * (RING - 2), lanes),
            input: row(),
            responses: [row(), row()],
            reals: [vec![[0.0; LANES]; lanes], vec![[0.0; LANES]; lanes]],
        }
    }

    /// One for each thread. Allocates.
    pub(super) fn for_threads(c: &Convolver) -> Vec<Self> {
        (0..c.workers().threads()).map(|_| Self::new(c)).collect()
    }

    /// Bytes of those of all threads.
    pub(super) fn bytes(c: &Convolver) -> usize {
        let (lanes, blocks) = (c.size().width.div_ceil(LANES), c.row_lanes());
        let rows = (2 * RING + 2) * blocks + (2 * (RING - 2) + 5) * lanes;
        let band = rows * size_of::<Lanes>() + 2 * lanes * size_of::<Reals>();
        c.workers().threads() * (band + c.row_fft().make_scratch().bytes())
    }
}

/// τ|D|² needs 4 − 2cos − 2cos of the frequencies of both axes.
#[derive(Debug)]
pub(super) struct Laplacian {
    rows: Vec<f32>,
    columns: Vec<Reals>,
}

impl Laplacian {
    pub(super) fn new(padded: Size) -> Self {
        let value = |k: usize, n: usize| 2.0 - 2.0 * (std::f32::consts::TAU * k as f32 / n as f32).cos();
        let lanes = |j: usize| std::array::from_fn(|l| value(j * LANES + l, padded.width));
        Self {
            rows: (0..padded.height).map(|k| value(k, padded.height)).collect(),
            columns: (0..padded.width / LANES).map(lanes).collect(),
        }
    }
}

impl Field {
    /// `borrows` leaves the place of k * x to the [`Scratch`]. Allocates.
    pub(super) fn new(c: &Convolver, borrows: bool) -> Self {
        let (Size { width, height }, blocks) = (c.size(), c.row_lanes());
        let (lanes, rows) = (width.div_ceil(LANES), |n: usize| vec![Lanes::ZERO; n]);
        Self {
            image: rows(c.coupled_rows() * blocks),
            blurred: rows(if borrows { 0 } else { height * blocks }),
            spectrum: rows(c.padded().height * blocks),
            blur_dual: rows(height * lanes),
            multipliers: vec![Multipliers::default(); height * lanes],
        }
    }

    pub(super) fn bytes(c: &Convolver, borrows: bool) -> usize {
        let (Size { width, height }, blocks) = (c.size(), c.row_lanes());
        let padded = c.coupled_rows() + c.padded().height + if borrows { 0 } else { height };
        let pixels = width.div_ceil(LANES) * height;
        (padded * blocks + pixels) * size_of::<Lanes>() + pixels * size_of::<Multipliers>()
    }

    /// Takes the place of k * x from `scratch`, or gives it back if it has it already.
    pub(super) fn borrow(&mut self, scratch: &mut Scratch) {
        if self.blurred.is_empty() {
            self.blurred = scratch.lend();
        }
    }

    pub(super) fn give_back(&mut self, scratch: &mut Scratch) {
        if !self.blurred.is_empty() {
            scratch.give_back(std::mem::take(&mut self.blurred));
        }
    }

    /// Takes `image` (`[H, W]`) as x, and k * x with it; no multipliers.
    pub(super) fn start(
        &mut self,
        image: &[Complex32],
        c: &Convolver,
        kernel: &Kernel,
        bands: &mut [Band],
        scratch: &mut Scratch,
    ) {
        self.spectrum.fill(Lanes::ZERO);
        self.blur_dual.fill(Lanes::ZERO);
        self.multipliers.fill(Multipliers::default());
        self.resume(image, c, kernel, bands, scratch);
    }

    /// Exchanges image and multipliers; [`Self::resume`] goes on from them.
    pub(super) fn exchange(&mut self, state: &mut State) {
        std::mem::swap(&mut self.spectrum, &mut state.spectrum);
        std::mem::swap(&mut self.blur_dual, &mut state.blur_dual);
        std::mem::swap(&mut self.multipliers, &mut state.multipliers);
    }

    /// Keeps a share of the multipliers of prior and TV, and none of those of ν = k * x: they hold the readings' noise.
    pub(super) fn fade(&mut self, share: f32) {
        self.blur_dual.fill(Lanes::ZERO);
        let fade = |lanes: &mut Lanes| lanes.re.iter_mut().chain(&mut lanes.im).for_each(|v| *v *= share);
        for Multipliers { prior, across, down } in &mut self.multipliers {
            [prior, across, down].into_iter().for_each(fade);
        }
    }

    /// Adds `image` (`[H, W]`) to x, as its spectrum has it, and makes k * x; the multipliers stay.
    pub(super) fn resume(
        &mut self,
        image: &[Complex32],
        c: &Convolver,
        kernel: &Kernel,
        bands: &mut [Band],
        scratch: &mut Scratch,
    ) {
        let (Size { width, height }, blocks) = (c.size(), c.row_lanes());
        self.blurred.fill(Lanes::ZERO);
        let (sensor, outside) = self.image.split_at_mut(height * blocks);
        outside.fill(Lanes::ZERO);
        let (rows, bands) = (Shared::new(sensor), Shared::new(bands));
        c.workers().run(c.workers().threads(), &|task| {
            // SAFETY: each task has a band and rows of its own.
            #[allow(unsafe_code)]
            let fft = unsafe { &mut bands.slice(task..task + 1)[0].fft };
            for y in c.workers().band(task, height) {
                // SAFETY: as above.
                #[allow(unsafe_code)]
                let row = unsafe { rows.slice(y * blocks..(y + 1) * blocks) };
                spread(&image[y * width..(y + 1) * width], row);
                c.row_fft().line(Way::Forward, row, fft);
            }
        });
        let (ph, share) = (c.padded().height, 1.0 / c.padded().pixels() as f32);
        let kernel = kernel.spectrum();
        let mix = |block: usize, a: &mut [Lanes], b: &mut [Lanes], x: &mut [Lanes]| {
            let kernel = &kernel[block * ph..][..ph];
            vectorize!(Level::new(), s => begin(s, a, b, x, kernel, share));
        };
        c.couple_columns(&mut self.blurred, &mut self.image, &mut self.spectrum, mix, scratch);
    }

    /// Calls `store(y, row)` with each row of x; rows come in order.
    pub(super) fn rows(&self, c: &Convolver, band: &mut Band, store: impl FnMut(usize, &[Lanes])) {
        Self::rows_of(&self.image, c, band, store);
    }

    /// The same with k * x, after [`Self::resume`].
    pub(super) fn blurred_rows(&self, c: &Convolver, band: &mut Band, store: impl FnMut(usize, &[Lanes])) {
        Self::rows_of(&self.blurred, c, band, store);
    }

    fn rows_of(image: &[Lanes], c: &Convolver, band: &mut Band, mut store: impl FnMut(usize, &[Lanes])) {
        let Band { next: [line, _], fft, .. } = band;
        for (y, row) in image.chunks_exact(c.row_lanes()).take(c.size().height).enumerate() {
            line.copy_from_slice(row);
            c.row_fft().line(Way::Inverse, line, fft);
            store(y, line);
        }
    }

    /// The image step, and `ahead` of it.
    pub(super) fn solve(
        &mut self,
        p: Penalties,
        ahead: Ahead,
        laplacian: &Laplacian,
        c: &Convolver,
        kernel: &Kernel,
        scratch: &mut Scratch,
    ) {
        let (ph, pixels) = (c.padded().height, c.padded().pixels() as f32);
        let kernel = kernel.spectrum();
        let mix = |block: usize, a: &mut [Lanes], b: &mut [Lanes], x: &mut [Lanes]| {
            let kernel = &kernel[block * ph..][..ph];
            let across = &laplacian.columns[block];
            vectorize!(Level::new(), s => divide(s, a, b, x, kernel, across, &laplacian.rows, p, ahead, pixels));
        };
        c.couple_columns(&mut self.blurred, &mut self.image, &mut self.spectrum, mix, scratch);
    }
}

/// x with b added to it; k * x and x for one inverse transform.
#[inline(always)]
fn begin<S: Simd>(s: S, a: &mut [Lanes], b: &mut [Lanes], x: &mut [Lanes], kernel: &[Lanes], share: f32) {
    for ((a, b), (x, k)) in a.iter_mut().zip(b).zip(x.iter_mut().zip(kernel)) {
        let sum = Wave::load(s, b).plus(Wave::load(s, x), f32x8::splat(s, 1.0));
        sum.store(x);
        (sum * Wave::load(s, k)).store(a);
        sum.scale(f32x8::splat(s, share)).store(b);
    }
}

/// The division of the image step at eight columns.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "an inlined loop body")]
fn divide<S: Simd>(
    s: S,
    a: &mut [Lanes],
    b: &mut [Lanes],
    x: &mut [Lanes],
    kernel: &[Lanes],
    across: &Reals,
    down: &[f32],
    p: Penalties,
    ahead: Ahead,
    pixels: f32,
) {
    // The kernel carries the 1/pixels of the inverse transform.
    let (square, single) = (f32x8::splat(s, p.blur * pixels * pixels), f32x8::splat(s, p.blur * pixels));
    let (share, gradient) = (f32x8::splat(s, 1.0 / pixels), f32x8::splat(s, p.gradient));
    let across = f32x8::simd_from(s, *across) * gradient + p.prior;
    let (leap, shown) = match ahead {
        Ahead::Shown(shown) => (0.0, shown),
        Ahead::Leap(leap) => (leap, 0.0),
    };
    let (leap, shown) = (f32x8::splat(s, leap), f32x8::splat(s, shown));
    for ((a, b), ((x, k), down)) in a.iter_mut().zip(b).zip(x.iter_mut().zip(kernel).zip(down)) {
        let k = Wave::load(s, k);
        let power = k.norm_sqr() * square;
        let divisor = f32x8::splat(s, 1.0) / (power + f32x8::splat(s, *down).mul_add(gradient, across));
        let pushed = Wave::load(s, b).plus(k.conj() * Wave::load(s, a), single);
        let before = Wave::load(s, x);
        let next = pushed.plus(before, power).scale(divisor);
        let step = next - before;
        let next = next.plus(step, leap);
        next.store(x);
        (k * next).store(a);
        next.plus(step, shown).scale(share).store(b);
    }
}

/// The data, prior and TV steps of an iteration on `K` fields, from x and k * x to the right-hand sides of the image steps.
/// `response(k, y, row)` fills row y of the responses e_k; the squared residuals of the present x are summed for each row into
/// `energies`. One band and one stream for each thread.
pub(super) fn row_steps<const K: usize>(
    mut fields: [&mut Field; K],
    around: Surroundings<'_>,
    p: Penalties,
    response: impl Fn(usize, usize, &mut [Lanes]) + Sync,
    (bands, streams): (&mut [Band], &mut [Stream]),
    energies: &mut [f32],
) {
    let c = around.convolver;
    let (Size { width, height }, blocks) = (c.size(), c.row_lanes());
    let (lanes, workers, fft) = (width.div_ceil(LANES), c.workers(), c.row_fft());
    // The filter reads ahead of the band and its rows come late; without it the row below is all that is needed.
    let (ahead, behind) = around.reach();
    exchange(&mut fields, around, p, bands);
    let state = fields.map(|f| {
        let (image, blurred) = (Shared::new(&mut f.image), Shared::new(&mut f.blurred));
        (image, blurred, Shared::new(&mut f.blur_dual), Shared::new(&mut f.multipliers))
    });
    let (bands, streams, energies) = (Shared::new(bands), Shared::new(streams), Shared::new(energies));
    workers.run(workers.threads(), &|task| {
        let band = workers.band(task, height);
        if band.is_empty() {
            return;
        }
        // SAFETY: each task has buffers of its own.
        #[allow(unsafe_code)]
        let (own, stream) = unsafe { (&mut bands.slice(task..task + 1)[0], &mut streams.slice(task..task + 1)[0]) };
        let Band { fft: scratch, ring, next, flow, around: halo, input, responses, reals } = own;
        let padded = |y: usize| y * blocks..(y + 1) * blocks;
        let sensor = |y: usize| y * lanes..(y + 1) * lanes;
        for step in 0..band.len() + ahead + behind {
            let j = (band.start + step).checked_sub(ahead).filter(|j| *j < height);
            if let Some(j) = j.filter(|j| band.contains(j)) {
                // SAFETY: each row belongs to one task.
                #[allow(unsafe_code)]
                let (images, mut blurred, mut duals, multipliers, energy) = unsafe {
                    (
                        state.each_ref().map(|f| &*f.0.slice(padded(j))),
                        state.each_ref().map(|f| f.1.slice(padded(j))),
                        state.each_ref().map(|f| f.2.slice(sensor(j))),
                        &*state[K - 1].3.slice(sensor(j)),
                        &mut energies.slice(j..j + 1)[0],
                    )
                };
                for (k, image) in images.into_iter().enumerate() {
                    let x = &mut ring[k][j % RING * blocks..][..blocks];
                    x.copy_from_slice(image);
                    fft.line(Way::Inverse, x, scratch);
                    crop(x, width);
                    fft.line(Way::Inverse, blurred[k], scratch);
                    response(k, j, &mut responses[k]);
                }
                spread_real(&around.target[j * width..(j + 1) * width], &mut reals[0]);
                spread_real(&around.weight[j * width..(j + 1) * width], &mut reals[1]);
                *energy =
                    vectorize!(Level::new(), s => data_row(s, &mut blurred, &mut duals, responses, reals, p.blur));
                for row in blurred {
                    row[lanes..].fill(Lanes::ZERO);
                    fft.line(Way::Forward, row, scratch);
                }
                if ahead > 0 {
                    let x = &ring[K - 1][j % RING * blocks..][..lanes];
                    vectorize!(Level::new(), s => prior_input(s, x, multipliers, p.rescale, input));
                }
            }
            let (y, filtered) = if ahead > 0 {
                let row = match j {
                    Some(j) if j < band.start => &halo[(j + ahead - band.start) * lanes..][..lanes],
                    Some(j) if j >= band.end => &halo[(j - band.end + ahead) * lanes..][..lanes],
                    _ => &input[..],
                };
                match around.filter.push(&band, step, row, around.guide, stream) {
                    Some(row) => row,
                    None => continue,
                }
            } else {
                match (band.start + step).checked_sub(behind).filter(|y| band.contains(y)) {
                    Some(y) => (y, &[][..]),
                    None => continue,
                }
            };
            // SAFETY: each row belongs to one task; this one is no longer read.
            #[allow(unsafe_code)]
            let (mut out, mut multipliers) = unsafe {
                (state.each_ref().map(|f| f.0.slice(padded(y))), state.each_ref().map(|f| f.3.slice(sensor(y))))
            };
            let here: [&[Lanes]; K] = std::array::from_fn(|k| &ring[k][y % RING * blocks..][..blocks]);
            let below: [&[Lanes]; K] = std::array::from_fn(|k| match y + 1 {
                below if below == height => here[k],
                below if below == band.end => &next[k],
                below => &ring[k][below % RING * blocks..][..blocks],
            });
            if y == 0 {
                flow.iter_mut().zip(here).for_each(|(flow, here)| flow.copy_from_slice(&here[..lanes]));
            }
            let [guide, edges] = &mut *reals;
            if ahead > 0 {
                spread_real(&around.guide[y * width..(y + 1) * width], guide);
                spread_real(&around.edges[y * width..(y + 1) * width], edges);
            }
            let rows = PriorRows { here, below, filtered, guide, edges, last: y + 1 == height };
            vectorize!(Level::new(), s => prior_row(s, rows, around, p, &mut multipliers, flow, &mut out));
            for (k, out) in out.into_iter().enumerate() {
                let (first, last) = (at(here[k], 0) * p.gradient, at(here[k], width - 1) * p.gradient);
                put(out, 0, at(out, 0) + first);
                put(out, width - 1, at(out, width - 1) + last);
                clear_from(out, width);
                put(out, width, -last);
                put(out, c.padded().width - 1, -first);
                fft.line(Way::Forward, out, scratch);
            }
            for (row, mine) in [(height, y + 1 == height), (height + 1, y == 0)] {
                for (k, field) in state.iter().enumerate().filter(|_| mine) {
                    // SAFETY: the row after the sensor belongs to the task of the last row, the last padded one to that of the first.
                    #[allow(unsafe_code)]
                    let out = unsafe { field.0.slice(padded(row)) };
                    out.copy_from_slice(here[k]);
                    clear_from(out, width);
                    out.iter_mut().flat_map(|v| v.re.iter_mut().chain(&mut v.im)).for_each(|v| *v *= -p.gradient);
                    fft.line(Way::Forward, out, scratch);
                }
            }
        }
    });
}

impl Surroundings<'_> {
    /// Rows that are looked at before the one that is worked on is: beyond the band, and in all.
    fn reach(&self) -> (usize, usize) {
        match self.pull {
            Pull::Positive => (0, 1),
            _ => (self.filter.delay(), self.filter.delay()),
        }
    }
}

/// What a band needs of its neighbours, before anything is overwritten: x + u as far as the filter reaches, the row of x behind,
/// and what flows down from the row before.
fn exchange<const K: usize>(fields: &mut [&mut Field; K], around: Surroundings<'_>, p: Penalties, bands: &mut [Band]) {
    let c = around.convolver;
    let (Size { width, height }, blocks) = (c.size(), c.row_lanes());
    let lanes = width.div_ceil(LANES);
    let (ahead, behind) = around.reach();
    for task in 1..bands.len() {
        let edge = c.workers().band(task, height).start;
        if edge == 0 || edge == height {
            continue;
        }
        let [.., upper, lower] = &mut bands[..=task] else { continue };
        for (k, field) in fields.iter().enumerate() {
            for j in edge.saturating_sub(behind)..(edge + behind).min(height) {
                let row = &mut upper.next[k];
                row.copy_from_slice(&field.image[j * blocks..(j + 1) * blocks]);
                c.row_fft().line(Way::Inverse, row, &mut upper.fft);
                crop(row, width);
                let multipliers = &field.multipliers[j * lanes..(j + 1) * lanes];
                if ahead > 0 && k + 1 == K {
                    let (halo, at) = match j.checked_sub(edge) {
                        Some(at) => (&mut upper.around, at + ahead),
                        None => (&mut lower.around, j + ahead - edge),
                    };
                    let halo = &mut halo[at * lanes..(at + 1) * lanes];
                    vectorize!(Level::new(), s => prior_input(s, row, multipliers, p.rescale, halo));
                }
                if j + 1 == edge {
                    lower.next[k].copy_from_slice(row);
                } else if j == edge {
                    let above = &field.multipliers[(j - 1) * lanes..j * lanes];
                    spread_real(&around.edges[(j - 1) * width..j * width], &mut upper.reals[1]);
                    let edges = (ahead > 0 && k + 1 == K).then_some(&upper.reals[1][..]);
                    let (here, flow) = (&lower.next[k], &mut lower.flow[k]);
                    vectorize!(Level::new(), s => flow_row(s, here, row, above, edges, around.threshold, p.rescale, flow));
                    // The row that the band above keeps is this one, not the later ones that only the filter needs.
                    lower.next[k].copy_from_slice(row);
                }
            }
            upper.next[k].copy_from_slice(&lower.next[k]);
        }
    }
}

/// Repeats the last value of the sensor's part of a row, so that the difference across the border is zero; zeros follow.
fn crop(row: &mut [Lanes], width: usize) {
    put(row, width, at(row, width - 1));
    clear_from(row, width + 1);
}

/// The data step on a row; the sum of its squared residuals.
#[inline(always)]
fn data_row<S: Simd, const K: usize>(
    s: S,
    blurred: &mut [&mut [Lanes]; K],
    duals: &mut [&mut [Lanes]; K],
    responses: &[Vec<Lanes>; 2],
    [target, weight]: &[Vec<Reals>; 2],
    rho: f32,
) -> f32 {
    let mut energy = f32x8::splat(s, 0.0);
    for (i, (target, weight)) in target.iter().zip(weight).enumerate() {
        let weight = f32x8::simd_from(s, *weight);
        let (mut read, mut dual, mut norm) = (f32x8::splat(s, 0.0), f32x8::splat(s, 0.0), f32x8::splat(s, rho));
        for k in 0..K {
            let e = Wave::load(s, &responses[k][i]);
            read += e.inner(Wave::load(s, &blurred[k][i]));
            dual += e.inner(Wave::load(s, &duals[k][i]));
            norm += e.norm_sqr();
        }
        let r = weight * (f32x8::simd_from(s, *target) - read);
        energy = r.mul_add(r, energy);
        let step = (r - weight * dual) / norm;
        for k in 0..K {
            let d = Wave::load(s, &responses[k][i]).scale(step);
            Wave::load(s, &duals[k][i]).plus(d, f32x8::splat(s, 2.0)).store(&mut blurred[k][i]);
            Wave { re: -d.re, im: -d.im }.store(&mut duals[k][i]);
        }
    }
    <[f32; LANES]>::from(energy).iter().sum()
}

/// x + u, u being the multiplier of z = x.
#[inline(always)]
fn prior_input<S: Simd>(s: S, x: &[Lanes], multipliers: &[Multipliers], rescale: f32, out: &mut [Lanes]) {
    let rescale = f32x8::splat(s, rescale);
    for ((x, m), out) in x.iter().zip(multipliers).zip(out) {
        Wave::load(s, x).plus(Wave::load(s, &m.prior), rescale).store(out);
    }
}

/// What [`prior_row`] reads.
#[derive(Clone, Copy)]
struct PriorRows<'a, const K: usize> {
    /// x, padded, the first value behind the sensor repeating the last one in it.
    here: [&'a [Lanes]; K],
    /// x in the row below.
    below: [&'a [Lanes]; K],
    /// The filtered image; empty if there is none.
    filtered: &'a [Lanes],
    guide: &'a [Reals],
    edges: &'a [Reals],
    /// Whether this is the sensor's last row.
    last: bool,
}

/// The prior and TV steps on a row, and the right-hand side of the image step but for what crosses the left and right border.
/// `flow` is what came down from the row above, then what goes down from this one.
#[inline(always)]
fn prior_row<S: Simd, const K: usize>(
    s: S,
    rows: PriorRows<'_, K>,
    around: Surroundings<'_>,
    p: Penalties,
    multipliers: &mut [&mut [Multipliers]; K],
    flow: &mut [Vec<Lanes>; 2],
    out: &mut [&mut [Lanes]; K],
) {
    let number = |v: f32| f32x8::splat(s, v);
    let (rescale, prior, gradient) = (number(p.rescale), number(p.prior), number(p.gradient));
    let (zero, tiny) = (number(0.0), number(f32::MIN_POSITIVE));
    let filtered = around.pull != Pull::Positive;
    // What came from the left.
    let mut left = [Wave::zero(s); K];
    for i in 0..flow[0].len() {
        let here: [Wave<S>; K] = std::array::from_fn(|k| Wave::load(s, &rows.here[k][i]));
        let mut input = here;
        for k in 0..K {
            input[k] = here[k].plus(Wave::load(s, &multipliers[k][i].prior), rescale);
        }
        let mut pulled = input;
        let last = &mut pulled[K - 1];
        if filtered {
            *last = Wave::load(s, &rows.filtered[i]);
        }
        match around.pull {
            Pull::Positive | Pull::FilteredPositive => *last = Wave { re: last.re.max(zero), im: zero },
            Pull::Filtered => {
                // DoLP ≤ 1: L·min(1, S0/|L|).
                let length = last.norm_sqr().sqrt().max(tiny);
                *last = last.scale((f32x8::simd_from(s, rows.guide[i]) / length).min(number(1.0)));
            }
            Pull::Cone => {
                // The nearest point of the cone, on its surface unless inside; its tip for all that lies beyond.
                let length = last.norm_sqr().sqrt().max(tiny);
                let s0 = pulled[0].re;
                let middle = ((s0 + length) * 0.5).max(zero);
                let inside = length.simd_le(s0);
                pulled[K - 1] = pulled[K - 1].scale(inside.select(number(1.0), middle / length));
                pulled[0] = Wave { re: inside.select(s0, middle), im: zero };
            }
        }
        for k in 0..K {
            let m = &mut multipliers[k][i];
            let mut threshold = number(around.threshold);
            if filtered && k + 1 == K {
                threshold *= f32x8::simd_from(s, rows.edges[i]);
            }
            let ahead = rows.here[k].get(i + 1).map_or(Wave::zero(s), |v| Wave::load(s, v));
            let below = Wave::load(s, &rows.below[k][i]);
            let ([across, down], [aside, mut onward]) = shrink(s, [here[k], ahead, below], m, rescale, threshold);
            let dual = input[k] - pulled[k];
            dual.store(&mut m.prior);
            across.store(&mut m.across);
            down.store(&mut m.down);
            if rows.last {
                onward = Wave { re: -here[k].re, im: -here[k].im };
            }
            let before = Wave { re: left[k].re.slide::<7>(aside.re), im: left[k].im.slide::<7>(aside.im) };
            let divergence = before - aside + Wave::load(s, &flow[k][i]) - onward;
            left[k] = aside;
            onward.store(&mut flow[k][i]);
            (pulled[k] - dual).scale(prior).plus(divergence, gradient).store(&mut out[k][i]);
        }
    }
}

/// Isotropic shrinkage of v = gradient + u to the right and down, for x `here`, in the next eight columns and below: the new u,
/// and d − u.
#[inline(always)]
fn shrink<S: Simd>(
    s: S,
    [here, ahead, below]: [Wave<S>; 3],
    m: &Multipliers,
    rescale: f32x8<S>,
    threshold: f32x8<S>,
) -> ([Wave<S>; 2], [Wave<S>; 2]) {
    let right = Wave { re: here.re.slide::<1>(ahead.re), im: here.im.slide::<1>(ahead.im) };
    let across = (right - here).plus(Wave::load(s, &m.across), rescale);
    let down = (below - here).plus(Wave::load(s, &m.down), rescale);
    let length = (across.norm_sqr() + down.norm_sqr()).sqrt().max(f32x8::splat(s, f32::MIN_POSITIVE));
    let cut = (threshold / length).min(f32x8::splat(s, 1.0));
    // 1 − cut is kept.
    let rest = f32x8::splat(s, 1.0) - cut - cut;
    ([across.scale(cut), down.scale(cut)], [across.scale(rest), down.scale(rest)])
}

/// What flows down from a row.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "an inlined loop body")]
fn flow_row<S: Simd>(
    s: S,
    here: &[Lanes],
    below: &[Lanes],
    multipliers: &[Multipliers],
    edges: Option<&[Reals]>,
    threshold: f32,
    rescale: f32,
    flow: &mut [Lanes],
) {
    for (i, (flow, m)) in flow.iter_mut().zip(multipliers).enumerate() {
        let ahead = here.get(i + 1).map_or(Wave::zero(s), |v| Wave::load(s, v));
        let x = [Wave::load(s, &here[i]), ahead, Wave::load(s, &below[i])];
        let mut threshold = f32x8::splat(s, threshold);
        if let Some(edges) = edges {
            threshold *= f32x8::simd_from(s, edges[i]);
        }
        shrink(s, x, m, f32x8::splat(s, rescale), threshold).1[1].store(flow);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::optics::lanes::{collect, spread};
    use crate::optics::{FftBackend, Reach};
    use crate::parallel::Workers;

    const SIZE: Size = Size::new(21, 19);
    const P: Penalties = Penalties { blur: 0.3, prior: 0.7, gradient: 0.2, rescale: 1.3 };
    const THRESHOLD: f32 = 0.4;

    fn noise(n: usize, seed: u32) -> Vec<f32> {
        let mut s = seed;
        let mut next = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32 - 0.5
        };
        (0..n).map(|_| next()).collect()
    }

    fn complex(seed: u32) -> Vec<Complex32> {
        noise(2 * SIZE.pixels(), seed).chunks(2).map(|v| Complex32::new(v[0], v[1])).collect()
    }

    /// An unknown image's state, pixel by pixel: x, k * x, u of ν, and the multipliers of z = x and of the gradient.
    struct State {
        x: Vec<Complex32>,
        blurred: Vec<Complex32>,
        dual: Vec<Complex32>,
        prior: Vec<Complex32>,
        gradient: [Vec<Complex32>; 2],
    }

    impl State {
        fn random(seed: u32) -> Self {
            let mut gradient = [complex(seed + 4), complex(seed + 5)];
            // A difference that leaves the sensor has no multiplier.
            for (i, (across, down)) in {
                let [a, b] = &mut gradient;
                a.iter_mut().zip(b).enumerate()
            } {
                if i % SIZE.width + 1 == SIZE.width {
                    *across = Complex32::ZERO;
                }
                if i / SIZE.width + 1 == SIZE.height {
                    *down = Complex32::ZERO;
                }
            }
            Self {
                x: complex(seed),
                blurred: complex(seed + 1),
                dual: complex(seed + 2),
                prior: complex(seed + 3),
                gradient,
            }
        }

        fn field(&self, c: &Convolver) -> Field {
            let mut field = Field::new(c, false);
            let (lanes, mut fft, share) =
                (SIZE.width.div_ceil(LANES), c.row_fft().make_scratch(), 1.0 / c.padded().width as f32);
            for y in 0..SIZE.height {
                let part = y * SIZE.width..(y + 1) * SIZE.width;
                for (image, rows) in [(&self.x, &mut field.image), (&self.blurred, &mut field.blurred)] {
                    let scaled: Vec<_> = image[part.clone()].iter().map(|v| v * share).collect();
                    let row = &mut rows[y * c.row_lanes()..][..c.row_lanes()];
                    spread(&scaled, row);
                    c.row_fft().line(Way::Forward, row, &mut fft);
                }
                spread(&self.dual[part], &mut field.blur_dual[y * lanes..][..lanes]);
                for x in 0..SIZE.width {
                    let (i, m) = (y * SIZE.width + x, &mut field.multipliers[y * lanes + x / LANES]);
                    m.prior.set(x % LANES, self.prior[i]);
                    m.across.set(x % LANES, self.gradient[0][i]);
                    m.down.set(x % LANES, self.gradient[1][i]);
                }
            }
            field
        }

        fn input(&self, i: usize) -> Complex32 {
            self.x[i] + self.prior[i] * P.rescale
        }

        /// What flows right and down from a pixel of the sensor.
        fn flow(&self, i: usize, threshold: f32) -> [Complex32; 2] {
            let (right, below) = (i % SIZE.width + 1 < SIZE.width, i / SIZE.width + 1 < SIZE.height);
            let v = [(right, 1), (below, SIZE.width)]
                .map(|(inside, step)| if inside { self.x[i + step] - self.x[i] } else { Complex32::ZERO });
            let v = [v[0] + self.gradient[0][i] * P.rescale, v[1] + self.gradient[1][i] * P.rescale];
            let length = (v[0].norm_sqr() + v[1].norm_sqr()).sqrt();
            let keep = if length > threshold { 1.0 - threshold / length } else { 0.0 };
            let flow = v.map(|v| v * (2.0 * keep - 1.0));
            [if right { flow[0] } else { -self.x[i] }, if below { flow[1] } else { -self.x[i] }]
        }

        /// The right-hand side at any row and column of the padded circle, counted from the sensor's first.
        fn right_hand_side(
            &self,
            y: isize,
            x: isize,
            pulled: &[Complex32],
            threshold: impl Fn(usize) -> f32,
        ) -> Complex32 {
            let index = |y: isize, x: isize| {
                let inside = (0..SIZE.height as isize).contains(&y) && (0..SIZE.width as isize).contains(&x);
                inside.then(|| y as usize * SIZE.width + x as usize)
            };
            let flow = |y: isize, x: isize, axis: usize| match index(y, x) {
                Some(i) => self.flow(i, threshold(i))[axis],
                // A difference into the sensor is what it is.
                None => index(y + axis as isize, x + 1 - axis as isize).map_or(Complex32::ZERO, |i| self.x[i]),
            };
            let divergence = flow(y, x - 1, 0) - flow(y, x, 0) + flow(y - 1, x, 1) - flow(y, x, 1);
            let prior = index(y, x).map_or(Complex32::ZERO, |i| pulled[i] * 2.0 - self.input(i));
            prior * P.prior + divergence * P.gradient
        }
    }

    fn naive_pull(pull: Pull, s0: f32, l: Complex32, guide: f32) -> (f32, Complex32) {
        let length = l.norm();
        match pull {
            Pull::Positive | Pull::FilteredPositive => (s0, Complex32::from(l.re.max(0.0))),
            Pull::Filtered => (s0, if length <= guide { l } else { l * (guide / length) }),
            Pull::Cone if length <= s0 => (s0, l),
            Pull::Cone if length <= -s0 => (0.0, Complex32::ZERO),
            Pull::Cone => (0.5 * (s0 + length), l * (0.5 * (s0 + length) / length)),
        }
    }

    /// Both fields' right-hand sides, data steps and energies against the definitions, for all priors and numbers of threads.
    #[test]
    fn the_row_steps_follow_their_definitions() {
        let n = SIZE.pixels();
        let (target, guide) = (noise(n, 11), noise(n, 12).iter().map(|v| v + 0.6).collect::<Vec<_>>());
        let edges: Vec<f32> = noise(n, 13).iter().map(|v| v + 0.6).collect();
        let weight: Vec<f32> = (0..n).map(|i| f32::from(i % 7 != 0)).collect();
        let responses = [noise(n, 14).into_iter().map(Complex32::from).collect(), complex(15)];
        for pull in [Pull::Positive, Pull::FilteredPositive, Pull::Filtered, Pull::Cone] {
            for threads in [1, 2, 3, 7, 30] {
                let reach = Reach { rows: (3, 3), columns: (4, 4) };
                let c = Convolver::new(SIZE, reach, FftBackend::Batched, Arc::new(Workers::new(threads))).unwrap();
                let states = [State::random(20), State::random(30)];
                let mut fields = states.each_ref().map(|s| s.field(&c));
                let mut streams: Vec<_> = (0..threads).map(|_| Stream::new(SIZE.width)).collect();
                let (mut bands, mut energies) = (Band::for_threads(&c), vec![f32::NAN; SIZE.height]);
                let mut filter = GuidedFilter::new(SIZE);
                filter.set_guide(&guide, 4, 0.01, c.workers(), &mut streams);
                let row = |y: usize| y * SIZE.width..(y + 1) * SIZE.width;

                let input: Vec<_> = (0..n).map(|i| states[1].input(i)).collect();
                let mut filtered = vec![Complex32::ZERO; n];
                if pull == Pull::Positive {
                    filtered.copy_from_slice(&input);
                } else {
                    let out = Shared::new(&mut filtered);
                    let load = |y: usize, line: &mut [Lanes]| spread(&input[row(y)], line);
                    // SAFETY: each row is stored once.
                    #[allow(unsafe_code)]
                    let store = |y: usize, line: &[Lanes]| collect(line, unsafe { out.slice(row(y)) });
                    filter.run(&guide, c.workers(), &mut streams, load, store);
                }
                let around = Surroundings {
                    convolver: &c,
                    target: &target,
                    weight: &weight,
                    filter: &filter,
                    guide: &guide,
                    edges: &edges,
                    pull,
                    threshold: THRESHOLD,
                };
                let response = |k: usize, y: usize, line: &mut [Lanes]| spread(&responses[k][row(y)], line);
                let [a, b] = &mut fields;
                row_steps([a, b], around, P, response, (&mut bands, &mut streams), &mut energies);

                let pulled: Vec<_> =
                    (0..n).map(|i| naive_pull(pull, states[0].input(i).re, filtered[i], guide[i])).collect();
                let mut fft = c.row_fft().make_scratch();
                let Size { width: pw, .. } = c.padded();
                for (k, (state, field)) in states.iter().zip(&mut fields).enumerate() {
                    let pulled: Vec<_> = (0..n)
                        .map(|i| match (k, pull) {
                            (1, _) => pulled[i].1,
                            (_, Pull::Cone) => Complex32::from(pulled[i].0),
                            _ => state.input(i),
                        })
                        .collect();
                    let threshold =
                        |i: usize| if k == 1 && pull != Pull::Positive { THRESHOLD * edges[i] } else { THRESHOLD };
                    for (y, line) in field.image.chunks_exact_mut(c.row_lanes()).enumerate() {
                        c.row_fft().line(Way::Inverse, line, &mut fft);
                        let y = if y == SIZE.height + 1 { -1 } else { y as isize };
                        for x in 0..pw {
                            let want =
                                state.right_hand_side(y, if x + 1 == pw { -1 } else { x as isize }, &pulled, threshold);
                            let got = at(line, x) / pw as f32;
                            assert!((want - got).norm() < 1e-4, "{pull:?} {threads} {k} {y} {x}: {want} {got}");
                        }
                    }
                    for (y, line) in field.blurred.chunks_exact_mut(c.row_lanes()).enumerate() {
                        c.row_fft().line(Way::Inverse, line, &mut fft);
                        let mut energy = 0.0;
                        for x in 0..pw {
                            let got = at(line, x) / pw as f32;
                            if x >= SIZE.width {
                                assert!(got.norm() < 1e-5);
                                continue;
                            }
                            let i = y * SIZE.width + x;
                            let sum = |f: &dyn Fn(usize) -> f32| f(0) + f(1);
                            let r =
                                weight[i] * (target[i] - sum(&|k| (responses[k][i].conj() * states[k].blurred[i]).re));
                            energy += r * r;
                            let dual = sum(&|k| (responses[k][i].conj() * states[k].dual[i]).re);
                            let d = responses[k][i]
                                * ((r - weight[i] * dual) / (sum(&|k| responses[k][i].norm_sqr()) + P.blur));
                            assert!((state.dual[i] + d * 2.0 - got).norm() < 1e-4, "{pull:?} {threads} {k} {y} {x}");
                            assert!((at(&field.blur_dual[y * SIZE.width.div_ceil(LANES)..], x) + d).norm() < 1e-4);
                        }
                        assert!((energy - energies[y]).abs() < 1e-4);
                    }
                }
            }
        }
    }

    /// What is shown and where the state is after an image step, and ahead of it.
    #[test]
    fn ahead_of_the_image_step_lies_more_of_it() {
        let reach = Reach { rows: (3, 3), columns: (4, 4) };
        let c = Convolver::new(SIZE, reach, FftBackend::Batched, Arc::new(Workers::new(1))).unwrap();
        let mut psf = vec![0.0; SIZE.pixels()];
        let middle = SIZE.height / 2 * SIZE.width + SIZE.width / 2;
        (psf[middle], psf[middle - 3], psf[middle + 2 * SIZE.width]) = (0.5, 0.2, 0.3);
        let kernel = c.kernel(&psf, SIZE);
        let (laplacian, x) = (Laplacian::new(c.padded()), complex(40));
        let (mut bands, mut scratch) = (Band::for_threads(&c), c.make_scratch());
        let mut run = |ahead: Option<Ahead>| {
            let mut field = Field::new(&c, false);
            field.start(&x, &c, &kernel, &mut bands, &mut scratch);
            if let Some(ahead) = ahead {
                field.solve(P, ahead, &laplacian, &c, &kernel, &mut scratch);
            }
            let lines = |field: &Field, band: &mut Band, blurred: bool| {
                let mut out = vec![Complex32::ZERO; SIZE.pixels()];
                let store = |y: usize, line: &[Lanes]| collect(line, &mut out[y * SIZE.width..(y + 1) * SIZE.width]);
                if blurred {
                    field.blurred_rows(&c, band, store);
                } else {
                    field.rows(&c, band, store);
                }
                out
            };
            let shown = lines(&field, &mut bands[0], false);
            // x of the state, once nothing is added to it
            field.image.fill(Lanes::ZERO);
            let blurred = lines(&field, &mut bands[0], true);
            field.resume(&vec![Complex32::ZERO; SIZE.pixels()], &c, &kernel, &mut bands, &mut scratch);
            [shown, blurred, lines(&field, &mut bands[0], false)]
        };
        let [[before, blurred_before, _], step] = [run(None), run(Some(Ahead::NONE))];
        let further = |from: &[Complex32], to: &[Complex32]| -> Vec<Complex32> {
            from.iter().zip(to).map(|(from, to)| to + (to - from) * 2.5).collect()
        };
        let ahead = further(&before, &step[0]);
        assert!(ahead.iter().zip(&step[0]).any(|(a, b)| (a - b).norm() > 0.1));
        for (what, got, want) in [
            ("shown", run(Some(Ahead::Shown(2.5))), [ahead.clone(), step[1].clone(), step[2].clone()]),
            ("leap", run(Some(Ahead::Leap(2.5))), [ahead.clone(), further(&blurred_before, &step[1]), ahead]),
        ] {
            for (part, (got, want)) in got.iter().zip(&want).enumerate() {
                for (i, (got, want)) in got.iter().zip(want).enumerate() {
                    assert!((got - want).norm() < 1e-4, "{what} {part} {i}: {got} {want}");
                }
            }
        }
    }
}
