//! The per-pixel formulas of linear polarization, in one place for everything that measures or draws it.

/// Degree of linear polarization √(S1² + S2²) / S0, not clamped: noise may push it above 1. 0 where S0 ≤ 0, where it has no
/// meaning. Source: Born and Wolf, Principles of Optics, the degree of polarization, with S3 left out.
///
/// ```
/// assert_eq!(stokescope_core::polarization::dolp(2.0, 0.6, 0.8), 0.5);
/// ```
#[inline]
pub fn dolp(s0: f32, s1: f32, s2: f32) -> f32 {
    if s0 > 0.0 { s1.hypot(s2) / s0 } else { 0.0 }
}

/// Angle of linear polarization ½·atan2(S2, S1), in degrees in [0°, 180°): 0° along the sensor's rows, counter-clockwise as
/// the camera sees it. Never average it: average S1 and S2. Source: Born and Wolf, Principles of Optics, the orientation of
/// the polarization ellipse.
///
/// ```
/// assert_eq!(stokescope_core::polarization::aolp_degrees(0.0, -1.0), 135.0);
/// ```
#[inline]
pub fn aolp_degrees(s1: f32, s2: f32) -> f32 {
    let degrees = 0.5 * s2.atan2(s1).to_degrees();
    let positive = if degrees < 0.0 { degrees + 180.0 } else { degrees };
    // A tiny negative angle rounds up to 180°, which is 0°.
    if positive < 180.0 { positive } else { 0.0 }
}

/// Least intensity behind any linear polarizer, ½·(S0 − √(S1² + S2²)): the scene without polarized glare. Same unit as
/// S0; noise may push it below 0.
///
/// ```
/// assert_eq!(stokescope_core::polarization::least_intensity(2.0, 0.6, 0.8), 0.5);
/// ```
#[inline]
pub fn least_intensity(s0: f32, s1: f32, s2: f32) -> f32 {
    0.5 * (s0 - s1.hypot(s2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_angle_comes_back_for_every_direction() {
        for degrees in 0..180 {
            let twice = 2.0 * (degrees as f32).to_radians();
            let found = aolp_degrees(twice.cos(), twice.sin());
            let error = (found - degrees as f32 + 90.0).rem_euclid(180.0) - 90.0;
            assert!(error.abs() < 1e-4 && (0.0..180.0).contains(&found), "{degrees}° came back as {found}°");
        }
    }

    #[test]
    fn the_angle_never_reaches_180() {
        for (s1, s2) in [(1.0, -0.0), (1.0, -1e-30), (1.0, -1e-9), (0.0, 0.0), (-1.0, -0.0)] {
            let found = aolp_degrees(s1, s2);
            assert!((0.0..180.0).contains(&found), "({s1}, {s2}) gives {found}");
        }
    }

    #[test]
    fn the_degree_is_unclamped_and_defined_in_the_dark() {
        assert_eq!(dolp(1.0, 0.0, -1.5), 1.5);
        assert_eq!(dolp(0.0, 1.0, 1.0), 0.0);
        assert_eq!(dolp(-0.1, 1.0, 1.0), 0.0);
    }
}
