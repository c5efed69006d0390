//! Noise of readings, measured in the frame itself.

use super::Size;

/// Samples a quantile is taken from, at most.
pub const SAMPLES: usize = 8192;

/// Standard deviation of the readings' noise, in their unit; 0 for an image of fewer than five rows of one kind.
///
/// It comes from fourth differences along columns, of readings `row_period` rows apart: the mask repeats after so many rows
/// ([`Response::row_period`](crate::optics::Response::row_period)) and a blurred image is smooth, so that little but noise
/// remains. Their median is taken, to which few dead pixels and edges do not matter. Readings of weight 0 are left out.
/// `samples` is scratch, of at most [`SAMPLES`] values.
pub fn reading_noise(y: &[f32], weight: &[f32], size: Size, row_period: usize, samples: &mut Vec<f32>) -> f32 {
    let Size { width, height } = size;
    if height <= 4 * row_period {
        return 0.0;
    }
    let at = |i: usize| {
        let column = [0, 1, 2, 3, 4].map(|k| i + k * row_period * width);
        let trusted = column.iter().all(|&i| weight[i] > 0.0);
        trusted.then(|| {
            let [a, b, c, d, e] = column.map(|i| y[i]);
            (a - 4.0 * b + 6.0 * c - 4.0 * d + e).abs()
        })
    };
    // 70 = 1 + 16 + 36 + 16 + 1; 0.6745 is the median of |N(0, 1)|.
    quantile((height - 4 * row_period) * width, 0.5, at, samples) / (0.6745 * 70f32.sqrt())
}

/// The `q` quantile of the values that `at` gives for evenly spaced indices below `count`; 0 if there are none.
pub(crate) fn quantile(count: usize, q: f64, at: impl Fn(usize) -> Option<f32>, samples: &mut Vec<f32>) -> f32 {
    samples.clear();
    // A step without common factors with the width visits all columns.
    let step = (count / SAMPLES).max(1) | 1;
    samples.extend((0..count).step_by(step).filter_map(at).filter(|v| v.is_finite()).take(SAMPLES));
    if samples.is_empty() {
        return 0.0;
    }
    let rank = ((samples.len() - 1) as f64 * q) as usize;
    *samples.select_nth_unstable_by(rank, f32::total_cmp).1
}

/// Normal noise for tests: a sum of twelve uniforms.
#[cfg(test)]
pub(crate) fn normal(n: usize, sigma: f32, seed: u32) -> Vec<f32> {
    let mut s = seed;
    let mut uniform = || {
        s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (s >> 8) as f32 / (1 << 24) as f32
    };
    (0..n).map(|_| sigma * ((0..12).map(|_| uniform()).sum::<f32>() - 6.0)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_measured_under_smooth_light_and_stripes_and_dead_pixels() {
        let size = Size::new(120, 90);
        let mut y = normal(size.pixels(), 0.003, 9);
        let mut weight = vec![1.0; y.len()];
        for (i, v) in y.iter_mut().enumerate() {
            *v += 0.2 + 0.1 * ((i / 120) as f32 * 0.05).sin() + if i % 120 / 8 % 2 == 0 { 0.2 } else { 0.0 };
            if i % 11 == 0 {
                (*v, weight[i]) = (0.0, 0.0);
            }
        }
        let sigma = reading_noise(&y, &weight, size, 1, &mut Vec::new());
        assert!((sigma - 0.003).abs() < 2e-4, "{sigma}");
    }
}
