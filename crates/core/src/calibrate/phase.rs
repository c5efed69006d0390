//! Sub-pixel displacement of two images by phase correlation.

use std::sync::Arc;

use rustfft::{Fft, FftPlanner};

use crate::image::{Complex32, Size};

/// Spatial frequencies beyond this share of the sampling rate (σ of a Gaussian) hold more noise than image; the correlation peak
/// is then a Gaussian of 1/(2π · 0.15) ≈ 1.1 pixels.
const BAND: f32 = 0.15;
/// Amplitudes below this share of the root mean square are not brought up to 1.
const FLOOR: f32 = 0.1;

/// Displacement of one image against another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Peak {
    /// Displacement of the second image's content in pixels, to the right and down.
    pub(super) shift: [f64; 2],
    /// Height of the correlation peak: 1 for equal images, near 0 for unrelated ones.
    pub(super) height: f64,
}

/// Phase correlation of images of one size. Allocates when made and at every call.
pub(super) struct Correlator {
    size: Size,
    rows: [Arc<dyn Fft<f32>>; 2],
    columns: [Arc<dyn Fft<f32>>; 2],
    window: Vec<f32>,
    band: Vec<f32>,
}

impl Correlator {
    /// Plans the transforms for images of `size`.
    pub(super) fn new(size: Size) -> Self {
        let mut planner = FftPlanner::new();
        let mut plans = |n: usize| [planner.plan_fft_forward(n), planner.plan_fft_inverse(n)];
        let hann = |i: usize, n: usize| (std::f32::consts::PI * (i as f32 + 0.5) / n as f32).sin().powi(2);
        let frequency = |i: usize, n: usize| if 2 * i < n { i as f32 } else { i as f32 - n as f32 } / n as f32;
        let each =
            |f: &dyn Fn(usize, usize) -> f32| (0..size.pixels()).map(|i| f(i % size.width, i / size.width)).collect();
        Self {
            size,
            rows: plans(size.width),
            columns: plans(size.height),
            window: each(&|x, y| hann(x, size.width) * hann(y, size.height)),
            band: each(&|x, y| {
                let (fx, fy) = (frequency(x, size.width), frequency(y, size.height));
                (-0.5 * (fx * fx + fy * fy) / (BAND * BAND)).exp()
            }),
        }
    }

    /// Displacement of `b` against `a`.
    pub(super) fn run(&self, a: &[f32], b: &[f32]) -> Peak {
        let (a, b) = (self.spectrum(a), self.spectrum(b));
        let mut cross: Vec<Complex32> = a.iter().zip(&b).map(|(a, b)| a.conj() * b).collect();
        let rms = (cross.iter().zip(&self.band).map(|(c, w)| w * c.norm_sqr()).sum::<f32>()
            / self.band.iter().sum::<f32>())
        .sqrt();
        let floor = FLOOR * rms + f32::MIN_POSITIVE;
        cross.iter_mut().zip(&self.band).for_each(|(c, w)| *c *= w / (c.norm() + floor));
        self.transform(&mut cross, 1);
        let at = |x: isize, y: isize| {
            let (w, h) = (self.size.width as isize, self.size.height as isize);
            cross[(y.rem_euclid(h) * w + x.rem_euclid(w)) as usize].re
        };
        let best = (0..cross.len()).max_by(|i, j| cross[*i].re.total_cmp(&cross[*j].re)).unwrap_or(0);
        let (x, y) = ((best % self.size.width) as isize, (best / self.size.width) as isize);
        let peak = at(x, y);
        // a parabola through the logarithms is exact for a Gaussian
        let vertex = |before: f32, after: f32| {
            let [l, m, r] = [before, peak, after].map(|v| f64::from(v.max(1e-3 * peak).max(f32::MIN_POSITIVE)).ln());
            let bend = l - 2.0 * m + r;
            if bend < 0.0 { (0.5 * (l - r) / bend).clamp(-0.5, 0.5) } else { 0.0 }
        };
        let signed = |i: isize, n: usize| if 2 * i < n as isize { i as f64 } else { i as f64 - n as f64 };
        Peak {
            shift: [
                signed(x, self.size.width) + vertex(at(x - 1, y), at(x + 1, y)),
                signed(y, self.size.height) + vertex(at(x, y - 1), at(x, y + 1)),
            ],
            height: f64::from(peak / self.band.iter().sum::<f32>()),
        }
    }

    fn spectrum(&self, image: &[f32]) -> Vec<Complex32> {
        let weight: f32 = self.window.iter().sum();
        let mean = image.iter().zip(&self.window).map(|(v, w)| v * w).sum::<f32>() / weight;
        let windowed = image.iter().zip(&self.window).map(|(v, w)| Complex32::new((v - mean) * w, 0.0));
        let mut out: Vec<_> = windowed.collect();
        self.transform(&mut out, 0);
        out
    }

    fn transform(&self, image: &mut [Complex32], direction: usize) {
        let Size { width, height } = self.size;
        self.rows[direction].process(image);
        let mut columns: Vec<Complex32> = (0..image.len()).map(|i| image[i % height * width + i / height]).collect();
        self.columns[direction].process(&mut columns);
        (0..image.len()).for_each(|i| image[i % height * width + i / height] = columns[i]);
    }
}

#[cfg(test)]
mod tests {
    use std::f32::consts::TAU;

    use rand::{Rng, SeedableRng, rngs::StdRng};

    use super::*;

    /// Waves of all directions with random phases, up to 0.2 cycles a pixel: a texture that is the same wherever it is sampled.
    fn image(size: Size, dx: f32, dy: f32) -> Vec<f32> {
        let mut random = StdRng::seed_from_u64(17);
        let waves: Vec<[f32; 3]> = (0..300)
            .map(|_| {
                let (turn, length) = (random.random::<f32>() * TAU, 0.2 * TAU * random.random::<f32>().sqrt());
                [length * turn.cos(), length * turn.sin(), random.random::<f32>() * TAU]
            })
            .collect();
        let value = |i: usize| {
            let (x, y) = ((i % size.width) as f32 - dx, (i / size.width) as f32 - dy);
            waves.iter().map(|[fx, fy, phase]| (fx * x + fy * y + phase).sin()).sum()
        };
        (0..size.pixels()).map(value).collect()
    }

    #[test]
    fn a_shift_is_found_to_a_fraction_of_a_pixel() {
        let size = Size::new(64, 48);
        let correlator = Correlator::new(size);
        for [dx, dy] in [[0.0, 0.0], [2.3, -1.6], [-4.75, 3.5]] {
            let peak = correlator.run(&image(size, 0.0, 0.0), &image(size, dx, dy));
            let error = (peak.shift[0] - f64::from(dx)).hypot(peak.shift[1] - f64::from(dy));
            assert!(error < 0.15 && peak.height > 0.1, "{dx} {dy}: {peak:?}");
        }
    }
}
