//! ADMM with 3-D total variation: `admm-published` as in the paper, `admm` with the inner solver replaced by exact splitting.
//!
//! Both: x step, z = max(prox_{(λ/ρ)TV}(x + u), 0), u += x − z. They differ in the x step ([`ImageStep`]).
//!
//! Published: (AᵀA + ρI) x = Aᵀb + ρ(z − u) by conjugate gradients.
//!
//! Exact splitting: ν = k * x lives on the padded grid and meets the readings only inside the frame. With r the residual of
//! v = k * x + u the data step is rank one in each pixel, ν = v + s·r/(‖s‖² + ρ₁) for the weights s of the angles, and the x
//! step one division for each frequency, (ρ₁|K|² + ρ₂) X = ρ₁ K̄ F(ν − u) + ρ₂ F(z − u_z). No inner iterations.

use std::fmt;
use std::marker::PhantomData;

use num_complex::Complex32;

use super::tv::{Thresholds, haar_3d};
use super::{ChannelSolver, residual};
use crate::image::Size;
use crate::optics::lanes::{LANES, Lanes, at, put};
use crate::optics::{AngleOperator, Convolver, Scratch};
use crate::solve::statistics::dot;
use crate::solve::{Buffers, Diverged};

/// ρ, λ and λ_w of the publication, for its unit-ℓ2 PSF.
const PUBLISHED_RHO: f32 = 0.15;
const PUBLISHED_LAMBDA: f32 = 3e-5;
const PUBLISHED_LAMBDA_W: f32 = 6e-5;
/// Most inner iterations of the publication.
const PUBLISHED_STEPS: usize = 30;
/// Norm of the residual, over that at the start, that ends the inner iterations. Relative to the right-hand side instead, a warm start
/// would end them at once and the outer iteration with them.
const PUBLISHED_TOLERANCE: f64 = 1e-3;

/// Penalty of ν = k * x.
const RHO_BLUR: f32 = 0.01;
/// Penalty of z = x.
const RHO_IMAGE: f32 = 2e-3;
/// λ of the exact splitting, for images in units of full scale, and the smoothing along the polarization axis over the spatial one.
const LAMBDA: f32 = 6e-5;
const LAMBDA_W: f32 = 0.1;

/// ADMM planned for one channel, with one of the x steps.
#[derive(Debug)]
pub(in crate::solve) struct Plan<X> {
    operator: AngleOperator,
    rho: f32,
    thresholds: Thresholds,
    x_step: PhantomData<fn() -> X>,
}

/// `admm`.
pub(in crate::solve) type Exact = Plan<Splitting>;
/// `admm-published`.
pub(in crate::solve) type Published = Plan<Gradients>;

/// Buffers of [`Plan`].
#[derive(Debug)]
pub(in crate::solve) struct Workspace<X> {
    outer: Outer,
    x_step: X,
}

/// Buffers of the iteration.
#[derive(Debug)]
pub(in crate::solve) struct Outer {
    z: Vec<f32>,
    u: Vec<f32>,
    v: Vec<f32>,
    residual: Vec<f32>,
    /// Two interleaved angles.
    pair: Vec<f32>,
    scratch: Scratch,
}

/// An x step, by its buffers.
pub(in crate::solve) trait ImageStep: fmt::Debug + Send + Sync + Sized + 'static {
    /// Allocates.
    fn new(operator: &AngleOperator) -> Self;

    /// Bytes of one.
    fn bytes(operator: &AngleOperator) -> usize;

    /// Prepares a run from zero.
    fn reset(&mut self);

    /// x from z, u, readings b and their weights.
    fn step(
        &mut self,
        operator: &AngleOperator,
        rho: f32,
        readings: (&[f32], &[f32]),
        x: &mut [f32],
        outer: &mut Outer,
    );
}

impl<X: ImageStep> Buffers for Workspace<X> {
    fn scratch(&self) -> &Scratch {
        &self.outer.scratch
    }

    fn scratch_mut(&mut self) -> &mut Scratch {
        &mut self.outer.scratch
    }
}

impl Exact {
    /// Plans `admm`.
    pub(in crate::solve) fn new(operator: AngleOperator) -> Self {
        let spatial = LAMBDA / RHO_IMAGE;
        let thresholds = Thresholds { spatial, polarization: LAMBDA_W * spatial };
        Self { operator, rho: RHO_IMAGE, thresholds, x_step: PhantomData }
    }
}

impl Published {
    /// Plans `admm-published`, written for a unit-sum kernel: A' = A/‖k‖₂ and x' = ‖k‖₂·x.
    pub(in crate::solve) fn new(operator: AngleOperator) -> Self {
        let l2 = operator.kernel.l2_norm();
        let spatial = PUBLISHED_LAMBDA / PUBLISHED_RHO / l2;
        let thresholds = Thresholds { spatial, polarization: spatial * PUBLISHED_LAMBDA_W };
        Self { operator, rho: PUBLISHED_RHO * l2 * l2, thresholds, x_step: PhantomData }
    }
}

impl<X: ImageStep> ChannelSolver for Plan<X> {
    const NAME: &'static str = "admm";
    type Workspace = Workspace<X>;

    fn operator(&self) -> &AngleOperator {
        &self.operator
    }

    fn make_workspace(&self) -> Workspace<X> {
        let c = &self.operator.convolver;
        let angles = || vec![0.0; values(&self.operator)];
        let outer = Outer {
            z: angles(),
            u: angles(),
            v: angles(),
            residual: vec![0.0; c.size().pixels()],
            pair: vec![0.0; 2 * c.size().pixels()],
            scratch: c.make_scratch(),
        };
        Workspace { outer, x_step: X::new(&self.operator) }
    }

    fn workspace_bytes(&self) -> usize {
        let c = &self.operator.convolver;
        let outer = (3 * values(&self.operator) + 3 * c.size().pixels()) * size_of::<f32>();
        outer + X::bytes(&self.operator) + c.scratch_bytes()
    }

    fn run(
        &self,
        b: &[f32],
        weight: &[f32],
        iterations: usize,
        x: &mut [f32],
        w: &mut Workspace<X>,
    ) -> Result<f64, Diverged> {
        let Workspace { outer, x_step } = w;
        [&mut *x, &mut outer.z, &mut outer.u].into_iter().for_each(|v| v.fill(0.0));
        x_step.reset();
        let (size, count) = (self.operator.convolver.size(), self.operator.weights.count());
        for iteration in 0..iterations {
            x_step.step(&self.operator, self.rho, (b, weight), x, outer);
            let Outer { z, u, v, .. } = outer;
            v.iter_mut().zip(x.iter().zip(&*u)).for_each(|(v, (x, u))| *v = x + u);
            let mut finite = true;
            haar_3d(v, count, size, self.thresholds, |i, smooth| {
                z[i] = smooth.max(0.0);
                u[i] = v[i] - z[i];
                finite &= u[i].is_finite();
            });
            if !finite {
                return Err(Diverged { iteration: iteration + 1, step: self.rho.recip() });
            }
        }
        x.copy_from_slice(&outer.z);
        Ok(residual(&self.operator, x, (b, weight), &mut outer.residual, &mut outer.scratch))
    }
}

/// x step by conjugate gradients, from the last x.
#[derive(Debug)]
pub(in crate::solve) struct Gradients {
    direction: Vec<f32>,
    image: Vec<f32>,
    rest: Vec<f32>,
}

impl ImageStep for Gradients {
    fn new(operator: &AngleOperator) -> Self {
        let angles = || vec![0.0; values(operator)];
        Self { direction: angles(), image: angles(), rest: angles() }
    }

    fn bytes(operator: &AngleOperator) -> usize {
        3 * values(operator) * size_of::<f32>()
    }

    fn reset(&mut self) {}

    fn step(
        &mut self,
        operator: &AngleOperator,
        rho: f32,
        (b, weight): (&[f32], &[f32]),
        x: &mut [f32],
        outer: &mut Outer,
    ) {
        let Outer { z, u, v, residual, pair, scratch } = outer;
        let Self { direction, image, rest } = self;
        // Right-hand side in `v`, the left-hand side at x in `image`.
        residual.iter_mut().zip(b.iter().zip(weight)).for_each(|(r, (b, w))| *r = b * w);
        operator.adjoint(residual, v, pair, scratch);
        v.iter_mut().zip(z.iter().zip(&*u)).for_each(|(v, (z, u))| *v += rho * (z - u));
        let mut normal = |x: &[f32], out: &mut [f32]| {
            operator.forward(x, residual, scratch);
            residual.iter_mut().zip(weight).for_each(|(r, w)| *r *= w);
            operator.adjoint(residual, out, pair, scratch);
            out.iter_mut().zip(x).for_each(|(o, x)| *o += rho * x);
        };
        normal(x, image);
        rest.iter_mut().zip(v.iter().zip(&*image)).for_each(|(r, (b, a))| *r = b - a);
        direction.copy_from_slice(rest);
        let mut energy = dot(rest, rest);
        let goal = PUBLISHED_TOLERANCE * energy.sqrt();
        for _ in 0..PUBLISHED_STEPS {
            if energy.sqrt() <= goal {
                break;
            }
            normal(direction, image);
            let length = (energy / dot(direction, image)) as f32;
            x.iter_mut().zip(&*direction).for_each(|(x, d)| *x += length * d);
            rest.iter_mut().zip(&*image).for_each(|(r, a)| *r -= length * a);
            let next = dot(rest, rest);
            let beta = (next / energy) as f32;
            direction.iter_mut().zip(&*rest).for_each(|(d, r)| *d = r + beta * *d);
            energy = next;
        }
    }
}

/// x step by exact splitting. Two angles share one complex image.
#[derive(Debug)]
pub(in crate::solve) struct Splitting {
    pairs: Vec<Pair>,
    /// x of one pair, on padded rows.
    image: Vec<Lanes>,
}

/// State of two angles.
#[derive(Debug)]
struct Pair {
    /// k * x, on padded rows.
    blurred: Vec<Lanes>,
    /// F(x).
    spectrum: Vec<Lanes>,
    /// Multiplier of ν.
    dual: Vec<Complex32>,
}

impl ImageStep for Splitting {
    fn new(operator: &AngleOperator) -> Self {
        let c = &operator.convolver;
        let rows = |rows: usize| vec![Lanes::ZERO; rows * c.row_lanes()];
        let pair = |_| Pair {
            blurred: rows(c.size().height),
            spectrum: rows(c.padded().height),
            dual: vec![Complex32::ZERO; c.size().pixels()],
        };
        Self { pairs: (0..pairs(operator)).map(pair).collect(), image: rows(c.coupled_rows()) }
    }

    fn bytes(operator: &AngleOperator) -> usize {
        let (c, pairs) = (&operator.convolver, pairs(operator));
        let rows = pairs * (c.padded().height + c.size().height) + c.coupled_rows();
        rows * c.row_lanes() * size_of::<Lanes>() + pairs * c.size().pixels() * size_of::<Complex32>()
    }

    fn reset(&mut self) {
        for Pair { blurred, spectrum, dual } in &mut self.pairs {
            [blurred, spectrum].into_iter().for_each(|v| v.fill(Lanes::ZERO));
            dual.fill(Complex32::ZERO);
        }
    }

    fn step(
        &mut self,
        operator: &AngleOperator,
        rho: f32,
        readings: (&[f32], &[f32]),
        x: &mut [f32],
        outer: &mut Outer,
    ) {
        self.residual(operator, readings, &mut outer.residual);
        let Outer { z, u, residual, scratch, .. } = outer;
        let convolver = &operator.convolver;
        let pixels = convolver.padded().pixels() as f32;
        let (n, ph) = (convolver.size().pixels(), convolver.padded().height);
        let kernel = operator.kernel.spectrum();
        let Self { pairs, image } = self;
        for (q, Pair { blurred, spectrum, dual }) in pairs.iter_mut().enumerate() {
            let pair = |values: &[f32], i: usize| pair_of(values, n, q, i);
            image.fill(Lanes::ZERO);
            blurred.fill(Lanes::ZERO);
            for i in 0..n {
                let step = pair(operator.weights.as_slice(), i) * residual[i];
                put_pixel(blurred, convolver, i, dual[i] + 2.0 * step);
                dual[i] = -step;
                put_pixel(image, convolver, i, (pair(z, i) - pair(u, i)) * rho);
            }
            let mix = |block: usize, a: &mut [Lanes], b: &mut [Lanes], x: &mut [Lanes]| {
                let k = &kernel[block * ph..][..ph];
                for ((a, b), (x, k)) in a.iter_mut().zip(b).zip(x.iter_mut().zip(k)) {
                    for lane in 0..LANES {
                        // The kernel carries the 1/pixels of the inverse transform.
                        let (k, full) = (k.get(lane), k.get(lane) * pixels);
                        let power = RHO_BLUR * full.norm_sqr();
                        let pushed = x.get(lane) * power + full.conj() * a.get(lane) * RHO_BLUR + b.get(lane);
                        let next = pushed / (power + rho);
                        x.set(lane, next);
                        a.set(lane, k * next);
                        b.set(lane, next / pixels);
                    }
                }
            };
            convolver.couple(blurred, image, spectrum, mix, scratch);
            for i in 0..n {
                let v = pixel(image, convolver, i);
                x[2 * q * n + i] = v.re;
                if let Some(second) = x.get_mut((2 * q + 1) * n + i) {
                    *second = v.im;
                }
            }
        }
    }
}

impl Splitting {
    /// w·r/(‖s‖² + ρ₁) of the data step for each pixel.
    fn residual(&self, operator: &AngleOperator, (b, weight): (&[f32], &[f32]), residual: &mut [f32]) {
        let (c, weights) = (&operator.convolver, operator.weights.as_slice());
        let n = c.size().pixels();
        for i in 0..n {
            let (mut read, mut norm) = (0.0, 0.0);
            for (q, Pair { blurred, dual, .. }) in self.pairs.iter().enumerate() {
                let s = pair_of(weights, n, q, i);
                let v = pixel(blurred, c, i) + dual[i];
                read += s.re * v.re + s.im * v.im;
                norm += s.norm_sqr();
            }
            residual[i] = weight[i] * (b[i] - read) / (norm + RHO_BLUR);
        }
    }
}

/// Values of `[P, H, W]`.
fn values(operator: &AngleOperator) -> usize {
    operator.weights.as_slice().len()
}

/// Pairs of angles.
fn pairs(operator: &AngleOperator) -> usize {
    operator.weights.count().div_ceil(2)
}

/// Pixel i of pair q of `[P, n]`, as one complex number; 0 for a missing second angle.
fn pair_of(values: &[f32], n: usize, q: usize, i: usize) -> Complex32 {
    Complex32::new(values[2 * q * n + i], values.get((2 * q + 1) * n + i).copied().unwrap_or(0.0))
}

/// Row and column of pixel i, the row as lanes of a padded image.
fn place(c: &Convolver, i: usize) -> (std::ops::Range<usize>, usize) {
    let (Size { width, .. }, blocks) = (c.size(), c.row_lanes());
    (i / width * blocks..(i / width + 1) * blocks, i % width)
}

fn pixel(rows: &[Lanes], c: &Convolver, i: usize) -> Complex32 {
    let (row, column) = place(c, i);
    at(&rows[row], column)
}

fn put_pixel(rows: &mut [Lanes], c: &Convolver, i: usize, v: Complex32) {
    let (row, column) = place(c, i);
    put(&mut rows[row], column, v);
}
