//! The forward model A and its adjoint Aᵀ, in Stokes form and in the paper's angle form.
//!
//! Stokes: y = m0 ⊙ (k * S0) + Re(ē ⊙ (k * L)) with L = S1 + i·S2 and e = m1 + i·m2; Aᵀr = (k̃ * (m0 ⊙ r), k̃ * (e ⊙ r)).
//! Angles: y = Σ_p w_p ⊙ (k * x_p); Aᵀr = k̃ * (w_p ⊙ r) for each p. Two angles share one complex convolution.

use std::ops::Range;
use std::sync::Arc;

use num_complex::Complex32;

use super::convolve::{Convolver, Kernel, LengthError, Scratch};
use super::fft::{Direction, FftBackend};
use super::field::{Field, Margin};
use super::psf::Psf;
use super::response::Response;
use crate::image::Stack;
use crate::parallel::Workers;

/// The camera in Stokes form, for one colour channel.
#[derive(Clone, Debug)]
pub struct StokesOperator {
    /// The planned convolution.
    pub convolver: Convolver,
    /// The channel's PSF.
    pub kernel: Arc<Kernel>,
    /// The sensor's response maps.
    pub response: Arc<Response>,
}

impl StokesOperator {
    /// One operator for each colour channel, for scenes that end with the frame. They share what is equal, so that clones are cheap.
    /// Allocates.
    ///
    /// # Errors
    /// [`LengthError`] when the backend cannot transform frames this large.
    pub fn for_channels(
        psf: &Psf,
        response: &Response,
        channels: usize,
        backend: FftBackend,
        workers: Arc<Workers>,
    ) -> Result<Vec<Self>, LengthError> {
        Self::on_field(psf, response, channels, Margin::default(), backend, workers)
    }

    /// As [`Self::for_channels`], for scenes that go on for `margin` beyond the frame. Allocates.
    ///
    /// # Errors
    /// [`LengthError`] when the backend cannot transform fields this large.
    pub fn on_field(
        psf: &Psf,
        response: &Response,
        channels: usize,
        margin: Margin,
        backend: FftBackend,
        workers: Arc<Workers>,
    ) -> Result<Vec<Self>, LengthError> {
        let field = Field::new(psf.size(), margin);
        let convolver = Convolver::new(field, psf.reach(), backend, workers)?;
        Ok(Self::each(&convolver, &Arc::new(response.within(field)), psf, channels))
    }

    /// The field.
    pub fn field(&self) -> Field {
        self.convolver.field()
    }

    /// This camera behind another PSF, one operator for each colour channel; what the planned convolution has no room for is left out.
    /// Allocates.
    pub fn behind(&self, psf: &Psf, channels: usize) -> Vec<Self> {
        Self::each(&self.convolver, &self.response, psf, channels)
    }

    fn each(convolver: &Convolver, response: &Arc<Response>, psf: &Psf, channels: usize) -> Vec<Self> {
        let kernel = |c: usize| Arc::new(convolver.kernel(psf.channel(c), psf.size()));
        let kernels: Vec<_> = (0..psf.count()).map(kernel).collect();
        let operator = |c: usize| Self {
            convolver: convolver.clone(),
            kernel: Arc::clone(&kernels[c.min(kernels.len() - 1)]),
            response: Arc::clone(response),
        };
        (0..channels).map(operator).collect()
    }

    /// m1 and m2 as planes of their own. Allocates.
    pub fn polarized_responses(&self) -> Vec<Vec<f32>> {
        let e = self.response.polarized();
        vec![e.iter().map(|e| e.re).collect(), e.iter().map(|e| e.im).collect()]
    }

    /// This camera in angle form. Allocates the weights.
    pub fn angle_form(&self) -> AngleOperator {
        AngleOperator {
            convolver: self.convolver.clone(),
            kernel: Arc::clone(&self.kernel),
            weights: self.response.angle_weights(),
        }
    }

    /// y = k * x, without the mask.
    pub fn blur(&self, x: &[f32], y: &mut [f32], scratch: &mut Scratch) {
        let width = self.convolver.size().width;
        self.convolver.run(
            &self.kernel,
            Direction::Forward,
            |row, line| load_real(line, &x[row * width..]),
            y,
            |_, line, y| y.iter_mut().zip(line).for_each(|(y, v)| *y = v.re),
            scratch,
        );
    }

    /// y = m0 ⊙ (k * S0).
    pub fn forward_s0(&self, s0: &[f32], y: &mut [f32], scratch: &mut Scratch) {
        let (m0, width) = (self.response.unpolarized(), self.convolver.size().width);
        self.convolver.run(
            &self.kernel,
            Direction::Forward,
            |row, line| load_real(line, &s0[row * width..]),
            y,
            |row, line, y| y.iter_mut().zip(line).zip(&m0[row * width..]).for_each(|((y, v), m)| *y = m * v.re),
            scratch,
        );
    }

    /// Readings y of the Stokes images `[3, H, W]`, or of S0 alone without a mask.
    pub fn forward(&self, stokes: &[f32], y: &mut [f32], scratch: &mut Scratch) {
        self.forward_without(|_| None, stokes, y, scratch);
    }

    /// Readings of the light from beyond the frame: as [`Self::forward`], with the frame of the images taken for dark.
    pub fn forward_margin(&self, stokes: &[f32], y: &mut [f32], scratch: &mut Scratch) {
        let field = self.field();
        self.forward_without(|row| field.shown_columns(row), stokes, y, scratch);
    }

    /// As [`Self::forward`], with the columns `dark(row)` of the images taken for dark.
    fn forward_without(
        &self,
        dark: impl Fn(usize) -> Option<Range<usize>> + Sync,
        stokes: &[f32],
        y: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let (n, width) = (self.convolver.size().pixels(), self.convolver.size().width);
        let load = |row: usize, line: &mut [Complex32], planes: [&[f32]; 2]| {
            for (x, v) in line.iter_mut().enumerate() {
                let i = row * width + x;
                *v = Complex32::new(planes[0][i], planes[1].get(i).copied().unwrap_or(0.0));
            }
            dark(row).into_iter().for_each(|columns| line[columns].fill(Complex32::ZERO));
        };
        let (m0, kernel) = (self.response.unpolarized(), &self.kernel);
        self.convolver.run(
            kernel,
            Direction::Forward,
            |row, line| load(row, line, [&stokes[..n], &[]]),
            y,
            |row, line, y| y.iter_mut().zip(line).zip(&m0[row * width..]).for_each(|((y, v), m)| *y = m * v.re),
            scratch,
        );
        if !self.response.is_polarized() {
            return;
        }
        let e = self.response.polarized();
        self.convolver.run(
            kernel,
            Direction::Forward,
            |row, line| load(row, line, [&stokes[n..2 * n], &stokes[2 * n..3 * n]]),
            y,
            |row, line, y| {
                y.iter_mut().zip(line).zip(&e[row * width..]).for_each(|((y, v), e)| *y += e.re * v.re + e.im * v.im);
            },
            scratch,
        );
    }

    /// S0 = k̃ * (m0 ⊙ r).
    pub fn adjoint_s0(&self, r: &[f32], s0: &mut [f32], scratch: &mut Scratch) {
        let (m0, width) = (self.response.unpolarized(), self.convolver.size().width);
        self.convolver.run(
            &self.kernel,
            Direction::Adjoint,
            |row, line| {
                let at = row * width;
                line.iter_mut().zip(&m0[at..]).zip(&r[at..]).for_each(|((v, m), r)| *v = Complex32::from(m * r));
            },
            s0,
            |_, line, s0| s0.iter_mut().zip(line).for_each(|(s, v)| *s = v.re),
            scratch,
        );
    }

    /// y = Re(ē ⊙ (k * L)).
    ///
    /// # Panics
    /// Without a mask there is no polarized response.
    pub fn forward_polarized(&self, l: &[Complex32], y: &mut [f32], scratch: &mut Scratch) {
        let (e, width) = (self.response.polarized(), self.convolver.size().width);
        self.convolver.run(
            &self.kernel,
            Direction::Forward,
            |row, line| line.copy_from_slice(&l[row * width..][..width]),
            y,
            |row, line, y| {
                y.iter_mut().zip(line).zip(&e[row * width..]).for_each(|((y, v), e)| *y = e.re * v.re + e.im * v.im);
            },
            scratch,
        );
    }

    /// L = k̃ * (e ⊙ r).
    ///
    /// # Panics
    /// Without a mask there is no polarized response.
    pub fn adjoint_polarized(&self, r: &[f32], l: &mut [Complex32], scratch: &mut Scratch) {
        let (e, width) = (self.response.polarized(), self.convolver.size().width);
        self.convolver.run(
            &self.kernel,
            Direction::Adjoint,
            |row, line| {
                let at = row * width;
                line.iter_mut().zip(&e[at..]).zip(&r[at..]).for_each(|((v, e), r)| *v = e * r);
            },
            l,
            |_, line, l| l.copy_from_slice(line),
            scratch,
        );
    }
}

fn load_real(line: &mut [Complex32], values: &[f32]) {
    line.iter_mut().zip(values).for_each(|(v, s)| *v = Complex32::from(*s));
}

/// The camera in the paper's angle form, for one colour channel.
#[derive(Clone, Debug)]
pub struct AngleOperator {
    /// The planned convolution.
    pub convolver: Convolver,
    /// The channel's PSF.
    pub kernel: Arc<Kernel>,
    /// Weight of each angle at each pixel, `[P, height, width]`.
    pub weights: Stack<f32>,
}

impl AngleOperator {
    /// y = Σ_p w_p ⊙ (k * x_p), for x = `[P, height, width]`.
    pub fn forward(&self, x: &[f32], y: &mut [f32], scratch: &mut Scratch) {
        let (n, width) = (self.convolver.size().pixels(), self.convolver.size().width);
        y.fill(0.0);
        for (w, x) in self.weights.as_slice().chunks(2 * n).zip(x.chunks(2 * n)) {
            self.convolver.run(
                &self.kernel,
                Direction::Forward,
                |row, line| load_pair(line, x, row * width, n),
                y,
                |row, line, y| {
                    let at = row * width;
                    y.iter_mut().zip(line).zip(&w[at..]).for_each(|((y, v), w)| *y += w * v.re);
                    if let Some(w) = w.get(n + at..) {
                        y.iter_mut().zip(line).zip(w).for_each(|((y, v), w)| *y += w * v.im);
                    }
                },
                scratch,
            );
        }
    }

    /// x_p = k̃ * (w_p ⊙ r), for x = `[P, height, width]`.
    ///
    /// `pair` holds two angles interleaved, 2 × height × width values; it is scratch.
    pub fn adjoint(&self, r: &[f32], x: &mut [f32], pair: &mut [f32], scratch: &mut Scratch) {
        let (n, width) = (self.convolver.size().pixels(), self.convolver.size().width);
        for (w, x) in self.weights.as_slice().chunks(2 * n).zip(x.chunks_mut(2 * n)) {
            self.convolver.run(
                &self.kernel,
                Direction::Adjoint,
                |row, line| {
                    let at = row * width;
                    load_pair(line, w, at, n);
                    line.iter_mut().zip(&r[at..]).for_each(|(v, r)| *v *= r);
                },
                pair,
                |_, line, pair| {
                    let (re, im) = pair.split_at_mut(width);
                    re.iter_mut().zip(line).for_each(|(p, v)| *p = v.re);
                    im.iter_mut().zip(line).for_each(|(p, v)| *p = v.im);
                },
                scratch,
            );
            for (half, x) in x.chunks_mut(n).enumerate() {
                for (row, pair) in x.chunks_exact_mut(width).zip(pair.chunks_exact(2 * width)) {
                    row.copy_from_slice(&pair[half * width..][..width]);
                }
            }
        }
    }
}

/// Row at `at` of one or two planes of `n` values as real and imaginary part.
fn load_pair(line: &mut [Complex32], planes: &[f32], at: usize, n: usize) {
    load_real(line, &planes[at..n]);
    if let Some(second) = planes.get(n + at..) {
        line.iter_mut().zip(second).for_each(|(v, s)| v.im = *s);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::image::Size;
    use crate::polarization::Angle;

    fn noise(n: usize, seed: u64) -> Vec<f32> {
        let mut s = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
        (0..n)
            .map(|_| {
                s ^= s << 13;
                s ^= s >> 7;
                s ^= s << 17;
                (s >> 40) as f32 / (1 << 24) as f32 - 0.5
            })
            .collect()
    }

    fn operator(size: Size, backend: FftBackend, threads: usize, response: &Response, seed: u64) -> StokesOperator {
        // some noise passes for a pedestal without light on it
        let psf = |seed| {
            let k = noise(size.pixels(), seed).iter().map(|v| v.abs()).collect();
            Psf::new(Stack::from_vec(1, size, k).unwrap(), size, 1).ok()
        };
        let psf = (seed..).find_map(psf).unwrap();
        let workers = Arc::new(Workers::new(threads));
        StokesOperator::for_channels(&psf, response, 1, backend, workers).unwrap().remove(0)
    }

    fn dot(a: &[f32], b: &[f32]) -> f64 {
        a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
    }

    fn complex(v: &[f32]) -> Vec<Complex32> {
        v.chunks(2).map(|p| Complex32::new(p[0], p[1])).collect()
    }

    fn reals(v: &[Complex32]) -> Vec<f32> {
        v.iter().flat_map(|c| [c.re, c.im]).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

        /// ⟨Ax, r⟩ = ⟨x, Aᵀr⟩ and A(x + 2z) = Ax + 2Az, for every form, size, backend and number of threads.
        #[test]
        fn adjoint_and_linear(w in 4usize..40, h in 1usize..40, p in 3usize..=5, threads in 1usize..4, seed in 1u64..1000) {
            let size = Size::new(w.max(p), h);
            let n = size.pixels();
            for backend in FftBackend::ALL {
                let angles = (0..p).map(|i| Angle::from_degrees(i as f64 * 180.0 / p as f64)).collect();
                let response = Response::stripes(size, angles, p, 50.0).unwrap();
                let s = operator(size, backend, threads, &response, seed);
                let a = s.angle_form();
                let mut scratch = s.convolver.make_scratch();
                let r = noise(n, seed + 1);
                let tolerance = 1e-5 * n as f64;
                let mut y = vec![0.0; n];
                let mut yz = vec![0.0; n];

                let (x, z) = (noise(n, seed + 2), noise(n, seed + 3));
                s.forward_s0(&x, &mut y, &mut scratch);
                let mut back = vec![f32::NAN; n];
                s.adjoint_s0(&r, &mut back, &mut scratch);
                prop_assert!((dot(&y, &r) - dot(&x, &back)).abs() < tolerance);
                s.forward_s0(&z, &mut yz, &mut scratch);
                let sum: Vec<f32> = x.iter().zip(&z).map(|(x, z)| x + 2.0 * z).collect();
                let mut ysum = vec![0.0; n];
                s.forward_s0(&sum, &mut ysum, &mut scratch);
                for i in 0..n {
                    prop_assert!((ysum[i] - y[i] - 2.0 * yz[i]).abs() < 1e-4);
                }

                let l = complex(&noise(2 * n, seed + 4));
                s.forward_polarized(&l, &mut y, &mut scratch);
                let mut back = vec![Complex32::ZERO; n];
                s.adjoint_polarized(&r, &mut back, &mut scratch);
                prop_assert!((dot(&y, &r) - dot(&reals(&l), &reals(&back))).abs() < tolerance);

                let x = noise(p * n, seed + 5);
                a.forward(&x, &mut y, &mut scratch);
                let (mut back, mut pair) = (vec![f32::NAN; p * n], vec![f32::NAN; 2 * n]);
                a.adjoint(&r, &mut back, &mut pair, &mut scratch);
                prop_assert!((dot(&y, &r) - dot(&x, &back)).abs() < tolerance);
            }
        }

        /// A scene that goes on: the readings of a field are those of a sensor as large as the field, cut to the frame, whatever the margin.
        #[test]
        fn readings_of_a_field_are_those_of_a_larger_sensor(
            w in 8usize..30, h in 8usize..30, columns in 0usize..9, rows in 0usize..9, seed in 1u64..1000,
        ) {
            let (frame, margin) = (Size::new(w, h), Margin { columns, rows });
            let field = Field::new(frame, margin);
            // A lopsided PSF whose reach is the margin, or less.
            let mut k = vec![0.0; frame.pixels()];
            let samples = noise(frame.pixels(), seed);
            for (i, (k, v)) in k.iter_mut().zip(&samples).enumerate() {
                let (dx, dy) = ((i % w).abs_diff(w / 2), (i / w).abs_diff(h / 2));
                *k = if dx <= columns && dy <= rows { v.abs() + 0.1 } else { 0.0 };
            }
            let mut whole = vec![0.0; field.size().pixels()];
            for (y, line) in k.chunks_exact(w).enumerate() {
                let at = (y + field.size().height / 2 - h / 2) * field.size().width + field.size().width / 2 - w / 2;
                whole[at..at + w].copy_from_slice(line);
            }
            let response = Response::stripes(frame, Angle::four(), 4, 50.0).unwrap();
            let workers = Arc::new(Workers::new(2));
            let psf = |size, k| Psf::new(Stack::from_vec(1, size, k).unwrap(), size, 1).unwrap();
            let backend = FftBackend::Batched;
            let own = StokesOperator::on_field(&psf(frame, k), &response, 1, margin, backend, Arc::clone(&workers));
            let (own, larger) = (own.unwrap().remove(0), psf(field.size(), whole));
            let larger =
                StokesOperator::for_channels(&larger, &response.within(field), 1, backend, workers).unwrap().remove(0);
            let n = field.size().pixels();
            let (stokes, r) = (noise(3 * n, seed + 1), noise(n, seed + 2));
            let [mut y, mut expected, mut margin_alone] = [vec![0.0; n], vec![0.0; n], vec![0.0; n]];
            own.forward(&stokes, &mut y, &mut own.convolver.make_scratch());
            larger.forward(&stokes, &mut expected, &mut larger.convolver.make_scratch());
            prop_assert!(y.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-4));
            prop_assert!(y.iter().enumerate().all(|(i, y)| field.shows(i) || *y == 0.0));
            let [mut back, mut wanted] = [vec![0.0; n], vec![0.0; n]];
            own.adjoint_s0(&r, &mut back, &mut own.convolver.make_scratch());
            larger.adjoint_s0(&r, &mut wanted, &mut larger.convolver.make_scratch());
            prop_assert!(back.iter().zip(&wanted).all(|(a, b)| (a - b).abs() < 1e-4));
            // Light from the margin and light from the frame add up.
            own.forward_margin(&stokes, &mut margin_alone, &mut own.convolver.make_scratch());
            let inner: Vec<f32> =
                stokes.iter().enumerate().map(|(i, v)| if field.shows(i % n) { *v } else { 0.0 }).collect();
            own.forward(&inner, &mut expected, &mut own.convolver.make_scratch());
            prop_assert!((0..n).all(|i| (y[i] - expected[i] - margin_alone[i]).abs() < 1e-4));
        }

        /// A physical scene (0 ≤ S0 ≤ 1, |L| ≤ S0) gives readings in [0, 1]: light is lost, never made.
        #[test]
        fn readings_are_bounded(seed in 1u64..1000) {
            let size = Size::new(24, 20);
            let response = Response::stripes(size, Angle::four(), 8, f64::INFINITY).unwrap();
            let s = operator(size, FftBackend::Batched, 1, &response, seed);
            let mut scratch = s.convolver.make_scratch();
            let s0: Vec<f32> = noise(size.pixels(), seed).iter().map(|v| v + 0.5).collect();
            let turn = noise(size.pixels(), seed + 7);
            let l: Vec<_> = s0.iter().zip(&turn).map(|(s, t)| Complex32::from_polar(*s, 6.3 * t)).collect();
            let (mut y0, mut y1) = (vec![0.0; size.pixels()], vec![0.0; size.pixels()]);
            s.forward_s0(&s0, &mut y0, &mut scratch);
            s.forward_polarized(&l, &mut y1, &mut scratch);
            for (a, b) in y0.iter().zip(&y1) {
                prop_assert!((-1e-5..=1.0 + 1e-5).contains(&(a + b)));
            }
        }
    }
}
