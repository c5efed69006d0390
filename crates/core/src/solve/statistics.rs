//! Noise and edges of a guide, norms of images.

use crate::image::Size;
use crate::image::noise::quantile;

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
    let share = 1.0 / (scale * kappa).max(f32::MIN_POSITIVE);
    // The means go into `weights` first; a row of weights needs only its own means and the next row's.
    for (y, means) in weights.chunks_exact_mut(width).enumerate() {
        let rows = y.saturating_sub(1)..(y + 2).min(height);
        let count = rows.len() as f32;
        means.fill(0.0);
        for row in rows {
            means.iter_mut().zip(&g[row * width..]).for_each(|(sum, v)| *sum += v);
        }
        let mut before = 0.0;
        for x in 0..width {
            let (here, after) = (means[x], means.get(x + 1).copied().unwrap_or(0.0));
            let columns = (x + 2).min(width) - x.saturating_sub(1);
            means[x] = (before + here + after) / (count * columns as f32);
            before = here;
        }
    }
    let weight = |right: f32, below: f32| 1.0 / (1.0 + (right * right + below * below).sqrt() * share);
    for y in 0..height {
        let (here, next) = weights[y * width..].split_at_mut(width);
        let last = here[width - 1];
        for x in 0..width - 1 {
            let below = next.get(x).map_or(0.0, |next| next - here[x]);
            here[x] = weight(here[x + 1] - here[x], below);
        }
        here[width - 1] = weight(0.0, next.get(width - 1).map_or(0.0, |next| next - last));
    }
}

/// Root mean square.
pub(super) fn rms(values: &[f32]) -> f32 {
    (dot(values, values) / values.len() as f64).sqrt() as f32
}

/// Inner product, summed in f64.
pub(super) fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::noise::normal;

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
