//! `psf`: what one point of the scene looks like on the sensor.

use std::collections::BTreeMap;

use super::{CalibrateError, Levels, Outcome, Shots, gray, median, phase::Correlator, picture};
use crate::image::{Size, Stack};
use crate::optics::Response;

const STEP: &str = "psf";
/// Light below this many σ of the average is none.
const OFF: f64 = 5.0;
/// Peak over noise that a usable, and a good PSF has.
const SNR: (f64, f64) = (20.0, 60.0);
/// Share of the support that may be clipped: hot pixels.
const CLIPPED: f64 = 0.002;
/// The support is where the mean over this many pixels a side …
const PATCH: usize = 7;
/// … is this many of its own σ above the background.
const ABOVE: f32 = 5.0;
/// Support larger than this share of the frame is no point source.
const FULL: f64 = 0.7;
/// Movement between the first and the last frames that is allowed, in pixels.
const STILL: f64 = 0.3;
/// Mask responses below this share of the median are too dark to see through.
const OPAQUE: f32 = 0.1;

/// A measured PSF.
#[derive(Clone, Debug)]
pub struct Point {
    /// `[C, H, W]`, sum 1 each, its centre of light (to the pixel) at half the size.
    pub planes: Stack<f32>,
    /// Where that centre was, in pixels.
    pub centre: [i64; 2],
    /// Peak over the noise of the average.
    pub snr: f64,
    /// Pixels of the support.
    pub support: usize,
    /// Whether light reaches the frame's border.
    pub cut: bool,
    /// Subtracted background, fraction of full scale.
    pub background: f64,
}

/// Averages frames of a point source, seen through `mask` if there is one.
///
/// # Errors
/// [`CalibrateError`]: frames that do not fit, no light, saturation, too weak a source, no point, movement.
pub fn measure(shots: &Shots, levels: &Levels, mask: Option<&Response>) -> Result<Point, CalibrateError> {
    let mean = levels.mean(shots, STEP)?;
    let (size, channels) = (mean.signal.size(), mean.signal.count());
    let n = size.pixels();
    let mut signal = mean.signal;
    let gain = mask.map(seen_through);
    for plane in signal.planes_mut() {
        if let Some(gain) = &gain {
            plane.iter_mut().zip(gain).for_each(|(v, g)| *v *= g);
        }
    }
    for (c, plane) in signal.planes_mut().enumerate() {
        let bad: Vec<bool> = (0..n).map(|i| mean.clipped[c * n + i]).collect();
        outliers(plane, &bad, size, mean.sigma);
    }
    let total = gray(&signal);
    let sigma = mean.sigma * gain.as_deref().map_or(1.0, |g| median(&mut g.to_vec())) / (channels as f32).sqrt();
    let (support, background) = support(&total, size, sigma);
    let peak = total.iter().zip(&support).filter(|(_, s)| **s).map(|(v, _)| v - background).fold(0.0, f32::max);
    let snr = f64::from(peak / sigma.max(1e-9));
    let count = support.iter().filter(|s| **s).count();
    if snr < OFF || count == 0 {
        let brightest = total.iter().copied().fold(0.0, f32::max);
        return Err(CalibrateError::LightsOff { step: STEP, signal: brightest, angle: None });
    }
    let clipped = (0..n).filter(|i| support[*i] && (0..channels).any(|c| mean.clipped[c * n + i])).count();
    let share = clipped as f64 / count as f64;
    if share > CLIPPED {
        return Err(CalibrateError::Saturated { step: STEP, percent: 100.0 * share, angle: None });
    }
    if snr < SNR.0 {
        return Err(CalibrateError::Weak { snr, needed: SNR.0 });
    }
    if count as f64 > FULL * n as f64 {
        return Err(CalibrateError::NoPoint { percent: 100.0 * count as f64 / n as f64, allowed: 100.0 * FULL });
    }
    still(shots, levels)?;

    let Size { width, height } = size;
    let light = |i: &usize| f64::from((total[*i] - background).max(0.0));
    let lit = || (0..n).filter(|i| support[*i]);
    let sum: f64 = lit().map(|i| light(&i)).sum();
    let centroid =
        |at: &dyn Fn(usize) -> usize| (lit().map(|i| at(i) as f64 * light(&i)).sum::<f64>() / sum).round() as i64;
    let centre = [centroid(&|i| i % width), centroid(&|i| i / width)];
    let (dx, dy) = ((width / 2) as i64 - centre[0], (height / 2) as i64 - centre[1]);
    let mut planes = Stack::zeros(channels, size);
    for c in 0..channels {
        let level = dark_level(signal.plane(c), &support);
        let out = planes.plane_mut(c);
        for i in lit() {
            let (x, y) = ((i % width) as i64 + dx, (i / width) as i64 + dy);
            if (0..width as i64).contains(&x) && (0..height as i64).contains(&y) {
                out[y as usize * width + x as usize] = (signal.plane(c)[i] - level).max(0.0);
            }
        }
        let sum: f64 = out.iter().copied().map(f64::from).sum();
        out.iter_mut().for_each(|v| *v = (f64::from(*v) / sum.max(f64::MIN_POSITIVE)) as f32);
    }
    let border = |i: &usize| [0, width - 1].contains(&(i % width)) || [0, height - 1].contains(&(i / width));
    Ok(Point { planes, centre, snr, support: count, cut: lit().any(|i| border(&i)), background: background.into() })
}

/// What undoes the mask's share of unpolarized light; 0 where it is too dark to see through.
fn seen_through(mask: &Response) -> Vec<f32> {
    let m0 = mask.unpolarized();
    let usual = median(&mut m0.to_vec());
    m0.iter().map(|m| if *m > OPAQUE * usual { 1.0 / m } else { 0.0 }).collect()
}

/// Replaces clipped pixels, and those that stand out from all their neighbours as no blurred light can, by the neighbours' median.
fn outliers(plane: &mut [f32], clipped: &[bool], Size { width, height }: Size, sigma: f32) {
    let original = plane.to_vec();
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let i = y * width + x;
            let around =
                [i - width - 1, i - width, i - width + 1, i - 1, i + 1, i + width - 1, i + width, i + width + 1];
            let mut near = around.map(|j| original[j]);
            let brightest = near.iter().copied().fold(0.0, f32::max);
            if clipped[i] || original[i] > 8.0 * brightest + 8.0 * sigma {
                plane[i] = median(&mut near);
            }
        }
    }
}

/// Where there is light, and the level of the background around it.
fn support(total: &[f32], size: Size, sigma: f32) -> (Vec<bool>, f32) {
    let Size { width, height } = size;
    let reach = PATCH / 2;
    let threshold = ABOVE * sigma / PATCH as f32;
    // the dimmest quarter of the frame is background in any case
    let mut background = quarter(total);
    let mut inside = vec![false; total.len()];
    for _ in 0..3 {
        for (i, lit) in inside.iter_mut().enumerate() {
            let (x, y) = (i % width, i / width);
            let rows = y.saturating_sub(reach)..(y + reach + 1).min(height);
            let columns = x.saturating_sub(reach)..(x + reach + 1).min(width);
            let count = (rows.len() * columns.len()) as f32;
            let sum: f32 = rows.map(|y| total[y * width..][columns.clone()].iter().sum::<f32>()).sum();
            *lit = sum / count - background > threshold;
        }
        background = dark_level(total, &inside);
    }
    (inside, background)
}

/// Mean of the dimmest quarter, a little low.
fn quarter(values: &[f32]) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    let dim = &sorted[..(sorted.len() / 4).max(1)];
    median(&mut dim.to_vec())
}

/// Median where there is no light.
fn dark_level(values: &[f32], support: &[bool]) -> f32 {
    median(&mut values.iter().zip(support).filter(|(_, s)| !**s).map(|(v, _)| *v).collect::<Vec<_>>())
}

/// Proves that the first and the last half of the frames show the same.
fn still(shots: &Shots, levels: &Levels) -> Result<(), CalibrateError> {
    let count = shots.frames.len();
    if count < 2 {
        return Ok(());
    }
    let half = |frames: &[Stack<f32>]| gray(&levels.normalize(&super::average(frames).0, shots.unit));
    let (first, last) = (half(&shots.frames[..count / 2]), half(&shots.frames[count / 2..]));
    let [dx, dy] = Correlator::new(levels.sensor.size).run(&first, &last).shift;
    let pixels = dx.hypot(dy);
    if pixels > STILL { Err(CalibrateError::Moved { step: STEP, pixels }) } else { Ok(()) }
}

impl Point {
    /// What there is to say.
    pub fn outcome(&self) -> Outcome {
        let size = self.planes.size();
        let share = 100.0 * self.support as f64 / size.pixels() as f64;
        let good = self.snr >= SNR.1 && !self.cut;
        let end = match (self.cut, good) {
            (true, _) => "poor: it reaches the frame's border, bring the source to the middle or use a larger frame",
            (_, false) => "usable: more light or more frames make it better",
            _ => "good",
        };
        Outcome {
            step: STEP,
            good,
            verdict: format!("PSF of {:.0} : 1 signal to noise on {share:.0} % of the frame: {end}.", self.snr),
            quality: BTreeMap::from([
                ("snr", self.snr),
                ("support_percent", share),
                ("background", self.background),
                ("centre_x", self.centre[0] as f64),
                ("centre_y", self.centre[1] as f64),
            ]),
            picture: picture(size, self.planes.plane(0)),
        }
    }
}
