//! The gain from guide units to sensor units, from one frame.
//!
//! y ≈ a·m0 ⊙ (k * g) + Re(ē ⊙ q ⊙ (k * g)) is fitted by weighted least squares, with a polarization state q that varies
//! linearly over the frame (6 real unknowns). Leaving q out would let strong polarization pass for gain: with three
//! stripe angles the mean of e over a period is not zero.

use nalgebra::{SMatrix, SVector};

use crate::optics::Response;
use crate::plane::Size;

const UNKNOWNS: usize = 7;

/// The gain a ≥ 0 of readings `y` over the blurred guide `u` = k * g; none when the guide explains nothing (it is dark, or
/// of another scene). Allocates nothing.
pub(super) fn fit(y: &[f32], weight: &[f32], u: &[f32], response: &Response, size: Size) -> Option<f32> {
    let polarized = response.is_polarized();
    let mut normal = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
    let mut right = SVector::<f64, UNKNOWNS>::zeros();
    for (i, (&y, (&w, &u))) in y.iter().zip(weight.iter().zip(u)).enumerate() {
        if w == 0.0 {
            continue;
        }
        let u = f64::from(u);
        let mut row = SVector::<f64, UNKNOWNS>::zeros();
        row[0] = u * f64::from(response.unpolarized()[i]);
        if polarized {
            let e = response.polarized()[i];
            let px = 2.0 * (i % size.width) as f64 / size.width as f64 - 1.0;
            let py = 2.0 * (i / size.width) as f64 / size.height as f64 - 1.0;
            for (k, shape) in [1.0, px, py].into_iter().enumerate() {
                row[1 + 2 * k] = u * f64::from(e.re) * shape;
                row[2 + 2 * k] = u * f64::from(e.im) * shape;
            }
        }
        normal += row * row.transpose();
        right += row * f64::from(y);
    }
    let trace = normal[(0, 0)];
    if trace <= f64::MIN_POSITIVE {
        return None;
    }
    // A touch of ridge keeps shapes that the weights removed (a half dark frame) from making the system singular.
    for k in 1..UNKNOWNS {
        normal[(k, k)] += 1e-6 * trace;
    }
    let gain = normal.cholesky()?.solve(&right)[0];
    (gain.is_finite() && gain > 0.0).then_some(gain as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plane::Angle;

    #[test]
    fn strong_polarization_does_not_pass_for_gain() {
        let size = Size::new(60, 20);
        for angles in [Angle::three(), Angle::four()] {
            let r = Response::stripes(size, angles, 12, f64::INFINITY).unwrap();
            let u: Vec<f32> = (0..size.pixels()).map(|i| 0.4 + 0.2 * (i as f32 * 0.03).sin()).collect();
            let y: Vec<f32> = (0..size.pixels())
                .map(|i| {
                    let (q, e) = (0.8 - 0.3 * (i / 60) as f32 / 20.0, r.polarized()[i]);
                    0.6 * u[i] * (r.unpolarized()[i] + q * (0.5 * e.re + 0.86 * e.im))
                })
                .collect();
            let gain = fit(&y, &vec![1.0; size.pixels()], &u, &r, size).unwrap();
            assert!((gain - 0.6).abs() < 1e-3, "{gain}");
        }
    }

    #[test]
    fn a_dark_guide_has_no_gain() {
        let size = Size::new(8, 8);
        let r = Response::none(size);
        assert_eq!(fit(&[0.5; 64], &[1.0; 64], &[0.0; 64], &r, size), None);
        assert_eq!(fit(&[0.5; 64], &[0.0; 64], &[1.0; 64], &r, size), None);
        assert_eq!(fit(&[0.5; 64], &[1.0; 64], &[0.25; 64], &r, size), Some(2.0));
    }
}
