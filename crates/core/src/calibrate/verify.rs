//! `verify`: Malus's test of the whole device, which reconstructs light of known polarization.

use std::collections::BTreeMap;

use super::error::list;
use super::{
    CalibrateError, Outcome, PolarizedShots, Remedy, Scale, Step, angle_difference, average, check_angles,
    check_shapes, pipeline,
};
use crate::device::Device;
use crate::image::{Picture, Stack};
use crate::polarization::Angle;
use crate::polarization::color::{AolpMode, aolp, quantile};

const STEP: Step = Step::Verify;
/// Pixels above this share of the 99 % quantile of S0 show the lamp.
const LAMP: f32 = 0.6;
/// A 99 % quantile of S0 below this share of full scale is no light.
const OFF: f32 = 0.01;
/// Measured angles that spread less than this share of the given ones come from a polarizer that was not turned.
const TURNED: f64 = 0.2;
/// Errors of the angles up to this many degrees have causes other than swapped views.
const ASTRAY: f64 = 5.0;
/// Swapped views, given in the other order, leave less than this share of the largest error.
const EXCHANGED: f64 = 0.2;
/// Largest error of the AoLP in degrees, and least DoLP of polarizer film, of a good device.
const GOOD: (f64, f64) = (1.0, 0.95);

/// The polarization measured in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// Angle of the polarizer in degrees, as given.
    pub set_deg: f64,
    /// Measured AoLP in degrees, within 90° of the given angle.
    pub aolp_deg: f64,
    /// Measured DoLP.
    pub dolp: f64,
}

/// The result of Malus's test.
#[derive(Clone, Debug)]
pub struct MalusTest {
    /// One reading for each view.
    pub readings: Vec<Reading>,
    picture: Picture,
}

/// Reconstructs views of a lamp behind a polarizer, each with its guide frame where `guides` has as many as there are views.
///
/// # Errors
/// [`CalibrateError`]: too few angles, frames that do not fit, no light, a polarizer that was not turned, two views that are swapped.
pub fn measure(
    device: &Device,
    views: &[PolarizedShots],
    guides: &[Stack<f32>],
    threads: usize,
) -> Result<MalusTest, CalibrateError> {
    check_angles(views, 2, STEP)?;
    let (channels, size) = (device.sensor.channels, device.sensor.size);
    let guided = guides.len() == views.len();
    let mut pipeline = pipeline(device, guided, threads)?;
    let mut readings = Vec::with_capacity(views.len());
    let mut pixels = vec![[0; 3]; size.pixels()];
    for (k, PolarizedShots { angle, shots }) in views.iter().enumerate() {
        check_shapes(shots, Some((channels, size)), STEP)?;
        let raw = average(&shots.frames).0;
        pipeline.process(raw.view().in_unit(shots.unit), guides.get(k).filter(|_| guided).map(Stack::view))?;
        let result = pipeline.result();
        if result.angles.is_none() {
            return Err(CalibrateError::MissingStep { step: STEP, first: Step::Mask });
        }
        let stokes = sum_channels(&result.stokes);
        let (reading, lamp) = read_lamp(&stokes, &result.valid, channels, *angle)?;
        readings.push(reading);
        let [s0, s1, s2] = &stokes;
        aolp([s0, s1, s2], &lamp, AolpMode::Value, 1.0, &mut pixels);
    }
    let (set, found) = (spread(readings.iter().map(|r| r.set_deg)), spread(readings.iter().map(|r| r.aolp_deg)));
    if found < TURNED * set {
        return Err(CalibrateError::NotTurned { step: STEP, found: found / set, needed: TURNED });
    }
    let test = MalusTest { readings, picture: Picture { size, pixels } };
    test.swapped().map_or(Ok(test), Err)
}

/// S0, S1 and S2, each summed over the channels of `[C, 3, H, W]`.
fn sum_channels(stokes: &Stack<f32>) -> [Vec<f32>; 3] {
    std::array::from_fn(|k| {
        let mut sum = vec![0.0f32; stokes.size().pixels()];
        for plane in stokes.planes().skip(k).step_by(3) {
            sum.iter_mut().zip(plane).for_each(|(s, v)| *s += v);
        }
        sum
    })
}

/// The polarization of the lamp, and the pixels that show it.
fn read_lamp(
    [s0, s1, s2]: &[Vec<f32>; 3],
    valid: &[bool],
    channels: usize,
    angle: Angle,
) -> Result<(Reading, Vec<bool>), CalibrateError> {
    let (signal, needed) = (quantile(s0, 0.99, &mut Vec::new()).unwrap_or(0.0), OFF * channels as f32);
    if signal < needed {
        return Err(CalibrateError::NoLight { step: STEP, signal, needed, angle: Some(angle) });
    }
    let lamp: Vec<bool> = s0.iter().zip(valid).map(|(v, valid)| *valid && *v > LAMP * signal).collect();
    let total = |plane: &[f32]| plane.iter().zip(&lamp).filter(|(_, l)| **l).map(|(v, _)| f64::from(*v)).sum::<f64>();
    let [t0, t1, t2] = [s0, s1, s2].map(|plane| total(plane));
    let (set_deg, found_deg) = (angle.degrees(), 0.5 * t2.atan2(t1).to_degrees());
    let aolp_deg = set_deg + angle_difference(found_deg, set_deg);
    Ok((Reading { set_deg, aolp_deg, dolp: t1.hypot(t2) / t0.max(f64::MIN_POSITIVE) }, lamp))
}

/// Circular variance of polarizer angles in degrees: 0 for equal ones, 1 for angles all around.
fn spread(degrees: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = degrees.len() as f64;
    let sum = degrees.map(|d| (2.0 * d).to_radians().sin_cos()).fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
    1.0 - sum.0.hypot(sum.1) / count
}

impl MalusTest {
    /// The error that two views were given for each other: their exchange leaves small errors, and no other zero of the polarizer does.
    fn swapped(&self) -> Option<CalibrateError> {
        let (offset, worst) = self.angle_errors();
        if worst <= ASTRAY || worst - offset.abs() < GOOD.0 {
            return None;
        }
        let count = self.readings.len();
        let exchanged = |i: usize, j: usize| {
            let set = |k: usize| {
                self.readings[if k == i {
                    j
                } else if k == j {
                    i
                } else {
                    k
                }]
                .set_deg
            };
            (0..count).map(|k| angle_difference(self.readings[k].aolp_deg, set(k)).abs()).fold(0.0, f64::max)
        };
        let pairs = (0..count).flat_map(|i| (i + 1..count).map(move |j| (i, j)));
        let (left, (i, j)) = pairs.map(|(i, j)| (exchanged(i, j), (i, j))).min_by(|a, b| a.0.total_cmp(&b.0))?;
        let angle = |k: usize| Angle::from_degrees(self.readings[k].set_deg);
        (left < worst * EXCHANGED).then(|| CalibrateError::Swapped {
            step: STEP,
            first: angle(i),
            second: angle(j),
            worst,
            left,
        })
    }

    /// Mean and largest magnitude of the measured minus the given angle, in degrees.
    pub fn angle_errors(&self) -> (f64, f64) {
        let errors = || self.readings.iter().map(|r| r.aolp_deg - r.set_deg);
        (errors().sum::<f64>() / self.readings.len() as f64, errors().map(f64::abs).fold(0.0, f64::max))
    }

    /// The quality of the device.
    pub fn outcome(&self) -> Outcome {
        let (offset, worst) = self.angle_errors();
        let dolp = self.readings.iter().map(|r| r.dolp).fold(f64::INFINITY, f64::min);
        let good = worst <= GOOD.0 && dolp >= GOOD.1;
        // errors that are alike come from the zero of the polarizer
        let alike = (worst - offset.abs()).abs() < GOOD.0;
        let remedy = match worst <= GOOD.0 {
            false if alike => Remedy::SameZero,
            _ => Remedy::Repeat(Step::Mask),
        };
        let angles: Vec<Angle> = self.readings.iter().map(|r| Angle::from_degrees(r.set_deg)).collect();
        Outcome {
            step: STEP,
            good,
            verdict: format!(
                "Polarizer at {}: angles within {worst:.2}°, DoLP at least {dolp:.3}: {}.",
                list(&angles),
                if good { "good" } else { "poor" }
            ),
            quality: BTreeMap::from([("aolp_error_deg", worst), ("aolp_offset_deg", offset), ("dolp", dolp)]),
            remedy: (!good).then_some(remedy),
            picture: self.picture.clone(),
            scale: Scale::Angle {
                title: "Angle of polarization of the lamp",
                notes: &["DoLP", "0: dark", "1: bright", "gray: no lamp"],
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Size;

    /// A test of views at `set` that show the light of polarizers at `found`.
    fn test(set: &[f64], found: &[f64]) -> MalusTest {
        let reading = |(&set_deg, &found): (&f64, &f64)| Reading {
            set_deg,
            aolp_deg: set_deg + angle_difference(found, set_deg),
            dolp: 0.98,
        };
        let picture = Picture { size: Size::new(1, 1), pixels: vec![[0; 3]] };
        MalusTest { readings: set.iter().zip(found).map(reading).collect(), picture }
    }

    #[test]
    fn swapped_views_are_named_and_other_errors_are_not_taken_for_them() {
        let said = |set: &[f64], found: &[f64]| test(set, found).swapped().map(|e| e.to_string());
        let four = [0.0, 45.0, 90.0, 135.0];
        let e = said(&four, &[0.2, 90.1, 45.3, 134.8]).unwrap();
        assert!(e.contains("at 45° and 90° seem to be swapped"), "{e}");
        assert!(said(&[0.0, 60.0, 120.0], &[120.0, 60.0, 0.0]).unwrap().contains("at 0° and 120°"));
        for found in
            [[0.2, 45.1, 89.8, 135.0], [20.0, 65.0, 110.0, 155.0], [90.0, 135.0, 0.0, 45.0], [8.0, 30.0, 99.0, 140.0]]
        {
            assert_eq!(said(&four, &found), None, "{found:?}");
        }
    }
}
