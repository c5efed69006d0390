use std::f32::consts::TAU;

use rand::{Rng, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;

use stokescope_core::image::{Complex32, Size, Stack};

/// Diameter of the support, as a share of the sensor's short side.
const SUPPORT: f32 = 0.44;
/// Plane waves that make up the diffuser's random surface.
const WAVES: usize = 72;
/// Spread of their spatial frequencies, in cycles over the support.
const CYCLES: f32 = 6.4;
/// Half-width of a filament, in standard deviations of the surface.
const FILAMENT: f32 = 0.12;
/// Samples per fine pixel and axis: filaments are thinner than a pixel.
const OVERSAMPLING: usize = 2;

/// The response of a synthetic diffuser to a point source on the fine grid: bright filaments (caustics) along the level
/// line of a smooth random surface, inside a disc.
#[derive(Clone, Debug)]
pub(super) struct Caustic {
    /// Odd number of samples of a side; the middle one is zero displacement.
    side: usize,
    values: Vec<f32>,
}

impl Caustic {
    /// The diffuser of `seed` in front of a sensor of `size`, on a grid `fine` times finer, magnified by 1 + `growth`. Sum 1.
    pub(super) fn new(size: Size, fine: usize, seed: u64, growth: f32) -> Self {
        let usual = SUPPORT * (size.width.min(size.height) * fine) as f32;
        let diameter = usual * (1.0 + growth);
        let side = (diameter as usize / 2) * 2 + 1;
        let samples = side * OVERSAMPLING;
        let mut rng = StdRng::seed_from_u64(seed);
        // exp(i·k·x) per wave and column, so that the inner loop is one complex product
        let step = CYCLES * TAU / (usual * OVERSAMPLING as f32);
        let middle = 0.5 * (samples - 1) as f32;
        // grown about the middle
        let usual_middle = 0.5 * (((usual as usize / 2) * 2 + 1) * OVERSAMPLING - 1) as f32;
        let at = |i: usize| (i as f32 - middle) / (1.0 + growth) + usual_middle;
        let waves: Vec<(Vec<Complex32>, f32, f32)> = (0..WAVES)
            .map(|_| {
                let (kx, ky): (f32, f32) = (rng.sample(StandardNormal), rng.sample(StandardNormal));
                let columns = (0..samples).map(|x| Complex32::cis(kx * step * at(x))).collect();
                (columns, ky * step, rng.random::<f32>() * TAU)
            })
            .collect();
        let unit = (2.0 / WAVES as f32).sqrt();
        let radius = 0.5 * diameter * OVERSAMPLING as f32;
        let mut values = vec![0.0; side * side];
        let mut surface = vec![0.0f32; samples];
        for y in 0..samples {
            surface.fill(0.0);
            for (columns, ky, phase) in &waves {
                let row = Complex32::cis(ky * at(y) + phase);
                for (height, c) in surface.iter_mut().zip(columns) {
                    *height += c.re * row.re - c.im * row.im;
                }
            }
            for (x, height) in surface.iter().enumerate() {
                let inside = (x as f32 - middle).hypot(y as f32 - middle) < radius;
                let filament = (-(height * unit / FILAMENT).powi(2)).exp();
                values[y / OVERSAMPLING * side + x / OVERSAMPLING] += if inside { filament } else { 0.0 };
            }
        }
        let sum: f64 = values.iter().copied().map(f64::from).sum();
        values.iter_mut().for_each(|v| *v = (f64::from(*v) / sum) as f32);
        Self { side, values }
    }

    /// Largest displacement with a response, in fine pixels.
    pub(super) fn radius(&self) -> usize {
        self.side / 2
    }

    /// [`Self::radius`] for a sensor of `size`, on a grid `fine` times finer.
    pub(super) fn radius_for(size: Size, fine: usize) -> usize {
        (SUPPORT * (size.width.min(size.height) * fine) as f32) as usize / 2
    }

    /// Pixels of a sensor of `size` that the response of a PSF magnified by 1 + `growth` reaches at most, in any direction.
    pub(super) fn reach(size: Size, growth: f32) -> usize {
        (0.5 * SUPPORT * size.width.min(size.height) as f32 * (1.0 + growth)).ceil() as usize
    }

    /// Every response with its displacement (x, y) in fine pixels.
    pub(super) fn responses(&self) -> impl Iterator<Item = ([isize; 2], f32)> {
        let radius = self.radius() as isize;
        self.values
            .iter()
            .enumerate()
            .map(move |(i, &v)| ([(i % self.side) as isize - radius, (i / self.side) as isize - radius], v))
    }

    /// The PSF as a bundle holds it: the response of sensor pixels to a source as large as a pixel. Averaging over the area of both centres
    /// it whatever `fine` is. One plane of `size`, zero displacement at half of it, sum 1.
    pub(super) fn measured(&self, size: Size, fine: usize) -> Stack<f32> {
        let mut out = Stack::zeros(1, size);
        let plane = out.plane_mut(0);
        let n = fine as isize;
        for ([dx, dy], v) in self.responses().filter(|r| r.1 > 0.0) {
            // along each axis a triangle shares the response between two neighbouring pixels
            let share = |d: isize| {
                let cell = d.div_euclid(n);
                let second = d.rem_euclid(n) as f32 / n as f32;
                [(cell, 1.0 - second), (cell + 1, second)]
            };
            for (cy, wy) in share(dy) {
                for (cx, wx) in share(dx) {
                    let (x, y) = (cx + (size.width / 2) as isize, cy + (size.height / 2) as isize);
                    if (0..size.width as isize).contains(&x) && (0..size.height as isize).contains(&y) {
                        plane[y as usize * size.width + x as usize] += v * wx * wy;
                    }
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_a_disc_of_filaments_with_sum_one() {
        let size = Size::new(101, 80);
        let psf = Caustic::new(size, 2, 7, 0.0).measured(size, 2);
        let plane = psf.plane(0);
        assert!((plane.iter().sum::<f32>() - 1.0).abs() < 1e-4);
        let lit = plane.iter().filter(|&&v| v > 0.0).count() as f32;
        let disc = std::f32::consts::PI * (0.22f32 * 80.0).powi(2);
        assert!(lit > 0.7 * disc && lit < 1.25 * disc, "{lit} of {disc}");
        let peak = plane.iter().fold(0.0f32, |a, &b| a.max(b));
        assert!(peak > 3.0 / disc, "filaments stand out: {}", peak * disc);
    }

    #[test]
    fn the_measured_response_keeps_the_centre_of_mass() {
        let size = Size::new(64, 64);
        for fine in [2, 3] {
            let caustic = Caustic::new(size, fine, 3, 0.0);
            let mean = caustic.responses().map(|([x, _], v)| x as f32 * v).sum::<f32>() / fine as f32;
            let psf = caustic.measured(size, fine);
            let found: f32 = psf.plane(0).iter().enumerate().map(|(i, v)| (i % 64) as f32 * v).sum();
            assert!((found - 32.0 - mean).abs() < 1e-3, "{found} {mean}");
        }
    }
}
