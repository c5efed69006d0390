//! L3: the steps that find out what a device is like, each a pure function from frames to a result with its quality.
//!
//! Frames are [`Shots`]: several of one unchanging scene, `[C, H, W]`, in counts or fractions of full scale. A step returns what a
//! bundle keeps of it, figures of quality, a picture and one sentence ([`Outcome`]); what went wrong is a [`CalibrateError`] that
//! says what to do. [`demo`] goes through all steps on simulated cameras.
//!
//! The usual order is dark, mask, psf, align, verify (and white for colour), each can be repeated by itself: `mask` and `psf` use
//! the dark frame, `psf` the mask it sees through, `align` and `verify` both.
//!
//! Allocation: every step allocates. Imports: [`crate::image`], [`crate::device`], [`crate::optics`], [`crate::guide`],
//! [`crate::output`] for the pictures, [`crate::pipeline`] for what is reconstructed, [`crate::camera`] for [`demo`].
//!
//! ```
//! use stokescope_core::calibrate::{CalibrateError, Shots, dark};
//! use stokescope_core::image::{Size, Stack};
//! use stokescope_core::readings::Unit;
//! let covered = Stack::<f32>::zeros(1, Size::new(16, 16));
//! let one = Shots { frames: vec![covered], unit: Unit::Counts };
//! assert!(matches!(dark::measure(&one, 12), Err(CalibrateError::FewFrames { found: 1, .. })));
//! ```

pub mod align;
pub mod dark;
pub mod mask;
mod phase;
pub mod psf;
pub mod verify;
pub mod white;

use std::collections::BTreeMap;

use serde::Serialize;

use crate::device::{Device, Sensor};
use crate::image::Picture;
use crate::image::{Size, Stack};
use crate::optics::{FftBackend, MaskError};
use crate::pipeline::{Pipeline, PlanError, ProcessError, Settings};
use crate::polarization::Angle;
use crate::polarization::color::{intensity_color, quantile};
use crate::readings::Unit;

/// Frames of one scene that does not change.
#[derive(Clone, Debug)]
pub struct Shots {
    /// The frames, `[C, H, W]` each.
    pub frames: Vec<Stack<f32>>,
    /// What their values mean.
    pub unit: Unit,
}

impl Shots {
    /// The mean of the frames. Allocates.
    ///
    /// # Panics
    /// Without frames.
    pub fn mean(&self) -> Stack<f32> {
        average(&self.frames).0
    }
}

/// Shots under polarized light, and the angle of it.
pub type View = (Angle, Shots);

/// What a step says.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Name of the step.
    pub step: &'static str,
    /// Whether the result is as good as it should be.
    pub good: bool,
    /// One sentence: how good it is and, where it is not good, what to do.
    pub verdict: String,
    /// Figures of quality by name.
    pub quality: BTreeMap<&'static str, f64>,
    /// What was found.
    #[serde(skip)]
    pub picture: Picture,
}

/// What went wrong with a step, and the remedy.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// Not enough frames to tell signal from noise.
    #[error("{step}: {found} frame(s), allowed: at least {needed}; take more with --frames or --from")]
    FewFrames {
        /// The step.
        step: &'static str,
        /// Frames there are.
        found: usize,
        /// Frames there should be.
        needed: usize,
    },
    /// Frames of different shapes, or of another shape than the bundle's sensor.
    #[error(
        "{step}: a frame has {found_channels} channel(s) of {found} pixels, expected {channels} of {size}; use one camera in one mode"
    )]
    Shape {
        /// The step.
        step: &'static str,
        /// Channels of the frame.
        found_channels: usize,
        /// Its size.
        found: Size,
        /// Expected channels.
        channels: usize,
        /// Expected size.
        size: Size,
    },
    /// An earlier step is missing.
    #[error("{step}: the bundle has no {what} yet; run `stokescope calibrate {first}` first")]
    Before {
        /// The step.
        step: &'static str,
        /// What is missing.
        what: &'static str,
        /// The step that makes it.
        first: &'static str,
    },
    /// Light where there should be none.
    #[error("dark: the frames show light ({percent:.1} % of full scale from place to place); cover the lens")]
    Lit {
        /// Spread of local means, in percent of full scale.
        percent: f64,
    },
    /// No light where there should be.
    #[error("{step}: no light ({signal:.4} of full scale{place}); switch the lamp on and uncover the lens", place = at(*.angle))]
    LightsOff {
        /// The step.
        step: &'static str,
        /// Signal found, fraction of full scale.
        signal: f32,
        /// Angle of the polarizer, where one is used.
        angle: Option<Angle>,
    },
    /// Clipped readings.
    #[error("{step}: {percent:.2} % of the readings are saturated{place}; expose shorter or dim the lamp", place = at(*.angle))]
    Saturated {
        /// The step.
        step: &'static str,
        /// Share of the readings, or of the PSF's support, in percent.
        percent: f64,
        /// Angle of the polarizer, where one is used.
        angle: Option<Angle>,
    },
    /// The point source drowns in noise.
    #[error(
        "psf: the point source is too weak, its peak is {snr:.1} times the noise, allowed: at least {needed}; expose longer, brighten the source or average more frames"
    )]
    Weak {
        /// Peak over noise.
        snr: f64,
        /// What it should be.
        needed: f64,
    },
    /// No single spot with dark around it.
    #[error(
        "psf: light fills {percent:.0} % of the frame, allowed: {allowed:.0} %; use one small source in a dark room"
    )]
    NoPoint {
        /// Support in percent of the frame.
        percent: f64,
        /// What is allowed.
        allowed: f64,
    },
    /// Something moved between frames.
    #[error("{step}: the image moved by {pixels:.2} pixels between frames; fix camera and target, and repeat")]
    Moved {
        /// The step.
        step: &'static str,
        /// How far.
        pixels: f64,
    },
    /// Too few different polarizer angles.
    #[error("{step}: polarizer at {angles}: {distinct} differ by 5° or more (modulo 180°), allowed: at least {needed}; turn it further", angles = list(.angles))]
    Angles {
        /// The step.
        step: &'static str,
        /// The angles given.
        angles: Vec<Angle>,
        /// How many of them differ.
        distinct: usize,
        /// How many should.
        needed: usize,
    },
    /// Readings that do not change with the polarizer.
    #[error(
        "{step}: the readings do not change with the polarizer's angle ({found:.3}, expected {expected}); turn the polarizer between views, and see that it is before the lamp"
    )]
    NotTurned {
        /// The step.
        step: &'static str,
        /// Modulation or spread of angles found.
        found: f64,
        /// What is expected.
        expected: &'static str,
    },
    /// Readings that no polarizer turned as said can give.
    #[error(
        "mask: the readings differ from Malus's law by {percent:.1} %, most at {angle}; the device moved, the lamp changed or that angle is wrong: repeat"
    )]
    NotMalus {
        /// Root mean square in percent of the mean reading.
        percent: f64,
        /// The view that differs most.
        angle: Angle,
    },
    /// The stripes are not those described.
    #[error(
        "mask: the stripes are {off:.0}° off what is described; give their layout with --stripes and --mask-angles, and the polarizer's zero with --zero"
    )]
    OtherMask {
        /// Root mean square of the differences, in degrees.
        off: f64,
    },
    /// Guide and raw frame do not match.
    #[error(
        "align: only {inliers} of {blocks} places of the guide match the reconstruction, allowed: at least half and {needed}; show both cameras the same well-lit printed target, and see that nothing moved since the psf step"
    )]
    OtherScene {
        /// Places that match.
        inliers: usize,
        /// Places with texture.
        blocks: usize,
        /// How many are needed.
        needed: usize,
    },
    /// A mask cannot be used.
    #[error("mask: {0}")]
    Mask(#[from] MaskError),
    /// A reconstruction cannot be planned.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// A frame cannot be reconstructed.
    #[error(transparent)]
    Process(#[from] ProcessError),
}

fn at(angle: Option<Angle>) -> String {
    angle.map_or_else(String::new, |angle| format!(" at {angle}"))
}

fn list(angles: &[Angle]) -> String {
    angles.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

/// The average of some shots, in fractions of full scale above the dark frame.
#[derive(Clone, Debug)]
struct Mean {
    /// `[C, H, W]`.
    signal: Stack<f32>,
    /// Readings that were saturated or no numbers in any frame, `C·H·W` of them.
    clipped: Vec<bool>,
    /// Noise of the average, σ.
    sigma: f32,
}

/// What turns readings into fractions of full scale.
#[derive(Clone, Debug)]
pub struct Levels {
    sensor: Sensor,
    dark: Option<Stack<f32>>,
}

impl Levels {
    /// The levels of a sensor and of its dark frame, which is in counts.
    pub fn new(sensor: Sensor, dark: Option<Stack<f32>>) -> Self {
        Self { sensor, dark }
    }

    /// One frame in fractions of full scale above the dark frame.
    fn normalize(&self, frame: &Stack<f32>, unit: Unit) -> Stack<f32> {
        let Sensor { black_level, saturation, .. } = self.sensor;
        let scale = if unit == Unit::Counts { 1.0 / (saturation - black_level) } else { 1.0 };
        let mut out = frame.clone();
        for (c, plane) in out.planes_mut().enumerate() {
            let dark = self.dark.as_ref().map(|dark| dark.plane(c.min(dark.count() - 1)));
            for (i, v) in plane.iter_mut().enumerate() {
                let counts = dark.map_or(black_level, |dark| dark[i]);
                let below =
                    if unit == Unit::Counts { counts } else { (counts - black_level) / (saturation - black_level) };
                *v = (*v - below) * scale;
            }
        }
        out
    }

    fn mean(&self, shots: &Shots, step: &'static str) -> Result<Mean, CalibrateError> {
        let Sensor { size, channels, saturation, .. } = self.sensor;
        check_shapes(shots, Some((channels, size)), step)?;
        let limit = if shots.unit == Unit::Counts { saturation } else { 1.0 };
        let (average, sigma) = average(&shots.frames);
        let span = if shots.unit == Unit::Counts { saturation - self.sensor.black_level } else { 1.0 };
        let mut clipped = vec![false; average.as_slice().len()];
        for frame in &shots.frames {
            clipped.iter_mut().zip(frame.as_slice()).for_each(|(c, v)| *c |= !(v.is_finite() && *v < limit));
        }
        let mut signal = self.normalize(&average, shots.unit);
        signal.as_mut_slice().iter_mut().zip(&clipped).filter(|(_, c)| **c).for_each(|(v, _)| *v = 0.0);
        Ok(Mean { signal, clipped, sigma: sigma / span / (shots.frames.len() as f32).sqrt() })
    }
}

fn check_shapes(shots: &Shots, expected: Option<(usize, Size)>, step: &'static str) -> Result<(), CalibrateError> {
    let first = shots.frames.first().ok_or(CalibrateError::FewFrames { step, found: 0, needed: 1 })?;
    let (channels, size) = expected.unwrap_or((first.count(), first.size()));
    match shots.frames.iter().find(|f| (f.count(), f.size()) != (channels, size)) {
        Some(other) => {
            let (found_channels, found) = (other.count(), other.size());
            Err(CalibrateError::Shape { step, found_channels, found, channels, size })
        }
        None => Ok(()),
    }
}

/// Mean of frames of one shape and the noise (σ) of one of them: from their spread; of a single frame from second differences
/// along its columns, where a blurred image is nearly linear.
fn average(frames: &[Stack<f32>]) -> (Stack<f32>, f32) {
    let mut mean = Stack::<f32>::zeros(frames[0].count(), frames[0].size());
    let share = 1.0 / frames.len() as f32;
    for frame in frames {
        mean.as_mut_slice().iter_mut().zip(frame.as_slice()).for_each(|(m, v)| *m += share * v);
    }
    let mut spread: Vec<f32> = if frames.len() > 1 {
        let square =
            |i: usize| frames.iter().map(|f: &Stack<f32>| (f.as_slice()[i] - mean.as_slice()[i]).powi(2)).sum::<f32>();
        // hot and clipped pixels are few: the median of the variances is that of the others
        (0..mean.as_slice().len()).map(|i| square(i) / (frames.len() - 1) as f32).collect()
    } else {
        let (v, w) = (mean.as_slice(), mean.size().width);
        (w..v.len().saturating_sub(w)).map(|i| (v[i - w] - 2.0 * v[i] + v[i + w]).powi(2) / 6.0).collect()
    };
    let median = median(&mut spread);
    // of a χ² distribution with k degrees of freedom, the median is about k (1 − 2/(9k))³
    let k = frames.len().max(2) as f32 - 1.0;
    (mean, (median / (1.0 - 2.0 / (9.0 * k)).powi(3)).max(0.0).sqrt())
}

/// The median, the upper one of two; 0 of nothing.
fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

/// The channels of an image averaged into one plane.
fn gray(image: &Stack<f32>) -> Vec<f32> {
    let mut out = vec![0.0; image.size().pixels()];
    for plane in image.planes() {
        out.iter_mut().zip(plane).for_each(|(o, v)| *o += v / image.count() as f32);
    }
    out
}

/// How many of `angles` differ from all before by 5° or more, modulo 180°.
fn distinct(angles: &[Angle]) -> usize {
    let apart = |a: &Angle, b: &Angle| turn(a.degrees(), b.degrees()).abs() >= 5.0;
    angles.iter().enumerate().filter(|(i, a)| angles[..*i].iter().all(|b| apart(a, b))).count()
}

/// The smallest turn from polarizer angle `from` to `to`, -90° to 90°.
pub fn turn(to: f64, from: f64) -> f64 {
    (to - from + 90.0).rem_euclid(180.0) - 90.0
}

/// A plane in gray, its 99.5 % quantile white.
fn picture(size: Size, plane: &[f32]) -> Picture {
    let white = quantile(plane, 0.995, &mut Vec::new()).filter(|w| *w > 0.0).unwrap_or(1.0);
    Picture { size, pixels: plane.iter().map(|v| intensity_color(v / white)).collect() }
}

/// A pipeline for one calibrated device with the settings of calibration: the guide stays where the bundle says.
fn pipeline(device: &Device, guide: bool, threads: usize, register: bool) -> Result<Pipeline, CalibrateError> {
    let settings = Settings {
        guided: guide,
        register,
        refit_psf: false,
        fft: FftBackend::Rustfft,
        threads,
        ..Settings::default()
    };
    Ok(Pipeline::new(device, settings)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_noise_of_many_frames_and_of_one_agree() {
        use rand::{Rng, SeedableRng, rngs::StdRng};
        let mut rng = StdRng::seed_from_u64(1);
        let size = Size::new(64, 48);
        let mut frame = || {
            let noise: Vec<f32> =
                (0..size.pixels()).map(|_| 5.0 * rng.sample::<f32, _>(rand_distr::StandardNormal)).collect();
            Stack::from_vec(1, size, noise).unwrap()
        };
        for count in [1, 2, 16] {
            let frames: Vec<_> = (0..count).map(|_| frame()).collect();
            let sigma = average(&frames).1;
            assert!((sigma - 5.0).abs() < 0.6, "{count} frames: {sigma}");
        }
    }

    #[test]
    fn angles_count_modulo_180_degrees() {
        let of = |list: &[f64]| distinct(&list.iter().copied().map(Angle::from_degrees).collect::<Vec<_>>());
        assert_eq!((of(&[0.0, 180.0, 90.0, 272.0]), of(&[0.0, 60.0, 120.0]), of(&[])), (2, 3, 0));
        assert_eq!((turn(179.0, 1.0), turn(1.0, 179.0)), (-2.0, 2.0));
    }
}
