//! Linear convolution with a PSF, cropped to the sensor: the one operation all solvers are made of.
//!
//! Padding: with the PSF's displacements in [d₋, d₊] only outputs inside the sensor count, so what wraps around may fall
//! anywhere outside of it and N + max(d₊, −d₋) padded samples suffice (250 px and a support of 110: 305, not 359 or 500).
//!
//! Order of work: FFT of the rows that hold data (the padding rows are zero), then for a few columns at a time FFT ×
//! spectrum × inverse FFT while they lie in cache, then inverse FFT of the rows that are kept. The full spectrum is never
//! stored. Everything is complex: a kernel is real, so two real images travel as real and imaginary part of one.

use std::ops::Range;
use std::sync::Arc;

use num_complex::Complex32;

use super::fft::{FftBackend, LineFft};
use crate::parallel::{Shared, Workers};
use crate::plane::Size;

/// Columns transformed together: one cache line of `Complex32`.
const COLUMNS: usize = 8;
/// Rows a task takes at a time.
const ROWS: usize = 8;

/// The largest displacements of a kernel: `before` up or left, `after` down or right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reach {
    /// Rows: (up, down).
    pub rows: (usize, usize),
    /// Columns: (left, right).
    pub columns: (usize, usize),
}

/// No backend can transform a line as long as needed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{backend:?} cannot transform {needed} samples; the padded frame is too large for it")]
pub struct LengthError {
    /// The backend asked.
    pub backend: FftBackend,
    /// Padded samples needed.
    pub needed: usize,
}

/// A planned convolution for one sensor size and reach.
#[derive(Clone)]
pub struct Convolver {
    size: Size,
    padded: Size,
    row: Arc<dyn LineFft>,
    column: Arc<dyn LineFft>,
    workers: Arc<Workers>,
}

/// A kernel's spectrum, column after column, scaled so that forward and inverse FFT need no factor.
#[derive(Clone, Debug)]
pub struct Kernel {
    spectrum: Vec<Complex32>,
}

impl Kernel {
    /// The spectrum, column after column: `padded.width` lines of `padded.height` values, times 1/(padded pixels).
    pub fn spectrum(&self) -> &[Complex32] {
        &self.spectrum
    }

    /// ‖k‖₂ of the kernel (Parseval).
    pub fn l2_norm(&self) -> f32 {
        let energy: f64 = self.spectrum.iter().map(|v| f64::from(v.norm_sqr())).sum();
        (energy * self.spectrum.len() as f64).sqrt() as f32
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        size_of_val(self.spectrum.as_slice())
    }
}

/// Buffers of one convolution at a time. Garbage between calls.
#[derive(Debug)]
pub struct Scratch {
    rows: Vec<Complex32>,
    /// One set of columns and FFT scratch for each thread's current task.
    lines: Vec<Complex32>,
    transforms: usize,
}

impl Scratch {
    /// Complex 2-D FFTs of the padded size that were done with this scratch: the unit in which solvers are compared.
    pub fn transforms(&self) -> usize {
        self.transforms
    }
}

/// Convolution with the kernel, or with its mirror image (the adjoint).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// k * x
    Forward,
    /// k̃ * x with k̃(d) = k(−d), the transpose of the forward convolution with crop.
    Adjoint,
}

impl std::fmt::Debug for Convolver {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Convolver({} in {})", self.size, self.padded)
    }
}

impl Convolver {
    /// Plans convolutions of frames of `size` with kernels of at most `reach`. Allocates FFT tables.
    ///
    /// # Errors
    /// [`LengthError`] when the backend has no transform long enough.
    pub fn new(size: Size, reach: Reach, backend: FftBackend, workers: Arc<Workers>) -> Result<Self, LengthError> {
        let line = |n: usize, reach: (usize, usize)| {
            // Two more samples at least, so that differences across the border stay outside: see `coupled_rows`.
            let needed = n + reach.0.max(reach.1).max(2);
            let error = LengthError { backend, needed };
            backend.length_at_least(needed).and_then(|len| backend.plan(len)).ok_or(error)
        };
        let row = line(size.width, reach.columns)?;
        let column = line(size.height, reach.rows)?;
        let padded = Size::new(row.line_len(), column.line_len());
        Ok(Self { size, padded, row, column, workers })
    }

    /// Size of the frames.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Size of the FFTs.
    pub fn padded(&self) -> Size {
        self.padded
    }

    /// The threads this convolver uses.
    pub fn workers(&self) -> &Workers {
        &self.workers
    }

    fn line_scratch(&self) -> usize {
        2 * COLUMNS * self.padded.height + self.row.scratch_len().max(self.column.scratch_len())
    }

    /// Bytes of one [`Scratch`].
    pub fn scratch_bytes(&self) -> usize {
        (self.size.height * self.padded.width + self.workers.threads() * self.line_scratch()) * size_of::<Complex32>()
    }

    /// Buffers for [`Self::run`]. Allocates.
    pub fn make_scratch(&self) -> Scratch {
        Scratch {
            rows: vec![Complex32::ZERO; self.size.height * self.padded.width],
            lines: vec![Complex32::ZERO; self.workers.threads() * self.line_scratch()],
            transforms: 0,
        }
    }

    /// The spectrum of a kernel given as `[height, width]` samples with zero displacement at (height/2, width/2) rounded
    /// down. Samples whose displacement exceeds the planned reach are ignored: give the reach of the kernel's support.
    /// Allocates.
    pub fn kernel(&self, samples: &[f32], size: Size) -> Kernel {
        let Size { width: pw, height: ph } = self.padded;
        let mut spectrum = vec![Complex32::ZERO; pw * ph];
        let wrap = |i: usize, centre: usize, n: usize| (i + n - centre % n) % n;
        for (y, row) in samples.chunks_exact(size.width).enumerate() {
            for (x, &v) in row.iter().enumerate().filter(|(_, v)| **v != 0.0) {
                spectrum[wrap(x, size.width / 2, pw) * ph + wrap(y, size.height / 2, ph)].re += v;
            }
        }
        let mut scratch = vec![Complex32::ZERO; self.row.scratch_len().max(self.column.scratch_len())];
        self.column.forward(&mut spectrum, &mut scratch);
        let scale = 1.0 / (pw * ph) as f32;
        let mut line = vec![Complex32::ZERO; pw];
        for y in 0..ph {
            for x in 0..pw {
                line[x] = spectrum[x * ph + y];
            }
            self.row.forward(&mut line, &mut scratch);
            for x in 0..pw {
                spectrum[x * ph + y] = line[x] * scale;
            }
        }
        Kernel { spectrum }
    }

    /// Convolves: `load(y, row)` fills row y of the input (`width` values), `store(y, row, out)` takes row y of the result
    /// and writes its part of `output` (`output.len() / height` values). Rows come in any order, from any thread.
    ///
    /// # Panics
    /// When `scratch` belongs to another plan or `output` is not a whole number of values a row.
    pub fn run<T: Send>(
        &self,
        kernel: &Kernel,
        direction: Direction,
        load: impl Fn(usize, &mut [Complex32]) + Sync,
        output: &mut [T],
        store: impl Fn(usize, &[Complex32], &mut [T]) + Sync,
        scratch: &mut Scratch,
    ) {
        let Size { width, height } = self.size;
        let Size { width: pw, height: ph } = self.padded;
        let out_width = output.len() / height;
        assert_eq!(scratch.rows.len(), height * pw, "scratch of another plan");
        assert_eq!(output.len(), out_width * height, "output is not a whole number of values a row");
        scratch.transforms += 2;
        let tasks = self.workers.threads();
        let line_scratch = self.line_scratch();
        let rows = Shared::new(&mut scratch.rows);
        let lines = Shared::new(&mut scratch.lines);
        let output = Shared::new(output);
        // SAFETY: every task has line buffers of its own.
        #[allow(unsafe_code)]
        let own_lines = |task: usize| unsafe { lines.slice(task * line_scratch..(task + 1) * line_scratch) };

        self.workers.run(tasks, &|task| {
            let fft_scratch = &mut own_lines(task)[2 * COLUMNS * ph..];
            for block in share(task, tasks, height, ROWS) {
                // SAFETY: the blocks of rows are disjoint between tasks.
                #[allow(unsafe_code)]
                let part = unsafe { rows.slice(block.start * pw..block.end * pw) };
                for (y, row) in block.zip(part.chunks_exact_mut(pw)) {
                    load(y, &mut row[..width]);
                    row[width..].fill(Complex32::ZERO);
                }
                self.row.forward(part, fft_scratch);
            }
        });
        self.workers.run(tasks, &|task| {
            let (columns, fft_scratch) = own_lines(task).split_at_mut(2 * COLUMNS * ph);
            for block in share(task, tasks, pw, COLUMNS) {
                let n = block.len();
                let columns = &mut columns[..n * ph];
                gather(&rows, pw, &block, columns, ph, height);
                self.column.forward(columns, fft_scratch);
                let spectrum = &kernel.spectrum[block.start * ph..block.end * ph];
                match direction {
                    Direction::Forward => columns.iter_mut().zip(spectrum).for_each(|(v, k)| *v *= k),
                    Direction::Adjoint => columns.iter_mut().zip(spectrum).for_each(|(v, k)| *v *= k.conj()),
                }
                self.column.inverse(columns, fft_scratch);
                scatter(columns, ph, &rows, pw, &block, height);
            }
        });
        self.workers.run(tasks, &|task| {
            let fft_scratch = &mut own_lines(task)[2 * COLUMNS * ph..];
            for block in share(task, tasks, height, ROWS) {
                // SAFETY: the blocks of rows are disjoint between tasks, in `rows` and in `output`.
                #[allow(unsafe_code)]
                let (part, out) = unsafe {
                    (
                        rows.slice(block.start * pw..block.end * pw),
                        output.slice(block.start * out_width..block.end * out_width),
                    )
                };
                self.row.inverse(part, fft_scratch);
                for (i, y) in block.enumerate() {
                    store(y, &part[i * pw..i * pw + width], &mut out[i * out_width..(i + 1) * out_width]);
                }
            }
        });
    }

    /// Rows of an image that [`Self::couple`] takes: the sensor's, the padded row after them and the last padded row. A
    /// difference operator on the padded circle reaches those two from inside the sensor.
    pub fn coupled_rows(&self) -> usize {
        self.size.height + 2
    }

    /// One frequency-domain step of a splitting method. `a` is an image on the sensor's rows, `b` one on the
    /// [`Self::coupled_rows`], both `padded.width` wide and zero everywhere else; `spectrum` is a state of its own, column
    /// after column. Both images are transformed, `mix(columns, a, b, spectrum)` edits the spectra of some columns (each
    /// `padded.height` values long, unnormalised), and the sensor's rows of both are transformed back.
    ///
    /// # Panics
    /// When a length does not fit the plan.
    pub fn couple(
        &self,
        a: &mut [Complex32],
        b: &mut [Complex32],
        spectrum: &mut [Complex32],
        mix: impl Fn(Range<usize>, &mut [Complex32], &mut [Complex32], &mut [Complex32]) + Sync,
        scratch: &mut Scratch,
    ) {
        let height = self.size.height;
        let Size { width: pw, height: ph } = self.padded;
        let lengths = (a.len(), b.len(), spectrum.len());
        assert_eq!(lengths, (height * pw, (height + 2) * pw, ph * pw), "images of another plan");
        scratch.transforms += 4;
        let tasks = self.workers.threads();
        let line_scratch = self.line_scratch();
        let (a, b, lines) = (Shared::new(a), Shared::new(b), Shared::new(&mut scratch.lines));
        let spectrum = Shared::new(spectrum);
        // SAFETY: every task has line buffers of its own.
        #[allow(unsafe_code)]
        let own_lines = |task: usize| unsafe { lines.slice(task * line_scratch..(task + 1) * line_scratch) };
        let rows = |extra: usize, transform: &(dyn Fn(&mut [Complex32], &mut [Complex32]) + Sync)| {
            self.workers.run(tasks, &|task| {
                let fft_scratch = &mut own_lines(task)[2 * COLUMNS * ph..];
                for (image, total) in [(&a, height), (&b, height + extra)] {
                    for block in share(task, tasks, total, ROWS) {
                        // SAFETY: the blocks of rows are disjoint between tasks.
                        #[allow(unsafe_code)]
                        transform(unsafe { image.slice(block.start * pw..block.end * pw) }, fft_scratch);
                    }
                }
            });
        };
        rows(2, &|lines, scratch| self.row.forward(lines, scratch));
        self.workers.run(tasks, &|task| {
            let (columns, fft_scratch) = own_lines(task).split_at_mut(2 * COLUMNS * ph);
            for block in share(task, tasks, pw, COLUMNS) {
                let (ca, rest) = columns.split_at_mut(block.len() * ph);
                let cb = &mut rest[..block.len() * ph];
                gather(&a, pw, &block, ca, ph, height);
                gather(&b, pw, &block, cb, ph, height + 2);
                for c in cb.chunks_exact_mut(ph) {
                    let last = std::mem::take(&mut c[height + 1]);
                    c[ph - 1] += last;
                }
                self.column.forward(ca, fft_scratch);
                self.column.forward(cb, fft_scratch);
                // SAFETY: the blocks of columns are disjoint between tasks.
                #[allow(unsafe_code)]
                mix(block.clone(), ca, cb, unsafe { spectrum.slice(block.start * ph..block.end * ph) });
                self.column.inverse(ca, fft_scratch);
                self.column.inverse(cb, fft_scratch);
                scatter(ca, ph, &a, pw, &block, height);
                scatter(cb, ph, &b, pw, &block, height);
            }
        });
        rows(0, &|lines, scratch| self.row.inverse(lines, scratch));
    }
}

/// A task's share of `total` rows or columns, in blocks of at most `step`.
fn share(task: usize, tasks: usize, total: usize, step: usize) -> impl Iterator<Item = Range<usize>> {
    let blocks = total.div_ceil(step);
    ((task * blocks / tasks)..((task + 1) * blocks / tasks)).map(move |b| b * step..((b + 1) * step).min(total))
}

/// Copies the columns `block` of the first `height` rows into lines of `len` values, zero below.
#[allow(unsafe_code)]
fn gather(
    rows: &Shared<'_, Complex32>,
    row_len: usize,
    block: &Range<usize>,
    columns: &mut [Complex32],
    len: usize,
    height: usize,
) {
    for y in 0..height {
        // SAFETY: blocks of columns are disjoint between tasks.
        let part = unsafe { rows.slice(y * row_len + block.start..y * row_len + block.end) };
        for (x, v) in part.iter().enumerate() {
            columns[x * len + y] = *v;
        }
    }
    columns.chunks_exact_mut(len).for_each(|c| c[height..].fill(Complex32::ZERO));
}

/// Copies the first `height` values of each line back into the columns `block`.
#[allow(unsafe_code)]
fn scatter(
    columns: &[Complex32],
    len: usize,
    rows: &Shared<'_, Complex32>,
    row_len: usize,
    block: &Range<usize>,
    height: usize,
) {
    for y in 0..height {
        // SAFETY: blocks of columns are disjoint between tasks.
        let part = unsafe { rows.slice(y * row_len + block.start..y * row_len + block.end) };
        for (x, v) in part.iter_mut().enumerate() {
            *v = columns[x * len + y];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, directly, in f64: y(i) = Σ_j k(i − j + centre) x(j), cropped to the frame.
    fn naive(x: &[f32], size: Size, k: &[f32], ksize: Size, mirror: bool) -> Vec<f64> {
        let (cy, cx) = ((ksize.height / 2) as isize, (ksize.width / 2) as isize);
        let mut out = vec![0.0; size.pixels()];
        for (i, o) in out.iter_mut().enumerate() {
            let (iy, ix) = ((i / size.width) as isize, (i % size.width) as isize);
            for (j, v) in x.iter().enumerate() {
                let (jy, jx) = ((j / size.width) as isize, (j % size.width) as isize);
                let (dy, dx) = if mirror { (jy - iy, jx - ix) } else { (iy - jy, ix - jx) };
                let (ky, kx) = (dy + cy, dx + cx);
                if (0..ksize.height as isize).contains(&ky) && (0..ksize.width as isize).contains(&kx) {
                    *o += f64::from(*v) * f64::from(k[ky as usize * ksize.width + kx as usize]);
                }
            }
        }
        out
    }

    fn noise(n: usize, seed: u32) -> Vec<f32> {
        let mut s = seed;
        (0..n)
            .map(|_| {
                s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (s >> 8) as f32 / (1 << 24) as f32
            })
            .collect()
    }

    #[test]
    fn agrees_with_the_direct_sum_for_odd_even_and_lopsided_kernels() {
        for (size, ksize, threads) in [
            (Size::new(13, 9), Size::new(13, 9), 1),
            (Size::new(8, 12), Size::new(5, 4), 2),
            (Size::new(1, 7), Size::new(1, 3), 1),
            (Size::new(30, 17), Size::new(30, 17), 3),
        ] {
            let (x, z) = (noise(size.pixels(), 1), noise(size.pixels(), 2));
            let k = noise(ksize.pixels(), 3);
            let reach = Reach {
                rows: (ksize.height / 2, ksize.height - 1 - ksize.height / 2),
                columns: (ksize.width / 2, ksize.width - 1 - ksize.width / 2),
            };
            for backend in FftBackend::ALL {
                let c = Convolver::new(size, reach, backend, Arc::new(Workers::new(threads))).unwrap();
                let kernel = c.kernel(&k, ksize);
                let mut scratch = c.make_scratch();
                scratch.rows.fill(Complex32::new(f32::NAN, f32::NAN));
                scratch.lines.fill(Complex32::new(f32::NAN, f32::NAN));
                for direction in [Direction::Forward, Direction::Adjoint] {
                    let mut got = vec![Complex32::ZERO; size.pixels()];
                    let load = |y: usize, row: &mut [Complex32]| {
                        for (i, v) in row.iter_mut().enumerate() {
                            *v = Complex32::new(x[y * size.width + i], z[y * size.width + i]);
                        }
                    };
                    c.run(&kernel, direction, load, &mut got, |_, row, out| out.copy_from_slice(row), &mut scratch);
                    let mirror = direction == Direction::Adjoint;
                    let (re, im) = (naive(&x, size, &k, ksize, mirror), naive(&z, size, &k, ksize, mirror));
                    for (g, (re, im)) in got.iter().zip(re.iter().zip(&im)) {
                        let tolerance = 2e-6 * size.pixels() as f64;
                        assert!((f64::from(g.re) - re).abs() < tolerance && (f64::from(g.im) - im).abs() < tolerance);
                    }
                }
            }
        }
    }

    #[test]
    fn a_coupled_step_is_the_convolution_on_the_padded_circle() {
        let (size, threads) = (Size::new(10, 7), 2);
        let reach = Reach { rows: (3, 3), columns: (5, 4) };
        let c = Convolver::new(size, reach, FftBackend::Rustfft, Arc::new(Workers::new(threads))).unwrap();
        let k = noise(size.pixels(), 3);
        let kernel = c.kernel(&k, size);
        let mut scratch = c.make_scratch();
        let (padded, x) = (c.padded(), noise(size.pixels(), 1));
        let pw = padded.width;
        let mut a = vec![Complex32::ZERO; size.height * pw];
        let mut b = vec![Complex32::ZERO; c.coupled_rows() * pw];
        let mut spectrum = vec![Complex32::ZERO; padded.pixels()];
        for (i, v) in x.iter().enumerate() {
            b[i / size.width * pw + i % size.width].re = *v;
        }
        // One value in the row after the sensor, one in the last padded row; both fall outside of the result.
        b[size.height * pw].im = 1.0;
        b[(size.height + 1) * pw + 1].im = -1.0;
        let ph = padded.height;
        let mix = |columns: Range<usize>, a: &mut [Complex32], b: &mut [Complex32], state: &mut [Complex32]| {
            let k = &kernel.spectrum()[columns.start * ph..columns.end * ph];
            state.copy_from_slice(b);
            a.iter_mut().zip(b.iter_mut()).zip(k).for_each(|((a, b), k)| *a = *b * k);
        };
        c.couple(&mut a, &mut b, &mut spectrum, mix, &mut scratch);
        let want = naive(&x, size, &k, size, false);
        for (i, (x, want)) in x.iter().zip(&want).enumerate() {
            let at = i / size.width * pw + i % size.width;
            assert!((f64::from(a[at].re) - want).abs() < 1e-4);
            assert!((b[at] / padded.pixels() as f32 - x).norm() < 1e-5);
        }
        let mean: f32 = x.iter().sum();
        assert!((spectrum[0] - mean).norm() < 1e-3 * mean, "the two outer values cancel in the mean");
    }
}
