//! Correction of a guide's brightness by the readings. The simplest of three models that suffices is solved for together with the slow
//! polarization:
//!
//! - a tone curve, S0 = a·g + b·g² + c·√g + d·g³ + e·∜g: another gamma, exposure or spectral response;
//! - that and shading, + (f·x + h·y + i·x² + j·xy + k·y² + l·r⁴)·g: vignetting, uneven light;
//! - a tone curve and a smooth error δ in the slow modes of [`crate::optics::Coarse`], where a [`Curve`] leaves one.
//!
//! An error of a percent in S0's slow modes is as large as the polarization that is measured, and would be mistaken for it. But a model
//! with more unknowns fits more of the noise and of the polarization's detail: the third has a hundred.

use nalgebra::{SMatrix, SVector};

use super::fit::{COLUMNS, Columns, Frame, GUIDE, Gram, REST, TONES, Workspace, mean};
use crate::image::Size;
use crate::optics::Scratch;

/// Passes that find a curve, at most, for the equations of one are approximate …
const PASSES: usize = 4;
/// … and that find a smooth error.
pub(super) const SMOOTH_PASSES: usize = 2;
/// Sum of squares that each unknown of a tone curve, or of shading beside it, must explain in the mean, in noise variances: two and a
/// half standard deviations (beside a perfect guide tones explain up to 20 in all and shading up to 32, detail of the polarization) …
const SIGNIFICANT: f64 = 6.0;
/// … and of what is left beside noise: stress patterns leave much, of which tones explain .4 % and shading 1 % by chance.
const OF_THE_REST: f64 = 0.005;
/// Sum of squares that each unknown of a further pass must explain, in noise variances: an unneeded pass explains next to nothing.
const UNSETTLED: f64 = 0.5;
/// Ridge that keeps a tone or shade that cannot be told from the others at zero, relative to its own square.
const RIDGE: f64 = 1e-5;
/// The guide's gain and the images beside it, at most.
const UNKNOWNS: usize = 1 + COLUMNS;

/// Tones and shading of one channel, as they were found one after the other. Relative to the guide's mean: another exposure of the
/// guide changes nothing.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Curve {
    passes: [[f64; UNKNOWNS]; PASSES],
    count: usize,
    /// True if there is shading.
    shaded: bool,
}

impl Curve {
    pub(super) fn is_none(&self) -> bool {
        self.count == 0
    }

    /// Corrects the guide `g`.
    pub(super) fn apply(&self, g: &mut [f32], size: Size) {
        self.passes[..self.count].iter().for_each(|theta| bend(g, size, theta));
    }

    /// Takes one more pass, and corrects the guide `g` by it, if there is room and the readings tell of an error. Allocates
    /// nothing.
    pub(super) fn refine(
        &mut self,
        frame: &Frame<'_>,
        c: usize,
        [y, g]: [&mut [f32]; 2],
        scratch: &mut Scratch,
        w: &mut Workspace,
    ) -> bool {
        if self.count == PASSES {
            return false;
        }
        let fit = w.fit(frame, c, y, g, Columns::Curve, scratch);
        let gram = &fit.polarized;
        let [plain, tones, shading] = [1, 1 + TONES, UNKNOWNS].map(|count| solve(gram, count));
        let (rest, readings) = (gram[(REST, REST)], frame.trusted / frame.operators.len() as f64);
        let found = |more: f64, less: f64, unknowns: usize| {
            let least = (SIGNIFICANT * rest / readings).max(OF_THE_REST * (rest - frame.noise * readings));
            more - less > unknowns as f64 * least
        };
        self.shaded |= found(shading.1, tones.1, UNKNOWNS - 1 - TONES);
        let (mut theta, explained, beside) = if self.shaded {
            (shading.0, shading.1 - plain.1, UNKNOWNS - 1)
        } else {
            (tones.0, tones.1 - plain.1, TONES)
        };
        let needed = if self.count == 0 {
            self.shaded || found(tones.1, plain.1, TONES)
        } else {
            explained > UNSETTLED * beside as f64 * rest / readings
        };
        if !needed {
            return false;
        }
        theta[0] += fit.gain;
        self.passes[self.count] = theta.into();
        self.count += 1;
        bend(g, frame.weight.size(), theta.as_slice());
        true
    }
}

/// The guide replaced by itself and its images, weighed with `theta`.
fn bend(g: &mut [f32], size: Size, theta: &[f64]) {
    let brightness = mean(g);
    for i in 0..g.len() {
        g[i] = Columns::Curve.combined(g, i, size, brightness, theta).max(0.0);
    }
}

/// Least squares of the rest of a fit by the guide and its first images, `count` in all: their factors, and the sum of squares explained.
fn solve(gram: &Gram, count: usize) -> (SVector<f64, UNKNOWNS>, f64) {
    let image = |k: usize| k.checked_sub(1).unwrap_or(GUIDE);
    let mut right = SVector::<f64, UNKNOWNS>::zeros();
    (0..count).for_each(|a| right[a] = gram[(image(a), REST)]);
    // Tones of a guide without contrast are so much alike that rounding can leave their products indefinite.
    for ridge in [RIDGE, 10.0 * RIDGE, 100.0 * RIDGE] {
        let mut normal = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::identity();
        for a in 0..count {
            (0..count).for_each(|b| normal[(a, b)] = gram[(image(a), image(b))]);
            normal[(a, a)] *= if a == 0 { 1.0 } else { 1.0 + ridge };
        }
        if let Some(theta) = normal.cholesky().map(|f| f.solve(&right)).filter(|x| x.iter().all(|v| v.is_finite())) {
            return (theta, theta.dot(&right));
        }
    }
    // A black guide has none.
    (SVector::zeros(), 0.0)
}

/// Corrects channel `c` of the guide by a tone curve and a smooth error. Allocates nothing.
pub(super) fn correct(
    frame: &Frame<'_>,
    c: usize,
    y: &mut [f32],
    g: &mut [f32],
    scratch: &mut Scratch,
    w: &mut Workspace,
) {
    let fit = w.fit(frame, c, y, g, Columns::Tones, scratch);
    let (theta, _) = solve(&fit.smooth, 1 + TONES);
    w.correction(frame, c, g, &theta.as_slice()[..1 + TONES]);
    for (g, v) in g.iter_mut().zip(&w.image) {
        *g = (fit.gain as f32 * *g + v.re).max(0.0);
    }
}
