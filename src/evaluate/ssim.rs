use stokescope_core::image::Size;

/// Side of the window in pixels.
pub(super) const WINDOW: usize = 11;

/// Mean structural similarity of two images with peak 1, over all positions where the whole window fits.
///
/// Wang, Bovik, Sheikh, Simoncelli, Image quality assessment, 2004, eq. 13 with K1 = 0.01, K2 = 0.03 and an 11×11 Gaussian window
/// of σ 1.5.
pub(super) fn ssim(size: Size, a: &[f64], b: &[f64]) -> f64 {
    let window = window();
    let mean = |of: &dyn Fn(f64, f64) -> f64| {
        let values: Vec<f64> = a.iter().zip(b).map(|(&a, &b)| of(a, b)).collect();
        weighted(size, &values, &window)
    };
    let (mean_a, mean_b) = (mean(&|a, _| a), mean(&|_, b| b));
    let (aa, bb, ab) = (mean(&|a, _| a * a), mean(&|_, b| b * b), mean(&|a, b| a * b));
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let at = |i: usize| {
        let (ma, mb) = (mean_a[i], mean_b[i]);
        let (va, vb, cov) = (aa[i] - ma * ma, bb[i] - mb * mb, ab[i] - ma * mb);
        (2.0 * ma * mb + c1) * (2.0 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))
    };
    (0..mean_a.len()).map(at).sum::<f64>() / mean_a.len() as f64
}

fn window() -> [f64; WINDOW] {
    let raw: [f64; WINDOW] = std::array::from_fn(|i| (-(i as f64 - 5.0).powi(2) / (2.0 * 1.5 * 1.5)).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|w| w / sum)
}

/// Weighted means over every window that fits, computed along rows, then along columns.
fn weighted(size: Size, values: &[f64], window: &[f64; WINDOW]) -> Vec<f64> {
    let width = size.width + 1 - WINDOW;
    let sum = |of: &mut dyn Iterator<Item = f64>| of.zip(window).map(|(v, w)| v * w).sum::<f64>();
    let rows: Vec<f64> = values
        .chunks_exact(size.width)
        .flat_map(|row| row.windows(WINDOW).map(|part| sum(&mut part.iter().copied())))
        .collect();
    (0..(size.height + 1 - WINDOW) * width).map(|at| sum(&mut (0..WINDOW).map(|k| rows[at + k * width]))).collect()
}
