//! Where the readings say that the guide's detail lies, for guides that were not aligned.
//!
//! A guide that is off puts all detail in the wrong place. Stage I cannot see that: what it explains wrongly as S0 it makes up for
//! in L, until nothing is left in the residual. But L has then what no scene has, detail that knows the mask. So the readings are
//! asked anew, for an L that goes with S0 at the degree of polarization around, D = ⟨L⟩/⟨S0⟩: with q = A·(∇S0, D·∇S0) and what
//! stays unexplained, r = y − A·(S0, D·S0), the shift is the least squares of r ≈ q·d. Both are taken without their means over
//! squares, for there the true L differs from that one most. S0 is moved by d and all is done again, [`ROUNDS`] times.
//!
//! What is found serves the network's candidates (`mixer.rs`) and the judgement of what it adds; where it is far, the pipeline aligns the
//! guide and solves again, for S0 itself was wrong.
//!
//! Cost: 6 convolutions a round. Steady state allocates nothing. `scripts/train/captures.py` has the same function.

use nalgebra::{Matrix2, Vector2};

use crate::image::{Complex32, Size, cubic};
use crate::optics::{Scratch, StokesOperator};

/// Gauss–Newton steps.
const ROUNDS: usize = 3;
/// Largest shift along each axis, in pixels.
const REACH: f64 = 4.0;
/// Half sides of the squares over which the degree of polarization, and what is coarse in the readings, is taken, in pixels.
const NEAR: usize = 7;
const COARSE: usize = 10;
/// Brightness below which there is no degree of polarization, of rms(S0).
const DARK: f32 = 1e-3;

/// Buffers for one channel.
#[derive(Debug)]
pub(super) struct Place {
    size: Size,
    /// ⟨L⟩.
    light: Vec<Complex32>,
    /// ⟨S0⟩ where it lies now.
    bright: Vec<f32>,
    /// S0 where it lies now.
    s0: Vec<f32>,
    /// What a shift changes in the readings, for each axis, and what is left of them.
    fine: [Vec<f32>; 3],
    plane: Vec<f32>,
    sums: Vec<f64>,
}

impl Place {
    /// Allocates.
    pub(super) fn new(size: Size) -> Self {
        let plane = || vec![0.0; size.pixels()];
        Self {
            size,
            light: vec![Complex32::ZERO; size.pixels()],
            bright: plane(),
            s0: plane(),
            fine: [plane(), plane(), plane()],
            plane: plane(),
            sums: vec![0.0; size.width],
        }
    }

    /// Bytes of the buffers.
    pub(super) fn bytes(size: Size) -> usize {
        8 * size.pixels() * size_of::<f32>() + size.width * size_of::<f64>()
    }

    /// S0 where it was last found to lie.
    pub(super) fn s0(&self) -> &[f32] {
        &self.s0
    }

    /// Finds where S0 of `stokes`, `[3, H, W]`, lies, from `rest`, the residual of readings of `weight`; by how much it was moved, in
    /// pixels along x and y. Takes `plain` and `polarized` as buffers.
    pub(super) fn find(
        &mut self,
        operator: &StokesOperator,
        stokes: &[f32],
        [rest, weight]: [&[f32]; 2],
        plain: &mut [f32],
        polarized: &mut [Complex32],
        scratch: &mut Scratch,
    ) -> [f64; 2] {
        let Self { size, light, bright, s0, fine, plane, sums } = self;
        let (size, n) = (*size, size.pixels());
        let (first, s1, s2) = (&stokes[..n], &stokes[n..2 * n], &stokes[2 * n..]);
        near(s1, size, NEAR, plane, sums, bright);
        light.iter_mut().zip(&*bright).for_each(|(l, mean)| l.re = *mean);
        near(s2, size, NEAR, plane, sums, bright);
        light.iter_mut().zip(&*bright).for_each(|(l, mean)| l.im = *mean);
        let dark = DARK * super::mean_square(first).sqrt() as f32;
        s0.copy_from_slice(first);
        let mut shift = Vector2::zeros();
        for _ in 0..ROUNDS {
            near(s0, size, NEAR, plane, sums, bright);
            let degree = |i: usize| light[i] / bright[i].max(dark).max(f32::MIN_POSITIVE);
            for (k, fine) in fine.iter_mut().enumerate() {
                match k {
                    0 => along_x(s0, size, plane),
                    1 => along_y(s0, size, plane),
                    _ => plane.copy_from_slice(s0),
                }
                polarized.iter_mut().enumerate().for_each(|(i, l)| *l = degree(i) * plane[i]);
                if k == 2 {
                    let given = first.iter().zip(s1.iter().zip(s2));
                    for ((v, l), (first, (s1, s2))) in plane.iter_mut().zip(&mut *polarized).zip(given) {
                        (*v, *l) = (first - *v, Complex32::new(*s1, *s2) - *l);
                    }
                }
                operator.forward_s0(plane, plain, scratch);
                operator.forward_polarized(polarized, fine, scratch);
                fine.iter_mut()
                    .zip(plain.iter().zip(weight))
                    .for_each(|(v, (plain, weight))| *v = weight * (*v + plain));
                if k == 2 {
                    fine.iter_mut().zip(rest).for_each(|(v, rest)| *v += rest);
                }
                near(fine, size, COARSE, plane, sums, plain);
                fine.iter_mut().zip(&*plain).for_each(|(v, mean)| *v -= mean);
            }
            let [x, y, left] = &*fine;
            let gram = Matrix2::new(dot(x, x), dot(x, y), dot(x, y), dot(y, y));
            let Some(step) = gram.cholesky().map(|gram| gram.solve(&Vector2::new(dot(x, left), dot(y, left)))) else {
                break;
            };
            if !step.iter().all(|v| v.is_finite()) {
                break;
            }
            shift = (shift + step).map(|v| v.clamp(-REACH, REACH));
            moved(first, size, shift, plane, s0);
        }
        shift.into()
    }

    /// Of the residual `rest` of readings of `weight` behind `stokes`, what would be left had S0 lain where it was found to. Takes
    /// `plain` as a buffer.
    pub(super) fn correct(
        &mut self,
        operator: &StokesOperator,
        stokes: &[f32],
        weight: &[f32],
        rest: &mut [f32],
        plain: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let moves = self.s0.iter().zip(stokes).map(|(after, before)| after - before);
        self.plane.iter_mut().zip(moves).for_each(|(v, moved)| *v = moved);
        operator.forward_s0(&self.plane, plain, scratch);
        rest.iter_mut().zip(plain.iter().zip(weight)).for_each(|(r, (plain, weight))| *r -= weight * plain);
    }
}

/// Means over squares of 2·`radius` + 1 pixels, at the border over what there is of them.
fn near(image: &[f32], size: Size, radius: usize, rows: &mut [f32], sums: &mut [f64], out: &mut [f32]) {
    let (w, h) = (size.width, size.height);
    let inside = |at: usize, len: usize| (at + radius + 1).min(len) - at.saturating_sub(radius);
    for (row, out) in image.chunks_exact(w).zip(rows.chunks_exact_mut(w)) {
        let mut sum: f64 = row[..radius.min(w)].iter().map(|v| f64::from(*v)).sum();
        for (x, out) in out.iter_mut().enumerate() {
            sum += row.get(x + radius).map_or(0.0, |v| f64::from(*v));
            sum -= x.checked_sub(radius + 1).map_or(0.0, |left| f64::from(row[left]));
            *out = (sum / inside(x, w) as f64) as f32;
        }
    }
    let row = |y: usize| &rows[y * w..][..w];
    sums.fill(0.0);
    for y in 0..radius.min(h) {
        sums.iter_mut().zip(row(y)).for_each(|(sum, v)| *sum += f64::from(*v));
    }
    for (y, out) in out.chunks_exact_mut(w).enumerate() {
        if y + radius < h {
            sums.iter_mut().zip(row(y + radius)).for_each(|(sum, v)| *sum += f64::from(*v));
        }
        if y > radius {
            sums.iter_mut().zip(row(y - radius - 1)).for_each(|(sum, v)| *sum -= f64::from(*v));
        }
        let count = inside(y, h) as f64;
        out.iter_mut().zip(&*sums).for_each(|(v, sum)| *v = (sum / count) as f32);
    }
}

/// Slopes along x, by the neighbours there are.
fn along_x(image: &[f32], size: Size, out: &mut [f32]) {
    for (row, out) in image.chunks_exact(size.width).zip(out.chunks_exact_mut(size.width)) {
        for (x, out) in out.iter_mut().enumerate() {
            let (before, after) = (x.saturating_sub(1), (x + 1).min(size.width - 1));
            *out = (row[after] - row[before]) / (after - before).max(1) as f32;
        }
    }
}

/// Slopes along y likewise.
fn along_y(image: &[f32], size: Size, out: &mut [f32]) {
    for (y, out) in out.chunks_exact_mut(size.width).enumerate() {
        let (before, after) = (y.saturating_sub(1), (y + 1).min(size.height - 1));
        let row = |y: usize| &image[y * size.width..][..size.width];
        let rows = row(after).iter().zip(row(before));
        let over = (after - before).max(1) as f32;
        out.iter_mut().zip(rows).for_each(|(out, (after, before))| *out = (after - before) / over);
    }
}

/// `image` at each pixel's place and `shift`, none below 0: cubic (Catmull and Rom), the border repeated.
fn moved(image: &[f32], size: Size, shift: Vector2<f64>, rows: &mut [f32], out: &mut [f32]) {
    let inside = |at: usize, by: isize, len: usize| (at as isize + by).clamp(0, len as isize - 1) as usize;
    let w = size.width;
    let (first, taps) = cubic(shift.x);
    for (row, out) in image.chunks_exact(w).zip(rows.chunks_exact_mut(w)) {
        for (x, out) in out.iter_mut().enumerate() {
            *out = taps.iter().zip(first..).map(|(tap, by)| tap * row[inside(x, by, w)]).sum();
        }
    }
    let (first, taps) = cubic(shift.y);
    for (y, out) in out.chunks_exact_mut(w).enumerate() {
        out.fill(0.0);
        for (tap, by) in taps.iter().zip(first..) {
            let row = &rows[inside(y, by, size.height) * w..][..w];
            out.iter_mut().zip(row).for_each(|(v, from)| *v += tap * from);
        }
        out.iter_mut().for_each(|v| *v = v.max(0.0));
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::image::Stack;
    use crate::optics::{FftBackend, Psf, Response};
    use crate::parallel::Workers;
    use crate::polarization::Angle;

    const SIZE: Size = Size::new(96, 80);

    fn operator(size: Size) -> StokesOperator {
        let (x0, y0) = (size.width as f32 / 2.0, size.height as f32 / 2.0);
        let disc = |i: usize| {
            let (dx, dy) = ((i % size.width) as f32 - x0, (i / size.width) as f32 - y0);
            if dx.hypot(dy) < 18.0 { 1.0 + (0.7 * dx + 0.2 * dy).sin() * (0.9 * dy).cos() } else { 0.0 }
        };
        let psf = Stack::from_vec(1, size, (0..size.pixels()).map(disc).collect()).unwrap();
        let response = Response::stripes(size, Angle::four(), 16.min(size.width), f64::INFINITY).unwrap();
        let psf = Psf::new(psf, size, 1).unwrap();
        StokesOperator::for_channels(&psf, &response, 1, FftBackend::Rustfft, Arc::new(Workers::new(1)))
            .unwrap()
            .remove(0)
    }

    /// S0, S1, S2 of waves of all lengths whose polarization turns slowly, with S0 looked at where it is `off`.
    fn scene(size: Size, off: [f32; 2]) -> Vec<f32> {
        let bright = |x: f32, y: f32| {
            let wave = |k: usize| {
                let (a, b) = (0.2 + 0.13 * k as f32, 1.1 - 0.17 * k as f32);
                (a * x + b * y + 2.0 * k as f32).sin() + (b * x - a * y + k as f32).sin()
            };
            0.5 + 0.05 * (0..6).map(wave).sum::<f32>()
        };
        let at = |i: usize| ((i % size.width) as f32, (i / size.width) as f32);
        let s0 = (0..size.pixels()).map(at).map(|(x, y)| bright(x - off[0], y - off[1]));
        let part = |phase: f32| {
            (0..size.pixels()).map(at).map(move |(x, y)| 0.3 * bright(x, y) * (0.03 * x + 0.02 * y + phase).cos())
        };
        s0.chain(part(0.0)).chain(part(-1.57)).collect()
    }

    /// By how much S0 is moved that lies `off` to the readings of the scene, and how far it then is from the truth, of how far it was.
    fn found(off: [f32; 2]) -> ([f64; 2], f64) {
        let (operator, n) = (operator(SIZE), SIZE.pixels());
        let mut scratch = operator.convolver.make_scratch();
        let (mut plain, mut polarized) = (vec![0.0; n], vec![Complex32::ZERO; n]);
        let (truth, stokes) = (scene(SIZE, [0.0; 2]), scene(SIZE, off));
        // L is right: what is left of the readings is S0 in the wrong place
        let wrong: Vec<f32> = truth[..n].iter().zip(&stokes).map(|(a, b)| a - b).collect();
        let mut rest = vec![0.0; n];
        operator.forward_s0(&wrong, &mut rest, &mut scratch);
        let mut place = Place::new(SIZE);
        let weight = vec![1.0; n];
        let moved = place.find(&operator, &stokes, [&rest, &weight], &mut plain, &mut polarized, &mut scratch);
        let before = rest.clone();
        place.correct(&operator, &stokes, &weight, &mut rest, &mut plain, &mut scratch);
        (moved, (dot(&rest, &rest) / dot(&before, &before).max(1e-12)).sqrt())
    }

    #[test]
    fn a_guide_that_is_off_is_moved_to_where_the_readings_have_it() {
        for off in [[1.6, -1.2], [-2.0, 0.0], [0.5, 2.5]] {
            let (moved, left) = found(off);
            let miss = (moved[0] - f64::from(off[0])).hypot(moved[1] - f64::from(off[1]));
            assert!(miss < 0.25, "{off:?}: moved by {moved:?}");
            assert!(left < 0.25, "{off:?}: {left} of the residual is left");
        }
        let (moved, _) = found([0.0; 2]);
        assert!(moved[0].hypot(moved[1]) < 0.05, "an aligned guide is moved by {moved:?}");
    }

    #[test]
    fn nothing_to_go_by_moves_nothing() {
        for size in [SIZE, Size::new(17, 1), Size::new(4, 9)] {
            let (operator, n) = (operator(size), size.pixels());
            let mut scratch = operator.convolver.make_scratch();
            let (mut plain, mut polarized) = (vec![0.0; n], vec![Complex32::ZERO; n]);
            for level in [0.0, 0.5] {
                let stokes: Vec<f32> = (0..3 * n).map(|i| if i < n { level } else { 0.0 }).collect();
                let mut place = Place::new(size);
                let readings = [&vec![0.0; n][..], &vec![1.0; n]];
                let moved = place.find(&operator, &stokes, readings, &mut plain, &mut polarized, &mut scratch);
                assert!(moved.iter().all(|v| v.abs() <= REACH), "{size}: {moved:?}");
                assert!(place.s0().iter().all(|v| (v - level).abs() < 1e-6), "{size}");
            }
        }
    }

    #[test]
    fn means_and_slopes_are_those_of_the_pixels_there_are() {
        for size in [Size::new(23, 9), Size::new(5, 30), Size::new(1, 1)] {
            let (w, h, n) = (size.width, size.height, size.pixels());
            let image: Vec<f32> = (0..n).map(|i| ((i * 7919) % 101) as f32).collect();
            let (mut rows, mut out, mut sums) = (vec![0.0; n], vec![0.0; n], vec![0.0; w]);
            for radius in [1, 4, 10] {
                near(&image, size, radius, &mut rows, &mut sums, &mut out);
                for (i, mean) in out.iter().enumerate() {
                    let (x, y) = (i % w, i / w);
                    let square = (0..n).filter(|j| (j % w).abs_diff(x) <= radius && (j / w).abs_diff(y) <= radius);
                    let (sum, count) = square.fold((0.0, 0.0), |(sum, count), j| (sum + image[j], count + 1.0));
                    assert!((mean - sum / count).abs() < 1e-3, "{size}, {radius}, ({x}, {y})");
                }
            }
            let ramp: Vec<f32> = (0..n).map(|i| 2.0 * (i % w) as f32 - 3.0 * (i / w) as f32).collect();
            along_x(&ramp, size, &mut out);
            assert!(w == 1 || out.iter().all(|v| (v - 2.0).abs() < 1e-5));
            along_y(&ramp, size, &mut out);
            assert!(h == 1 || out.iter().all(|v| (v + 3.0).abs() < 1e-5));
        }
    }

    #[test]
    fn an_image_is_moved_by_whole_pixels_and_by_parts_of_them() {
        let size = Size::new(12, 9);
        let image: Vec<f32> = (0..size.pixels()).map(|i| ((i * 7919) % 101) as f32).collect();
        let (mut rows, mut out) = (vec![0.0; size.pixels()], vec![0.0; size.pixels()]);
        moved(&image, size, Vector2::new(2.0, -3.0), &mut rows, &mut out);
        for (i, v) in out.iter().enumerate() {
            let (x, y) = ((i % 12 + 2).min(11), (i / 12).saturating_sub(3));
            assert!((v - image[y * 12 + x]).abs() < 1e-4);
        }
        let ramp: Vec<f32> = (0..size.pixels()).map(|i| 50.0 + (i % 12) as f32 - 2.0 * (i / 12) as f32).collect();
        moved(&ramp, size, Vector2::new(0.25, 0.5), &mut rows, &mut out);
        for y in 2..6 {
            for x in 2..9 {
                assert!((out[y * 12 + x] - ramp[y * 12 + x] - 0.25 + 1.0).abs() < 1e-4, "({x}, {y})");
            }
        }
    }
}
