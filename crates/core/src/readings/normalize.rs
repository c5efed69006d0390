//! Readings of the lensless sensor: counts → fractions of full scale, and which of them to trust.

use std::sync::Arc;

use super::Unit;
use crate::device::{Device, Sensor};
use crate::image::noise::{SAMPLES, quantile, reading_noise};
use crate::image::{Buffers, OffScale, Planes, Size, Stack};

/// Equal readings at the very top that make a floating-point frame clipped rather than bright.
const CLIPPED_MIN: usize = 16;

/// Fractions of full scale up to this may come of noise and of scaling; larger ones are counts.
pub(super) const LARGEST_FRACTION: f32 = 2.0;

/// A reading this many standard deviations of the noise from its neighbours is defective …
const OUTLYING: f32 = 12.0;
/// … if that is this share of bright readings …
const VISIBLE: f32 = 0.02;
/// … and this many times what its neighbours are from theirs: fine lines of light are longer than a pixel.
const ISOLATED: f32 = 4.0;
/// As above behind a lens, where a point of light is one bright reading with faint ones around it.
const ISOLATED_BEHIND_LENS: f32 = 8.0;
/// Share of the readings up to which isolated ones behind a lens are taken for points of light.
const POINTS_OF_LIGHT: f32 = 1e-5;

/// Shares of the readings of one frame that are not to be trusted or not worth much, 0 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Quality {
    /// At or above saturation; ignored by the solvers.
    pub saturated: f32,
    /// NaN or infinite; ignored by the solvers.
    pub not_finite: f32,
    /// Isolated ones far from their neighbours, of dead or hot pixels; ignored by the solvers.
    pub defective: f32,
    /// Largest trusted reading, fractions of full scale.
    pub peak: f32,
    /// Mean trusted reading, fractions of full scale.
    pub mean: f32,
    /// Smallest trusted reading, fractions of full scale.
    pub floor: f32,
    /// How the readings contradict the declared scale of counts.
    pub off_scale: Option<OffScale>,
}

/// A raw frame that cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ReadingsError {
    /// The frame is not what the bundle is for.
    #[error("raw frame has {found_channels} channel(s) of {found} pixels, the bundle is for {channels} of {size}")]
    Shape {
        /// Channels of the frame.
        found_channels: usize,
        /// Size in pixels.
        found: Size,
        /// Channels of the bundle's sensor.
        channels: usize,
        /// Size in pixels.
        size: Size,
    },
    /// Floating-point readings that look like counts, of a sensor whose black level would then stay in them.
    #[error(
        "raw frame: floating-point readings up to {peak}, allowed: fractions of full scale, 0 to 1, less the black level (of {black_level} \
         counts); give counts as integers, or say that the unit is counts"
    )]
    Unit {
        /// Largest reading.
        peak: f32,
        /// Counts of a pixel without light.
        black_level: f32,
    },
    /// Nothing in the frame can be used.
    #[error(
        "raw frame: none of the {count} readings can be used ({saturated:.1} % saturated, {not_finite:.1} % NaN or infinite){}",
        .off_scale.map_or_else(String::new, |found| format!("; {found}"))
    )]
    Unusable {
        /// Number of readings.
        count: usize,
        /// Saturated ones, in percent.
        saturated: f32,
        /// NaN and infinite ones, in percent.
        not_finite: f32,
        /// How they contradict the declared scale of counts.
        off_scale: Option<OffScale>,
    },
}

/// The normalized readings of one frame.
#[derive(Debug)]
pub(crate) struct Readings {
    /// `[C, H, W]`, fractions of full scale; where the weight is 0, an estimate.
    pub(crate) raw: Stack<f32>,
    /// 0 or 1 for each reading.
    pub(crate) weight: Stack<f32>,
    /// Shares of readings that are not to be trusted.
    pub(crate) quality: Quality,
    samples: Vec<f32>,
}

/// Normalization for one device.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    sensor: Sensor,
    /// In counts, one plane or one for each channel; none where binning subtracts it.
    dark: Option<Arc<Stack<f32>>>,
    /// Multiplies the channels.
    white: [f32; 3],
    /// Rows after which the mask repeats.
    row_period: usize,
    /// Whether the PSF is that of a lens.
    lens: bool,
}

impl Plan {
    /// Normalization for `device`.
    pub(crate) fn new(device: &Device) -> Self {
        let (sensor, row_period) = (device.sensor, device.response.row_period());
        let dark = device.dark.clone().filter(|_| sensor.window.is_whole());
        Self { sensor, dark, white: device.white, row_period, lens: device.psf.is_of_lens() }
    }

    /// Buffers of one frame.
    pub(crate) fn readings(&self, buffers: &mut Buffers) -> Readings {
        let Sensor { size, channels, .. } = self.sensor;
        let (raw, weight) = (buffers.stack(channels, size), buffers.stack(channels, size));
        Readings { raw, weight, quality: Quality::default(), samples: buffers.reserved(SAMPLES) }
    }

    /// Normalizes `values` (`[C, H, W]`). The weight is 1, or that which comes with a value, where a reading can be trusted,
    /// else 0 and the reading an estimate from its column.
    ///
    /// # Errors
    /// [`ReadingsError`] for a frame of another shape than the device's, of another unit, or without a reading that can be used.
    pub(crate) fn run(&self, values: Planes<'_>, unit: Unit, readings: &mut Readings) -> Result<(), ReadingsError> {
        let Sensor { size, channels, .. } = self.sensor;
        if values.size() != size || values.count() != channels {
            return Err(ReadingsError::Shape { found_channels: values.count(), found: values.size(), channels, size });
        }
        let black_level = self.sensor.black_level;
        if let Some(OffScale::Counts { largest: peak }) = values.off_scale() {
            return Err(ReadingsError::Unit { peak, black_level });
        }
        if unit == Unit::FullScale && (self.sensor.black_level > 0.0 || self.dark.is_some()) {
            let peak = values.as_slice().iter().copied().filter(|v| v.is_finite()).fold(0.0, f32::max);
            if peak > LARGEST_FRACTION {
                return Err(ReadingsError::Unit { peak, black_level });
            }
        }
        let Readings { raw, weight, samples, .. } = readings;
        readings.quality = self.normalize(values, unit, [raw, weight], samples);
        let Quality { saturated, not_finite, off_scale, .. } = readings.quality;
        if saturated + not_finite >= 1.0 {
            let (saturated, not_finite) = (100.0 * saturated, 100.0 * not_finite);
            return Err(ReadingsError::Unusable { count: values.as_slice().len(), saturated, not_finite, off_scale });
        }
        Ok(())
    }

    fn normalize(
        &self,
        values: Planes<'_>,
        unit: Unit,
        [raw, weight]: [&mut Stack<f32>; 2],
        samples: &mut Vec<f32>,
    ) -> Quality {
        let Sensor { black_level, saturation, .. } = self.sensor;
        let span = saturation - black_level;
        let (scale, offset, highest) = match unit {
            Unit::Counts => (span.recip(), black_level, saturation),
            Unit::FullScale => (1.0, 0.0, Plateau::of(values.as_slice()).level()),
        };
        let mut off_scale = values.off_scale();
        // clipping of means is found where they are made
        let counted = unit == Unit::Counts && off_scale.is_none() && self.sensor.window.is_whole();
        let (mut saturated, mut not_finite, mut defective, mut sum) = (0usize, 0usize, 0usize, 0.0f64);
        let (mut peak, mut floor, mut lost) = (f32::NEG_INFINITY, f32::INFINITY, 0.0f64);
        let (size, n) = (values.size(), values.as_slice().len());
        for c in 0..values.count() {
            let found = OffScale::find(values.plane(c), saturation).filter(|_| counted);
            let limit = if let Some(OffScale::Clipped { level, .. }) = found { level } else { highest };
            off_scale = off_scale.or(found);
            let dark = self.dark.as_ref().map(|d| d.plane(c.min(d.count() - 1)));
            let scale = scale * self.white[c.min(2)];
            let (raw, weight) = (raw.plane_mut(c), weight.plane_mut(c));
            let dark_of = |i: usize| match (dark, unit) {
                (None, _) => offset,
                (Some(d), Unit::Counts) => d[i],
                (Some(d), Unit::FullScale) => (d[i] - black_level) / span,
            };
            for (i, (&v, (r, w))) in values.plane(c).iter().zip(raw.iter_mut().zip(&mut *weight)).enumerate() {
                let trusted = v.is_finite() && v < limit;
                not_finite += usize::from(!v.is_finite());
                saturated += usize::from(v.is_finite() && v >= limit);
                *w = f32::from(trusted);
                *r = if trusted { (v - dark_of(i)) * scale } else { 0.0 };
            }
            if let Some(weights) = values.weights(c) {
                lost += weigh(weights, raw, weight);
            }
            interpolate(raw, weight, size, self.row_period);
            let found = reject_outliers(raw, weight, size, self.row_period, self.lens, samples);
            if found > 0 {
                defective += found;
                interpolate(raw, weight, size, self.row_period);
            }
            if self.lens {
                brighten(raw, values.plane(c), limit, |i| (limit - dark_of(i)) * scale);
            }
            for (r, _) in raw.iter().zip(weight).filter(|(_, w)| **w > 0.0) {
                sum += f64::from(*r);
                (peak, floor) = (peak.max(*r), floor.min(*r));
            }
        }
        let trusted = n - saturated - not_finite - defective;
        let share = |count: usize| count as f32 / n as f32;
        let mean = if trusted > 0 { (sum / trusted as f64) as f32 } else { 0.0 };
        let (peak, floor) = if trusted > 0 { (peak, floor) } else { (0.0, 0.0) };
        Quality {
            saturated: share(saturated),
            not_finite: share(not_finite),
            defective: share(defective) + (lost / n as f64) as f32,
            peak,
            mean,
            floor,
            off_scale,
        }
    }
}

/// The level from which on readings of a plane of a frame are saturated: that at which they are clipped below the declared `saturation`,
/// else the declared one. Fractions of full scale have none that is declared: their plateau at the top, else infinity.
pub fn saturation_found(plane: &[f32], unit: Unit, saturation: f32) -> f32 {
    match unit {
        Unit::FullScale => Plateau::of(plane).level(),
        Unit::Counts => match OffScale::find(plane, saturation) {
            Some(OffScale::Clipped { level, .. }) => level,
            _ => saturation,
        },
    }
}

/// Raises the estimates of saturated readings to `full`: behind a lens a saturated reading tells that its own pixel is at least so bright.
fn brighten(raw: &mut [f32], values: &[f32], limit: f32, full: impl Fn(usize) -> f32) {
    for (i, (raw, v)) in raw.iter_mut().zip(values).enumerate() {
        if v.is_finite() && *v >= limit {
            *raw = raw.max(full(i));
        }
    }
}

/// Gives trusted readings the weights that came with them; returns the sum of the weight that they lack.
fn weigh(given: &[f32], raw: &mut [f32], weight: &mut [f32]) -> f64 {
    let mut lost = 0.0;
    for ((given, raw), weight) in given.iter().zip(raw).zip(weight).filter(|(_, weight)| **weight > 0.0) {
        *weight = *given;
        lost += f64::from(1.0 - given);
        if *given == 0.0 {
            *raw = 0.0;
        }
    }
    lost
}

/// Fills untrusted readings from the nearest trusted ones above and below that lie behind like polarizers: in the same
/// column, a multiple of `row_period` rows away. Where there are none, readings stay as they are.
fn interpolate(raw: &mut [f32], weight: &[f32], Size { width, height }: Size, row_period: usize) {
    if weight.iter().all(|w| *w > 0.0) {
        return;
    }
    for first in 0..(row_period * width).min(raw.len()) {
        // Reading k of this kind.
        let at = |k: usize| first + k * row_period * width;
        let count = (height - first / width).div_ceil(row_period);
        let mut above = None;
        let mut k = 0;
        while k < count {
            if weight[at(k)] > 0.0 {
                above = Some(k);
                k += 1;
                continue;
            }
            let below = (k..count).find(|k| weight[at(*k)] > 0.0);
            let end = below.unwrap_or(count);
            for k in k..end {
                raw[at(k)] = match (above, below) {
                    (Some(a), Some(b)) => {
                        let t = (k - a) as f32 / (b - a) as f32;
                        raw[at(a)] * (1.0 - t) + raw[at(b)] * t
                    }
                    (Some(one), None) | (None, Some(one)) => raw[at(one)],
                    (None, None) => raw[at(k)],
                };
            }
            k = end;
        }
    }
}

/// Sets the weight of isolated readings to 0 that are far from the others of their column behind like polarizers, which are
/// multiples of `row_period` rows away; returns how many there are. Behind a `lens` a few may be points of light and are left.
fn reject_outliers(
    raw: &[f32],
    weight: &mut [f32],
    size: Size,
    row_period: usize,
    lens: bool,
    samples: &mut Vec<f32>,
) -> usize {
    let Size { width, height } = size;
    let (isolated, few) =
        if lens { (ISOLATED_BEHIND_LENS, (POINTS_OF_LIGHT * raw.len() as f32) as usize) } else { (ISOLATED, 0) };
    if height < 5 * row_period {
        return 0;
    }
    let sigma = reading_noise(raw, weight, size, row_period, samples);
    // Not the peak itself: that may be a hot pixel.
    let bright = quantile(raw.len(), 0.99, |i| Some(raw[i]), samples);
    let least = (OUTLYING * sigma).max(VISIBLE * bright);
    // From the median of the four nearest of the column.
    let row = |y: usize| &raw[y * width..][..width];
    let near = |y: usize| {
        let (phase, k) = (y % row_period, y / row_period);
        let first = k.saturating_sub(2).min((height - phase).div_ceil(row_period) - 5);
        [0, 1, 2, 3].map(|j| row(phase + row_period * (first + j + usize::from(first + j >= k))))
    };
    let off = |v: f32, [a, b, c, d]: [f32; 4]| {
        // the two in the middle
        let (low, high) = (a.min(b).max(c.min(d)), a.max(b).min(c.max(d)));
        (v - 0.5 * (low + high)).abs()
    };
    let off_at = |x: usize, y: usize| off(row(y)[x], near(y).map(|row| row[x]));
    let mut count = 0;
    for y in 0..height {
        let (here, [a, b, c, d]) = (row(y), near(y));
        for x in 0..width {
            let here = off(here[x], [a[x], b[x], c[x], d[x]]);
            if here <= least || weight[y * width + x] == 0.0 {
                continue;
            }
            let rows = y.saturating_sub(1)..(y + 2).min(height);
            let columns = x.saturating_sub(1)..(x + 2).min(width);
            let around = rows.flat_map(|v| columns.clone().map(move |u| (u, v))).filter(|at| *at != (x, y));
            if around.map(|(u, v)| off_at(u, v)).fold(0.0, f32::max) * isolated < here {
                // marked, until all are counted
                weight[y * width + x] *= -1.0;
                count += 1;
            }
        }
    }
    let found = if count > few { count } else { 0 };
    if count > 0 {
        weight.iter_mut().filter(|w| **w < 0.0).for_each(|w| *w = if found > 0 { 0.0 } else { -*w });
    }
    found
}

/// The largest of some values. A floating-point frame has no stated full scale, so clipping shows as a plateau: many readings at exactly
/// the maximum, while others lie below.
#[derive(Clone, Copy, Debug)]
pub(super) struct Plateau {
    max: f32,
    count: usize,
    others: bool,
}

impl Default for Plateau {
    fn default() -> Self {
        Self { max: f32::NEG_INFINITY, count: 0, others: false }
    }
}

impl Plateau {
    fn of(values: &[f32]) -> Self {
        let mut plateau = Self::default();
        values.iter().for_each(|v| plateau.add(*v));
        plateau
    }

    /// Counts a value; one that is not finite does not matter.
    pub(super) fn add(&mut self, v: f32) {
        if !v.is_finite() {
            return;
        }
        self.others |= self.count > 0 && v != self.max;
        if v > self.max {
            (self.max, self.count) = (v, 0);
        }
        self.count += usize::from(v == self.max);
    }

    /// The largest value.
    pub(super) fn largest(&self) -> f32 {
        self.max
    }

    /// The value at which the frame is clipped; infinite when it is not.
    pub(super) fn level(&self) -> f32 {
        if self.count >= CLIPPED_MIN && self.max > 0.0 && self.others { self.max } else { f32::INFINITY }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::{Size, Window};

    const SENSOR: Sensor = Sensor {
        size: Size::new(3, 1),
        window: Window::whole(Size::new(3, 1)),
        channels: 1,
        black_level: 100.0,
        saturation: 1100.0,
    };
    const PLAN: Plan = Plan { sensor: SENSOR, dark: None, white: [1.0; 3], row_period: 1, lens: false };

    fn run(values: Vec<f32>, unit: Unit, dark: Option<Vec<f32>>) -> (Vec<f32>, Vec<f32>, Quality) {
        let size = Size::new(values.len(), 1);
        let values = Stack::from_vec(1, size, values).unwrap();
        let dark = dark.map(|d| Arc::new(Stack::from_vec(1, size, d).unwrap()));
        let (mut raw, mut weight) = (Stack::zeros(1, size), Stack::zeros(1, size));
        let q = Plan { dark, ..PLAN }.normalize(values.borrow(), unit, [&mut raw, &mut weight], &mut Vec::new());
        (raw.as_slice().to_vec(), weight.as_slice().to_vec(), q)
    }

    #[test]
    fn counts_become_fractions_and_full_pixels_lose_their_weight() {
        let (raw, weight, q) = run(vec![100.0, 600.0, 1100.0], Unit::Counts, None);
        assert_eq!((raw, weight), (vec![0.0, 0.5, 0.0], vec![1.0, 1.0, 0.0]));
        assert_eq!((q.peak, q.floor, q.mean), (0.5, 0.0, 0.25));
        assert!((q.saturated - 1.0 / 3.0).abs() < 1e-6);
    }

    #[test]
    fn a_dark_frame_replaces_the_black_level() {
        let (raw, ..) = run(vec![150.0, 600.0, 300.0], Unit::Counts, Some(vec![150.0, 100.0, 200.0]));
        assert_eq!(raw, [0.0, 0.5, 0.1]);
        let (raw, ..) = run(vec![0.05, 0.5, 0.2], Unit::FullScale, Some(vec![150.0, 100.0, 200.0]));
        assert!(raw.iter().zip([0.0, 0.5, 0.1]).all(|(a, b)| (a - b).abs() < 1e-6));
    }

    #[test]
    fn nan_is_ignored_and_counted_whatever_the_scale() {
        for scale in [1e-6, 1.0, 1e6] {
            let (raw, weight, q) = run(vec![f32::NAN, 0.5 * scale, f32::INFINITY, scale], Unit::FullScale, None);
            assert_eq!((raw, weight), (vec![0.0, 0.5 * scale, 0.0, scale], vec![0.0, 1.0, 0.0, 1.0]));
            assert_eq!(q.not_finite, 0.5);
        }
    }

    #[test]
    fn a_plateau_at_the_top_of_a_float_frame_is_saturation() {
        let mut v = vec![2.0; 20];
        v.push(1.0);
        let (.., q) = run(v, Unit::FullScale, None);
        assert!((q.saturated - 20.0 / 21.0).abs() < 1e-6);
        assert_eq!(run(vec![0.3; 20], Unit::FullScale, None).2.saturated, 0.0, "a constant frame is not clipped");
    }

    #[test]
    fn clipping_below_the_declared_saturation_is_found_and_left_out() {
        let noise = crate::image::noise::normal(4000, 8.0, 3);
        let values: Vec<f32> = (0..4000).map(|i| (200.0 + 0.2 * i as f32 + noise[i]).round()).collect();
        let clean = run(values.clone(), Unit::Counts, None).2;
        assert_eq!((clean.saturated, clean.off_scale), (0.0, None));
        let clipped: Vec<f32> = values.iter().map(|v| v.min(900.0)).collect();
        let (_, weight, q) = run(clipped.clone(), Unit::Counts, None);
        assert_eq!(q.off_scale, Some(OffScale::Clipped { level: 900.0, saturation: 1100.0 }));
        assert!(weight.iter().zip(&clipped).all(|(w, v)| *w == f32::from(*v < 900.0)));
        assert!((q.saturated - clipped.iter().filter(|v| **v == 900.0).count() as f32 / 4000.0).abs() < 1e-6);
        let aligned: Vec<f32> = values.iter().map(|v| (v / 16.0).floor() * 16.0).collect();
        let found = run(aligned, Unit::Counts, None).2.off_scale;
        assert_eq!(found, Some(OffScale::LeftAligned { step: 16, saturation: 1100.0 }));
        let deeper: Vec<f32> = values.iter().map(|v| v * 5.0).collect();
        assert!(matches!(run(deeper, Unit::Counts, None).2.off_scale, Some(OffScale::Deeper { .. })));
    }

    #[test]
    fn white_balance_multiplies_the_channels_after_black_and_dark() {
        let size = Size::new(2, 1);
        let values = Stack::from_vec(3, size, vec![100.0, 350.0, 100.0, 600.0, 100.0, 1100.0]).unwrap();
        let (mut raw, mut weight) = (Stack::zeros(3, size), Stack::zeros(3, size));
        let plan = Plan { white: [2.0, 1.0, 0.5], ..PLAN };
        plan.normalize(values.borrow(), Unit::Counts, [&mut raw, &mut weight], &mut Vec::new());
        assert_eq!(raw.as_slice(), [0.0, 0.5, 0.0, 0.5, 0.0, 0.0]);
        assert_eq!(weight.as_slice(), [1.0, 1.0, 1.0, 1.0, 1.0, 0.0], "clipping is judged before");
    }

    #[test]
    fn weights_of_blocks_are_kept_and_what_they_lack_is_counted() {
        let size = Size::new(1, 4);
        let values = Stack::from_vec(1, size, vec![200.0, 300.0, 500.0, 1100.0]).unwrap();
        let weights = [1.0, 0.75, 0.0, 0.0];
        let (mut raw, mut weight) = (Stack::zeros(1, size), Stack::zeros(1, size));
        let view = values.view().weighted(&weights).unwrap();
        let mut buffer = Stack::zeros(0, Size::new(0, 0));
        let q = PLAN.normalize(view.to_planes(&mut buffer), Unit::Counts, [&mut raw, &mut weight], &mut Vec::new());
        assert_eq!((raw.as_slice(), weight.as_slice()), ([0.1, 0.2, 0.2, 0.2].as_slice(), weights.as_slice()));
        assert_eq!((q.saturated, q.defective), (0.25, 0.3125));
        assert_eq!(values.view().weighted(&weights[1..]).unwrap_err().found, 3);
    }

    #[test]
    fn untrusted_readings_are_estimated_from_their_column() {
        let mut raw = vec![1.0, 5.0, 0.0, 0.0, 0.0, 0.0, 4.0, 2.0];
        let weight = [1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        interpolate(&mut raw, &weight, Size::new(2, 4), 1);
        assert_eq!(raw, [1.0, 5.0, 2.0, 5.0, 3.0, 5.0, 4.0, 5.0]);
    }

    /// Stripes, a ramp and noise.
    fn frame(size: Size) -> Vec<f32> {
        let mut s = 5u32;
        let mut noise = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            0.004 * ((s >> 8) as f32 / (1 << 24) as f32 - 0.5)
        };
        let level = |i: usize| 0.2 + 0.001 * (i / size.width) as f32 + 0.2 * (i % size.width / 6 % 2) as f32;
        (0..size.pixels()).map(|i| level(i) + noise()).collect()
    }

    #[test]
    fn dead_and_hot_pixels_are_found_and_nothing_else() {
        let size = Size::new(60, 50);
        let mut raw = frame(size);
        let mut weight = vec![1.0; raw.len()];
        assert_eq!(reject_outliers(&raw, &mut weight, size, 1, false, &mut Vec::new()), 0);
        // A line of light is no defect.
        (10..30).for_each(|y| raw[y * 60 + 40] += 0.5);
        let bad = [0, 7 * 60 + 13, 25 * 60 + 3, 49 * 60 + 59];
        bad.iter().zip([0.0, 0.9, 0.0, 0.95]).for_each(|(i, v)| raw[*i] = v);
        assert_eq!(reject_outliers(&raw, &mut weight, size, 1, false, &mut Vec::new()), bad.len());
        assert!(bad.iter().all(|i| weight[*i] == 0.0));
    }

    #[test]
    fn behind_a_lens_points_of_light_are_no_defects_and_hot_pixels_are() {
        let size = Size::new(400, 300);
        let clean = frame(size);
        let found = |bright: &[usize], around: f32, lens: bool| {
            let (mut raw, mut weight) = (clean.clone(), vec![1.0; clean.len()]);
            for i in bright {
                raw[*i] += 0.5;
                [1, 400].iter().for_each(|step| raw[i + step] += around);
            }
            let found = reject_outliers(&raw, &mut weight, size, 1, lens, &mut Vec::new());
            assert_eq!(weight.iter().filter(|w| **w == 0.0).count(), found);
            assert!(weight.iter().all(|w| [0.0, 1.0].contains(w)));
            found
        };
        let places: Vec<usize> = (1..9).map(|k| k * 31 * 400 + k * 37).collect();
        assert_eq!(found(&places, 0.1, false), 8);
        assert_eq!(found(&places, 0.1, true), 0, "points of light have a little light around them");
        assert_eq!(found(&places, 0.0, true), 8, "hot pixels have none");
        assert_eq!(found(&places[..1], 0.0, true), 0, "one in a hundred thousand may be a point of light");
    }

    #[test]
    fn behind_a_lens_saturated_readings_are_estimated_as_full_ones() {
        let size = Size::new(1, 5);
        let values = Stack::from_vec(1, size, vec![600.0, 1100.0, 1100.0, f32::NAN, 600.0]).unwrap();
        let estimates = |lens: bool| {
            let (mut raw, mut weight) = (Stack::zeros(1, size), Stack::zeros(1, size));
            let plan = Plan { lens, ..PLAN };
            plan.normalize(values.borrow(), Unit::Counts, [&mut raw, &mut weight], &mut Vec::new());
            assert_eq!(weight.as_slice(), [1.0, 0.0, 0.0, 0.0, 1.0]);
            raw.as_slice().to_vec()
        };
        assert_eq!(estimates(false), [0.5; 5]);
        assert_eq!(estimates(true), [0.5, 1.0, 1.0, 0.5, 0.5], "a reading that is missing tells nothing");
    }

    /// A flat, polarized field behind a mosaic of 2×2 polarizers with noise of 0.003: columns alternate between two levels.
    fn mosaic(size: Size) -> (Vec<f32>, impl Fn(usize) -> f32) {
        let level = move |i: usize| [[0.1, 0.3], [0.4, 0.2]][i / size.width % 2][i % size.width % 2];
        let noise = crate::image::noise::normal(size.pixels(), 0.003, 4);
        (noise.iter().enumerate().map(|(i, v)| v + level(i)).collect(), level)
    }

    #[test]
    fn behind_a_mosaic_like_readings_are_compared() {
        let size = Size::new(60, 51);
        let (clean, level) = mosaic(size);
        let sigma = reading_noise(&clean, &vec![1.0; clean.len()], size, 2, &mut Vec::new());
        assert!((sigma - 0.003).abs() < 3e-4, "{sigma}");
        // Hot and dead pixels at the borders and inside, some of them as bright as the other polarizers' readings.
        let bad = [(0, 0.4), (7 * 60 + 13, 0.9), (25 * 60 + 3, 0.0), (30 * 60 + 8, 0.25), (50 * 60 + 59, 0.05)];
        let (mut values, lost) = (clean.clone(), [61, 61 + 120, 50 * 60, 24 * 60 + 31]);
        bad.iter().for_each(|(i, v)| values[*i] = *v);
        lost.iter().for_each(|i| values[*i] = f32::NAN);
        let values = Stack::from_vec(1, size, values).unwrap();
        let (mut raw, mut weight) = (Stack::zeros(1, size), Stack::zeros(1, size));
        let plan = Plan { row_period: 2, ..PLAN };
        let q = plan.normalize(values.borrow(), Unit::FullScale, [&mut raw, &mut weight], &mut Vec::new());
        assert_eq!(q.defective, bad.len() as f32 / size.pixels() as f32);
        for (i, (raw, weight)) in raw.as_slice().iter().zip(weight.as_slice()).enumerate() {
            let spoilt = lost.contains(&i) || bad.iter().any(|(bad, _)| *bad == i);
            assert_eq!(*weight, f32::from(!spoilt), "{i}");
            assert!(if spoilt { (raw - level(i)).abs() < 0.015 } else { *raw == clean[i] }, "{i}: {raw}");
        }
    }
}
