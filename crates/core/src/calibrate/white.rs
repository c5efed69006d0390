//! `white`: what a white surface reads, channel by channel.

use std::collections::BTreeMap;

use super::{CalibrateError, Levels, Outcome, Shots, gray, picture};
use crate::image::Picture;

/// Signal below this many σ, or this share of full scale, is no light.
const OFF: (f32, f32) = (10.0, 0.01);
/// Share of clipped readings that is allowed.
const CLIPPED: f64 = 1e-3;
/// Gains beyond this make noise of a channel.
const STRONG: f64 = 4.0;

/// A white balance.
#[derive(Clone, Debug)]
pub struct White {
    /// What the readings of each channel are multiplied by; the green one by 1, and that of a mono sensor.
    pub gains: [f64; 3],
    /// Channels of the sensor, 1 or 3.
    pub channels: usize,
    /// Mean signal, fraction of full scale.
    pub signal: f64,
    /// Darkest of the four corners against the middle.
    pub corner: f64,
    picture: Picture,
}

/// Averages frames of a white, unpolarized surface that fills the view.
///
/// # Errors
/// [`CalibrateError`]: frames that do not fit, no light, saturation.
pub fn measure(shots: &Shots, levels: &Levels) -> Result<White, CalibrateError> {
    let step = "white";
    let mean = levels.mean(shots, step)?;
    let clipped = mean.clipped.iter().filter(|c| **c).count() as f64 / mean.clipped.len() as f64;
    if clipped > CLIPPED {
        return Err(CalibrateError::Saturated { step, percent: 100.0 * clipped, angle: None });
    }
    let n = mean.signal.size().pixels() as f64;
    let each: Vec<f64> = mean.signal.planes().map(|p| p.iter().copied().map(f64::from).sum::<f64>() / n).collect();
    let least = each.iter().copied().fold(f64::INFINITY, f64::min) as f32;
    if least < OFF.1.max(OFF.0 * mean.sigma) {
        return Err(CalibrateError::LightsOff { step, signal: least, angle: None });
    }
    let gains = if each.len() == 3 { [each[1] / each[0], 1.0, each[1] / each[2]] } else { [1.0; 3] };
    let plane = gray(&mean.signal);
    let (w, h) = (mean.signal.size().width, mean.signal.size().height);
    // a quarter of the width holds every angle of a usual mask
    let (bw, bh) = ((w / 4).max(1), (h / 4).max(1));
    let block = |x: usize, y: usize| (0..bw * bh).map(|i| f64::from(plane[(y + i / bw) * w + x + i % bw])).sum::<f64>();
    let middle = block((w - bw) / 2, (h - bh) / 2).max(f64::MIN_POSITIVE);
    let corners = [(0, 0), (w - bw, 0), (0, h - bh), (w - bw, h - bh)].map(|(x, y)| block(x, y) / middle);
    Ok(White {
        gains,
        channels: each.len(),
        signal: each.iter().sum::<f64>() / each.len() as f64,
        corner: corners.into_iter().fold(f64::INFINITY, f64::min),
        picture: picture(mean.signal.size(), &plane),
    })
}

impl White {
    /// What there is to say.
    pub fn outcome(&self) -> Outcome {
        let good = self.gains.iter().all(|g| (1.0 / STRONG..STRONG).contains(g));
        let [red, _, blue] = self.gains;
        let verdict = match (self.channels, good) {
            (1, _) => {
                format!("A mono sensor needs no balance; its corners get {:.0} % of the light.", 100.0 * self.corner)
            }
            (_, true) => format!("White balance of red × {red:.3}, blue × {blue:.3}: good."),
            (_, false) => format!("White balance of red × {red:.3}, blue × {blue:.3}: poor, use white light."),
        };
        Outcome {
            step: "white",
            good,
            verdict,
            quality: BTreeMap::from([
                ("gain_red", red),
                ("gain_blue", blue),
                ("signal", self.signal),
                ("corner", self.corner),
            ]),
            picture: self.picture.clone(),
        }
    }
}
