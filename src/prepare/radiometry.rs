//! What a guide says of brightness, made what the readings say: gain, tone curve and a smooth error, solved for together with
//! the slow polarization. S0 = a·g + b·g² + c·√g + δ, the last in the slow modes of [`crate::optics::Coarse`].
//!
//! An error of a few percent in S0's slow modes is as large as the polarization that is looked for, and would be taken for it.

use nalgebra::{Matrix3, Vector3};

use super::fit::{Columns, Frame, GUIDE, REST, Workspace};
use crate::optics::Scratch;

/// What keeps a tone curve that cannot be told from the gain at zero, relative to its own square.
const TONE_RIDGE: f64 = 1e-4;

/// Corrects channel `c` of the guide. Allocates nothing.
pub(super) fn correct(
    frame: &Frame<'_>,
    c: usize,
    y: &mut [f32],
    g: &mut [f32],
    scratch: &mut Scratch,
    w: &mut Workspace,
) {
    let fit = w.fit(frame, c, y, g, Columns::Tones, scratch);
    let images = [GUIDE, 0, 1];
    let mut normal = Matrix3::from_fn(|a, b| fit.smooth[(images[a], images[b])]);
    for k in 1..3 {
        normal[(k, k)] *= 1.0 + TONE_RIDGE;
    }
    let right = Vector3::from_fn(|a, _| fit.smooth[(images[a], REST)]);
    let change = normal.cholesky().map(|f| f.solve(&right)).filter(|x| x.iter().all(|v| v.is_finite()));
    // A guide without detail has no tones either; its smooth part is still to be corrected.
    let change = change.unwrap_or_default();
    w.correction(frame, c, g, change.into());
    for (g, v) in g.iter_mut().zip(&w.image) {
        *g = (fit.gain as f32 * *g + v.re).max(0.0);
    }
}
