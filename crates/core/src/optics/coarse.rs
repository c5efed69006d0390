//! The direct start: the unknown images' slowest modes, solved for exactly instead of iterated for.
//!
//! A diffuser's |K|² falls by orders of magnitude within a few cycles a frame, so steps sized by the slowest modes leave
//! everything else behind. Each unknown real plane (S0, S1, S2, whichever are solved for) is therefore first taken as
//! Σ c_ij b_i(y) b_j(x), cosines b (DCT-II) of 16 frequencies a side, and found by regularized least squares:
//! (H + R) c = Bᵀ Aᵀ y with H = Bᵀ AᵀA B made once for a camera and R a ridge that grows with frequency². A frame costs one
//! adjoint, thin products and two triangular solves; a new ridge costs one factorization.
//!
//! Last comes a coarser set for S0 beside L, where a guide gives S0 but for a smooth error ([`Coarse::beside_guide`]). A Cholesky
//! factor's leading block is the factor of the leading unknowns, so the first entries of a whitened vector tell what L alone
//! explains, and all of them what L and the smooth error do.
//!
//! H is summed over a few rows at a time, for the blurred modes are smooth along a column. Responses are not: their products are
//! summed row by row. Columns are never merged, for the mask changes from one to the next.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use nalgebra::DMatrix;
use num_complex::Complex32;

use super::convolve::Direction;
use super::lanes::vectorize;
use super::operator::StokesOperator;
use crate::image::{Buffers, Size};

/// Modes a side. Higher ones of a diffuser that spreads light over a large part of the frame are below the noise.
const MODES: usize = 16;
/// Modes a side of the smooth error of a guide.
const ERROR_MODES: usize = 10;
/// Row bins, at most: the fastest product of two modes has 16 cycles a frame.
const ROW_BINS: usize = 84;
/// Samples of H summed at a time.
const PANEL: usize = 512;
/// Relative change of the ridge that is worth a new factorization.
const REFACTOR: f64 = 0.2;

/// The normal equations of one camera.
#[derive(Debug)]
pub struct Coarse {
    size: Size,
    /// b_i at each row, `[modes, height]`, and b_j at each column, `[modes, width]`; orthonormal.
    rows: DMatrix<f32>,
    columns: DMatrix<f32>,
    /// Modes of each unknown plane: rows, columns.
    shapes: Vec<[usize; 2]>,
    /// H, lower triangle row after row; plane after plane.
    gram: Arc<[f32]>,
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
    /// Cholesky factor of H + R, packed like H and as exact.
    factor: Vec<f32>,
    /// The ridges and the equations it was made for.
    ridges: [f64; 3],
    id: u64,
}

impl Coarse {
    /// Builds the normal equations for the unknown planes that the sensor weighs with `responses` (m0, or m1 and m2, or all
    /// three). Allocates; costs one convolution for two modes.
    pub fn new(operator: &StokesOperator, responses: &[Vec<f32>]) -> Self {
        Self::with_sides(operator, responses, &vec![MODES; responses.len()])
    }

    /// S1 and S2, then the smooth error of a guide's S0 with fewer modes. Allocates; costs one convolution for two modes.
    pub fn beside_guide(operator: &StokesOperator) -> Self {
        let mut responses = operator.polarized_responses();
        responses.push(operator.response.unpolarized().to_vec());
        Self::with_sides(operator, &responses, &[MODES, MODES, ERROR_MODES])
    }

    fn with_sides(operator: &StokesOperator, responses: &[Vec<f32>], sides: &[usize]) -> Self {
        let size = operator.convolver.size();
        let rows = cosines(MODES.min(size.height), size.height);
        let columns = cosines(MODES.min(size.width), size.width);
        let shapes: Vec<_> =
            sides.iter().map(|side| [side.min(&rows.nrows()), side.min(&columns.nrows())].map(|n| *n)).collect();
        let gram: Arc<[f32]> = gram(operator, responses, &rows, &columns, &shapes).into();
        let first = f64::from(gram[0]).max(f64::MIN_POSITIVE);
        Self { size, rows, columns, shapes, gram, first, id: next_id() }
    }

    /// The equations of the first `planes` alone, which share memory with these.
    pub fn leading(&self, planes: usize) -> Self {
        Self {
            size: self.size,
            rows: self.rows.clone(),
            columns: self.columns.clone(),
            shapes: self.shapes[..planes].to_vec(),
            gram: Arc::clone(&self.gram),
            first: self.first,
            id: next_id(),
        }
    }

    /// Unknowns of the first plane.
    pub fn modes(&self) -> usize {
        self.shapes[0].iter().product()
    }

    /// Bytes that making the equations of frames of `size` takes for a moment, beside the equations.
    pub fn planning_bytes(size: Size) -> usize {
        let modes = MODES.min(size.width) * MODES.min(size.height);
        let samples = size.height.min(ROW_BINS) * size.width;
        samples * (modes * size_of::<i16>() + 3 * size_of::<f32>())
            // two panels, what the library's product packs of them, and the product
            + (3 * PANEL + modes) * modes * size_of::<f32>()
            + size.pixels() * (size_of::<Complex32>() + 3 * size_of::<f32>())
    }

    /// All unknowns.
    pub fn unknowns(&self) -> usize {
        self.shapes.iter().map(|[i, j]| i * j).sum()
    }

    /// Bytes of the equations.
    pub fn bytes(&self) -> usize {
        (self.packed() + self.rows.len() + self.columns.len()) * size_of::<f32>()
    }

    /// Bytes of one [`CoarseWorkspace`].
    pub fn workspace_bytes(&self) -> usize {
        Buffers::bytes(|buffers| self.workspace(buffers))
    }

    /// Elements of a packed triangle.
    fn packed(&self) -> usize {
        self.unknowns() * (self.unknowns() + 1) / 2
    }

    /// Buffers for one solve at a time.
    pub fn workspace(&self, buffers: &mut Buffers) -> CoarseWorkspace {
        CoarseWorkspace {
            half: buffers.filled(Complex32::ZERO, self.rows.nrows() * self.size.width),
            factor: buffers.filled(0.0, self.packed()),
            ridges: [f64::NAN; 3],
            id: 0,
        }
    }

    /// Buffers for one solve at a time. Allocates.
    pub fn make_workspace(&self) -> CoarseWorkspace {
        Buffers::allocate(|buffers| self.workspace(buffers))
    }

    /// Factors H + R for a ridge relative to H₀₀ for each plane, unless the last factor is close enough. Should rounding
    /// leave the matrix indefinite, the ridge is raised until it is not.
    pub fn factor(&self, ridges: [f64; 3], w: &mut CoarseWorkspace) {
        if w.id == self.id && (0..self.shapes.len()).all(|p| (ridges[p] / w.ridges[p]).ln().abs() < REFACTOR) {
            return;
        }
        w.ridges = ridges;
        w.id = self.id;
        while !self.try_factor(w.ridges, &mut w.factor) {
            w.ridges = w.ridges.map(|r| 10.0 * r.max(1e-12));
        }
    }

    fn try_factor(&self, ridges: [f64; 3], factor: &mut [f32]) -> bool {
        for k in 0..self.unknowns() {
            let ridge = self.ridge(k, ridges);
            let row = k * (k + 1) / 2;
            for c in 0..=k {
                let column = c * (c + 1) / 2;
                let (done, rest) = factor.split_at_mut(row);
                // Row c of the factor lies before row k, except on the diagonal, where it is row k itself.
                let above = if c == k { &rest[..c] } else { &done[column..column + c] };
                let product = dot(&rest[..c], above);
                let value = f64::from(self.gram[row + c]) - product;
                rest[c] = if c == k {
                    let pivot = value + ridge;
                    if pivot.is_nan() || pivot <= 0.0 {
                        return false;
                    }
                    pivot.sqrt() as f32
                } else {
                    (value / f64::from(done[column + c])) as f32
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

    /// x ← F⁻¹ x, with the Cholesky factor F of H + R: then ⟨x, x⟩ is what the modes take off a sum of squares. A shorter x is
    /// of the leading unknowns alone, here and in what follows. Allocates nothing.
    pub fn whiten(&self, x: &mut [f64], w: &CoarseWorkspace) {
        self.whiten_from(0, x, w);
    }

    /// As [`Self::whiten`] for an `x` whose first `done` entries are whitened already. Allocates nothing.
    pub fn whiten_from(&self, done: usize, x: &mut [f64], w: &CoarseWorkspace) {
        for k in done..x.len() {
            let l = &w.factor[k * (k + 1) / 2..][..=k];
            x[k] = (x[k] - dot(&l[..k], x)) / f64::from(l[k]);
        }
    }

    /// x ← F⁻ᵀ x. Allocates nothing.
    pub fn unwhiten(&self, x: &mut [f64], w: &CoarseWorkspace) {
        for k in (0..x.len()).rev() {
            let l = &w.factor[k * (k + 1) / 2..][..=k];
            let value = x[k] / f64::from(l[k]);
            x[k] = value;
            x[..k].iter_mut().zip(l).for_each(|(x, l)| *x -= f64::from(*l) * value);
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
        let (mut plane, mut k) = (0, k);
        while k >= self.shapes[plane][0] * self.shapes[plane][1] {
            k -= self.shapes[plane][0] * self.shapes[plane][1];
            plane += 1;
        }
        let (i, j) = (k / self.shapes[plane][1], k % self.shapes[plane][1]);
        self.first * ridges[plane].max(1e-12) * ((i * i + j * j) as f64 + 1e-3)
    }

    /// Bᵀ image for the modes of the first plane: real parts into `re`, imaginary ones into `im` (or nowhere, if it is empty).
    pub fn project(&self, image: &[Complex32], re: &mut [f64], im: &mut [f64], w: &mut CoarseWorkspace) {
        self.project_plane(0, image, re, im, w);
    }

    /// As [`Self::project`] for the modes of the last plane.
    pub fn project_last(&self, image: &[Complex32], re: &mut [f64], im: &mut [f64], w: &mut CoarseWorkspace) {
        self.project_plane(self.shapes.len() - 1, image, re, im, w);
    }

    fn project_plane(&self, p: usize, image: &[Complex32], re: &mut [f64], im: &mut [f64], w: &mut CoarseWorkspace) {
        let (width, [ni, nj]) = (self.size.width, self.shapes[p]);
        let half = &mut w.half[..ni * width];
        half.fill(Complex32::ZERO);
        vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            for (y, line) in image.chunks_exact(width).enumerate() {
                for (i, half) in half.chunks_exact_mut(width).enumerate() {
                    add_multiple(half, line, self.rows[(i, y)]);
                }
            }
        });
        for (i, half) in half.chunks_exact(width).enumerate() {
            for j in 0..nj {
                let c: Complex32 = half.iter().enumerate().map(|(x, h)| h * self.columns[(j, x)]).sum();
                re[i * nj + j] = f64::from(c.re);
                if let Some(im) = im.get_mut(i * nj + j) {
                    *im = f64::from(c.im);
                }
            }
        }
    }

    /// image = B c for the modes of the first plane, for coefficients of the real and the imaginary part (none if empty).
    pub fn synthesize(&self, re: &[f64], im: &[f64], image: &mut [Complex32], w: &mut CoarseWorkspace) {
        self.synthesize_plane(0, re, im, image, w);
    }

    /// As [`Self::synthesize`] for the modes of the last plane.
    pub fn synthesize_last(&self, re: &[f64], im: &[f64], image: &mut [Complex32], w: &mut CoarseWorkspace) {
        self.synthesize_plane(self.shapes.len() - 1, re, im, image, w);
    }

    fn synthesize_plane(&self, p: usize, re: &[f64], im: &[f64], image: &mut [Complex32], w: &mut CoarseWorkspace) {
        let (width, [ni, nj]) = (self.size.width, self.shapes[p]);
        let half = &mut w.half[..ni * width];
        for (i, half) in half.chunks_exact_mut(width).enumerate() {
            half.fill(Complex32::ZERO);
            for j in 0..nj {
                let c = Complex32::new(re[i * nj + j] as f32, im.get(i * nj + j).copied().unwrap_or(0.0) as f32);
                half.iter_mut().enumerate().for_each(|(x, h)| *h += c * self.columns[(j, x)]);
            }
        }
        vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            for (y, line) in image.chunks_exact_mut(width).enumerate() {
                line.fill(Complex32::ZERO);
                for (i, half) in half.chunks_exact(width).enumerate() {
                    add_multiple(line, half, self.rows[(i, y)]);
                }
            }
        });
    }
}

/// sum += factor · values.
#[inline(always)]
fn add_multiple(sum: &mut [Complex32], values: &[Complex32], factor: f32) {
    sum.iter_mut().zip(values).for_each(|(sum, v)| *sum += v * factor);
}

/// ⟨a, b⟩ in four sums, which the processor can work on at the same time.
fn dot<T: Copy + Into<f64>>(a: &[f32], b: &[T]) -> f64 {
    let mut sums = [0.0; 4];
    let (a, b) = (&a[..a.len().min(b.len())], &b[..a.len().min(b.len())]);
    let (fours, others) = (a.chunks_exact(4), b.chunks_exact(4));
    let last: f64 = fours.remainder().iter().zip(others.remainder()).map(|(a, b)| f64::from(*a) * (*b).into()).sum();
    for (a, b) in fours.zip(others) {
        for k in 0..4 {
            sums[k] += f64::from(a[k]) * b[k].into();
        }
    }
    sums.iter().sum::<f64>() + last
}

fn next_id() -> u64 {
    static NEXT: AtomicU64 = AtomicU64::new(1);
    NEXT.fetch_add(1, Ordering::Relaxed)
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
fn gram(
    operator: &StokesOperator,
    responses: &[Vec<f32>],
    rows: &DMatrix<f32>,
    columns: &DMatrix<f32>,
    shapes: &[[usize; 2]],
) -> Vec<f32> {
    let Size { width, height } = operator.convolver.size();
    let bins = height.min(ROW_BINS);
    let blurred = blurred_modes(operator, rows, columns);
    // Where each plane's unknowns begin, and the mode that each stands for.
    let start = |p: usize| shapes[..p].iter().map(|[i, j]| i * j).sum::<usize>();
    let mode = |p: usize, k: usize| k / shapes[p][1] * columns.nrows() + k % shapes[p][1];
    let unknowns = start(shapes.len());
    let mut packed = vec![0.0f32; unknowns * (unknowns + 1) / 2];
    for p in 0..responses.len() {
        for q in 0..=p {
            // Sums of m_p m_q over the rows of each bin.
            let mut weights = vec![0.0f32; bins * width];
            for (i, (a, b)) in responses[p].iter().zip(&responses[q]).enumerate() {
                weights[bin(i / width, height) * width + i % width] += a * b;
            }
            let h = weighted_product(&blurred, &weights);
            for i in 0..start(p + 1) - start(p) {
                let row = start(p) + i;
                for j in 0..start(q + 1) - start(q) {
                    let column = start(q) + j;
                    if column <= row {
                        packed[row * (row + 1) / 2 + column] = h[(mode(p, i), mode(q, j))];
                    }
                }
            }
        }
    }
    packed
}

/// The bin that row `y` of `height` rows belongs to.
fn bin(y: usize, height: usize) -> usize {
    y * height.min(ROW_BINS) / height
}

/// All modes behind the diffuser, two to a convolution, averaged over the rows of each bin.
fn blurred_modes(operator: &StokesOperator, rows: &DMatrix<f32>, columns: &DMatrix<f32>) -> Blurred {
    let Size { width, height } = operator.convolver.size();
    let (nj, bins) = (columns.nrows(), height.min(ROW_BINS));
    let modes = rows.nrows() * nj;
    let mut counts = vec![0.0f32; bins];
    (0..height).for_each(|y| counts[bin(y, height)] += 1.0);
    let samples = bins * width;
    let mut blurred = Blurred { samples, values: Vec::with_capacity(modes * samples), scales: Vec::new() };
    let mut means = [vec![0.0f32; samples], vec![0.0f32; samples]];
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
            let (at, share) = (bin(y, height) * width, 1.0 / counts[bin(y, height)]);
            for (x, v) in line.iter().enumerate() {
                means[0][at + x] += v.re * share;
                means[1][at + x] += v.im * share;
            }
        }
        for mean in means.iter_mut().take(1 + second - first) {
            blurred.push(mean);
            mean.fill(0.0);
        }
        means[1].fill(0.0);
    }
    blurred
}

/// Blurred modes averaged over the rows of a bin, in 16 bits each: these are the largest numbers of a plan by far, and rounding
/// moves H by less than sums of f32 do.
struct Blurred {
    /// Samples of one mode.
    samples: usize,
    /// Mode after mode, in units of the mode's scale.
    values: Vec<i16>,
    scales: Vec<f32>,
}

impl Blurred {
    fn push(&mut self, mode: &[f32]) {
        let scale = mode.iter().fold(f32::MIN_POSITIVE, |peak, v| peak.max(v.abs())) / f32::from(i16::MAX);
        self.values.extend(mode.iter().map(|v| (v / scale).round() as i16));
        self.scales.push(scale);
    }

    /// All modes at the samples from `start` on, `[samples, modes]`.
    fn panel(&self, start: usize) -> DMatrix<f32> {
        let count = PANEL.min(self.samples - start);
        DMatrix::from_fn(count, self.scales.len(), |i, mode| {
            f32::from(self.values[mode * self.samples + start + i]) * self.scales[mode]
        })
    }
}

/// Vᵀ diag(w) V, a panel of samples at a time.
fn weighted_product(v: &Blurred, weights: &[f32]) -> DMatrix<f32> {
    let modes = v.scales.len();
    let mut product = DMatrix::zeros(modes, modes);
    // Transposed by hand: the library's product of a transposed matrix is not blocked and an order of magnitude slower.
    let mut weighted = DMatrix::zeros(modes, PANEL.min(v.samples));
    for start in (0..v.samples).step_by(PANEL) {
        let panel = v.panel(start);
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
    use crate::image::Stack;
    use crate::optics::{FftBackend, Psf, Response};
    use crate::parallel::Workers;
    use crate::polarization::Angle;

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
    fn leading_unknowns_are_solved_as_if_alone() {
        let size = Size::new(24, 20);
        let mut k = vec![0.0; size.pixels()];
        for i in 0..9 {
            k[(9 + i / 3) * 24 + 11 + i % 3] = 1.0 + i as f32;
        }
        let psf = Psf::new(Stack::from_vec(1, size, k).unwrap(), size, 1).unwrap();
        let response = Response::stripes(size, Angle::four(), 8, f64::INFINITY).unwrap();
        let workers = Arc::new(Workers::new(1));
        let op = StokesOperator::for_channels(&psf, &response, 1, FftBackend::Rustfft, workers).unwrap().remove(0);
        let all = Coarse::beside_guide(&op);
        let (alone, leading) = (Coarse::new(&op, &op.polarized_responses()), all.leading(2));
        let right: Vec<f64> = (0..alone.unknowns()).map(|i| ((i * 37 % 101) as f64 - 50.0) * 0.01).collect();
        let solve = |c: &Coarse| {
            let (mut x, mut w) = (right.clone(), c.make_workspace());
            c.factor([1e-4; 3], &mut w);
            c.solve(&mut x, &w);
            x
        };
        let expected = solve(&alone);
        assert!(all.unknowns() > alone.unknowns() && leading.unknowns() == alone.unknowns());
        assert_eq!(solve(&leading), expected);
        assert_eq!(solve(&all), expected);
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
