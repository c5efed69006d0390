//! One unknown image of a splitting method and the three steps of an iteration on it.
//!
//! Scaled ADMM on min ½‖w ⊙ (b − Σ_k Re(ē_k ⊙ ν_k))‖² + prior(z) + λ·TV with ν = k * x (penalty ρ), z = x (penalty t) and the
//! gradient d = ∇x (penalty τ). Data step: one real equation for each pixel, so ν = v + e·r/(Σ|e|² + ρ) with the residual r at
//! v = k * x + u. TV step: isotropic soft shrinkage of ∇x + u, real and imaginary part together. Image step, exact on the
//! padded circle: (ρ|K|² + t + τ|D|²) X = ρ(|K|² X + K̄ F(ν − u − k * x)) + t F(z − u) + τ F(Dᵀ(d − u)).
//!
//! Differences that leave the sensor carry no penalty: their target is their present value.

use std::ops::Range;

use num_complex::Complex32;

use crate::optics::{Convolver, Kernel, Scratch};
use crate::parallel::Shared;
use crate::plane::Size;

/// Penalties of one iteration.
#[derive(Clone, Copy, Debug)]
pub(super) struct Penalties {
    /// ρ of ν = k * x.
    pub(super) blur: f32,
    /// t of z = x.
    pub(super) prior: f32,
    /// τ of d = ∇x.
    pub(super) gradient: f32,
    /// Old over new t and τ: multipliers are scaled, so they change with the penalty.
    pub(super) rescale: f32,
}

/// Multipliers of z = x and of the two parts of d = ∇x.
#[derive(Clone, Copy, Debug, Default)]
struct Multipliers {
    prior: Complex32,
    across: Complex32,
    down: Complex32,
}

/// One complex image (S1 + i·S2, or S0 as real part) and its state.
#[derive(Debug)]
pub(super) struct Field {
    /// x on padded rows; within an iteration the right-hand side of the image step.
    image: Vec<Complex32>,
    /// k * x on padded rows; within an iteration ν − u − k * x.
    blurred: Vec<Complex32>,
    /// F(x), column after column.
    spectrum: Vec<Complex32>,
    /// u of ν.
    blur_dual: Vec<Complex32>,
    multipliers: Vec<Multipliers>,
    /// For each thread: x in the row below its band, and what flows down into its band's next row.
    halo: Vec<Complex32>,
}

/// τ|D|² needs 4 − 2cos − 2cos of the frequencies of both axes.
#[derive(Debug)]
pub(super) struct Laplacian {
    rows: Vec<f32>,
    columns: Vec<f32>,
}

impl Laplacian {
    pub(super) fn new(padded: Size) -> Self {
        let axis = |n: usize| (0..n).map(|k| 2.0 - 2.0 * (std::f32::consts::TAU * k as f32 / n as f32).cos()).collect();
        Self { rows: axis(padded.height), columns: axis(padded.width) }
    }
}

impl Field {
    pub(super) fn new(c: &Convolver) -> Self {
        let (size, padded) = (c.size(), c.padded());
        let complex = |n: usize| vec![Complex32::ZERO; n];
        Self {
            image: complex(c.coupled_rows() * padded.width),
            blurred: complex(size.height * padded.width),
            spectrum: complex(padded.pixels()),
            blur_dual: complex(size.pixels()),
            multipliers: vec![Multipliers::default(); size.pixels()],
            halo: complex(2 * size.width * c.workers().threads()),
        }
    }

    pub(super) fn bytes(c: &Convolver) -> usize {
        let (size, padded) = (c.size(), c.padded());
        let complex = (c.coupled_rows() + size.height) * padded.width
            + padded.pixels()
            + size.pixels()
            + 2 * size.width * c.workers().threads();
        complex * size_of::<Complex32>() + size.pixels() * size_of::<Multipliers>()
    }

    /// Takes `image` (`[H, W]`) as x, and k * x with it; no multipliers.
    pub(super) fn start(&mut self, image: &[Complex32], c: &Convolver, kernel: &Kernel, scratch: &mut Scratch) {
        let (width, pw) = (c.size().width, c.padded().width);
        self.image.fill(Complex32::ZERO);
        self.blurred.fill(Complex32::ZERO);
        self.blur_dual.fill(Complex32::ZERO);
        self.multipliers.fill(Multipliers::default());
        for (padded, row) in self.image.chunks_exact_mut(pw).zip(image.chunks_exact(width)) {
            padded[..width].copy_from_slice(row);
        }
        let (ph, share) = (c.padded().height, 1.0 / c.padded().pixels() as f32);
        let kernel = kernel.spectrum();
        let mix = |columns: Range<usize>, a: &mut [Complex32], b: &mut [Complex32], x: &mut [Complex32]| {
            let kernel = &kernel[columns.start * ph..columns.end * ph];
            x.copy_from_slice(b);
            for ((a, b), k) in a.iter_mut().zip(b).zip(kernel) {
                *a = *b * k;
                *b *= share;
            }
        };
        c.couple(&mut self.blurred, &mut self.image, &mut self.spectrum, mix, scratch);
    }

    /// x at pixel `i` of a sensor `width` wide, on padded rows of `pw`.
    pub(super) fn value(&self, i: usize, width: usize, pw: usize) -> Complex32 {
        self.image[i / width * pw + i % width]
    }

    /// x plus the multiplier of z = x: what the prior is applied to.
    pub(super) fn prior_input(&self, i: usize, width: usize, pw: usize, rescale: f32) -> Complex32 {
        self.value(i, width, pw) + self.multipliers[i].prior * rescale
    }

    /// The image step.
    pub(super) fn solve(
        &mut self,
        p: Penalties,
        laplacian: &Laplacian,
        c: &Convolver,
        kernel: &Kernel,
        scratch: &mut Scratch,
    ) {
        let (ph, pixels) = (c.padded().height, c.padded().pixels() as f32);
        let kernel = kernel.spectrum();
        let mix = |columns: Range<usize>, a: &mut [Complex32], b: &mut [Complex32], x: &mut [Complex32]| {
            for (i, column) in columns.enumerate() {
                let part = i * ph..(i + 1) * ph;
                let kernel = &kernel[column * ph..][..ph];
                let (a, b, x) = (&mut a[part.clone()], &mut b[part.clone()], &mut x[part]);
                let across = p.prior + p.gradient * laplacian.columns[column];
                for (y, ((a, b), (x, k))) in a.iter_mut().zip(b).zip(x.iter_mut().zip(kernel)).enumerate() {
                    // The kernel carries the 1/pixels of the inverse transform.
                    let full = k * pixels;
                    let power = p.blur * full.norm_sqr();
                    let divisor = 1.0 / (power + across + p.gradient * laplacian.rows[y]);
                    *x = (*x * power + full.conj() * *a * p.blur + *b) * divisor;
                    *a = k * *x;
                    *b = *x * (1.0 / pixels);
                }
            }
        };
        c.couple(&mut self.blurred, &mut self.image, &mut self.spectrum, mix, scratch);
    }
}

/// The data step on `K` unknowns with responses e_k = `response(i)[k]`; the squared residuals of the present x are summed
/// for each row into `energies`.
pub(super) fn data_step<const K: usize>(
    fields: [&mut Field; K],
    c: &Convolver,
    rho: f32,
    target: &[f32],
    weight: &[f32],
    response: impl Fn(usize) -> [Complex32; K] + Sync,
    energies: &mut [f32],
) {
    let (Size { width, height }, pw) = (c.size(), c.padded().width);
    let state = fields.map(|f| (Shared::new(&mut f.blurred), Shared::new(&mut f.blur_dual)));
    let energies = Shared::new(energies);
    c.workers().run(c.workers().threads(), &|task| {
        for y in c.workers().band(task, height) {
            // SAFETY: each row belongs to one task.
            #[allow(unsafe_code)]
            let (mut rows, energy) = unsafe {
                let rows = state.each_ref().map(|(blurred, dual)| {
                    (blurred.slice(y * pw..(y + 1) * pw), dual.slice(y * width..(y + 1) * width))
                });
                (rows, &mut energies.slice(y..y + 1)[0])
            };
            *energy = 0.0;
            for x in 0..width {
                let i = y * width + x;
                let e = response(i);
                let (mut read, mut dual, mut norm) = (0.0, 0.0, rho);
                for k in 0..K {
                    let (b, u) = (rows[k].0[x], rows[k].1[x]);
                    read += e[k].re * b.re + e[k].im * b.im;
                    dual += e[k].re * u.re + e[k].im * u.im;
                    norm += e[k].norm_sqr();
                }
                let r = weight[i] * (target[i] - read);
                *energy += r * r;
                let step = (r - weight[i] * dual) / norm;
                for k in 0..K {
                    let d = e[k] * step;
                    rows[k].0[x] = rows[k].1[x] + d * 2.0;
                    rows[k].1[x] = -d;
                }
            }
            rows.iter_mut().for_each(|(blurred, _)| blurred[width..].fill(Complex32::ZERO));
        }
    });
}

/// The prior and TV steps on `K` unknowns: z = `pull(i, x + u)`, shrinkage by `threshold(i)[k]`, and the right-hand sides of the
/// image steps.
pub(super) fn prior_step<const K: usize>(
    mut fields: [&mut Field; K],
    c: &Convolver,
    p: Penalties,
    pull: impl Fn(usize, [Complex32; K]) -> [Complex32; K] + Sync,
    threshold: impl Fn(usize) -> [f32; K] + Sync,
) {
    let (Size { width, height }, pw) = (c.size(), c.padded().width);
    let workers = c.workers();
    let tasks = workers.threads();
    // What a band needs of its neighbours, before anything is overwritten.
    for (k, field) in fields.iter_mut().enumerate() {
        let Field { image, multipliers, halo, .. } = &mut **field;
        for (task, halo) in halo.chunks_exact_mut(2 * width).enumerate() {
            let band = workers.band(task, height);
            let (below, flow) = halo.split_at_mut(width);
            if band.end < height {
                below.copy_from_slice(&image[band.end * pw..][..width]);
            }
            flow.fill(Complex32::ZERO);
            if let Some(y) = band.start.checked_sub(1) {
                for x in 0..width {
                    let at = y * pw + x;
                    let right = if x + 1 < width { image[at + 1] - image[at] } else { Complex32::ZERO };
                    let m = multipliers[y * width + x];
                    let gradient = [right, image[at + pw] - image[at]];
                    flow[x] = shrink(gradient, [m.across, m.down], p.rescale, threshold(y * width + x)[k]).1[1];
                }
            }
        }
    }
    let state = fields.map(|f| (Shared::new(&mut f.image), Shared::new(&mut f.multipliers), Shared::new(&mut f.halo)));
    workers.run(tasks, &|task| {
        let band = workers.band(task, height);
        // SAFETY: each band, halo and outer row belongs to one task: the first writes the last padded row, the last the row
        // after the sensor.
        #[allow(unsafe_code)]
        let mut parts = unsafe {
            state.each_ref().map(|(image, multipliers, halo)| {
                let outer = |row: usize, mine: bool| image.slice(if mine { row * pw..(row + 1) * pw } else { 0..0 });
                Part {
                    image: image.slice(band.start * pw..band.end * pw),
                    multipliers: multipliers.slice(band.start * width..band.end * width),
                    halo: halo.slice(2 * task * width..2 * (task + 1) * width),
                    after: outer(height, band.end == height && !band.is_empty()),
                    last: outer(height + 1, band.start == 0 && !band.is_empty()),
                }
            })
        };
        for part in &mut parts {
            part.after.fill(Complex32::ZERO);
            part.last.fill(Complex32::ZERO);
        }
        for y in band.clone() {
            let row = y - band.start;
            let mut carried = [Complex32::ZERO; K];
            let first: [Complex32; K] = std::array::from_fn(|k| parts[k].image[row * pw]);
            for x in 0..width {
                let i = y * width + x;
                let inputs = std::array::from_fn(|k| {
                    parts[k].image[row * pw + x] + parts[k].multipliers[row * width + x].prior * p.rescale
                });
                let pulled = pull(i, inputs);
                let th = threshold(i);
                for k in 0..K {
                    let part = &mut parts[k];
                    let here = part.image[row * pw + x];
                    let right = if x + 1 < width { part.image[row * pw + x + 1] - here } else { Complex32::ZERO };
                    let below = match () {
                        () if y + 1 == height => Complex32::ZERO,
                        () if y + 1 == band.end => part.halo[x] - here,
                        () => part.image[(row + 1) * pw + x] - here,
                    };
                    let m = &mut part.multipliers[row * width + x];
                    let (dual, mut flow) = shrink([right, below], [m.across, m.down], p.rescale, th[k]);
                    *m = Multipliers { prior: inputs[k] - pulled[k], across: dual[0], down: dual[1] };
                    if x + 1 == width {
                        flow[0] = -here;
                    }
                    if y + 1 == height {
                        flow[1] = -here;
                        part.after[x] = flow[1] * p.gradient;
                    }
                    let mut divergence = carried[k] - flow[0] + part.halo[width + x] - flow[1];
                    if y == 0 {
                        divergence += here;
                        part.last[x] = -here * p.gradient;
                    }
                    if x == 0 {
                        divergence += here;
                    }
                    carried[k] = flow[0];
                    part.halo[width + x] = flow[1];
                    part.image[row * pw + x] = (pulled[k] - m.prior) * p.prior + divergence * p.gradient;
                }
            }
            for k in 0..K {
                let row = &mut parts[k].image[row * pw..(row + 1) * pw];
                row[width..].fill(Complex32::ZERO);
                row[width] = carried[k] * p.gradient;
                row[pw - 1] = -first[k] * p.gradient;
            }
        }
    });
}

/// One task's share of a field.
struct Part<'a> {
    image: &'a mut [Complex32],
    multipliers: &'a mut [Multipliers],
    halo: &'a mut [Complex32],
    after: &'a mut [Complex32],
    last: &'a mut [Complex32],
}

/// Isotropic shrinkage of v = gradient + u: (the new u, d − u).
fn shrink(
    gradient: [Complex32; 2],
    dual: [Complex32; 2],
    rescale: f32,
    threshold: f32,
) -> ([Complex32; 2], [Complex32; 2]) {
    let v = [gradient[0] + dual[0] * rescale, gradient[1] + dual[1] * rescale];
    let length = (v[0].norm_sqr() + v[1].norm_sqr()).sqrt();
    let keep = if length > threshold { 1.0 - threshold / length } else { 0.0 };
    (v.map(|v| v * (1.0 - keep)), v.map(|v| v * (2.0 * keep - 1.0)))
}
