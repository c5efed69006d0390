//! Light from beyond the frame: whether the readings tell of it, and how much of them it is.
//!
//! The model of a scene that ends with the frame leaves that light in the rest of its fit. It falls on the borders, and it is positive. So
//! the rest is multiplied with the readings of an evenly bright surrounding, for each of the four sides by itself: a lamp may stand on one.
//!
//! Allocation: [`pattern`] allocates.

use super::fit;
use crate::image::{Complex32, Size, Stack};
use crate::optics::{Scratch, StokesOperator};

/// How much light it takes to be told from errors of the model.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sensitivity {
    /// Product of rest and pattern that is more than chance, in standard deviations of the noise.
    significant: f64,
    /// Brightness of the surrounding over that of the frame.
    least: f64,
}

/// Beside a guide that shows the scene a dark surrounding leaves 1 standard deviation and a brightness of 2·10⁻⁴, one of 2 % leaves 12 and
/// 3·10⁻³: slow polarization takes most of it.
pub(crate) const GUIDED: Sensitivity = Sensitivity { significant: 8.0, least: 8e-4 };
/// Without a guide the solution of a dark surrounding leaves up to 20 and 5·10⁻³, for it has not settled; an evenly bright one leaves 300
/// and 0.1.
pub(crate) const UNGUIDED: Sensitivity = Sensitivity { significant: 100.0, least: 0.03 };

/// Light from beyond the frame in the rest of a fit, over all channels; for each side of the frame.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Traces {
    /// ⟨pattern, rest⟩.
    products: [f64; 4],
    /// ⟨pattern, pattern⟩ times the variance of the noise.
    variances: [f64; 4],
    /// ⟨pattern, pattern⟩ times the brightness of the frame, in the readings' units.
    expected: [f64; 4],
}

impl Traces {
    /// Adds a channel whose fit left `rest`; `brightness` is that of the frame, `noise` the variance of its readings.
    pub(crate) fn add(&mut self, pattern: &[f32], rest: &[f32], size: Size, brightness: f64, noise: f64) {
        // A black guide leaves everything.
        if brightness <= 0.0 {
            return;
        }
        for (i, (pattern, rest)) in pattern.iter().zip(rest).enumerate() {
            let (pattern, rest, side) = (f64::from(*pattern), f64::from(*rest), side(i, size));
            self.products[side] += pattern * rest;
            self.variances[side] += pattern * pattern * noise;
            self.expected[side] += pattern * pattern * brightness;
        }
    }

    /// True if light from beyond one of the sides is in the rest.
    pub(crate) fn tell(&self, sensitivity: Sensitivity) -> bool {
        (0..4).any(|side| {
            let product = self.products[side];
            product > sensitivity.significant * self.variances[side].sqrt()
                && product > sensitivity.least * self.expected[side]
        })
    }
}

/// The side that pixel `i` is nearest to: left, right, above, below.
fn side(i: usize, Size { width, height }: Size) -> usize {
    let (x, y) = ((i % width) as f32 / width as f32 - 0.5, (i / width) as f32 / height as f32 - 0.5);
    if x.abs() > y.abs() { usize::from(x > 0.0) } else { 2 + usize::from(y > 0.0) }
}

/// Readings of a scene that is dark in the frame and of brightness 1 everywhere else, for a camera whose field is the frame. Allocates.
pub(crate) fn pattern(operator: &StokesOperator) -> Vec<f32> {
    let n = operator.field().frame().pixels();
    let mut inner = vec![0.0; n];
    operator.forward_s0(&vec![1.0; n], &mut inner, &mut operator.convolver.make_scratch());
    let m0 = operator.response.unpolarized();
    inner.iter().zip(m0).map(|(inner, m0)| (m0 - inner).max(0.0)).collect()
}

/// Share of the readings' light that comes from the margin of the guide, all channels together. The guide is overwritten in `image`.
/// Allocates nothing.
pub(super) fn share(
    operators: &[StokesOperator],
    guide: &Stack<f32>,
    image: &mut [Complex32],
    scratch: &mut Scratch,
) -> f32 {
    let [mut outer, mut all] = [0.0; 2];
    for (operator, guide) in operators.iter().zip(guide.planes()) {
        let field = operator.field();
        fit::forward(
            operator,
            |i| Complex32::new(guide[i], if field.shows(i) { 0.0 } else { guide[i] }),
            image,
            scratch,
        );
        let [more, beyond] = fit::sum(image.len(), |i| [image[i].re, image[i].im]);
        (outer, all) = (outer + beyond, all + more);
    }
    if all > 0.0 { (outer / all) as f32 } else { 0.0 }
}
