//! `verify`: Malus's test of the whole device: light of known polarization, reconstructed.

use std::collections::BTreeMap;

use super::{CalibrateError, Outcome, View, average, check_shapes, distinct, list, pipeline, turn};
use crate::device::Device;
use crate::image::Picture;
use crate::image::Stack;
use crate::polarization::Angle;
use crate::polarization::color::{AolpMode, aolp, quantile};

const STEP: &str = "verify";
/// Of the brightest pixels (99 % quantile of S0), those above this share are the lamp's.
const LAMP: f32 = 0.6;
/// Brightest pixels below this share of full scale are no light.
const OFF: f32 = 0.01;
/// Views whose angles spread less than this share of what they should were not turned.
const TURNED: f64 = 0.2;
/// A good device: AoLP within so many degrees, DoLP of polarizer film at least so much.
const GOOD: (f64, f64) = (1.0, 0.95);

/// What was measured of one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// The polarizer's angle in degrees.
    pub set_deg: f64,
    /// The angle measured, within 90° of it.
    pub aolp_deg: f64,
    /// The degree of polarization measured.
    pub dolp: f64,
}

/// A test.
#[derive(Clone, Debug)]
pub struct Verified {
    /// One reading for each view.
    pub readings: Vec<Reading>,
    picture: Picture,
}

/// Reconstructs views of a lamp behind a polarizer, with the guide frames beside them where there are any.
///
/// # Errors
/// [`CalibrateError`]: too few angles, frames that do not fit, no light, a polarizer that was not turned.
pub fn measure(
    device: &Device,
    views: &[View],
    guides: &[Stack<f32>],
    threads: usize,
) -> Result<Verified, CalibrateError> {
    let angles: Vec<Angle> = views.iter().map(|(angle, _)| *angle).collect();
    let different = distinct(&angles);
    if different < 2 {
        return Err(CalibrateError::Angles { step: STEP, angles, distinct: different, needed: 2 });
    }
    let (channels, size) = (device.sensor.channels, device.sensor.size);
    let guided = guides.len() == views.len();
    let mut pipeline = pipeline(device, guided, threads, false)?;
    let mut readings = Vec::with_capacity(views.len());
    let mut pixels = vec![[0; 3]; size.pixels()];
    for (k, (angle, shots)) in views.iter().enumerate() {
        check_shapes(shots, Some((channels, size)), STEP)?;
        pipeline.process(
            average(&shots.frames).0.view().in_unit(shots.unit),
            guides.get(k).filter(|_| guided).map(Stack::view),
        )?;
        let result = pipeline.result();
        if result.angles.is_none() {
            return Err(CalibrateError::Before { step: STEP, what: "polarizer mask", first: "mask" });
        }
        let sum = |k: usize| {
            let mut plane = vec![0.0f32; size.pixels()];
            (0..channels).for_each(|c| plane.iter_mut().zip(result.stokes.plane(3 * c + k)).for_each(|(s, v)| *s += v));
            plane
        };
        let [s0, s1, s2] = [0, 1, 2].map(sum);
        let bright = quantile(&s0, 0.99, &mut Vec::new()).unwrap_or(0.0);
        if bright < OFF * channels as f32 {
            return Err(CalibrateError::LightsOff { step: STEP, signal: bright, angle: Some(*angle) });
        }
        let lamp: Vec<bool> = s0.iter().zip(&result.valid).map(|(v, valid)| *valid && *v > LAMP * bright).collect();
        let total =
            |plane: &[f32]| plane.iter().zip(&lamp).filter(|(_, l)| **l).map(|(v, _)| f64::from(*v)).sum::<f64>();
        let [t0, t1, t2] = [&s0, &s1, &s2].map(|plane| total(plane));
        let found = 0.5 * t2.atan2(t1).to_degrees();
        readings.push(Reading {
            set_deg: angle.degrees(),
            aolp_deg: angle.degrees() + turn(found, angle.degrees()),
            dolp: t1.hypot(t2) / t0.max(f64::MIN_POSITIVE),
        });
        aolp([&s0, &s1, &s2], &lamp, AolpMode::Value, &mut pixels);
    }
    // on the circle of doubled angles: how far apart the settings are, and how far the readings
    let spread = |of: &dyn Fn(&Reading) -> f64| {
        let mean = readings
            .iter()
            .map(|r| (2.0 * of(r)).to_radians().sin_cos())
            .fold((0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1));
        1.0 - mean.0.hypot(mean.1) / readings.len() as f64
    };
    let (set, found) = (spread(&|r| r.set_deg), spread(&|r| r.aolp_deg));
    if found < TURNED * set {
        return Err(CalibrateError::NotTurned {
            step: STEP,
            found: found / set,
            expected: "a spread of angles near 1",
        });
    }
    Ok(Verified { readings, picture: Picture { size, pixels } })
}

impl Verified {
    /// Measured minus set angle, the mean and the largest magnitude, in degrees.
    pub fn angle_errors(&self) -> (f64, f64) {
        let errors = || self.readings.iter().map(|r| r.aolp_deg - r.set_deg);
        (errors().sum::<f64>() / self.readings.len() as f64, errors().map(f64::abs).fold(0.0, f64::max))
    }

    /// What there is to say.
    pub fn outcome(&self) -> Outcome {
        let (offset, worst) = self.angle_errors();
        let dolp = self.readings.iter().map(|r| r.dolp).fold(f64::INFINITY, f64::min);
        let good = worst <= GOOD.0 && dolp >= GOOD.1;
        let end = match (worst <= GOOD.0, dolp >= GOOD.1) {
            (true, true) => "good",
            (false, _) if (worst - offset.abs()).abs() < GOOD.0 => {
                "poor: all are off alike, repeat mask with the same zero of the polarizer"
            }
            (false, _) => "poor: repeat mask and psf",
            (true, false) => "poor: repeat mask, its extinction is not known well",
        };
        let angles: Vec<Angle> = self.readings.iter().map(|r| Angle::from_degrees(r.set_deg)).collect();
        Outcome {
            step: STEP,
            good,
            verdict: format!(
                "Polarizer at {}: angles within {worst:.2}°, DoLP at least {dolp:.3}: {end}.",
                list(&angles)
            ),
            quality: BTreeMap::from([("aolp_error_deg", worst), ("aolp_offset_deg", offset), ("dolp", dolp)]),
            picture: self.picture.clone(),
        }
    }
}
