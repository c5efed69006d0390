//! `psf`: the point spread function, the image of one scene point on the sensor.

use std::collections::BTreeMap;

use super::{CalibrateError, Levels, Mean, Outcome, Remedy, Shots, Step, average, check_still, gray, median, picture};
use crate::image::{Size, Stack};
use crate::optics::Response;

const STEP: Step = Step::Psf;
/// Light below this many σ of the average is none.
const OFF: f64 = 5.0;
/// Least peak over noise of a usable and of a good PSF.
const SNR: (f64, f64) = (20.0, 60.0);
/// Share of the support that may be clipped: hot pixels.
const CLIPPED: f64 = 0.002;
/// The support is where the mean over this many pixels a side …
const PATCH: usize = 7;
/// … is this many of its own σ above the background.
const ABOVE: f32 = 5.0;
/// Support larger than this share of the frame is no point source.
const FULL: f64 = 0.7;
/// Mask responses below this share of the median are too dark to see through.
const OPAQUE: f32 = 0.1;

/// A measured point spread function.
#[derive(Clone, Debug)]
pub struct MeasuredPsf {
    /// The PSF, `[C, H, W]`, sum 1 in each channel. Its centre of light lies, to the pixel, at half the size.
    pub planes: Stack<f32>,
    /// Place of the centre of light on the sensor: column, row.
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
pub fn measure(shots: &Shots, levels: &Levels, mask: Option<&Response>) -> Result<MeasuredPsf, CalibrateError> {
    let Mean { mut signal, clipped, mut sigma } = levels.mean(shots, STEP)?;
    let (size, channels) = (signal.size(), signal.count());
    let gain = mask.map(inverse_mask);
    if let Some(gain) = &gain {
        signal.planes_mut().for_each(|plane| plane.iter_mut().zip(gain).for_each(|(v, g)| *v *= g));
    }
    for (plane, clipped) in signal.planes_mut().zip(clipped.chunks_exact(size.pixels())) {
        replace_outliers(plane, clipped, size, sigma);
    }
    let total = gray(&signal);
    sigma = sigma * gain.as_deref().map_or(1.0, |g| median(&mut g.to_vec())) / (channels as f32).sqrt();
    let (support, background) = support(&total, size, sigma);
    let lit: Vec<usize> = (0..size.pixels()).filter(|i| support[*i]).collect();
    let snr = check_light(&total, background, &lit, sigma)?;
    check_spot(&clipped, size, &lit, snr)?;
    check_still(&shots.frames, STEP, |frames| gray(&levels.normalize(&average(frames).0, shots.unit)))?;

    let Size { width, height } = size;
    let centre = centre_of_light(&total, background, &lit, width);
    let (dx, dy) = ((width / 2) as i64 - centre[0], (height / 2) as i64 - centre[1]);
    let mut planes = Stack::zeros(channels, size);
    for (out, plane) in planes.planes_mut().zip(signal.planes()) {
        let level = dark_level(plane, &support);
        for &i in &lit {
            let (x, y) = ((i % width) as i64 + dx, (i / width) as i64 + dy);
            if (0..width as i64).contains(&x) && (0..height as i64).contains(&y) {
                out[y as usize * width + x as usize] = (plane[i] - level).max(0.0);
            }
        }
        let sum: f64 = out.iter().copied().map(f64::from).sum();
        out.iter_mut().for_each(|v| *v = (f64::from(*v) / sum.max(f64::MIN_POSITIVE)) as f32);
    }
    let border = |i: &usize| [0, width - 1].contains(&(i % width)) || [0, height - 1].contains(&(i / width));
    let cut = lit.iter().any(border);
    Ok(MeasuredPsf { planes, centre, snr, support: lit.len(), cut, background: background.into() })
}

/// The peak over the noise `sigma`, unless there is no light.
fn check_light(total: &[f32], background: f32, lit: &[usize], sigma: f32) -> Result<f64, CalibrateError> {
    let peak = lit.iter().map(|i| total[*i] - background).fold(0.0, f32::max);
    let snr = f64::from(peak / sigma.max(1e-9));
    if snr < OFF || lit.is_empty() {
        return Err(CalibrateError::NoLight { step: STEP, signal: peak, needed: OFF as f32 * sigma, angle: None });
    }
    Ok(snr)
}

/// Refuses a support with saturated readings, too weak a source, and light all over the frame.
fn check_spot(clipped: &[bool], size: Size, lit: &[usize], snr: f64) -> Result<(), CalibrateError> {
    let n = size.pixels();
    let saturated = lit.iter().filter(|i| clipped[**i..].iter().step_by(n).any(|c| *c)).count();
    let share = saturated as f64 / lit.len() as f64;
    if share > CLIPPED {
        let (percent, allowed) = (100.0 * share, 100.0 * CLIPPED);
        return Err(CalibrateError::Saturated { step: STEP, percent, allowed, angle: None });
    }
    if snr < SNR.0 {
        return Err(CalibrateError::WeakSource { snr, needed: SNR.0 });
    }
    let fill = lit.len() as f64 / n as f64;
    if fill > FULL {
        return Err(CalibrateError::NotAPoint { percent: 100.0 * fill, allowed: 100.0 * FULL });
    }
    Ok(())
}

/// Column and row of the centre of light above the background, to the pixel.
fn centre_of_light(total: &[f32], background: f32, lit: &[usize], width: usize) -> [i64; 2] {
    let light = |i: &usize| f64::from((total[*i] - background).max(0.0));
    let sum: f64 = lit.iter().map(light).sum();
    let mean =
        |at: &dyn Fn(usize) -> usize| (lit.iter().map(|i| at(*i) as f64 * light(i)).sum::<f64>() / sum).round() as i64;
    [mean(&|i| i % width), mean(&|i| i / width)]
}

/// Factors that undo the mask's transmission of unpolarized light; 0 where the mask is opaque.
fn inverse_mask(mask: &Response) -> Vec<f32> {
    let m0 = mask.unpolarized();
    let usual = median(&mut m0.to_vec());
    m0.iter().map(|m| if *m > OPAQUE * usual { 1.0 / m } else { 0.0 }).collect()
}

/// Replaces clipped pixels, and pixels much brighter than all their neighbours, by the neighbours' median.
fn replace_outliers(plane: &mut [f32], clipped: &[bool], Size { width, height }: Size, sigma: f32) {
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

/// The pixels with light, and the level of the background around them.
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

/// Median of the dimmest quarter: a background level that is a little low.
fn quarter(values: &[f32]) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    let dim = &sorted[..(sorted.len() / 4).max(1)];
    median(&mut dim.to_vec())
}

/// Median of the pixels without light.
fn dark_level(values: &[f32], support: &[bool]) -> f32 {
    median(&mut values.iter().zip(support).filter(|(_, s)| !**s).map(|(v, _)| *v).collect::<Vec<_>>())
}

impl MeasuredPsf {
    /// The quality of the PSF.
    pub fn outcome(&self) -> Outcome {
        let size = self.planes.size();
        let share = 100.0 * self.support as f64 / size.pixels() as f64;
        let good = self.snr >= SNR.1 && !self.cut;
        let (end, remedy) = match (self.cut, good) {
            (true, _) => ("poor, it reaches the frame's border", Some(Remedy::CentreSource)),
            (_, false) => ("usable", Some(Remedy::ExposeLonger)),
            _ => ("good", None),
        };
        let plane = self.planes.plane(0);
        let peak = plane.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
        let shares: Vec<f32> = plane.iter().map(|v| v / peak).collect();
        let (picture, scale) = picture(size, &shares, "Point-spread function (PSF)", "of the peak");
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
            remedy,
            picture,
            scale,
        }
    }
}
