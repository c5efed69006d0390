use std::sync::Arc;

use rustfft::{Fft, FftPlanner};

use super::psf::Caustic;
use stokescope_core::image::{Complex32, Size};

/// Linear convolution of real fine images with one caustic, cropped to a frame inside the image. Plans and buffers are made once: half a
/// spectrum of the caustic, half a spectrum of the image, and a few columns.
pub(super) struct Convolver {
    /// Size of the image that is convolved: the frame and its margin.
    image: Size,
    /// Fine pixels of the image beyond the frame, on each side.
    margin: usize,
    padded: Size,
    rows: [Arc<dyn Fft<f32>>; 2],
    columns: [Arc<dyn Fft<f32>>; 2],
    /// Spectrum of the caustic, column by column, the first half and the middle one: the others mirror them, as images and caustic are
    /// real. The factor of the inverse transform is included.
    spectrum: Vec<Complex32>,
    /// Spectrum of each row of the image, the first half and the middle.
    by_row: Vec<Complex32>,
    /// [`BLOCK`] columns, one after another.
    by_column: Vec<Complex32>,
    /// Two rows as real and imaginary part, and two rows of an image.
    pair: Vec<Complex32>,
    lines: [Vec<f32>; 2],
    scratch: Vec<Complex32>,
}

/// Columns that are transformed together: as many as a cache line or two hold of a row.
const BLOCK: usize = 16;

impl Convolver {
    /// A convolver for frames of `frame` fine pixels and images that go on for `margin` fine pixels beyond them on each side.
    pub(super) fn new(frame: Size, margin: usize, caustic: &Caustic) -> Self {
        let radius = caustic.radius();
        let (image, padded) = Self::sizes(frame, margin, radius);
        let mut planner = FftPlanner::new();
        let rows = [planner.plan_fft_forward(padded.width), planner.plan_fft_inverse(padded.width)];
        let columns = [planner.plan_fft_forward(padded.height), planner.plan_fft_inverse(padded.height)];
        let scratch = rows.iter().chain(&columns).map(|f| f.get_inplace_scratch_len()).max().unwrap_or(0);
        let zero = Complex32::default();
        let (half, lit) = (padded.width / 2 + 1, 2 * radius + 1);
        let mut it = Self {
            image,
            margin,
            padded,
            rows,
            columns,
            spectrum: vec![zero; half * padded.height],
            by_row: vec![zero; half * image.height],
            by_column: vec![zero; padded.height * BLOCK],
            pair: vec![zero; padded.width],
            lines: [(); 2].map(|()| vec![0.0; image.width]),
            scratch: vec![zero; scratch],
        };
        let mut line = vec![zero; padded.width];
        let mut responses = caustic.responses().peekable();
        for y in 0..lit {
            line.fill(zero);
            // += for a caustic so large that it wraps onto itself
            while let Some(([dx, _], v)) = responses.next_if(|([_, dy], _)| *dy + radius as isize == y as isize) {
                line[dx.rem_euclid(padded.width as isize) as usize] += v / padded.pixels() as f32;
            }
            it.rows[0].process_with_scratch(&mut line, &mut it.scratch);
            let at = (y + padded.height - radius % padded.height) % padded.height;
            for (column, value) in it.spectrum.chunks_exact_mut(padded.height).zip(&line) {
                column[at] += value;
            }
        }
        it.columns[0].process_with_scratch(&mut it.spectrum, &mut it.scratch);
        it
    }

    /// Size of the image, and of the transform: padding keeps what wraps around outside the frame.
    fn sizes(frame: Size, margin: usize, radius: usize) -> (Size, Size) {
        let image = Size::new(frame.width + 2 * margin, frame.height + 2 * margin);
        let padding = radius.saturating_sub(margin);
        (image, Size::new(smooth(image.width + padding), smooth(image.height + padding)))
    }

    /// Bytes of a convolver as [`Self::new`] makes it for a caustic of this radius.
    pub(super) fn bytes(frame: Size, margin: usize, radius: usize) -> usize {
        let (image, Size { width, height }) = Self::sizes(frame, margin, radius);
        let values = (width / 2 + 1) * (height + image.height) + height * BLOCK + width;
        values * size_of::<Complex32>() + 2 * image.width * size_of::<f32>()
    }

    /// Convolves the image that `read` gives row by row from the top, and hands each row of the frame to `write`.
    pub(super) fn convolve(&mut self, mut read: impl FnMut(usize, &mut [f32]), mut write: impl FnMut(usize, &[f32])) {
        let (Size { width, height }, Size { width: shown, height: rows }) = (self.padded, self.image);
        let half = width / 2 + 1;
        let (zero, i) = (Complex32::default(), Complex32::i());
        // two real rows share one complex transform, whose even part belongs to the first and whose odd part to the second
        for (y, spectra) in (0..rows).step_by(2).zip(self.by_row.chunks_mut(2 * half)) {
            self.lines[1].fill(0.0);
            self.lines.iter_mut().zip(y..rows).for_each(|(line, y)| read(y, line));
            self.pair[shown..].fill(zero);
            let [a, b] = &self.lines;
            self.pair.iter_mut().zip(a.iter().zip(b)).for_each(|(z, (a, b))| *z = Complex32::new(*a, *b));
            self.rows[0].process_with_scratch(&mut self.pair, &mut self.scratch);
            let mirrored = self.pair[..1].iter().chain(self.pair[1..].iter().rev());
            let halves = self.pair.iter().zip(mirrored).take(half).map(|(z, w)| (0.5 * z, 0.5 * w.conj()));
            let (first, second) = spectra.split_at_mut(half);
            for (k, (z, w)) in halves.enumerate() {
                first[k] = z + w;
                second.get_mut(k).into_iter().for_each(|value| *value = (w - z) * i);
            }
        }
        for x0 in (0..half).step_by(BLOCK) {
            let count = BLOCK.min(half - x0);
            let block = &mut self.by_column[..count * height];
            for (y, row) in self.by_row.chunks_exact(half).enumerate() {
                row[x0..x0 + count].iter().enumerate().for_each(|(x, v)| block[x * height + y] = *v);
            }
            block.chunks_exact_mut(height).for_each(|column| column[rows..].fill(zero));
            self.columns[0].process_with_scratch(block, &mut self.scratch);
            let response = &self.spectrum[x0 * height..];
            block.iter_mut().zip(response).for_each(|(value, r)| *value *= r);
            self.columns[1].process_with_scratch(block, &mut self.scratch);
            for (y, row) in self.by_row.chunks_exact_mut(half).enumerate() {
                row[x0..x0 + count].iter_mut().enumerate().for_each(|(x, v)| *v = block[x * height + y]);
            }
        }
        let seen = self.margin..rows - self.margin;
        let spectra = self.by_row[seen.start * half..seen.end * half].chunks(2 * half);
        for (y, spectra) in (0..seen.len()).step_by(2).zip(spectra) {
            let (first, second) = spectra.split_at(half);
            // an odd last row has no partner
            let pairs = first.iter().zip(second.iter().chain(std::iter::repeat(&zero)));
            for (k, (&a, &b)) in pairs.enumerate() {
                self.pair[k] = a + i * b;
                self.pair[(width - k) % width] = a.conj() + i * b.conj();
            }
            self.rows[1].process_with_scratch(&mut self.pair, &mut self.scratch);
            let [a, b] = &mut self.lines;
            for (z, (a, b)) in self.pair.iter().zip(a.iter_mut().zip(b)) {
                (*a, *b) = (z.re, z.im);
            }
            let columns = self.margin..shown - self.margin;
            self.lines.iter().zip(y..seen.len()).for_each(|(line, y)| write(y, &line[columns.clone()]));
        }
    }
}

/// Smallest length of at least `n` with no prime factor above 5.
fn smooth(n: usize) -> usize {
    (n..)
        .find(|&m| {
            let mut rest = m;
            for prime in [2, 3, 5] {
                while rest % prime == 0 {
                    rest /= prime;
                }
            }
            rest == 1
        })
        .unwrap_or(n)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_agrees_with_direct_convolution() {
        for frame in [Size::new(31, 22), Size::new(30, 21)] {
            // less than the caustic reaches, as far, and farther
            [0, 3, 8, 11].into_iter().for_each(|margin| check(frame, margin));
        }
    }

    fn check(frame: Size, margin: usize) {
        let psf = Caustic::new(Size::new(20, 24), 2, 5, 0.0);
        let image = Size::new(frame.width + 2 * margin, frame.height + 2 * margin);
        let a = |i: usize| ((i * 7919) % 101) as f32 / 101.0;
        let mut convolver = Convolver::new(frame, margin, &psf);
        convolver.convolve(|_, row| row.fill(f32::MAX.sqrt()), |_, _| ());
        let mut found = vec![0.0; frame.pixels()];
        convolver.convolve(
            |y, row| row.iter_mut().enumerate().for_each(|(x, v)| *v = a(y * image.width + x)),
            |y, row| found[y * frame.width..][..frame.width].copy_from_slice(row),
        );
        for y in 0..frame.height {
            for x in 0..frame.width {
                let mut sum = 0.0;
                for ([dx, dy], v) in psf.responses() {
                    let (u, w) = ((x + margin) as isize - dx, (y + margin) as isize - dy);
                    if (0..image.width as isize).contains(&u) && (0..image.height as isize).contains(&w) {
                        let i = w as usize * image.width + u as usize;
                        sum += v * a(i);
                    }
                }
                let f = found[y * frame.width + x];
                assert!((f - sum).abs() < 1e-5, "{margin}: {x} {y}: {f} {sum}");
            }
        }
    }
}
