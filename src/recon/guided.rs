//! The default solver: S1 and S2 with S0 from the guide, by splitting.
//!
//! min_L ½‖w ⊙ (y − m0 ⊙ (k * S0) − Re(ē ⊙ (k * L)))‖² over L = S1 + i·S2 that look like the guide and obey |L| ≤ S0.
//! ν = k * L and z = L are split off (scaled ADMM). Every iteration
//! 1. data: with r the residual at t = k * L + u, ν = t + e·r/(|e|² + ρ), one real equation for each pixel;
//! 2. prior: z = guided filter of L + u_z, shortened to |z| ≤ S0;
//! 3. image: (ρ|K|² + τ) L̂ = ρ K̄ F(ν − u) + τ F(z − u_z), one division for each frequency.
//!
//! It starts from the direct solution of the slowest modes ([`Coarse`]) and costs four complex FFTs an iteration.

use std::sync::Arc;

use num_complex::Complex32;

use super::Diverged;
use super::guided_filter::GuidedFilter;
use crate::optics::{Coarse, CoarseWorkspace, Scratch, StokesOperator};

/// Penalty ρ of ν = k * L, in units of |e|² = ¼.
const RHO: f32 = 0.03;
/// Penalty τ of z = L at the noise `TAU_SIGMA`; grows with σ^1.5.
const TAU: f32 = 9e-4;
const TAU_SIGMA: f32 = 0.002;
/// Guide variance that counts as flat, relative to the guide's mean square.
const EPSILON: f32 = 2.5e-4;

#[derive(Debug)]
pub(super) struct Plan {
    operator: StokesOperator,
    coarse: Arc<Coarse>,
    iterations: usize,
    tau: f32,
}

#[derive(Debug)]
pub(super) struct Workspace {
    /// What the guide leaves of the readings.
    target: Vec<f32>,
    /// k * L on the padded grid, then ν − u.
    blurred: Vec<Complex32>,
    /// u of ν, inside the sensor.
    blur_dual: Vec<Complex32>,
    /// L on padded rows, then τ(z − u_z).
    image: Vec<Complex32>,
    image_dual: Vec<Complex32>,
    filter: GuidedFilter,
    coarse: CoarseWorkspace,
    scratch: Scratch,
    energies: Vec<f32>,
}

impl Plan {
    pub(super) fn new(operator: StokesOperator, coarse: Arc<Coarse>, iterations: usize, sigma: f32) -> Self {
        let tau = TAU * (sigma.max(1e-5) / TAU_SIGMA).powf(1.5);
        Self { operator, coarse, iterations, tau }
    }

    pub(super) fn workspace_bytes(&self) -> usize {
        let c = &self.operator.convolver;
        let (size, padded) = (c.size(), c.padded());
        let n = size.pixels();
        let complex = padded.pixels() + 2 * n + size.height * padded.width;
        n * size_of::<f32>()
            + complex * size_of::<Complex32>()
            + GuidedFilter::bytes(size)
            + self.coarse.workspace_bytes()
            + c.scratch_bytes()
            + size.height * size_of::<f32>()
    }

    pub(super) fn make_workspace(&self) -> Workspace {
        let c = &self.operator.convolver;
        let (size, padded) = (c.size(), c.padded());
        let complex = |len: usize| vec![Complex32::ZERO; len];
        Workspace {
            target: vec![0.0; size.pixels()],
            blurred: complex(padded.pixels()),
            blur_dual: complex(size.pixels()),
            image: complex(size.height * padded.width),
            image_dual: complex(size.pixels()),
            filter: GuidedFilter::new(size),
            coarse: self.coarse.make_workspace(),
            scratch: c.make_scratch(),
            energies: vec![0.0; size.height],
        }
    }

    /// Reconstructs one channel into `stokes`, `[3, H, W]`, from `guide` in units of the readings; returns the energy of the
    /// residual.
    pub(super) fn run(
        &self,
        y: &[f32],
        weight: &[f32],
        guide: &[f32],
        stokes: &mut [f32],
        w: &mut Workspace,
    ) -> Result<f64, Diverged> {
        let convolver = &self.operator.convolver;
        let (size, pw) = (convolver.size(), convolver.padded().width);
        let n = size.pixels();
        self.operator.forward_s0(guide, &mut w.target, &mut w.scratch);
        w.target.iter_mut().zip(y.iter().zip(weight)).for_each(|(t, (y, weight))| *t = weight * (y - *t));
        let mean_square = guide.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>() / n as f64;
        w.filter.set_guide(guide, (EPSILON * mean_square as f32).max(f32::MIN_POSITIVE), convolver.workers());
        self.start(w);
        let mut energy = f64::INFINITY;
        for iteration in 0..self.iterations {
            energy = self.step(weight, guide, w);
            if !energy.is_finite() {
                return Err(Diverged { iteration: iteration + 1, step: self.tau });
            }
        }
        let (s0, rest) = stokes.split_at_mut(n);
        let (s1, s2) = rest.split_at_mut(n);
        s0.copy_from_slice(guide);
        for i in 0..n {
            let l = shorten(w.image[i / size.width * pw + i % size.width], guide[i]);
            (s1[i], s2[i]) = (l.re, l.im);
        }
        Ok(energy)
    }

    /// L = the coarse estimate, k * L to go with it, no multipliers.
    fn start(&self, w: &mut Workspace) {
        let convolver = &self.operator.convolver;
        let (size, pw) = (convolver.size(), convolver.padded().width);
        self.operator.adjoint_polarized(&w.target, &mut w.image_dual, &mut w.scratch);
        self.coarse.solve(&mut w.image_dual, &mut w.coarse);
        w.image.fill(Complex32::ZERO);
        w.blurred.fill(Complex32::ZERO);
        for (row, line) in w.image.chunks_exact_mut(pw).zip(w.image_dual.chunks_exact(size.width)) {
            row[..size.width].copy_from_slice(line);
        }
        self.mix(w, |k, _, b| (k * b, b));
        w.blur_dual.fill(Complex32::ZERO);
        w.image_dual.fill(Complex32::ZERO);
    }

    /// One iteration; returns the energy of the data residual it started from.
    fn step(&self, weight: &[f32], guide: &[f32], w: &mut Workspace) -> f64 {
        let convolver = &self.operator.convolver;
        let (size, pw) = (convolver.size(), convolver.padded().width);
        let (width, height) = (size.width, size.height);
        let workers = convolver.workers();
        let (e, target) = (self.operator.response.polarized(), &w.target);
        let images = (&mut w.blurred[..height * pw], &mut *w.blur_dual, &mut *w.energies, &mut [(); 0][..]);
        workers.bands(height, images, |rows, (blurred, dual, energies, _)| {
            let lines = blurred.chunks_exact_mut(pw).zip(dual.chunks_exact_mut(width));
            for ((y, energy), (blurred, dual)) in rows.zip(energies).zip(lines) {
                *energy = 0.0;
                for (x, (b, u)) in blurred.iter_mut().zip(dual).enumerate() {
                    let i = y * width + x;
                    let e = e[i];
                    let r = target[i] - weight[i] * (e.re * b.re + e.im * b.im);
                    *energy += r * r;
                    let r = r - weight[i] * (e.re * u.re + e.im * u.im);
                    let step = e * (r / (e.norm_sqr() + RHO));
                    *b += *u + step * 2.0;
                    *u = -step;
                }
            }
        });
        let Workspace { image, image_dual, filter, .. } = w;
        filter.analyze(guide, workers, |y, x| image[y * pw + x] + image_dual[y * width + x]);
        filter.apply(guide, workers, (image, image_dual), |y, filtered, image, dual| {
            for (x, (v, u)) in image.iter_mut().zip(dual).enumerate() {
                let sum = *v + *u;
                let z = shorten(Complex32::new(filtered[x][0], filtered[x][1]), guide[y * width + x]);
                *u = sum - z;
                *v = (z - *u) * self.tau;
            }
            image[width..].fill(Complex32::ZERO);
        });
        self.mix(w, |k, a, b| {
            let x = (k.conj() * a * RHO + b) / (RHO * k.norm_sqr() + self.tau);
            (k * x, x)
        });
        w.energies.iter().map(|e| f64::from(*e)).sum()
    }

    /// Replaces (blurred, image) by `f(K, blurred, image)` in each frequency.
    fn mix(&self, w: &mut Workspace, f: impl Fn(Complex32, Complex32, Complex32) -> (Complex32, Complex32) + Sync) {
        let convolver = &self.operator.convolver;
        let ph = convolver.padded().height;
        // The kernel carries the factor 1/pixels of the inverse transform.
        let scale = convolver.padded().pixels() as f32;
        let kernel = self.operator.kernel.spectrum();
        convolver.couple(
            &mut w.blurred,
            &mut w.image,
            |columns, a, b| {
                let kernel = &kernel[columns.start * ph..columns.end * ph];
                for ((a, b), k) in a.iter_mut().zip(b).zip(kernel) {
                    let (blurred, image) = f(k * scale, *a, *b);
                    (*a, *b) = (blurred / scale, image / scale);
                }
            },
            &mut w.scratch,
        );
    }
}

/// DoLP ≤ 1: L·min(1, S0/|L|).
fn shorten(l: Complex32, s0: f32) -> Complex32 {
    let square = l.norm_sqr();
    if square <= s0 * s0 { l } else { l * (s0 / square.sqrt()) }
}
