//! State of the ADMM for one unknown image.

use fearless_simd::prelude::*;
use fearless_simd::{Level, f32x8};
use num_complex::Complex32;

use super::buffers::RowBuffers;
use crate::image::Size;
use crate::optics::lanes::{LANES, Lanes, Wave, spread, vectorize};
use crate::optics::{Convolver, Direction, Kernel, Scratch};

/// Scaled multipliers of z = x and of the two parts of d = ∇x, at eight pixels.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Multipliers {
    pub(super) prior: Lanes,
    pub(super) across: Lanes,
    pub(super) down: Lanes,
}

/// An unknown image and all its multipliers: everything that the next iteration, or the next frame of a video, goes on from.
///
/// The image is held as F(x), with its values around the frame. Multipliers that meet another x there take many iterations to settle.
#[derive(Debug)]
pub(in crate::solve) struct State {
    /// F(x), eight columns after eight columns.
    pub(super) spectrum: Vec<Lanes>,
    /// u of ν = k * x, in rows of the frame filled up to whole lanes.
    pub(super) blur_dual: Vec<Lanes>,
    pub(super) multipliers: Vec<Multipliers>,
}

impl State {
    /// Zeros. Allocates.
    pub(in crate::solve) fn new(c: &Convolver) -> Self {
        let n = c.size().width.div_ceil(LANES) * c.size().height;
        let spectrum = vec![Lanes::ZERO; c.padded().height * c.row_lanes()];
        Self { spectrum, blur_dual: vec![Lanes::ZERO; n], multipliers: vec![Multipliers::default(); n] }
    }

    /// Bytes of one.
    pub(in crate::solve) fn bytes(c: &Convolver) -> usize {
        let pixels = c.size().width.div_ceil(LANES) * c.size().height;
        (pixels + c.padded().height * c.row_lanes()) * size_of::<Lanes>() + pixels * size_of::<Multipliers>()
    }

    /// Keeps a share of the multipliers of prior and total variation, and none of those of ν = k * x, which hold the noise of readings.
    pub(in crate::solve) fn fade(&mut self, share: f32) {
        self.blur_dual.fill(Lanes::ZERO);
        let fade = |lanes: &mut Lanes| lanes.re.iter_mut().chain(&mut lanes.im).for_each(|v| *v *= share);
        for Multipliers { prior, across, down } in &mut self.multipliers {
            [prior, across, down].into_iter().for_each(fade);
        }
    }
}

/// One complex unknown image (L, or S0 as its real part) in the course of the iterations.
#[derive(Debug)]
pub(in crate::solve) struct Iterate {
    pub(in crate::solve) state: State,
    /// x; between the row pass and the image step the right-hand side of the latter. Transformed padded rows of
    /// [`Convolver::coupled_rows`].
    pub(super) image: Vec<Lanes>,
    /// k * x; between the row pass and the image step ν − u − k * x. Transformed padded rows; empty while [`Scratch`] has them.
    pub(super) blurred: Vec<Lanes>,
}

impl Iterate {
    /// Zeros. `borrows` leaves the memory of k * x to the [`Scratch`]. Allocates.
    pub(in crate::solve) fn new(c: &Convolver, borrows: bool) -> Self {
        let rows = |n: usize| vec![Lanes::ZERO; n * c.row_lanes()];
        let blurred = rows(if borrows { 0 } else { c.size().height });
        Self { state: State::new(c), image: rows(c.coupled_rows()), blurred }
    }

    /// Bytes of one.
    pub(in crate::solve) fn bytes(c: &Convolver, borrows: bool) -> usize {
        let rows = c.coupled_rows() + if borrows { 0 } else { c.size().height };
        State::bytes(c) + rows * c.row_lanes() * size_of::<Lanes>()
    }

    /// Takes the memory of k * x from `scratch`, unless it is here.
    fn borrow(&mut self, scratch: &mut Scratch) {
        if self.blurred.is_empty() {
            self.blurred = scratch.lend();
        }
    }

    /// Returns the memory of k * x to `scratch`, if it was borrowed from there.
    pub(in crate::solve) fn give_back(&mut self, scratch: &mut Scratch) {
        if !self.blurred.is_empty() {
            scratch.give_back(std::mem::take(&mut self.blurred));
        }
    }

    /// x = `image` (`[H, W]`) with multipliers of zero.
    pub(in crate::solve) fn start(
        &mut self,
        image: &[Complex32],
        c: &Convolver,
        kernel: &Kernel,
        buffers: &mut [RowBuffers],
        scratch: &mut Scratch,
    ) {
        self.state.spectrum.fill(Lanes::ZERO);
        self.state.blur_dual.fill(Lanes::ZERO);
        self.state.multipliers.fill(Multipliers::default());
        self.resume(image, c, kernel, buffers, scratch);
    }

    /// Adds `image` (`[H, W]`) to x and makes k * x. The multipliers stay.
    pub(in crate::solve) fn resume(
        &mut self,
        image: &[Complex32],
        c: &Convolver,
        kernel: &Kernel,
        buffers: &mut [RowBuffers],
        scratch: &mut Scratch,
    ) {
        self.borrow(scratch);
        let (Size { width, height }, workers) = (c.size(), c.workers());
        self.blurred.fill(Lanes::ZERO);
        let (frame, around) = self.image.split_at_mut(height * c.row_lanes());
        around.fill(Lanes::ZERO);
        let (rows, buffers) = (workers.bands_mut(frame, height), workers.each_mut(buffers));
        workers.run(workers.threads(), &|task| {
            let fft = &mut buffers.take(task).fft;
            for (y, row) in rows.take_rows(task) {
                spread(&image[y * width..(y + 1) * width], row);
                c.row_fft().line(Direction::Forward, row, fft);
            }
        });
        self.add_image(c, kernel, scratch);
    }

    /// Adds the image to the state's F(x); makes x and k * x of the sum.
    fn add_image(&mut self, c: &Convolver, kernel: &Kernel, scratch: &mut Scratch) {
        let (ph, share) = (c.padded().height, 1.0 / c.padded().pixels() as f32);
        let kernel = kernel.spectrum();
        let mix = |block: usize, a: &mut [Lanes], b: &mut [Lanes], x: &mut [Lanes]| {
            let kernel = &kernel[block * ph..][..ph];
            vectorize!(Level::new(), s => add(s, a, b, x, kernel, share));
        };
        c.couple_columns(&mut self.blurred, &mut self.image, &mut self.state.spectrum, mix, scratch);
    }

    /// Calls `store(y, row)` with each row of x, from top to bottom.
    pub(in crate::solve) fn rows(&self, c: &Convolver, buffers: &mut RowBuffers, store: impl FnMut(usize, &[Lanes])) {
        Self::rows_of(&self.image, c, buffers, store);
    }

    /// Calls `store(y, row)` with each row of k * x, from top to bottom. Only after [`Self::resume`].
    pub(in crate::solve) fn blurred_rows(
        &self,
        c: &Convolver,
        buffers: &mut RowBuffers,
        store: impl FnMut(usize, &[Lanes]),
    ) {
        Self::rows_of(&self.blurred, c, buffers, store);
    }

    fn rows_of(image: &[Lanes], c: &Convolver, buffers: &mut RowBuffers, mut store: impl FnMut(usize, &[Lanes])) {
        let RowBuffers { next: [line, _], fft, .. } = buffers;
        for (y, row) in image.chunks_exact(c.row_lanes()).take(c.size().height).enumerate() {
            line.copy_from_slice(row);
            c.row_fft().line(Direction::Adjoint, line, fft);
            store(y, line);
        }
    }
}

/// x with b added to it; k * x in `a` and x in `b` for the inverse transform.
#[inline(always)]
fn add<S: Simd>(s: S, a: &mut [Lanes], b: &mut [Lanes], x: &mut [Lanes], kernel: &[Lanes], share: f32) {
    for ((a, b), (x, k)) in a.iter_mut().zip(b).zip(x.iter_mut().zip(kernel)) {
        let sum = Wave::load(s, b).plus(Wave::load(s, x), f32x8::splat(s, 1.0));
        sum.store(x);
        (sum * Wave::load(s, k)).store(a);
        sum.scale(f32x8::splat(s, share)).store(b);
    }
}
