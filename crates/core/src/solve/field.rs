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
//! it lies in the cache (`field/rows.rs`). Over columns: FFT, image step, inverse FFT ([`Field::solve`]). Between the two passes
//! an image consists of transformed rows.

mod rows;

pub(super) use rows::{Band, Pull, Surroundings, row_steps};

use fearless_simd::prelude::*;
use fearless_simd::{Level, f32x8};
use num_complex::Complex32;

use super::guided_filter::Reals;
use crate::image::Size;
use crate::optics::lanes::{LANES, Lanes, Wave, spread, vectorize};
use crate::optics::{Convolver, Kernel, Scratch, Way};
use crate::parallel::Shared;

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

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::optics::lanes::collect;
    use crate::optics::{FftBackend, Reach};
    use crate::parallel::Workers;

    pub(super) const SIZE: Size = Size::new(21, 19);
    pub(super) const P: Penalties = Penalties { blur: 0.3, prior: 0.7, gradient: 0.2, rescale: 1.3 };

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
