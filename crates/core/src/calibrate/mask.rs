//! `mask`: what each pixel lets through of polarized light, and where the stripes are.
//!
//! Uniform light behind a polarizer at θ_j reads g_j · (m0 + m1 cos 2θ_j + m2 sin 2θ_j) at a pixel; the lamp's and the exposure's
//! g_j differ a little. With more than three angles they are found, too: what is no combination of 1, cos 2θ and sin 2θ must
//! vanish at every pixel once its readings are divided by g_j, so that the 1/g_j are the eigenvector of the smallest eigenvalue
//! of N ∘ Σ r rᵀ, with N the projection onto what no polarizer can read and r a pixel's readings.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, SymmetricEigen};

use super::{CalibrateError, Levels, Outcome, View, distinct, gray, median, turn};
use crate::image::Picture;
use crate::image::{Complex32, Size, Stack};
use crate::optics::Response;
use crate::polarization::Angle;
use crate::polarization::color::{AolpMode, aolp_color, quantile};

const STEP: &str = "mask";
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
/// Stripes this far off their description (rms, degrees) are others.
const OTHER: f64 = 20.0;
/// Good stripes: angle errors (rms, degrees) do not matter, they are known; these do.
const GOOD_EXTINCTION: f64 = 5.0;

/// What the mask should look like.
#[derive(Clone, Debug)]
pub struct Layout {
    /// Angles in stripe order.
    pub angles: Vec<Angle>,
    /// Vertical stripes over the width.
    pub stripes: usize,
}

/// One stripe as it was found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Found {
    /// Its angle in degrees, near the described one.
    pub angle_deg: f64,
    /// The described one.
    pub nominal_deg: f64,
    /// Transmission parallel : crossed.
    pub extinction: f64,
    /// Its left edge in pixels from the left; none for the first, and where stripes are too narrow to tell.
    pub left: Option<f64>,
    /// Width (σ) of that edge in pixels.
    pub blur: Option<f64>,
}

/// A measured mask.
#[derive(Clone, Debug)]
pub struct Mask {
    /// Readings under unit light polarized at each described angle, `[P, H, W]`.
    pub transmission: Stack<f32>,
    /// The described angles.
    pub angles: Vec<Angle>,
    /// The stripes.
    pub stripes: Vec<Found>,
    /// Exposure of each view against their mean.
    pub exposures: Vec<f64>,
    /// Root mean square departure from Malus's law, a share of the mean reading.
    pub malus: f64,
    polarized: Vec<Complex32>,
}

/// Measures the mask from views of uniform light behind a polarizer. Angles are against the sensor's rows.
///
/// # Errors
/// [`CalibrateError`]: too few angles, frames that do not fit, no light, saturation, a polarizer that was not turned, readings
/// that no polarizer gives, stripes that are not those described.
pub fn measure(views: &[View], levels: &Levels, layout: &Layout) -> Result<Mask, CalibrateError> {
    let angles: Vec<Angle> = views.iter().map(|(angle, _)| *angle).collect();
    let different = distinct(&angles);
    if different < 3 {
        return Err(CalibrateError::Angles { step: STEP, angles, distinct: different, needed: 3 });
    }
    let size = levels.sensor.size;
    let n = size.pixels();
    let mut readings = Vec::with_capacity(views.len());
    let (mut clipped, mut variance) = (vec![false; n], 0.0);
    for (angle, shots) in views {
        let mean = levels.mean(shots, STEP)?;
        let share = mean.clipped.iter().filter(|c| **c).count() as f64 / mean.clipped.len() as f64;
        if share > CLIPPED {
            return Err(CalibrateError::Saturated { step: STEP, percent: 100.0 * share, angle: Some(*angle) });
        }
        let plane = gray(&mean.signal);
        let signal = plane.iter().sum::<f32>() / n as f32;
        if signal < OFF.1.max(OFF.0 * mean.sigma) {
            return Err(CalibrateError::LightsOff { step: STEP, signal, angle: Some(*angle) });
        }
        clipped
            .iter_mut()
            .enumerate()
            .for_each(|(i, c)| *c |= (0..mean.signal.count()).any(|k| mean.clipped[k * n + i]));
        variance += f64::from(mean.sigma * mean.sigma) / (mean.signal.count() * views.len()) as f64;
        readings.push(plane);
    }
    let design = DMatrix::from_fn(views.len(), 3, |j, k| [1.0, angles[j].cos2(), angles[j].sin2()][k]);
    // with ε > 0 the pseudo-inverse exists for every matrix
    let fit = design.clone().pseudo_inverse(1e-9).unwrap_or_else(|_| DMatrix::zeros(3, views.len()));
    let unreadable = DMatrix::identity(views.len(), views.len()) - &design * &fit;
    let exposures = exposures(&readings, &clipped, &unreadable, variance);
    for (plane, exposure) in readings.iter_mut().zip(&exposures) {
        plane.iter_mut().for_each(|v| *v /= *exposure as f32);
    }
    let mut maps = [vec![0.0f32; n], vec![0.0; n], vec![0.0; n]];
    for (k, map) in maps.iter_mut().enumerate() {
        for (j, plane) in readings.iter().enumerate() {
            map.iter_mut().zip(plane).for_each(|(m, r)| *m += fit[(k, j)] as f32 * r);
        }
        mend(map, &clipped, size.width);
    }
    let modulation = |i: usize| maps[1][i].hypot(maps[2][i]) / maps[0][i].max(f32::MIN_POSITIVE);
    let found = f64::from(median(&mut (0..n).map(modulation).collect::<Vec<_>>()));
    if found < MODULATION {
        return Err(CalibrateError::NotTurned { step: STEP, found, expected: "a modulation above 0.1" });
    }
    let malus = departure(&readings, &maps, &clipped, &angles, variance)?;
    let unit = unit(&maps, size);
    maps.iter_mut().flatten().for_each(|v| *v /= unit);
    let stripes = stripes(&maps, size, layout);
    let off = rms(stripes.iter().map(|s| s.angle_deg - s.nominal_deg));
    if off > OTHER {
        return Err(CalibrateError::OtherMask { off });
    }
    let mut transmission = Stack::zeros(layout.angles.len(), size);
    for (plane, angle) in transmission.planes_mut().zip(&layout.angles) {
        let (c, s) = (angle.cos2() as f32, angle.sin2() as f32);
        plane.iter_mut().enumerate().for_each(|(i, t)| *t = (maps[0][i] + c * maps[1][i] + s * maps[2][i]).max(0.0));
    }
    // what the bundle will make of it
    let response = Response::measured(size, layout.angles.clone(), &transmission)?;
    let polarized = response.polarized().to_vec();
    Ok(Mask { transmission, angles: layout.angles.clone(), stripes, exposures, malus, polarized })
}

fn rms(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1) as f64;
    (values.map(|v| v * v).sum::<f64>() / count).sqrt()
}

/// Exposure of each view against their mean; all 1 where the views do not tell.
fn exposures(readings: &[Vec<f32>], clipped: &[bool], unreadable: &DMatrix<f64>, variance: f64) -> Vec<f64> {
    let count = readings.len();
    let equal = vec![1.0; count];
    if count < 4 {
        return equal;
    }
    let mut moments = DMatrix::<f64>::zeros(count, count);
    for i in (0..clipped.len()).filter(|i| !clipped[*i]) {
        for j in 0..count {
            for k in 0..=j {
                moments[(j, k)] += f64::from(readings[j][i]) * f64::from(readings[k][i]);
            }
        }
    }
    moments.fill_upper_triangle_with_lower_triangle();
    (0..count).for_each(|j| moments[(j, j)] -= variance * clipped.len() as f64);
    let eigen = SymmetricEigen::new(moments.component_mul(unreadable));
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

/// Replaces what was clipped by the nearest reading of its column.
fn mend(map: &mut [f32], clipped: &[bool], width: usize) {
    let rows = map.len() / width;
    for i in (0..map.len()).filter(|i| clipped[*i]) {
        let (x, y) = (i % width, i / width);
        let near = (1..rows).flat_map(|d| [y.checked_sub(d), (y + d < rows).then_some(y + d)]).flatten();
        map[i] = near.map(|y| y * width + x).find(|j| !clipped[*j]).map_or(0.0, |j| map[j]);
    }
}

/// Root mean square of what the maps leave of the readings beyond noise, as a share of the mean reading.
fn departure(
    readings: &[Vec<f32>],
    maps: &[Vec<f32>; 3],
    clipped: &[bool],
    angles: &[Angle],
    variance: f64,
) -> Result<f64, CalibrateError> {
    let sums = readings.iter().zip(angles).map(|(plane, angle)| {
        let (c, s) = (angle.cos2() as f32, angle.sin2() as f32);
        let left = |i: usize| f64::from(plane[i] - maps[0][i] - c * maps[1][i] - s * maps[2][i]).powi(2);
        (0..plane.len()).filter(|i| !clipped[*i]).map(left).sum::<f64>() / plane.len() as f64
    });
    let each: Vec<f64> = sums.collect();
    let freedom = (readings.len() as f64 - 3.0) / readings.len() as f64;
    let square = each.iter().sum::<f64>() / each.len() as f64 - freedom * variance;
    let mean = maps[0].iter().copied().map(f64::from).sum::<f64>() / maps[0].len() as f64;
    let share = square.max(0.0).sqrt() / mean;
    let worst = (0..each.len()).max_by(|a, b| each[*a].total_cmp(&each[*b])).unwrap_or(0);
    if share > MALUS {
        return Err(CalibrateError::NotMalus { percent: 100.0 * share, angle: angles[worst] });
    }
    Ok(share)
}

/// What a pixel in the middle of the frame and of a stripe lets through of light along its axis: the unit of transmission.
fn unit(maps: &[Vec<f32>; 3], size: Size) -> f32 {
    let Size { width, height } = size;
    let (x0, y0) = (width * 3 / 8, height * 3 / 8);
    let middle = (y0..height - y0).flat_map(|y| (x0..width - x0).map(move |x| y * width + x));
    let parallel: Vec<f32> = middle.map(|i| maps[0][i] + maps[1][i].hypot(maps[2][i])).collect();
    // most pixels do not lie on an edge
    quantile(&parallel, 0.8, &mut Vec::new()).filter(|u| *u > 0.0).unwrap_or(1.0)
}

/// Angle, extinction and edges of every stripe, from column sums.
fn stripes(maps: &[Vec<f32>; 3], size: Size, layout: &Layout) -> Vec<Found> {
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
                // of a Gaussian edge ∫ t (1 − t) = σ / √π; a pixel's area alone gives 1/6 at the most
                let overlap = (from..to).map(|x| share(x) * (1.0 - share(x))).sum::<f64>();
                let variance = std::f64::consts::PI * overlap.max(0.0).powi(2) - 1.0 / 12.0;
                (from as f64 + left, variance.max(0.0).sqrt())
            });
            Found {
                angle_deg: nominal_deg + turn(0.5 * m2.atan2(m1).to_degrees(), nominal_deg),
                nominal_deg,
                extinction: if contrast < 1.0 { (1.0 + contrast) / (1.0 - contrast) } else { f64::INFINITY },
                left: edge.map(|e| e.0),
                blur: edge.map(|e| e.1),
            }
        })
        .collect()
}

impl Mask {
    /// Shift of the edges against their description, in pixels: its mean.
    pub fn shift(&self) -> Option<f64> {
        let (width, count) = (self.transmission.size().width, self.stripes.len());
        let edges =
            self.stripes.iter().enumerate().filter_map(|(k, s)| Some(s.left? - (k * width).div_ceil(count) as f64));
        mean(edges)
    }

    /// What there is to say.
    pub fn outcome(&self) -> Outcome {
        let turned = || self.stripes.iter().map(|s| s.angle_deg - s.nominal_deg);
        let extinction = median(&mut self.stripes.iter().map(|s| s.extinction as f32).collect::<Vec<_>>());
        let extinction = f64::from(extinction).min(1e6);
        let good = extinction >= GOOD_EXTINCTION;
        let end = if good { "good" } else { "poor: is the diffuser off and the light behind the polarizer alone?" };
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
            picture: Picture { size: self.transmission.size(), pixels: pixels.collect() },
        }
    }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (count, sum) = values.fold((0usize, 0.0), |(count, sum), v| (count + 1, sum + v));
    (count > 0).then(|| sum / count as f64)
}
