//! The prior step of an iteration: z from x and d from ∇x, pixel by pixel, and the right-hand side that both leave to the image step.
//!
//! With u the multiplier of the splitting in question, and the guided filter of the last unknown's x + u done already:
//!
//! ```text
//! z = prox(x + u)                          u' = x + u − z      ([`Prox`])
//! d = v·max(0, 1 − λa/(τ|v|)), v = ∇x + u    u' = v − d          (isotropic soft shrinkage)
//! right-hand side = t·(z − u') + τ·∇ᵀ(d − u')
//! ```
//!
//! λ/τ is the threshold, a the weight at edges. A difference that leaves the frame has no penalty: d − u' is its present value.

use fearless_simd::f32x8;
use fearless_simd::prelude::*;

use super::Penalties;
use super::state::Multipliers;
use crate::optics::lanes::{Lanes, Wave};
use crate::solve::guided_filter::Reals;

/// Proximal step of prior and constraint on x + u. The filtered image is that of the last unknown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::solve) enum Prox {
    /// S0: x + u, not negative.
    Positive,
    /// S0: the filtered image, not negative.
    FilteredPositive,
    /// L: the filtered image, no longer than the guide.
    Filtered,
    /// S0 and L: S0's x + u and L's filtered image at the nearest point of the cone |L| ≤ S0.
    Cone,
}

impl Prox {
    /// Whether the last unknown is filtered and its total variation weighted at edges.
    pub(super) fn is_filtered(self) -> bool {
        self != Self::Positive
    }

    /// The step at one pixel, in plain form: z of S0 and of L, or of one of them in the second place. What [`apply`] is tested against.
    #[cfg(test)]
    pub(super) fn scalar(
        self,
        s0: f32,
        input: num_complex::Complex32,
        filtered: num_complex::Complex32,
        guide: f32,
    ) -> (f32, num_complex::Complex32) {
        match self {
            Self::Positive => (s0, input.re.max(0.0).into()),
            Self::FilteredPositive => (s0, filtered.re.max(0.0).into()),
            Self::Filtered => (s0, crate::solve::problem::limit_dolp(filtered, guide)),
            Self::Cone => crate::solve::problem::project_on_cone(s0, filtered),
        }
    }
}

/// d of v at one pixel, in plain form: what [`shrink`] is tested against.
#[cfg(test)]
pub(super) fn scalar_shrink(v: [num_complex::Complex32; 2], threshold: f32) -> [num_complex::Complex32; 2] {
    let length = (v[0].norm_sqr() + v[1].norm_sqr()).sqrt();
    v.map(|v| v * if length > threshold { 1.0 - threshold / length } else { 0.0 })
}

/// Constants of a prior step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Constants {
    pub(super) prox: Prox,
    /// Threshold of total variation, λ/τ.
    pub(super) threshold: f32,
    pub(super) p: Penalties,
}

/// Output of the prior step for one unknown in a row.
pub(super) struct PriorOutput<'a> {
    /// u, then u', of both splittings.
    pub(super) multipliers: &'a mut [Multipliers],
    /// The right-hand side of the image step, padded.
    pub(super) rhs: &'a mut [Lanes],
}

/// Images that the prior step reads in a row.
#[derive(Clone, Copy)]
pub(super) struct PriorRow<'a, const K: usize> {
    /// x, padded. The first value behind the frame repeats the last one in it.
    pub(super) here: [&'a [Lanes]; K],
    /// x in the row below.
    pub(super) below: [&'a [Lanes]; K],
    /// The filtered image; empty if there is none.
    pub(super) filtered: &'a [Lanes],
    pub(super) guide: &'a [Reals],
    pub(super) edges: &'a [Reals],
    /// Whether this is the frame's last row.
    pub(super) last: bool,
}

/// out = x + u, u being the multiplier of z = x.
#[inline(always)]
pub(super) fn prior_input<S: Simd>(s: S, x: &[Lanes], multipliers: &[Multipliers], rescale: f32, out: &mut [Lanes]) {
    let rescale = f32x8::splat(s, rescale);
    for ((x, m), out) in x.iter().zip(multipliers).zip(out) {
        Wave::load(s, x).plus(Wave::load(s, &m.prior), rescale).store(out);
    }
}

/// The prior step on a row of `K` unknowns, but for what crosses the left and right border of the frame. `flow` holds the downward part of d − u' in the row above, then in this one.
#[inline(always)]
pub(super) fn prior_row<S: Simd, const K: usize>(
    s: S,
    rows: PriorRow<'_, K>,
    constants: Constants,
    outputs: &mut [PriorOutput<'_>; K],
    flow: &mut [Vec<Lanes>; 2],
) {
    let Constants { prox, threshold, p } = constants;
    let number = |v: f32| f32x8::splat(s, v);
    let (rescale, prior, gradient) = (number(p.rescale), number(p.prior), number(p.gradient));
    // The rightward part of d − u' in the eight pixels to the left.
    let mut left = [Wave::zero(s); K];
    for i in 0..flow[0].len() {
        let here: [Wave<S>; K] = std::array::from_fn(|k| Wave::load(s, &rows.here[k][i]));
        let mut input = here;
        for k in 0..K {
            input[k] = here[k].plus(Wave::load(s, &outputs[k].multipliers[i].prior), rescale);
        }
        let mut z = input;
        if prox.is_filtered() {
            z[K - 1] = Wave::load(s, &rows.filtered[i]);
        }
        apply(s, prox, &mut z, &rows.guide[i]);
        for k in 0..K {
            let m = &mut outputs[k].multipliers[i];
            let mut threshold = number(threshold);
            if prox.is_filtered() && k + 1 == K {
                threshold *= f32x8::simd_from(s, rows.edges[i]);
            }
            let ahead = rows.here[k].get(i + 1).map_or(Wave::zero(s), |v| Wave::load(s, v));
            let below = Wave::load(s, &rows.below[k][i]);
            let ([across, down], [aside, mut onward]) = shrink(s, [here[k], ahead, below], m, rescale, threshold);
            let dual = input[k] - z[k];
            dual.store(&mut m.prior);
            across.store(&mut m.across);
            down.store(&mut m.down);
            if rows.last {
                onward = Wave { re: -here[k].re, im: -here[k].im };
            }
            let before = Wave { re: left[k].re.slide::<7>(aside.re), im: left[k].im.slide::<7>(aside.im) };
            let divergence = before - aside + Wave::load(s, &flow[k][i]) - onward;
            left[k] = aside;
            onward.store(&mut flow[k][i]);
            (z[k] - dual).scale(prior).plus(divergence, gradient).store(&mut outputs[k].rhs[i]);
        }
    }
}

/// The downward part of d − u' in a row of one unknown, into `flow`, with nothing else changed. `edges` are the weights a, 1 if there
/// are none.
#[inline(always)]
pub(super) fn flow_row<S: Simd>(
    s: S,
    [here, below]: [&[Lanes]; 2],
    multipliers: &[Multipliers],
    edges: Option<&[Reals]>,
    Constants { threshold, p, .. }: Constants,
    flow: &mut [Lanes],
) {
    for (i, (flow, m)) in flow.iter_mut().zip(multipliers).enumerate() {
        let ahead = here.get(i + 1).map_or(Wave::zero(s), |v| Wave::load(s, v));
        let x = [Wave::load(s, &here[i]), ahead, Wave::load(s, &below[i])];
        let mut threshold = f32x8::splat(s, threshold);
        if let Some(edges) = edges {
            threshold *= f32x8::simd_from(s, edges[i]);
        }
        shrink(s, x, m, f32x8::splat(s, p.rescale), threshold).1[1].store(flow);
    }
}

/// z from x + u, or from the filtered image in its place.
#[inline(always)]
fn apply<S: Simd, const K: usize>(s: S, prox: Prox, z: &mut [Wave<S>; K], guide: &Reals) {
    let number = |v: f32| f32x8::splat(s, v);
    let (zero, tiny) = (number(0.0), number(f32::MIN_POSITIVE));
    let last = &mut z[K - 1];
    match prox {
        Prox::Positive | Prox::FilteredPositive => *last = Wave { re: last.re.max(zero), im: zero },
        Prox::Filtered => {
            let length = last.norm_sqr().sqrt().max(tiny);
            *last = last.scale((f32x8::simd_from(s, *guide) / length).min(number(1.0)));
        }
        Prox::Cone => {
            // On the cone's surface unless inside; at its tip where S0 would be negative.
            let length = last.norm_sqr().sqrt().max(tiny);
            let s0 = z[0].re;
            let middle = ((s0 + length) * 0.5).max(zero);
            let inside = length.simd_le(s0);
            z[K - 1] = z[K - 1].scale(inside.select(number(1.0), middle / length));
            z[0] = Wave { re: inside.select(s0, middle), im: zero };
        }
    }
}

/// Isotropic shrinkage of v = ∇x + u, for x here, in the next eight columns and below: u' and d − u', rightward and downward.
#[inline(always)]
fn shrink<S: Simd>(
    s: S,
    [here, ahead, below]: [Wave<S>; 3],
    m: &Multipliers,
    rescale: f32x8<S>,
    threshold: f32x8<S>,
) -> ([Wave<S>; 2], [Wave<S>; 2]) {
    let right = Wave { re: here.re.slide::<1>(ahead.re), im: here.im.slide::<1>(ahead.im) };
    let across = (right - here).plus(Wave::load(s, &m.across), rescale);
    let down = (below - here).plus(Wave::load(s, &m.down), rescale);
    let length = (across.norm_sqr() + down.norm_sqr()).sqrt().max(f32x8::splat(s, f32::MIN_POSITIVE));
    let cut = (threshold / length).min(f32x8::splat(s, 1.0));
    // d = (1 − cut)·v and u' = cut·v.
    let rest = f32x8::splat(s, 1.0) - cut - cut;
    ([across.scale(cut), down.scale(cut)], [across.scale(rest), down.scale(rest)])
}

#[cfg(test)]
mod tests {
    use num_complex::Complex32;
    use proptest::prelude::*;

    use super::*;
    use crate::optics::lanes::{LANES, levels, vectorize};
    use crate::solve::admm::testing::lanes;

    fn real(v: Lanes) -> Lanes {
        Lanes { im: [0.0; LANES], ..v }
    }

    proptest! {
        #[test]
        fn the_vector_prox_is_the_scalar_one(
            [s0, input, filtered] in [lanes(), lanes(), lanes()],
            guide in proptest::array::uniform8(0.0f32..1.0),
        ) {
            for level in levels() {
                for prox in [Prox::Positive, Prox::FilteredPositive, Prox::Filtered, Prox::Cone] {
                    let mut z = [real(s0), if prox.is_filtered() { filtered } else { input }];
                    vectorize!(level, s => {
                        let mut waves = z.map(|z| Wave::load(s, &z));
                        apply(s, prox, &mut waves, &guide);
                        waves.into_iter().zip(&mut z).for_each(|(wave, z)| wave.store(z));
                    });
                    for (lane, guide) in guide.into_iter().enumerate() {
                        let (s, l) = prox.scalar(s0.re[lane], input.get(lane), filtered.get(lane), guide);
                        prop_assert!((z[0].get(lane) - s).norm() < 1e-5, "{prox:?} {} {s}", z[0].get(lane));
                        prop_assert!((z[1].get(lane) - l).norm() < 1e-5, "{prox:?} {} {l}", z[1].get(lane));
                    }
                }
            }
        }

        #[test]
        fn the_vector_shrinkage_is_the_scalar_one(
            [here, ahead, below, across, down] in proptest::array::uniform5(lanes()),
            rescale in 0.5f32..2.0,
            threshold in 0.0f32..3.0,
        ) {
            let m = Multipliers { prior: Lanes::ZERO, across, down };
            for level in levels() {
                let [mut dual, mut flow] = [[Lanes::ZERO; 2]; 2];
                vectorize!(level, s => {
                    let x = [here, ahead, below].map(|x| Wave::load(s, &x));
                    let found = shrink(s, x, &m, f32x8::splat(s, rescale), f32x8::splat(s, threshold));
                    (0..2).for_each(|axis| {
                        found.0[axis].store(&mut dual[axis]);
                        found.1[axis].store(&mut flow[axis]);
                    });
                });
                for lane in 0..LANES {
                    let right = if lane + 1 < LANES { here.get(lane + 1) } else { ahead.get(0) };
                    let v: [Complex32; 2] = [
                        right - here.get(lane) + across.get(lane) * rescale,
                        below.get(lane) - here.get(lane) + down.get(lane) * rescale,
                    ];
                    for (axis, d) in scalar_shrink(v, threshold).into_iter().enumerate() {
                        let new = v[axis] - d;
                        prop_assert!((dual[axis].get(lane) - new).norm() < 1e-5);
                        prop_assert!((flow[axis].get(lane) - (d - new)).norm() < 1e-5);
                    }
                }
            }
        }

        /// d minimises ½|d − v|² + threshold·|d|: at a non-zero d the slope is zero, at zero |v| is below the threshold.
        #[test]
        fn the_scalar_shrinkage_is_the_minimum([a, b] in [lanes(), lanes()], threshold in 0.01f32..2.0) {
            let v = [a.get(0), b.get(0)];
            let d = scalar_shrink(v, threshold);
            let length = |v: [Complex32; 2]| (v[0].norm_sqr() + v[1].norm_sqr()).sqrt();
            if length(d) > 1e-3 {
                for axis in 0..2 {
                    let slope = d[axis] - v[axis] + d[axis] * (threshold / length(d));
                    prop_assert!(slope.norm() < 1e-3, "{slope}");
                }
            } else {
                prop_assert!(length(v) <= threshold + 1e-3);
            }
        }
    }
}
