//! The problem that `guided` and `stokes` minimise, and its symbols.
//!
//! ```text
//! minimise over x   ½ Σᵢ wᵢ (bᵢ − Σₓ Re(ēᵢ (k * x)ᵢ))²  +  prior(x)  +  λ Σᵢ aᵢ |∇x|ᵢ
//! subject to        S0 ≥ 0 and |L| ≤ S0
//! ```
//!
//! | symbol | meaning |
//! |---|---|
//! | x | an unknown image: S0, or L = S1 + i·S2, in fractions of full scale. Σₓ runs over both where both are unknown |
//! | k | PSF of unit sum; k * x is a linear convolution, x is zero outside the frame |
//! | e | response of a pixel: m0 for S0, m1 + i·m2 for L ([`crate::optics::Response`]) |
//! | b | readings, less S0's share of them where S0 is known: `target` |
//! | w | weight of a reading, 0 or 1 |
//! | ∇x | differences to the right and below, real and imaginary part of both under one root; none across the border |
//! | a | weight of total variation, in (0, 1], small at edges of the guide |
//! | prior | distance of x from a local affine function of the guide; its proximal step is the guided filter |
//!
//! | method | mask | unknown | S0 | prior, a | constraint |
//! |---|---|---|---|---|---|
//! | `guided` | yes | L ([`Unknowns::Polarized`]) | the guide times a fitted gain | by the guide | \|L\| ≤ S0 |
//! | `guided` | no | S0 ([`Unknowns::Intensity`]) | | by the guide | S0 ≥ 0 |
//! | `stokes` | yes | S0 and L ([`Unknowns::Both`]) | | of L, by the present S0; a = 1 for S0 | \|L\| ≤ S0 |
//! | `stokes` | no | S0 ([`Unknowns::Intensity`]) | | none; a = 1 | S0 ≥ 0 |
//!
//! The algorithm is the alternating direction method of multipliers ([`super::admm`]) with three splittings, each with a penalty and
//! a scaled multiplier u: ν = k * x (ρ), z = x (t) and d = ∇x (τ). An iteration consists of
//!
//! - the data step, ν ([`super::admm::data_step`]): one real equation for each pixel;
//! - the prior step, z and d ([`super::admm::prior_step`]): guided filter, constraint, shrinkage;
//! - the image step, x ([`super::admm::image_step`]): one division for each frequency.
//!
//! Constants stand where they are used: in `guided.rs`, `unguided.rs`, `direct_start.rs` and `joint_colors.rs`. Those that two of these
//! files need are here. They were found on procedural and real scenes; halving or doubling one costs less than 0.3 dB. All are relative
//! to the scene's brightness, the noise of the readings and the mean squared response, so that the scale of readings, PSF and guide
//! cancels.
//!
//! The angle methods of [`super::reference`] minimise ½‖w ⊙ (A x − b)‖² + λ·TV(x) over x ≥ 0, one intensity for each polarizer angle.

use num_complex::Complex32;

use crate::optics::{Response, StokesOperator};

/// Radius of the guided filter in pixels.
pub(super) const RADIUS: usize = 4;
/// Exponent by which t grows with the noise.
pub(super) const NOISE_POWER: f32 = 1.3;

/// Unknown images of a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unknowns {
    /// L; S0 is the guide times a gain.
    Polarized,
    /// S0.
    Intensity,
    /// S0 and L.
    Both,
}

impl Unknowns {
    /// The unknowns behind a mask or none, with S0 from a guide or without.
    pub(super) fn new(response: &Response, guided: bool) -> Self {
        match (response.is_polarized(), guided) {
            (true, true) => Self::Polarized,
            (true, false) => Self::Both,
            (false, _) => Self::Intensity,
        }
    }

    /// The real response maps of the unknowns, m0 before m1 and m2. Allocates.
    pub(super) fn responses(self, operator: &StokesOperator) -> Vec<Vec<f32>> {
        let mut maps = Vec::new();
        if self != Self::Polarized {
            maps.push(operator.response.unpolarized().to_vec());
        }
        if self != Self::Intensity {
            maps.extend(operator.polarized_responses());
        }
        maps
    }
}

/// The nearest L of a degree of polarization of at most 1: L·min(1, S0/|L|).
pub(super) fn limit_dolp(l: Complex32, s0: f32) -> Complex32 {
    let square = l.norm_sqr();
    if square <= s0 * s0 { l } else { l * (s0 / square.sqrt()) }
}

/// The nearest point of the cone |L| ≤ S0.
pub(super) fn project_on_cone(s0: f32, l: Complex32) -> (f32, Complex32) {
    let length = l.norm();
    if length <= s0 {
        (s0, l)
    } else if length <= -s0 {
        (0.0, Complex32::ZERO)
    } else {
        let middle = 0.5 * (s0 + length);
        (middle, l * (middle / length))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// A projection is feasible, and no feasible point is nearer: the rest is orthogonal to the cone.
        #[test]
        fn the_nearest_point_of_the_cone(s0 in -2.0f32..2.0, re in -2.0f32..2.0, im in -2.0f32..2.0) {
            let l = Complex32::new(re, im);
            let (s, p) = project_on_cone(s0, l);
            prop_assert!(p.norm() <= s + 1e-5);
            let rest = (s0 - s, l - p);
            let inner = |s: f32, p: Complex32| rest.0 * s + rest.1.re * p.re + rest.1.im * p.im;
            prop_assert!(inner(s, p).abs() < 1e-5);
            for turn in 0..16 {
                prop_assert!(inner(1.0, Complex32::from_polar(1.0, turn as f32 * 0.4)) < 1e-5);
            }
        }

        #[test]
        fn the_degree_of_polarization_ends_at_one(s0 in 0.0f32..2.0, re in -2.0f32..2.0, im in -2.0f32..2.0) {
            let l = Complex32::new(re, im);
            let limited = limit_dolp(l, s0);
            prop_assert!(limited.norm() <= s0 * (1.0 + 1e-6));
            let expected = if l.norm() <= s0 { l } else { l * (s0 / l.norm()) };
            prop_assert!((limited - expected).norm() < 1e-5);
        }
    }
}
