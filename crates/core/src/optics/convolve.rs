//! Linear convolution with a PSF on a field, exact in its frame: the one operation all solvers are made of.
//!
//! Padding: with the PSF's displacements in [d₋, d₊] only outputs inside the frame count, so what wraps around may fall
//! anywhere outside of it and N + margin + max(d₊, −d₋) padded samples suffice for a frame of N (250 px and a support of 110: 305, not
//! 359 or 500). With a margin of the PSF's reach that is the field itself (360).
//!
//! Order of work: FFT of the rows that hold data (the padding rows are zero), then for eight columns at a time FFT ×
//! spectrum × inverse FFT while they lie in cache, then inverse FFT of the rows that are kept. Between the passes rows are
//! rows of [`Lanes`], so that eight columns are gathered a cache line at a time and nothing is transposed. Everything is
//! complex: a kernel is real, so two real images travel as real and imaginary part of one.

use std::sync::Arc;

use fearless_simd::prelude::*;
use fearless_simd::{Level, f32x8};
use num_complex::Complex32;

use super::fft::{Direction, Fft, FftBackend, FftScratch};
use super::field::Field;
use super::lanes::{LANES, Lanes, Wave, collect, put, spread, vectorize};
use crate::image::{Buffers, Size};
use crate::parallel::{StridedMut, Workers};

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

/// A planned convolution for one field and reach.
#[derive(Clone)]
pub struct Convolver {
    field: Field,
    size: Size,
    padded: Size,
    row: Arc<dyn Fft>,
    column: Arc<dyn Fft>,
    workers: Arc<Workers>,
}

/// A kernel's spectrum, eight columns after eight columns, scaled so that forward and inverse FFT need no factor.
#[derive(Clone, Debug)]
pub struct Kernel {
    spectrum: Vec<Lanes>,
    /// The sample at zero displacement, where all others are zero: the image of a point behind a lens. A product then needs no FFT.
    point: Option<f32>,
}

impl Kernel {
    /// The spectrum, times 1/(padded pixels): `padded.width / 8` columns of `padded.height` lanes.
    pub fn spectrum(&self) -> &[Lanes] {
        &self.spectrum
    }

    /// Pixels that a point of light fills, for samples k of sum 1: 1/Σk².
    pub fn spread(&self) -> f32 {
        let power: f64 =
            self.spectrum.iter().flat_map(|v| v.re.iter().chain(&v.im)).map(|v| f64::from(*v).powi(2)).sum();
        (1.0 / (power * (self.spectrum.len() * LANES) as f64)) as f32
    }

    /// The kernel whose spectrum is v / (v + |K|²/max|K|²): it keeps of an image what this one shows little of. Allocates.
    ///
    /// # Panics
    /// Unless 0 < `visible`.
    pub fn hidden(&self, visible: f32) -> Self {
        assert!(visible > 0.0, "a filter that keeps nothing");
        let power = |v: &Lanes, i: usize| v.re[i] * v.re[i] + v.im[i] * v.im[i];
        let largest =
            self.spectrum.iter().flat_map(|v| (0..LANES).map(|i| power(v, i))).fold(f32::MIN_POSITIVE, f32::max);
        let scale = 1.0 / (self.spectrum.len() * LANES) as f32;
        let filtered = |v: &Lanes| {
            let keep = |i: usize| scale * visible / (visible + power(v, i) / largest);
            Lanes { re: std::array::from_fn(keep), im: [0.0; LANES] }
        };
        Self { spectrum: self.spectrum.iter().map(filtered).collect(), point: None }
    }

    /// ‖k‖₂ of the kernel (Parseval).
    pub fn l2_norm(&self) -> f32 {
        let square = |v: &f32| f64::from(*v) * f64::from(*v);
        let energy: f64 = self.spectrum.iter().flat_map(|v| v.re.iter().chain(&v.im)).map(square).sum();
        (energy * (self.spectrum.len() * LANES) as f64).sqrt() as f32
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        size_of_val(self.spectrum.as_slice())
    }
}

/// Scratch of one convolution at a time.
#[derive(Debug)]
pub struct Scratch {
    rows: Vec<Lanes>,
    /// One for each thread's current task.
    tasks: Vec<TaskScratch>,
    transforms: usize,
}

#[derive(Debug)]
struct TaskScratch {
    row: FftScratch,
    column: FftScratch,
    line: Vec<Complex32>,
    columns: [Vec<Lanes>; 2],
}

impl Scratch {
    /// Complex 2-D FFTs of the padded size that were done with this scratch: the unit in which solvers are compared.
    pub fn transforms(&self) -> usize {
        self.transforms
    }

    /// Takes out the image on padded rows, `height × padded.width / 8` lanes of any value, until [`Self::give_back`].
    /// [`Convolver::run`] needs it, [`Convolver::couple_columns`] does not.
    pub fn lend(&mut self) -> Vec<Lanes> {
        std::mem::take(&mut self.rows)
    }

    /// Bytes that [`Self::lend`] takes out.
    pub fn lent_bytes(&self) -> usize {
        size_of_val(&self.rows[..])
    }

    /// Returns what was lent.
    pub fn give_back(&mut self, rows: Vec<Lanes>) {
        self.rows = rows;
    }
}

impl std::fmt::Debug for Convolver {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Convolver({} in {})", self.size, self.padded)
    }
}

impl Convolver {
    /// Plans convolutions of images of `field` with kernels of at most `reach`. They are exact in the frame. Allocates FFT tables.
    ///
    /// # Errors
    /// [`LengthError`] when the backend has no transform long enough.
    pub fn new(field: Field, reach: Reach, backend: FftBackend, workers: Arc<Workers>) -> Result<Self, LengthError> {
        let (size, frame, margin) = (field.size(), field.frame(), field.margin());
        let plan = |n: usize, kept: usize, reach: (usize, usize), length: fn(FftBackend, usize) -> Option<usize>| {
            // Two more samples than the field at least, so that differences across its border stay outside: see `coupled_rows`.
            let needed = (kept + reach.0.max(reach.1)).max(n + 2);
            length(backend, needed).and_then(|len| backend.plan(len)).ok_or(LengthError { backend, needed })
        };
        let row = plan(size.width, frame.width + margin.columns, reach.columns, FftBackend::line_length)?;
        let column = plan(size.height, frame.height + margin.rows, reach.rows, FftBackend::batch_length)?;
        let padded = Size::new(row.line_len(), column.line_len());
        Ok(Self { field, size, padded, row, column, workers })
    }

    /// These convolutions on other threads.
    pub fn on(&self, workers: Arc<Workers>) -> Self {
        Self { workers, ..self.clone() }
    }

    /// The field.
    pub fn field(&self) -> Field {
        self.field
    }

    /// Size of the field.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Size of the FFTs.
    pub fn padded(&self) -> Size {
        self.padded
    }

    /// Lanes of a padded row.
    pub fn row_lanes(&self) -> usize {
        self.padded.width / LANES
    }

    /// The threads this convolver uses.
    pub fn workers(&self) -> &Arc<Workers> {
        &self.workers
    }

    /// The transform of padded rows.
    pub fn row_fft(&self) -> &dyn Fft {
        &*self.row
    }

    fn task_scratch(&self, buffers: &mut Buffers) -> TaskScratch {
        TaskScratch {
            row: self.row.scratch(buffers),
            column: self.column.scratch(buffers),
            line: buffers.filled(Complex32::ZERO, self.size.width),
            columns: [0, 1].map(|_| buffers.filled(Lanes::ZERO, self.padded.height)),
        }
    }

    /// Buffers for [`Self::run`].
    pub fn scratch(&self, buffers: &mut Buffers) -> Scratch {
        Scratch {
            rows: buffers.filled(Lanes::ZERO, self.size.height * self.row_lanes()),
            tasks: (0..self.workers.threads()).map(|_| self.task_scratch(buffers)).collect(),
            transforms: 0,
        }
    }

    /// Bytes of one [`Scratch`].
    pub fn scratch_bytes(&self) -> usize {
        Buffers::bytes(|buffers| self.scratch(buffers))
    }

    /// Buffers for [`Self::run`]. Allocates.
    pub fn make_scratch(&self) -> Scratch {
        Buffers::allocate(|buffers| self.scratch(buffers))
    }

    /// The spectrum of a kernel given as `[height, width]` samples with zero displacement at (height/2, width/2) rounded
    /// down. Samples whose displacement exceeds what the padding has room for, the planned reach or a little more, are ignored. Allocates.
    pub fn kernel(&self, samples: &[f32], size: Size) -> Kernel {
        let (Size { width: pw, height: ph }, blocks) = (self.padded, self.row_lanes());
        let mut rows = vec![Lanes::ZERO; ph * blocks];
        let wrap = |i: usize, centre: usize, n: usize| (i + n - centre % n) % n;
        let within = |i: usize, centre: usize, room: usize| i.abs_diff(centre) <= room;
        let (frame, margin) = (self.field.frame(), self.field.margin());
        let (up, across) = (ph - frame.height - margin.rows, pw - frame.width - margin.columns);
        let lines = samples.chunks_exact(size.width).enumerate().filter(|(y, _)| within(*y, size.height / 2, up));
        for (y, row) in lines {
            let line = &mut rows[wrap(y, size.height / 2, ph) * blocks..][..blocks];
            for (x, &v) in row.iter().enumerate().filter(|(x, v)| **v != 0.0 && within(*x, size.width / 2, across)) {
                let x = wrap(x, size.width / 2, pw);
                let sum = line[x / LANES].re[x % LANES] + v;
                put(line, x, Complex32::from(sum));
            }
        }
        let TaskScratch { mut row, mut column, .. } = Buffers::allocate(|buffers| self.task_scratch(buffers));
        rows.chunks_exact_mut(blocks).for_each(|line| self.row.line(Direction::Forward, line, &mut row));
        let mut spectrum = vec![Lanes::ZERO; ph * blocks];
        let scale = 1.0 / (pw * ph) as f32;
        for (block, columns) in spectrum.chunks_exact_mut(ph).enumerate() {
            columns.iter_mut().zip(rows.chunks_exact(blocks)).for_each(|(v, row)| *v = row[block]);
            self.column.batch(Direction::Forward, columns, &mut column);
            columns.iter_mut().flat_map(|v| v.re.iter_mut().chain(&mut v.im)).for_each(|v| *v *= scale);
        }
        let (centre, lit) =
            (size.height / 2 * size.width + size.width / 2, samples.iter().filter(|v| **v != 0.0).count());
        let point = (lit == 1 && samples[centre] != 0.0).then(|| samples[centre]);
        Kernel { spectrum, point }
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
        self.convolve((kernel, direction), Beyond::Dark, load, output, store, scratch);
    }

    /// As [`Self::run`] forward, with the image mirrored at its borders, so that a filter treats pixels there like others.
    ///
    /// # Panics
    /// As [`Self::run`].
    pub fn filter<T: Send>(
        &self,
        kernel: &Kernel,
        load: impl Fn(usize, &mut [Complex32]) + Sync,
        output: &mut [T],
        store: impl Fn(usize, &[Complex32], &mut [T]) + Sync,
        scratch: &mut Scratch,
    ) {
        self.convolve((kernel, Direction::Forward), Beyond::Mirrored, load, output, store, scratch);
    }

    fn convolve<T: Send>(
        &self,
        (kernel, direction): (&Kernel, Direction),
        beyond: Beyond,
        load: impl Fn(usize, &mut [Complex32]) + Sync,
        output: &mut [T],
        store: impl Fn(usize, &[Complex32], &mut [T]) + Sync,
        scratch: &mut Scratch,
    ) {
        let (height, blocks, ph) = (self.size.height, self.row_lanes(), self.padded.height);
        let out_width = output.len() / height;
        assert_eq!(scratch.rows.len(), height * blocks, "scratch of another plan");
        assert_eq!(output.len(), out_width * height, "output is not a whole number of values a row");
        let (workers, tasks) = (&self.workers, self.workers.threads());
        if let Some(weight) = kernel.point {
            let (output, own) = (workers.bands_mut(output, height), workers.each_mut(&mut scratch.tasks));
            return workers.run(tasks, &|task| {
                let line = &mut own.take(task).line;
                for (y, out) in output.take_rows(task) {
                    load(y, line);
                    line.iter_mut().for_each(|v| *v *= weight);
                    store(y, line, out);
                }
            });
        }
        scratch.transforms += 2;
        let Scratch { rows: image, tasks: buffers, .. } = scratch;

        let (rows, own) = (workers.bands_mut(image, height), workers.each_mut(buffers));
        workers.run(tasks, &|task| {
            let TaskScratch { row: fft, line, .. } = own.take(task);
            for (y, row) in rows.take_rows(task) {
                load(y, line);
                spread(line, row);
                for (x, end, start, share) in beyond.mirrors(line.len(), self.padded.width) {
                    put(row, x, line[end] * (1.0 - share) + line[start] * share);
                }
                self.row.line(Direction::Forward, row, fft);
            }
        });
        let (columns, own) = (workers.strided_bands_mut(image, height, blocks), workers.each_mut(buffers));
        workers.run(tasks, &|task| {
            let TaskScratch { column: fft, columns: [eight, _], .. } = own.take(task);
            let mut columns = columns.take(task);
            for (at, block) in workers.band(task, blocks).enumerate() {
                gather(&columns, at, eight, height);
                for (y, end, start, share) in beyond.mirrors(height, ph) {
                    let mixed = |a: f32, b: f32| a * (1.0 - share) + b * share;
                    eight[y] = Lanes {
                        re: std::array::from_fn(|i| mixed(eight[end].re[i], eight[start].re[i])),
                        im: std::array::from_fn(|i| mixed(eight[end].im[i], eight[start].im[i])),
                    };
                }
                self.column.batch(Direction::Forward, eight, fft);
                let spectrum = &kernel.spectrum[block * ph..][..ph];
                vectorize!(Level::new(), s => multiply(s, eight, spectrum, direction));
                self.column.batch(Direction::Adjoint, eight, fft);
                scatter(eight, &mut columns, at, height);
            }
        });
        let (rows, own) = (workers.bands_mut(image, height), workers.each_mut(buffers));
        let output = workers.bands_mut(output, height);
        workers.run(tasks, &|task| {
            let TaskScratch { row: fft, line, .. } = own.take(task);
            for ((y, row), (_, out)) in rows.take_rows(task).zip(output.take_rows(task)) {
                self.row.line(Direction::Adjoint, row, fft);
                collect(row, line);
                store(y, line, out);
            }
        });
    }

    /// Rows of an image that [`Self::couple`] takes: the sensor's, the padded row after them and the last padded row. A
    /// difference operator on the padded circle reaches those two from inside the sensor.
    pub fn coupled_rows(&self) -> usize {
        self.size.height + 2
    }

    /// One frequency-domain step of a splitting method. `a` is an image on the sensor's rows, `b` one on the
    /// [`Self::coupled_rows`], both of padded rows and zero everywhere else; both are transformed, `mix` edits their spectra
    /// as in [`Self::couple_columns`], and the sensor's rows of both are transformed back.
    ///
    /// # Panics
    /// When a length does not fit the plan.
    pub fn couple(
        &self,
        a: &mut [Lanes],
        b: &mut [Lanes],
        spectrum: &mut [Lanes],
        mix: impl Fn(usize, &mut [Lanes], &mut [Lanes], &mut [Lanes]) + Sync,
        scratch: &mut Scratch,
    ) {
        let (height, blocks) = (self.size.height, self.row_lanes());
        let rows = |direction: Direction, a: &mut [Lanes], b: &mut [Lanes], scratch: &mut Scratch| {
            let images = [a, b].map(|image| {
                let rows = image.len() / blocks;
                self.workers.bands_mut(image, rows)
            });
            let own = self.workers.each_mut(&mut scratch.tasks);
            self.workers.run(self.workers.threads(), &|task| {
                let fft = &mut own.take(task).row;
                images
                    .iter()
                    .flat_map(|rows| rows.take_rows(task))
                    .for_each(|(_, row)| self.row.line(direction, row, fft));
            });
        };
        rows(Direction::Forward, a, b, scratch);
        self.couple_columns(a, b, spectrum, mix, scratch);
        rows(Direction::Adjoint, a, &mut b[..height * blocks], scratch);
    }

    /// The part of [`Self::couple`] between the transforms of the rows: `a` and `b` hold transformed rows and are left so.
    /// `mix(j, a, b, spectrum)` edits the spectra at the columns 8j … 8j + 7, each `padded.height` lanes long and
    /// unnormalised; `spectrum` is a state of its own, eight columns after eight columns. Counts as four transforms.
    ///
    /// # Panics
    /// When a length does not fit the plan.
    pub fn couple_columns(
        &self,
        a: &mut [Lanes],
        b: &mut [Lanes],
        spectrum: &mut [Lanes],
        mix: impl Fn(usize, &mut [Lanes], &mut [Lanes], &mut [Lanes]) + Sync,
        scratch: &mut Scratch,
    ) {
        let (height, blocks, ph) = (self.size.height, self.row_lanes(), self.padded.height);
        let workers = &self.workers;
        let lengths = (a.len(), b.len(), spectrum.len());
        assert_eq!(lengths, (height * blocks, (height + 2) * blocks, ph * blocks), "images of another plan");
        scratch.transforms += 4;
        let [a, b] = [(a, height), (b, height + 2)].map(|(image, rows)| workers.strided_bands_mut(image, rows, blocks));
        let (spectrum, own) = (workers.bands_mut(spectrum, blocks), workers.each_mut(&mut scratch.tasks));
        workers.run(workers.threads(), &|task| {
            let TaskScratch { column: fft, columns: [ca, cb], .. } = own.take(task);
            let (mut a, mut b) = (a.take(task), b.take(task));
            for (at, (block, spectrum)) in spectrum.take_rows(task).enumerate() {
                gather(&a, at, ca, height);
                gather(&b, at, cb, height + 2);
                // In a frame padded by two rows the last row is where it belongs already.
                if ph > height + 2 {
                    cb[ph - 1] = std::mem::take(&mut cb[height + 1]);
                }
                self.column.batch(Direction::Forward, ca, fft);
                self.column.batch(Direction::Forward, cb, fft);
                mix(block, ca, cb, spectrum);
                self.column.batch(Direction::Adjoint, ca, fft);
                self.column.batch(Direction::Adjoint, cb, fft);
                scatter(ca, &mut a, at, height);
                scatter(cb, &mut b, at, height);
            }
        });
    }
}

/// The image beyond its borders, on the padded circle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Beyond {
    /// Zero.
    Dark,
    /// Mirrored at both borders, the one faded into the other.
    Mirrored,
}

impl Beyond {
    /// For each sample of a padded line behind the `n` of the image: its place, the samples of the image that it mirrors at the end and at
    /// the start, and the share of the latter.
    fn mirrors(self, n: usize, padded: usize) -> impl Iterator<Item = (usize, usize, usize, f32)> {
        let gap = if self == Self::Mirrored { padded - n } else { 0 };
        (0..gap).map(move |k| {
            let (end, start) = (n - 1 - k.min(n - 1), (gap - 1 - k).min(n - 1));
            (n + k, end, start, (k as f32 + 0.5) / gap as f32)
        })
    }
}

/// columns ⊙ spectrum, or its conjugate.
#[inline(always)]
fn multiply<S: Simd>(s: S, columns: &mut [Lanes], spectrum: &[Lanes], direction: Direction) {
    let sign = f32x8::splat(s, if direction == Direction::Forward { 1.0 } else { -1.0 });
    for (v, k) in columns.iter_mut().zip(spectrum) {
        let Wave { re, im } = Wave::load(s, k);
        (Wave::load(s, v) * Wave { re, im: im * sign }).store(v);
    }
}

/// Copies the eight columns `at` of the first `height` rows of `image` into `columns`, zeros below.
fn gather(image: &StridedMut<'_, Lanes>, at: usize, columns: &mut [Lanes], height: usize) {
    columns[..height].iter_mut().enumerate().for_each(|(y, v)| *v = image.group(y)[at]);
    columns[height..].fill(Lanes::ZERO);
}

/// Copies the first `height` of `columns` back.
fn scatter(columns: &[Lanes], image: &mut StridedMut<'_, Lanes>, at: usize, height: usize) {
    columns[..height].iter().enumerate().for_each(|(y, v)| image.group_mut(y)[at] = *v);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optics::lanes::at;

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
    fn the_image_of_a_point_takes_no_fft_and_is_the_image_times_its_sample() {
        let (size, reach) = (Size::new(40, 31), Reach { rows: (2, 2), columns: (2, 2) });
        let c = Convolver::new(Field::of_frame(size), reach, FftBackend::default(), Arc::new(Workers::new(2))).unwrap();
        let (image, mut scratch) = (noise(size.pixels(), 3), c.make_scratch());
        let mut product = |lit: usize, direction| {
            let samples: Vec<_> = (0..25).map(|i| if i == lit { 0.5 } else { 0.0 }).collect();
            let (kernel, mut out) = (c.kernel(&samples, Size::new(5, 5)), vec![0.0; size.pixels()]);
            let load = |y: usize, row: &mut [Complex32]| {
                row.iter_mut().zip(&image[y * size.width..]).for_each(|(v, x)| *v = Complex32::from(*x));
            };
            let store =
                |_: usize, row: &[Complex32], out: &mut [f32]| out.iter_mut().zip(row).for_each(|(o, v)| *o = v.re);
            let before = scratch.transforms();
            c.run(&kernel, direction, load, &mut out, store, &mut scratch);
            (out, scratch.transforms() - before)
        };
        let half: Vec<_> = image.iter().map(|v| 0.5 * v).collect();
        assert_eq!(product(12, Direction::Forward), (half.clone(), 0));
        assert_eq!(product(12, Direction::Adjoint), (half.clone(), 0));
        // one sample that is off the centre moves the image
        let (moved, transforms) = product(13, Direction::Forward);
        assert_eq!(transforms, 2);
        assert!((moved[41] - half[40]).abs() < 1e-5 && moved != half);
    }

    #[test]
    fn a_filter_treats_a_flat_image_alike_everywhere() {
        let (size, reach) = (Size::new(40, 31), Reach { rows: (8, 8), columns: (8, 8) });
        let c = Convolver::new(Field::of_frame(size), reach, FftBackend::default(), Arc::new(Workers::new(2))).unwrap();
        let kernel = c.kernel(&noise(25, 4), Size::new(5, 5)).hidden(0.1);
        let (mut filtered, mut scratch) = (vec![0.0; size.pixels()], c.make_scratch());
        let load = |_: usize, row: &mut [Complex32]| row.fill(Complex32::from(1.1));
        let store = |_: usize, row: &[Complex32], out: &mut [f32]| out.iter_mut().zip(row).for_each(|(o, v)| *o = v.re);
        c.filter(&kernel, load, &mut filtered, store, &mut scratch);
        assert!(filtered.iter().all(|v| (v - 0.1).abs() < 1e-4), "{:?}", &filtered[..8]);
        c.run(&kernel, Direction::Forward, load, &mut filtered, store, &mut scratch);
        assert!(filtered[0] > 0.2, "a border to the dark is an edge: {}", filtered[0]);
    }

    /// For a kernel of positive samples (|K| is largest at frequency 0) and an image amidst the padded circle, with its hidden part h:
    /// h + k̃ * k * h / (v·K(0)²) is the image.
    #[test]
    fn what_a_kernel_hides_is_an_image_less_what_the_kernel_shows_of_it() {
        let (size, visible, reach) = (Size::new(40, 32), 0.1, Reach { rows: (8, 8), columns: (8, 8) });
        let c = Convolver::new(Field::of_frame(size), reach, FftBackend::default(), Arc::new(Workers::new(2))).unwrap();
        let k = noise(25, 4);
        let (kernel, sum) = (c.kernel(&k, Size::new(5, 5)), k.iter().sum::<f32>());
        let mut scratch = c.make_scratch();
        let mut run = |kernel: &Kernel, direction, image: &[f32]| {
            let mut out = vec![0.0; size.pixels()];
            let load = |y: usize, row: &mut [Complex32]| {
                row.iter_mut().zip(&image[y * size.width..]).for_each(|(v, x)| *v = Complex32::from(*x));
            };
            let store =
                |_: usize, row: &[Complex32], out: &mut [f32]| out.iter_mut().zip(row).for_each(|(o, v)| *o = v.re);
            c.run(kernel, direction, load, &mut out, store, &mut scratch);
            out
        };
        let energy = |v: &[f32]| v.iter().map(|v| v * v).sum::<f32>();
        for fine in [false, true] {
            let image: Vec<f32> = (0..size.pixels())
                .map(|i| {
                    let (x, y) = ((i % size.width) as f32 - 20.0, (i / size.width) as f32 - 16.0);
                    let sign = if fine && (x + y) as i32 % 2 != 0 { -1.0 } else { 1.0 };
                    sign * (-(x * x + y * y) / 8.0).exp()
                })
                .collect();
            let hidden = run(&kernel.hidden(visible), Direction::Forward, &image);
            let seen = run(&kernel, Direction::Forward, &hidden);
            let seen = run(&kernel, Direction::Adjoint, &seen);
            let sums = hidden.iter().zip(&seen).map(|(hidden, seen)| hidden + seen / (visible * sum * sum));
            let worst = sums.zip(&image).map(|(sum, v)| (sum - v).abs()).fold(0.0, f32::max);
            assert!(worst < 1e-2, "{worst}");
            let share = energy(&hidden) / energy(&image);
            assert!(if fine { share > 0.6 } else { share < 0.3 }, "fine {fine}: {share}");
        }
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
                let c = Convolver::new(Field::of_frame(size), reach, backend, Arc::new(Workers::new(threads))).unwrap();
                let kernel = c.kernel(&k, ksize);
                let mut scratch = c.make_scratch();
                let dirty = Lanes { re: [f32::NAN; LANES], im: [f32::NAN; LANES] };
                scratch.rows.fill(dirty);
                for task in &mut scratch.tasks {
                    task.columns.iter_mut().for_each(|c| c.fill(dirty));
                    task.line.fill(Complex32::new(f32::NAN, f32::NAN));
                }
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
        // The second frame is padded by two rows only, so that the row after it is the last but one.
        for (size, rows) in [(Size::new(10, 7), 3), (Size::new(10, 14), 0)] {
            let reach = Reach { rows: (rows, rows), columns: (5, 4) };
            let c =
                Convolver::new(Field::of_frame(size), reach, FftBackend::Batched, Arc::new(Workers::new(2))).unwrap();
            let ksize = Size::new(10, 2 * rows + 1);
            let k = noise(ksize.pixels(), 3);
            let kernel = c.kernel(&k, ksize);
            let mut scratch = c.make_scratch();
            let (padded, blocks, x) = (c.padded(), c.row_lanes(), noise(size.pixels(), 1));
            let mut a = vec![Lanes::ZERO; size.height * blocks];
            let mut b = vec![Lanes::ZERO; c.coupled_rows() * blocks];
            let mut spectrum = vec![Lanes::ZERO; padded.height * blocks];
            for (i, v) in x.iter().enumerate() {
                put(&mut b[i / size.width * blocks..], i % size.width, Complex32::from(*v));
            }
            // One value in the row after the sensor, one in the last padded row; both fall outside of the result.
            put(&mut b[size.height * blocks..], 0, Complex32::I);
            put(&mut b[(size.height + 1) * blocks..], 1, -Complex32::I);
            let ph = padded.height;
            let mix = |block: usize, a: &mut [Lanes], b: &mut [Lanes], state: &mut [Lanes]| {
                state.copy_from_slice(b);
                a.copy_from_slice(b);
                let k = &kernel.spectrum()[block * ph..][..ph];
                vectorize!(Level::new(), s => multiply(s, a, k, Direction::Forward));
            };
            c.couple(&mut a, &mut b, &mut spectrum, mix, &mut scratch);
            let want = naive(&x, size, &k, ksize, false);
            for (i, (x, want)) in x.iter().zip(&want).enumerate() {
                let value = |image: &[Lanes]| at(&image[i / size.width * blocks..], i % size.width);
                assert!((f64::from(value(&a).re) - want).abs() < 1e-4);
                assert!((value(&b) / padded.pixels() as f32 - x).norm() < 1e-5);
            }
            let mean: f32 = x.iter().sum();
            assert!((spectrum[0].get(0) - mean).norm() < 1e-3 * mean, "the two outer values cancel in the mean");
        }
    }
}
