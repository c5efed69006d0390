//! `dark`: readings of the sensor without light.

use std::collections::BTreeMap;

use super::{CalibrateError, Outcome, Remedy, Shots, Step, average, check_shapes, median, picture};
use crate::image::{Size, Stack};
use crate::readings::Unit;

const STEP: Step = Step::Dark;
/// Local medians that spread by more than this share of full scale are an image.
const LIT: f64 = 0.01;
/// A median above this share of full scale is light.
const BRIGHT: f32 = 0.5;
/// Side of the places whose medians are compared, in pixels.
const PLACE: usize = 8;
/// A hot pixel is above the median by this share of full scale and this many σ of the average.
const HOT: (f32, f32) = (0.005, 8.0);
/// Frames below which read noise is a guess.
const FEW: usize = 2;
/// More read noise than this share of full scale, or more hot pixels than that share, is no good sensor.
const POOR: (f32, f32) = (0.02, 0.01);

/// A measured dark frame.
#[derive(Clone, Debug)]
pub struct DarkFrame {
    /// The average of the frames, counts, `[C, H, W]`.
    pub mean: Stack<f32>,
    /// Median of the average, counts.
    pub black_level: f32,
    /// Reading of a full pixel, counts.
    pub saturation: f32,
    /// Read noise (σ) of one frame, fraction of full scale.
    pub read_noise: f32,
    /// Number of hot pixels.
    pub hot: usize,
    /// Significant bits of a count.
    pub bits: u32,
}

/// Averages frames of the covered sensor, whose counts have `bits` significant bits.
///
/// # Errors
/// [`CalibrateError`]: fewer than two frames, frames that differ in shape, light.
pub fn measure(shots: &Shots, bits: u32) -> Result<DarkFrame, CalibrateError> {
    measure_to(shots, bits, f32::INFINITY)
}

/// Like [`measure`], for a sensor whose full reading has `white` counts: left-aligned samples of 12 bits are full at 65520.
///
/// # Errors
/// Those of [`measure`].
pub fn measure_to(shots: &Shots, bits: u32, white: f32) -> Result<DarkFrame, CalibrateError> {
    check_shapes(shots, None, STEP)?;
    if shots.frames.len() < FEW {
        return Err(CalibrateError::FewFrames { step: STEP, found: shots.frames.len(), needed: FEW });
    }
    let full = (((1u32 << bits.clamp(1, 16)) - 1) as f32).min(white);
    let (mut mean, mut sigma) = average(&shots.frames);
    if shots.unit == Unit::FullScale {
        mean.as_mut_slice().iter_mut().for_each(|v| *v *= full);
        sigma *= full;
    }
    let black_level = median(&mut mean.as_slice().to_vec()).clamp(0.0, full - 1.0);
    let span = full - black_level;
    let spread = f64::from(unevenness(&mean) / span);
    if spread > LIT {
        return Err(CalibrateError::NotDark { percent: 100.0 * spread, allowed: 100.0 * LIT });
    }
    if black_level > BRIGHT * full {
        let percent = 100.0 * f64::from(black_level / full);
        return Err(CalibrateError::NotDark { percent, allowed: 100.0 * f64::from(BRIGHT) });
    }
    let limit = (HOT.0 * span).max(HOT.1 * sigma / (shots.frames.len() as f32).sqrt());
    let hot = mean.as_slice().iter().filter(|v| **v - black_level > limit).count();
    // a pixel that is saturated in the dark counts as saturated in every frame; any dark value below full scale serves it
    mean.as_mut_slice().iter_mut().for_each(|v| *v = if v.is_finite() { v.min(full - 1.0) } else { full - 1.0 });
    Ok(DarkFrame { mean, black_level, saturation: full, read_noise: sigma / span, hot, bits })
}

/// Spread of the medians of small places, which noise and hot pixels hardly change.
fn unevenness(mean: &Stack<f32>) -> f32 {
    let Size { width, height } = mean.size();
    let mut spread = 0.0f32;
    for plane in mean.planes() {
        let mut places = Vec::new();
        for y in (0..height.saturating_sub(PLACE - 1)).step_by(PLACE) {
            for x in (0..width.saturating_sub(PLACE - 1)).step_by(PLACE) {
                let place = (0..PLACE * PLACE).map(|i| plane[(y + i / PLACE) * width + x + i % PLACE]);
                places.push(median(&mut place.collect::<Vec<_>>()));
            }
        }
        places.sort_by(f32::total_cmp);
        if let (Some(low), Some(high)) = (places.get(places.len() / 20), places.get(places.len() * 19 / 20)) {
            spread = spread.max(high - low);
        }
    }
    spread
}

impl DarkFrame {
    /// The quality of the dark frame.
    pub fn outcome(&self) -> Outcome {
        let pixels = self.mean.as_slice().len();
        let good = self.read_noise < POOR.0 && (self.hot as f32) < POOR.1 * pixels as f32;
        let above: Vec<f32> = self.mean.plane(0).iter().map(|v| (v - self.black_level).max(0.0)).collect();
        let (picture, scale) = picture(self.mean.size(), &above, "Dark frame, above the black level", "counts");
        Outcome {
            step: STEP,
            good,
            verdict: format!(
                "Dark frame of black level {:.1} counts, read noise {:.4} of full scale, {} hot pixel(s): {}.",
                self.black_level,
                self.read_noise,
                self.hot,
                if good { "good" } else { "poor" }
            ),
            quality: BTreeMap::from([
                ("black_level", f64::from(self.black_level)),
                ("read_noise", f64::from(self.read_noise)),
                ("hot_pixels", self.hot as f64),
            ]),
            remedy: (!good).then_some(Remedy::CoolSensor),
            picture,
            scale,
        }
    }
}
