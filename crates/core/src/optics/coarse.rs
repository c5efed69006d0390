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
//! Where the field has a margin, modes are multiplied with the brightness of the margin relative to the frame, its *level*, outside of the
//! frame: a dim margin is a step at the border that smooth modes have no room for. H is the sum of three matrices, times 1, level and
//! level².
//!
//! H is made with the exact operator. Where light may come from beyond the frame, some directions are all but invisible, and an
//! approximation of H would fill them with its errors.

use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use nalgebra::DMatrix;
use num_complex::Complex32;

use super::convolve::{Convolver, Scratch};
use super::fft::Direction;
use super::field::Field;
use super::lanes::vectorize;
use super::operator::StokesOperator;
use crate::image::{Buffers, Size};
use crate::parallel::Workers;

/// Modes a side. Higher ones of a diffuser that spreads light over a large part of the frame are below the noise.
const MODES: usize = 16;
/// Modes a side of the smooth error of a guide.
const ERROR_MODES: usize = 10;
/// Relative change of the ridge that is worth a new factorization.
const REFACTOR: f64 = 0.2;

/// The normal equations of one camera.
#[derive(Debug)]
pub struct Coarse {
    size: Size,
    basis: Basis,
    /// Modes of each unknown plane: rows, columns.
    shapes: Vec<[usize; 2]>,
    /// Parts of H that are multiplied with powers of the level, one without a margin; each a lower triangle row after row, plane after
    /// plane.
    grams: Vec<Arc<Vec<f32>>>,
    /// Tells these equations from others that use the same workspace.
    id: u64,
}

/// The slow modes of an image.
#[derive(Clone, Debug)]
struct Basis {
    field: Field,
    /// b_i at each row, `[modes, height]`, and b_j at each column, `[modes, width]`; orthonormal.
    rows: DMatrix<f32>,
    columns: DMatrix<f32>,
}

/// Buffers of one solve.
#[derive(Debug)]
pub struct CoarseWorkspace {
    /// An image multiplied with one of the two bases, `[modes, width]`.
    half: Vec<Complex32>,
    /// Cholesky factor of H + R, packed like H and as exact.
    factor: Vec<f32>,
    /// The ridges, the level and the equations it was made for.
    ridges: [f64; 3],
    level: f32,
    id: u64,
    /// Whether it is used for no other ridges and level than these.
    only_exact: bool,
}

impl CoarseWorkspace {
    /// Makes what follows independent of what was before: the next factor is that of its own ridges and level.
    pub fn forget(&mut self) {
        self.only_exact = true;
    }
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
        let basis = Basis {
            field: operator.field(),
            rows: cosines(MODES.min(size.height), size.height),
            columns: cosines(MODES.min(size.width), size.width),
        };
        let most = [basis.rows.nrows(), basis.columns.nrows()];
        let shapes: Vec<_> = sides.iter().map(|side| most.map(|most| most.min(*side))).collect();
        let grams = gram(operator, responses, &basis, &shapes);
        Self { size, basis, shapes, grams, id: next_id() }
    }

    /// The equations of the first `planes` alone, which share memory with these.
    pub fn leading(&self, planes: usize) -> Self {
        Self {
            size: self.size,
            basis: self.basis.clone(),
            shapes: self.shapes[..planes].to_vec(),
            grams: self.grams.clone(),
            id: next_id(),
        }
    }

    /// Unknowns of the first plane.
    pub fn modes(&self) -> usize {
        self.shapes[0].iter().product()
    }

    /// Bytes that making the equations for images of `size` takes on `threads` threads for a moment, beside the equations and the scratch of
    /// one convolution for each thread.
    pub fn planning_bytes(size: Size, threads: usize) -> usize {
        let half = MODES.min(size.height) * size.width;
        let products = 2 * MODES * MODES * size_of::<f64>();
        let images = (2 * size.pixels() + half) * size_of::<Complex32>();
        threads * (images + products) + size.pixels() * 3 * size_of::<f32>()
    }

    /// All unknowns.
    pub fn unknowns(&self) -> usize {
        self.shapes.iter().map(|[i, j]| i * j).sum()
    }

    /// Bytes of the equations.
    pub fn bytes(&self) -> usize {
        (self.grams.len() * self.packed() + self.basis.rows.len() + self.basis.columns.len()) * size_of::<f32>()
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
            half: buffers.filled(Complex32::ZERO, self.basis.rows.nrows() * self.size.width),
            factor: buffers.filled(0.0, self.packed()),
            ridges: [f64::NAN; 3],
            level: 1.0,
            id: 0,
            only_exact: false,
        }
    }

    /// Buffers for one solve at a time. Allocates.
    pub fn make_workspace(&self) -> CoarseWorkspace {
        Buffers::allocate(|buffers| self.workspace(buffers))
    }

    /// Factors H + R for a ridge relative to H₀₀ for each plane, unless the last factor is close enough. Should rounding
    /// leave the matrix indefinite, the ridge is raised until it is not.
    ///
    /// `level` is the brightness of the margin over that of the frame. What follows uses the modes of that level.
    pub fn factor(&self, ridges: [f64; 3], level: f32, w: &mut CoarseWorkspace) {
        let most = if std::mem::take(&mut w.only_exact) { f64::MIN_POSITIVE } else { REFACTOR };
        let alike = |a: f64, b: f64| (a / b).ln().abs() < most;
        let known = w.id == self.id && (self.grams.len() == 1 || alike(f64::from(level), f64::from(w.level)));
        if known && (0..self.shapes.len()).all(|p| alike(ridges[p], w.ridges[p])) {
            return;
        }
        (w.ridges, w.level, w.id) = (ridges, level, self.id);
        while !self.try_factor(w.ridges, level, &mut w.factor) {
            w.ridges = w.ridges.map(|r| 10.0 * r.max(1e-12));
        }
    }

    /// An element of H.
    fn element(&self, index: usize, level: f32) -> f64 {
        self.grams.iter().rev().fold(0.0, |sum, gram| sum * f64::from(level) + f64::from(gram[index]))
    }

    fn try_factor(&self, ridges: [f64; 3], level: f32, factor: &mut [f32]) -> bool {
        let first = self.element(0, level).max(f64::MIN_POSITIVE);
        for k in 0..self.unknowns() {
            let ridge = first * self.ridge(k, ridges);
            let row = k * (k + 1) / 2;
            for c in 0..=k {
                let column = c * (c + 1) / 2;
                let (done, rest) = factor.split_at_mut(row);
                // Row c of the factor lies before row k, except on the diagonal, where it is row k itself.
                let above = if c == k { &rest[..c] } else { &done[column..column + c] };
                let product = dot(&rest[..c], above);
                let value = self.element(row + c, level) - product;
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
        let (mut penalty, first) = (0.0, self.element(0, w.level).max(f64::MIN_POSITIVE));
        for (k, (x, c)) in x.iter_mut().zip(c).enumerate() {
            let r = first * self.ridge(k, w.ridges);
            *x -= r * c;
            penalty += r * c * c;
        }
        penalty
    }

    /// Plane of unknown k, and row and column frequency of its mode.
    fn place(&self, k: usize) -> (usize, [usize; 2]) {
        let (mut plane, mut k) = (0, k);
        while k >= self.shapes[plane][0] * self.shapes[plane][1] {
            k -= self.shapes[plane][0] * self.shapes[plane][1];
            plane += 1;
        }
        (plane, [k / self.shapes[plane][1], k % self.shapes[plane][1]])
    }

    /// R_kk over H₀₀.
    fn ridge(&self, k: usize, ridges: [f64; 3]) -> f64 {
        let (plane, [i, j]) = self.place(k);
        ridges[plane].max(1e-12) * ((i * i + j * j) as f64 + 1e-3)
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
        self.basis.project(self.shapes[p], image, [re, im], [1.0, w.level], &mut w.half);
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
        self.basis.synthesize(self.shapes[p], [re, im], image, w.level, &mut w.half);
    }
}

impl Basis {
    /// Modes of a plane with all of them.
    fn modes(&self) -> usize {
        self.rows.nrows() * self.columns.nrows()
    }

    /// Row and column frequency of a mode.
    fn place(&self, mode: usize) -> [usize; 2] {
        [mode / self.columns.nrows(), mode % self.columns.nrows()]
    }

    /// Bᵀ image for the first `ni` × `nj` modes, multiplied with `inner` in the frame and with `outer` in the margin: real parts into `re`,
    /// imaginary ones into `im` (or nowhere, if it is empty).
    fn project(
        &self,
        [ni, nj]: [usize; 2],
        image: &[Complex32],
        [re, im]: [&mut [f64]; 2],
        [inner, outer]: [f32; 2],
        half: &mut [Complex32],
    ) {
        let width = self.columns.ncols();
        let half = &mut half[..ni * width];
        half.fill(Complex32::ZERO);
        vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            for (y, line) in image.chunks_exact(width).enumerate() {
                let shown = self.field.shown_columns(y).unwrap_or(0..0);
                for (i, half) in half.chunks_exact_mut(width).enumerate() {
                    let mode = self.rows[(i, y)];
                    add_multiple(&mut half[..shown.start], &line[..shown.start], outer * mode);
                    add_multiple(&mut half[shown.clone()], &line[shown.clone()], inner * mode);
                    add_multiple(&mut half[shown.end..], &line[shown.end..], outer * mode);
                }
            }
        });
        for (i, half) in half.chunks_exact(width).enumerate() {
            let mut sums = [Complex32::ZERO; MODES];
            for (h, modes) in half.iter().zip(self.columns.column_iter()) {
                sums[..nj].iter_mut().zip(modes.iter()).for_each(|(sum, b)| *sum += h * b);
            }
            for (j, sum) in sums[..nj].iter().enumerate() {
                re[i * nj + j] = f64::from(sum.re);
                if let Some(im) = im.get_mut(i * nj + j) {
                    *im = f64::from(sum.im);
                }
            }
        }
    }

    /// image = B c for the first `ni` × `nj` modes, multiplied with `outer` in the margin, for coefficients of the real and the imaginary
    /// part (none if empty).
    fn synthesize(
        &self,
        [ni, nj]: [usize; 2],
        [re, im]: [&[f64]; 2],
        image: &mut [Complex32],
        outer: f32,
        half: &mut [Complex32],
    ) {
        let width = self.columns.ncols();
        let half = &mut half[..ni * width];
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
                if outer != 1.0 {
                    let shown = self.field.shown_columns(y).unwrap_or(0..0);
                    let (before, after) = line.split_at_mut(shown.end);
                    before[..shown.start].iter_mut().chain(after).for_each(|v| *v *= outer);
                }
            }
        });
    }
}

/// sum += factor · values.
#[inline(always)]
fn add_multiple(sum: &mut [Complex32], values: &[Complex32], factor: f32) {
    if factor == 0.0 {
        return;
    }
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

/// Parts of H = Bᵀ AᵀA B, packed, for unknown planes that the sensor weighs with `responses`: of modes in the frame with each other, with
/// those in the margin, and of the latter with each other.
///
/// Two modes travel as real and imaginary part of one image: behind the diffuser once, and for each pair of planes back again, weighed
/// with both responses. Nothing is averaged: directions in which H is all but zero would be filled with the errors of an approximation.
///
/// Every thread does convolutions of its own: they are many, and small.
fn gram(operator: &StokesOperator, responses: &[Vec<f32>], basis: &Basis, shapes: &[[usize; 2]]) -> Vec<Arc<Vec<f32>>> {
    let unknowns: usize = shapes.iter().map(|[i, j]| i * j).sum();
    let parts: &[Part] = if basis.field.margin().is_none() { &[Part::Frame] } else { &[Part::Frame, Part::Margin] };
    let grams = Mutex::new(vec![vec![0.0f32; unknowns * (unknowns + 1) / 2]; 2 * parts.len() - 1]);
    let workers = operator.convolver.workers();
    let convolver = operator.convolver.on(Arc::new(Workers::new(1)));
    let mut buffers: Vec<_> = (0..workers.threads()).map(|_| GramWorkspace::new(&convolver, basis)).collect();
    let own = workers.each_mut(&mut buffers);
    let rows = GramRows { operator, convolver: &convolver, responses, basis, shapes, parts, grams: &grams };
    workers.run(workers.threads(), &|task| {
        let buffers = own.take(task);
        for first in (2 * task..basis.modes()).step_by(2 * workers.threads()) {
            let pair = [first, (first + 1).min(basis.modes() - 1)].map(|mode| basis.place(mode));
            parts.iter().for_each(|part| rows.add(pair, *part, buffers));
        }
    });
    let grams = grams.into_inner().unwrap_or_else(PoisonError::into_inner);
    grams.into_iter().map(Arc::new).collect()
}

/// Rows of H, whose parts are shared by all threads.
struct GramRows<'a> {
    operator: &'a StokesOperator,
    convolver: &'a Convolver,
    responses: &'a [Vec<f32>],
    basis: &'a Basis,
    shapes: &'a [[usize; 2]],
    parts: &'a [Part],
    grams: &'a Mutex<Vec<Vec<f32>>>,
}

/// Buffers of one thread.
struct GramWorkspace {
    scratch: Scratch,
    blurred: Vec<Complex32>,
    image: Vec<Complex32>,
    half: Vec<Complex32>,
    re: Vec<f64>,
    im: Vec<f64>,
}

impl GramWorkspace {
    fn new(convolver: &Convolver, basis: &Basis) -> Self {
        let pixels = convolver.size().pixels();
        Self {
            scratch: convolver.make_scratch(),
            blurred: vec![Complex32::ZERO; pixels],
            image: vec![Complex32::ZERO; pixels],
            half: vec![Complex32::ZERO; basis.rows.nrows() * basis.columns.ncols()],
            re: vec![0.0; basis.modes()],
            im: vec![0.0; basis.modes()],
        }
    }
}

impl GramRows<'_> {
    /// Adds the rows of two modes in one part of the field, of every plane.
    fn add(&self, pair: [[usize; 2]; 2], part: Part, buffers: &mut GramWorkspace) {
        let Self { operator, basis, responses, shapes, .. } = self;
        let GramWorkspace { scratch, blurred, image, half, re, im } = buffers;
        let (field, width) = (basis.field, basis.field.size().width);
        // Where each plane's unknowns begin.
        let start = |p: usize| shapes[..p].iter().map(|[i, j]| i * j).sum::<usize>();
        let store = |_: usize, line: &[Complex32], out: &mut [Complex32]| out.copy_from_slice(line);
        let load = |y: usize, line: &mut [Complex32]| {
            let value = |[i, j]: [usize; 2], x: usize| basis.rows[(i, y)] * basis.columns[(j, x)];
            line.iter_mut().enumerate().for_each(|(x, v)| *v = Complex32::new(value(pair[0], x), value(pair[1], x)));
            part.keep(field.shown_columns(y), line);
        };
        self.convolver.run(&operator.kernel, Direction::Forward, load, blurred, store, scratch);
        for p in 0..responses.len() {
            // Row of H of each of the two modes in this plane.
            let rows =
                pair.map(|[i, j]| (i < shapes[p][0] && j < shapes[p][1]).then(|| start(p) + i * shapes[p][1] + j));
            if rows == [None; 2] {
                continue;
            }
            for q in (0..=p).filter(|q| meet(&responses[p], &responses[*q])) {
                let load = |y: usize, line: &mut [Complex32]| {
                    for (x, v) in line.iter_mut().enumerate() {
                        let i = y * width + x;
                        *v = blurred[i] * (responses[p][i] * responses[q][i]);
                    }
                };
                self.convolver.run(&operator.kernel, Direction::Adjoint, load, image, store, scratch);
                for other in self.parts {
                    basis.project(shapes[q], image, [re, im], other.weights(), half);
                    let mut grams = self.grams.lock().unwrap_or_else(PoisonError::into_inner);
                    let gram = &mut grams[part.power() + other.power()];
                    for (row, products) in rows.into_iter().zip([&*re, &*im]).filter_map(|(row, v)| Some((row?, v))) {
                        let (columns, count) = (start(q), shapes[q][0] * shapes[q][1]);
                        let kept = count.min((row + 1).saturating_sub(columns));
                        let out = &mut gram[row * (row + 1) / 2 + columns..][..kept];
                        out.iter_mut().zip(products).for_each(|(h, v)| *h += *v as f32);
                    }
                }
            }
        }
    }
}

/// Whether some pixel responds to both of two planes. Ideal polarizers at multiples of 45° respond to S1 or to S2.
fn meet(a: &[f32], b: &[f32]) -> bool {
    a.iter().zip(b).any(|(a, b)| (a * b).abs() > 1e-6)
}

/// A part of the field.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Part {
    Frame,
    Margin,
}

impl Part {
    /// Power of the level that modes in this part are multiplied with.
    fn power(self) -> usize {
        usize::from(self == Self::Margin)
    }

    /// Factors of the frame and of the margin.
    fn weights(self) -> [f32; 2] {
        if self == Self::Frame { [1.0, 0.0] } else { [0.0, 1.0] }
    }

    /// Sets the rest of a line of the field to zero; `shown` are its columns in the frame.
    fn keep(self, shown: Option<Range<usize>>, line: &mut [Complex32]) {
        let shown = shown.unwrap_or(0..0);
        match self {
            Self::Margin => line[shown].fill(Complex32::ZERO),
            Self::Frame => {
                line[..shown.start].fill(Complex32::ZERO);
                line[shown.end..].fill(Complex32::ZERO);
            }
        }
    }
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
        coarse.factor([1e-6; 3], 1.0, &mut w);
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
            c.factor([1e-4; 3], 1.0, &mut w);
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
        coarse.factor([1e-6; 3], 1.0, &mut w);
        let mut x = vec![0.0; coarse.unknowns()];
        coarse.solve(&mut x, &w);
        assert!(x.iter().all(|v| *v == 0.0));
    }
}
