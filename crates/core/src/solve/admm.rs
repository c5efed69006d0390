//! The paper's ADMM over angle intensities with 3-D TV, and the same with the inner solver replaced by exact splitting.
//!
//! Published: (AᵀA + ρI) v = Aᵀy + ρ(z − u) by conjugate gradients, z = max(prox_{(λ/ρ)TV}(v + u), 0), u += v − z.
//!
//! Exact splitting: ν = k * x lives on the padded grid and meets the readings only inside the sensor. With r the residual of
//! w = k * x + u the data step is rank one in each pixel, ν = w + s·r/(‖s‖² + ρ₁) for the weights s of the angles, and the x
//! step one division for each frequency, (ρ₁|K|² + ρ₂) X = ρ₁ K̄ F(ν − u) + ρ₂ F(z − u_z). No inner iterations.

use num_complex::Complex32;

use super::Diverged;
use super::tv::{Thresholds, haar_3d};
use crate::optics::lanes::{LANES, Lanes, at, put};
use crate::optics::{AngleOperator, Scratch};

/// ρ, λ and λ_w of the publication, for its unit-ℓ2 PSF, its inner iterations at most, and how far they lower the residual they
/// start with. Measured by the right-hand side instead, a warm start would end them at once and the outer iteration with them.
const PUBLISHED_RHO: f32 = 0.15;
const PUBLISHED_LAMBDA: f32 = 3e-5;
const PUBLISHED_LAMBDA_W: f32 = 6e-5;
const PUBLISHED_STEPS: usize = 30;
const PUBLISHED_TOLERANCE: f64 = 1e-3;

/// Penalty of ν = k * x.
const RHO_BLUR: f32 = 0.01;
/// Penalty of z = x.
const RHO_IMAGE: f32 = 2e-3;
/// λ of the exact splitting, for images in units of full scale, and how much less the polarization axis is smoothed.
const LAMBDA: f32 = 6e-5;
const LAMBDA_W: f32 = 0.1;

#[derive(Debug)]
pub(super) struct Plan {
    operator: AngleOperator,
    published: bool,
    pub(super) iterations: usize,
    rho: f32,
    thresholds: Thresholds,
}

#[derive(Debug)]
pub(super) struct Workspace {
    z: Vec<f32>,
    u: Vec<f32>,
    v: Vec<f32>,
    residual: Vec<f32>,
    pair: Vec<f32>,
    pub(super) scratch: Scratch,
    inner: Inner,
}

/// What only one of the two variants needs.
#[derive(Debug)]
enum Inner {
    Gradients {
        direction: Vec<f32>,
        image: Vec<f32>,
        rest: Vec<f32>,
    },
    Splitting {
        /// k * x of each pair of angles, on padded rows.
        blurred: Vec<Vec<Lanes>>,
        /// F(x) of each pair.
        spectrum: Vec<Vec<Lanes>>,
        /// The multiplier of ν.
        dual: Vec<Vec<Complex32>>,
        /// x of one pair, on padded rows.
        image: Vec<Lanes>,
    },
}

impl Plan {
    pub(super) fn new(operator: AngleOperator, published: bool, iterations: usize) -> Self {
        let (rho, spatial, polarization) = if published {
            // Written for a unit-sum kernel: A' = A/‖k‖₂ and x' = ‖k‖₂·x.
            let l2 = operator.kernel.l2_norm();
            let tau = PUBLISHED_LAMBDA / PUBLISHED_RHO / l2;
            (PUBLISHED_RHO * l2 * l2, tau, tau * PUBLISHED_LAMBDA_W)
        } else {
            let tau = LAMBDA / RHO_IMAGE;
            (RHO_IMAGE, tau, LAMBDA_W * tau)
        };
        Self { operator, published, iterations, rho, thresholds: Thresholds { spatial, polarization } }
    }

    fn values(&self) -> usize {
        self.operator.weights.as_slice().len()
    }

    fn pairs(&self) -> usize {
        self.operator.weights.count().div_ceil(2)
    }

    pub(super) fn workspace_bytes(&self) -> usize {
        let c = &self.operator.convolver;
        let n = c.size().pixels();
        let inner = if self.published {
            3 * self.values() * size_of::<f32>()
        } else {
            let rows = self.pairs() * (c.padded().height + c.size().height) + c.coupled_rows();
            rows * c.row_lanes() * size_of::<Lanes>() + self.pairs() * n * size_of::<Complex32>()
        };
        (3 * self.values() + 3 * n) * size_of::<f32>() + inner + c.scratch_bytes()
    }

    pub(super) fn make_workspace(&self) -> Workspace {
        let c = &self.operator.convolver;
        let n = c.size().pixels();
        let angles = || vec![0.0; self.values()];
        let rows = |rows: usize| vec![Lanes::ZERO; rows * c.row_lanes()];
        let pairs = |height: usize| (0..self.pairs()).map(|_| rows(height)).collect();
        Workspace {
            z: angles(),
            u: angles(),
            v: angles(),
            residual: vec![0.0; n],
            pair: vec![0.0; 2 * n],
            scratch: c.make_scratch(),
            inner: if self.published {
                Inner::Gradients { direction: angles(), image: angles(), rest: angles() }
            } else {
                Inner::Splitting {
                    blurred: pairs(c.size().height),
                    spectrum: pairs(c.padded().height),
                    dual: (0..self.pairs()).map(|_| vec![Complex32::ZERO; n]).collect(),
                    image: rows(c.coupled_rows()),
                }
            },
        }
    }

    /// Reconstructs one channel from zero into `x`, `[P, H, W]`; returns the energy of the residual.
    pub(super) fn run(&self, y: &[f32], weight: &[f32], x: &mut [f32], w: &mut Workspace) -> Result<f64, Diverged> {
        x.fill(0.0);
        [&mut w.z, &mut w.u].into_iter().for_each(|v| v.fill(0.0));
        if let Inner::Splitting { blurred, spectrum, dual, .. } = &mut w.inner {
            blurred.iter_mut().chain(spectrum).for_each(|v| v.fill(Lanes::ZERO));
            dual.iter_mut().for_each(|v| v.fill(Complex32::ZERO));
        }
        for iteration in 0..self.iterations {
            if self.published {
                self.gradients(y, weight, x, w);
            } else {
                self.split(y, weight, x, w);
            }
            // x holds v of the publication; u and z follow.
            let (size, count) = (self.operator.convolver.size(), self.operator.weights.count());
            let Workspace { z, u, v, .. } = w;
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
        x.copy_from_slice(&w.z);
        self.operator.forward(x, &mut w.residual, &mut w.scratch);
        Ok(super::subtract(&mut w.residual, y, weight))
    }

    /// x ← (AᵀA + ρI)⁻¹ (Aᵀy + ρ(z − u)), warm-started.
    fn gradients(&self, y: &[f32], weight: &[f32], x: &mut [f32], w: &mut Workspace) {
        let Workspace { z, u, v, residual, pair, scratch, inner } = w;
        let Inner::Gradients { direction, image, rest } = inner else { return };
        // Right-hand side in `v`, minus the left-hand side at x in `image`.
        residual.iter_mut().zip(y.iter().zip(weight)).for_each(|(r, (y, w))| *r = y * w);
        self.operator.adjoint(residual, v, pair, scratch);
        v.iter_mut().zip(z.iter().zip(&*u)).for_each(|(v, (z, u))| *v += self.rho * (z - u));
        let mut normal = |x: &[f32], out: &mut [f32]| {
            self.operator.forward(x, residual, scratch);
            residual.iter_mut().zip(weight).for_each(|(r, w)| *r *= w);
            self.operator.adjoint(residual, out, pair, scratch);
            out.iter_mut().zip(x).for_each(|(o, x)| *o += self.rho * x);
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

    /// One data step and one x step of the exact splitting.
    fn split(&self, y: &[f32], weight: &[f32], x: &mut [f32], w: &mut Workspace) {
        let Workspace { z, u, residual, scratch, inner, .. } = w;
        let Inner::Splitting { blurred, spectrum, dual, image } = inner else { return };
        let convolver = &self.operator.convolver;
        let (size, blocks) = (convolver.size(), convolver.row_lanes());
        let n = size.pixels();
        let row = |i: usize| i / size.width * blocks..(i / size.width + 1) * blocks;
        let column = |i: usize| i % size.width;
        let weights = &self.operator.weights;
        let pair_of = |values: &[f32], q: usize, i: usize| {
            Complex32::new(values[2 * q * n + i], values.get((2 * q + 1) * n + i).copied().unwrap_or(0.0))
        };
        for i in 0..n {
            let (mut read, mut norm) = (0.0, 0.0);
            for (q, (blurred, dual)) in blurred.iter().zip(&*dual).enumerate() {
                let s = pair_of(weights.as_slice(), q, i);
                let v = at(&blurred[row(i)], column(i)) + dual[i];
                read += s.re * v.re + s.im * v.im;
                norm += s.norm_sqr();
            }
            residual[i] = weight[i] * (y[i] - read) / (norm + RHO_BLUR);
        }
        let pixels = convolver.padded().pixels() as f32;
        let ph = convolver.padded().height;
        let kernel = self.operator.kernel.spectrum();
        for (q, (blurred, (spectrum, dual))) in blurred.iter_mut().zip(spectrum.iter_mut().zip(dual)).enumerate() {
            image.fill(Lanes::ZERO);
            blurred.fill(Lanes::ZERO);
            for i in 0..n {
                let step = pair_of(weights.as_slice(), q, i) * residual[i];
                put(&mut blurred[row(i)], column(i), dual[i] + 2.0 * step);
                dual[i] = -step;
                put(&mut image[row(i)], column(i), (pair_of(z, q, i) - pair_of(u, q, i)) * self.rho);
            }
            let mix = |block: usize, a: &mut [Lanes], b: &mut [Lanes], x: &mut [Lanes]| {
                let k = &kernel[block * ph..][..ph];
                for ((a, b), (x, k)) in a.iter_mut().zip(b).zip(x.iter_mut().zip(k)) {
                    for lane in 0..LANES {
                        // The kernel carries the 1/pixels of the inverse transform.
                        let (k, full) = (k.get(lane), k.get(lane) * pixels);
                        let power = RHO_BLUR * full.norm_sqr();
                        let pushed = x.get(lane) * power + full.conj() * a.get(lane) * RHO_BLUR + b.get(lane);
                        let next = pushed / (power + self.rho);
                        x.set(lane, next);
                        a.set(lane, k * next);
                        b.set(lane, next / pixels);
                    }
                }
            };
            convolver.couple(blurred, image, spectrum, mix, scratch);
            for i in 0..n {
                let v = at(&image[row(i)], column(i));
                x[2 * q * n + i] = v.re;
                if let Some(second) = x.get_mut((2 * q + 1) * n + i) {
                    *second = v.im;
                }
            }
        }
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}
