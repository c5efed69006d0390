//! The steps that measure a device: each a pure function from frames to a result with figures of its quality.
//!
//! Frames come as [`Shots`]: several of one unchanging scene, `[C, H, W]`, in counts or fractions of full scale. A step returns the
//! measured quantity; its `outcome` gives figures of quality, a picture, a sentence and perhaps a [`Remedy`] ([`Outcome`]). A step that
//! fails returns a [`CalibrateError`], whose text states the facts and whose [`remedy`](CalibrateError::remedy) is what to do.
//!
//! The usual order is [`dark`], [`mask`], [`psf`], [`align`], [`verify`], and [`white`] for colour. Each can be repeated by itself. `mask`,
//! `psf` and `white` subtract the dark frame, `psf` divides by the mask, `align` and `verify` reconstruct with the whole [`Device`].
//!
//! Allocation: every step allocates.
//!
//! ```
//! use stokescope_core::calibrate::{CalibrateError, Remedy, Shots, dark};
//! use stokescope_core::image::{Size, Stack};
//! use stokescope_core::readings::Unit;
//! let covered = Stack::<f32>::zeros(1, Size::new(16, 16));
//! let one = Shots { frames: vec![covered], unit: Unit::Counts };
//! let error = dark::measure(&one, 12).unwrap_err();
//! assert_eq!(error.to_string(), "dark: 1 frame(s), allowed: at least 2");
//! assert_eq!(error.remedy(), Some(Remedy::MoreFrames));
//! ```

pub mod align;
pub mod dark;
mod error;
pub mod mask;
mod phase;
pub mod psf;
mod remedy;
pub mod verify;
pub mod white;

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::Serialize;

use crate::device::{Device, Sensor};
use crate::image::{Picture, Size, Stack};
use crate::optics::FftBackend;
use crate::pipeline::{Pipeline, Settings};
use crate::polarization::Angle;
use crate::polarization::color::{intensity_color, quantile};
use crate::readings::Unit;
use phase::Correlator;

pub use error::CalibrateError;
pub use remedy::{Remedy, Step};

/// Movement between the first and the last half of the frames that is allowed, in pixels.
const STILL: f64 = 0.3;

/// Several frames of one scene that does not change.
#[derive(Clone, Debug)]
pub struct Shots {
    /// The frames, `[C, H, W]` each.
    pub frames: Vec<Stack<f32>>,
    /// Unit of their values.
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

/// Frames of a lamp behind a polarizer.
#[derive(Clone, Debug)]
pub struct PolarizedShots {
    /// Angle of the polarizer against the sensor's rows.
    pub angle: Angle,
    /// The frames.
    pub shots: Shots,
}

/// The quality of a step's result.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// The step.
    pub step: Step,
    /// Whether the result is as good as it should be.
    pub good: bool,
    /// One sentence that says how good it is.
    pub verdict: String,
    /// Figures of quality by name.
    pub quality: BTreeMap<&'static str, f64>,
    /// The action that makes the result better, where it is not good.
    #[serde(skip)]
    pub remedy: Option<Remedy>,
    /// The result as an image.
    #[serde(skip)]
    pub picture: Picture,
    /// Meaning of the picture's colours.
    #[serde(skip)]
    pub scale: Scale,
}

/// Meaning of the colours of a step's picture, with its title.
#[derive(Clone, Debug, PartialEq)]
pub enum Scale {
    /// Gray from 0 to `white`, drawn with the curve of sRGB.
    Gray {
        /// Title of the picture.
        title: &'static str,
        /// Unit of the values.
        unit: &'static str,
        /// Value from which on pixels are white.
        white: f32,
    },
    /// Hue is the angle of a polarizer or of polarization; brightness is another quantity, from 0 to 1.
    Angle {
        /// Title of the picture.
        title: &'static str,
        /// Meaning of brightness and gray, in a few short lines.
        notes: &'static [&'static str],
    },
    /// Two images in green and magenta, which make gray where they agree.
    Overlay {
        /// Title of the picture.
        title: &'static str,
        /// Image in green.
        green: &'static str,
        /// Image in magenta.
        magenta: &'static str,
    },
}

impl Scale {
    /// Title of the picture.
    pub fn title(&self) -> &'static str {
        match self {
            Self::Gray { title, .. } | Self::Angle { title, .. } | Self::Overlay { title, .. } => title,
        }
    }
}

/// The average of some shots, in fractions of full scale above the dark frame.
struct Mean {
    /// `[C, H, W]`.
    signal: Stack<f32>,
    /// Readings that were saturated or no numbers in any frame, `C·H·W` of them.
    clipped: Vec<bool>,
    /// Noise of the average, σ.
    sigma: f32,
}

/// Black and white level of every pixel, which turn readings into fractions of full scale.
#[derive(Clone, Debug)]
pub struct Levels {
    sensor: Sensor,
    dark: Option<Arc<Stack<f32>>>,
}

impl Levels {
    /// The levels of a sensor, with its dark frame in counts where there is one.
    pub fn new(sensor: Sensor, dark: Option<Arc<Stack<f32>>>) -> Self {
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

    /// Averages shots of the sensor's shape.
    fn mean(&self, shots: &Shots, step: Step) -> Result<Mean, CalibrateError> {
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

/// Refuses shots without frames, and frames of another shape than `expected` (channels, size), or than the first.
fn check_shapes(shots: &Shots, expected: Option<(usize, Size)>, step: Step) -> Result<(), CalibrateError> {
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

/// Refuses frames whose last half shows the scene displaced against the first half. `flatten` averages some frames into one plane.
fn check_still(
    frames: &[Stack<f32>],
    step: Step,
    flatten: impl Fn(&[Stack<f32>]) -> Vec<f32>,
) -> Result<(), CalibrateError> {
    let count = frames.len();
    if count < 2 {
        return Ok(());
    }
    let (first, last) = (flatten(&frames[..count / 2]), flatten(&frames[count / 2..]));
    let [dx, dy] = Correlator::new(frames[0].size()).run(&first, &last).shift;
    let pixels = dx.hypot(dy);
    if pixels > STILL { Err(CalibrateError::Moved { step, pixels, allowed: STILL }) } else { Ok(()) }
}

/// The angles of `views`, at least `needed` of which differ.
fn check_angles(views: &[PolarizedShots], needed: usize, step: Step) -> Result<Vec<Angle>, CalibrateError> {
    let angles: Vec<Angle> = views.iter().map(|view| view.angle).collect();
    if let Some(&angle) = angles.iter().find(|angle| !angle.degrees().is_finite()) {
        return Err(CalibrateError::Angle { step, angle });
    }
    let distinct = distinct(&angles);
    if distinct < needed {
        return Err(CalibrateError::FewAngles { step, angles, distinct, needed });
    }
    Ok(angles)
}

/// Mean of frames of one shape, and the noise (σ) of one of them. The noise comes from their spread, or for a single frame from second
/// differences along its columns, where a blurred image is nearly linear.
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
    // the median of a χ² distribution with k degrees of freedom is about k (1 − 2/(9k))³
    let k = frames.len().max(2) as f32 - 1.0;
    (mean, (median / (1.0 - 2.0 / (9.0 * k)).powi(3)).max(0.0).sqrt())
}

/// The median; the upper one of two middle values, and 0 without values.
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
    let apart = |a: &Angle, b: &Angle| angle_difference(a.degrees(), b.degrees()).abs() >= 5.0;
    angles.iter().enumerate().filter(|(i, a)| angles[..*i].iter().all(|b| apart(a, b))).count()
}

/// Difference `a - b` of two polarizer angles in degrees, -90 to 90: polarizers 180° apart are the same.
pub fn angle_difference(a: f64, b: f64) -> f64 {
    (a - b + 90.0).rem_euclid(180.0) - 90.0
}

/// A gray picture of a plane, whose 99.5 % quantile is white, and its scale.
fn picture(size: Size, plane: &[f32], title: &'static str, unit: &'static str) -> (Picture, Scale) {
    let white = quantile(plane, 0.995, &mut Vec::new()).filter(|w| *w > 0.0).unwrap_or(1.0);
    let picture = Picture { size, pixels: plane.iter().map(|v| intensity_color(v / white)).collect() };
    (picture, Scale::Gray { title, unit, white })
}

/// A pipeline that takes the device as it is described: it neither registers the guide nor refits the PSF.
fn pipeline(device: &Device, guided: bool, threads: usize) -> Result<Pipeline, CalibrateError> {
    let settings = Settings {
        guided,
        register: false,
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
        assert_eq!((angle_difference(179.0, 1.0), angle_difference(1.0, 179.0)), (-2.0, 2.0));
    }
}
