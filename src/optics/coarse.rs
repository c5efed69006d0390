//! The direct start: the polarized image's few slowest modes, solved exactly instead of iterated for.
//!
//! A diffuser's |K|² falls by orders of magnitude within a few cycles a frame, so gradient steps sized by the slowest modes
//! leave everything else behind. L = Σ c_ij b_i(y) b_j(x), cosines b (DCT-II) of `MODES` frequencies a side, is therefore
//! found first by regularized least squares: (H + R) c = Bᵀ Aᵀ r with the Gram matrix H = Bᵀ AᵀA B made once for a camera.
//! A frame costs one adjoint, two thin products and two triangular solves.
//!
//! Seen the other way round, (H + R)⁻¹ takes the modes out of an estimation problem: the least squares of y over other
//! unknowns and c together is that over the others alone under the form ⟨u, v⟩ − ⟨u′, v′⟩, where v′ = F⁻¹ Bᵀ Aᵀ v and
//! F Fᵀ = H + R ([`Coarse::reduce`]).
//!
//! H needs k * (b_i b_j) only as averages over small blocks: the blurred modes are smooth, the response maps enter as block
//! sums of e eᵀ.

use nalgebra::{DMatrix, DVector};
use num_complex::Complex32;

use super::convolve::{Direction, Scratch};
use super::operator::StokesOperator;
use crate::plane::Size;

/// Modes a side. Higher ones are below the noise for a diffuser that spreads light over a large part of the frame.
const MODES: usize = 16;
/// Blocks a side, at most: the fastest product of two modes has 16 cycles a frame.
const BLOCKS: usize = 84;
/// Ridge at the noise `RIDGE_SIGMA`, relative to H₀₀, for a mode of frequency 1; grows with frequency² and σ^1.5.
const RIDGE: f64 = 1e-5;
const RIDGE_SIGMA: f64 = 0.002;

/// The factored system of one camera.
#[derive(Debug)]
pub struct Coarse {
    size: Size,
    /// b_i at each row, `[modes, height]`, and b_j at each column, `[modes, width]`; orthonormal.
    rows: DMatrix<f32>,
    columns: DMatrix<f32>,
    /// Diagonal of R.
    ridge: DVector<f32>,
    /// Cholesky factor of H + R, lower triangle; real parts first, then imaginary ones.
    factor: DMatrix<f32>,
}

/// Buffers of one solve.
#[derive(Debug)]
pub struct CoarseWorkspace {
    /// Products with one of the two bases, `[modes, width]`.
    half: Vec<Complex32>,
    coefficients: DVector<f32>,
}

impl CoarseWorkspace {
    /// The coefficients c that [`Coarse::solve`] or [`Coarse::estimate`] found: real parts, then imaginary ones.
    pub fn coefficients(&self) -> &[f32] {
        self.coefficients.as_slice()
    }
}

impl Coarse {
    /// Builds and factors the system for noise `sigma`. Allocates; costs one convolution for two modes.
    pub fn new(operator: &StokesOperator, sigma: f32) -> Self {
        let size = operator.convolver.size();
        let rows = cosines(MODES.min(size.height), size.height);
        let columns = cosines(MODES.min(size.width), size.width);
        let modes = rows.nrows() * columns.nrows();
        let h = gram(operator, &rows, &columns);
        let noise = (f64::from(sigma) / RIDGE_SIGMA).powf(1.5);
        let first = h[(0, 0)].max(h[(modes, modes)]).max(f64::MIN_POSITIVE);
        let ridge = DVector::from_fn(2 * modes, |k, _| {
            let (i, j) = (k % modes / columns.nrows(), k % modes % columns.nrows());
            let frequency = (i * i + j * j) as f64;
            first * (RIDGE * noise * frequency + 1e-9)
        });
        let mut system = h;
        (0..2 * modes).for_each(|k| system[(k, k)] += ridge[k]);
        // Positive definite by the ridge; a mask that answers nothing leaves only that, and then zero is the estimate.
        let factor = system.cholesky().map_or_else(|| DMatrix::zeros(0, 0), |c| c.unpack().cast::<f32>());
        Self { size, rows, columns, ridge: ridge.cast(), factor }
    }

    /// Length of what [`Self::reduce`] fills: two for each mode.
    pub fn unknowns(&self) -> usize {
        2 * self.modes()
    }

    fn modes(&self) -> usize {
        self.rows.nrows() * self.columns.nrows()
    }

    /// Bytes of one [`CoarseWorkspace`].
    pub fn workspace_bytes(&self) -> usize {
        self.rows.nrows() * self.size.width * size_of::<Complex32>() + 2 * self.modes() * size_of::<f32>()
    }

    /// Buffers for [`Self::solve`] and [`Self::reduce`]. Allocates.
    pub fn make_workspace(&self) -> CoarseWorkspace {
        CoarseWorkspace {
            half: vec![Complex32::ZERO; self.rows.nrows() * self.size.width],
            coefficients: DVector::zeros(2 * self.modes()),
        }
    }

    /// Bytes of the factor and the bases.
    pub fn bytes(&self) -> usize {
        (self.factor.len() + self.ridge.len() + self.rows.len() + self.columns.len()) * size_of::<f32>()
    }

    /// Replaces `image`, which holds Aᵀr, by the coarse estimate of L. Allocates nothing.
    pub fn solve(&self, image: &mut [Complex32], w: &mut CoarseWorkspace) {
        self.analyze(image, w);
        self.whiten(w);
        self.synthesize(image, w);
    }

    /// The coarse estimate B c of L from r′ ([`Self::reduce`]). Allocates nothing.
    pub fn estimate(&self, reduced: &[f32], image: &mut [Complex32], w: &mut CoarseWorkspace) {
        w.coefficients.as_mut_slice().copy_from_slice(reduced);
        self.synthesize(image, w);
    }

    /// B F⁻ᵀ of what the workspace holds.
    fn synthesize(&self, image: &mut [Complex32], w: &mut CoarseWorkspace) {
        let (width, modes) = (self.size.width, self.modes());
        let (ni, nj) = (self.rows.nrows(), self.columns.nrows());
        if self.factor.is_empty() {
            image.fill(Complex32::ZERO);
            w.coefficients.fill(0.0);
            return;
        }
        self.factor.tr_solve_lower_triangular_mut(&mut w.coefficients);
        for (i, half) in w.half.chunks_exact_mut(width).enumerate() {
            half.fill(Complex32::ZERO);
            for j in 0..nj {
                let c = Complex32::new(w.coefficients[i * nj + j], w.coefficients[modes + i * nj + j]);
                half.iter_mut().enumerate().for_each(|(x, h)| *h += c * self.columns[(j, x)]);
            }
        }
        for (y, line) in image.chunks_exact_mut(width).enumerate() {
            line.fill(Complex32::ZERO);
            for (i, half) in w.half.chunks_exact(width).enumerate().take(ni) {
                let b = self.rows[(i, y)];
                line.iter_mut().zip(half).for_each(|(v, h)| *v += h * b);
            }
        }
    }

    /// Fills `reduced` ([`Self::unknowns`] values) with v′ = F⁻¹ Bᵀ `image`, where `image` holds Aᵀv. Allocates nothing.
    pub fn reduce(&self, image: &[Complex32], reduced: &mut [f32], w: &mut CoarseWorkspace) {
        self.analyze(image, w);
        self.whiten(w);
        reduced.copy_from_slice(w.coefficients.as_slice());
    }

    /// The same for v = y − A B c, where c, `start`, is known beforehand: v′ = F⁻¹ (Bᵀ `image` − R c). Returns c·R c, which
    /// belongs to ⟨v, v⟩. The result is that of y itself, but errors of H count for little.
    pub fn reduce_rest(&self, image: &[Complex32], start: &[f32], reduced: &mut [f32], w: &mut CoarseWorkspace) -> f64 {
        self.analyze(image, w);
        let mut penalty = 0.0;
        for (v, (c, r)) in w.coefficients.iter_mut().zip(start.iter().zip(&self.ridge)) {
            *v -= r * c;
            penalty += f64::from(r * c * c);
        }
        self.whiten(w);
        reduced.copy_from_slice(w.coefficients.as_slice());
        penalty
    }

    /// F⁻¹ of what the workspace holds.
    fn whiten(&self, w: &mut CoarseWorkspace) {
        if self.factor.is_empty() {
            w.coefficients.fill(0.0);
        } else {
            self.factor.solve_lower_triangular_mut(&mut w.coefficients);
        }
    }

    /// Coefficients Bᵀ `image`.
    fn analyze(&self, image: &[Complex32], w: &mut CoarseWorkspace) {
        let (width, modes, nj) = (self.size.width, self.modes(), self.columns.nrows());
        w.half.fill(Complex32::ZERO);
        for (y, line) in image.chunks_exact(width).enumerate() {
            for (i, half) in w.half.chunks_exact_mut(width).enumerate() {
                let b = self.rows[(i, y)];
                half.iter_mut().zip(line).for_each(|(h, v)| *h += v * b);
            }
        }
        for (i, half) in w.half.chunks_exact(width).enumerate() {
            for j in 0..nj {
                let c: Complex32 = half.iter().enumerate().map(|(x, h)| h * self.columns[(j, x)]).sum();
                w.coefficients[i * nj + j] = c.re;
                w.coefficients[modes + i * nj + j] = c.im;
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

/// Bᵀ AᵀA B, real parts first.
fn gram(operator: &StokesOperator, rows: &DMatrix<f32>, columns: &DMatrix<f32>) -> DMatrix<f64> {
    let size = operator.convolver.size();
    let (ni, nj) = (rows.nrows(), columns.nrows());
    let modes = ni * nj;
    let (by, bx) = (size.height.min(BLOCKS), size.width.min(BLOCKS));
    let block = |i: usize| i / size.width * by / size.height * bx + i % size.width * bx / size.width;
    // Block sums of e eᵀ and block sizes.
    let mut weights = vec![[0.0f64; 3]; bx * by];
    let mut counts = vec![0.0f32; bx * by];
    for (i, e) in operator.response.polarized().iter().enumerate() {
        let (re, im) = (f64::from(e.re), f64::from(e.im));
        let w = &mut weights[block(i)];
        w[0] += re * re;
        w[1] += re * im;
        w[2] += im * im;
        counts[block(i)] += 1.0;
    }
    // Blurred modes as block averages, two to a convolution.
    let mut blurred = DMatrix::<f32>::zeros(bx * by, modes);
    let mut scratch: Scratch = operator.convolver.make_scratch();
    let mut image = vec![Complex32::ZERO; size.pixels()];
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
        for (i, v) in image.iter().enumerate() {
            blurred[(block(i), first)] += v.re / counts[block(i)];
            if second != first {
                blurred[(block(i), second)] += v.im / counts[block(i)];
            }
        }
    }
    let mut h = DMatrix::<f64>::zeros(2 * modes, 2 * modes);
    for (part, (p, q)) in [(0, (0, 0)), (1, (0, modes)), (2, (modes, modes))] {
        let mut weighted = blurred.clone();
        for mut mode in weighted.column_iter_mut() {
            mode.iter_mut().zip(&weights).for_each(|(v, w)| *v *= w[part] as f32);
        }
        let product = blurred.tr_mul(&weighted).cast::<f64>();
        h.view_mut((p, q), (modes, modes)).copy_from(&product);
        if p != q {
            h.view_mut((q, p), (modes, modes)).copy_from(&product.transpose());
        }
    }
    h
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
        let coarse = Coarse::new(&op, 0.0005);
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
        coarse.solve(&mut got, &mut coarse.make_workspace());
        let rms = |f: &dyn Fn(usize) -> f32| ((0..got.len()).map(f).sum::<f32>() / got.len() as f32).sqrt();
        let error = rms(&|i| (got[i] - truth[i]).norm_sqr());
        let signal = rms(&|i| truth[i].norm_sqr());
        assert!(error < 0.03 * signal, "{error} of {signal}");
    }
}
