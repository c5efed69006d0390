//! Where the guide lies against the scene, from one raw frame: minimize over the shift d, the gains a and the polarized part L
//!
//! ‖w ⊙ (y − a·m0 ⊙ (k * g(· + d)) − Re(ē ⊙ (k * L)))‖² + the prior of L,
//!
//! summed over the channels, by Gauss–Newton on d. L and a are eliminated exactly: L, in the slow modes of [`Coarse`], turns
//! every product ⟨u, v⟩ of the normal equations into ⟨u, v⟩ − ⟨u′, v′⟩, so that strong polarization cannot pass for
//! misalignment; a goes by a Schur complement. The blur makes the cost smooth over many pixels.
//!
//! The modes' normal matrix is a good approximation only, and polarization can hold a thousand times the energy of what
//! misalignment leaves. So at every step the polarization found is subtracted through the exact operator, and only what
//! remains is left to the approximation.
//!
//! Cost, in complex convolutions for each channel: 9 for the first step, 7 for each further one.

use std::sync::Arc;

use nalgebra::{Matrix2, SMatrix, Vector2};
use num_complex::Complex32;

use crate::optics::{Coarse, CoarseWorkspace, Direction, Scratch, StokesOperator};
use crate::plane::{Size, Stack};

/// Gauss–Newton steps, at most.
const STEPS: usize = 6;
/// After a step this short the next would be below a hundredth of a pixel, in pixels.
const SETTLED: f64 = 0.4;
/// A shift must lower the sum of squares by this many noise variances, or the guide stays where it is.
const SIGNIFICANT: f64 = 60.0;
/// Ridge of the slow polarized modes, relative to the strongest.
const RIDGE: f64 = 1e-5;
/// Largest shift looked for, as a share of the longer side.
const REACH: f64 = 0.06;
/// A guide that leaves more than this share of what a featureless one leaves is of another scene …
const UNEXPLAINED: f64 = 0.5;
/// … if what it leaves is this many times the noise variance.
const ABOVE_NOISE: f64 = 3.0;

/// The images that the normal equations relate: ∂g/∂x, ∂g/∂y, g and 1, all behind lens and mask, and y.
const IMAGES: usize = 5;
const GUIDE: usize = 2;
const FLAT: usize = 3;
const RAW: usize = 4;

/// What there is to find out about a guide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Found {
    /// Shift of the guide's content against the scene, in pixels: right, down.
    pub(super) shift: [f64; 2],
    /// Whether the guide shows the scene of the raw frame.
    pub(super) same_scene: bool,
}

#[derive(Debug)]
pub(super) struct Workspace {
    /// Two images a row after each other, `[height, 2, width]`: ∂g/∂x and ∂g/∂y, then g and 1.
    pairs: [Vec<f32>; 2],
    polarized: Vec<Complex32>,
    /// The readings without polarization.
    target: Vec<f32>,
    /// v′ of each image, for each channel.
    reduced: Vec<f64>,
    /// That of the target, and the coefficients of the polarization subtracted.
    target_reduced: Vec<f64>,
    start: Vec<f64>,
    coarse: Option<CoarseWorkspace>,
}

/// Bytes of one [`Workspace`].
pub(super) fn workspace_bytes(coarse: &[Arc<Coarse>], size: Size) -> usize {
    let images = size.pixels() * (5 * size_of::<f32>() + size_of::<Complex32>());
    let modes = coarse
        .first()
        .map_or(0, |c| c.unknowns() * (IMAGES * coarse.len() + 2) * size_of::<f64>() + c.workspace_bytes());
    images + modes
}

/// Buffers for [`find`]. Allocates.
pub(super) fn make_workspace(coarse: &[Arc<Coarse>], size: Size) -> Workspace {
    let zeros = |len: usize| vec![0.0f32; len];
    let unknowns = coarse.first().map_or(0, |c| c.unknowns());
    Workspace {
        pairs: [zeros(2 * size.pixels()), zeros(2 * size.pixels())],
        polarized: vec![Complex32::ZERO; size.pixels()],
        target: zeros(size.pixels()),
        reduced: vec![0.0; unknowns * IMAGES * coarse.len()],
        target_reduced: vec![0.0; unknowns],
        start: vec![0.0; unknowns],
        coarse: coarse.first().map(|c| c.make_workspace()),
    }
}

/// One frame of all channels.
pub(super) struct Frame<'a> {
    pub(super) operators: &'a [StokesOperator],
    pub(super) coarse: &'a [Arc<Coarse>],
    pub(super) raw: &'a Stack<f32>,
    pub(super) weight: &'a Stack<f32>,
}

/// The quadratic model of the cost around one shift, all channels together.
#[derive(Default)]
struct Normal {
    hessian: Matrix2<f64>,
    slope: Vector2<f64>,
    /// What the guide leaves unexplained.
    rest: f64,
    /// What a featureless guide leaves.
    flat_rest: f64,
}

impl Normal {
    /// The step to the model's minimum and how much lower that is; none if the guide is flat.
    fn step(&self) -> Option<(Vector2<f64>, f64)> {
        let step = self.hessian.cholesky()?.solve(&self.slope);
        let drop = step.dot(&self.slope);
        (drop.is_finite() && step.norm().is_finite()).then_some((step, drop))
    }
}

/// Finds the shift. `place(d, guide)` resamples the guide as if its content were shifted by d; `guide` is left as placed
/// by the shift found. Allocates nothing.
pub(super) fn find(
    frame: &Frame<'_>,
    mut place: impl FnMut([f64; 2], &mut Stack<f32>),
    guide: &mut Stack<f32>,
    scratch: &mut Scratch,
    w: &mut Workspace,
) -> Found {
    let size = guide.size();
    let count = frame.weight.as_slice().iter().map(|w| f64::from(*w)).sum::<f64>().max(1.0);
    let longest = REACH * size.width.max(size.height) as f64;
    let mut shift = Vector2::<f64>::zeros();
    place([0.0; 2], guide);
    let first = normal(frame, guide, true, scratch, w);
    let (mut now, mut rest) = (first.step(), first.rest);
    let mut steps = 0;
    while let Some((step, drop)) = now {
        let variance = (rest - drop).max(0.0) / count;
        if steps == 0 && drop <= SIGNIFICANT * variance {
            break;
        }
        shift += step * (0.5 * longest / step.norm()).min(1.0);
        steps += 1;
        rest -= drop;
        if shift.norm() > longest || step.norm() < SETTLED || steps == STEPS {
            break;
        }
        place(shift.into(), guide);
        let model = normal(frame, guide, false, scratch, w);
        (now, rest) = (model.step(), model.rest);
    }
    let better = first.rest - rest > SIGNIFICANT * rest.max(0.0) / count;
    if steps > 0 && !(better && shift.norm() <= longest) {
        (shift, rest) = (Vector2::zeros(), first.rest);
    }
    if steps > 0 {
        place(shift.into(), guide);
    }
    let noise = count * noise_variance(frame);
    let other = rest > ABOVE_NOISE * noise && rest - noise > UNEXPLAINED * (first.flat_rest - noise);
    Found { shift: shift.into(), same_scene: !other }
}

/// The model around the guide as placed. The `first` call keeps what does not depend on the guide.
fn normal(frame: &Frame<'_>, guide: &Stack<f32>, first: bool, scratch: &mut Scratch, w: &mut Workspace) -> Normal {
    let size = guide.size();
    let (width, height) = (size.width, size.height);
    let mut total = Normal::default();
    for (c, operator) in frame.operators.iter().enumerate() {
        let (y, weight, g) = (frame.raw.plane(c), frame.weight.plane(c), guide.plane(c));
        let m0 = operator.response.unpolarized();
        let store = |row: usize, line: &[Complex32], out: &mut [f32]| {
            let (re, im) = out.split_at_mut(width);
            for (x, v) in line.iter().enumerate() {
                let m = m0[row * width + x] * weight[row * width + x];
                (re[x], im[x]) = (m * v.re, m * v.im);
            }
        };
        let [slopes, values] = &mut w.pairs;
        let load = |row: usize, line: &mut [Complex32]| {
            let (here, up) = (&g[row * width..][..width], &g[row.saturating_sub(1) * width..][..width]);
            let down = &g[(row + 1).min(height - 1) * width..][..width];
            for (x, v) in line.iter_mut().enumerate() {
                let right = here[(x + 1).min(width - 1)] - here[x.saturating_sub(1)];
                *v = Complex32::new(0.5 * right, 0.5 * (down[x] - up[x]));
            }
        };
        operator.convolver.run(&operator.kernel, Direction::Forward, load, slopes, store, scratch);
        let load = |row: usize, line: &mut [Complex32]| {
            line.iter_mut().zip(&g[row * width..]).for_each(|(v, g)| *v = Complex32::new(*g, 1.0));
        };
        operator.convolver.run(&operator.kernel, Direction::Forward, load, values, store, scratch);

        let (slopes, values) = (&*slopes, &*values);
        let at = |image: usize, i: usize| match image {
            RAW => weight[i] * y[i],
            GUIDE | FLAT => values[(2 * (i / width) + image - GUIDE) * width + i % width],
            _ => slopes[(2 * (i / width) + image) * width + i % width],
        };
        let dot = |p: usize, q: usize| (0..y.len()).map(|i| f64::from(at(p, i)) * f64::from(at(q, i))).sum::<f64>();
        let mut penalty = 0.0;
        let mut gain = 0.0;
        let modes = frame.coarse.get(c).zip(w.coarse.as_mut());
        let n = modes.as_ref().map_or(0, |(coarse, _)| coarse.unknowns());
        let reduced = &mut w.reduced[c * IMAGES * n..(c + 1) * IMAGES * n];
        if let Some((coarse, buffers)) = modes {
            coarse.factor([RIDGE; 3], buffers);
            let reduce = |image: &[Complex32], out: &mut [f64], buffers: &mut CoarseWorkspace| {
                let (re, im) = out.split_at_mut(n / 2);
                coarse.project(image, re, im, buffers);
            };
            for (image, reduced) in reduced.chunks_exact_mut(n).enumerate().filter(|(i, _)| first || *i < FLAT) {
                adjoint(operator, |i| weight[i] * at(image, i), &mut w.polarized, scratch);
                reduce(&w.polarized, reduced, buffers);
                coarse.whiten(reduced, buffers);
            }
            let square = dot(GUIDE, GUIDE) - inner(&reduced[GUIDE * n..][..n], &reduced[GUIDE * n..][..n]);
            if square > 0.0 {
                gain = (dot(GUIDE, RAW) - inner(&reduced[GUIDE * n..][..n], &reduced[RAW * n..][..n])) / square;
            }
            let pairs = reduced[RAW * n..][..n].iter().zip(&reduced[GUIDE * n..][..n]);
            w.start.iter_mut().zip(pairs).for_each(|(t, (y, g))| *t = y - gain * g);
            coarse.unwhiten(&mut w.start, buffers);
            let (re, im) = w.start.split_at(n / 2);
            coarse.synthesize(re, im, &mut w.polarized, buffers);
            operator.forward_polarized(&w.polarized, &mut w.target, scratch);
            let left = |i: usize| at(RAW, i) - gain as f32 * at(GUIDE, i);
            w.target.iter_mut().enumerate().for_each(|(i, t)| *t = left(i) - weight[i] * *t);
            let rest = &w.target;
            adjoint(operator, |i| weight[i] * rest[i], &mut w.polarized, scratch);
            reduce(&w.polarized, &mut w.target_reduced, buffers);
            penalty = coarse.subtract_ridge(&w.start, &mut w.target_reduced, buffers);
            coarse.whiten(&mut w.target_reduced, buffers);
            w.target_reduced.iter_mut().zip(&reduced[GUIDE * n..]).for_each(|(t, g)| *t += gain * g);
        } else {
            w.target.iter_mut().enumerate().for_each(|(i, t)| *t = at(RAW, i));
        }
        let mut gram = SMatrix::<f64, IMAGES, IMAGES>::zeros();
        for i in 0..y.len() {
            let mut v = [0, 1, GUIDE, FLAT, RAW].map(|image| f64::from(at(image, i)));
            v[RAW] = f64::from(w.target[i]) + gain * v[GUIDE];
            for p in 0..IMAGES {
                for q in p..IMAGES {
                    gram[(p, q)] += v[p] * v[q];
                }
            }
        }
        gram[(RAW, RAW)] += penalty;
        let vector = |image: usize| if image == RAW { &w.target_reduced[..n] } else { &reduced[image * n..][..n] };
        for p in 0..IMAGES {
            for q in p..IMAGES {
                gram[(p, q)] -= inner(vector(p), vector(q));
            }
        }
        total.add(&gram);
    }
    total
}

fn inner(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// L = k̃ * (e ⊙ r).
fn adjoint(operator: &StokesOperator, r: impl Fn(usize) -> f32 + Sync, l: &mut [Complex32], scratch: &mut Scratch) {
    let (e, width) = (operator.response.polarized(), operator.convolver.size().width);
    operator.convolver.run(
        &operator.kernel,
        Direction::Adjoint,
        |row, line| line.iter_mut().enumerate().for_each(|(x, v)| *v = e[row * width + x] * r(row * width + x)),
        l,
        |_, line, out| out.copy_from_slice(line),
        scratch,
    );
}

impl Normal {
    /// Adds a channel, its gain eliminated; `gram` is an upper triangle.
    fn add(&mut self, gram: &SMatrix<f64, IMAGES, IMAGES>) {
        let energy = gram[(RAW, RAW)];
        let left = |image: usize| match gram[(image, image)] {
            square if square > 0.0 => energy - gram[(image, RAW)].powi(2) / square,
            _ => energy,
        };
        self.rest += left(GUIDE);
        self.flat_rest += left(FLAT);
        let square = gram[(GUIDE, GUIDE)];
        if square <= 0.0 {
            return;
        }
        let gain = gram[(GUIDE, RAW)] / square;
        let cross = Vector2::new(gram[(0, GUIDE)], gram[(1, GUIDE)]);
        let slopes = Matrix2::new(gram[(0, 0)], gram[(0, 1)], gram[(0, 1)], gram[(1, 1)]);
        self.hessian += (slopes - cross * cross.transpose() / square) * (gain * gain);
        self.slope += (Vector2::new(gram[(0, RAW)], gram[(1, RAW)]) - cross * gain) * gain;
    }
}

/// Noise variance of the readings from their second differences along columns, where a blurred image is nearly linear and
/// stripes do not change. Structure only makes it larger.
fn noise_variance(frame: &Frame<'_>) -> f64 {
    let width = frame.raw.size().width;
    let (mut sum, mut count) = (0.0f64, 0usize);
    for (y, weight) in frame.raw.planes().zip(frame.weight.planes()) {
        for i in width..y.len().saturating_sub(width) {
            if weight[i - width] * weight[i] * weight[i + width] > 0.0 {
                sum += f64::from((y[i - width] - 2.0 * y[i] + y[i + width]).abs());
                count += 1;
            }
        }
    }
    // Of normal noise: E|second difference| = σ √6 √(2/π).
    let mean = sum / count.max(1) as f64;
    mean * mean * std::f64::consts::PI / 12.0
}

#[cfg(test)]
mod tests {
    use super::super::guide::{Sampler, moved};
    use super::*;
    use crate::calibration::Homography;
    use crate::optics::{FftBackend, Psf, Response};
    use crate::parallel::Workers;
    use crate::plane::Angle;

    const SIZE: Size = Size::new(96, 80);
    const NOISE: f32 = 0.001;
    /// What the guide camera sees more, so that borders do not come in, in pixels.
    const MARGIN: usize = 12;

    fn operator() -> StokesOperator {
        let disc = |i: usize| {
            let (dy, dx) = ((i / 96) as f32 - 40.0, (i % 96) as f32 - 48.0);
            if dx.hypot(dy) < 18.0 { 1.0 + (0.7 * dx + 0.2 * dy).sin() * (0.9 * dy).cos() } else { 0.0 }
        };
        let psf = Stack::from_vec(1, SIZE, (0..SIZE.pixels()).map(disc).collect()).unwrap();
        let psf = Psf::new(psf, SIZE, 1).unwrap();
        let response = Response::stripes(SIZE, Angle::four(), 16, f64::INFINITY).unwrap();
        let workers = Arc::new(Workers::new(1));
        StokesOperator::for_channels(&psf, &response, 1, FftBackend::Rustfft, workers).unwrap().remove(0)
    }

    /// A scene of waves, band-limited so that it can be sampled anywhere; never dark.
    fn scene(seed: u32, x: f32, y: f32) -> f32 {
        let mut s = seed;
        let mut next = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32
        };
        let mut wave = || ((next() - 0.5) * 0.5 * x + (next() - 0.5) * 0.5 * y + 6.3 * next()).sin();
        0.5 + 0.03 * (0..12).map(|_| wave()).sum::<f32>()
    }

    /// A view of the scene, shifted, that sees `margin` pixels more on every side.
    fn image(seed: u32, shift: [f64; 2], margin: usize) -> Stack<f32> {
        let size = Size::new(SIZE.width + 2 * margin, SIZE.height + 2 * margin);
        let origin = shift.map(|d| d + margin as f64);
        let at = |i: usize| {
            let (x, y) = ((i % size.width) as f64 - origin[0], (i / size.width) as f64 - origin[1]);
            scene(seed, x as f32, y as f32)
        };
        Stack::from_vec(1, size, (0..size.pixels()).map(at).collect()).unwrap()
    }

    /// What is found out of a guide `seed`, shifted, about the scene of seed 1 with a degree of polarization of `dolp`.
    fn register(seed: u32, shift: [f64; 2], dolp: f32) -> (Found, Stack<f32>) {
        let operators = [operator()];
        let [op] = &operators;
        let coarse = [Arc::new(Coarse::new(op, &op.polarized_responses()))];
        let s0 = image(1, [0.0; 2], 0);
        let l: Vec<_> = s0
            .as_slice()
            .iter()
            .enumerate()
            .map(|(i, s)| {
                let (x, y) = ((i % SIZE.width) as f32, (i / SIZE.width) as f32);
                Complex32::from_polar(dolp * s * (0.7 + 0.3 * (0.05 * x).cos()), 0.03 * y + 0.02 * x)
            })
            .collect();
        let mut scratch = op.convolver.make_scratch();
        let (mut y, mut polarized) = (vec![0.0; SIZE.pixels()], vec![0.0; SIZE.pixels()]);
        op.forward_s0(s0.as_slice(), &mut y, &mut scratch);
        op.forward_polarized(&l, &mut polarized, &mut scratch);
        let mut s = 7u32;
        for (y, p) in y.iter_mut().zip(&polarized) {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            *y = 0.6 * (*y + p) + NOISE * 12f32.sqrt() * ((s >> 8) as f32 / (1 << 24) as f32 - 0.5);
        }
        let raw = Stack::from_vec(1, SIZE, y).unwrap();
        let weight = Stack::from_vec(1, SIZE, vec![1.0; SIZE.pixels()]).unwrap();
        let frame = Frame { operators: &operators, coarse: &coarse, raw: &raw, weight: &weight };
        let (mut placed, sampler, mut plane) = (Stack::zeros(1, SIZE), Sampler::new(), vec![0.0; SIZE.pixels()]);
        let seen = image(seed, shift, MARGIN);
        let lies = moved(&Homography::IDENTITY, [MARGIN as f64; 2]);
        let place = |d: [f64; 2], guide: &mut Stack<f32>| {
            sampler.resample(&seen, &moved(&lies, d), guide, &mut plane);
        };
        let mut w = make_workspace(&coarse, SIZE);
        w.target.fill(f32::NAN);
        (find(&frame, place, &mut placed, &mut scratch, &mut w), placed)
    }

    #[test]
    fn shifts_are_found_under_strong_polarization() {
        for shift in [[0.4, 0.4], [2.3, -3.4], [-3.0, 3.0]] {
            let (found, placed) = register(1, shift, 0.8);
            let error = (found.shift[0] - shift[0]).hypot(found.shift[1] - shift[1]);
            assert!(found.same_scene && error < 0.2, "{shift:?}: {found:?}");
            let truth = image(1, [0.0; 2], 0);
            let far = placed.as_slice().iter().zip(truth.as_slice()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(far < 0.02, "{shift:?}: the placed guide is off by {far}");
        }
    }

    #[test]
    fn an_aligned_guide_is_not_touched() {
        for dolp in [0.0, 0.8] {
            let (found, placed) = register(1, [0.0; 2], dolp);
            assert_eq!(found, Found { shift: [0.0; 2], same_scene: true });
            assert_eq!(placed.as_slice(), image(1, [0.0; 2], 0).as_slice());
        }
    }

    #[test]
    fn a_guide_of_another_scene_is_told() {
        for seed in [2, 3, 4] {
            let (found, _) = register(seed, [0.0; 2], 0.3);
            assert!(!found.same_scene, "{seed}: {found:?}");
        }
    }
}
