//! `white`: gains of the colour channels, from a white surface.

use std::collections::BTreeMap;

use super::{CalibrateError, Levels, Outcome, Remedy, Scale, Shots, Step, gray, picture};
use crate::image::Picture;

const STEP: Step = Step::White;
/// Signal below this many σ, or this share of full scale, is no light.
const OFF: (f32, f32) = (10.0, 0.01);
/// Share of clipped readings that is allowed.
const CLIPPED: f64 = 1e-3;
/// A larger gain makes a channel too noisy.
const STRONG: f64 = 4.0;

/// A measured white balance.
#[derive(Clone, Debug)]
pub struct WhiteBalance {
    /// Factors of the readings in red, green and blue. Green has 1, and a mono sensor 1 throughout.
    pub gains: [f64; 3],
    /// Channels of the sensor, 1 or 3.
    pub channels: usize,
    /// Mean signal, fraction of full scale.
    pub signal: f64,
    /// Signal in the darkest of the four corners over that in the middle.
    pub corner: f64,
    picture: (Picture, Scale),
}

/// Averages frames of a white, unpolarized surface that fills the view.
///
/// # Errors
/// [`CalibrateError`]: frames that do not fit, no light, saturation.
pub fn measure(shots: &Shots, levels: &Levels) -> Result<WhiteBalance, CalibrateError> {
    let mean = levels.mean(shots, STEP)?;
    let clipped = mean.clipped.iter().filter(|c| **c).count() as f64 / mean.clipped.len() as f64;
    if clipped > CLIPPED {
        return Err(CalibrateError::Saturated {
            step: STEP,
            percent: 100.0 * clipped,
            allowed: 100.0 * CLIPPED,
            angle: None,
        });
    }
    let n = mean.signal.size().pixels() as f64;
    let each: Vec<f64> = mean.signal.planes().map(|p| p.iter().copied().map(f64::from).sum::<f64>() / n).collect();
    let least = each.iter().copied().fold(f64::INFINITY, f64::min) as f32;
    let needed = OFF.1.max(OFF.0 * mean.sigma);
    if least < needed {
        return Err(CalibrateError::NoLight { step: STEP, signal: least, needed, angle: None });
    }
    let gains = if each.len() == 3 { [each[1] / each[0], 1.0, each[1] / each[2]] } else { [1.0; 3] };
    let plane = gray(&mean.signal);
    let (w, h) = (mean.signal.size().width, mean.signal.size().height);
    // a quarter of the width holds every angle of a usual mask
    let (bw, bh) = ((w / 4).max(1), (h / 4).max(1));
    let block = |x: usize, y: usize| (0..bw * bh).map(|i| f64::from(plane[(y + i / bw) * w + x + i % bw])).sum::<f64>();
    let middle = block((w - bw) / 2, (h - bh) / 2).max(f64::MIN_POSITIVE);
    let corners = [(0, 0), (w - bw, 0), (0, h - bh), (w - bw, h - bh)].map(|(x, y)| block(x, y) / middle);
    Ok(WhiteBalance {
        gains,
        channels: each.len(),
        signal: each.iter().sum::<f64>() / each.len() as f64,
        corner: corners.into_iter().fold(f64::INFINITY, f64::min),
        picture: picture(mean.signal.size(), &plane, "White surface", "of full scale"),
    })
}

impl WhiteBalance {
    /// The quality of the white balance.
    pub fn outcome(&self) -> Outcome {
        let good = self.gains.iter().all(|g| (1.0 / STRONG..STRONG).contains(g));
        let [red, _, blue] = self.gains;
        let verdict = match (self.channels, good) {
            (1, _) => {
                format!("A mono sensor needs no balance; its corners get {:.0} % of the light.", 100.0 * self.corner)
            }
            (_, true) => format!("White balance of red × {red:.3}, blue × {blue:.3}: good."),
            (_, false) => format!("White balance of red × {red:.3}, blue × {blue:.3}: poor."),
        };
        let (picture, scale) = self.picture.clone();
        Outcome {
            step: STEP,
            good,
            verdict,
            quality: BTreeMap::from([
                ("gain_red", red),
                ("gain_blue", blue),
                ("signal", self.signal),
                ("corner", self.corner),
            ]),
            remedy: (!good).then_some(Remedy::WhiteLight),
            picture,
            scale,
        }
    }
}
