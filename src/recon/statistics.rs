//! What a frame says about itself: noise of the readings, noise of the guide, edges of the guide.

use crate::plane::Size;

/// Samples a quantile is taken from, at most.
pub(super) const SAMPLES: usize = 8192;

/// Standard deviation of the readings' noise from fourth differences along columns: stripes run along columns and a blurred
/// image is smooth, so little else survives. The median makes dead pixels and edges harmless. Differences with an untrusted
/// reading are left out. `samples` are garbage afterwards.
pub(super) fn reading_noise(y: &[f32], weight: &[f32], size: Size, samples: &mut Vec<f32>) -> f32 {
    let Size { width, height } = size;
    if height < 5 {
        return 0.0;
    }
    let at = |i: usize| {
        let column = [0, 1, 2, 3, 4].map(|k| i + k * width);
        let trusted = column.iter().all(|&i| weight[i] > 0.0);
        trusted.then(|| {
            let [a, b, c, d, e] = column.map(|i| y[i]);
            (a - 4.0 * b + 6.0 * c - 4.0 * d + e).abs()
        })
    };
    // 70 = 1 + 16 + 36 + 16 + 1; 0.6745 is the median of |N(0, 1)|.
    quantile((height - 4) * width, 0.5, at, samples) / (0.6745 * 70f32.sqrt())
}

/// Standard deviation of the guide's noise from diagonal differences of 2×2 cells; the 20 % quantile, so that texture hardly
/// counts.
pub(super) fn guide_noise(g: &[f32], size: Size, samples: &mut Vec<f32>) -> f32 {
    let (width, cells) = (size.width, Size::new(size.width / 2, size.height / 2));
    let at = |cell: usize| {
        let i = cell / cells.width * 2 * width + cell % cells.width * 2;
        Some(0.5 * (g[i] - g[i + 1] - g[i + width] + g[i + width + 1]).abs())
    };
    // 0.2533 is the 20 % quantile of |N(0, 1)|.
    quantile(cells.pixels(), 0.2, at, samples) / 0.2533
}

/// The `q` quantile of the values that `at` gives for evenly spaced indices below `count`; 0 if there are none.
fn quantile(count: usize, q: f64, at: impl Fn(usize) -> Option<f32>, samples: &mut Vec<f32>) -> f32 {
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

/// Weights in (0, 1] of the TV of an image beside its guide: 1/(1 + |∇ḡ|/κ) with ḡ the guide averaged over 3×3, in units of
/// `scale`.
pub(super) fn edge_weights(g: &[f32], size: Size, scale: f32, kappa: f32, weights: &mut [f32]) {
    let Size { width, height } = size;
    let sum3 = |y: usize, x: usize| {
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        let count = (rows.len() * columns.len()) as f32;
        rows.map(|y| g[y * width..][columns.clone()].iter().sum::<f32>()).sum::<f32>() / count
    };
    let share = 1.0 / (scale * kappa).max(f32::MIN_POSITIVE);
    // The means go into `weights` first; a row of weights needs only its own means and the next row's.
    for (i, w) in weights.iter_mut().enumerate() {
        *w = sum3(i / width, i % width);
    }
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let here = weights[i];
            let right = if x + 1 < width { weights[i + 1] - here } else { 0.0 };
            let below = if y + 1 < height { weights[i + width] - here } else { 0.0 };
            weights[i] = 1.0 / (1.0 + right.hypot(below) * share);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(n: usize, sigma: f32) -> Vec<f32> {
        let mut s = 9u32;
        let mut uniform = || {
            s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (s >> 8) as f32 / (1 << 24) as f32
        };
        // Twelve uniforms make a normal.
        (0..n).map(|_| sigma * ((0..12).map(|_| uniform()).sum::<f32>() - 6.0)).collect()
    }

    #[test]
    fn noise_is_measured_under_smooth_light_and_stripes_and_dead_pixels() {
        let size = Size::new(120, 90);
        let mut y = noise(size.pixels(), 0.003);
        let mut weight = vec![1.0; y.len()];
        for (i, v) in y.iter_mut().enumerate() {
            *v += 0.2 + 0.1 * ((i / 120) as f32 * 0.05).sin() + if i % 120 / 8 % 2 == 0 { 0.2 } else { 0.0 };
            if i % 11 == 0 {
                (*v, weight[i]) = (0.0, 0.0);
            }
        }
        let sigma = reading_noise(&y, &weight, size, &mut Vec::new());
        assert!((sigma - 0.003).abs() < 2e-4, "{sigma}");
        let mut g = noise(size.pixels(), 0.01);
        g.iter_mut().enumerate().for_each(|(i, v)| *v += if i % 120 > 60 { 0.8 } else { 0.1 });
        let sigma = guide_noise(&g, size, &mut Vec::new());
        assert!((sigma - 0.01).abs() < 1e-3, "{sigma}");
    }

    #[test]
    fn edges_lower_the_weight_and_flat_areas_keep_it() {
        let size = Size::new(12, 4);
        let g: Vec<f32> = (0..48).map(|i| if i % 12 < 6 { 0.2 } else { 1.2 }).collect();
        let mut w = vec![f32::NAN; 48];
        edge_weights(&g, size, 1.0, 0.01, &mut w);
        assert_eq!((w[1], w[10]), (1.0, 1.0));
        assert!(w[5] < 0.05);
    }
}
