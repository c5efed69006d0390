//! What the readings of a whole tile say of its detail.
//!
//! Above some .08 cycles a pixel the readings hide every single detail of L = S1 + i·S2 in their noise. How much of it there is, as a
//! share of what the guide's detail and the degree of polarization make one expect, is a single number, and sixty thousand readings
//! together do tell it: with candidates c for what stage I lacks, its residual r and the noise σ, the shares are
//!
//! s = (Cᵀ AᵀA C + n·I)⁻¹ Cᵀ Aᵀr,  n = σ² · [`DOUBT`],
//!
//! the least squares of r ≈ A·C·s, for shares that are expected to be about 1/√[`DOUBT`]. With the mask taken for an even one,
//! ⟨A u, A v⟩ = ⅛ Σ |K|² û* v̂; Aᵀr is what stage II is given anyway; noise alone has once back-projected a mean square of
//! ¼ σ² mean |K|², from which σ is taken. Means over cells of [`crate::model::CELL`] pixels will do: finer detail does not pass the PSF.
//!
//! Candidates that hold noise of the readings themselves ([`ROUGH`]) agree with it and would be overstated: what is found of them is
//! told to the network, not used by itself. `scripts/train/network.py` has the same function.

use std::sync::Arc;

use nalgebra::{SMatrix, SVector};
use rustfft::{Fft, FftPlanner};

use crate::model::{CELL, TOLD};
use crate::plane::Complex32;

/// Candidates that are the guide's detail times the degree of polarization, fine first; see `mixer.rs`.
pub(super) const DETAILS: [usize; 4] = [3, 6, 9, 12];
/// Candidates that are what L has beyond its blurs.
pub(super) const ROUGH: [usize; 3] = [4, 7, 10];
// What is told: shares of the details, how far they are sure (0 to 1), and of the rough ones, each by itself.
const _: () = assert!(TOLD == 2 * DETAILS.len() + ROUGH.len());
/// One over the expected square of a share.
const DOUBT: f64 = 2.0;
/// Largest share.
const MOST: f64 = 2.0;
/// Noise that is always there, so that an empty tile has shares of zero.
const LEAST: f64 = 1e-9;
const JUDGED: usize = DETAILS.len() + ROUGH.len();

/// |K|²/max|K|² of a PSF at the frequencies of a tile's cells.
#[derive(Clone, Debug)]
pub(super) struct Power {
    /// `[columns, rows]`, in the order of an FFT.
    low: Vec<f32>,
    /// Over all frequencies of the tile.
    mean: f64,
}

impl Power {
    /// From `power`, `[side, side]`, of every frequency of a tile. Allocates.
    ///
    /// # Panics
    /// When the length is another.
    pub(super) fn of(power: &[f32], side: usize) -> Self {
        assert_eq!(power.len(), side * side, "frequencies of another tile");
        let most = power.iter().fold(f32::MIN_POSITIVE, |most, v| most.max(*v));
        let m = side / CELL;
        let at = |k: usize| if k < m / 2 { k } else { k + side - m };
        let low = (0..m * m).map(|i| power[at(i % m) * side + at(i / m)] / most).collect();
        let mean = power.iter().map(|v| f64::from(v / most)).sum::<f64>() / power.len() as f64;
        Self { low, mean }
    }

    /// Of the PSF `samples`, rows of `width`, for tiles of `side` pixels; a larger one is wrapped around. Allocates.
    pub(super) fn of_psf(samples: &[f32], width: usize, side: usize) -> Self {
        let mut image = vec![Complex32::ZERO; side * side];
        for (y, row) in samples.chunks_exact(width).enumerate() {
            for (x, v) in row.iter().enumerate() {
                image[y % side * side + x % side] += v;
            }
        }
        let fft = FftPlanner::new().plan_fft_forward(side);
        let mut scratch = vec![Complex32::ZERO; fft.get_inplace_scratch_len()];
        let mut turned = vec![Complex32::ZERO; side * side];
        transform(&*fft, &mut image, &mut turned, &mut scratch);
        let power: Vec<f32> = (0..side * side).map(|i| image[i % side * side + i / side].norm_sqr()).collect();
        Self::of(&power, side)
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.low[..])
    }
}

/// Buffers for tiles of `side` × `side` cells. Steady state allocates nothing.
pub(super) struct Shares {
    side: usize,
    fft: Arc<dyn Fft<f32>>,
    /// Means over cells, then spectra, of the candidates: `[JUDGED, side, side]`.
    candidates: Vec<Complex32>,
    turned: Vec<Complex32>,
    scratch: Vec<Complex32>,
    found: [f32; DETAILS.len()],
}

impl std::fmt::Debug for Shares {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Shares({} cells, {:?})", self.side, self.found)
    }
}

impl Shares {
    /// Allocates.
    pub(super) fn new(side: usize) -> Self {
        let fft = FftPlanner::new().plan_fft_forward(side);
        Self {
            side,
            candidates: vec![Complex32::ZERO; JUDGED * side * side],
            turned: vec![Complex32::ZERO; side * side],
            scratch: vec![Complex32::ZERO; fft.get_inplace_scratch_len()],
            found: [0.0; DETAILS.len()],
            fft,
        }
    }

    /// Bytes of the buffers.
    pub(super) fn bytes(side: usize) -> usize {
        let scratch = FftPlanner::<f32>::new().plan_fft_forward(side).get_inplace_scratch_len();
        ((JUDGED + 1) * side * side + scratch) * size_of::<Complex32>()
    }

    /// Where the means over cells of [`DETAILS`] and [`ROUGH`] go, `[7, side, side]`, before [`Self::find`].
    pub(super) fn candidates(&mut self) -> &mut [Complex32] {
        &mut self.candidates
    }

    /// The shares of [`DETAILS`] that were found last.
    pub(super) fn found(&self) -> [f32; DETAILS.len()] {
        self.found
    }

    /// What the back-projected residual, real and imaginary part in pixels and `unit` times too large, says of the candidates.
    pub(super) fn find<'a>(
        &mut self,
        residual: impl Iterator<Item = &'a [f32]> + Clone,
        unit: f32,
        power: &Power,
    ) -> [f32; TOLD] {
        let Self { side, fft, candidates, turned, scratch, found } = self;
        let cells = *side * *side;
        let (mut square, pixels) = (0.0, cells * CELL * CELL);
        turned.fill(Complex32::ZERO);
        for (k, plane) in residual.enumerate() {
            for (y, row) in plane.chunks_exact(*side * CELL).enumerate() {
                square += row.iter().map(|v| f64::from(*v * *v)).sum::<f64>();
                for (sum, v) in turned[y / CELL * *side..].iter_mut().zip(row.as_chunks::<CELL>().0) {
                    let v = v.iter().sum::<f32>();
                    if k == 0 { sum.re += v } else { sum.im += v }
                }
            }
        }
        let unit = f64::from(unit);
        let noise = DOUBT / 4.0 * square / pixels as f64 / unit.powi(2) / power.mean + LEAST;
        let scale = 1.0 / ((CELL * CELL) as f64 * unit);
        let along: [f64; JUDGED] = std::array::from_fn(|k| {
            let products = candidates[k * cells..][..cells].iter().zip(&*turned);
            scale * products.map(|(c, r)| f64::from(c.re * r.re + c.im * r.im)).sum::<f64>()
        });
        for image in candidates.chunks_exact_mut(cells) {
            transform(&**fft, image, turned, scratch);
        }
        let seen = |a: usize, b: usize| {
            let [a, b] = [a, b].map(|k| &candidates[k * cells..][..cells]);
            let products = power.low.iter().zip(a.iter().zip(b));
            products.map(|(p, (a, b))| f64::from(p * (a.re * b.re + a.im * b.im))).sum::<f64>() / (8 * cells) as f64
        };
        let mut gram = SMatrix::<f64, { DETAILS.len() }, { DETAILS.len() }>::zeros();
        for a in 0..DETAILS.len() {
            for b in 0..=a {
                gram[(a, b)] = seen(a, b);
                gram[(b, a)] = gram[(a, b)];
            }
        }
        let own = gram.diagonal();
        (0..DETAILS.len()).for_each(|k| gram[(k, k)] += noise);
        let wanted = SVector::<f64, { DETAILS.len() }>::from_fn(|k, _| along[k]);
        let shares = gram.cholesky().map_or_else(SVector::zeros, |gram| gram.solve(&wanted));
        let limited = |v: f64| if v.is_finite() { v.clamp(-MOST, MOST) as f32 } else { 0.0 };
        *found = std::array::from_fn(|k| limited(shares[k]));
        let mut told = [0.0; TOLD];
        for k in 0..DETAILS.len() {
            told[k] = found[k];
            told[DETAILS.len() + k] = limited(own[k] / (own[k] + noise));
        }
        for k in DETAILS.len()..JUDGED {
            told[DETAILS.len() + k] = limited(along[k] / (seen(k, k) + noise));
        }
        told
    }
}

/// The spectrum of a square image, `[columns, rows]`, in its place.
fn transform(fft: &dyn Fft<f32>, image: &mut [Complex32], turned: &mut [Complex32], scratch: &mut [Complex32]) {
    let side = fft.len();
    fft.process_with_scratch(image, scratch);
    for (i, v) in turned.iter_mut().enumerate() {
        *v = image[i % side * side + i / side];
    }
    fft.process_with_scratch(turned, scratch);
    image.copy_from_slice(turned);
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng, rngs::StdRng};

    use super::*;

    /// Seven candidates of noise, and the power of a wide PSF.
    fn camera(m: usize) -> (Vec<Complex32>, Vec<f32>) {
        let mut random = StdRng::seed_from_u64(7);
        let mut noise = || random.random_range(-1.0..1.0f32);
        let candidates = (0..JUDGED * m * m).map(|_| Complex32::new(noise(), noise())).collect();
        let side = m * CELL;
        let signed = |k: usize| if k < side / 2 { k as f32 } else { k as f32 - side as f32 };
        let power = |i: usize| 1.0 / (1.0 + (signed(i % side).powi(2) + 2.0 * signed(i / side).powi(2)) / 20.0);
        (candidates, (0..side * side).map(power).collect())
    }

    /// ⅛ k̃ * k * Σ sₖ cₖ, in pixels that are alike in each cell: what an even mask would send back of candidates, by definition.
    fn seen_back(candidates: &[Complex32], shares: &[f64], power: &[f32], m: usize) -> [Vec<f32>; 2] {
        let side = m * CELL;
        let at = |k: usize| if k < m / 2 { k } else { k + side - m };
        let mut sum = vec![Complex32::ZERO; m * m];
        for (image, share) in candidates.chunks_exact(m * m).zip(shares) {
            sum.iter_mut().zip(image).for_each(|(v, c)| *v += c * *share as f32);
        }
        let wave = |k: usize, x: usize, sign: f32| {
            Complex32::cis(sign * std::f32::consts::TAU * (k * x % m) as f32 / m as f32)
        };
        let all = || (0..m).flat_map(move |y| (0..m).map(move |x| (x, y)));
        let spectrum: Vec<_> = all()
            .map(|(kx, ky)| {
                let v: Complex32 = all().map(|(x, y)| sum[y * m + x] * wave(kx, x, -1.0) * wave(ky, y, -1.0)).sum();
                v * power[at(ky) * side + at(kx)] / (8 * m * m) as f32
            })
            .collect();
        let back: Vec<_> = all()
            .map(|(x, y)| {
                all().map(|(kx, ky)| spectrum[ky * m + kx] * wave(kx, x, 1.0) * wave(ky, y, 1.0)).sum::<Complex32>()
            })
            .collect();
        let plane = |part: fn(&Complex32) -> f32| {
            (0..side * side).map(|i| part(&back[i / side / CELL * m + i % side / CELL])).collect()
        };
        [plane(|v| v.re), plane(|v| v.im)]
    }

    #[test]
    fn shares_that_made_a_residual_are_found_in_it() {
        let m = 8;
        let (candidates, power) = camera(m);
        let made = [0.5, -0.25, 1.5, 0.75];
        let back = seen_back(&candidates, &made, &power, m);
        let mut shares = Shares::new(m);
        shares.candidates().copy_from_slice(&candidates);
        let planes = back.iter().map(Vec::as_slice);
        let mut power = Power::of(&power, m * CELL);
        // so little noise that nothing is doubted
        power.mean *= 1e9;
        let told = shares.find(planes, 1.0, &power);
        for (found, made) in shares.found().iter().zip(made) {
            assert!((f64::from(*found) - made).abs() < 1e-3, "{found} instead of {made}");
        }
        assert_eq!(told[..DETAILS.len()], shares.found());
        assert!(told[DETAILS.len()..2 * DETAILS.len()].iter().all(|sure| *sure > 0.999), "{told:?}");
    }

    #[test]
    fn shares_do_not_depend_on_the_residuals_unit_and_are_doubted_in_noise() {
        let m = 8;
        let (candidates, power) = camera(m);
        let back = seen_back(&candidates, &[1.0; 4], &power, m);
        let large: Vec<Vec<f32>> = back.iter().map(|plane| plane.iter().map(|v| 1000.0 * v).collect()).collect();
        let mut power = Power::of(&power, m * CELL);
        let find = |planes: &[Vec<f32>], unit: f32, power: &Power| {
            let mut shares = Shares::new(m);
            shares.candidates().copy_from_slice(&candidates);
            shares.find(planes.iter().map(Vec::as_slice), unit, power)
        };
        let (one, other) = (find(&back, 1.0, &power), find(&large, 1000.0, &power));
        one.iter().zip(other).for_each(|(a, b)| assert!((a - b).abs() < 1e-4, "{one:?} {other:?}"));
        power.mean *= 1e-6;
        let doubted = find(&back, 1.0, &power);
        assert!(doubted[..2 * DETAILS.len()].iter().all(|v| v.abs() < 0.05), "{doubted:?}");
    }

    #[test]
    fn nothing_and_nonsense_have_shares_of_zero() {
        let m = 4;
        let mut shares = Shares::new(m);
        let power = Power::of(&vec![1.0; (m * CELL).pow(2)], m * CELL);
        for fill in [0.0, f32::NAN] {
            shares.candidates().fill(Complex32::new(fill, fill));
            let plane = vec![fill; (m * CELL).pow(2)];
            let told = shares.find([&plane[..], &plane[..]].into_iter(), 1.0, &power);
            assert_eq!(told, [0.0; TOLD]);
        }
    }

    #[test]
    fn the_power_of_a_psf_is_that_of_its_spectrum() {
        // two points: |1 + e^{iφ}|² of the distance between them
        let (side, width) = (16, 5);
        let mut psf = vec![0.0; 15];
        (psf[1], psf[2 * width + 1]) = (0.5, 0.5);
        let power = Power::of_psf(&psf, width, side);
        let m = side / CELL;
        for (i, found) in power.low.iter().enumerate() {
            let ky = [0.0, 1.0, -2.0, -1.0][i % m];
            let expected = (std::f32::consts::TAU * ky / side as f32).cos().powi(2);
            assert!((found - expected).abs() < 1e-5, "{i}: {found} instead of {expected}");
        }
        assert!((power.mean - 0.5).abs() < 1e-6, "{}", power.mean);
    }
}
