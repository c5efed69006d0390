//! All calibration steps on simulated cameras with the flaws of a device built by hand, compared with perfect knowledge of it.

use std::path::Path;

use nalgebra::{Matrix3, Vector2};
use serde::Serialize;

use super::Beyond;
use crate::Error;
use crate::bundle::{Bundle, BundleError, Draft, write_simulated};
use crate::camera::sim::{self, Capture, Imperfections, Knowledge, SimSpec, Simulator};
use stokescope_core::calibrate::mask::Layout;
use stokescope_core::calibrate::{
    CalibrateError, Outcome, PolarizedShots, Shots, Step, align, angle_difference, dark, mask, psf, verify, white,
};
use stokescope_core::device::{DeviceError, Homography};
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::FftBackend;
use stokescope_core::optics::Psf;
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::polarization::Angle;
use stokescope_core::readings::Unit;

/// Frames averaged for each view.
const FRAMES: u64 = 12;
/// Angles of the polarizer as read off its dial, in degrees.
const ANGLES: [f64; 6] = [0.0, 30.0, 60.0, 90.0, 120.0, 150.0];
/// Errors of these readings, in degrees.
const DIAL: [f64; 6] = [0.1, -0.15, 0.05, -0.1, 0.15, -0.05];
/// Place of the point source in pixels from the axis, to the right and down.
const POINT: [i32; 2] = [4, -3];
/// Largest loss in dB, homography error in pixels and mask angle error in degrees that pass.
pub(super) const ALLOWED: (f64, f64, f64) = (0.7, 0.3, 0.3);

/// The device of the demonstration, and the scene it is judged on.
#[derive(Clone, Debug)]
pub(super) struct Spec {
    /// Scene the result is judged on.
    pub(super) scene: String,
    /// Sensor size.
    pub(super) size: Size,
    /// Colour sensor.
    pub(super) color: bool,
    /// Scene beyond the frame.
    pub(super) beyond: Beyond,
    /// Seed of the device.
    pub(super) seed: u64,
    /// Solver threads.
    pub(super) threads: usize,
}

/// Quality of a reconstruction.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Score {
    /// PSNR of the angle images, dB.
    pub(super) psnr: f64,
    /// PSNR of S1 and S2, dB.
    pub(super) s12_psnr: f64,
}

/// The result of the demonstration.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Summary {
    /// Reconstruction with the measured bundle.
    pub(super) calibrated: Score,
    /// Reconstruction with perfect knowledge of the device.
    pub(super) exact: Score,
    /// Reconstruction with the nominal device, without calibration.
    pub(super) nominal: Score,
    /// Loss of PSNR against perfect knowledge, the larger of both scores, dB.
    pub(super) loss_db: f64,
    /// Root mean square error of the homography over the frame, in pixels of the scene.
    pub(super) homography_px: f64,
    /// Root mean square error of the stripe angles, degrees.
    pub(super) mask_angle_rms_deg: f64,
    /// Largest error of a stripe angle, degrees.
    pub(super) mask_angle_max_deg: f64,
    /// Whether all errors are within [`ALLOWED`].
    pub(super) passed: bool,
    /// SHA-256 of the bundle.
    pub(super) calibration: String,
}

/// Takes all steps into the bundle `dir` and judges it. `each` is called with the outcome of every step.
///
/// # Errors
/// [`CalibrateError`] of any step.
pub(super) fn run(spec: &Spec, dir: &Path, mut each: impl FnMut(&Outcome)) -> Result<Summary, Error> {
    let device = device(spec);
    let done = |found: Option<Bundle>| {
        found.ok_or_else(|| Error::Internal("the bundle is incomplete after the psf step".to_owned()))
    };

    let found = dark::measure(&shots(&device, "dark", None)?, device.bit_depth)?;
    each(&found.outcome());
    let mut draft = Draft::open(dir)?;
    draft.set_dark(&found);
    draft.set("noise", "shot", f64::from(device.shot_noise));
    draft.commit()?;

    let mut draft = Draft::open(dir)?;
    let levels = draft.levels(Step::Mask)?;
    let views = views(&device, "uniform")?;
    let layout = Layout { angles: device.mask_angles(), stripes: device.stripes };
    let mask = mask::measure(&views, &levels, &layout)?;
    each(&mask.outcome());
    draft.set_mask(&mask);
    draft.commit()?;

    if device.color {
        let mut draft = Draft::open(dir)?;
        let found = white::measure(&shots(&device, "uniform", None)?, &draft.levels(Step::White)?)?;
        each(&found.outcome());
        draft.set_white(&found);
        draft.commit()?;
    }

    let mut draft = Draft::open(dir)?;
    let point = psf::measure(&shots(&device, "point", None)?, &levels, draft.known.response.as_ref())?;
    each(&point.outcome());
    draft.set_psf(&point);
    let calibration = done(draft.commit()?)?;

    let mut draft = Draft::open(dir)?;
    let (raw, guide) = pair(&device, "print", None)?;
    let aligned = align::measure(&calibration, &raw, &guide, spec.threads)?;
    each(&aligned.outcome());
    draft.set_alignment(&aligned);
    let calibration = done(draft.commit()?)?;

    let tests = ANGLES.iter().zip(DIAL).step_by(2).map(|(angle, error)| {
        let (raw, guide) = pair(&device, "film", Some(angle + error))?;
        Ok((PolarizedShots { angle: Angle::from_degrees(*angle), shots: raw }, guide.mean()))
    });
    let (views, guides): (Vec<_>, Vec<_>) = tests.collect::<Result<Vec<_>, Error>>()?.into_iter().unzip();
    each(&verify::measure(&calibration, &views, &guides, spec.threads)?.outcome());

    judge(spec, &device, dir, &calibration, &mask, &aligned, offset(&device, &point))
}

/// A device built by hand.
fn device(spec: &Spec) -> SimSpec {
    let mut device = SimSpec {
        scene: spec.scene.clone(),
        size: spec.size,
        color: spec.color,
        seed: spec.seed,
        point: POINT,
        surround: spec.beyond.surround,
        surround_level: spec.beyond.surround_level,
        guide_margin: spec.beyond.guide_margin,
        ..SimSpec::default()
    };
    device.spoil(&"all".parse::<Imperfections>().unwrap_or_default());
    device
}

/// A simulator of the device in front of `scene`, and the number of its first frame. Every view has its own noise and exposures.
fn simulator(device: &SimSpec, scene: &str, polarizer: Option<f64>) -> Result<(Simulator, u64), Error> {
    let first = polarizer.map_or(0, |degrees| 1000 + 100 * degrees.abs() as u64);
    Ok((sim::simulator(SimSpec { scene: scene.to_owned(), polarizer, ..device.clone() })?, first))
}

fn pair(device: &SimSpec, scene: &str, polarizer: Option<f64>) -> Result<(Shots, Shots), Error> {
    let (mut simulator, first) = simulator(device, scene, polarizer)?;
    let frames = (first..first + FRAMES).map(|index| {
        let capture = simulator.capture(index);
        (floats(&capture.raw), capture.guide)
    });
    let (raw, guide) = frames.unzip();
    Ok((Shots { frames: raw, unit: Unit::Counts }, Shots { frames: guide, unit: Unit::FullScale }))
}

fn shots(device: &SimSpec, scene: &str, polarizer: Option<f64>) -> Result<Shots, Error> {
    let (mut simulator, first) = simulator(device, scene, polarizer)?;
    let mut counts = Stack::zeros(device.channels(), device.size);
    let frames = (first..first + FRAMES).map(|index| {
        simulator.raw(index, &mut counts);
        floats(&counts)
    });
    Ok(Shots { frames: frames.collect(), unit: Unit::Counts })
}

fn views(device: &SimSpec, scene: &str) -> Result<Vec<PolarizedShots>, Error> {
    let view = |(angle, error): (&f64, f64)| {
        let shots = shots(device, scene, Some(angle + error))?;
        Ok(PolarizedShots { angle: Angle::from_degrees(*angle), shots })
    };
    ANGLES.iter().zip(DIAL).map(view).collect()
}

fn floats(counts: &Stack<u16>) -> Stack<f32> {
    let mut out = Stack::zeros(counts.count(), counts.size());
    out.as_mut_slice().iter_mut().zip(counts.as_slice()).for_each(|(v, c)| *v = f32::from(*c));
    out
}

/// Displacement of the true scene against the bundle's: its PSF was centred, so a scene point appears at true − offset.
fn offset(device: &SimSpec, point: &psf::MeasuredPsf) -> [i64; 2] {
    // the source stands at the middle pixel plus `point`
    let middle = [device.size.width / 2, device.size.height / 2];
    std::array::from_fn(|k| point.centre[k] - middle[k] as i64 - i64::from(device.point[k]))
}

/// Compares the bundle with perfect and with nominal knowledge.
fn judge(
    spec: &Spec,
    device: &SimSpec,
    dir: &Path,
    calibration: &Bundle,
    mask: &mask::MeasuredMask,
    aligned: &align::Alignment,
    offset: [i64; 2],
) -> Result<Summary, Error> {
    let capture = sim::simulator(device.clone())?.capture(0);
    let score = |calibration: &Bundle, offset: [i64; 2]| score(calibration, &capture, device, offset, spec.threads);
    let calibrated = score(calibration, offset)?;
    let known = |knowledge: Knowledge, name: &str| -> Result<Bundle, Error> {
        let dir = dir.join(name);
        write_simulated(&SimSpec { knowledge, ..device.clone() }, &dir)?;
        Ok(Bundle::load(&dir)?)
    };
    let nominal = score(&known(Knowledge::Nominal, "nominal")?, [0; 2])?;
    let exact = score(&centred(known(Knowledge::Exact, "exact")?, offset)?, offset)?;
    let errors: Vec<f64> = mask
        .stripes
        .iter()
        .zip(device.stripes())
        .map(|(found, true_)| angle_difference(found.angle_deg, true_.angle.degrees()))
        .collect();
    let rms = |values: &[f64]| (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt();
    let homography_px = homography_error(&aligned.homography, &device.homography(Knowledge::Exact), spec.size, offset);
    let loss_db = (exact.psnr - calibrated.psnr).max(exact.s12_psnr - calibrated.s12_psnr);
    let mask_angle_max_deg = errors.iter().copied().map(f64::abs).fold(0.0, f64::max);
    Ok(Summary {
        calibrated,
        exact,
        nominal,
        loss_db,
        homography_px,
        mask_angle_rms_deg: rms(&errors),
        mask_angle_max_deg,
        passed: loss_db <= ALLOWED.0 && homography_px <= ALLOWED.1 && mask_angle_max_deg <= ALLOWED.2,
        calibration: calibration.digest.clone(),
    })
}

/// Centres the PSF of a bundle as the psf step does. The place of zero displacement is a convention, but it moves the border beyond
/// which no light is assumed; bundles are compared under the same one.
fn centred(mut bundle: Bundle, offset: [i64; 2]) -> Result<Bundle, Error> {
    let (size, [dx, dy]) = (bundle.sensor.size, offset);
    let mut planes = Stack::zeros(bundle.psf.count(), size);
    for (c, plane) in planes.planes_mut().enumerate() {
        for (i, v) in plane.iter_mut().enumerate() {
            let (x, y) = ((i % size.width) as i64 + dx, (i / size.width) as i64 + dy);
            if (0..size.width as i64).contains(&x) && (0..size.height as i64).contains(&y) {
                *v = bundle.psf.channel(c)[y as usize * size.width + x as usize];
            }
        }
    }
    bundle.device.psf = Psf::new(planes, size, bundle.sensor.channels)
        .map_err(|e| BundleError::Device { file: bundle.dir.join("psf.npy"), source: Box::new(DeviceError::Psf(e)) })?;
    let h = Matrix3::from_row_slice(&bundle.guide.0) * Matrix3::new_translation(&Vector2::new(-dx as f64, -dy as f64));
    bundle.device.guide = Homography(std::array::from_fn(|i| h[(i / 3, i % 3)]));
    Ok(bundle)
}

/// Reconstructs the capture and compares it with the truth, displaced by the bundle's offset, away from the borders. The white balance
/// is undone first: it would weigh the channels of one bundle more than those of another.
fn score(
    calibration: &Bundle,
    capture: &Capture,
    device: &SimSpec,
    offset: [i64; 2],
    threads: usize,
) -> Result<Score, Error> {
    let settings = Settings { threads, refit_psf: false, fft: FftBackend::Rustfft, ..Settings::default() };
    let mut pipeline = Pipeline::new(calibration, settings)?;
    pipeline.process(floats(&capture.raw).view().in_unit(Unit::Counts), capture.guide.view())?;
    let Some(found) = pipeline.result().angles.as_ref() else {
        return Err(CalibrateError::MissingStep { step: Step::Verify, first: Step::Mask }.into());
    };
    let Size { width, height } = calibration.sensor.size;
    let border = 8usize.max(2 * offset.iter().map(|d| d.unsigned_abs() as usize).max().unwrap_or(0));
    let count = device.angles;
    let (mut square, mut polarized, mut n) = (0.0f64, 0.0f64, 0usize);
    let polar = stokescope_core::polarization::Plan::new(pipeline.angles());
    for channel in 0..device.channels() {
        let white = calibration.white[channel];
        for y in border..height - border {
            for x in border..width - border {
                let there = (y as i64 - offset[1]) as usize * width + (x as i64 - offset[0]) as usize;
                let error: Vec<f32> = (0..count)
                    .map(|p| {
                        found.plane(channel * count + p)[y * width + x] / white
                            - capture.truth.plane(channel * count + p)[there]
                    })
                    .collect();
                square += error.iter().map(|e| f64::from(e * e)).sum::<f64>() / count as f64;
                let mut stokes = [0.0; 3];
                polar.to_stokes(&error, &mut stokes, 1);
                polarized += 0.5 * f64::from(stokes[1] * stokes[1] + stokes[2] * stokes[2]);
                n += 1;
            }
        }
    }
    let decibels = |sum: f64| -10.0 * (sum / n as f64).max(f64::MIN_POSITIVE).log10();
    Ok(Score { psnr: decibels(square), s12_psnr: decibels(polarized) })
}

/// Root mean square distance over the frame between the guide points of two homographies, in pixels of the scene.
fn homography_error(found: &Homography, exact: &[f64; 9], size: Size, offset: [i64; 2]) -> f64 {
    let exact = Homography(*exact);
    let scale = Matrix3::from_row_slice(&exact.0).determinant().abs().sqrt();
    let each = (0..size.pixels()).map(|i| {
        let (x, y) = ((i % size.width) as f64, (i / size.width) as f64);
        let (a, b) = (found.apply(x, y), exact.apply(x - offset[0] as f64, y - offset[1] as f64));
        ((a.0 - b.0).powi(2) + (a.1 - b.1).powi(2)) / (scale * scale)
    });
    (each.sum::<f64>() / size.pixels() as f64).sqrt()
}
