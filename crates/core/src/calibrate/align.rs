//! `align`: the homography from the scene, as the lensless camera sees it, to the guide camera.
//!
//! S0 is reconstructed without the guide. A coarse search over magnification and rotation gives a first homography. Each round of
//! refinement warps the guide by the present homography, measures the displacement at places all over the frame, and fits a homography
//! to the pairs of points (RANSAC, then least squares; Hartley and Zisserman, Multiple View Geometry, algorithms 4.2 and 4.6).

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use nalgebra::{Matrix3, SMatrix, SymmetricEigen, Vector3};
use rand::{Rng, SeedableRng, rngs::StdRng};

use super::phase::{Correlator, Peak};
use super::{CalibrateError, Outcome, Remedy, Scale, Shots, Step, average, check_shapes, check_still, gray, pipeline};
use crate::device::{Device, Homography};
use crate::image::{Picture, Size, local_mean};

const STEP: Step = Step::Align;
/// Short side of the images of the coarse search, in pixels.
const COARSE: usize = 96;
/// Magnifications of the coarse search, as powers of a step: a guide camera may see twice as far as the sensor, or a little less.
const ZOOMS: (RangeInclusive<i32>, f64) = (-14..=5, 1.05);
/// Rotations of the coarse search, as multiples of a step in degrees.
const TURNS: (RangeInclusive<i32>, f64) = (-4..=4, 2.0);
/// Rounds of refinement.
const ROUNDS: usize = 6;
/// Number of places over the short side; neighbours overlap by half.
const PLACES: usize = 4;
/// A place has texture if its standard deviation is at least this share of the whole guide's.
const TEXTURE: f32 = 0.25;
/// A place matches if its correlation peak is above this height.
const FOUND: f64 = 0.04;
/// A place this far off the homography is an outlier, in pixels of the scene.
const OUTLIER: f64 = 1.0;
/// Least number of places that match.
const NEEDED: usize = 8;
/// Samples of four places that RANSAC tries.
const SAMPLES: usize = 400;
/// Largest residual of a good alignment, in pixels.
const GOOD: f64 = 0.3;

/// A measured alignment of the guide camera.
#[derive(Clone, Debug)]
pub struct Alignment {
    /// Maps a pixel of the scene to a pixel of the guide.
    pub homography: Homography,
    /// Root mean square distance between the matched places and the homography, in pixels of the scene.
    pub residual_px: f64,
    /// Number of places that agree with the homography.
    pub inliers: usize,
    /// Number of places with texture.
    pub places: usize,
    picture: Picture,
}

/// Aligns the guide with the reconstruction of raw frames of the same target.
///
/// # Errors
/// [`CalibrateError`]: frames that do not fit, movement, a guide that shows something else.
pub fn measure(device: &Device, raw: &Shots, guide: &Shots, threads: usize) -> Result<Alignment, CalibrateError> {
    check_shapes(raw, Some((device.sensor.channels, device.sensor.size)), STEP)?;
    check_shapes(guide, None, STEP)?;
    for shots in [raw, guide] {
        check_still(&shots.frames, STEP, |frames| gray(&average(frames).0))?;
    }
    let mut pipeline = pipeline(device, false, threads)?;
    pipeline.process(average(&raw.frames).0.view().in_unit(raw.unit), None)?;
    let stokes = &pipeline.result().stokes;
    let (size, each) = (stokes.size(), stokes.count() / device.sensor.channels);
    let mut s0 = vec![0.0; size.pixels()];
    for plane in stokes.planes().step_by(each) {
        s0.iter_mut().zip(plane).for_each(|(sum, v)| *sum += v);
    }
    let guide = average(&guide.frames).0;
    let start = if device.guide == Homography::IDENTITY { fit(size, guide.size()) } else { matrix(&device.guide) };
    find(&s0, size, &gray(&guide), guide.size(), start)
}

/// The homography of a guide whose view is that of the sensor.
fn fit(size: Size, guide: Size) -> Matrix3<f64> {
    let side = |s: Size| s.width.min(s.height) as f64;
    let scale = side(guide) / side(size);
    let offset = |from: usize, to: usize| 0.5 * (to as f64 - 1.0) - scale * 0.5 * (from as f64 - 1.0);
    Matrix3::new(
        scale,
        0.0,
        offset(size.width, guide.width),
        0.0,
        scale,
        offset(size.height, guide.height),
        0.0,
        0.0,
        1.0,
    )
}

fn matrix(h: &Homography) -> Matrix3<f64> {
    Matrix3::from_row_slice(&h.0)
}

fn apply(h: &Matrix3<f64>, x: f64, y: f64) -> [f64; 2] {
    let v = h * Vector3::new(x, y, 1.0);
    [v.x / v.z, v.y / v.z]
}

fn translation([dx, dy]: [f64; 2]) -> Matrix3<f64> {
    Matrix3::new(1.0, 0.0, dx, 0.0, 1.0, dy, 0.0, 0.0, 1.0)
}

/// A point of the scene, and the point of the guide that shows it.
type Pair = ([f64; 2], [f64; 2]);

/// Finds the homography from `s0` to the guide, near `start`.
fn find(
    s0: &[f32],
    size: Size,
    guide: &[f32],
    guide_size: Size,
    start: Matrix3<f64>,
) -> Result<Alignment, CalibrateError> {
    let mut h = coarse(s0, size, guide, guide_size, start);
    let side = (size.width.min(size.height) / PLACES).max(16);
    let correlator = Correlator::new(Size::new(side, side));
    let (mut inliers, mut places, mut residual) = (0, 0, f64::INFINITY);
    let mut rng = StdRng::seed_from_u64(1);
    for _ in 0..ROUNDS {
        let seen = warp(guide, guide_size, &h, size, 1.0);
        let contrast = deviation(&seen);
        let mut pairs: Vec<Pair> = Vec::new();
        places = 0;
        for top in (0..=size.height - side).step_by(side / 2) {
            for left in (0..=size.width - side).step_by(side / 2) {
                let cut = |image: &[f32]| -> Vec<f32> {
                    (0..side).flat_map(|y| image[(top + y) * size.width + left..][..side].iter().copied()).collect()
                };
                let place = cut(&seen);
                if deviation(&place) < TEXTURE * contrast {
                    continue;
                }
                places += 1;
                let Peak { shift: [dx, dy], height } = correlator.run(&cut(s0), &place);
                if height > FOUND && dx.abs().max(dy.abs()) < 0.25 * side as f64 {
                    let middle = 0.5 * (side as f64 - 1.0);
                    let at = [left as f64 + middle, top as f64 + middle];
                    pairs.push((at, apply(&h, at[0] + dx, at[1] + dy)));
                }
            }
        }
        let agreed = ransac(&pairs, &mut rng);
        inliers = agreed.len();
        let refined = if inliers >= NEEDED { homography(&agreed) } else { None };
        let Some(refined) = refined.filter(|_| 2 * inliers >= places) else {
            return Err(CalibrateError::OtherScene { inliers, places, needed: NEEDED });
        };
        h = refined;
        residual = (agreed.iter().map(|pair| distance(&h, pair).powi(2)).sum::<f64>() / inliers as f64).sqrt();
    }
    let h = h / h[(2, 2)];
    Ok(Alignment {
        homography: Homography(std::array::from_fn(|i| h[(i / 3, i % 3)])),
        residual_px: residual,
        inliers,
        places,
        picture: overlay(s0, &warp(guide, guide_size, &h, size, 1.0), size),
    })
}

/// The magnification, rotation about the middle and displacement whose warped guide correlates best with S0.
fn coarse(s0: &[f32], size: Size, guide: &[f32], guide_size: Size, start: Matrix3<f64>) -> Matrix3<f64> {
    let step = (size.width.min(size.height) as f64 / COARSE as f64).max(1.0);
    let small = Size::new((size.width as f64 / step) as usize, (size.height as f64 / step) as usize);
    let shrunk = warp(s0, size, &Matrix3::identity(), small, step);
    let correlator = Correlator::new(small);
    let (cx, cy) = (0.5 * (size.width as f64 - 1.0), 0.5 * (size.height as f64 - 1.0));
    let mut best = (f64::NEG_INFINITY, start);
    for zoom in ZOOMS.0 {
        for turn in TURNS.0 {
            let scale = ZOOMS.1.powi(zoom);
            let (sin, cos) = (f64::from(turn) * TURNS.1).to_radians().sin_cos();
            let about = Matrix3::new(scale * cos, -scale * sin, 0.0, scale * sin, scale * cos, 0.0, 0.0, 0.0, 1.0);
            let h = start * translation([cx, cy]) * about * translation([-cx, -cy]);
            let peak = correlator.run(&shrunk, &warp(guide, guide_size, &h, small, step));
            if peak.height > best.0 {
                best = (peak.height, h * translation(peak.shift.map(|d| d * step)));
            }
        }
    }
    best.1
}

/// Resamples an image through `h` on a grid of `size` whose pixels are `step` scene pixels wide, averaged over their area.
fn warp(image: &[f32], from: Size, h: &Matrix3<f64>, size: Size, step: f64) -> Vec<f32> {
    let sharp = h.determinant().abs().sqrt() * step;
    let fine = if sharp.is_finite() { (sharp.round() as usize).clamp(1, 4) } else { 1 };
    let offset = |k: usize| (k as f64 + 0.5) / fine as f64 - 0.5;
    let sample = |x: f64, y: f64| {
        let inside = |v: f64, n: usize| if v.is_finite() { v.clamp(0.0, (n - 1) as f64) } else { 0.0 };
        let (x, y) = (inside(x, from.width), inside(y, from.height));
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(from.width - 1), (y0 + 1).min(from.height - 1));
        let (fx, fy) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
        let line = |y: usize| image[y * from.width + x0] * (1.0 - fx) + image[y * from.width + x1] * fx;
        line(y0) * (1.0 - fy) + line(y1) * fy
    };
    let pixel = |i: usize| {
        let (x, y) = ((i % size.width) as f64, (i / size.width) as f64);
        let each = (0..fine * fine).map(|s| {
            let scene = |v: f64, k: usize| (v + offset(k) + 0.5) * step - 0.5;
            let [gx, gy] = apply(h, scene(x, s % fine), scene(y, s / fine));
            sample(gx, gy)
        });
        each.sum::<f32>() / (fine * fine) as f32
    };
    (0..size.pixels()).map(pixel).collect()
}

/// Standard deviation.
fn deviation(image: &[f32]) -> f32 {
    let n = image.len() as f32;
    let mean = image.iter().sum::<f32>() / n;
    (image.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n).sqrt()
}

/// Distance between the point of the guide and the point of the scene mapped by `h`, in pixels of the scene.
fn distance(h: &Matrix3<f64>, ([x, y], [gx, gy]): &Pair) -> f64 {
    let [hx, hy] = apply(h, *x, *y);
    let [[ax, ay], [bx, by]] = [apply(h, x + 1.0, *y), apply(h, *x, y + 1.0)];
    let scale = ((ax - hx) * (by - hy) - (ay - hy) * (bx - hx)).abs().sqrt().max(f64::MIN_POSITIVE);
    (hx - gx).hypot(hy - gy) / scale
}

/// The largest set of pairs that agree with one homography.
fn ransac(pairs: &[Pair], rng: &mut StdRng) -> Vec<Pair> {
    let mut best: Vec<Pair> = Vec::new();
    if pairs.len() < 4 {
        return best;
    }
    for _ in 0..SAMPLES {
        let sample: Vec<Pair> = (0..4).map(|_| pairs[rng.random_range(0..pairs.len())]).collect();
        let Some(h) = homography(&sample) else { continue };
        let agree: Vec<Pair> = pairs.iter().filter(|pair| distance(&h, pair) < OUTLIER).copied().collect();
        if agree.len() > best.len() {
            best = agree;
        }
    }
    best
}

/// The homography through pairs of points, by the normalized direct linear transform.
fn homography(pairs: &[Pair]) -> Option<Matrix3<f64>> {
    let normalizer = |points: &dyn Fn(&Pair) -> [f64; 2]| {
        let n = pairs.len() as f64;
        let sum = pairs.iter().map(points).fold([0.0; 2], |s, p| [s[0] + p[0] / n, s[1] + p[1] / n]);
        let spread = pairs.iter().map(points).map(|p| (p[0] - sum[0]).hypot(p[1] - sum[1])).sum::<f64>() / n;
        (spread > 1e-6)
            .then(|| Matrix3::new_scaling(std::f64::consts::SQRT_2 / spread) * translation([-sum[0], -sum[1]]))
    };
    let (from, to) = (normalizer(&|p| p.0)?, normalizer(&|p| p.1)?);
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (p, g) in pairs {
        let ([x, y], [u, v]) = (apply(&from, p[0], p[1]), apply(&to, g[0], g[1]));
        for row in [[x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u], [0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v]] {
            let row = SMatrix::<f64, 9, 1>::from(row);
            normal += row * row.transpose();
        }
    }
    let eigen = SymmetricEigen::new(normal);
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    // points on a line, or the same ones, leave more than one solution
    if eigen.eigenvalues[order[1]] < 1e-9 * eigen.eigenvalues[order[8]] {
        return None;
    }
    let h = Matrix3::from_row_slice(eigen.eigenvectors.column(order[0]).as_slice());
    let h = to.try_inverse()? * h * from;
    (h.iter().all(|v| v.is_finite()) && h[(2, 2)].abs() > 1e-12).then(|| h / h[(2, 2)])
}

/// S0 in green and the guide in magenta, both by their local contrast: gray where their structure agrees, whatever their brightness.
fn overlay(s0: &[f32], guide: &[f32], size: Size) -> Picture {
    let code = |value: f32| (255.0 * (0.5 + 0.2 * value).clamp(0.0, 1.0)) as u8;
    let [green, magenta] = [s0, guide].map(|plane| local_contrast(plane, size));
    let pixels = green.into_iter().zip(magenta).map(|(g, m)| [code(m), code(g), code(m)]);
    Picture { size, pixels: pixels.collect() }
}

/// Difference of each pixel to the mean around it, over the standard deviation there. Little structure stays little.
fn local_contrast(plane: &[f32], size: Size) -> Vec<f32> {
    let radius = (size.width.min(size.height) / 16).max(4);
    let around = |values: &[f32]| {
        let mut means = vec![0.0; values.len()];
        local_mean(values, radius, &mut vec![0.0; size.width], &mut means);
        means
    };
    let means = around(plane);
    let parts: Vec<f32> = plane.iter().zip(&means).map(|(v, mean)| v - mean).collect();
    let squares: Vec<f32> = parts.iter().map(|v| v * v).collect();
    let (local, whole) = (around(&squares), squares.iter().sum::<f32>() / squares.len().max(1) as f32);
    let scaled = parts.iter().zip(local).map(|(v, square)| v / (square + 0.1 * whole + f32::MIN_POSITIVE).sqrt());
    scaled.collect()
}

impl Alignment {
    /// The quality of the alignment.
    pub fn outcome(&self) -> Outcome {
        let good = self.residual_px <= GOOD;
        let end = if good { "good" } else { "usable" };
        Outcome {
            step: STEP,
            good,
            verdict: format!(
                "Guide aligned to {:.2} pixels (rms) at {} of {} places: {end}.",
                self.residual_px, self.inliers, self.places
            ),
            quality: BTreeMap::from([
                ("residual_px", self.residual_px),
                ("inliers", self.inliers as f64),
                ("places", self.places as f64),
            ]),
            remedy: (!good).then_some(Remedy::SharperTarget),
            picture: self.picture.clone(),
            scale: Scale::Overlay { title: "Guide on the lensless image", green: "lensless", magenta: "guide" },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_picture_is_gray_where_both_agree_whatever_their_brightness() {
        let size = Size::new(32, 32);
        let guide: Vec<f32> = (0..1024).map(|i| 0.2 + 0.5 * ((i * 37 % 101) as f32 / 101.0)).collect();
        let dim: Vec<f32> =
            guide.iter().enumerate().map(|(i, g)| 0.1 + 0.3 * g + 0.2 * (i / 32) as f32 / 32.0).collect();
        let colour = |s0: &[f32]| {
            let pixels = overlay(s0, &guide, size).pixels;
            pixels.iter().map(|[r, g, _]| u32::from(r.abs_diff(*g))).max().unwrap()
        };
        assert!(colour(&dim) <= 20, "{}", colour(&dim));
        let moved: Vec<f32> = (0..1024).map(|i| dim[(i + 1) % 1024]).collect();
        assert!(colour(&moved) > 50);
    }

    #[test]
    fn a_homography_comes_back_from_pairs_with_outliers() {
        let truth = Matrix3::new(1.2, 0.03, 5.0, -0.02, 1.25, -3.0, 1e-4, -5e-5, 1.0);
        let mut pairs: Vec<Pair> = (0..40)
            .map(|i| [f64::from(i % 8) * 20.0, f64::from(i / 8) * 25.0])
            .map(|p| (p, apply(&truth, p[0], p[1])))
            .collect();
        pairs.iter_mut().step_by(4).for_each(|pair| pair.1[0] += 15.0);
        let agreed = ransac(&pairs, &mut StdRng::seed_from_u64(1));
        assert_eq!(agreed.len(), 30);
        assert!((homography(&agreed).unwrap() - truth).norm() < 1e-6);
    }

    #[test]
    fn points_on_a_line_have_no_homography() {
        let line: Vec<Pair> = (0..6).map(|i| [f64::from(i), f64::from(2 * i)]).map(|p| (p, p)).collect();
        assert!(homography(&line).is_none());
    }
}
