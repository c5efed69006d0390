//! The guide frame: resampled onto the sensor's grid, in the sensor's channels.

use crate::calibration::Homography;
use crate::plane::{Size, Stack};

/// Values that are not finite or negative become 0: a guide never measures less than no light.
fn clean(v: f32) -> f32 {
    if v.is_finite() { v.max(0.0) } else { 0.0 }
}

/// Resamples `frame` (1 or 3 planes, any size) into `guide` (1 or 3 planes of the sensor's size). `homography` maps scene
/// pixels to guide pixels; where it leaves the frame, the nearest pixel of the frame is taken. A colour guide of a mono
/// sensor is averaged, a mono guide of a colour sensor repeated.
pub(super) fn resample(frame: &Stack<f32>, homography: &Homography, guide: &mut Stack<f32>) {
    let size = guide.size();
    let planes = frame.count();
    let direct = *homography == Homography::IDENTITY && frame.size() == size;
    // A finer guide is averaged over the footprint of a scene pixel, or fine texture would alias.
    let samples = samples_per_side(homography, size);
    for c in 0..guide.count() {
        let sources = if guide.count() == planes { c..c + 1 } else { 0..planes };
        let share = 1.0 / (sources.len() * if direct { 1 } else { samples * samples }) as f32;
        let out = guide.plane_mut(c);
        for y in 0..size.height {
            for x in 0..size.width {
                let mut sum = 0.0;
                for source in sources.clone() {
                    let plane = frame.plane(source);
                    if direct {
                        sum += clean(plane[y * size.width + x]);
                        continue;
                    }
                    for s in 0..samples * samples {
                        let offset = |k: usize| (k as f64 + 0.5) / samples as f64 - 0.5;
                        let (sx, sy) = (offset(s % samples), offset(s / samples));
                        let (gx, gy) = homography.apply(x as f64 + sx, y as f64 + sy);
                        sum += bilinear(plane, frame.size(), gx, gy);
                    }
                }
                out[y * size.width + x] = sum * share;
            }
        }
    }
}

fn samples_per_side(homography: &Homography, size: Size) -> usize {
    let (x, y) = (size.width as f64 / 2.0, size.height as f64 / 2.0);
    let (a, b) = (homography.apply(x, y), homography.apply(x + 1.0, y));
    let c = homography.apply(x, y + 1.0);
    let step = (b.0 - a.0).hypot(b.1 - a.1).max((c.0 - a.0).hypot(c.1 - a.1));
    if step.is_finite() { (step.ceil() as usize).clamp(1, 8) } else { 1 }
}

fn bilinear(plane: &[f32], size: Size, x: f64, y: f64) -> f32 {
    let clamp = |v: f64, n: usize| if v.is_finite() { v.clamp(0.0, (n - 1) as f64) } else { 0.0 };
    let (x, y) = (clamp(x, size.width), clamp(y, size.height));
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
    use super::*;

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
