//! All calibration steps on simulated cameras with the flaws of a hand-built device, compared with perfect knowledge of the device.

use std::path::Path;

use nalgebra::{Matrix3, Vector2};
use serde::Serialize;

use crate::Error;
use crate::bundle::{Bundle, BundleError, Draft, write_simulated};
use crate::camera::sim::{self, Capture, Imperfections, Knowledge, SimSpec, Simulator};
use stokescope_core::calibrate::mask::Layout;
use stokescope_core::calibrate::{CalibrateError, Outcome, Shots, View, align, dark, mask, psf, turn, verify, white};
use stokescope_core::device::{DeviceError, Homography};
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::FftBackend;
use stokescope_core::optics::Psf;
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::polarization::Angle;
use stokescope_core::readings::Unit;

/// Number of frames averaged per view.
const FRAMES: u64 = 12;
/// Nominal angles of the polarizer in degrees.
const ANGLES: [f64; 6] = [0.0, 30.0, 60.0, 90.0, 120.0, 150.0];
/// Reading error of the polarizer's dial at each of [`ANGLES`], in degrees.
const DIAL_ERRORS: [f64; 6] = [0.1, -0.15, 0.05, -0.1, 0.15, -0.05];
/// Position of the point source, in pixels from the axis.
const POINT: [i32; 2] = [4, -3];
/// Allowed errors: loss in dB, homography error in pixels, mask angle error in degrees.
pub(super) const ALLOWED: (f64, f64, f64) = (0.7, 0.3, 0.3);

/// Device and scene of the demonstration.
#[derive(Clone, Debug)]
pub(super) struct Spec {
    /// Scene for the evaluation.
    pub(super) scene: String,
    /// Sensor size.
    pub(super) size: Size,
    /// Whether the sensor has three colour channels.
    pub(super) color: bool,
    /// Seed of the device.
    pub(super) seed: u64,
    /// Solver threads.
    pub(super) threads: usize,
}

/// Quality of a reconstruction.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Score {
    /// PSNR of the angle images in dB.
    pub(super) psnr: f64,
    /// PSNR of S1 and S2 in dB.
    pub(super) s12_psnr: f64,
}

/// Result of the demonstration.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Summary {
    /// Score with the calibrated bundle.
    pub(super) calibrated: Score,
    /// Score with perfect knowledge of the device.
    pub(super) exact: Score,
    /// Score with the nominal device, without calibration.
    pub(super) nominal: Score,
    /// Loss against perfect knowledge in dB, the larger one of both scores.
    pub(super) loss_db: f64,
    /// Error of the homography, root mean square over the frame, in pixels of the scene.
    pub(super) homography_px: f64,
    /// Error of the stripe angles, root mean square, in degrees.
    pub(super) mask_angle_rms_deg: f64,
    /// Largest error of a stripe angle in degrees.
    pub(super) mask_angle_max_deg: f64,
    /// Whether all errors are at most the allowed ones.
    pub(super) passed: bool,
    /// SHA-256 of the calibrated bundle.
    pub(super) calibration: String,
}

/// Takes all steps with the bundle in `dir` and evaluates it; `report` is called after every step.
///
/// # Errors
/// [`CalibrateError`] of any step.
pub(super) fn run(spec: &Spec, dir: &Path, mut report: impl FnMut(&Outcome)) -> Result<Summary, Error> {
    let device = device(spec);
    let complete = |found: Option<Bundle>| {
        // all steps before align have been taken
        found.ok_or(CalibrateError::Before { step: "demo", what: "complete description", first: "dark" })
    };

    let found = dark::measure(&shots(&device, "dark", None)?, device.bit_depth)?;
    report(&found.outcome());
    let mut draft = Draft::open(dir)?;
    draft.set_dark(&found);
    draft.set("noise", "shot", f64::from(device.shot_noise));
    draft.commit()?;

    let mut draft = Draft::open(dir)?;
    let levels = draft.levels("demo")?;
    let views = views(&device, "uniform")?;
    let layout = Layout { angles: device.mask_angles(), stripes: device.stripes };
    let mask = mask::measure(&views, &levels, &layout)?;
    report(&mask.outcome());
    draft.set_mask(&mask);
    draft.commit()?;

    if device.color {
        let mut draft = Draft::open(dir)?;
        let found = white::measure(&shots(&device, "uniform", None)?, &draft.levels("demo")?)?;
        report(&found.outcome());
        draft.set_white(&found);
        draft.commit()?;
    }

    let mut draft = Draft::open(dir)?;
    let point = psf::measure(&shots(&device, "point", None)?, &levels, draft.known.response.as_ref())?;
    report(&point.outcome());
    draft.set_psf(&point);
    let bundle = complete(draft.commit()?)?;

    let mut draft = Draft::open(dir)?;
    let (raw, guide) = pair(&device, "print", None)?;
    let aligned = align::measure(&bundle, &raw, &guide, spec.threads)?;
    report(&aligned.outcome());
    draft.set_alignment(&aligned);
    let bundle = complete(draft.commit()?)?;

    let tests = ANGLES.iter().zip(DIAL_ERRORS).step_by(2).map(|(angle, error)| {
        let (raw, guide) = pair(&device, "film", Some(angle + error))?;
        Ok(((Angle::from_degrees(*angle), raw), guide.mean()))
    });
    let (views, guides): (Vec<_>, Vec<_>) = tests.collect::<Result<Vec<_>, Error>>()?.into_iter().unzip();
    report(&verify::measure(&bundle, &views, &guides, spec.threads)?.outcome());

    evaluate(spec, &device, dir, &bundle, &mask, &aligned, offset(&device, &point))
}

/// Simulated device with the flaws of a hand-built one.
fn device(spec: &Spec) -> SimSpec {
    let mut device = SimSpec {
        scene: spec.scene.clone(),
        size: spec.size,
        color: spec.color,
        seed: spec.seed,
        point: POINT,
        ..SimSpec::default()
    };
    // `all` is a valid name
    device.spoil(&"all".parse::<Imperfections>().unwrap_or_default());
    device
}

/// Simulator of the device in front of `scene`, and the number of its first frame, which gives every view its own noise and exposures.
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

fn views(device: &SimSpec, scene: &str) -> Result<Vec<View>, Error> {
    let view =
        |(angle, error): (&f64, f64)| Ok((Angle::from_degrees(*angle), shots(device, scene, Some(angle + error))?));
    ANGLES.iter().zip(DIAL_ERRORS).map(view).collect()
}

fn floats(counts: &Stack<u16>) -> Stack<f32> {
    let mut out = Stack::zeros(counts.count(), counts.size());
    out.as_mut_slice().iter_mut().zip(counts.as_slice()).for_each(|(v, c)| *v = f32::from(*c));
    out
}

/// Displacement of the calibrated scene: the PSF was centred, so a scene point appears at its true position − offset, in pixels.
fn offset(device: &SimSpec, point: &psf::Point) -> [i64; 2] {
    // the source is at the middle pixel plus `point`
    let middle = [device.size.width / 2, device.size.height / 2];
    std::array::from_fn(|k| point.centre[k] - middle[k] as i64 - i64::from(device.point[k]))
}

/// Compares the calibrated bundle with perfect and with nominal knowledge.
fn evaluate(
    spec: &Spec,
    device: &SimSpec,
    dir: &Path,
    bundle: &Bundle,
    mask: &mask::Mask,
    aligned: &align::Aligned,
    offset: [i64; 2],
) -> Result<Summary, Error> {
    let capture = sim::simulator(device.clone())?.capture(0);
    let score = |bundle: &Bundle, offset: [i64; 2]| score(bundle, &capture, device, offset, spec.threads);
    let calibrated = score(bundle, offset)?;
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
        .map(|(found, true_)| turn(found.angle_deg, true_.angle.degrees()))
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
        calibration: bundle.digest.clone(),
    })
}

/// Shifts the PSF of a bundle by `offset`, as the calibration does when it centres the PSF.
///
/// The position of zero displacement is a convention, but it moves the border beyond which no light is assumed. Bundles are therefore
/// compared with the same convention.
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
        .map_err(|e| BundleError::Device { file: bundle.dir.join("psf.npy"), source: DeviceError::Psf(e) })?;
    let h = Matrix3::from_row_slice(&bundle.guide.0) * Matrix3::new_translation(&Vector2::new(-dx as f64, -dy as f64));
    bundle.device.guide = Homography(std::array::from_fn(|i| h[(i / 3, i % 3)]));
    Ok(bundle)
}

/// Reconstructs the capture and compares it with the truth shifted by `offset`, without the borders. The white balance is undone,
/// because it would weigh channels differently for different bundles.
fn score(
    bundle: &Bundle,
    capture: &Capture,
    device: &SimSpec,
    offset: [i64; 2],
    threads: usize,
) -> Result<Score, Error> {
    let settings = Settings { threads, refit_psf: false, fft: FftBackend::Rustfft, ..Settings::default() };
    let mut pipeline = Pipeline::new(bundle, settings)?;
    pipeline.process(floats(&capture.raw).view().in_unit(Unit::Counts), capture.guide.view())?;
    let Some(found) = pipeline.result().angles.as_ref() else {
        return Err(CalibrateError::Before { step: "demo", what: "polarizer mask", first: "mask" }.into());
    };
    let Size { width, height } = bundle.sensor.size;
    let border = 8usize.max(2 * offset.iter().map(|d| d.unsigned_abs() as usize).max().unwrap_or(0));
    let count = device.angles;
    let (mut square, mut polarized, mut n) = (0.0f64, 0.0f64, 0usize);
    let polar = stokescope_core::polarization::Plan::new(pipeline.angles());
    for channel in 0..device.channels() {
        let white = bundle.white[channel];
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

/// Root mean square distance between two homographies over the frame, in pixels of the scene.
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
