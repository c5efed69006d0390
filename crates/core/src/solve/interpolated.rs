//! `stokes` behind a lens: S0 and L interpolated between polarizers on single pixels.
//!
//! Where a point of the scene lights a single pixel, a reading tells of nothing but that pixel, one number for three unknowns. A solution that
//! explains every reading then fits its noise. What the readings do tell is the local mean: S0 and L at a pixel are those that fit the
//! readings around it best, in weighted least squares with weights that fall linearly to zero at the distance after which the polarizers
//! repeat. For 2 × 2 polarizers at 0°, 45°, 90° and 135° that is bilinear interpolation of the four images.
//!
//! No iteration is run, so there is neither a direct start nor any state of one.

use num_complex::Complex32;

use super::problem::project_on_cone;
use super::video::Continuation;
use super::{Buffers, Diverged, Input, Modelled, Outcome, Solver, own};
use crate::image::noise::{SAMPLES, reading_noise};
use crate::optics::{LENS_SPREAD, Response, Scratch, StokesOperator};

/// Distances after which polarizers on single pixels repeat, at most.
const LARGEST_RADIUS: usize = 4;
/// Share of the mean squared response with which the readings around a pixel must tell the least visible polarization; ideal 2 × 2
/// polarizers have 0.5.
const VISIBLE: f32 = 0.15;
/// Share of the pixels of which that is true, at least.
const COVERED: f64 = 0.95;
/// Ridge of L over the mean squared response: where readings are missing, L is what is left.
const RIDGE: f32 = 1e-5;

/// Weighted sums over the readings around a pixel: the normal equations of S0, S1 and S2.
#[derive(Clone, Copy, Debug, Default)]
struct Normal {
    /// Σ w m mᵀ: 00, 01, 02, 11, 12, 22.
    matrix: [f32; 6],
    /// Σ w m b.
    right: [f32; 3],
}

impl Normal {
    fn add(&mut self, weight: f32, m0: f32, e: Complex32, reading: f32) {
        let products = [m0 * m0, m0 * e.re, m0 * e.im, e.re * e.re, e.re * e.im, e.im * e.im];
        self.matrix.iter_mut().zip(products).for_each(|(sum, product)| *sum += weight * product);
        self.right.iter_mut().zip([m0, e.re, e.im]).for_each(|(sum, m)| *sum += weight * m * reading);
    }

    /// S0 of unpolarized light.
    fn intensity(&self) -> f32 {
        if self.matrix[0] > 0.0 { self.right[0] / self.matrix[0] } else { 0.0 }
    }

    /// The normal equations of L where S0 follows from it: 11, 12, 22.
    fn polarized(&self) -> [f32; 3] {
        let [a, b, c, d, e, f] = self.matrix;
        let s = a.max(f32::MIN_POSITIVE);
        [d - b * b / s, e - b * c / s, f - c * c / s]
    }

    /// The smaller eigenvalue of these equations.
    fn least(&self) -> f32 {
        let [a, b, c] = self.polarized();
        0.5 * (a + c - ((a - c).powi(2) + 4.0 * b * b).sqrt())
    }

    /// S0 and L; zero where the response tells of no light.
    fn solve(&self) -> (f32, Complex32) {
        let [a, b, c, d, _, f] = self.matrix;
        if a <= 0.0 {
            return (0.0, Complex32::ZERO);
        }
        let [p, q, r] = self.polarized();
        let ridge = RIDGE * (d + f) + f32::MIN_POSITIVE;
        let (p, r) = (p + ridge, r + ridge);
        let [u, v, w] = self.right;
        let (v, w) = (v - b * u / a, w - c * u / a);
        let determinant = p * r - q * q;
        let l = Complex32::new((r * v - q * w) / determinant, (p * w - q * v) / determinant);
        ((u - b * l.re - c * l.im) / a, l)
    }
}

/// The normal equations around pixel (`x`, `y`), from readings and their weights.
fn around(
    response: &Response,
    [x, y]: [usize; 2],
    radius: usize,
    reading: impl Fn(usize) -> f32,
    weight: impl Fn(usize) -> f32,
) -> Normal {
    let (size, m0, e) = (response.size(), response.unpolarized(), response.polarized());
    let mut normal = Normal::default();
    let span = |at: usize, end: usize| (at + 1).saturating_sub(radius)..(at + radius).min(end);
    for v in span(y, size.height) {
        let down = (radius - v.abs_diff(y)) as f32;
        for u in span(x, size.width) {
            let i = v * size.width + u;
            normal.add(down * (radius - u.abs_diff(x)) as f32 * weight(i), m0[i], e[i], reading(i));
        }
    }
    normal
}

/// The distance after which the polarizers repeat, where they lie on single pixels; none for any other mask. Allocates nothing.
fn radius(operator: &StokesOperator) -> Option<usize> {
    let (response, field) = (&operator.response, operator.field());
    let (size, margin) = (field.frame(), field.margin());
    let covered = |radius: usize| {
        let tells = |i: &usize| {
            let at = [margin.columns + i % size.width, margin.rows + i / size.width];
            let normal = around(response, at, radius, |_| 0.0, |_| 1.0);
            normal.least() >= VISIBLE * (normal.matrix[3] + normal.matrix[5])
        };
        (0..size.pixels()).filter(tells).count() as f64 >= COVERED * size.pixels() as f64
    };
    (2..=LARGEST_RADIUS).find(|radius| covered(*radius))
}

/// The interpolation planned for all colour channels.
#[derive(Debug)]
pub(super) struct Interpolation {
    operators: Vec<StokesOperator>,
    /// Pixels after which the polarizers repeat.
    radius: usize,
}

/// Buffers of one channel at a time.
#[derive(Debug)]
struct Workspace {
    /// Readings of the result.
    modelled: Vec<f32>,
    samples: Vec<f32>,
    scratch: Scratch,
}

impl Buffers for Workspace {
    fn scratch(&self) -> &Scratch {
        &self.scratch
    }

    fn scratch_mut(&mut self) -> &mut Scratch {
        &mut self.scratch
    }
}

impl Interpolation {
    /// Plans a camera behind a lens with polarizers on single pixels; none for any other camera. Allocates.
    pub(super) fn new(operators: &[StokesOperator]) -> Option<Self> {
        let lens = operators.iter().all(|operator| operator.kernel.spread() <= LENS_SPREAD);
        let polarized = operators[0].response.is_polarized();
        let radius = (lens && polarized).then(|| radius(&operators[0])).flatten()?;
        Some(Self { operators: operators.to_vec(), radius })
    }

    /// S0 and L of one channel between the polarizers, into `out` (`[3, H, W]`). Returns the residual's sum of squares.
    fn interpolate(
        &self,
        operator: &StokesOperator,
        raw: &[f32],
        weight: &[f32],
        out: &mut [f32],
        w: &mut Workspace,
    ) -> f64 {
        let (response, width) = (&operator.response, operator.convolver.size().width);
        let (s0, polarized) = out.split_at_mut(raw.len());
        let (s1, s2) = polarized.split_at_mut(raw.len());
        for (i, ((s0, s1), s2)) in s0.iter_mut().zip(s1).zip(s2).enumerate() {
            let at = [i % width, i / width];
            let normal = around(response, at, self.radius, |i| raw[i], |i| weight[i]);
            let (intensity, l) = if normal.matrix[0] > 0.0 {
                normal.solve()
            } else {
                // no reading around is trusted: the estimates tell how bright it is there, and nothing of polarization
                (around(response, at, self.radius, |i| raw[i], |_| 1.0).intensity(), Complex32::ZERO)
            };
            let (intensity, l) = project_on_cone(intensity, l);
            (*s0, *s1, *s2) = (intensity, l.re, l.im);
        }
        operator.forward(out, &mut w.modelled, &mut w.scratch);
        let rest = raw.iter().zip(&w.modelled).zip(weight);
        rest.map(|((reading, modelled), weight)| f64::from(weight * (reading - modelled)).powi(2)).sum()
    }
}

impl Solver for Interpolation {
    fn make_workspace(&self) -> Box<dyn Buffers> {
        let c = &self.operators[0].convolver;
        Box::new(Workspace {
            modelled: vec![0.0; c.size().pixels()],
            samples: Vec::with_capacity(SAMPLES),
            scratch: c.make_scratch(),
        })
    }

    fn workspace_parts(&self) -> Vec<(&'static str, usize)> {
        let c = &self.operators[0].convolver;
        vec![("transforms", c.scratch_bytes()), ("modelled readings", (c.size().pixels() + SAMPLES) * size_of::<f32>())]
    }

    fn run(
        &self,
        input: &Input<'_>,
        iterations: usize,
        output: &mut [f32],
        workspace: &mut dyn Buffers,
        _: Option<&mut Continuation>,
    ) -> Result<Outcome, Diverged> {
        let w: &mut Workspace = own(workspace);
        let (channels, size) = (self.operators.len(), self.operators[0].convolver.size());
        let (mut energy, mut sigma) = (0.0, 0.0f32);
        let outputs = output.chunks_exact_mut(output.len() / channels);
        for (c, (operator, out)) in self.operators.iter().zip(outputs).enumerate() {
            let (raw, weight) = (input.raw.plane(c), input.weight.plane(c));
            sigma = sigma.max(reading_noise(raw, weight, size, operator.response.row_period(), &mut w.samples));
            energy += self.interpolate(operator, raw, weight, out, w);
        }
        let outcome = Outcome::cold(Modelled::Interpolated, iterations, energy, channels, self.operators[0].field());
        Ok(Outcome { sigma: Some(sigma), ..outcome })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::image::{Size, Stack};
    use crate::optics::{FftBackend, Mask, Mosaic, Psf};
    use crate::parallel::Workers;
    use crate::solve::{self, Method};

    const SIZE: Size = Size::new(24, 20);

    fn operator(mask: Mask, sigma: f32) -> StokesOperator {
        let square = |i: usize| ((i % 24) as f32 - 12.0).powi(2) + ((i / 24) as f32 - 10.0).powi(2);
        let psf = (0..SIZE.pixels()).map(|i| (-square(i) / (2.0 * sigma * sigma)).exp()).collect();
        let psf = Psf::new(Stack::from_vec(1, SIZE, psf).unwrap(), SIZE, 1).unwrap();
        let workers = Arc::new(Workers::new(1));
        let response = mask.response(SIZE).unwrap();
        StokesOperator::for_channels(&psf, &response, 1, FftBackend::default(), workers).unwrap().remove(0)
    }

    fn mosaic(rows: &[&[f64]]) -> Mask {
        Mask::Mosaic { layout: Mosaic::new(rows).unwrap(), extinction_ratio: f64::INFINITY }
    }

    const SONY: [&[f64]; 2] = [&[90.0, 45.0], &[135.0, 0.0]];

    #[test]
    fn only_single_polarizers_behind_a_lens_are_interpolated_between() {
        let found = |mask, sigma| Interpolation::new(&[operator(mask, sigma)]).map(|plan| plan.radius);
        assert_eq!(found(mosaic(&SONY), 0.1), Some(2));
        assert_eq!(found(mosaic(&[&[0.0, 60.0, 120.0]]), 0.1), Some(3));
        assert_eq!(found(mosaic(&[&[0.0, 0.0, 45.0, 45.0], &[90.0, 90.0, 135.0, 135.0]]), 0.1), Some(3));
        assert_eq!(found(mosaic(&SONY), 2.0), None, "light that is spread tells of many pixels");
        assert_eq!(found(Mask::stripes(&[0.0, 45.0, 90.0, 135.0], 4), 0.1), None, "no neighbour tells what is missing");
        assert_eq!(found(Mask::None, 0.1), None, "there are no polarizers");
        let colors = [operator(mosaic(&SONY), 0.1), operator(mosaic(&SONY), 2.0)];
        assert!(Interpolation::new(&colors).is_none(), "one colour is spread");
    }

    #[test]
    fn nothing_of_an_iteration_is_planned() {
        let operators = [operator(mosaic(&SONY), 0.1)];
        let plan =
            solve::Plan::new(&solve::Spec { method: Method::Stokes, operators: &operators, coarse: &[] }).unwrap();
        assert_eq!(plan.bytes(), 0);
        let parts: Vec<_> = plan.workspace_parts().iter().map(|(name, _)| *name).collect();
        assert_eq!(parts, ["transforms", "modelled readings"]);
    }

    #[test]
    fn it_is_bilinear_interpolation_of_the_four_images() {
        let operator = operator(mosaic(&SONY), 0.1);
        let readings = crate::image::noise::normal(SIZE.pixels(), 0.1, 3).iter().map(|v| 0.5 + v).collect::<Vec<_>>();
        let at = |x: usize, y: usize| readings[y * SIZE.width + x];
        for (x, y) in [(6, 6), (7, 6), (6, 7), (7, 7)] {
            let (s0, l) = around(&operator.response, [x, y], 2, |i| readings[i], |_| 1.0).solve();
            // means of the images behind 90°, 45°, 135° and 0°, which are those of pixels with even or odd columns and rows
            let mean = |column: usize, row: usize| {
                let near =
                    |from: usize, odd: usize| if from % 2 == odd { vec![from] } else { vec![from - 1, from + 1] };
                let (columns, rows) = (near(x, column), near(y, row));
                let values = rows.iter().flat_map(|y| columns.iter().map(move |x| (*x, *y))).map(|(x, y)| at(x, y));
                values.sum::<f32>() / (rows.len() * columns.len()) as f32
            };
            let [i90, i45, i135, i0] = [mean(0, 0), mean(1, 0), mean(0, 1), mean(1, 1)];
            let expected = [0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135];
            for (found, expected) in [s0, l.re, l.im].into_iter().zip(expected) {
                assert!((found - expected).abs() < 1e-4, "({x}, {y}): {found}, expected {expected}");
            }
        }
    }

    #[test]
    fn readings_that_are_missing_are_done_without() {
        let response = operator(mosaic(&SONY), 0.1).response;
        let (m0, e) = (response.unpolarized().to_vec(), response.polarized().to_vec());
        let scene = (0.8, Complex32::new(0.2, -0.1));
        let reading = |i: usize| m0[i] * scene.0 + (e[i].conj() * scene.1).re;
        for missing in [vec![10 * 24 + 10], vec![0, 1, 24], (0..24).collect()] {
            let weight = |i: usize| f32::from(!missing.contains(&i));
            for i in 0..SIZE.pixels() {
                let (s0, l) =
                    around(&response, [i % 24, i / 24], 2, |i| if weight(i) > 0.0 { reading(i) } else { 9.0 }, weight)
                        .solve();
                assert!(s0.is_finite() && l.norm().is_finite());
                let near_hole = missing.iter().any(|m| (m % 24).abs_diff(i % 24) < 2 && (m / 24).abs_diff(i / 24) < 2);
                let error = (s0 - scene.0).abs() + (l - scene.1).norm();
                assert!(error < if near_hole { 0.5 } else { 1e-3 }, "{i}: {error}");
            }
        }
        let none = around(&response, [3, 3], 2, |_| 1.0, |_| 0.0).solve();
        assert_eq!(none, (0.0, Complex32::ZERO));
    }
}
