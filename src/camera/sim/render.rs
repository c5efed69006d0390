use std::sync::Arc;

use rustfft::{Fft, FftPlanner};

use super::psf::Caustic;
use crate::plane::{Complex32, Size};

/// Linear convolution of fine images with one caustic, two real images at a time. Plans and buffers are made once: one
/// complex image, half a spectrum and a few columns.
pub(super) struct Convolver {
    image: Size,
    padded: Size,
    rows: [Arc<dyn Fft<f32>>; 2],
    columns: [Arc<dyn Fft<f32>>; 2],
    /// The first half and the middle of the frequency columns, one after another, scaled so that the inverse needs no
    /// scaling; the response is real, so the others are theirs turned around.
    spectrum: Vec<Complex32>,
    by_row: Vec<Complex32>,
    /// [`BLOCK`] columns, one after another.
    by_column: Vec<Complex32>,
    scratch: Vec<Complex32>,
}

/// Columns that are transformed together: as many as a cache line or two hold of a row.
const BLOCK: usize = 16;

impl Convolver {
    /// A convolver for images of `image` fine pixels.
    pub(super) fn new(image: Size, caustic: &Caustic) -> Self {
        // what wraps around stays outside the image when one radius is added, not two
        let radius = caustic.radius();
        let padded = Size::new(smooth(image.width + radius), smooth(image.height + radius));
        let mut planner = FftPlanner::new();
        let rows = [planner.plan_fft_forward(padded.width), planner.plan_fft_inverse(padded.width)];
        let columns = [planner.plan_fft_forward(padded.height), planner.plan_fft_inverse(padded.height)];
        let scratch = rows.iter().chain(&columns).map(|f| f.get_inplace_scratch_len()).max().unwrap_or(0);
        let zero = Complex32::default();
        let lit = 2 * radius + 1;
        let mut it = Self {
            image,
            padded,
            rows,
            columns,
            spectrum: Vec::with_capacity((padded.width / 2 + 1) * padded.height),
            by_row: vec![zero; padded.width * image.height.max(lit)],
            by_column: vec![zero; padded.height * BLOCK],
            scratch: vec![zero; scratch],
        };
        for ([dx, dy], v) in caustic.responses() {
            let x = dx.rem_euclid(padded.width as isize) as usize;
            let y = (dy + radius as isize) as usize;
            it.by_row[y * padded.width + x] = Complex32::new(v / padded.pixels() as f32, 0.0);
        }
        it.rows[0].process_with_scratch(&mut it.by_row[..lit * padded.width], &mut it.scratch);
        let column = &mut it.by_column[..padded.height];
        for x in 0..=padded.width / 2 {
            column.fill(zero);
            for y in 0..lit {
                // += for a caustic so large that it wraps onto itself
                column[(y + padded.height - radius) % padded.height] += it.by_row[y * padded.width + x];
            }
            it.columns[0].process_with_scratch(column, &mut it.scratch);
            it.spectrum.extend_from_slice(column);
        }
        it
    }

    /// Bytes of a convolver for images of `image` fine pixels and a caustic of this radius.
    pub(super) fn bytes(image: Size, radius: usize) -> usize {
        let (width, height) = (smooth(image.width + radius), smooth(image.height + radius));
        let values = (width / 2 + 1) * height + width * image.height.max(2 * radius + 1) + height * BLOCK;
        values * size_of::<Complex32>()
    }

    /// Convolves the two images `pixel` gives for each fine pixel (x, y); the response is real, so one transform of
    /// `a + ib` does both. Returns row-major values of which row `y` starts at `y` times the returned width.
    pub(super) fn convolve(&mut self, pixel: impl Fn(usize) -> (f32, f32)) -> (&[Complex32], usize) {
        let Size { width, height } = self.padded;
        let filled = self.image.height * width;
        for (y, row) in self.by_row[..filled].chunks_exact_mut(width).enumerate() {
            let (image, padding) = row.split_at_mut(self.image.width);
            for (x, value) in image.iter_mut().enumerate() {
                let (a, b) = pixel(y * self.image.width + x);
                *value = Complex32::new(a, b);
            }
            padding.fill(Complex32::default());
        }
        self.rows[0].process_with_scratch(&mut self.by_row[..filled], &mut self.scratch);
        for x0 in (0..width).step_by(BLOCK) {
            let count = BLOCK.min(width - x0);
            let block = &mut self.by_column[..count * height];
            for (y, row) in self.by_row[..filled].chunks_exact(width).enumerate() {
                row[x0..x0 + count].iter().enumerate().for_each(|(x, v)| block[x * height + y] = *v);
            }
            block.chunks_exact_mut(height).for_each(|column| column[self.image.height..].fill(Complex32::default()));
            self.columns[0].process_with_scratch(block, &mut self.scratch);
            for (x, column) in (x0..).zip(block.chunks_exact_mut(height)) {
                let response = &self.spectrum[x.min(width - x) * height..][..height];
                if x <= width / 2 {
                    column.iter_mut().zip(response).for_each(|(value, r)| *value *= r);
                } else {
                    let turned = response[..1].iter().chain(response[1..].iter().rev());
                    column.iter_mut().zip(turned).for_each(|(value, r)| *value *= r.conj());
                }
            }
            self.columns[1].process_with_scratch(block, &mut self.scratch);
            for (y, row) in self.by_row[..filled].chunks_exact_mut(width).enumerate() {
                row[x0..x0 + count].iter_mut().enumerate().for_each(|(x, v)| *v = block[x * height + y]);
            }
        }
        self.rows[1].process_with_scratch(&mut self.by_row[..filled], &mut self.scratch);
        (&self.by_row[..filled], width)
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
        let (image, psf) = (Size::new(31, 22), Caustic::new(Size::new(20, 24), 2, 5, 0.0));
        let a = |i: usize| ((i * 7919) % 101) as f32 / 101.0;
        let b = |i: usize| ((i * 104_729) % 89) as f32 / 89.0;
        let mut convolver = Convolver::new(image, &psf);
        convolver.convolve(|_| (f32::MAX.sqrt(), 1.0));
        let (found, width) = convolver.convolve(|i| (a(i), b(i)));
        for y in 0..image.height {
            for x in 0..image.width {
                let (mut sum_a, mut sum_b) = (0.0, 0.0);
                for ([dx, dy], v) in psf.responses() {
                    let (u, w) = (x as isize - dx, y as isize - dy);
                    if (0..image.width as isize).contains(&u) && (0..image.height as isize).contains(&w) {
                        let i = w as usize * image.width + u as usize;
                        (sum_a, sum_b) = (sum_a + v * a(i), sum_b + v * b(i));
                    }
                }
                let f = found[y * width + x];
                assert!((f.re - sum_a).abs() < 1e-5 && (f.im - sum_b).abs() < 1e-5, "{x} {y}: {f} {sum_a} {sum_b}");
            }
        }
    }
}
