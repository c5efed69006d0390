//! Standard errors of a result, estimated from the result itself: σ of S0, S1 and S2 for each pixel, and of DoLP and AoLP from them.
//!
//! The variance of a pixel is a non-negative sum of five local quantities. With r the residual of the frame, d² the energy of the detail
//! of S0 between one and two pixels, p² that of the polarization, q² that of the light and t² that of the detail of S1 and S2, they are
//! r², r·d·p/q, d·p, d² and t². Errors are largest where there is detail in polarized light: whether polarization follows that detail,
//! the readings hardly tell. Where light from beyond the frame is modelled, the variance has a further factor. All terms are quadratic in
//! the unit of the readings, so σ scales with exposure. Constants come from `scripts/fit_error_bars.py`; there is one set for frames with
//! a guide, one for frames without, and one for those that are interpolated between polarizers on single pixels.
//!
//! σ of S1 and of S2 are equal. Errors that leave no trace in the result, such as a wrong order of the mask's angles, are not seen.
//!
//! Allocation: a workspace is allocated with its plan; estimates allocate nothing.

use crate::image::{Buffers, Size, Stack, local_mean};
use crate::polarization::dolp;
use crate::solve::Modelled;

/// Pixels on each side of a pixel over which S0 is averaged, twice: its detail is the difference of both.
const FINE: usize = 1;
const COARSE: usize = 2;
/// Pixels on each side over which the energy of the detail is averaged, and those of light and polarization.
const DETAIL: usize = 3;
const AREA: usize = 6;

/// Share of each term in the variance, and its factor where light from beyond the frame is modelled.
struct Constants {
    noise: f32,
    degree: f32,
    polarization: f32,
    intensity: f32,
    texture: f32,
    beyond: f32,
}

/// S0 of a guide: its error is the guide's. Fitted to measured scenes alone, whose guides have noise of their own.
const GUIDED_S0: Constants =
    Constants { noise: 0.365, degree: 0.314, polarization: 0.0267, intensity: 0.0169, texture: 0.00482, beyond: 1.26 };
const GUIDED_S12: Constants =
    Constants { noise: 0.117, degree: 18.5, polarization: 0.118, intensity: 0.0, texture: 2.15, beyond: 1.64 };
const UNGUIDED_S0: Constants =
    Constants { noise: 8.39, degree: 0.0592, polarization: 0.103, intensity: 20.0, texture: 5.71, beyond: 1.79 };
const UNGUIDED_S12: Constants =
    Constants { noise: 1.15, degree: 0.155, polarization: 0.101, intensity: 0.0788, texture: 9.85, beyond: 1.35 };
/// Between polarizers on single pixels behind a lens.
const INTERPOLATED_S0: Constants =
    Constants { noise: 3.32, degree: 0.918, polarization: 0.0214, intensity: 0.139, texture: 0.069, beyond: 1.0 };
const INTERPOLATED_S12: Constants =
    Constants { noise: 5.32, degree: 0.309, polarization: 0.0262, intensity: 0.00099, texture: 0.247, beyond: 1.0 };

/// Local quantities of a result.
#[derive(Clone, Copy)]
struct Local {
    /// Energies of the detail of S0, of the polarization, of the light and of the detail of the polarization.
    detail: f32,
    polarization: f32,
    light: f32,
    texture: f32,
}

impl Constants {
    /// σ from the residual and the local quantities. `beyond` says whether light from beyond the frame is modelled.
    #[inline]
    fn sigma(&self, residual: f32, beyond: bool, Local { detail, polarization, light, texture }: Local) -> f32 {
        let both = (detail * polarization).sqrt();
        let degree = if light > 0.0 { residual * both / light.sqrt() } else { 0.0 };
        let variance = self.noise * residual * residual
            + self.degree * degree
            + self.polarization * both
            + self.intensity * detail
            + self.texture * texture;
        (if beyond { self.beyond * variance } else { variance }).sqrt()
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
    /// Local means, and values of which a mean is taken.
    means: [Vec<f32>; 2],
    /// Energies of detail, polarization, light and texture.
    energies: [Vec<f32>; 4],
    /// Column sums of one row.
    columns: Vec<f32>,
}

impl Workspace {
    /// The working memory for planes of `size`, made or counted by `buffers`.
    pub fn new(buffers: &mut Buffers, size: Size) -> Self {
        let n = size.pixels();
        Self {
            means: [(); 2].map(|()| buffers.filled(0.0, n)),
            energies: [(); 4].map(|()| buffers.filled(0.0, n)),
            columns: buffers.filled(0.0, size.width),
        }
    }

    /// Estimates σ of each plane of `stokes`, `[C, 3, H, W]`, or `[C, 1, H, W]` where `channels` says that S0 is alone. `residual` is the
    /// root mean square residual of the frame, `beyond` says whether light from beyond it is modelled. Both images in fractions of full
    /// scale. Allocates nothing.
    pub fn estimate(
        &mut self,
        stokes: &Stack<f32>,
        channels: usize,
        (modelled, beyond): (Modelled, bool),
        residual: f32,
        errors: &mut Stack<f32>,
    ) {
        let [of_s0, of_s12] = match modelled {
            Modelled::Nothing | Modelled::Polarized | Modelled::Shared => [GUIDED_S0, GUIDED_S12],
            Modelled::Intensity | Modelled::Both | Modelled::Angles => [UNGUIDED_S0, UNGUIDED_S12],
            Modelled::Interpolated => [INTERPOLATED_S0, INTERPOLATED_S12],
        };
        let (n, planes) = (stokes.size().pixels(), stokes.count() / channels);
        let pairs = stokes.as_slice().chunks_exact(planes * n).zip(errors.as_mut_slice().chunks_exact_mut(planes * n));
        for (stokes, errors) in pairs {
            self.energies_of(stokes, n);
            let [detail, polarization, light, texture] = &self.energies;
            let (s0, rest) = errors.split_at_mut(n);
            for (i, s0) in s0.iter_mut().enumerate() {
                let [detail, polarization, light, texture] = [detail[i], polarization[i], light[i], texture[i]];
                let local = Local { detail, polarization, light, texture };
                *s0 = of_s0.sigma(residual, beyond, local);
                if let Some(s1) = rest.get_mut(i) {
                    *s1 = of_s12.sigma(residual, beyond, local);
                }
            }
            if planes == 3 {
                rest.copy_within(..n, n);
            }
        }
    }

    /// Local energies of one channel of `n` pixels.
    fn energies_of(&mut self, stokes: &[f32], n: usize) {
        let Self { means: [first, second], energies: [detail, polarization, light, texture], columns } = self;
        let (s0, rest) = stokes.split_at(n);
        local_mean(s0, FINE, columns, second);
        local_mean(second, FINE, columns, first);
        local_mean(s0, COARSE, columns, second);
        local_mean(second, COARSE, columns, light);
        first.iter_mut().zip(&*light).for_each(|(fine, coarse)| *fine = (*fine - coarse).powi(2));
        local_mean(first, DETAIL, columns, detail);
        first.fill(0.0);
        for plane in rest.chunks_exact(n) {
            local_mean(plane, DETAIL, columns, second);
            local_mean(second, DETAIL, columns, light);
            first.iter_mut().zip(plane.iter().zip(&*light)).for_each(|(sum, (x, mean))| *sum += (x - mean).powi(2));
        }
        local_mean(first, DETAIL, columns, texture);
        first.iter_mut().zip(s0).for_each(|(square, x)| *square = x * x);
        local_mean(first, AREA, columns, light);
        first.fill(0.0);
        for plane in rest.chunks_exact(n) {
            first.iter_mut().zip(plane).for_each(|(sum, x)| *sum += x * x);
        }
        local_mean(first, AREA, columns, polarization);
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
        estimate_within(stokes, (modelled, false), residual)
    }

    fn estimate_within(stokes: &Stack<f32>, modelled: (Modelled, bool), residual: f32) -> Stack<f32> {
        let mut errors = Stack::zeros(stokes.count(), stokes.size());
        let mut workspace = Buffers::allocate(|buffers| Workspace::new(buffers, stokes.size()));
        workspace.estimate(stokes, stokes.count().div_ceil(3), modelled, residual, &mut errors);
        errors
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
    fn noise_makes_errors_larger_and_a_missing_guide_that_of_s0() {
        let stokes = scene(1.0);
        let base = estimate(&stokes, Modelled::Polarized, 0.002);
        let noisy = estimate(&stokes, Modelled::Polarized, 0.1);
        assert!(base.as_slice().iter().zip(noisy.as_slice()).all(|(a, b)| b > a));
        let unguided = estimate(&stokes, Modelled::Both, 0.002);
        assert!(base.plane(0).iter().zip(unguided.plane(0)).all(|(a, b)| b > a));
    }

    #[test]
    fn errors_are_largest_where_polarized_light_has_detail() {
        let size = Size::new(64, 32);
        let mut stokes = Stack::zeros(3, size);
        let checks = |x: usize, y: usize| if x / 2 % 2 == y / 2 % 2 { 0.6 } else { 0.2 };
        for (i, s0) in stokes.plane_mut(0).iter_mut().enumerate() {
            *s0 = if i % 64 < 32 { checks(i % 64, i / 64) } else { 0.4 };
        }
        stokes.plane_mut(1)[16 * 64..].fill(0.2);
        let errors = estimate(&stokes, Modelled::Polarized, 0.0002);
        let at = |x: usize, y: usize| errors.plane(1)[y * 64 + x];
        let places = [at(16, 26), at(16, 4), at(50, 26), at(50, 4)];
        assert!(places[0] > 9.0 * places[1].max(places[2]) && places[3] > 0.0, "{places:?}");
        let beyond = estimate_within(&stokes, (Modelled::Polarized, true), 0.0002);
        assert!(beyond.as_slice().iter().zip(errors.as_slice()).all(|(beyond, error)| beyond > error));
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
