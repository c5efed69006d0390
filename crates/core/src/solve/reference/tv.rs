//! The proximal step of anisotropic total variation, in closed form.
//!
//! The Haar "TV prox" of the published code (one level of cycle-spinning Haar shrinkage along each axis) is, exactly,
//! tv(x)ᵢ = xᵢ + (1/4d) Σ_axes (fᵢ − fᵢ₋₁) with fᵢ = clip(xᵢ₊₁ − xᵢ, ±4d·τ·w_axis), circular along every axis, d = 3 axes:
//! one fused stencil, any length.

use crate::image::Size;

/// 4 × the number of axes.
const SPREAD: f32 = 12.0;

/// Prox weights: how strongly each axis is smoothed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Thresholds {
    /// τ·w along rows and columns.
    pub(super) spatial: f32,
    /// τ·w along the polarization axis.
    pub(super) polarization: f32,
}

/// Calls `store(index, tv(x)[index])` for every value of x = `[count, height, width]`.
pub(super) fn haar_3d(x: &[f32], count: usize, size: Size, t: Thresholds, mut store: impl FnMut(usize, f32)) {
    let (n, Size { width, height }) = (size.pixels(), size);
    let (ts, tp) = (SPREAD * t.spatial, SPREAD * t.polarization);
    for p in 0..count {
        let (next_p, previous_p) = ((p + 1) % count, (p + count - 1) % count);
        for y in 0..height {
            let row = |p: usize, y: usize| &x[p * n + y * width..][..width];
            let (here, up, down) = (row(p, y), row(p, (y + height - 1) % height), row(p, (y + 1) % height));
            let (before, after) = (row(previous_p, y), row(next_p, y));
            for i in 0..width {
                let v = here[i];
                let flow = |a: f32, t: f32| a.clamp(-t, t);
                let left = here[if i == 0 { width - 1 } else { i - 1 }];
                let right = here[if i + 1 == width { 0 } else { i + 1 }];
                let sum = flow(right - v, ts) - flow(v - left, ts) + flow(down[i] - v, ts) - flow(v - up[i], ts)
                    + flow(after[i] - v, tp)
                    - flow(v - before[i], tp);
                store(p * n + y * width + i, v + sum / SPREAD);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition: for each axis and each of the two alignments of Haar pairs, shrink the difference of a pair softly
    /// and keep its mean; average over all 2·d reconstructions. Soft threshold of (a−b)/√2 at √2·d·2τ... derived per pair:
    /// the half difference h = (b − a)/2 becomes sign(h)·max(|h| − 2dτ, 0).
    fn by_definition(x: &[f64], dims: [usize; 3], t: [f64; 3]) -> Vec<f64> {
        let strides = [dims[1] * dims[2], dims[2], 1];
        let mut out = vec![0.0; x.len()];
        for axis in 0..3 {
            for i in 0..x.len() {
                let at = i / strides[axis] % dims[axis];
                let neighbour = |step: usize| i - at * strides[axis] + (at + step) % dims[axis] * strides[axis];
                // Pair (i, i+1) in one alignment, (i−1, i) in the other.
                for j in [neighbour(1), neighbour(dims[axis] - 1)] {
                    let (mean, half) = (0.5 * (x[i] + x[j]), 0.5 * (x[i] - x[j]));
                    out[i] += mean + half.signum() * (half.abs() - 6.0 * t[axis]).max(0.0);
                }
            }
        }
        out.iter().map(|v| v / 6.0).collect()
    }

    #[test]
    fn the_closed_form_is_the_haar_definition() {
        let mut seed = 5u32;
        let mut random = || {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(seed >> 8) / f64::from(1 << 24) - 0.5
        };
        for (p, size) in [(4, Size::new(7, 5)), (3, Size::new(4, 1)), (1, Size::new(9, 8))] {
            let x: Vec<f64> = (0..p * size.pixels()).map(|_| random()).collect();
            let x32: Vec<f32> = x.iter().map(|v| *v as f32).collect();
            let mut got = vec![f32::NAN; x.len()];
            let t = Thresholds { spatial: 0.02, polarization: 0.05 };
            haar_3d(&x32, p, size, t, |i, v| got[i] = v);
            let want = by_definition(&x, [p, size.height, size.width], [0.05, 0.02, 0.02]);
            for (g, w) in got.iter().zip(&want) {
                assert!((f64::from(*g) - w).abs() < 1e-6, "{g} {w}");
            }
        }
    }
}
