//! Local shifts of the guide: objects at different distances lie differently against each other in the guide camera and on the sensor.
//!
//! A smooth field of shifts d, bilinear between [`NODES`]² nodes, is found by Gauss–Newton on
//!
//! ‖y − a·m0 ⊙ (k * g(· + d)) − Re(ē ⊙ (k * L))‖² / σ² + Σ |d_i − d_j|² / τ² + Σ |d_i|² / R²
//!
//! with L eliminated as in `fit.rs`, σ² the variance of what is left of a reading, and neighbouring nodes i, j. Each step is solved by a few
//! conjugate gradients. The guide is differentiated over a wide distance first, so that shifts of several pixels are found.
//!
//! Cost, in complex convolutions for each channel: one to look whether there are any ([`hint`]), about 40 for each of six steps.

use super::border;
use super::fit::{self, Columns, Frame};
use crate::image::{Size, Stack};
use crate::optics::Scratch;

/// Nodes a side.
const NODES: usize = 17;
const COUNT: usize = 2 * NODES * NODES;
/// Deviation of the difference of neighbouring nodes, in pixels.
const TAU: f64 = 0.7;
/// Deviation of a node, in pixels.
const RANGE: f64 = 8.0;
/// Distances over which the guide is differentiated in the steps, in pixels.
const DISTANCES: [usize; 6] = [6, 4, 2, 1, 1, 1];
/// Conjugate gradients in a step.
const INNER: usize = 8;
/// Blocks a side in which a first look takes the shifts for the same.
const BLOCKS: usize = 5;
/// Noise variances that shifts of the blocks have to explain by a rough estimate: perfect guides give 30 to 160, two depths that lie two
/// pixels to either side 1600 and more.
const HINT: f64 = 500.0;
/// Noise variances that the shifts have to explain, and their share of the rest beyond noise.
const SIGNIFICANT: f64 = 400.0;
const EXPLAINED: f64 = 0.25;
/// Longest shift that is believed, in pixels.
const LONGEST: f32 = 16.0;

/// Shifts at the nodes, in pixels: all to the right, then all down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shifts([f32; COUNT]);

impl Shifts {
    /// The shift of a pixel of an image of `size`.
    pub(super) fn at(&self, x: f64, y: f64, size: Size) -> (f64, f64) {
        let (mut dx, mut dy) = (0.0, 0.0);
        for (node, weight) in nodes(x, y, size) {
            dx += f64::from(self.0[node]) * weight;
            dy += f64::from(self.0[NODES * NODES + node]) * weight;
        }
        (dx, dy)
    }

    /// Length of the longest shift, in pixels.
    pub(super) fn longest(&self) -> f32 {
        let (right, down) = self.0.split_at(NODES * NODES);
        right.iter().zip(down).map(|(x, y)| x.hypot(*y)).fold(0.0, f32::max)
    }
}

/// The four nodes around a pixel and their weights.
fn nodes(x: f64, y: f64, size: Size) -> [(usize, f64); 4] {
    let place = |v: f64, n: usize| {
        let v = (v / (n - 1).max(1) as f64).clamp(0.0, 1.0) * (NODES - 1) as f64;
        let first = (v as usize).min(NODES - 2);
        (first, v - first as f64)
    };
    let ((i, fx), (j, fy)) = (place(x, size.width), place(y, size.height));
    let first = j * NODES + i;
    [
        (first, (1.0 - fx) * (1.0 - fy)),
        (first + 1, fx * (1.0 - fy)),
        (first + NODES, (1.0 - fx) * fy),
        (first + NODES + 1, fx * fy),
    ]
}

/// The derivative of `g` to the right and down at pixel `i`, over `distance` pixels each way.
fn gradient(g: &[f32], i: usize, distance: usize, Size { width, height }: Size) -> [f32; 2] {
    let (x, y) = (i % width, i / width);
    let difference = |v: usize, n: usize, at: &dyn Fn(usize) -> f32| {
        let (low, high) = (v.saturating_sub(distance), (v + distance).min(n - 1));
        (at(high) - at(low)) / (high - low).max(1) as f32
    };
    [difference(x, width, &|x| g[y * width + x]), difference(y, height, &|y| g[y * width + x])]
}

/// True if the rest of the last fit of channel `c` asks for local shifts of the guide `g` whose gain is `gain`. `moves` is the curvature of
/// the readings over that of the guide's own gradients. Overwrites the fit's image. Allocates nothing.
pub(super) fn hint(
    frame: &Frame<'_>,
    (c, g, gain): (usize, &[f32], f64),
    moves: f64,
    border: &border::Workspace,
    scratch: &mut Scratch,
    fit: &mut fit::Workspace,
) -> bool {
    let rest = fit.rest.iter().map(|r| f64::from(r * r)).sum::<f64>();
    let size = frame.weight.size();
    fit.adjoint_rest(frame, c, scratch);
    let (mut slopes, mut squares) = ([0.0; 2 * BLOCKS * BLOCKS], [0.0; 2 * BLOCKS * BLOCKS]);
    for (i, v) in fit.image.iter().enumerate().filter(|(i, _)| !border.is_hidden(*i)) {
        let block = i / size.width * BLOCKS / size.height * BLOCKS + i % size.width * BLOCKS / size.width;
        for (axis, derivative) in gradient(g, i, 1, size).map(|v| gain * f64::from(v)).into_iter().enumerate() {
            slopes[axis * BLOCKS * BLOCKS + block] += derivative * f64::from(v.re);
            squares[axis * BLOCKS * BLOCKS + block] += derivative * derivative;
        }
    }
    let explained = |(slope, square): (&f64, &f64)| slope * slope / (square * moves).max(f64::MIN_POSITIVE);
    let sum = slopes.iter().zip(&squares).map(explained).sum::<f64>();
    sum > HINT * rest / frame.trusted.max(1.0)
}

/// True if shifts that lower the sum of squares left of the readings from `before` to `after` explain enough of it.
pub(super) fn explains(before: f64, after: f64, frame: &Frame<'_>) -> bool {
    let (drop, noise) = (before - after, frame.noise * frame.trusted);
    drop > SIGNIFICANT * after / frame.trusted.max(1.0) && drop > EXPLAINED * (before - noise)
}

/// Everything that a search works with.
pub(super) struct Search<'a, 'f> {
    pub(super) frame: &'a Frame<'f>,
    pub(super) raw: &'a mut Stack<f32>,
    pub(super) guide: &'a mut Stack<f32>,
    pub(super) border: &'a mut border::Workspace,
    pub(super) scratch: &'a mut Scratch,
    pub(super) fit: &'a mut fit::Workspace,
}

impl Search<'_, '_> {
    /// Finds the shifts of a guide that is aligned as a whole. `place(shifts, guide, border)` resamples the guide with the shifts; `moves` is
    /// that of [`hint`]. None where the readings ask for no shifts, or the shifts explain little. The guide is left as placed by the result.
    /// Allocates nothing.
    pub(super) fn run(
        &mut self,
        moves: f64,
        mut place: impl FnMut(Option<&Shifts>, &mut Stack<f32>, &mut border::Workspace),
    ) -> Option<Shifts> {
        let (first, mut gains) = self.rest();
        let last = self.frame.operators.len() - 1;
        let channel = (last, self.guide.plane(last), gains[last]);
        if !hint(self.frame, channel, moves, self.border, self.scratch, self.fit) {
            return None;
        }
        let (mut now, mut rest) = (Shifts([0.0; COUNT]), first);
        for distance in DISTANCES {
            let Some(next) = self.step(&now, rest, gains, distance) else { break };
            place(Some(&next), self.guide, self.border);
            let (there, there_gains) = self.rest();
            if there < rest {
                (now, rest, gains) = (next, there, there_gains);
            } else {
                place(Some(&now), self.guide, self.border);
                self.rest();
            }
        }
        let explains = explains(first, rest, self.frame);
        let found = (explains && now.longest() <= LONGEST).then_some(now);
        if found.is_none() {
            place(None, self.guide, self.border);
        }
        found
    }

    /// Sum of squares that the guide as placed leaves, and its gains.
    fn rest(&mut self) -> (f64, [f64; 3]) {
        let (mut sum, mut gains) = (0.0, [0.0; 3]);
        for (c, gain) in gains.iter_mut().enumerate().take(self.frame.operators.len()) {
            let fit =
                self.fit.fit(self.frame, c, self.raw.plane_mut(c), self.guide.plane(c), Columns::Gain, self.scratch);
            sum += fit.polarized[(fit::REST, fit::REST)];
            *gain = fit.gain;
        }
        (sum, gains)
    }

    /// One step of Gauss–Newton from `now`, whose sum of squares is `rest`; none if there is nothing to move.
    fn step(&mut self, now: &Shifts, rest: f64, gains: [f64; 3], distance: usize) -> Option<Shifts> {
        let variance = rest / self.frame.trusted;
        let mut left = [0.0f64; COUNT];
        let mut moving = [0.0f64; COUNT];
        for (c, gain) in gains.into_iter().enumerate().take(self.frame.operators.len()) {
            // The rest belongs to the channel that was fitted last.
            if self.frame.operators.len() > 1 {
                self.fit.fit(self.frame, c, self.raw.plane_mut(c), self.guide.plane(c), Columns::Gain, self.scratch);
            }
            self.fit.adjoint_rest(self.frame, c, self.scratch);
            self.project(c, gain, distance, &mut left);
            self.add_squares(c, gain, distance, &mut moving);
        }
        prior(&now.0.map(f64::from), variance).iter().zip(&mut left).for_each(|(p, left)| *left -= p);
        let (mut change, mut scale) = ([0.0f64; COUNT], None);
        let mut direction = [0.0f64; COUNT];
        let mut energy = 0.0;
        for step in 0..INNER {
            // The curvature of the readings is that of the guide's own gradients, times a factor that the first direction tells.
            let diagonal = |k: usize| scale.unwrap_or(1.0) * moving[k] + 4.0 * variance / TAU.powi(2);
            let preconditioned: [f64; COUNT] = std::array::from_fn(|k| left[k] / diagonal(k));
            let next = fit::inner(&left, &preconditioned);
            let keep = if step == 0 { 0.0 } else { next / energy };
            energy = next;
            direction.iter_mut().zip(&preconditioned).for_each(|(d, p)| *d = p + keep * *d);
            let applied = self.normal(&direction, gains, distance, variance);
            let curvature = fit::inner(&direction, &applied);
            if energy <= 0.0 || curvature <= 0.0 {
                break;
            }
            let length = energy / curvature;
            change.iter_mut().zip(&direction).for_each(|(c, d)| *c += length * d);
            left.iter_mut().zip(&applied).for_each(|(l, a)| *l -= length * a);
            if step == 0 {
                let own: f64 = direction.iter().zip(&moving).map(|(d, m)| d * d * m).sum();
                scale = Some(curvature / own.max(f64::MIN_POSITIVE));
                // Another preconditioner: directions begin anew.
                energy = f64::INFINITY;
            }
        }
        let next = std::array::from_fn(|k| (f64::from(now.0[k]) + change[k]) as f32);
        next.iter().all(|v: &f32| v.is_finite()).then_some(Shifts(next))
    }

    /// out += gain · Cᵀ image, where C takes shifts of nodes to changes of the guide.
    fn project(&self, c: usize, gain: f64, distance: usize, out: &mut [f64; COUNT]) {
        let (g, size) = (self.guide.plane(c), self.guide.size());
        for (i, v) in self.fit.image.iter().enumerate() {
            if self.border.is_hidden(i) {
                continue;
            }
            let [gx, gy] = gradient(g, i, distance, size);
            let v = gain * f64::from(v.re);
            for (node, weight) in nodes((i % size.width) as f64, (i / size.width) as f64, size) {
                out[node] += weight * v * f64::from(gx);
                out[NODES * NODES + node] += weight * v * f64::from(gy);
            }
        }
    }

    /// out += gain² · the diagonal of CᵀC.
    fn add_squares(&self, c: usize, gain: f64, distance: usize, out: &mut [f64; COUNT]) {
        let (g, size) = (self.guide.plane(c), self.guide.size());
        for i in (0..g.len()).filter(|i| !self.border.is_hidden(*i)) {
            let [gx, gy] = gradient(g, i, distance, size).map(|v| (gain * f64::from(v)).powi(2));
            for (node, weight) in nodes((i % size.width) as f64, (i / size.width) as f64, size) {
                out[node] += weight * weight * gx;
                out[NODES * NODES + node] += weight * weight * gy;
            }
        }
    }

    /// The normal matrix of the shifts and of their prior, times `shifts`.
    fn normal(&mut self, shifts: &[f64; COUNT], gains: [f64; 3], distance: usize, variance: f64) -> [f64; COUNT] {
        let mut out = prior(shifts, variance);
        let (right, down) = shifts.split_at(NODES * NODES);
        for (c, gain) in gains.into_iter().enumerate().take(self.frame.operators.len()) {
            let (g, size) = (self.guide.plane(c), self.guide.size());
            for i in 0..g.len() {
                let [gx, gy] = gradient(g, i, distance, size).map(f64::from);
                let moved = |(node, weight): (usize, f64)| weight * (right[node] * gx + down[node] * gy);
                let sum: f64 = nodes((i % size.width) as f64, (i / size.width) as f64, size).map(moved).iter().sum();
                let hidden = self.border.is_hidden(i);
                self.border.plane()[i] = if hidden { 0.0 } else { (gain * sum) as f32 };
            }
            self.fit.normal(self.frame, c, self.border.plane(), self.scratch);
            self.project(c, gain, distance, &mut out);
        }
        out
    }
}

/// The prior's normal matrix times `shifts`, for readings of variance `variance`.
fn prior(shifts: &[f64; COUNT], variance: f64) -> [f64; COUNT] {
    let mut out = shifts.map(|v| v * variance / RANGE.powi(2));
    let scale = variance / TAU.powi(2);
    for (axis, out) in shifts.chunks_exact(NODES * NODES).zip(out.chunks_exact_mut(NODES * NODES)) {
        for j in 0..NODES {
            for i in 0..NODES {
                let here = j * NODES + i;
                let neighbours = [(i + 1 < NODES).then_some(here + 1), (j + 1 < NODES).then_some(here + NODES)];
                for there in neighbours.into_iter().flatten() {
                    let pull = scale * (axis[here] - axis[there]);
                    out[here] += pull;
                    out[there] -= pull;
                }
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::colors::EVEN;
    use super::super::register;
    use super::super::register::tests::{Bench, SIZE, scene};
    use super::super::resample::Sampler;
    use super::*;
    use crate::device::Homography;
    use crate::image::Buffers;

    fn image(at: impl Fn(f32, f32) -> f32) -> Stack<f32> {
        let pixels = (0..SIZE.pixels()).map(|i| at((i % SIZE.width) as f32, (i / SIZE.width) as f32));
        Stack::from_vec(1, SIZE, pixels.collect()).unwrap()
    }

    /// Searches for the shifts of a guide whose content lies `depth` pixels to the right at the left border and as many to the left at the
    /// right one. Returns them and the mean square of the placed guide's error, away from the borders, before and after.
    fn search(depth: f32) -> (Option<Shifts>, [f32; 2]) {
        let truth = image(|x, y| scene(1, x, y));
        let shift = |x: f32| depth * ((48.0 - x) / 16.0).tanh();
        let seen = image(|x, y| scene(1, x - shift(x), y));
        let (mut guide, sampler) = (seen.clone(), Sampler::new());
        let error = |guide: &Stack<f32>| {
            let pairs = guide.as_slice().iter().zip(truth.as_slice()).enumerate();
            let inner = pairs.filter(|(i, _)| (8..SIZE.width - 8).contains(&(i % SIZE.width)));
            let (sum, count) = inner.fold((0.0, 0.0), |(sum, n), (_, (a, b))| (sum + (a - b) * (a - b), n + 1.0));
            sum / count
        };
        let before = error(&guide);
        let mut border = Buffers::allocate(|buffers| border::Workspace::new(SIZE, buffers));
        let found = Bench::new(truth.plane(0), 0.4).run(|frame, raw, scratch, fit| {
            let placed = register::judge(frame, raw, &guide, scratch, fit);
            let mut search = Search { frame, raw, guide: &mut guide, border: &mut border, scratch, fit };
            search.run(placed.hessian.trace() / placed.moving, |shifts, guide, border| {
                sampler.resample(seen.borrow(), (&Homography::IDENTITY, shifts), EVEN, guide, border.plane());
            })
        });
        (found, [before, error(&guide)])
    }

    #[test]
    fn two_depths_are_found_and_undone() {
        for depth in [1.5, -3.0] {
            let (found, [before, after]) = search(depth);
            let found = found.unwrap_or_else(|| panic!("{depth} px were not found"));
            let (left, right) = (found.at(16.0, 40.0, SIZE).0, found.at(80.0, 40.0, SIZE).0);
            let depth = f64::from(depth);
            assert!((left - depth).abs() < 0.5 && (right + depth).abs() < 0.5, "{depth}: {left} and {right}");
            assert!(after < 0.2 * before, "{depth}: {before} to {after}");
        }
    }

    #[test]
    fn a_guide_without_parallax_stays_as_it_is() {
        let (found, [before, after]) = search(0.0);
        assert_eq!((found, before, after), (None, 0.0, 0.0));
    }

    #[test]
    fn shifts_are_bilinear_between_nodes() {
        let mut shifts = Shifts([0.0; COUNT]);
        shifts.0[NODES + 1] = 4.0;
        shifts.0[NODES * NODES + NODES + 1] = -2.0;
        let size = Size::new(8 * (NODES - 1) + 1, 4 * (NODES - 1) + 1);
        assert_eq!(shifts.at(8.0, 4.0, size), (4.0, -2.0));
        assert_eq!(shifts.at(4.0, 4.0, size), (2.0, -1.0));
        assert_eq!(shifts.at(12.0, 6.0, size), (1.0, -0.5));
        assert_eq!(shifts.at(-3.0, 500.0, size), (0.0, 0.0));
        assert!((shifts.longest() - 20f32.sqrt()).abs() < 1e-6);
    }
}
