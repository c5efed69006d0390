//! The guided iteration in f64 on whole images, one plain step after the other: `solve/guided.rs` and `solve/admm` of the core crate,
//! written anew. Fused passes, lanes, bands and the single transform of x and k * x have no counterpart here. Only the direct start's
//! equations are the program's.
#![allow(dead_code, reason = "every test binary uses its part of these helpers")]

use std::f64::consts::TAU;
use std::sync::Arc;

use num_complex::Complex64;
use rustfft::{Fft, FftPlanner};
use stokescope_core::image::noise::reading_noise;
use stokescope_core::image::{Complex32, Size};
use stokescope_core::optics::{Coarse, StokesOperator};

const RHO: f64 = 0.12;
const PRIOR: f64 = 1e-3;
const NOISE_POWER: f64 = 1.3;
const PRIOR_RANGE: (f64, f64) = (2e-5, 0.2);
const THRESHOLD: f64 = 7.0;
const FIRST_PRIOR: f64 = 0.25;
const RAMP: f64 = 6.0;
const OUTPUT_STEPS: f64 = 0.4;
const MOST_OUTPUT_STEPS: f64 = 4.0;
const STATE_AT: usize = 3;
const STATE_STEPS: f64 = 3.0;
const STATE_SETTLES: usize = 6;
const RADIUS: usize = 4;
const FLAT: f64 = 0.01;
const EDGE: f64 = 0.012;
const RIDGE: f64 = 0.018;
const GAIN_RIDGE: f64 = 2e-5;

/// 2-D transforms of one size, without a factor.
struct Transform {
    size: Size,
    rows: [Arc<dyn Fft<f64>>; 2],
    columns: [Arc<dyn Fft<f64>>; 2],
}

impl Transform {
    fn new(size: Size) -> Self {
        let mut planner = FftPlanner::new();
        let mut both = |n: usize| [planner.plan_fft_forward(n), planner.plan_fft_inverse(n)];
        Self { size, rows: both(size.width), columns: both(size.height) }
    }

    fn run(&self, mut image: Vec<Complex64>, direction: usize) -> Vec<Complex64> {
        let Size { width, height } = self.size;
        self.rows[direction].process(&mut image);
        let mut turned: Vec<_> = (0..image.len()).map(|i| image[i % height * width + i / height]).collect();
        self.columns[direction].process(&mut turned);
        (0..image.len()).for_each(|i| image[i % height * width + i / height] = turned[i]);
        image
    }
}

/// Transform of a PSF of `size`, zero displacement at its middle, on a circle of `padded`.
pub(crate) fn spectrum(psf: &[f32], size: Size, padded: Size) -> Vec<Complex64> {
    let mut image = vec![Complex64::ZERO; padded.pixels()];
    for (i, v) in psf.iter().enumerate() {
        let wrap = |at: usize, n: usize, circle: usize| (at + circle - n / 2) % circle;
        let (x, y) = (wrap(i % size.width, size.width, padded.width), wrap(i / size.width, size.height, padded.height));
        image[y * padded.width + x] += f64::from(*v);
    }
    Transform::new(padded).run(image, 0)
}

/// Mean over the window of each pixel, cut at the borders.
fn window_mean(image: &[Complex64], size: Size, radius: usize) -> Vec<Complex64> {
    let Size { width, height } = size;
    let reach = |at: usize, n: usize| at.saturating_sub(radius)..(at + radius + 1).min(n);
    let mean = |values: &mut dyn ExactSizeIterator<Item = Complex64>| {
        let count = values.len() as f64;
        values.sum::<Complex64>() / count
    };
    let across: Vec<_> =
        (0..image.len()).map(|i| mean(&mut reach(i % width, width).map(|x| image[i / width * width + x]))).collect();
    (0..image.len()).map(|i| mean(&mut reach(i / width, height).map(|y| across[y * width + i % width]))).collect()
}

/// The guided filter.
struct Filter {
    size: Size,
    radius: usize,
    guide: Vec<f64>,
    mean: Vec<f64>,
    precision: Vec<f64>,
}

impl Filter {
    fn new(guide: &[f64], size: Size, radius: usize, epsilon: f64) -> Self {
        let real = |values: Vec<Complex64>| values.into_iter().map(|v| v.re).collect::<Vec<_>>();
        let mean = real(window_mean(&guide.iter().map(|g| Complex64::from(*g)).collect::<Vec<_>>(), size, radius));
        let square = real(window_mean(&guide.iter().map(|g| Complex64::from(g * g)).collect::<Vec<_>>(), size, radius));
        // The program counts contrast of less than a thousandth as none, for f32 could not tell it.
        let precision =
            square.iter().zip(&mean).map(|(s, m)| 1.0 / ((s - m * m).max(0.0) + epsilon + 1e-6 * s)).collect();
        Self { size, radius, guide: guide.to_vec(), mean, precision }
    }

    fn run(&self, image: &[Complex64]) -> Vec<Complex64> {
        let means = |values: Vec<Complex64>| window_mean(&values, self.size, self.radius);
        let of_image = means(image.to_vec());
        let of_product = means(image.iter().zip(&self.guide).map(|(v, g)| v * g).collect());
        let slope: Vec<_> =
            (0..image.len()).map(|i| (of_product[i] - of_image[i] * self.mean[i]) * self.precision[i]).collect();
        let offset = (0..image.len()).map(|i| of_image[i] - slope[i] * self.mean[i]).collect();
        let (slope, offset) = (means(slope), means(offset));
        (0..image.len()).map(|i| slope[i] * self.guide[i] + offset[i]).collect()
    }
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt()
}

fn shorten(l: Complex64, s0: f64) -> Complex64 {
    if l.norm() <= s0 { l } else { l * (s0 / l.norm()) }
}

pub(crate) struct Twin {
    size: Size,
    transform: Transform,
    kernel: Vec<Complex64>,
    /// |D|² of both axes.
    laplacian: Vec<f64>,
    response: Vec<Complex64>,
    power: f64,
    target: Vec<f64>,
    guide: Vec<f64>,
    filter: Filter,
    edges: Vec<f64>,
    t: f64,
    threshold: f64,
    /// F(x) on the circle, and the multipliers on the sensor.
    spectrum: Vec<Complex64>,
    /// F(x) before the last iteration.
    before: Vec<Complex64>,
    blur_dual: Vec<Complex64>,
    prior_dual: Vec<Complex64>,
    gradient_dual: [Vec<Complex64>; 2],
    done: usize,
    energy: f64,
}

impl Twin {
    /// Everything up to the first iteration.
    pub(crate) fn new(operator: &StokesOperator, psf: &[f32], raw: &[f32], guide: &[f32], coarse: &Coarse) -> Self {
        let (size, padded) = (operator.convolver.size(), operator.convolver.padded());
        let n = size.pixels();
        let wide = |values: &[f32]| values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
        let response: Vec<_> =
            operator.response.polarized().iter().map(|e| Complex64::new(e.re.into(), e.im.into())).collect();
        let power = response.iter().map(num_complex::Complex::norm_sqr).sum::<f64>() / n as f64;
        let transform = Transform::new(padded);
        let kernel = spectrum(psf, size, padded);
        let mut random_access = Vec::new();
        let sigma =
            f64::from(reading_noise(raw, &vec![1.0; n], size, operator.response.row_period(), &mut random_access));

        let guide = denoised(&wide(guide), size);
        let m0 = wide(operator.response.unpolarized());
        let blurred = crop(
            &blur(&transform, &kernel, &guide.iter().map(|g| Complex64::from(*g)).collect::<Vec<_>>(), size),
            size,
            padded,
        );
        let share: Vec<f64> = blurred.iter().zip(&m0).map(|(v, m)| m * v.re).collect();
        let readings = wide(raw);
        let seen = |scale: f64| sigma.max(1e-4 * scale) / (2.0 * power.sqrt());

        let scale = rms(&readings) / rms(&share) * rms(&guide);
        let mut w = coarse.make_workspace();
        coarse.factor([RIDGE * (seen(scale) / scale).powf(1.5); 3], 1.0, &mut w);
        let modes = coarse.modes();
        let mut project = |values: &[f64]| {
            let seen: Vec<_> = values.iter().zip(&response).map(|(v, e)| e * v).collect();
            let conjugate: Vec<_> = kernel.iter().map(num_complex::Complex::conj).collect();
            let image = crop(&blur(&transform, &conjugate, &seen, size), size, padded);
            let image: Vec<_> = image.iter().map(|v| Complex32::new(v.re as f32, v.im as f32)).collect();
            let mut rhs = vec![0.0; coarse.unknowns()];
            let (re, im) = rhs.split_at_mut(modes);
            coarse.project(&image, re, im, &mut w);
            let mut x = rhs.clone();
            coarse.solve(&mut x, &w);
            (rhs, x)
        };
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let ((qa, xa), (_, xy)) = (project(&share), project(&readings));
        let (aa, ay) = (dot(&share, &share), dot(&share, &readings));
        let gain = (ay - dot(&qa, &xy) + GAIN_RIDGE * ay) / (aa - dot(&qa, &xa) + GAIN_RIDGE * aa);
        let modes_of_l: Vec<f64> = xy.iter().zip(&xa).map(|(y, a)| y - gain * a).collect();
        let mut image = vec![Complex32::ZERO; n];
        coarse.synthesize(&modes_of_l[..modes], &modes_of_l[modes..], &mut image, &mut w);
        let start: Vec<_> = image.iter().map(|v| Complex64::new(v.re.into(), v.im.into())).collect();
        let guide: Vec<f64> = guide.iter().map(|g| g * gain).collect();
        let target = readings.iter().zip(&share).map(|(y, a)| y - gain * a).collect();

        let brightness = rms(&guide);
        let filter = Filter::new(&guide, size, RADIUS, (FLAT * brightness).powi(2));
        let off = start.iter().zip(filter.run(&start)).map(|(v, f)| (v - f).norm_sqr()).sum::<f64>();
        let misfit = (off / n as f64).sqrt().max(1e-4 * brightness);
        let x: Vec<_> = start.iter().zip(&guide).map(|(v, g)| shorten(*v, *g)).collect();
        let value = |k: usize, n: usize| 2.0 - 2.0 * (TAU * k as f64 / n as f64).cos();
        Self {
            size,
            laplacian: (0..padded.pixels())
                .map(|i| value(i % padded.width, padded.width) + value(i / padded.width, padded.height))
                .collect(),
            edges: edge_weights(&guide, size, brightness),
            t: (PRIOR * (seen(brightness) / misfit).powf(NOISE_POWER)).clamp(PRIOR_RANGE.0, PRIOR_RANGE.1)
                * 4.0
                * power,
            threshold: THRESHOLD * misfit,
            spectrum: transform.run(pad(&x, size, padded), 0),
            before: Vec::new(),
            blur_dual: vec![Complex64::ZERO; n],
            prior_dual: vec![Complex64::ZERO; n],
            gradient_dual: [vec![Complex64::ZERO; n], vec![Complex64::ZERO; n]],
            transform,
            kernel,
            response,
            power,
            target,
            guide,
            filter,
            done: 0,
            energy: f64::NAN,
        }
    }

    /// Iterates until `iterations` are done; the residual's root mean square when the last of them began.
    pub(crate) fn advance_to(&mut self, iterations: usize) -> f64 {
        while self.done < iterations {
            self.before.clone_from(&self.spectrum);
            self.iterate();
            if self.done == STATE_AT && iterations > STATE_AT + STATE_SETTLES {
                self.spectrum = self.ahead(STATE_STEPS);
            }
            self.done += 1;
        }
        (self.energy / self.size.pixels() as f64).sqrt()
    }

    /// S1, then S2.
    pub(crate) fn polarized(&self) -> Vec<f64> {
        let shown = self.ahead((OUTPUT_STEPS * (self.done - 1) as f64).min(MOST_OUTPUT_STEPS));
        let x = crop(&self.back(shown), self.size, self.transform.size);
        let l: Vec<_> = x.iter().zip(&self.guide).map(|(v, g)| shorten(*v, *g)).collect();
        l.iter().map(|v| v.re).chain(l.iter().map(|v| v.im)).collect()
    }

    /// F(x) further on by so many of the last iteration's steps.
    fn ahead(&self, steps: f64) -> Vec<Complex64> {
        self.spectrum.iter().zip(&self.before).map(|(x, before)| x + (x - before) * steps).collect()
    }

    fn image(&self) -> Vec<Complex64> {
        crop(&self.back(self.spectrum.clone()), self.size, self.transform.size)
    }

    fn back(&self, spectrum: Vec<Complex64>) -> Vec<Complex64> {
        let share = 1.0 / spectrum.len() as f64;
        self.transform.run(spectrum, 1).into_iter().map(|v| v * share).collect()
    }

    fn iterate(&mut self) {
        let (Size { width, height }, padded) = (self.size, self.transform.size);
        let penalty = |i: usize| self.t * FIRST_PRIOR.powf((1.0 - i as f64 / RAMP).max(0.0));
        let (t, rho) = (penalty(self.done), RHO * self.power);
        let rescale = penalty(self.done.saturating_sub(1)) / t;
        for dual in [&mut self.prior_dual].into_iter().chain(&mut self.gradient_dual) {
            dual.iter_mut().for_each(|u| *u *= rescale);
        }

        // ν = k * x, a reading at a time.
        let x = self.image();
        let spread = self.kernel.iter().zip(&self.spectrum).map(|(k, x)| k * x).collect();
        let blurred = crop(&self.back(spread), self.size, padded);
        self.energy = 0.0;
        let mut pushed = Vec::with_capacity(x.len());
        for (i, e) in self.response.iter().enumerate() {
            let v = blurred[i] + self.blur_dual[i];
            let r = self.target[i] - (e.conj() * blurred[i]).re;
            self.energy += r * r;
            let nu = v + e * ((self.target[i] - (e.conj() * v).re) / (e.norm_sqr() + rho));
            self.blur_dual[i] = v - nu;
            pushed.push(nu - self.blur_dual[i] - blurred[i]);
        }

        // z = x: the guided filter, no longer than S0.
        let mut rhs = vec![Complex64::ZERO; padded.pixels()];
        let input: Vec<_> = x.iter().zip(&self.prior_dual).map(|(x, u)| x + u).collect();
        let filtered = self.filter.run(&input);
        for (i, input) in input.iter().enumerate() {
            let z = shorten(filtered[i], self.guide[i]);
            self.prior_dual[i] = input - z;
            rhs[i / width * padded.width + i % width] += (z - self.prior_dual[i]) * t;
        }

        // d = ∇x: shrinkage inside; differences that leave the sensor keep what they are, with nothing behind the border.
        let place = |y: usize, x: usize| y % padded.height * padded.width + x % padded.width;
        let mut flow = |y: usize, x: usize, axis: usize, d: Complex64| {
            let (below, right) = if axis == 0 { (y, x + 1) } else { (y + 1, x) };
            rhs[place(below, right)] += d * t;
            rhs[place(y, x)] -= d * t;
        };
        for i in 0..x.len() {
            let (row, column) = (i / width, i % width);
            let inside = [column + 1 < width, row + 1 < height];
            let next = [1, width];
            let v: [Complex64; 2] = std::array::from_fn(|axis| {
                if inside[axis] { x[i + next[axis]] - x[i] + self.gradient_dual[axis][i] } else { Complex64::ZERO }
            });
            let length = (v[0].norm_sqr() + v[1].norm_sqr()).sqrt();
            let threshold = self.threshold * self.edges[i];
            let keep = if length > threshold { 1.0 - threshold / length } else { 0.0 };
            for axis in [0, 1] {
                if inside[axis] {
                    let d = v[axis] * keep;
                    self.gradient_dual[axis][i] = v[axis] - d;
                    flow(row, column, axis, d - self.gradient_dual[axis][i]);
                } else {
                    flow(row, column, axis, -x[i]);
                }
            }
            if column == 0 {
                flow(row, padded.width - 1, 0, x[i]);
            }
            if row == 0 {
                flow(padded.height - 1, column, 1, x[i]);
            }
        }

        let data = self.transform.run(pad(&pushed, self.size, padded), 0);
        let prior = self.transform.run(rhs, 0);
        for (i, x) in self.spectrum.iter_mut().enumerate() {
            let (k, power) = (self.kernel[i], self.kernel[i].norm_sqr());
            let sum = rho * (power * *x + k.conj() * data[i]) + prior[i];
            *x = sum / (rho * power + t + t * self.laplacian[i]);
        }
    }
}

/// An image on the circle, zero beyond the sensor.
fn pad(image: &[Complex64], size: Size, padded: Size) -> Vec<Complex64> {
    let mut out = vec![Complex64::ZERO; padded.pixels()];
    image.iter().enumerate().for_each(|(i, v)| out[i / size.width * padded.width + i % size.width] = *v);
    out
}

fn crop(image: &[Complex64], size: Size, padded: Size) -> Vec<Complex64> {
    (0..size.pixels()).map(|i| image[i / size.width * padded.width + i % size.width]).collect()
}

/// k * x on the circle.
fn blur(transform: &Transform, kernel: &[Complex64], image: &[Complex64], size: Size) -> Vec<Complex64> {
    let spectrum = transform.run(pad(image, size, transform.size), 0);
    let share = 1.0 / spectrum.len() as f64;
    transform.run(spectrum.iter().zip(kernel).map(|(x, k)| x * k * share).collect(), 1)
}

/// The guide filtered by itself over 3×3, as strongly as its noise asks for.
fn denoised(guide: &[f64], size: Size) -> Vec<f64> {
    let width = size.width;
    let mut cells: Vec<f64> = (0..size.height / 2)
        .flat_map(|y| (0..width / 2).map(move |x| 2 * y * width + 2 * x))
        .map(|i| 0.5 * (guide[i] - guide[i + 1] - guide[i + width] + guide[i + width + 1]).abs())
        .collect();
    cells.sort_by(f64::total_cmp);
    let noise = cells[((cells.len() - 1) as f64 * 0.2) as usize] / 0.2533;
    let image: Vec<_> = guide.iter().map(|g| Complex64::from(*g)).collect();
    Filter::new(guide, size, 1, noise * noise).run(&image).iter().map(|v| v.re.max(0.0)).collect()
}

/// 1/(1 + |∇ḡ|/κ), ḡ the mean over 3×3.
fn edge_weights(guide: &[f64], size: Size, brightness: f64) -> Vec<f64> {
    let mean = window_mean(&guide.iter().map(|g| Complex64::from(*g)).collect::<Vec<_>>(), size, 1);
    let step = |i: usize, inside: bool, next: usize| if inside { (mean[i + next] - mean[i]).re } else { 0.0 };
    let weight = |i: usize| {
        let right = step(i, i % size.width + 1 < size.width, 1);
        let below = step(i, i / size.width + 1 < size.height, size.width);
        1.0 / (1.0 + right.hypot(below) / (brightness * EDGE))
    };
    (0..guide.len()).map(weight).collect()
}
