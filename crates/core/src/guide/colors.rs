//! Weights of a colour guide's channels beside a mono sensor, which weighs colours in its own way.
//!
//! The weights are the least squares ones of
//!
//! ‖y − m0 ⊙ (k * Σ w_c g_c) − Re(ē ⊙ (k * L))‖² / σ² + Σ (w_c − w̄_c)² / τ², w ≥ 0,
//!
//! with L eliminated as in `fit.rs` and σ² the variance of what is left of a reading. w̄ are the weights so far.
//!
//! Cost: 24 complex convolutions.

use nalgebra::{Matrix3, Vector3};

use super::fit::{self, Columns, Frame};
use crate::image::Stack;
use crate::optics::Scratch;

/// Weights of a guide's channels, of sum 1.
pub(super) type Weights = [f32; 3];

/// Weights of a guide of which nothing is known.
pub(super) const EVEN: Weights = [1.0 / 3.0; 3];
/// Deviation of a weight before a look at the readings.
const TAU: f64 = 0.3;
/// Noise variances by which other weights have to lower the sum of squares, and the share of what is left beside noise.
const SIGNIFICANT: f64 = 100.0;
const OF_THE_REST: f64 = 0.02;

/// The weights by the readings; none where others than `before` explain little more. `guide` lies as it was aligned, mixed by `before`;
/// `place(weights, guide)` mixes it anew, into `channel` for single channels. `direction` and `channel` are buffers. Allocates nothing.
pub(super) fn find(
    frame: &Frame<'_>,
    before: Weights,
    (raw, guide): (&mut Stack<f32>, &Stack<f32>),
    mut place: impl FnMut(Weights, &mut Stack<f32>),
    (direction, channel): (&mut [f32], &mut Stack<f32>),
    scratch: &mut Scratch,
    w: &mut fit::Workspace,
) -> Option<Weights> {
    let fit = w.fit(frame, 0, raw.plane_mut(0), guide.plane(0), Columns::Gain, scratch);
    let rest = fit.polarized[(fit::REST, fit::REST)];
    let variance = rest / frame.trusted.max(1.0);
    if fit.gain.is_nan() || fit.gain <= 0.0 {
        return None;
    }
    let unit = |c: usize| std::array::from_fn(|k| if k == c { 1.0 } else { 0.0 });
    let product = |a: &[f32], w: &fit::Workspace| -> f64 {
        a.iter().zip(&w.image).map(|(a, b)| f64::from(*a) * f64::from(b.re)).sum()
    };
    w.adjoint_rest(frame, 0, scratch);
    let mut slope = Vector3::zeros();
    for c in 0..3 {
        place(unit(c), channel);
        slope[c] = product(channel.plane(0), w);
    }
    let mut hessian = Matrix3::zeros();
    for c in 0..3 {
        place(unit(c), channel);
        direction.copy_from_slice(channel.plane(0));
        w.normal(frame, 0, direction, scratch);
        for other in 0..3 {
            place(unit(other), channel);
            hessian[(other, c)] = product(channel.plane(0), w);
        }
    }
    hessian = (hessian + hessian.transpose()) * 0.5;
    let start = Vector3::from(before.map(|w| f64::from(w) * fit.gain));
    let ridge = variance / (TAU * fit.gain).powi(2);
    let found = positive(&(hessian + Matrix3::identity() * ridge), &slope, &start)?;
    // Weights that differ by a factor alone are the same weights.
    let drop = |change: Vector3<f64>| 2.0 * change.dot(&slope) - change.dot(&(hessian * change));
    let own = start.dot(&slope) / start.dot(&(hessian * start));
    let drop = drop(found - start) - if own.is_finite() { drop(start * own) } else { 0.0 };
    let weights = found / found.sum();
    let significant = drop > SIGNIFICANT * variance && drop > OF_THE_REST * (rest - frame.noise * frame.trusted);
    (significant && weights.iter().all(|w| w.is_finite())).then(|| std::array::from_fn(|c| weights[c] as f32))
}

/// The minimum of ½ (w − start)ᵀ H (w − start) − slopeᵀ (w − start) with no w below 0; none if the equations have no solution.
fn positive(hessian: &Matrix3<f64>, slope: &Vector3<f64>, start: &Vector3<f64>) -> Option<Vector3<f64>> {
    let right = slope + hessian * start;
    let cost = |w: &Vector3<f64>| 0.5 * w.dot(&(hessian * w)) - right.dot(w);
    // Each set of weights that are not 0.
    let solutions = (1..8usize).filter_map(|set| {
        let used = |c: usize| set & (1 << c) != 0;
        let matrix = Matrix3::from_fn(|a, b| match (a == b, used(a) && used(b)) {
            (_, true) => hessian[(a, b)],
            (same, false) => f64::from(u8::from(same)),
        });
        let side = Vector3::from_fn(|c, _| if used(c) { right[c] } else { 0.0 });
        let w = matrix.cholesky()?.solve(&side);
        w.iter().all(|w| *w >= 0.0).then_some(w)
    });
    solutions.min_by(|a, b| cost(a).total_cmp(&cost(b)))
}

#[cfg(test)]
mod tests {
    use super::super::register::tests::{Bench, SIZE, scene};
    use super::*;

    /// The weights found for a scene whose channels are scenes of their own, behind a sensor of weights `exact`.
    fn weigh(exact: Weights, seeds: [u32; 3]) -> Option<Weights> {
        let at = |seed: u32, i: usize| scene(seed, (i % SIZE.width) as f32, (i / SIZE.width) as f32);
        let mixed = |weights: Weights, out: &mut Stack<f32>| {
            for (i, v) in out.plane_mut(0).iter_mut().enumerate() {
                *v = weights.iter().zip(seeds).map(|(w, seed)| w * at(seed, i)).sum();
            }
        };
        let [mut s0, mut guide, mut channel] = [(); 3].map(|()| Stack::zeros(1, SIZE));
        mixed(exact, &mut s0);
        mixed(EVEN, &mut guide);
        let mut direction = vec![0.0; SIZE.pixels()];
        Bench::new(s0.plane(0), 0.4).run(|frame, raw, scratch, w| {
            find(frame, EVEN, (raw, &guide), mixed, (&mut direction, &mut channel), scratch, w)
        })
    }

    #[test]
    fn weights_of_another_spectrum_are_found() {
        for exact in [[0.15, 0.6, 0.25], [0.8, 0.15, 0.05], [0.0, 1.0, 0.0]] {
            let found = weigh(exact, [1, 2, 3]).unwrap();
            let far = found.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(far < 0.03 && found.iter().all(|w| *w >= 0.0), "{exact:?}: {found:?}");
        }
    }

    #[test]
    fn weights_that_the_readings_do_not_tell_stay() {
        assert_eq!(weigh(EVEN, [1, 2, 3]), None, "they are right");
        assert_eq!(weigh([0.8, 0.15, 0.05], [1, 1, 1]), None, "a gray scene");
    }
}
