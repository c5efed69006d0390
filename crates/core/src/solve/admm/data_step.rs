//! The data step of an iteration: ν from k * x, pixel by pixel.
//!
//! It minimises ½w(b − Σ Re(ē ν))² + ½ρ Σ|ν − v|² over the ν of all unknowns, with v = k * x + u. A pixel reads one real number, so the
//! step goes along e, by the residual at v:
//!
//! ```text
//! r = b − Σ Re(ē v)        ν = v + e·w·r / (w Σ|e|² + ρ)        u' = v − ν
//! ```

use fearless_simd::f32x8;
use fearless_simd::prelude::*;

use crate::optics::lanes::{LANES, Lanes, Wave};
use crate::solve::guided_filter::Reals;

/// A row of one unknown.
pub(super) struct DataRow<'a> {
    /// k * x, then ν − u' − k * x.
    pub(super) blurred: &'a mut [Lanes],
    /// u, then u'.
    pub(super) dual: &'a mut [Lanes],
}

/// Readings of a row of pixels, eight after eight.
#[derive(Clone, Copy)]
pub(super) struct Readings<'a> {
    /// Response e to each unknown.
    pub(super) responses: &'a [Vec<Lanes>; 2],
    /// Reading b.
    pub(super) target: &'a [Reals],
    /// Weight w of the reading, 0 or more.
    pub(super) weight: &'a [Reals],
}

/// ν at one pixel, in plain form: what [`data_row`] is tested against. Also the weighted square of the residual at k * x.
#[cfg(test)]
pub(super) fn scalar<const K: usize>(
    blurred: [num_complex::Complex32; K],
    dual: [num_complex::Complex32; K],
    response: [num_complex::Complex32; K],
    (target, weight): (f32, f32),
    rho: f32,
) -> ([num_complex::Complex32; K], f32) {
    let v: [_; K] = std::array::from_fn(|k| blurred[k] + dual[k]);
    let residual =
        |v: &[num_complex::Complex32; K]| target - (0..K).map(|k| (response[k].conj() * v[k]).re).sum::<f32>();
    let norm: f32 = response.iter().map(num_complex::Complex::norm_sqr).sum();
    let step = weight * residual(&v) / (weight * norm + rho);
    (std::array::from_fn(|k| v[k] + response[k] * step), weight * residual(&blurred).powi(2))
}

/// The data step on a row of `K` unknowns. Returns the weighted sum of squares of the residual at k * x.
#[inline(always)]
pub(super) fn data_row<S: Simd, const K: usize>(
    s: S,
    rows: &mut [DataRow<'_>; K],
    Readings { responses, target, weight }: Readings<'_>,
    rho: f32,
) -> f32 {
    let mut energy = f32x8::splat(s, 0.0);
    for (i, (target, weight)) in target.iter().zip(weight).enumerate() {
        let weight = f32x8::simd_from(s, *weight);
        let (mut read, mut dual, mut norm) = (f32x8::splat(s, 0.0), f32x8::splat(s, 0.0), f32x8::splat(s, rho));
        for k in 0..K {
            let e = Wave::load(s, &responses[k][i]);
            read += e.inner(Wave::load(s, &rows[k].blurred[i]));
            dual += e.inner(Wave::load(s, &rows[k].dual[i]));
            norm += weight * e.norm_sqr();
        }
        let residual = f32x8::simd_from(s, *target) - read;
        let weighted = weight * residual;
        energy = weighted.mul_add(residual, energy);
        let step = (weighted - weight * dual) / norm;
        for k in 0..K {
            // ν − v, so that u' = −d and ν − u' − k * x = u + 2d.
            let d = Wave::load(s, &responses[k][i]).scale(step);
            let DataRow { blurred, dual } = &mut rows[k];
            Wave::load(s, &dual[i]).plus(d, f32x8::splat(s, 2.0)).store(&mut blurred[i]);
            Wave { re: -d.re, im: -d.im }.store(&mut dual[i]);
        }
    }
    <[f32; LANES]>::from(energy).iter().sum()
}

#[cfg(test)]
mod tests {
    use fearless_simd::Level;
    use num_complex::Complex32;
    use proptest::prelude::*;

    use super::*;
    use crate::optics::lanes::{levels, vectorize};
    use crate::solve::admm::testing::lanes;

    fn weights() -> impl Strategy<Value = Reals> {
        proptest::array::uniform8(prop_oneof![Just(0.0f32), Just(1.0f32), 0.0f32..2.0])
    }

    fn numbers() -> impl Strategy<Value = Reals> {
        proptest::array::uniform8(-1.0f32..1.0)
    }

    /// The vector form of `K` unknowns against the scalar one.
    fn compare<const K: usize>(
        level: Level,
        [blurred, duals, responses]: [[Lanes; 2]; 3],
        (target, weight): (Reals, Reals),
        rho: f32,
    ) -> Result<(), TestCaseError> {
        let mut found: [_; K] = std::array::from_fn(|k| ([blurred[k]], [duals[k]]));
        let mut rows = found.each_mut().map(|(blurred, dual)| DataRow { blurred, dual });
        let responses_of = responses.map(|e| vec![e]);
        let readings = Readings { responses: &responses_of, target: &[target], weight: &[weight] };
        let energy = vectorize!(level, s => data_row(s, &mut rows, readings, rho));
        let mut sum = 0.0;
        for lane in 0..LANES {
            let at = |images: &[Lanes; 2]| -> [Complex32; K] { std::array::from_fn(|k| images[k].get(lane)) };
            let (x, u) = (at(&blurred), at(&duals));
            let (nu, square) = scalar(x, u, at(&responses), (target[lane], weight[lane]), rho);
            sum += square;
            for k in 0..K {
                let dual = x[k] + u[k] - nu[k];
                let ([blurred], [new]) = &found[k];
                prop_assert!((new.get(lane) - dual).norm() < 1e-5);
                prop_assert!((blurred.get(lane) - (nu[k] - dual - x[k])).norm() < 1e-5);
            }
        }
        prop_assert!((energy - sum).abs() < 1e-4 * (1.0 + sum), "{energy} {sum}");
        Ok(())
    }

    proptest! {
        #[test]
        fn the_vector_form_is_the_scalar_one(
            images in proptest::array::uniform3([lanes(), lanes()]),
            readings in (numbers(), weights()),
            rho in 0.1f32..2.0,
        ) {
            for level in levels() {
                compare::<1>(level, images, readings, rho)?;
                compare::<2>(level, images, readings, rho)?;
            }
        }

        /// Derivative of what the step minimises, at ν.
        #[test]
        fn the_scalar_form_is_the_minimum(
            [blurred, dual, response] in proptest::array::uniform3([lanes(), lanes()]),
            target in -1.0f32..1.0,
            weight in 0.0f32..2.0,
            rho in 0.1f32..2.0,
        ) {
            let [blurred, dual, response] = [blurred, dual, response].map(|v| v.map(|v| v.get(0)));
            let (nu, _) = scalar(blurred, dual, response, (target, weight), rho);
            let residual = target - (0..2).map(|k| (response[k].conj() * nu[k]).re).sum::<f32>();
            for k in 0..2 {
                let slope = (nu[k] - blurred[k] - dual[k]) * rho - response[k] * weight * residual;
                prop_assert!(slope.norm() < 1e-5, "{slope}");
            }
        }
    }
}
