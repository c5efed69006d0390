//! Errors of a reconstruction against the truth.
//!
//! Shapes: angle images `[P, H, W]` or `[C, P, H, W]`, intensities behind ideal polarizers in units of full scale, in the order
//! of the angles. Only PSNR and DoLP clamp values, as stated at [`Scores`]. All scores are computed in double precision.
//!
//! ```
//! use stokescope::{files::{Array, Values}, evaluate::score};
//! use stokescope_core::polarization::Angle;
//! let flat = |value| Array { shape: vec![3, 16, 16], samples: Values::F32(vec![value; 768]) };
//! let scores = score(&flat(0.4), &flat(0.5), &Angle::three())?;
//! assert!((scores.psnr - 20.0).abs() < 1e-4); // an error of 0.1 everywhere
//! # Ok::<(), stokescope::evaluate::EvaluateError>(())
//! ```

pub mod bench;
mod folders;
mod ssim;

use std::path::PathBuf;

use nalgebra::DMatrix;
use serde::Serialize;

pub use folders::{Pair, Pairs, pairs, score_files, score_images};

use crate::files::{Array, ArrayError, Values};
use stokescope_core::image::Size;
use stokescope_core::polarization::Angle;

/// Shortest side of an image in pixels: the window of SSIM.
pub const MIN_SIDE: usize = ssim::WINDOW;
/// Smallest S0 that DoLP is divided by, in units of full scale.
const MIN_S0: f64 = 0.02;

/// Errors of an estimate. The PSNR of a perfect estimate is infinite, written as null in JSON.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// Peak signal-to-noise ratio of the angle images in dB, peak 1, both sides clamped to 0 … 1; mean over the images.
    pub psnr: f64,
    /// Structural similarity of the angle images (Wang et al. 2004: 11×11 Gaussian window, σ 1.5, peak 1); mean over the images.
    pub ssim: f64,
    /// Peak signal-to-noise ratio of S1 and S2 together in dB, peak 1, not clamped.
    pub s12_psnr: f64,
    /// Mean absolute error of DoLP, clamped to 0 … 1, over all pixels.
    pub dolp_mae: f64,
    /// Mean absolute error of AoLP in degrees, 0 to 90, over pixels with true DoLP above 0.1 and true S0 above 0.05; 0 without such
    /// pixels.
    pub aolp_mae_deg: f64,
}

/// Reason why an estimate cannot be scored.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// A file cannot be read.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// The two arrays differ in shape.
    #[error("the estimate has the shape {estimate:?}, the truth {truth:?}: allowed are equal shapes")]
    Shapes {
        /// Shape of the estimate.
        estimate: Vec<usize>,
        /// Shape of the truth.
        truth: Vec<usize>,
    },
    /// The arrays are not angle images.
    #[error("shape {found:?}, allowed: [{angles}, H, W] or [C, {angles}, H, W] with H and W at least {MIN_SIDE}")]
    NotAngles {
        /// Shape of both arrays.
        found: Vec<usize>,
        /// Number of polarizer angles, or "3 or 4".
        angles: String,
    },
    /// The polarizer angles do not determine linear polarization.
    #[error("angles {}: allowed are at least three different ones", .0.iter().map(ToString::to_string).collect::<Vec<_>>().join(", "))]
    Angles(Vec<Angle>),
    /// A value is not finite.
    #[error("the {side} holds {value} at {index:?}, allowed: finite values")]
    NonFinite {
        /// Estimate or truth.
        side: &'static str,
        /// Index of the value along each axis.
        index: Vec<usize>,
        /// NaN or an infinity.
        value: f32,
    },
    /// Another error, with the file it concerns.
    #[error("{}: {source}", estimate.display())]
    Refused {
        /// File of the estimate.
        estimate: PathBuf,
        /// Error.
        source: Box<EvaluateError>,
    },
    /// A folder cannot be listed.
    #[error("{}: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// Reason.
        source: std::io::Error,
    },
    /// One path is a folder and the other is not.
    #[error("{} and {}: allowed are two NPY files or two folders", estimate.display(), truth.display())]
    Mixed {
        /// Path of the estimate.
        estimate: PathBuf,
        /// Path of the truth.
        truth: PathBuf,
    },
    /// No NPY file name exists in both folders.
    #[error("{} and {}: no NPY file of the same name in both", estimate.display(), truth.display())]
    NoPairs {
        /// Folder of the estimates.
        estimate: PathBuf,
        /// Folder of the truth files.
        truth: PathBuf,
    },
}

/// Scores angle images at `angles` against the truth.
///
/// # Errors
/// [`EvaluateError`]: the shapes differ or are not those of angle images, or a value is not finite.
pub fn score(estimate: &Array, truth: &Array, angles: &[Angle]) -> Result<Scores, EvaluateError> {
    if estimate.shape != truth.shape {
        return Err(EvaluateError::Shapes { estimate: estimate.shape.clone(), truth: truth.shape.clone() });
    }
    let (channels, size) = match truth.shape[..] {
        [p, height, width] if p == angles.len() => (1, Size::new(width, height)),
        [channels, p, height, width] if p == angles.len() => (channels, Size::new(width, height)),
        _ => return Err(not_angles(truth, angles.len().to_string())),
    };
    if size.width.min(size.height) < MIN_SIDE {
        return Err(not_angles(truth, angles.len().to_string()));
    }
    let to_stokes = to_stokes(angles)?;
    let (estimate, truth) = (finite(estimate, "estimate")?, finite(truth, "truth")?);

    let n = size.pixels();
    let images = (channels * angles.len()) as f64;
    let (mut psnr, mut similarity) = (0.0, 0.0);
    for (e, t) in estimate.chunks_exact(n).zip(truth.chunks_exact(n)) {
        let squares: f64 = e.iter().zip(t).map(|(e, t)| (e.clamp(0.0, 1.0) - t.clamp(0.0, 1.0)).powi(2)).sum();
        psnr += decibels(squares / n as f64);
        similarity += ssim::ssim(size, e, t);
    }
    let per_channel = n * angles.len();
    let mut polarization = Polarization::default();
    for (e, t) in estimate.chunks_exact(per_channel).zip(truth.chunks_exact(per_channel)) {
        for pixel in 0..n {
            polarization.add(to_stokes.at(e, n, pixel), to_stokes.at(t, n, pixel));
        }
    }
    let pixels = (channels * n) as f64;
    Ok(Scores {
        psnr: psnr / images,
        ssim: similarity / images,
        s12_psnr: decibels(polarization.s12_squares / (2.0 * pixels)),
        dolp_mae: polarization.dolp / pixels,
        aolp_mae_deg: polarization.aolp / polarization.polarized.max(1.0),
    })
}

fn not_angles(array: &Array, angles: String) -> EvaluateError {
    EvaluateError::NotAngles { found: array.shape.clone(), angles }
}

/// Sums of polarization errors over pixels.
#[derive(Default)]
struct Polarization {
    s12_squares: f64,
    dolp: f64,
    aolp: f64,
    /// Number of pixels that contribute to `aolp`.
    polarized: f64,
}

impl Polarization {
    fn add(&mut self, estimate: [f64; 3], truth: [f64; 3]) {
        // double precision and a smallest S0, unlike the formulas of the result images
        let dolp = |[s0, s1, s2]: [f64; 3]| (s1.hypot(s2) / s0.max(MIN_S0)).clamp(0.0, 1.0);
        let aolp = |[_, s1, s2]: [f64; 3]| 0.5 * s2.atan2(s1).to_degrees();
        self.s12_squares += (estimate[1] - truth[1]).powi(2) + (estimate[2] - truth[2]).powi(2);
        self.dolp += (dolp(estimate) - dolp(truth)).abs();
        if dolp(truth) > 0.1 && truth[0] > 0.05 {
            self.aolp += ((aolp(estimate) - aolp(truth) + 90.0).rem_euclid(180.0) - 90.0).abs();
            self.polarized += 1.0;
        }
    }
}

/// PSNR in dB of a mean square error, with peak 1.
fn decibels(mean_square: f64) -> f64 {
    -10.0 * mean_square.log10()
}

/// Rows S0, S1, S2 of the pseudo-inverse of ½[1, cos 2θ, sin 2θ], one column per angle θ.
struct ToStokes([Vec<f64>; 3]);

fn to_stokes(angles: &[Angle]) -> Result<ToStokes, EvaluateError> {
    let analyzers = DMatrix::from_fn(angles.len(), 3, |p, k| 0.5 * [1.0, angles[p].cos2(), angles[p].sin2()][k]);
    let svd = analyzers.svd(true, true);
    if svd.rank(1e-6) < 3 {
        return Err(EvaluateError::Angles(angles.to_vec()));
    }
    let inverse = svd.pseudo_inverse(1e-9).map_err(|_| EvaluateError::Angles(angles.to_vec()))?;
    Ok(ToStokes([0, 1, 2].map(|k| inverse.row(k).iter().copied().collect())))
}

impl ToStokes {
    /// Stokes vector of one pixel of the angle images, which have `n` pixels each.
    fn at(&self, images: &[f64], n: usize, pixel: usize) -> [f64; 3] {
        [0, 1, 2].map(|k| self.0[k].iter().enumerate().map(|(p, weight)| weight * images[p * n + pixel]).sum())
    }
}

/// Converts the values to double precision and checks that all are finite.
fn finite(array: &Array, side: &'static str) -> Result<Vec<f64>, EvaluateError> {
    match &array.samples {
        Values::U8(v) => Ok(v.iter().map(|&v| f64::from(v)).collect()),
        Values::U16(v) => Ok(v.iter().map(|&v| f64::from(v)).collect()),
        Values::F32(v) => match v.iter().position(|v| !v.is_finite()) {
            None => Ok(v.iter().map(|&v| f64::from(v)).collect()),
            Some(at) => Err(EvaluateError::NonFinite { side, index: index(&array.shape, at), value: v[at] }),
        },
    }
}

/// Index along each axis of the value at position `at`.
fn index(shape: &[usize], mut at: usize) -> Vec<usize> {
    let mut index = vec![0; shape.len()];
    for (i, n) in index.iter_mut().zip(shape).rev() {
        *i = at % n;
        at /= n;
    }
    index
}

#[cfg(test)]
mod tests {
    use super::*;

    fn array(shape: &[usize], f: impl Fn(usize) -> f32) -> Array {
        Array { shape: shape.to_vec(), samples: Values::F32((0..shape.iter().product()).map(f).collect()) }
    }

    /// Test image that NumPy reproduces exactly: hashes of the index, multiples of 1/1024.
    fn truth(shape: &[usize]) -> Array {
        array(shape, |i| ((i * i * 7 + i * 131) % 1021) as f32 / 1024.0)
    }

    fn estimate(shape: &[usize]) -> Array {
        array(shape, |i| ((i * i * 7 + i * 131) % 1021) as f32 / 1024.0 + ((i * 37) % 101) as f32 / 512.0 - 0.125)
    }

    fn assert_scores(found: Scores, expected: Scores) {
        let pairs = [
            (found.psnr, expected.psnr),
            (found.ssim, expected.ssim),
            (found.s12_psnr, expected.s12_psnr),
            (found.dolp_mae, expected.dolp_mae),
            (found.aolp_mae_deg, expected.aolp_mae_deg),
        ];
        assert!(pairs.iter().all(|(f, e)| (f - e).abs() < 1e-9 * e.abs().max(1.0)), "{found:?}, expected {expected:?}");
    }

    const FOUR: Scores = Scores {
        psnr: 24.31206911666618,
        ssim: 0.9781550810370123,
        s12_psnr: 20.13093769368261,
        dolp_mae: 0.09042362405701762,
        aolp_mae_deg: 5.644261985026506,
    };
    const COLOUR: Scores = Scores {
        psnr: 24.29921943894245,
        ssim: 0.977402145107463,
        s12_psnr: 23.501107914621535,
        dolp_mae: 0.05020999510334446,
        aolp_mae_deg: 1.8502679269623195,
    };

    /// Expected values: an independent NumPy implementation of the same definitions (pinv, `np.convolve`), fed with the same
    /// formulas, printed with all digits.
    #[test]
    fn scores_agree_with_an_independent_implementation() {
        let four = [4, 17, 23];
        assert_scores(score(&estimate(&four), &truth(&four), &Angle::four()).unwrap(), FOUR);
        let colour = [3, 3, 12, 15];
        assert_scores(score(&estimate(&colour), &truth(&colour), &Angle::three()).unwrap(), COLOUR);
    }

    #[test]
    fn the_truth_is_perfect() {
        let t = truth(&[3, 12, 12]);
        let s = score(&t, &t, &Angle::three()).unwrap();
        assert_eq!((s.psnr, s.s12_psnr, s.dolp_mae, s.aolp_mae_deg), (f64::INFINITY, f64::INFINITY, 0.0, 0.0));
        assert!((s.ssim - 1.0).abs() < 1e-12);
        assert!(serde_json::to_string(&s).unwrap().starts_with(r#"{"psnr":null,"#));
    }

    #[test]
    fn unusable_arrays_are_refused_with_the_place() {
        let t = truth(&[3, 12, 12]);
        let message = |e: Array, angles: &[Angle]| score(&e, &t, angles).unwrap_err().to_string();
        let three = Angle::three();
        assert!(message(truth(&[3, 12, 13]), &three).contains("the shape [3, 12, 13], the truth [3, 12, 12]"));
        assert!(
            message(t.clone(), &Angle::four()).starts_with("shape [3, 12, 12], allowed: [4, H, W] or [C, 4, H, W]")
        );
        let bad = array(&[3, 12, 12], |i| if i == 144 + 12 + 2 { f32::NAN } else { 0.5 });
        assert_eq!(message(bad, &three), "the estimate holds NaN at [1, 1, 2], allowed: finite values");
        let twice = [0.0, 90.0, 180.0].map(Angle::from_degrees);
        assert_eq!(message(t.clone(), &twice), "angles 0°, 90°, 180°: allowed are at least three different ones");
        let small = truth(&[3, 12, 10]);
        assert!(score(&small, &small, &three).unwrap_err().to_string().ends_with("at least 11"));
    }
}
