//! The point spread function of the diffuser: what one point of the scene looks like on the sensor.

use super::convolve::Reach;
use crate::image::{Size, Stack, cubic};

/// Samples below this fraction of the peak do not count as support: they are rounding, not light.
const SUPPORT_FLOOR: f32 = 1e-6;
/// A measured PSF has one brightest pixel; this share of its support at exactly the peak value means it is clipped.
const SATURATED_SHARE: f64 = 0.05;
/// Fewer equal peaks than this are coincidence.
const SATURATED_MIN: usize = 16;
/// Width of the frame's border in which the background shows, as a share of the shorter side.
const BORDER: usize = 32;
/// Samples of the border of a pedestal differ by no more than this share of it, beside their noise.
const FLAT: f32 = 0.15;
/// Background below this share of the light is left alone …
const HARMLESS: f64 = 0.01;
/// … and a background that may or may not be light may hold no more than this.
const UNCLEAR: f64 = 0.12;
/// Samples above a pedestal by less than this many standard deviations of the border's noise are no light.
const CLEAR: f32 = 5.0;
/// Noise around a subtracted background may dip below zero; this share of the light may not.
const NEGATIVE_SHARE: f64 = 0.2;

/// Pixels that a point of light fills, at most, behind a lens: 1/Σk² of samples k of sum 1.
pub const LENS_SPREAD: f32 = 4.0;

/// Why a PSF cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PsfError {
    /// Not the size of the sensor.
    #[error("psf is {found} pixels, the sensor is {expected}")]
    Size {
        /// Size of the file's planes.
        found: Size,
        /// Size of the sensor.
        expected: Size,
    },
    /// Neither one plane nor one for each channel.
    #[error("psf has {found} planes, allowed: 1 or {channels} (one for each channel)")]
    Channels {
        /// Planes in the file.
        found: usize,
        /// Channels of the sensor.
        channels: usize,
    },
    /// NaN or infinite samples.
    #[error(
        "psf plane {plane} has {count} samples that are NaN or infinite, the first at row {row}, column {column}; allowed: none"
    )]
    NotFinite {
        /// Plane.
        plane: usize,
        /// Number of such samples.
        count: usize,
        /// Row of the first.
        row: usize,
        /// Column of the first.
        column: usize,
    },
    /// No light.
    #[error("psf plane {plane} has no light: its largest sample is {max}, allowed: > 0")]
    Dark {
        /// Plane.
        plane: usize,
        /// Largest sample.
        max: f32,
    },
    /// All samples equal.
    #[error("psf plane {plane} is constant at {value}: it shows no point source")]
    Constant {
        /// Plane.
        plane: usize,
        /// The value of all samples.
        value: f32,
    },
    /// Clipped at full scale.
    #[error("psf plane {plane} is saturated: {count} samples ({percent:.1} % of its support) are exactly at the peak {peak}, allowed: {:.0} %; expose shorter", 100.0 * SATURATED_SHARE)]
    Saturated {
        /// Plane.
        plane: usize,
        /// Samples at the peak.
        count: usize,
        /// Their share of the support, in percent.
        percent: f64,
        /// The peak value.
        peak: f32,
    },
    /// A background that may be a pedestal or light.
    #[error("psf plane {plane}: even its darkest samples hold {percent:.1} % of its light, allowed: {:.0} % unless the border is flat, where they are a pedestal and taken off; subtract a frame taken with the point source off", 100.0 * UNCLEAR)]
    Background {
        /// Plane.
        plane: usize,
        /// Share of the light that a floor of the level of the darkest samples holds, in percent.
        percent: f64,
    },
    /// Much negative light: the background was over-subtracted.
    #[error("psf plane {plane}: negative samples sum to {percent:.1} % of the positive ones, allowed: {:.0} %; subtract less background", 100.0 * NEGATIVE_SHARE)]
    Negative {
        /// Plane.
        plane: usize,
        /// Share in percent.
        percent: f64,
    },
}

/// A checked PSF: one plane for all channels or one for each, non-negative, each plane of sum 1, zero displacement at
/// (height/2, width/2) rounded down.
#[derive(Clone, Debug)]
pub struct Psf {
    planes: Stack<f32>,
    reach: Reach,
    pedestal: f64,
}

impl Psf {
    /// Checks and normalizes `samples`, of any positive scale, for a sensor of `size` and `channels`. A pedestal, which shows as a flat
    /// border, is taken off; negative noise is set to zero.
    ///
    /// # Errors
    /// [`PsfError`]: wrong size, NaN, dark, constant, saturated, mostly negative, or on a background that may be light.
    pub fn new(mut samples: Stack<f32>, size: Size, channels: usize) -> Result<Self, PsfError> {
        if samples.size() != size {
            return Err(PsfError::Size { found: samples.size(), expected: size });
        }
        if samples.count() != 1 && samples.count() != channels {
            return Err(PsfError::Channels { found: samples.count(), channels });
        }
        let mut pedestal = 0.0f64;
        for (plane, values) in samples.planes_mut().enumerate() {
            check(plane, values, size.width)?;
            pedestal = pedestal.max(take_pedestal_off(plane, values, size.width)?);
            normalize(plane, values)?;
        }
        let reach = reach(&samples);
        Ok(Self { planes: samples, reach, pedestal })
    }

    /// The PSF magnified by `scale`, k(q/scale)/scale² with its sum kept at 1, interpolated by cubics along each axis; light that leaves
    /// the frame is lost.
    /// Allocates.
    #[must_use]
    pub fn scaled(&self, scale: f64) -> Self {
        if scale.to_bits() == 1f64.to_bits() {
            return self.clone();
        }
        let mut planes = self.planes.clone();
        let Size { width, height } = planes.size();
        let mut line = vec![0.0; width.max(height)];
        for plane in planes.planes_mut() {
            (0..height).for_each(|y| stretch(plane, (y * width, 1), scale, &mut line[..width]));
            (0..width).for_each(|x| stretch(plane, (x, width), scale, &mut line[..height]));
            let sum: f64 = plane.iter().map(|v| f64::from(*v)).sum();
            plane.iter_mut().for_each(|v| *v = (f64::from(*v) / sum.max(f64::MIN_POSITIVE)) as f32);
        }
        Self { reach: reach(&planes), planes, pedestal: self.pedestal }
    }

    /// Share of the light of the samples that was a pedestal and has been taken off, 0 to 1; the largest over all planes.
    pub fn pedestal(&self) -> f64 {
        self.pedestal
    }

    /// The PSF of `channel`, sum 1.
    pub fn channel(&self, channel: usize) -> &[f32] {
        self.planes.plane(channel.min(self.planes.count() - 1))
    }

    /// Size of the sensor.
    pub fn size(&self) -> Size {
        self.planes.size()
    }

    /// Number of different PSFs: 1, or one for each channel.
    pub fn count(&self) -> usize {
        self.planes.count()
    }

    /// Whether light from a point of the scene falls on few pixels, in all channels: the PSF of a lens rather than of a diffuser.
    pub fn is_of_lens(&self) -> bool {
        self.planes.planes().all(|k| k.iter().map(|v| v * v).sum::<f32>() * LENS_SPREAD >= 1.0)
    }

    /// Largest displacements of light, over all channels.
    pub fn reach(&self) -> Reach {
        self.reach
    }
}

/// Refuses samples that show no point source, or a clipped one.
fn check(plane: usize, values: &[f32], width: usize) -> Result<(), PsfError> {
    if let Some(first) = values.iter().position(|v| !v.is_finite()) {
        let count = values.iter().filter(|v| !v.is_finite()).count();
        return Err(PsfError::NotFinite { plane, count, row: first / width, column: first % width });
    }
    let max = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    if max <= 0.0 {
        return Err(PsfError::Dark { plane, max });
    }
    if values.len() > 1 && values.iter().all(|&v| v == max) {
        return Err(PsfError::Constant { plane, value: max });
    }
    let floor = max * SUPPORT_FLOOR;
    let support = values.iter().filter(|&&v| v > floor).count();
    let count = values.iter().filter(|&&v| v == max).count();
    let share = count as f64 / support as f64;
    if count >= SATURATED_MIN && share > SATURATED_SHARE {
        return Err(PsfError::Saturated { plane, count, percent: 100.0 * share, peak: max });
    }
    Ok(())
}

/// Takes off a pedestal: the level of a border that is flat and as dark as anything. Returns its share of the light. Allocates.
fn take_pedestal_off(plane: usize, values: &mut [f32], width: usize) -> Result<f64, PsfError> {
    let height = values.len() / width;
    let depth = width.min(height) / BORDER;
    if depth == 0 {
        return Ok(0.0);
    }
    let max = f64::from(values.iter().copied().fold(0.0, f32::max));
    // Divided by the peak: sums of 1e+38 would leave f32.
    let light = values.iter().map(|v| f64::from(*v) / max).sum::<f64>();
    if light <= 0.0 {
        return Ok(0.0);
    }
    let share = |level: f32| f64::from(level) / max * values.len() as f64 / light;
    let border = |i: usize| {
        let (x, y) = (i % width, i / width);
        x.min(width - 1 - x).min(y).min(height - 1 - y) < depth
    };
    let at_border = || (0..values.len()).filter(|i| border(*i));
    let spread = |values: Vec<f32>| 1.4826 * quantile(values.into_iter().map(f32::abs).collect(), 0.5);
    let level = quantile(at_border().map(|i| values[i]).collect(), 0.5);
    let uneven = spread(at_border().map(|i| values[i] - level).collect());
    // Differences of neighbours show noise, not slopes.
    let next = |i: usize| if i % width + 1 < width { i + 1 } else { i - 1 };
    let noise = spread(at_border().map(|i| values[next(i)] - values[i]).collect()) * std::f32::consts::FRAC_1_SQRT_2;
    let darkest = quantile(values.to_vec(), 0.02);
    let flat =
        noise < 0.5 * level && uneven < FLAT * level + 1.5 * noise && darkest > (1.0 - FLAT) * level - 3.0 * noise;
    if level > 0.0 && flat && share(level) > HARMLESS {
        let share = share(level);
        let above = CLEAR * noise;
        values.iter_mut().for_each(|v| *v = if *v - level > above { *v - level } else { 0.0 });
        return Ok(share);
    }
    if share(darkest) > UNCLEAR {
        return Err(PsfError::Background { plane, percent: 100.0 * share(darkest) });
    }
    Ok(0.0)
}

/// The `q` quantile of finite `values`, of which there is one at least.
fn quantile(mut values: Vec<f32>, q: f64) -> f32 {
    let rank = ((values.len() - 1) as f64 * q) as usize;
    *values.select_nth_unstable_by(rank, f32::total_cmp).1
}

/// Makes the sum one and negative noise zero.
fn normalize(plane: usize, values: &mut [f32]) -> Result<(), PsfError> {
    let max = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    if max <= 0.0 {
        return Err(PsfError::Dark { plane, max });
    }
    // Divided by the peak first: sums of 1e-38 or 1e+38 would leave f32.
    let (mut positive, mut negative) = (0.0f64, 0.0f64);
    for v in values.iter_mut() {
        *v /= max;
        if *v > 0.0 { positive += f64::from(*v) } else { negative -= f64::from(*v) }
    }
    if negative > NEGATIVE_SHARE * positive {
        return Err(PsfError::Negative { plane, percent: 100.0 * negative / positive });
    }
    for v in values.iter_mut() {
        *v = if *v > SUPPORT_FLOOR { (f64::from(*v) / positive) as f32 } else { 0.0 };
    }
    Ok(())
}

/// Spreads a line of an image, which begins at `first` and goes on every `step` samples, from its middle.
fn stretch(plane: &mut [f32], (first, step): (usize, usize), scale: f64, line: &mut [f32]) {
    let centre = (line.len() / 2) as f64;
    line.iter_mut().zip(plane[first..].iter().step_by(step)).for_each(|(v, from)| *v = *from);
    for (x, out) in plane[first..].iter_mut().step_by(step).enumerate().take(line.len()) {
        let (from, taps) = cubic(centre + (x as f64 - centre) / scale);
        let sample = |at: isize| usize::try_from(at).ok().and_then(|at| line.get(at)).copied().unwrap_or(0.0);
        *out = taps.iter().zip(from..).map(|(tap, at)| tap * sample(at)).sum::<f32>().max(0.0);
    }
}

fn reach(planes: &Stack<f32>) -> Reach {
    let Size { width, height } = planes.size();
    let (cy, cx) = (height / 2, width / 2);
    let mut reach = Reach { rows: (0, 0), columns: (0, 0) };
    for plane in planes.planes() {
        for (i, _) in plane.iter().enumerate().filter(|(_, v)| **v > 0.0) {
            let (y, x) = (i / width, i % width);
            reach.rows = (reach.rows.0.max(cy.saturating_sub(y)), reach.rows.1.max(y.saturating_sub(cy)));
            reach.columns = (reach.columns.0.max(cx.saturating_sub(x)), reach.columns.1.max(x.saturating_sub(cx)));
        }
    }
    reach
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(6, 5);

    fn psf(edit: impl Fn(&mut [f32])) -> Result<Psf, PsfError> {
        let mut s = Stack::zeros(1, SIZE);
        s.plane_mut(0)[2 * 6 + 3] = 4.0;
        s.plane_mut(0)[2 * 6 + 5] = 2.0;
        s.plane_mut(0)[3] = 2.0;
        edit(s.plane_mut(0));
        Psf::new(s, SIZE, 3)
    }

    #[test]
    fn any_positive_scale_becomes_sum_one_with_the_same_reach() {
        for scale in [1.0, 1e-38, 1e37] {
            let p = psf(|v| v.iter_mut().for_each(|v| *v *= scale)).unwrap();
            assert!((p.channel(2).iter().sum::<f32>() - 1.0).abs() < 1e-6);
            assert_eq!(p.reach(), Reach { rows: (2, 0), columns: (0, 2) });
        }
    }

    #[test]
    fn a_scaled_psf_has_its_light_further_out() {
        let size = Size::new(64, 48);
        let disc = |i: usize| {
            let (x, y) = ((i % 64) as f32 - 32.0, (i / 64) as f32 - 24.0);
            (-(x * x + y * y) / 98.0).exp() * (1.2 + (0.6 * x).sin())
        };
        let before =
            Psf::new(Stack::from_vec(1, size, (0..size.pixels()).map(disc).collect()).unwrap(), size, 1).unwrap();
        let spread = |psf: &Psf| {
            let far = |i: usize| ((i % 64) as f64 - 32.0).powi(2) + ((i / 64) as f64 - 24.0).powi(2);
            psf.channel(0).iter().enumerate().map(|(i, v)| f64::from(*v) * far(i)).sum::<f64>().sqrt()
        };
        for scale in [0.95, 1.0, 1.03] {
            let after = before.scaled(scale);
            assert!((after.channel(0).iter().sum::<f32>() - 1.0).abs() < 1e-5);
            assert!(
                (spread(&after) / spread(&before) - scale).abs() < 2e-3,
                "{scale}: {}",
                spread(&after) / spread(&before)
            );
        }
        assert_eq!(before.scaled(1.0).reach(), before.reach());
    }

    /// Filaments on a disc.
    fn filaments(size: Size, radius: f32) -> Vec<f32> {
        let Size { width, height } = size;
        let at = |i: usize| {
            let (x, y) = ((i % width) as f32 - (width / 2) as f32, (i / width) as f32 - (height / 2) as f32);
            if x.hypot(y) < radius { (0.5 + 0.5 * (0.9 * x + 0.3 * y).sin() * (0.7 * y).cos()).powi(6) } else { 0.0 }
        };
        (0..size.pixels()).map(at).collect()
    }

    #[test]
    fn a_pedestal_is_taken_off_with_its_noise() {
        let size = Size::new(96, 80);
        let clean = Psf::new(Stack::from_vec(1, size, filaments(size, 25.0)).unwrap(), size, 1).unwrap();
        assert!(clean.pedestal() == 0.0);
        for (level, sigma) in [(0.01, 0.0), (0.06, 0.0), (0.06, 0.002)] {
            let noise = crate::image::noise::normal(size.pixels(), sigma, 3);
            let with = filaments(size, 25.0).iter().zip(noise).map(|(v, noise)| v + level + noise).collect();
            let psf = Psf::new(Stack::from_vec(1, size, with).unwrap(), size, 1).unwrap();
            let off: f32 = psf.channel(0).iter().zip(clean.channel(0)).map(|(a, b)| (a - b).abs()).sum();
            assert!(psf.pedestal() > 0.05 && off < 0.05, "{level} {sigma}: {} {off}", psf.pedestal());
            assert_eq!(psf.reach(), clean.reach());
        }
    }

    #[test]
    fn a_background_that_may_be_light_is_refused_and_a_wide_psf_is_not() {
        let size = Size::new(96, 80);
        let psf = |values: Vec<f32>| Psf::new(Stack::from_vec(1, size, values).unwrap(), size, 1);
        let wide = psf(filaments(size, 80.0)).unwrap();
        assert!(wide.pedestal() == 0.0);
        let slope = filaments(size, 25.0).iter().enumerate().map(|(i, v)| v + 0.02 + 0.002 * (i % 96) as f32).collect();
        let message = psf(slope).unwrap_err().to_string();
        assert!(message.contains("even its darkest samples hold") && message.contains("source off"), "{message}");
    }

    #[test]
    fn unusable_psfs_are_refused_with_their_statistic() {
        let message = |r: Result<Psf, PsfError>| r.unwrap_err().to_string();
        assert!(message(psf(|v| v.fill(0.0))).contains("no light: its largest sample is 0"));
        assert!(message(psf(|v| v.fill(-1.0))).contains("no light"));
        assert!(message(psf(|v| v.fill(0.5))).contains("constant at 0.5"));
        assert!(
            message(psf(|v| v[7] = f32::NAN))
                .contains("1 samples that are NaN or infinite, the first at row 1, column 1")
        );
        assert!(message(psf(|v| v[..20].fill(9.0))).contains("20 samples"));
        assert!(message(psf(|v| v[20..].fill(-1.0))).contains("negative samples sum to 125.0 %"));
        let other = Psf::new(Stack::zeros(1, Size::new(2, 2)), SIZE, 1).map(|_| ());
        assert_eq!(other.unwrap_err().to_string(), "psf is 2×2 pixels, the sensor is 6×5");
        let two = Psf::new(Stack::zeros(2, SIZE), SIZE, 3).map(|_| ());
        assert_eq!(two.unwrap_err().to_string(), "psf has 2 planes, allowed: 1 or 3 (one for each channel)");
    }
}
