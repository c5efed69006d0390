//! Readings of the lensless sensor: counts → fractions of full scale, and which of them to trust.

use super::Unit;
use crate::calibration::Sensor;
use crate::plane::Stack;

/// Equal readings at the very top that make a floating-point frame clipped rather than bright.
const CLIPPED_MIN: usize = 16;

/// Shares of the readings of one frame that are not to be trusted or not worth much, 0 to 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Quality {
    /// At or above saturation; ignored by the solvers.
    pub saturated: f32,
    /// NaN or infinite; ignored by the solvers.
    pub not_finite: f32,
    /// Largest trusted reading, fractions of full scale.
    pub peak: f32,
    /// Mean trusted reading, fractions of full scale.
    pub mean: f32,
    /// Smallest trusted reading, fractions of full scale.
    pub floor: f32,
}

/// Normalizes `values` (`[C, H, W]`) into `raw` and sets `weight` to 1 where a reading can be trusted, else to 0 (and the
/// reading to 0). `dark` is in counts, `white` multiplies the channels.
pub(super) fn normalize(
    values: &Stack<f32>,
    unit: Unit,
    sensor: &Sensor,
    dark: Option<&Stack<f32>>,
    white: [f32; 3],
    raw: &mut Stack<f32>,
    weight: &mut Stack<f32>,
) -> Quality {
    let span = sensor.saturation - sensor.black_level;
    let (scale, offset, limit) = match unit {
        Unit::Counts => (span.recip(), sensor.black_level, sensor.saturation),
        Unit::FullScale => (1.0, 0.0, clipping_level(values.as_slice())),
    };
    let (mut saturated, mut not_finite, mut sum) = (0usize, 0usize, 0.0f64);
    let (mut peak, mut floor) = (f32::NEG_INFINITY, f32::INFINITY);
    for c in 0..values.count() {
        let dark = dark.map(|d| d.plane(c.min(d.count() - 1)));
        let scale = scale * white[c.min(2)];
        let out = raw.plane_mut(c).iter_mut().zip(weight.plane_mut(c));
        for (i, (&v, (r, w))) in values.plane(c).iter().zip(out).enumerate() {
            let dark = match (dark, unit) {
                (None, _) => offset,
                (Some(d), Unit::Counts) => d[i],
                (Some(d), Unit::FullScale) => (d[i] - sensor.black_level) / span,
            };
            let trusted = v.is_finite() && v < limit;
            not_finite += usize::from(!v.is_finite());
            saturated += usize::from(v.is_finite() && v >= limit);
            *w = f32::from(trusted);
            *r = if trusted { (v - dark) * scale } else { 0.0 };
            if trusted {
                sum += f64::from(*r);
                (peak, floor) = (peak.max(*r), floor.min(*r));
            }
        }
    }
    let n = values.as_slice().len();
    let trusted = n - saturated - not_finite;
    let share = |count: usize| count as f32 / n as f32;
    let mean = if trusted > 0 { (sum / trusted as f64) as f32 } else { 0.0 };
    let (peak, floor) = if trusted > 0 { (peak, floor) } else { (0.0, 0.0) };
    Quality { saturated: share(saturated), not_finite: share(not_finite), peak, mean, floor }
}

/// A floating-point frame has no stated full scale, so clipping shows as a plateau: many readings at exactly the maximum,
/// while others lie below. Infinite when there is none.
fn clipping_level(values: &[f32]) -> f32 {
    let finite = || values.iter().copied().filter(|v| v.is_finite());
    let max = finite().fold(f32::NEG_INFINITY, f32::max);
    let plateau = finite().filter(|v| *v == max).count();
    if plateau >= CLIPPED_MIN && max > 0.0 && finite().any(|v| v < max) { max } else { f32::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plane::Size;

    const SENSOR: Sensor = Sensor { size: Size::new(3, 1), channels: 1, black_level: 100.0, saturation: 1100.0 };

    fn run(values: Vec<f32>, unit: Unit, dark: Option<Vec<f32>>) -> (Vec<f32>, Vec<f32>, Quality) {
        let size = Size::new(values.len(), 1);
        let values = Stack::from_vec(1, size, values).unwrap();
        let dark = dark.map(|d| Stack::from_vec(1, size, d).unwrap());
        let (mut raw, mut weight) = (Stack::zeros(1, size), Stack::zeros(1, size));
        let q = normalize(&values, unit, &SENSOR, dark.as_ref(), [1.0; 3], &mut raw, &mut weight);
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
    fn white_balance_multiplies_the_channels_after_black_and_dark() {
        let size = Size::new(2, 1);
        let values = Stack::from_vec(3, size, vec![100.0, 350.0, 100.0, 600.0, 100.0, 1100.0]).unwrap();
        let (mut raw, mut weight) = (Stack::zeros(3, size), Stack::zeros(3, size));
        normalize(&values, Unit::Counts, &SENSOR, None, [2.0, 1.0, 0.5], &mut raw, &mut weight);
        assert_eq!(raw.as_slice(), [0.0, 0.5, 0.0, 0.5, 0.0, 0.0]);
        assert_eq!(weight.as_slice(), [1.0, 1.0, 1.0, 1.0, 1.0, 0.0], "clipping is judged before");
    }
}
