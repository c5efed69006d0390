//! How much detail of L = S1 + i·S2 the readings of a whole tile show.
//!
//! Above about 0.08 cycles per pixel the noise of the readings hides every single detail of L. But the amount of detail, as a share of
//! what the guide's detail and the degree of polarization predict, is a single number, which sixty thousand readings together do
//! determine. With candidates C for what stage I lacks, its residual r and the noise σ, the shares are
//!
//! s = (Cᵀ AᵀA C + σ²·D)⁻¹ Cᵀ Aᵀr,
//!
//! the least squares of r ≈ A·C·s with an expected size of 1/√d for each share, d from the diagonal of D ([`DOUBT`]). With the mask
//! approximated as uniform ⟨A u, A v⟩ = ⅛ Σ |K|² û* v̂, and Aᵀr is an input of stage II. Back-projected noise has a mean square of
//! ¼ σ² mean |K|², which gives σ. Means over cells of [`CELL`] pixels suffice, because finer detail does not pass the PSF.
//!
//! A share whose standard deviation is as large as itself says nothing. So s counts s²/(s² + [`SURE`]·v) of itself, with its variance v on
//! the diagonal of σ²·(Cᵀ AᵀA C + σ²·D)⁻¹. Without this the network adds the guide's detail to scenes whose polarization has none, such as
//! cloth, print and haze, and loses up to 1 dB there.
//!
//! Each scale of detail has three shares ([`KINDS`]): of the detail, of its magnitude (highlights have another degree of polarization
//! than dark lines), and of its product with the brightness around it (dark surfaces polarize more).
//!
//! The rough candidates ([`ROUGH`]) contain noise of the readings themselves, with which the readings agree. Their shares would be
//! overestimated, so they are features for the network and nothing more. `scripts/train/network.py` computes the same.

use std::sync::Arc;

use nalgebra::{SMatrix, SVector};
use rustfft::{Fft, FftPlanner};

use crate::image::{Buffers, Complex32};
use crate::optics::lanes::vectorize;
use crate::refine::model::{CELL, TILE_FEATURES};

/// Scales of the guide's detail.
pub(super) const SCALES: usize = 4;
/// Kinds of detail at each scale: the detail, its magnitude, its product with the brightness around it.
pub(super) const KINDS: usize = 3;
/// Scales of the difference between L and its local means.
pub(super) const ROUGH: usize = 3;
/// Candidates whose shares are fitted together: the scales of the first kind, of the second, of the third.
pub(super) const FITTED: usize = KINDS * SCALES;
/// All candidates: the fitted ones, then the rough ones.
const ALL: usize = FITTED + ROUGH;
// Features: all shares, the certainty (0 to 1) of those of the first kind, and the share of each rough candidate, fitted alone.
const _: () = assert!(TILE_FEATURES == FITTED + SCALES + ROUGH);
/// Inverse of the expected square of a share, for each kind.
const DOUBT: [f64; KINDS] = [2.0, 6.0, 6.0];
/// Square of a share over its variance at which half of it is believed.
const SURE: f64 = 4.0;
/// Largest share.
const MOST: f64 = 2.0;
/// Added to the variance of the noise, so that an empty tile has shares of zero.
const LEAST: f64 = 1e-9;

/// |K|²/max|K|² of a PSF at the frequencies of a tile.
#[derive(Clone, Debug)]
pub(super) struct Power {
    /// √(⅛ |K|²) at the frequencies of the tile's cells, `[columns, rows]`, in FFT order.
    response: Vec<f32>,
    /// Mean of |K|² over all frequencies of the tile.
    mean: f64,
}

impl Power {
    /// From |K|² of every frequency of a tile, `[side, side]`, in FFT order and any unit. Allocates.
    ///
    /// # Panics
    /// When the length is wrong.
    pub(super) fn new(power: &[f32], side: usize) -> Self {
        assert_eq!(power.len(), side * side, "frequencies of another tile");
        let most = power.iter().fold(f32::MIN_POSITIVE, |most, v| most.max(*v));
        let m = side / CELL;
        let at = |k: usize| if k < m / 2 { k } else { k + side - m };
        let response = (0..m * m).map(|i| (power[at(i % m) * side + at(i / m)] / most / 8.0).sqrt()).collect();
        let mean = power.iter().map(|v| f64::from(v / most)).sum::<f64>() / power.len() as f64;
        Self { response, mean }
    }

    /// From a PSF in rows of `width` pixels, for tiles of `side` pixels. A larger PSF is wrapped around. Allocates.
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
        let power: Vec<f32> = (0..side * side).map(|i| turned[i % side * side + i / side].norm_sqr()).collect();
        Self::new(&power, side)
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> usize {
        size_of_val(&self.response[..])
    }
}

/// Buffers for tiles of `side` × `side` cells. After construction nothing is allocated.
pub(super) struct Shares {
    side: usize,
    fft: Arc<dyn Fft<f32>>,
    /// Real and imaginary parts of the candidates, `[ALL, 2, side, side]`: means over cells, later the spectra behind the PSF.
    candidates: Vec<f32>,
    /// Means over cells of the back-projected residual, `[2, side, side]`.
    residual: Vec<f32>,
    image: Vec<Complex32>,
    turned: Vec<Complex32>,
    scratch: Vec<Complex32>,
    shares: [[f32; SCALES]; KINDS],
}

impl std::fmt::Debug for Shares {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Shares({} cells, {:?})", self.side, self.shares)
    }
}

impl Shares {
    pub(super) fn new(buffers: &mut Buffers, side: usize) -> Self {
        let (fft, cells) = (FftPlanner::new().plan_fft_forward(side), side * side);
        Self {
            side,
            candidates: buffers.filled(0.0, 2 * ALL * cells),
            residual: buffers.filled(0.0, 2 * cells),
            image: buffers.filled(Complex32::ZERO, cells),
            turned: buffers.filled(Complex32::ZERO, cells),
            scratch: buffers.filled(Complex32::ZERO, fft.get_inplace_scratch_len()),
            shares: [[0.0; SCALES]; KINDS],
            fft,
        }
    }

    /// The means over cells of the candidates, `[ALL, 2, side, side]`, to be written before [`Self::find`].
    pub(super) fn candidates(&mut self) -> &mut [f32] {
        &mut self.candidates
    }

    /// The means over cells of the back-projected residual, `[2, side, side]`, to be written before [`Self::find`].
    pub(super) fn residual(&mut self) -> &mut [f32] {
        &mut self.residual
    }

    /// The shares of each kind that [`Self::find`] found last, fine detail first.
    pub(super) fn shares(&self) -> [[f32; SCALES]; KINDS] {
        self.shares
    }

    /// Finds the shares of the candidates in the back-projected residual R1 + i·R2, which is given in pixels and `unit` times too large.
    /// Returns the features of the tile.
    pub(super) fn find(&mut self, residual: [&[f32]; 2], unit: f32, power: &Power) -> [f32; TILE_FEATURES] {
        let Self { side, fft, candidates, residual: means, image, turned, scratch, shares: found } = self;
        let cells = *side * *side;
        let pixels = cells * CELL * CELL;
        let square: f64 = vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            residual.iter().map(|plane| dot(plane, plane)).sum()
        });
        let unit = f64::from(unit);
        let variance = square / pixels as f64 / unit.powi(2) / power.mean / 4.0;
        let doubt = DOUBT.map(|doubt| doubt * variance + LEAST);
        let along: [f64; ALL] = vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            std::array::from_fn(|k| dot(&candidates[2 * k * cells..][..2 * cells], means) / unit)
        });
        for candidate in candidates.chunks_exact_mut(2 * cells) {
            let (re, im) = candidate.split_at_mut(cells);
            image.iter_mut().zip(re.iter().zip(&*im)).for_each(|(v, (re, im))| *v = Complex32::new(*re, *im));
            transform(&**fft, image, turned, scratch);
            let shown = turned.iter().zip(&power.response);
            re.iter_mut().zip(im).zip(shown).for_each(|((re, im), (v, seen))| (*re, *im) = (v.re * seen, v.im * seen));
        }
        let mut gram = SMatrix::<f64, FITTED, FITTED>::zeros();
        let rough: [f64; ROUGH] = vectorize!(fearless_simd::Level::new(), s => {
            let _ = s;
            let spectrum = |k: usize| &candidates[2 * k * cells..][..2 * cells];
            for a in 0..FITTED {
                for b in 0..=a {
                    gram[(a, b)] = dot(spectrum(a), spectrum(b)) / cells as f64;
                    gram[(b, a)] = gram[(a, b)];
                }
            }
            std::array::from_fn(|k| dot(spectrum(FITTED + k), spectrum(FITTED + k)) / cells as f64)
        });
        let own = gram.diagonal();
        (0..FITTED).for_each(|k| gram[(k, k)] += doubt[k / SCALES]);
        let wanted = SVector::<f64, FITTED>::from_fn(|k, _| along[k]);
        let shares = gram.try_inverse().map_or_else(SVector::zeros, |inverse| {
            let shares = inverse * wanted;
            let sure = |s: f64, inverse: f64| s.powi(3) / (s * s + SURE * inverse * variance + 1e-12);
            shares.zip_map(&inverse.diagonal(), sure)
        });
        let limited = |v: f64| if v.is_finite() { v.clamp(-MOST, MOST) as f32 } else { 0.0 };
        *found = std::array::from_fn(|kind| std::array::from_fn(|k| limited(shares[kind * SCALES + k])));
        let mut features = [0.0; TILE_FEATURES];
        features[..FITTED].copy_from_slice(found.as_flattened());
        (0..SCALES).for_each(|k| features[FITTED + k] = limited(own[k] / (own[k] + doubt[0])));
        (0..ROUGH).for_each(|k| features[FITTED + SCALES + k] = limited(along[FITTED + k] / (rough[k] + doubt[0])));
        features
    }
}

/// Writes the spectrum of a square image to `turned`, `[columns, rows]`.
fn transform(fft: &dyn Fft<f32>, image: &mut [Complex32], turned: &mut [Complex32], scratch: &mut [Complex32]) {
    let side = fft.len();
    fft.process_with_scratch(image, scratch);
    for (x, column) in turned.chunks_exact_mut(side).enumerate() {
        column.iter_mut().zip(image.chunks_exact(side)).for_each(|(v, row)| *v = row[x]);
    }
    fft.process_with_scratch(turned, scratch);
}

/// a·b. Sums in f32 are short enough to be accurate. Lengths are multiples of 16.
#[inline(always)]
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let parts = a.chunks(1024).zip(b.chunks(1024));
    let of_part = |(a, b): (&[f32], &[f32])| {
        let mut sums = [0.0f32; 16];
        for (a, b) in a.as_chunks::<16>().0.iter().zip(b.as_chunks::<16>().0) {
            sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a * b);
        }
        f64::from(sums.iter().sum::<f32>())
    };
    parts.map(of_part).sum()
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng, rngs::StdRng};

    use super::*;

    /// Candidates of noise, and the power of a wide PSF.
    fn camera(m: usize) -> (Vec<f32>, Vec<f32>) {
        let mut random = StdRng::seed_from_u64(7);
        let mut noise = || random.random_range(-1.0..1.0f32);
        let candidates = (0..2 * ALL * m * m).map(|_| noise()).collect();
        let side = m * CELL;
        let signed = |k: usize| if k < side / 2 { k as f32 } else { k as f32 - side as f32 };
        let power = |i: usize| 1.0 / (1.0 + (signed(i % side).powi(2) + 2.0 * signed(i / side).powi(2)) / 20.0);
        (candidates, (0..side * side).map(power).collect())
    }

    /// The back-projection ⅛ k̃ * k * Σ sₖ cₖ of candidates behind a uniform mask, by definition. All pixels of a cell are alike.
    fn seen_back(candidates: &[f32], shares: &[f64], power: &[f32], m: usize) -> [Vec<f32>; 2] {
        let side = m * CELL;
        let at = |k: usize| if k < m / 2 { k } else { k + side - m };
        let mut sum = vec![Complex32::ZERO; m * m];
        for (image, share) in candidates.chunks_exact(2 * m * m).zip(shares) {
            let (re, im) = image.split_at(m * m);
            let image = re.iter().zip(im).map(|(re, im)| Complex32::new(*re, *im));
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

    /// The features that `shares` finds in the back-projected residual `back`.
    fn found(
        shares: &mut Shares,
        candidates: &[f32],
        back: &[Vec<f32>; 2],
        unit: f32,
        power: &Power,
    ) -> [f32; TILE_FEATURES] {
        let m = shares.side;
        shares.candidates().copy_from_slice(candidates);
        for (plane, means) in back.iter().zip(shares.residual().chunks_exact_mut(m * m)) {
            means.fill(0.0);
            plane
                .iter()
                .enumerate()
                .for_each(|(i, v)| means[i / (m * CELL) / CELL * m + i % (m * CELL) / CELL] += v / 16.0);
        }
        shares.find([&back[0], &back[1]], unit, power)
    }

    #[test]
    fn shares_that_made_a_residual_are_found_in_it() {
        let m = 8;
        let (candidates, power) = camera(m);
        let made = [0.5, -0.25, 1.5, 0.75, 0.1, -0.3, 0.0, 0.6, -0.9, 1.2, 0.4, -0.2];
        let back = seen_back(&candidates, &made, &power, m);
        let mut shares = Buffers::allocate(|buffers| Shares::new(buffers, m));
        let mut power = Power::new(&power, m * CELL);
        // so little noise that nothing is doubted
        power.mean *= 1e9;
        let features = found(&mut shares, &candidates, &back, 1.0, &power);
        for (found, made) in shares.shares().as_flattened().iter().zip(made) {
            assert!((f64::from(*found) - made).abs() < 1e-3, "{found} instead of {made}");
        }
        assert_eq!(features[..FITTED], *shares.shares().as_flattened());
        assert!(features[FITTED..FITTED + SCALES].iter().all(|sure| *sure > 0.999), "{features:?}");
    }

    #[test]
    fn shares_do_not_depend_on_the_residuals_unit_and_are_doubted_in_noise() {
        let m = 8;
        let (candidates, power) = camera(m);
        let back = seen_back(&candidates, &[1.0; FITTED], &power, m);
        let large = back.each_ref().map(|plane| plane.iter().map(|v| 1000.0 * v).collect());
        let mut power = Power::new(&power, m * CELL);
        let find = |planes: &[Vec<f32>; 2], unit: f32, power: &Power| {
            found(&mut Buffers::allocate(|buffers| Shares::new(buffers, m)), &candidates, planes, unit, power)
        };
        let (one, other) = (find(&back, 1.0, &power), find(&large, 1000.0, &power));
        one.iter().zip(other).for_each(|(a, b)| assert!((a - b).abs() < 1e-4, "{one:?} {other:?}"));
        power.mean *= 1e-6;
        let doubted = find(&back, 1.0, &power);
        assert!(doubted[..FITTED + SCALES].iter().all(|v| v.abs() < 0.05), "{doubted:?}");
    }

    #[test]
    fn nothing_and_nonsense_have_shares_of_zero() {
        let m = 4;
        let mut shares = Buffers::allocate(|buffers| Shares::new(buffers, m));
        let power = Power::new(&vec![1.0; (m * CELL).pow(2)], m * CELL);
        for fill in [0.0, f32::NAN] {
            let (candidates, plane) = (vec![fill; 2 * ALL * m * m], vec![fill; (m * CELL).pow(2)]);
            let features = found(&mut shares, &candidates, &[plane.clone(), plane], 1.0, &power);
            assert_eq!(features, [0.0; TILE_FEATURES]);
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
        for (i, seen) in power.response.iter().enumerate() {
            let found = 8.0 * seen * seen;
            let ky = [0.0, 1.0, -2.0, -1.0][i % m];
            let expected = (std::f32::consts::TAU * ky / side as f32).cos().powi(2);
            assert!((found - expected).abs() < 1e-5, "{i}: {found} instead of {expected}");
        }
        assert!((power.mean - 0.5).abs() < 1e-6, "{}", power.mean);
    }
}
