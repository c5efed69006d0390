//! `stokescope bench --video`: frames of videos that go on from each other, against frames solved by themselves.

use rand::{Rng, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;
use serde::Serialize;

use super::{Args, Machine, SEED, Scene, as_json, describe, judge, latest, process, settings};
use crate::Error;
use crate::bundle::{Bundle, write_simulated};
use crate::camera::sim::{SimSpec, simulator};
use crate::files::{Array, Values};
use stokescope_core::image::{Size, Stack};
use stokescope_core::pipeline::{FrameReport, Pipeline, Settings};
use stokescope_core::readings::Unit;
use stokescope_core::solve::Method;

/// Videos: name, scene, and frames per second of the scene's time; a still scene has none, and fresh noise in every frame.
const VIDEOS: [(&str, &str, Option<f64>); 6] = [
    ("still spheres", "spheres", None),
    ("still tissue", "tissue", None),
    ("still wedges", "wedges", None),
    ("tissue moving by 1 to 2 px a frame", "tissue", Some(5.0)),
    ("polarizers turning by 3 to 5 degrees a frame", "wedges", Some(4.7)),
    ("plastic under changing load", "plastic", Some(5.0)),
];
/// Frames of each, and iterations of a frame by itself.
const FRAMES: u64 = 10;
const COLD: usize = 20;

/// What a pipeline says of a frame, and the S1, S2 PSNR of what it made of it.
type Solved = (FrameReport, f64);

/// One frame of a video.
#[derive(Debug, Serialize)]
struct Row {
    video: &'static str,
    frame: usize,
    course: String,
    iterations: usize,
    averaged: usize,
    /// S1, S2 PSNR in dB, of the frame after the last one and by itself.
    s12_psnr: f64,
    s12_psnr_cold: f64,
    /// Times of the solver.
    seconds: f64,
    seconds_cold: f64,
}

#[allow(clippy::print_stdout, reason = "the command's answer")]
pub(super) fn run(args: &Args, json: bool) -> Result<(), Error> {
    let size = Size::new(args.size[0] as usize, args.size[0] as usize);
    let by_itself =
        Settings { register: true, refit_psf: true, ..settings(Method::Guided, COLD, args.threads, args.fft) };
    let going_on = Settings { video: true, ..by_itself.clone() };
    let mut rows: Vec<Row> = Vec::new();
    if !json {
        println!("{}", describe(&Machine::this()));
        println!("frame  course  iterations  averaged  S1,S2 [dB]  cold [dB]  time [ms]  cold [ms]");
    }
    for (video, name, frame_rate) in VIDEOS {
        let frames = captured(name, size, frame_rate)?;
        let (next, cold) = (solved(&frames, &going_on)?, solved(&frames, &by_itself)?);
        let row = |(frame, ((report, s12_psnr), (alone, s12_psnr_cold))): (usize, (Solved, Solved))| Row {
            video,
            frame,
            course: report.course.to_string(),
            iterations: report.iterations,
            averaged: report.averaged,
            s12_psnr,
            s12_psnr_cold,
            seconds: report.recon.as_secs_f64(),
            seconds_cold: alone.recon.as_secs_f64(),
        };
        let of_video: Vec<_> = next.into_iter().zip(cold).enumerate().map(row).collect();
        if !json {
            println!("{video}, {size}");
            of_video.iter().for_each(|row| println!("{}", line(row)));
            println!("{}", after_the_first(&of_video[1..]));
        }
        rows.extend(of_video);
    }
    if json {
        println!("{}", as_json(&rows)?);
    }
    Ok(())
}

/// The frames of a video.
fn captured(name: &str, size: Size, frame_rate: Option<f64>) -> Result<Vec<Scene>, Error> {
    let spec = SimSpec {
        scene: name.to_owned(),
        size,
        seed: SEED,
        frame_rate: frame_rate.unwrap_or(1.0),
        ..SimSpec::default()
    };
    // The simulator's time stands still in its first frame alone: its noise is added here.
    let noise = [spec.read_noise * f32::from(spec.saturation() - spec.black_level), spec.guide_noise];
    let still = frame_rate.is_none();
    let spec = if still { SimSpec { read_noise: 0.0, shot_noise: 0.0, guide_noise: 0.0, ..spec } } else { spec };
    let mut rng = StdRng::seed_from_u64(SEED);
    let mut simulator = simulator(spec)?;
    let folder = tempfile::tempdir().map_err(|e| Error::Internal(format!("no temporary folder: {e}")))?;
    write_simulated(simulator.spec(), folder.path())?;
    let calibration = Bundle::load(folder.path())?;
    let frame = |frame| {
        let mut capture = simulator.capture(if still { 0 } else { frame });
        let counts = capture.raw.as_slice().iter().map(|v| f32::from(*v)).collect();
        let mut raw = Stack::from_vec(capture.raw.count(), capture.raw.size(), counts)
            .map_err(|e| Error::Internal(e.to_string()))?;
        for (image, sigma) in [&mut raw, &mut capture.guide].into_iter().zip(noise).filter(|_| still) {
            image.as_mut_slice().iter_mut().for_each(|v| *v += sigma * rng.sample::<f32, _>(StandardNormal));
        }
        let truth = Array {
            shape: vec![capture.truth.count(), size.height, size.width],
            samples: Values::F32(capture.truth.as_slice().to_vec()),
        };
        let (guide, calibration) = (Some(capture.guide), calibration.clone());
        Ok(Scene { name: name.to_owned(), calibration, raw, unit: Unit::Counts, guide, truth })
    };
    (0..FRAMES).map(frame).collect()
}

/// What one pipeline makes of all frames in their order. They are judged afterwards: nothing comes between frames in the caches.
fn solved(frames: &[Scene], settings: &Settings) -> Result<Vec<Solved>, Error> {
    let mut pipeline = Pipeline::new(&frames[0].calibration, settings.clone())?;
    let mut found = Vec::with_capacity(frames.len());
    for frame in frames {
        let report = process(&mut pipeline, frame)?;
        found.push((report, latest(&pipeline)));
    }
    let judged = |((report, estimate), frame)| Ok((report, judge(frame, &pipeline, estimate)?.s12_psnr));
    found.into_iter().zip(frames).map(judged).collect()
}

fn line(row: &Row) -> String {
    format!(
        "{:5}  {:6}  {:10}  {:8}  {:10.2}  {:9.2}  {:9.1}  {:9.1}",
        row.frame,
        row.course,
        row.iterations,
        row.averaged,
        row.s12_psnr,
        row.s12_psnr_cold,
        1e3 * row.seconds,
        1e3 * row.seconds_cold
    )
}

/// Frames that went on from another one, in the mean; times are the shortest.
fn after_the_first(rows: &[Row]) -> String {
    let mean = |of: fn(&Row) -> f64| rows.iter().map(of).sum::<f64>() / rows.len() as f64;
    let least = |of: fn(&Row) -> f64| rows.iter().map(of).fold(f64::INFINITY, f64::min);
    format!(
        "       mean {:33.2}  {:9.2}  worst frame {:+.2} dB, shortest time {:.2} of by itself",
        mean(|row| row.s12_psnr),
        mean(|row| row.s12_psnr_cold),
        least(|row| row.s12_psnr - row.s12_psnr_cold),
        least(|row| row.seconds) / least(|row| row.seconds_cold)
    )
}
