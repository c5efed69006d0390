//! The direct start: the unknown images' slowest modes, solved for exactly instead of iterated for.
//!
//! A diffuser's |K|² falls by orders of magnitude within a few cycles a frame, so steps sized by the slowest modes leave
//! everything else behind. Each unknown real plane (S0, S1, S2, whichever are solved for) is therefore first taken as
//! Σ c_ij b_i(y) b_j(x), cosines b (DCT-II) of 16 frequencies a side, and found by regularized least squares:
//! (H + R) c = Bᵀ Aᵀ y with H = Bᵀ AᵀA B made once for a camera and R a ridge that grows with frequency². A frame costs one
//! adjoint, thin products and two triangular solves; a new ridge costs one factorization.
//!
//! H is summed over a few rows at a time, for the blurred modes are smooth and vertical stripes do not change along a column;
//! columns are never merged, for the mask changes from one to the next.

use std::sync::atomic::{AtomicU64, Ordering};

use nalgebra::DMatrix;
use num_complex::Complex32;

use super::convolve::Direction;
use super::operator::StokesOperator;
use crate::plane::Size;

/// Modes a side. Higher ones of a diffuser that spreads light over a large part of the frame are below the noise.
const MODES: usize = 16;
/// Row bins, at most: the fastest product of two modes has 16 cycles a frame.
const ROW_BINS: usize = 84;
/// Samples of H summed at a time.
const PANEL: usize = 2048;
/// Relative change of the ridge that is worth a new factorization.
const REFACTOR: f64 = 0.2;

/// The normal equations of one camera.
#[derive(Debug)]
pub struct Coarse {
    size: Size,
    /// b_i at each row, `[modes, height]`, and b_j at each column, `[modes, width]`; orthonormal.
    rows: DMatrix<f32>,
    columns: DMatrix<f32>,
    /// Unknown planes.
    planes: usize,
    /// H, lower triangle row after row; plane after plane.
    gram: Vec<f32>,
    /// H₀₀, the scale of the ridge.
    first: f64,
    /// Tells these equations from others that use the same workspace.
    id: u64,
}

/// Buffers of one solve.
#[derive(Debug)]
pub struct CoarseWorkspace {
    /// An image multiplied with one of the two bases, `[modes, width]`.
    half: Vec<Complex32>,
    /// Cholesky factor of H + R, packed like H.
    factor: Vec<f64>,
    /// The ridges and the equations it was made for.
    ridges: [f64; 3],
    id: u64,
}

impl Coarse {
    /// Builds the normal equations for the unknown planes that the sensor weighs with `responses` (m0, or m1 and m2, or all
    /// three). Allocates; costs one convolution for two modes.
    pub fn new(operator: &StokesOperator, responses: &[Vec<f32>]) -> Self {
        let size = operator.convolver.size();
        let rows = cosines(MODES.min(size.height), size.height);
        let columns = cosines(MODES.min(size.width), size.width);
        let gram = gram(operator, responses, &rows, &columns);
        let first = f64::from(gram[0]).max(f64::MIN_POSITIVE);
        static NEXT: AtomicU64 = AtomicU64::new(1);
        let id = NEXT.fetch_add(1, Ordering::Relaxed);
        Self { size, rows, columns, planes: responses.len(), gram, first, id }
    }

    /// Unknowns of one plane.
    pub fn modes(&self) -> usize {
        self.rows.nrows() * self.columns.nrows()
    }

    /// All unknowns.
    pub fn unknowns(&self) -> usize {
        self.planes * self.modes()
    }

    /// Bytes of the equations.
    pub fn bytes(&self) -> usize {
        (self.gram.len() + self.rows.len() + self.columns.len()) * size_of::<f32>()
    }

    /// Bytes of one [`CoarseWorkspace`].
    pub fn workspace_bytes(&self) -> usize {
        self.rows.nrows() * self.size.width * size_of::<Complex32>() + self.gram.len() * size_of::<f64>()
    }

    /// Buffers for one solve at a time. Allocates.
    pub fn make_workspace(&self) -> CoarseWorkspace {
        CoarseWorkspace {
            half: vec![Complex32::ZERO; self.rows.nrows() * self.size.width],
            factor: vec![0.0; self.gram.len()],
            ridges: [f64::NAN; 3],
            id: 0,
        }
    }

    /// Factors H + R for a ridge relative to H₀₀ for each plane, unless the last factor is close enough. Should rounding
    /// leave the matrix indefinite, the ridge is raised until it is not.
    pub fn factor(&self, ridges: [f64; 3], w: &mut CoarseWorkspace) {
        if w.id == self.id && (0..self.planes).all(|p| (ridges[p] / w.ridges[p]).ln().abs() < REFACTOR) {
            return;
        }
        w.ridges = ridges;
        w.id = self.id;
        while !self.try_factor(w.ridges, &mut w.factor) {
            w.ridges = w.ridges.map(|r| 10.0 * r.max(1e-12));
        }
    }

    fn try_factor(&self, ridges: [f64; 3], factor: &mut [f64]) -> bool {
        for k in 0..self.unknowns() {
            let ridge = self.ridge(k, ridges);
            let row = k * (k + 1) / 2;
            for c in 0..=k {
                let column = c * (c + 1) / 2;
                let (done, rest) = factor.split_at_mut(row);
                // Row c of the factor lies before row k, except on the diagonal, where it is row k itself.
                let above = if c == k { &rest[..c] } else { &done[column..column + c] };
                let product: f64 = rest[..c].iter().zip(above).map(|(a, b)| a * b).sum();
                let value = f64::from(self.gram[row + c]) - product;
                rest[c] = if c == k {
                    let pivot = value + ridge;
                    if pivot.is_nan() || pivot <= 0.0 {
                        return false;
                    }
                    pivot.sqrt()
                } else {
                    value / done[column + c]
                };
            }
        }
        true
    }

    /// Replaces the right-hand side by the solution. Allocates nothing.
    pub fn solve(&self, x: &mut [f64], w: &CoarseWorkspace) {
        self.whiten(x, w);
        self.unwhiten(x, w);
    }

    /// x ← F⁻¹ x, with the Cholesky factor F of H + R: then ⟨x, x⟩ is what the modes take off a sum of squares. Allocates
    /// nothing.
    pub fn whiten(&self, x: &mut [f64], w: &CoarseWorkspace) {
        for k in 0..self.unknowns() {
            let l = &w.factor[k * (k + 1) / 2..][..=k];
            let sum: f64 = l[..k].iter().zip(&*x).map(|(l, x)| l * x).sum();
            x[k] = (x[k] - sum) / l[k];
        }
    }

    /// x ← F⁻ᵀ x. Allocates nothing.
    pub fn unwhiten(&self, x: &mut [f64], w: &CoarseWorkspace) {
        for k in (0..self.unknowns()).rev() {
            let l = &w.factor[k * (k + 1) / 2..][..=k];
            let value = x[k] / l[k];
            x[k] = value;
            x[..k].iter_mut().zip(l).for_each(|(x, l)| *x -= l * value);
        }
    }

    /// Subtracts R c from `x`; returns ⟨c, R c⟩. Allocates nothing.
    pub fn subtract_ridge(&self, c: &[f64], x: &mut [f64], w: &CoarseWorkspace) -> f64 {
        let mut penalty = 0.0;
        for (k, (x, c)) in x.iter_mut().zip(c).enumerate() {
            let r = self.ridge(k, w.ridges);
            *x -= r * c;
            penalty += r * c * c;
        }
        penalty
    }

    /// R_kk.
    fn ridge(&self, k: usize, ridges: [f64; 3]) -> f64 {
        let modes = self.modes();
        let (i, j) = (k % modes / self.columns.nrows(), k % modes % self.columns.nrows());
        self.first * ridges[k / modes].max(1e-12) * ((i * i + j * j) as f64 + 1e-3)
    }

    /// Bᵀ image: real parts into `re`, imaginary ones into `im` (or nowhere, if it is empty).
    pub fn project(&self, image: &[Complex32], re: &mut [f64], im: &mut [f64], w: &mut CoarseWorkspace) {
        let width = self.size.width;
        w.half.fill(Complex32::ZERO);
        for (y, line) in image.chunks_exact(width).enumerate() {
            for (i, half) in w.half.chunks_exact_mut(width).enumerate() {
                let b = self.rows[(i, y)];
                half.iter_mut().zip(line).for_each(|(h, v)| *h += v * b);
            }
        }
        let nj = self.columns.nrows();
        for (i, half) in w.half.chunks_exact(width).enumerate() {
            for j in 0..nj {
                let c: Complex32 = half.iter().enumerate().map(|(x, h)| h * self.columns[(j, x)]).sum();
                re[i * nj + j] = f64::from(c.re);
                if let Some(im) = im.get_mut(i * nj + j) {
                    *im = f64::from(c.im);
                }
            }
        }
    }

    /// image = B c, for coefficients of the real and the imaginary part (none if empty).
    pub fn synthesize(&self, re: &[f64], im: &[f64], image: &mut [Complex32], w: &mut CoarseWorkspace) {
        let (width, nj) = (self.size.width, self.columns.nrows());
        for (i, half) in w.half.chunks_exact_mut(width).enumerate() {
            half.fill(Complex32::ZERO);
            for j in 0..nj {
                let c = Complex32::new(re[i * nj + j] as f32, im.get(i * nj + j).copied().unwrap_or(0.0) as f32);
                half.iter_mut().enumerate().for_each(|(x, h)| *h += c * self.columns[(j, x)]);
            }
        }
        for (y, line) in image.chunks_exact_mut(width).enumerate() {
            line.fill(Complex32::ZERO);
            for (i, half) in w.half.chunks_exact(width).enumerate() {
                let b = self.rows[(i, y)];
                line.iter_mut().zip(half).for_each(|(v, h)| *v += h * b);
            }
        }
    }
}

/// The first `count` functions of the orthonormal DCT-II of length `n`.
fn cosines(count: usize, n: usize) -> DMatrix<f32> {
    DMatrix::from_fn(count, n, |i, x| {
        let norm = if i == 0 { 1.0 } else { 2.0 } / n as f64;
        let phase = std::f64::consts::PI * (x as f64 + 0.5) * i as f64 / n as f64;
        (norm.sqrt() * phase.cos()) as f32
    })
}

/// H = Bᵀ AᵀA B, packed.
fn gram(operator: &StokesOperator, responses: &[Vec<f32>], rows: &DMatrix<f32>, columns: &DMatrix<f32>) -> Vec<f32> {
    let Size { width, height } = operator.convolver.size();
    let nj = columns.nrows();
    let modes = rows.nrows() * nj;
    let bins = height.min(ROW_BINS);
    let bin = |y: usize| y * bins / height;
    let counts = (0..height).fold(vec![0.0f32; bins], |mut counts, y| {
        counts[bin(y)] += 1.0;
        counts
    });
    // Blurred modes averaged over the rows of a bin, `[samples, modes]`; two to a convolution.
    let mut blurred = DMatrix::<f32>::zeros(bins * width, modes);
    let mut scratch = operator.convolver.make_scratch();
    let mut image = vec![Complex32::ZERO; width * height];
    for first in (0..modes).step_by(2) {
        let second = (first + 1).min(modes - 1);
        operator.convolver.run(
            &operator.kernel,
            Direction::Forward,
            |y, line| {
                let (a, b) = (rows[(first / nj, y)], rows[(second / nj, y)]);
                for (x, v) in line.iter_mut().enumerate() {
                    *v = Complex32::new(a * columns[(first % nj, x)], b * columns[(second % nj, x)]);
                }
            },
            &mut image,
            |_, line, out| out.copy_from_slice(line),
            &mut scratch,
        );
        for (y, line) in image.chunks_exact(width).enumerate() {
            let (at, share) = (bin(y) * width, 1.0 / counts[bin(y)]);
            for (x, v) in line.iter().enumerate() {
                blurred[(at + x, first)] += v.re * share;
                if second != first {
                    blurred[(at + x, second)] += v.im * share;
                }
            }
        }
    }
    let unknowns = responses.len() * modes;
    let mut packed = vec![0.0f32; unknowns * (unknowns + 1) / 2];
    for p in 0..responses.len() {
        for q in 0..=p {
            // Sums of m_p m_q over the rows of each bin.
            let mut weights = vec![0.0f32; bins * width];
            for (i, (a, b)) in responses[p].iter().zip(&responses[q]).enumerate() {
                weights[bin(i / width) * width + i % width] += a * b;
            }
            let h = weighted_product(&blurred, &weights);
            for i in 0..modes {
                let row = p * modes + i;
                for j in 0..modes {
                    let column = q * modes + j;
                    if column <= row {
                        packed[row * (row + 1) / 2 + column] = h[(i, j)];
                    }
                }
            }
        }
    }
    packed
}

/// Vᵀ diag(w) V, a panel of samples at a time.
fn weighted_product(v: &DMatrix<f32>, weights: &[f32]) -> DMatrix<f32> {
    let modes = v.ncols();
    let mut product = DMatrix::zeros(modes, modes);
    // Transposed by hand: the library's product of a transposed matrix is not blocked and an order of magnitude slower.
    let mut weighted = DMatrix::zeros(modes, PANEL.min(v.nrows()));
    for start in (0..v.nrows()).step_by(PANEL) {
        let panel = v.rows(start, PANEL.min(v.nrows() - start));
        let mut scaled = weighted.columns_mut(0, panel.nrows());
        panel.transpose_to(&mut scaled);
        for (mut sample, weight) in scaled.column_iter_mut().zip(&weights[start..]) {
            sample *= *weight;
        }
        product.gemm(1.0, &scaled, &panel, 1.0);
    }
    product
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::optics::{FftBackend, Psf, Response};
    use crate::parallel::Workers;
    use crate::plane::{Angle, Stack};

    #[test]
    fn slow_polarization_is_found_without_an_iteration() {
        let size = Size::new(96, 80);
        let disc = |i: usize| {
            let (dy, dx) = ((i / 96) as f32 - 40.0, (i % 96) as f32 - 48.0);
            if dx.hypot(dy) < 18.0 { 1.0 + (0.7 * dx + 0.2 * dy).sin() * (0.9 * dy).cos() } else { 0.0 }
        };
        let psf = Stack::from_vec(1, size, (0..size.pixels()).map(disc).collect()).unwrap();
        let psf = Psf::new(psf, size, 1).unwrap();
        let response = Response::stripes(size, Angle::four(), 16, f64::INFINITY).unwrap();
        let workers = Arc::new(Workers::new(1));
        let op = StokesOperator::for_channels(&psf, &response, 1, FftBackend::Rustfft, workers).unwrap().remove(0);
        let (m1, m2) = response.polarized().iter().map(|e| (e.re, e.im)).unzip();
        let coarse = Coarse::new(&op, &[m1, m2]);
        let truth: Vec<_> = (0..size.pixels())
            .map(|i| {
                let (y, x) = ((i / 96) as f32 / 80.0, (i % 96) as f32 / 96.0);
                Complex32::new(0.3 + 0.2 * (5.0 * x).sin() * y, 0.1 - 0.3 * (4.0 * y + x).cos())
            })
            .collect();
        let (mut y, mut scratch) = (vec![0.0; size.pixels()], op.convolver.make_scratch());
        op.forward_polarized(&truth, &mut y, &mut scratch);
        let mut got = vec![Complex32::ZERO; size.pixels()];
        op.adjoint_polarized(&y, &mut got, &mut scratch);
        let mut w = coarse.make_workspace();
        coarse.factor([1e-6; 3], &mut w);
        let mut x = vec![0.0; coarse.unknowns()];
        let (re, im) = x.split_at_mut(coarse.modes());
        coarse.project(&got, re, im, &mut w);
        coarse.solve(&mut x, &w);
        let (re, im) = x.split_at(coarse.modes());
        coarse.synthesize(re, im, &mut got, &mut w);
        let rms = |f: &dyn Fn(usize) -> f32| ((0..got.len()).map(f).sum::<f32>() / got.len() as f32).sqrt();
        let error = rms(&|i| (got[i] - truth[i]).norm_sqr());
        let signal = rms(&|i| truth[i].norm_sqr());
        assert!(error < 0.03 * signal, "{error} of {signal}");
    }

    #[test]
    fn an_empty_system_gives_nothing_rather_than_nan() {
        let size = Size::new(20, 20);
        let mut k = vec![0.0; 400];
        k[210] = 1.0;
        let psf = Psf::new(Stack::from_vec(1, size, k).unwrap(), size, 1).unwrap();
        let workers = Arc::new(Workers::new(1));
        let op = StokesOperator::for_channels(&psf, &Response::none(size), 1, FftBackend::Rustfft, workers)
            .unwrap()
            .remove(0);
        let coarse = Coarse::new(&op, &[vec![0.0; 400]]);
        let mut w = coarse.make_workspace();
        coarse.factor([1e-6; 3], &mut w);
        let mut x = vec![0.0; coarse.unknowns()];
        coarse.solve(&mut x, &w);
        assert!(x.iter().all(|v| *v == 0.0));
    }
}
