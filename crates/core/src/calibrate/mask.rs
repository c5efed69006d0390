//! `mask`: response of every pixel to polarized light, and the angle, extinction and edges of every stripe.
//!
//! Uniform light behind a polarizer at θ_j reads g_j · (m0 + m1 cos 2θ_j + m2 sin 2θ_j) at a pixel. The exposures g_j of the views differ
//! a little, as lamp and shutter do. With more than three angles they are estimated: divided by g_j, the readings r of every pixel must
//! be a combination of 1, cos 2θ and sin 2θ. With N the projection onto the orthogonal complement of these three, the 1/g_j are the
//! eigenvector of the smallest eigenvalue of N ∘ Σ r rᵀ.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, SymmetricEigen};

use super::{
    CalibrateError, Levels, Outcome, PolarizedShots, Remedy, Scale, Step, angle_difference, check_angles, gray, median,
};
use crate::image::{Complex32, Picture, Size, Stack};
use crate::optics::Response;
use crate::polarization::Angle;
use crate::polarization::color::{AolpMode, aolp_color, quantile};

const STEP: Step = Step::Mask;
/// Signal below this many σ, or this share of full scale, is no light.
const OFF: (f32, f32) = (10.0, 0.01);
/// Share of clipped readings that is allowed: hot pixels.
const CLIPPED: f64 = 0.005;
/// Median modulation |m1 + i·m2| / m0 below which nothing was turned.
const MODULATION: f64 = 0.1;
/// Root mean square departure from Malus's law, as a share of the mean reading, beyond what noise explains.
const MALUS: f64 = 0.03;
/// The exposures' eigenvector is believed when its eigenvalue is this much smaller than the next …
const DISTINCT: f64 = 10.0;
/// … and no exposure differs more than this from the mean.
const EXPOSURES: f64 = 0.3;
/// Stripes this far off their description (rms, degrees) are those of another mask.
const OTHER: f64 = 20.0;
/// Least median extinction of a good mask. Angle errors do not matter: they are measured.
const GOOD_EXTINCTION: f64 = 5.0;

/// The mask as its maker describes it.
#[derive(Clone, Debug)]
pub struct Layout {
    /// Angles in stripe order.
    pub angles: Vec<Angle>,
    /// Vertical stripes over the width.
    pub stripes: usize,
}

/// One measured stripe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredStripe {
    /// Measured angle in degrees, within 90° of the nominal one.
    pub angle_deg: f64,
    /// Nominal angle in degrees, from the [`Layout`].
    pub nominal_deg: f64,
    /// Transmission parallel : crossed.
    pub extinction: f64,
    /// Left edge in pixels from the left; none for the first stripe, and for stripes narrower than four pixels.
    pub left: Option<f64>,
    /// Width (σ) of the left edge in pixels.
    pub blur: Option<f64>,
}

/// A measured mask.
#[derive(Clone, Debug)]
pub struct MeasuredMask {
    /// Readings under unit light polarized at each angle of the layout, `[P, H, W]`.
    pub transmission: Stack<f32>,
    /// Angles of the layout.
    pub angles: Vec<Angle>,
    /// The stripes from left to right.
    pub stripes: Vec<MeasuredStripe>,
    /// Exposure of each view over their mean.
    pub exposures: Vec<f64>,
    /// Root mean square departure from Malus's law, as a share of the mean reading.
    pub malus: f64,
    /// m1 + i·m2 of each pixel.
    polarized: Vec<Complex32>,
}

/// The averaged views.
struct Readings {
    /// Signal of each view, one plane of all channels.
    planes: Vec<Vec<f32>>,
    /// Pixels that were clipped in any view.
    clipped: Vec<bool>,
    /// Noise variance of a reading.
    variance: f64,
}

/// Measures the mask from views of uniform light behind a polarizer. Angles are against the sensor's rows.
///
/// # Errors
/// [`CalibrateError`]: a layout that cannot be, too few angles, frames that do not fit, no light, saturation, a polarizer that was not
/// turned, readings that no polarizer gives, stripes that are not those described.
pub fn measure(views: &[PolarizedShots], levels: &Levels, layout: &Layout) -> Result<MeasuredMask, CalibrateError> {
    let size = levels.sensor.size;
    // refuses a layout without three different angles, or with more stripes than columns
    Response::stripes(size, layout.angles.clone(), layout.stripes, f64::INFINITY)?;
    let angles = check_angles(views, 3, STEP)?;
    let mut readings = average_views(views, levels)?;
    let design = DMatrix::from_fn(views.len(), 3, |j, k| [1.0, angles[j].cos2(), angles[j].sin2()][k]);
    // with ε > 0 the pseudo-inverse exists for every matrix
    let fit = design.clone().pseudo_inverse(1e-9).unwrap_or_else(|_| DMatrix::zeros(3, views.len()));
    let complement = DMatrix::identity(views.len(), views.len()) - &design * &fit;
    let exposures = exposures(&readings, &complement);
    for (plane, exposure) in readings.planes.iter_mut().zip(&exposures) {
        plane.iter_mut().for_each(|v| *v /= *exposure as f32);
    }
    let mut maps = response_maps(&readings, &fit, size);
    let modulation = |i: usize| maps[1][i].hypot(maps[2][i]) / maps[0][i].max(f32::MIN_POSITIVE);
    let found = f64::from(median(&mut (0..size.pixels()).map(modulation).collect::<Vec<_>>()));
    if found < MODULATION {
        return Err(CalibrateError::NotTurned { step: STEP, found, needed: MODULATION });
    }
    let malus = departure(&readings, &maps, &angles)?;
    let unit = unit(&maps, size);
    maps.iter_mut().flatten().for_each(|v| *v /= unit);
    let stripes = stripes(&maps, size, layout);
    let off = rms(stripes.iter().map(|s| s.angle_deg - s.nominal_deg));
    if off > OTHER {
        return Err(CalibrateError::OtherMask { off, allowed: OTHER });
    }
    let transmission = transmission(&maps, &layout.angles, size);
    // refuses a mask that no bundle can hold
    let response = Response::measured(size, layout.angles.clone(), &transmission)?;
    let polarized = response.polarized().to_vec();
    Ok(MeasuredMask { transmission, angles: layout.angles.clone(), stripes, exposures, malus, polarized })
}

fn average_views(views: &[PolarizedShots], levels: &Levels) -> Result<Readings, CalibrateError> {
    let n = levels.sensor.size.pixels();
    let mut readings = Readings { planes: Vec::with_capacity(views.len()), clipped: vec![false; n], variance: 0.0 };
    for PolarizedShots { angle, shots } in views {
        let mean = levels.mean(shots, STEP)?;
        let share = mean.clipped.iter().filter(|c| **c).count() as f64 / mean.clipped.len() as f64;
        if share > CLIPPED {
            let (percent, allowed) = (100.0 * share, 100.0 * CLIPPED);
            return Err(CalibrateError::Saturated { step: STEP, percent, allowed, angle: Some(*angle) });
        }
        let plane = gray(&mean.signal);
        let (signal, needed) = (plane.iter().sum::<f32>() / n as f32, OFF.1.max(OFF.0 * mean.sigma));
        if signal < needed {
            return Err(CalibrateError::NoLight { step: STEP, signal, needed, angle: Some(*angle) });
        }
        for channel in mean.clipped.chunks_exact(n) {
            readings.clipped.iter_mut().zip(channel).for_each(|(any, clipped)| *any |= clipped);
        }
        readings.variance += f64::from(mean.sigma * mean.sigma) / (mean.signal.count() * views.len()) as f64;
        readings.planes.push(plane);
    }
    Ok(readings)
}

/// m0, m1 and m2 of each pixel: the least-squares `fit` (3 × views) of the readings.
fn response_maps(readings: &Readings, fit: &DMatrix<f64>, size: Size) -> [Vec<f32>; 3] {
    std::array::from_fn(|k| {
        let mut map = vec![0.0f32; size.pixels()];
        for (j, plane) in readings.planes.iter().enumerate() {
            map.iter_mut().zip(plane).for_each(|(m, r)| *m += fit[(k, j)] as f32 * r);
        }
        mend(&mut map, &readings.clipped, size.width);
        map
    })
}

/// Readings under unit light polarized at each of `angles`, `[P, H, W]`.
fn transmission(maps: &[Vec<f32>; 3], angles: &[Angle], size: Size) -> Stack<f32> {
    let mut transmission = Stack::zeros(angles.len(), size);
    for (plane, angle) in transmission.planes_mut().zip(angles) {
        let (c, s) = (angle.cos2() as f32, angle.sin2() as f32);
        plane.iter_mut().enumerate().for_each(|(i, t)| *t = (maps[0][i] + c * maps[1][i] + s * maps[2][i]).max(0.0));
    }
    transmission
}

fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1) as f64;
    (values.map(|v| v * v).sum::<f64>() / count).sqrt()
}

/// Exposure of each view over their mean; all 1 where the readings do not determine them. `complement` is the projection onto the
/// readings that no mixture of polarizers gives.
fn exposures(Readings { planes, clipped, variance }: &Readings, complement: &DMatrix<f64>) -> Vec<f64> {
    let count = planes.len();
    let equal = vec![1.0; count];
    if count < 4 {
        return equal;
    }
    let mut moments = DMatrix::<f64>::zeros(count, count);
    for i in (0..clipped.len()).filter(|i| !clipped[*i]) {
        for j in 0..count {
            for k in 0..=j {
                moments[(j, k)] += f64::from(planes[j][i]) * f64::from(planes[k][i]);
            }
        }
    }
    moments.fill_upper_triangle_with_lower_triangle();
    (0..count).for_each(|j| moments[(j, j)] -= variance * clipped.len() as f64);
    let eigen = SymmetricEigen::new(moments.component_mul(complement));
    let mut order: Vec<usize> = (0..count).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    let vector = eigen.eigenvectors.column(order[0]);
    let inverse: Vec<f64> = vector.iter().map(|v| v * count as f64 / vector.sum()).collect();
    let known = eigen.eigenvalues[order[1]] > DISTINCT * eigen.eigenvalues[order[0]].abs();
    if known && inverse.iter().all(|v| (v - 1.0).abs() < EXPOSURES) {
        inverse.iter().map(|v| 1.0 / v).collect()
    } else {
        equal
    }
}

/// Replaces clipped pixels by the nearest other one of their column.
fn mend(map: &mut [f32], clipped: &[bool], width: usize) {
    let rows = map.len() / width;
    for i in (0..map.len()).filter(|i| clipped[*i]) {
        let (x, y) = (i % width, i / width);
        let near = (1..rows).flat_map(|d| [y.checked_sub(d), (y + d < rows).then_some(y + d)]).flatten();
        map[i] = near.map(|y| y * width + x).find(|j| !clipped[*j]).map_or(0.0, |j| map[j]);
    }
}

/// Root mean square residual of the fit beyond noise, as a share of the mean reading.
fn departure(
    Readings { planes, clipped, variance }: &Readings,
    maps: &[Vec<f32>; 3],
    angles: &[Angle],
) -> Result<f64, CalibrateError> {
    let sums = planes.iter().zip(angles).map(|(plane, angle)| {
        let (c, s) = (angle.cos2() as f32, angle.sin2() as f32);
        let left = |i: usize| f64::from(plane[i] - maps[0][i] - c * maps[1][i] - s * maps[2][i]).powi(2);
        (0..plane.len()).filter(|i| !clipped[*i]).map(left).sum::<f64>() / plane.len() as f64
    });
    let each: Vec<f64> = sums.collect();
    let freedom = (planes.len() as f64 - 3.0) / planes.len() as f64;
    let square = each.iter().sum::<f64>() / each.len() as f64 - freedom * variance;
    let mean = maps[0].iter().copied().map(f64::from).sum::<f64>() / maps[0].len() as f64;
    let share = square.max(0.0).sqrt() / mean;
    let worst = (0..each.len()).max_by(|a, b| each[*a].total_cmp(&each[*b])).unwrap_or(0);
    if share > MALUS {
        return Err(CalibrateError::NotMalus { percent: 100.0 * share, allowed: 100.0 * MALUS, angle: angles[worst] });
    }
    Ok(share)
}

/// The unit of transmission: readings of light along the axis of a pixel in the middle of the frame and of a stripe.
fn unit(maps: &[Vec<f32>; 3], size: Size) -> f32 {
    let Size { width, height } = size;
    let (x0, y0) = (width * 3 / 8, height * 3 / 8);
    let middle = (y0..height - y0).flat_map(|y| (x0..width - x0).map(move |x| y * width + x));
    let parallel: Vec<f32> = middle.map(|i| maps[0][i] + maps[1][i].hypot(maps[2][i])).collect();
    // most pixels do not lie on an edge
    quantile(&parallel, 0.8, &mut Vec::new()).filter(|u| *u > 0.0).unwrap_or(1.0)
}

/// Angle, extinction and edges of every stripe, from column sums.
fn stripes(maps: &[Vec<f32>; 3], size: Size, layout: &Layout) -> Vec<MeasuredStripe> {
    let Size { width, .. } = size;
    let column = |map: &[f32], x: usize| map.iter().skip(x).step_by(width).copied().map(f64::from).sum::<f64>();
    let sums: Vec<[f64; 3]> = (0..width).map(|x| [0, 1, 2].map(|k| column(&maps[k], x))).collect();
    let border = |k: usize| (k * width).div_ceil(layout.stripes);
    // the middle of a stripe, that edges and a small shift of the mask leave alone
    let cores: Vec<[f64; 3]> = (0..layout.stripes)
        .map(|k| {
            let margin = (border(k + 1) - border(k)) / 3;
            let core = sums[border(k) + margin..border(k + 1) - margin].iter();
            let count = core.len() as f64;
            core.fold([0.0; 3], |sum, v| std::array::from_fn(|k| sum[k] + v[k] / count))
        })
        .collect();
    (0..layout.stripes)
        .map(|k| {
            let [m0, m1, m2] = cores[k];
            let nominal_deg = layout.angles[k % layout.angles.len()].degrees();
            let contrast = m1.hypot(m2) / m0;
            let edge = (k > 0 && width / layout.stripes >= 4).then(|| {
                let (a, b) = (cores[k - 1], cores[k]);
                let d = [b[1] - a[1], b[2] - a[2]];
                let square = (d[0] * d[0] + d[1] * d[1]).max(f64::MIN_POSITIVE);
                let middle = |k: usize| usize::midpoint(border(k), border(k + 1));
                let (from, to) = (middle(k - 1), middle(k));
                let share = |x: usize| ((sums[x][1] - a[1]) * d[0] + (sums[x][2] - a[2]) * d[1]) / square;
                let left = (from..to).map(|x| 1.0 - share(x)).sum::<f64>();
                // a Gaussian edge has ∫ t (1 − t) = σ / √π; the area of a pixel alone gives at most 1/6
                let overlap = (from..to).map(|x| share(x) * (1.0 - share(x))).sum::<f64>();
                let variance = std::f64::consts::PI * overlap.max(0.0).powi(2) - 1.0 / 12.0;
                (from as f64 + left, variance.max(0.0).sqrt())
            });
            MeasuredStripe {
                angle_deg: nominal_deg + angle_difference(0.5 * m2.atan2(m1).to_degrees(), nominal_deg),
                nominal_deg,
                extinction: if contrast < 1.0 { (1.0 + contrast) / (1.0 - contrast) } else { f64::INFINITY },
                left: edge.map(|e| e.0),
                blur: edge.map(|e| e.1),
            }
        })
        .collect()
}

impl MeasuredMask {
    /// Mean displacement of the edges from those of the layout, in pixels.
    pub fn shift(&self) -> Option<f64> {
        let (width, count) = (self.transmission.size().width, self.stripes.len());
        let edges =
            self.stripes.iter().enumerate().filter_map(|(k, s)| Some(s.left? - (k * width).div_ceil(count) as f64));
        mean(edges)
    }

    /// The quality of the mask.
    pub fn outcome(&self) -> Outcome {
        let turned = || self.stripes.iter().map(|s| s.angle_deg - s.nominal_deg);
        let extinction = median(&mut self.stripes.iter().map(|s| s.extinction as f32).collect::<Vec<_>>());
        let extinction = f64::from(extinction).min(1e6);
        let good = extinction >= GOOD_EXTINCTION;
        let end = if good { "good" } else { "poor" };
        let mut quality = BTreeMap::from([
            ("extinction", extinction),
            ("angle_error_rms_deg", rms(turned())),
            ("angle_error_mean_deg", mean(turned()).unwrap_or(0.0)),
            ("malus_residual", self.malus),
            ("exposure_spread", rms(self.exposures.iter().map(|e| e - 1.0))),
        ]);
        quality.extend(self.shift().map(|shift| ("edge_shift_px", shift)));
        quality.extend(mean(self.stripes.iter().filter_map(|s| s.blur)).map(|blur| ("edge_blur_px", blur)));
        let pixels = self
            .polarized
            .iter()
            .map(|e| aolp_color(0.5 * e.im.atan2(e.re).to_degrees(), 2.0 * e.norm(), AolpMode::Value));
        Outcome {
            step: STEP,
            good,
            verdict: format!(
                "Mask of {} stripes, extinction {extinction:.0} : 1, {:.2}° (rms) off their angles, Malus's law kept to {:.2} %: {end}.",
                self.stripes.len(),
                rms(turned()),
                100.0 * self.malus
            ),
            quality,
            remedy: (!good).then_some(Remedy::RemoveDiffuser),
            picture: Picture { size: self.transmission.size(), pixels: pixels.collect() },
            scale: Scale::Angle { title: "Polarizers of the mask", notes: &["contrast", "0: dark", "1: bright"] },
        }
    }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (count, sum) = values.fold((0usize, 0.0), |(count, sum), v| (count + 1, sum + v));
    (count > 0).then(|| sum / count as f64)
}
