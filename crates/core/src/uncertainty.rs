//! Standard errors of a result, estimated from the result itself: σ of S0, S1 and S2 for each pixel, and of DoLP and AoLP from them.
//!
//! The variance of a pixel is a non-negative sum of five local quantities: the residual of the frame squared, the energy of fine
//! polarization, the energy of fine intensity, the geometric mean of both, and the energy of the light. Energies are means over 5 × 5
//! pixels. All terms are quadratic in the unit of the readings, so σ scales with exposure. Constants come from
//! `scripts/fit_error_bars.py`; there is one set for frames with a guide and one for frames without.
//!
//! σ of S1 and of S2 are equal. Errors that leave no trace in the result, such as a wrong order of the mask's angles, are not seen.
//!
//! Allocation: a workspace is allocated with its plan; estimates allocate nothing.

use crate::image::{Buffers, Size, Stack};
use crate::polarization::dolp;
use crate::solve::Modelled;

/// Pixels on each side of a pixel over which energies are averaged.
const AVERAGED: usize = 2;
/// Pixels on each side over which the mean is taken off: fine and less fine detail.
const FINE: usize = 1;
const COARSE: usize = 3;

/// Share of each term in the variance.
struct Constants {
    noise: f32,
    polarization: f32,
    mixed: f32,
    intensity: f32,
    light: f32,
}

/// S0 of a guide: its error is the guide's.
const GUIDED_S0: Constants =
    Constants { noise: 0.31, polarization: 3.91e-5, mixed: 9.61e-3, intensity: 6.03e-2, light: 2.16e-5 };
const GUIDED_S12: Constants =
    Constants { noise: 0.833, polarization: 0.359, mixed: 0.569, intensity: 6.01e-2, light: 9.46e-5 };
const UNGUIDED_S0: Constants =
    Constants { noise: 54.5, polarization: 4.03e-3, mixed: 7.7, intensity: 7.41, light: 5.75e-9 };
const UNGUIDED_S12: Constants =
    Constants { noise: 12.5, polarization: 10.4, mixed: 0.176, intensity: 0.168, light: 8.79e-5 };

impl Constants {
    /// σ from the squared residual and the energies of polarization, of coarse and fine intensity, and of the light.
    #[inline]
    fn sigma(&self, noise: f32, [polarization, coarse, fine, light]: [f32; 4]) -> f32 {
        let mixed = (polarization * coarse).sqrt();
        let variance = self.noise * noise
            + self.polarization * polarization
            + self.mixed * mixed
            + self.intensity * fine
            + self.light * light;
        variance.sqrt()
    }
}

/// Medians of the standard errors over the valid pixels of all channels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Summary {
    /// σ of S1 and S2, fractions of full scale.
    pub polarization: f32,
    /// σ of the DoLP.
    pub dolp: f32,
}

/// Working memory of an estimate.
#[derive(Debug)]
pub struct Workspace {
    /// Local means, and a second plane of them.
    means: [Vec<f32>; 2],
    /// Energies of polarization, coarse intensity and fine intensity.
    energies: [Vec<f32>; 3],
    /// Column sums of one row.
    columns: Vec<f32>,
}

impl Workspace {
    /// The working memory for planes of `size`, made or counted by `buffers`.
    pub fn new(buffers: &mut Buffers, size: Size) -> Self {
        let n = size.pixels();
        Self {
            means: [(); 2].map(|()| buffers.filled(0.0, n)),
            energies: [(); 3].map(|()| buffers.filled(0.0, n)),
            columns: buffers.filled(0.0, size.width),
        }
    }

    /// Estimates σ of each plane of `stokes`, `[C, 3, H, W]`, or `[C, 1, H, W]` where `channels` says that S0 is alone. `residual` is the
    /// root mean square residual of the frame. Both images in fractions of full scale. Allocates nothing.
    pub fn estimate(
        &mut self,
        stokes: &Stack<f32>,
        channels: usize,
        modelled: Modelled,
        residual: f32,
        errors: &mut Stack<f32>,
    ) {
        let guided = matches!(modelled, Modelled::Nothing | Modelled::Polarized | Modelled::Shared);
        let [of_s0, of_s12] = if guided { [GUIDED_S0, GUIDED_S12] } else { [UNGUIDED_S0, UNGUIDED_S12] };
        let (n, noise, planes) = (stokes.size().pixels(), residual * residual, stokes.count() / channels);
        let pairs = stokes.as_slice().chunks_exact(planes * n).zip(errors.as_mut_slice().chunks_exact_mut(planes * n));
        for (stokes, errors) in pairs {
            self.energies_of(stokes, errors.len() / planes);
            let [polarization, coarse, fine] = &self.energies;
            let light = &self.means[1];
            let (s0, rest) = errors.split_at_mut(n);
            for (i, s0) in s0.iter_mut().enumerate() {
                let local = [polarization[i], coarse[i], fine[i], light[i]];
                *s0 = of_s0.sigma(noise, local);
                if let Some(s1) = rest.get_mut(i) {
                    *s1 = of_s12.sigma(noise, local);
                }
            }
            if planes == 3 {
                rest.copy_within(..n, n);
            }
        }
    }

    /// Local energies of one channel; that of the light is left in the second plane of means.
    fn energies_of(&mut self, stokes: &[f32], n: usize) {
        let Self { means: [first, second], energies: [polarization, coarse, fine], columns } = self;
        let (s0, rest) = stokes.split_at(n);
        first.fill(0.0);
        for plane in rest.chunks_exact(n) {
            local_mean(plane, COARSE, columns, second);
            first.iter_mut().zip(plane.iter().zip(&*second)).for_each(|(sum, (x, mean))| *sum += (x - mean).powi(2));
        }
        local_mean(first, AVERAGED, columns, polarization);
        for (radius, energy) in [(COARSE, coarse), (FINE, fine)] {
            local_mean(s0, radius, columns, first);
            first.iter_mut().zip(s0).for_each(|(mean, x)| *mean = (x - *mean).powi(2));
            local_mean(first, AVERAGED, columns, energy);
        }
        first.iter_mut().zip(s0).for_each(|(square, x)| *square = x * x);
        local_mean(first, AVERAGED, columns, second);
    }

    /// Medians over the valid pixels, of one channel in turn at each pixel; none without polarization or valid pixels. Allocates nothing.
    pub fn summarize(&mut self, stokes: &Stack<f32>, errors: &Stack<f32>, valid: &[bool]) -> Option<Summary> {
        let channels = stokes.count() / 3;
        if channels == 0 || !stokes.count().is_multiple_of(3) {
            return None;
        }
        let [polarization, degree] = &mut self.means;
        let mut count = 0;
        for i in (0..valid.len()).filter(|i| valid[*i]) {
            let at = |image: &Stack<f32>| [0, 1, 2].map(|k| image.plane(i % channels * 3 + k)[i]);
            let (stokes, errors) = (at(stokes), at(errors));
            (polarization[count], degree[count]) = (errors[1], dolp_error(stokes, errors));
            count += 1;
        }
        let median = |values: &mut [f32]| Some(*values.select_nth_unstable_by(values.len() / 2, f32::total_cmp).1);
        (count > 0).then_some(())?;
        Some(Summary { polarization: median(&mut polarization[..count])?, dolp: median(&mut degree[..count])? })
    }
}

/// Means over squares of 2·`radius` + 1 pixels a side, of the part that lies within the image. `columns` holds one row.
fn local_mean(image: &[f32], radius: usize, columns: &mut [f32], out: &mut [f32]) {
    let width = columns.len();
    let height = image.len() / width;
    let span = |i: usize, n: usize| i.saturating_sub(radius)..(i + radius + 1).min(n);
    for (y, out) in out.chunks_exact_mut(width).enumerate() {
        let rows = span(y, height);
        columns.fill(0.0);
        for row in image[rows.start * width..rows.end * width].chunks_exact(width) {
            columns.iter_mut().zip(row).for_each(|(sum, x)| *sum += x);
        }
        let scale = 1.0 / rows.len() as f32;
        for (x, out) in out.iter_mut().enumerate() {
            let near = &columns[span(x, width)];
            *out = near.iter().sum::<f32>() * scale / near.len() as f32;
        }
    }
}

/// S0, S1 and S2 of pixel `i`, summed over the channels, and their σ. Channels have noise of their own, so the squares of σ add up.
///
/// # Panics
/// For images without S1 and S2, of different shapes, or without a pixel `i`.
pub fn summed(stokes: &Stack<f32>, errors: &Stack<f32>, i: usize) -> [[f32; 3]; 2] {
    assert!(stokes.count().is_multiple_of(3) && stokes.count() == errors.count(), "S0, S1 and S2 with their errors");
    let channels = || (0..stokes.count()).step_by(3);
    let sum = |k: usize| channels().map(|c| stokes.plane(c + k)[i]).sum();
    let error = |k: usize| channels().map(|c| errors.plane(c + k)[i].powi(2)).sum::<f32>().sqrt();
    [[0, 1, 2].map(sum), [0, 1, 2].map(error)]
}

/// σ of the length of (S1, S2), to first order; where the length is 0, the root mean square of both σ.
fn length_error([_, s1, s2]: [f32; 3], [_, e1, e2]: [f32; 3]) -> f32 {
    let length = s1.hypot(s2);
    if length > 0.0 { (s1 * e1).hypot(s2 * e2) / length } else { e1.hypot(e2) * std::f32::consts::FRAC_1_SQRT_2 }
}

/// σ of the DoLP of one pixel, by propagation of the σ `errors` of its `stokes`, to first order. 0 where S0 ≤ 0, as
/// [`dolp`] is there.
///
/// ```
/// let error = stokescope_core::uncertainty::dolp_error([1.0, 0.5, 0.0], [0.0, 0.02, 0.02]);
/// assert!((error - 0.02).abs() < 1e-6);
/// ```
#[inline]
pub fn dolp_error(stokes: [f32; 3], errors: [f32; 3]) -> f32 {
    let [s0, s1, s2] = stokes;
    if s0 > 0.0 { length_error(stokes, errors).hypot(dolp(s0, s1, s2) * errors[0]) / s0 } else { 0.0 }
}

/// σ of the AoLP of one pixel in degrees, by propagation of the σ `errors` of its `stokes`, to first order; none where √(S1² + S2²)
/// is not above its σ, where the angle means nothing.
///
/// ```
/// use stokescope_core::uncertainty::aolp_error_degrees;
/// let error = aolp_error_degrees([1.0, 0.5, 0.0], [0.0, 0.02, 0.02]).unwrap();
/// assert!((error - (0.5f32 * 0.04).to_degrees()).abs() < 1e-4);
/// assert_eq!(aolp_error_degrees([1.0, 0.01, 0.0], [0.0, 0.02, 0.02]), None);
/// ```
#[inline]
pub fn aolp_error_degrees(stokes: [f32; 3], errors: [f32; 3]) -> Option<f32> {
    let ([_, s1, s2], [_, e1, e2]) = (stokes, errors);
    let length = s1.hypot(s2);
    (length > length_error(stokes, errors)).then(|| (0.5 * (s2 * e1).hypot(s1 * e2) / (length * length)).to_degrees())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(31, 23);

    fn workspace() -> Workspace {
        Buffers::allocate(|buffers| Workspace::new(buffers, SIZE))
    }

    /// S0, S1, S2 with detail in every plane.
    fn scene(scale: f32) -> Stack<f32> {
        let value = |i: usize| scale * (0.3 + 0.1 * ((i * i) % 17) as f32 / 17.0);
        Stack::from_vec(3, SIZE, (0..3 * SIZE.pixels()).map(value).collect()).unwrap()
    }

    fn estimate(stokes: &Stack<f32>, modelled: Modelled, residual: f32) -> Stack<f32> {
        let mut errors = Stack::zeros(stokes.count(), SIZE);
        workspace().estimate(stokes, stokes.count().div_ceil(3), modelled, residual, &mut errors);
        errors
    }

    #[test]
    fn local_means_are_those_of_the_part_within_the_image() {
        let image: Vec<f32> = (0..12).map(|i| i as f32).collect();
        let (mut columns, mut out) = (vec![0.0; 4], vec![0.0; 12]);
        local_mean(&image, 1, &mut columns, &mut out);
        assert!((out[0] - 2.5).abs() < 1e-6 && (out[5] - 5.0).abs() < 1e-6 && (out[11] - 8.5).abs() < 1e-6, "{out:?}");
    }

    #[test]
    fn errors_scale_with_the_exposure() {
        let (one, two) = (scene(1.0), scene(2.0));
        for modelled in [Modelled::Polarized, Modelled::Both] {
            let (a, b) = (estimate(&one, modelled, 0.002), estimate(&two, modelled, 0.004));
            assert!(a.as_slice().iter().zip(b.as_slice()).all(|(a, b)| *a > 0.0 && (b / a - 2.0).abs() < 1e-3));
        }
    }

    #[test]
    fn noise_and_a_missing_guide_make_errors_larger() {
        let stokes = scene(1.0);
        let base = estimate(&stokes, Modelled::Polarized, 0.002);
        for worse in [estimate(&stokes, Modelled::Polarized, 0.1), estimate(&stokes, Modelled::Both, 0.002)] {
            assert!(base.as_slice().iter().zip(worse.as_slice()).all(|(a, b)| b > a));
        }
    }

    #[test]
    fn a_scene_without_polarization_files_has_the_error_of_s0_alone() {
        let s0 = Stack::from_vec(1, SIZE, scene(1.0).plane(0).to_vec()).unwrap();
        let errors = estimate(&s0, Modelled::Intensity, 0.002);
        assert!(errors.count() == 1 && errors.as_slice().iter().all(|e| *e > 0.0));
        assert_eq!(workspace().summarize(&s0, &errors, &[true; 31 * 23]), None);
    }

    #[test]
    fn sums_over_channels_have_errors_of_independent_channels() {
        let value = |k: usize| [1.0, 0.5, 0.0, 3.0, 0.5, 1.0][k % 6];
        let error = |k: usize| if k < 3 { 0.3 } else { 0.4 };
        let image = |of: &dyn Fn(usize) -> f32| Stack::from_vec(6, Size::new(1, 1), (0..6).map(of).collect()).unwrap();
        assert_eq!(summed(&image(&value), &image(&error), 0), [[4.0, 1.0, 1.0], [0.5; 3]]);
    }

    #[test]
    fn medians_are_those_of_the_valid_pixels() {
        let (mut stokes, mut errors) = (Stack::zeros(3, SIZE), Stack::zeros(3, SIZE));
        stokes.plane_mut(0).fill(2.0);
        stokes.plane_mut(1).fill(1.0);
        (1..3).for_each(|k| errors.plane_mut(k).fill(0.1));
        let mut valid = vec![false; SIZE.pixels()];
        assert_eq!(workspace().summarize(&stokes, &errors, &valid), None);
        (1..3).for_each(|k| errors.plane_mut(k)[5] = 0.4);
        valid[5] = true;
        assert_eq!(workspace().summarize(&stokes, &errors, &valid), Some(Summary { polarization: 0.4, dolp: 0.2 }));
    }
}
