//! `stokescope bench --video`: measures video frames that start from the frame before, against frames solved alone.

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

/// Videos: name, scene and frame rate. A still scene has no frame rate, and new noise in every frame.
const VIDEOS: [(&str, &str, Option<f64>); 6] = [
    ("still spheres", "spheres", None),
    ("still tissue", "tissue", None),
    ("still wedges", "wedges", None),
    ("tissue moving by 1 to 2 px a frame", "tissue", Some(5.0)),
    ("polarizers turning by 3 to 5 degrees a frame", "wedges", Some(4.7)),
    ("plastic under changing load", "plastic", Some(5.0)),
];
/// Number of frames of each video.
const FRAMES: u64 = 10;
/// Iterations of a frame solved alone.
const COLD_ITERATIONS: usize = 20;

/// Report of a frame, and S1, S2 PSNR of its result in dB.
type Solved = (FrameReport, f64);

/// Result of one frame of a video.
#[derive(Debug, Serialize)]
struct Row {
    video: &'static str,
    frame: usize,
    course: String,
    iterations: usize,
    averaged: usize,
    /// S1, S2 PSNR in dB: in the video, and solved alone.
    s12_psnr: f64,
    s12_psnr_cold: f64,
    /// Seconds of the solver: in the video, and solved alone.
    seconds: f64,
    seconds_cold: f64,
}

#[allow(clippy::print_stdout, reason = "output of the command")]
pub(super) fn run(args: &Args, json: bool) -> Result<(), Error> {
    let size = Size::new(args.size[0] as usize, args.size[0] as usize);
    let alone = Settings {
        register: true,
        refit_psf: true,
        ..settings(Method::Guided, COLD_ITERATIONS, args.threads, args.fft)
    };
    let in_video = Settings { video: true, ..alone.clone() };
    let mut rows: Vec<Row> = Vec::new();
    if !json {
        println!("{}", describe(&Machine::this()));
        println!("frame  course  iterations  averaged  S1,S2 [dB]  cold [dB]  time [ms]  cold [ms]");
    }
    for (video, name, frame_rate) in VIDEOS {
        let frames = captured(name, size, frame_rate)?;
        let (next, cold) = (solved(&frames, &in_video)?, solved(&frames, &alone)?);
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

/// Simulates the frames of a video.
fn captured(name: &str, size: Size, frame_rate: Option<f64>) -> Result<Vec<Scene>, Error> {
    let spec = SimSpec {
        scene: name.to_owned(),
        size,
        seed: SEED,
        frame_rate: frame_rate.unwrap_or(1.0),
        ..SimSpec::default()
    };
    // a still scene repeats frame 0 without noise, and the noise is added here
    let noise = [spec.read_noise * f32::from(spec.saturation() - spec.black_level), spec.guide_noise];
    let still = frame_rate.is_none();
    let spec = if still { SimSpec { read_noise: 0.0, shot_noise: 0.0, guide_noise: 0.0, ..spec } } else { spec };
    let mut rng = StdRng::seed_from_u64(SEED);
    let mut simulator = simulator(spec)?;
    let folder = tempfile::tempdir().map_err(|e| Error::Internal(format!("no temporary folder: {e}")))?;
    write_simulated(simulator.spec(), folder.path())?;
    let bundle = Bundle::load(folder.path())?;
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
        let (guide, bundle) = (Some(capture.guide), bundle.clone());
        Ok(Scene { name: name.to_owned(), bundle, raw, unit: Unit::Counts, guide, truth })
    };
    (0..FRAMES).map(frame).collect()
}

/// Solves all frames in order with one pipeline. They are scored afterwards, so that scoring does not disturb the caches.
fn solved(frames: &[Scene], settings: &Settings) -> Result<Vec<Solved>, Error> {
    let mut pipeline = Pipeline::new(&frames[0].bundle, settings.clone())?;
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

/// Summary of the frames after the first: means, the worst frame, and the ratio of the shortest times.
fn after_the_first(rows: &[Row]) -> String {
    let mean = |of: fn(&Row) -> f64| rows.iter().map(of).sum::<f64>() / rows.len() as f64;
    let least = |of: fn(&Row) -> f64| rows.iter().map(of).fold(f64::INFINITY, f64::min);
    format!(
        "       mean {:33.2}  {:9.2}  worst frame {:+.2} dB, shortest time {:.2} of that alone",
        mean(|row| row.s12_psnr),
        mean(|row| row.s12_psnr_cold),
        least(|row| row.s12_psnr - row.s12_psnr_cold),
        least(|row| row.seconds) / least(|row| row.seconds_cold)
    )
}
