//! Linear polarization of images: angles, Stokes components, degree and angle of polarization, and their colours.
//!
//! S = pinv(½[1, cos 2θ, sin 2θ])·I, least squares over the polarizer angles; I_θ = ½(S0 + S1 cos 2θ + S2 sin 2θ).
//! Stokes images are `[C, 3, H, W]` and angle images `[C, P, H, W]`, f32, in the units of the input. [`dolp`] and [`aolp_degrees`] give
//! the degree and the angle of linear polarization of one pixel.
//!
//! Allocation: a [`Plan`] allocates when it is made; conversions do not.
//!
//! ```
//! use stokescope_core::polarization::{Angle, Plan};
//! let plan = Plan::new(&Angle::four());
//! let (mut stokes, mut angles) = ([0.0; 3], [0.0; 4]);
//! plan.to_stokes(&[1.0, 0.5, 0.0, 0.5], &mut stokes, 1);
//! plan.to_angles(&stokes, &mut angles, 1);
//! assert!((stokes[1] - 1.0).abs() < 1e-6 && (angles[1] - 0.5).abs() < 1e-6);
//! ```

mod angle;
pub mod color;
mod stokes;

pub use angle::Angle;
pub use stokes::{aolp_degrees, dolp, least_intensity};

use nalgebra::DMatrix;

use crate::image::Stack;

/// Conversions between Stokes images and angle images for one list of angles.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Weights of each Stokes component in each angle: ½(1, cos 2θ, sin 2θ).
    analyze: Vec<[f32; 3]>,
    /// Weights of each angle in each Stokes component.
    fit: Vec<[f32; 3]>,
}

impl Plan {
    /// The conversions for `angles`. Allocates.
    pub fn new(angles: &[Angle]) -> Self {
        let fit = stokes_from_angles(angles);
        Self {
            analyze: angles.iter().map(|a| a.analyzer()).collect(),
            fit: (0..angles.len()).map(|p| [0, 1, 2].map(|k| fit[(k, p)] as f32)).collect(),
        }
    }

    /// Stokes `[3, pixels]` of one channel → intensities `[P, pixels]`.
    pub fn to_angles(&self, stokes: &[f32], angles: &mut [f32], pixels: usize) {
        combine(&self.analyze, stokes, pixels, |p, i, v| angles[p * pixels + i] = v);
    }

    /// Intensities `[P, pixels]` of one channel → Stokes `[3, pixels]`, least squares.
    pub fn to_stokes(&self, angles: &[f32], stokes: &mut [f32], pixels: usize) {
        stokes.fill(0.0);
        for (plane, fit) in angles.chunks_exact(pixels).zip(&self.fit) {
            for (k, out) in stokes.chunks_exact_mut(pixels).enumerate() {
                out.iter_mut().zip(plane).for_each(|(s, v)| *s += fit[k] * v);
            }
        }
    }

    /// As [`Self::to_angles`], for every channel: Stokes `[C, 3, H, W]` → intensities `[C, P, H, W]`.
    pub fn to_angle_images(&self, stokes: &Stack<f32>, angles: &mut Stack<f32>) {
        let (n, p) = (stokes.size().pixels(), self.fit.len());
        let channels = stokes.as_slice().chunks_exact(3 * n).zip(angles.as_mut_slice().chunks_exact_mut(p * n));
        channels.for_each(|(stokes, angles)| self.to_angles(stokes, angles, n));
    }

    /// As [`Self::to_stokes`], for every channel: intensities `[C, P, H, W]` → Stokes `[C, 3, H, W]`.
    pub fn to_stokes_images(&self, angles: &Stack<f32>, stokes: &mut Stack<f32>) {
        let (n, p) = (angles.size().pixels(), self.fit.len());
        let channels = angles.as_slice().chunks_exact(p * n).zip(stokes.as_mut_slice().chunks_exact_mut(3 * n));
        channels.for_each(|(angles, stokes)| self.to_stokes(angles, stokes, n));
    }
}

/// Least-squares Stokes vector from intensities behind ideal polarizers: pinv(½[1, cos 2θ, sin 2θ]), a 3 × P matrix.
pub fn stokes_from_angles(angles: &[Angle]) -> DMatrix<f64> {
    if angles.is_empty() {
        return DMatrix::zeros(3, 0);
    }
    let rows = DMatrix::from_fn(angles.len(), 3, |p, k| 0.5 * [1.0, angles[p].cos2(), angles[p].sin2()][k]);
    // With ε ≥ 0 the pseudo-inverse exists for every matrix.
    rows.pseudo_inverse(1e-9).unwrap_or_else(|_| DMatrix::zeros(3, angles.len()))
}

fn combine(rows: &[[f32; 3]], stokes: &[f32], pixels: usize, mut store: impl FnMut(usize, usize, f32)) {
    let (s0, rest) = stokes.split_at(pixels);
    let (s1, s2) = rest.split_at(pixels);
    for (p, [a, b, c]) in rows.iter().enumerate() {
        for i in 0..pixels {
            store(p, i, a * s0[i] + b * s1[i] + c * s2[i]);
        }
    }
}

/// Mean DoLP over the valid pixels of Stokes `[C, 3, pixels]`, each limited to 1; none when no pixel is valid.
pub fn mean_dolp(stokes: &[f32], valid: &[bool]) -> Option<f32> {
    let pixels = valid.len();
    let (mut sum, mut count) = (0.0f64, 0usize);
    for channel in stokes.chunks_exact(3 * pixels) {
        for (i, _) in valid.iter().enumerate().filter(|(_, v)| **v) {
            sum += f64::from(dolp(channel[i], channel[pixels + i], channel[2 * pixels + i]).min(1.0));
            count += 1;
        }
    }
    (count > 0).then(|| (sum / count as f64) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stokes_survive_the_way_through_any_three_or_more_angles() {
        for degrees in [&[0.0, 45.0, 90.0][..], &[0.0, 45.0, 90.0, 135.0], &[7.0, 60.0, 100.0, 131.0, 160.0]] {
            let plan = Plan::new(&degrees.iter().copied().map(Angle::from_degrees).collect::<Vec<_>>());
            let stokes = [0.5, 1.0, -0.2, 0.4, 0.3, -0.9];
            let (mut angles, mut back) = (vec![0.0; 2 * degrees.len()], [0.0; 6]);
            plan.to_angles(&stokes, &mut angles, 2);
            plan.to_stokes(&angles, &mut back, 2);
            for (a, b) in stokes.iter().zip(&back) {
                assert!((a - b).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn the_mean_dolp_counts_valid_pixels_only() {
        let stokes = [1.0, 1.0, 0.5, 0.9, 0.0, 0.0];
        assert_eq!(mean_dolp(&stokes, &[true, false]), Some(0.5));
        assert_eq!(mean_dolp(&stokes, &[false, false]), None);
    }
}
