//! What a guide says about itself: its noise and its edges.

use crate::plane::Size;
use crate::plane::noise::quantile;

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
    use crate::plane::noise::normal;

    #[test]
    fn noise_is_measured_across_an_edge() {
        let size = Size::new(120, 90);
        let mut g = normal(size.pixels(), 0.01, 9);
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
