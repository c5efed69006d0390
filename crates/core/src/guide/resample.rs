//! The guide frame: resampled onto the sensor's grid, in the sensor's channels.

use super::colors::Weights;
use super::fit::centre;
use super::parallax::Shifts;
use super::register::Parameters;
use crate::device::Homography;
use crate::image::{Planes, Size, Stack};

/// Values that are not finite or negative become 0: a guide never measures less than no light.
fn clean(v: f32) -> f32 {
    if v.is_finite() { v.max(0.0) } else { 0.0 }
}

/// Interpolation taps a side. Fewer soften fine texture: at half a pixel of shift, 4 taps cost up to 5 dB of S0, 16 one or two.
const TAPS: usize = 16;
/// Phases of the kernel's table; positions are rounded to the nearest one.
const PHASES: usize = 512;
/// Shape of the Kaiser window.
const BETA: f64 = 4.0;

/// Interpolation by a windowed sinc.
#[derive(Clone, Debug)]
pub(super) struct Sampler {
    /// For each phase, the weights of the samples from −7 to 8 around a position in [0, 1].
    table: Vec<[f32; TAPS]>,
}

impl Sampler {
    /// Makes the table. Allocates.
    pub(super) fn new() -> Self {
        let table = (0..=PHASES).map(|phase| {
            let weights: [f64; TAPS] = std::array::from_fn(|k| {
                let x = k as f64 - (TAPS / 2 - 1) as f64 - phase as f64 / PHASES as f64;
                let inside = 1.0 - (x / (TAPS / 2) as f64).powi(2);
                sinc(x) * bessel_i0(BETA * inside.max(0.0).sqrt())
            });
            let sum: f64 = weights.iter().sum();
            weights.map(|w| (w / sum) as f32)
        });
        Self { table: table.collect() }
    }

    /// The first sample that counts at position `x`, and the weights from there on.
    fn at(&self, x: f64) -> (isize, &[f32; TAPS]) {
        let floor = x.floor();
        let phase = ((x - floor) * PHASES as f64).round() as usize;
        (floor as isize - (TAPS / 2 - 1) as isize, &self.table[phase])
    }

    /// Resamples `frame` (1 or 3 planes, any size) into `guide` (1 or 3 planes of the sensor's size). `homography` maps
    /// scene pixels, moved by `shifts`, to guide pixels; where it leaves the frame, the nearest pixel of the frame is taken. A colour guide
    /// of a mono sensor is mixed by `weights`, a mono guide of a colour sensor repeated. `plane` is a buffer of the sensor's size.
    pub(super) fn resample(
        &self,
        frame: Planes<'_>,
        (homography, shifts): (&Homography, Option<&Shifts>),
        weights: Weights,
        guide: &mut Stack<f32>,
        plane: &mut [f32],
    ) {
        let (size, planes) = (guide.size(), frame.count());
        let translation = match homography.0 {
            [1.0, 0.0, dx, 0.0, 1.0, dy, 0.0, 0.0, 1.0] if frame.size() == size && shifts.is_none() => Some((dx, dy)),
            _ => None,
        };
        for c in 0..guide.count() {
            let sources = if guide.count() == planes { c..c + 1 } else { 0..planes };
            let alone = sources.len() == 1;
            let sources = sources.map(|c| (frame.plane(c), if alone { 1.0 } else { weights[c] }));
            let sources = sources.filter(|(_, weight)| *weight != 0.0);
            match translation {
                Some(shift) => self.translate(sources, size, shift, guide.plane_mut(c), plane),
                None => self.warp(sources, frame.size(), (homography, shifts), guide.plane_mut(c), size),
            }
        }
    }

    /// out(x, y) = Σ weight · source (x + dx, y + dy), rows first, then columns.
    fn translate<'a>(
        &self,
        sources: impl Iterator<Item = (&'a [f32], f32)>,
        size: Size,
        (dx, dy): (f64, f64),
        out: &mut [f32],
        rows: &mut [f32],
    ) {
        let (width, height) = (size.width, size.height);
        // Beyond the frame there is nothing but its border.
        let (dx, dy) = (dx.clamp(-(width as f64), width as f64), dy.clamp(-(height as f64), height as f64));
        rows.fill(0.0);
        let (first, weights) = self.at(dx);
        for (source, share) in sources {
            for (line, out) in source.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
                if dx == 0.0 {
                    out.iter_mut().zip(line).for_each(|(o, v)| *o += share * clean(*v));
                    continue;
                }
                for (x, o) in out.iter_mut().enumerate() {
                    *o += share * weigh(weights, x as isize + first, width, |x| line[x]);
                }
            }
        }
        let (first, weights) = self.at(dy);
        for (y, out) in out.chunks_exact_mut(width).enumerate() {
            if dy == 0.0 {
                out.copy_from_slice(&rows[y * width..][..width]);
            } else {
                out.fill(0.0);
                for (k, w) in weights.iter().enumerate() {
                    let line = &rows[inside(y as isize + first + k as isize, height) * width..][..width];
                    out.iter_mut().zip(line).for_each(|(o, v)| *o += w * v);
                }
            }
            out.iter_mut().for_each(|v| *v = v.max(0.0));
        }
    }

    /// out(x, y) = Σ weight · source (homography((x, y) + shifts(x, y))).
    fn warp<'a>(
        &self,
        sources: impl Iterator<Item = (&'a [f32], f32)>,
        source_size: Size,
        (homography, shifts): (&Homography, Option<&Shifts>),
        out: &mut [f32],
        size: Size,
    ) {
        // A finer guide is averaged over the footprint of a scene pixel, or fine texture would alias.
        let samples = samples_per_side(homography, size);
        let offset = |k: usize| (k as f64 + 0.5) / samples as f64 - 0.5;
        out.fill(0.0);
        for (plane, weight) in sources {
            let share = weight / (samples * samples) as f32;
            for (i, o) in out.iter_mut().enumerate() {
                let (x, y) = moved_by(shifts, i, size);
                let mut sum = 0.0;
                for s in 0..samples * samples {
                    let (gx, gy) = homography.apply(x + offset(s % samples), y + offset(s / samples));
                    let sample = |gx, gy| match samples {
                        1 => self.sinc(plane, source_size, gx, gy),
                        _ => bilinear(plane, source_size, gx, gy),
                    };
                    sum += sample(within(gx, source_size.width), within(gy, source_size.height));
                }
                *o += share * sum;
            }
        }
        out.iter_mut().for_each(|v| *v = v.max(0.0));
    }

    fn sinc(&self, plane: &[f32], size: Size, x: f64, y: f64) -> f32 {
        let ((left, across), (top, down)) = (self.at(x), self.at(y));
        let line = |k: usize| &plane[inside(top + k as isize, size.height) * size.width..][..size.width];
        let row = |k: usize| weigh(across, left, size.width, |x| line(k)[x]);
        down.iter().enumerate().map(|(k, w)| w * row(k)).sum()
    }
}

/// Σ weights · clean(samples from `first` on), the border repeated.
fn weigh(weights: &[f32; TAPS], first: isize, len: usize, sample: impl Fn(usize) -> f32) -> f32 {
    let weighed = |at: &dyn Fn(usize) -> usize| -> f32 {
        weights.iter().enumerate().map(|(k, w)| w * clean(sample(at(k)))).sum()
    };
    match usize::try_from(first) {
        Ok(first) if first + TAPS <= len => weighed(&|k| first + k),
        _ => weighed(&|k| inside(first + k as isize, len)),
    }
}

fn inside(i: isize, len: usize) -> usize {
    i.clamp(0, len as isize - 1) as usize
}

/// A position inside a line of `len` pixels.
fn within(v: f64, len: usize) -> f64 {
    if v.is_finite() { v.clamp(0.0, (len - 1) as f64) } else { 0.0 }
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { (std::f64::consts::PI * x).sin() / (std::f64::consts::PI * x) }
}

/// The modified Bessel function I₀ by its power series, for small arguments.
fn bessel_i0(x: f64) -> f64 {
    let (mut sum, mut term) = (1.0, 1.0);
    for k in 1..32 {
        term *= (x / (2 * k) as f64).powi(2);
        sum += term;
    }
    sum
}

/// The homography of a scene whose content lies against the guide as `lies` says: pixel (x, y) is seen as if at (x, y) + the
/// shift there.
pub(super) fn moved(homography: &Homography, lies: &Parameters, size: Size) -> Homography {
    let (cx, cy, unit) = centre(size);
    let [dx, dy, xx, xy, yx, yy] = std::array::from_fn(|k| if k < 2 { lies[k] } else { lies[k] / unit });
    let map = [1.0 + xx, xy, dx - xx * cx - xy * cy, yx, 1.0 + yy, dy - yx * cx - yy * cy];
    let mut h = homography.0;
    for row in h.chunks_exact_mut(3) {
        let [a, b, c] = [row[0], row[1], row[2]];
        row[0] = a * map[0] + b * map[3];
        row[1] = a * map[1] + b * map[4];
        row[2] = a * map[2] + b * map[5] + c;
    }
    Homography(h)
}

/// The place of pixel `i` once `shifts` have moved it.
pub(super) fn moved_by(shifts: Option<&Shifts>, i: usize, size: Size) -> (f64, f64) {
    let (x, y) = ((i % size.width) as f64, (i / size.width) as f64);
    let (dx, dy) = shifts.map_or((0.0, 0.0), |shifts| shifts.at(x, y, size));
    (x + dx, y + dy)
}

fn samples_per_side(homography: &Homography, size: Size) -> usize {
    let (x, y) = (size.width as f64 / 2.0, size.height as f64 / 2.0);
    let (a, b) = (homography.apply(x, y), homography.apply(x + 1.0, y));
    let c = homography.apply(x, y + 1.0);
    let step = (b.0 - a.0).hypot(b.1 - a.1).max((c.0 - a.0).hypot(c.1 - a.1));
    if step.is_finite() { (step.ceil() as usize).clamp(1, 8) } else { 1 }
}

fn bilinear(plane: &[f32], size: Size, x: f64, y: f64) -> f32 {
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(size.width - 1), (y0 + 1).min(size.height - 1));
    let (fx, fy) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
    let at = |y: usize, x: usize| clean(plane[y * size.width + x]);
    let top = at(y0, x0) * (1.0 - fx) + at(y0, x1) * fx;
    let bottom = at(y1, x0) * (1.0 - fx) + at(y1, x1) * fx;
    top * (1.0 - fy) + bottom * fy
}

#[cfg(test)]
mod tests {
    use super::super::colors::EVEN;
    use super::*;

    fn resample(frame: &Stack<f32>, homography: &Homography, guide: &mut Stack<f32>) {
        let mut plane = vec![f32::NAN; guide.size().pixels()];
        Sampler::new().resample(frame.borrow(), (homography, None), EVEN, guide, &mut plane);
    }

    fn ramp(size: Size, planes: usize) -> Stack<f32> {
        let mut s = Stack::zeros(planes, size);
        for (c, plane) in s.planes_mut().enumerate() {
            for (i, v) in plane.iter_mut().enumerate() {
                *v = (i % size.width) as f32 + 100.0 * (i / size.width) as f32 + 1e4 * c as f32;
            }
        }
        s
    }

    #[test]
    fn a_homography_shifts_scales_and_averages() {
        let frame = ramp(Size::new(20, 16), 1);
        let mut guide = Stack::zeros(1, Size::new(6, 5));
        // Scene pixel (x, y) is guide pixel (2x + 3.5, 2y + 2.5): centres of 2×2 blocks.
        resample(&frame, &Homography([2.0, 0.0, 3.5, 0.0, 2.0, 2.5, 0.0, 0.0, 1.0]), &mut guide);
        for y in 0..5 {
            for x in 0..6 {
                let want = 2.0 * x as f32 + 3.5 + 100.0 * (2.0 * y as f32 + 2.5);
                assert!((guide.plane(0)[y * 6 + x] - want).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn channels_are_matched() {
        let size = Size::new(4, 3);
        let (mut mono, mut colour) = (Stack::zeros(1, size), Stack::zeros(3, size));
        resample(&ramp(size, 3), &Homography::IDENTITY, &mut mono);
        assert_eq!(mono.plane(0)[5], 101.0 + 1e4);
        resample(&ramp(size, 1), &Homography::IDENTITY, &mut colour);
        assert_eq!(colour.plane(2), ramp(size, 1).plane(0));
    }

    #[test]
    fn values_that_are_no_light_become_none() {
        let size = Size::new(2, 2);
        let frame = Stack::from_vec(1, size, vec![f32::NAN, -1.0, f32::INFINITY, 0.5]).unwrap();
        let mut guide = Stack::zeros(1, size);
        resample(&frame, &Homography::IDENTITY, &mut guide);
        assert_eq!(guide.plane(0), [0.0, 0.0, 0.0, 0.5]);
    }
}
