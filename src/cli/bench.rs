//! `stokescope bench`: measures speed against error of every method, on built-in scenes or a folder of bundles.

mod models;
mod solver;
mod video;

use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{reconstruct, simulate, values};
use crate::Error;
use crate::bundle::{Bundle, write_simulated};
use crate::camera::sim::{SCENES, SimSpec, simulator};
use crate::evaluate::bench::{Figures, REFERENCE, Row, at_equal_error, csv, means, picture, set_time_ratios, table};
use crate::evaluate::{EvaluateError, Scores, score};
use crate::files::{Array, Values, read_npy, write_atomic};
use crate::output::panel::write_png;
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::FftBackend;
use stokescope_core::pipeline::{FrameReport, Pipeline, ProcessError, ProcessedFrame, Settings};
use stokescope_core::readings::Unit;
use stokescope_core::solve::Method;

/// Measure speed against error of every method for several iterations and sizes; makes a table, bench.csv and bench.png.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder of bundles, each a folder with calibration.toml, raw.npy, truth.npy and optionally guide.npy [default: the built-in
    /// scenes, simulated].
    #[arg(long, value_name = "DIR")]
    pub suite: Option<PathBuf>,
    /// Folder for bench.csv and bench.png; created if needed.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Methods to measure [default: all].
    #[arg(long, value_name = "METHOD", value_delimiter = ',', value_parser = values::method())]
    pub methods: Vec<Method>,
    /// Numbers of iterations for every method [default: a list for each method].
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Vec<u32>,
    /// Side lengths of the simulated frames in pixels.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "250", conflicts_with = "suite",
          value_parser = clap::value_parser!(u32).range(16..=2048))]
    pub size: Vec<u32>,
    /// Solver threads; times with one thread are the most reproducible.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub threads: u32,
    /// Align the guide with the raw frame and refit the scale of the PSF, as `reconstruct` does. The measured times do not include it.
    #[arg(long, value_enum, value_name = "on|off", default_value = "off")]
    pub register: reconstruct::Switch,
    /// FFT implementation.
    #[arg(long, value_name = "LIBRARY", value_parser = values::fft(), default_value_t)]
    pub fft: FftBackend,
    /// Measure instead: one guided iteration against four plain FFTs, two threads against one, and the preparation of a frame.
    #[arg(long, conflicts_with_all = ["suite", "out", "methods", "iterations", "threads", "register"])]
    pub solver: bool,
    /// Measure instead: video frames that start from the frame before, against frames solved alone.
    #[arg(long, conflicts_with_all = ["suite", "out", "methods", "iterations", "register", "solver"])]
    pub video: bool,
    /// Measure instead: cost of every fusion model, and its gain over stage I at equal iterations and at equal time.
    #[arg(long, conflicts_with_all = ["out", "methods", "iterations", "register", "solver", "video"])]
    pub models: bool,
}

/// Default numbers of iterations of each method: from far too few up to convergence, as far as time allows.
const ITERATIONS: [(Method, &[usize]); 8] = [
    (Method::Guided, &[1, 5, 10, 20, 60]),
    (Method::Stokes, &[1, 5, 20, 60]),
    (Method::Fista, &[5, 20, 60, 200]),
    (Method::FistaPublished, &[20, 60, 200]),
    (Method::FistaPublishedScaled, &[20, 60, 200, 500]),
    (Method::FistaPublishedFrame, &[20, 60]),
    (Method::Admm, &[5, 20, 60, 200]),
    (Method::AdmmPublished, &[1, 5, 20]),
];
/// Number of measured runs after a warm-up; the result is their median.
const RUNS: usize = 3;
/// Runs of at least this many seconds are not repeated.
const LONG_RUN: f64 = 1.0;
/// Seed of the simulated scenes.
const SEED: u64 = 1;

/// Processor of this machine.
#[derive(Clone, Debug, Serialize)]
struct Machine {
    processor: String,
    cores: usize,
}

impl Machine {
    fn this() -> Self {
        let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        // x86 names the model of each core, ARM boards name the board
        let field = |name: &str| {
            info.lines()
                .find_map(|line| line.split_once(':').filter(|(key, _)| key.trim() == name).map(|(_, v)| v.trim()))
        };
        let processor = field("model name").or_else(|| field("Model")).unwrap_or("unknown processor").to_owned();
        Self { processor, cores: std::thread::available_parallelism().map_or(1, usize::from) }
    }
}

/// Output of the command.
#[derive(Serialize)]
struct Output {
    machine: Machine,
    threads: u32,
    scenes: Vec<String>,
    rows: Vec<Row>,
    mean: Vec<Row>,
    at_equal_error: Vec<String>,
}

/// Measures, prints the means, or with `json` one object with all rows, and writes the files.
///
/// # Errors
/// A suite that cannot be read or scored, or an output folder that cannot be written. A method that diverges gives a row without
/// figures.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    if args.solver {
        return solver::run(args, json);
    }
    if args.video {
        return video::run(args, json);
    }
    if args.models {
        return models::run(args, json);
    }
    let mut rows = Vec::new();
    let mut scenes = Vec::new();
    match &args.suite {
        Some(suite) => {
            for (name, folder) in bundles(suite)? {
                measure(&Scene::load(name.clone(), &folder)?, args, &mut rows)?;
                scenes.push(name);
            }
        }
        None => {
            for size in &args.size {
                for (name, _) in SCENES {
                    measure(&simulated(name, *size as usize)?, args, &mut rows)?;
                }
            }
            scenes.extend(SCENES.iter().map(|(name, _)| (*name).to_owned()));
        }
    }
    set_time_ratios(&mut rows);
    let mean = means(&rows);
    if let Some(out) = &args.out {
        std::fs::create_dir_all(out)
            .map_err(|source| crate::files::WriteError::Create { path: out.clone(), source })?;
        let all: Vec<_> = rows.iter().chain(&mean).cloned().collect();
        write_atomic(&out.join("bench.csv"), |file| file.write_all(csv(&all).as_bytes()))?;
        write_png(&out.join("bench.png"), &picture(&mean))?;
    }
    let at_equal_error = at_equal_error(&mean);
    let output = Output { machine: Machine::this(), threads: args.threads, scenes, rows, mean, at_equal_error };
    if json {
        println!("{}", as_json(&output)?);
    } else {
        println!("{}, {} thread(s)", describe(&output.machine), output.threads);
        println!("mean of {}", output.scenes.join(", "));
        println!("time ratio: time divided by that of {REFERENCE} with its most iterations");
        println!("{}", table(&output.mean).trim_end());
        output.at_equal_error.iter().for_each(|line| println!("{line}"));
    }
    Ok(())
}

fn as_json(output: &impl Serialize) -> Result<String, Error> {
    serde_json::to_string(output).map_err(|e| Error::Internal(e.to_string()))
}

fn describe(machine: &Machine) -> String {
    format!("{}, {} cores", machine.processor, machine.cores)
}

/// A capture, its device and its truth.
#[derive(Clone)]
struct Scene {
    name: String,
    bundle: Bundle,
    raw: Stack<f32>,
    unit: Unit,
    guide: Option<Stack<f32>>,
    truth: Array,
}

impl Scene {
    /// The scene in 10 % less light, for timing only.
    fn darker(&self) -> Self {
        let dim = |frame: &Stack<f32>| {
            let mut frame = frame.clone();
            frame.as_mut_slice().iter_mut().for_each(|v| *v *= 0.9);
            frame
        };
        Self { raw: dim(&self.raw), guide: self.guide.as_ref().map(dim), ..self.clone() }
    }

    fn load(name: String, folder: &Path) -> Result<Self, Error> {
        let (raw, unit) = reconstruct::read(&folder.join("raw.npy"))?;
        let guide = folder.join("guide.npy");
        let guide = guide.exists().then(|| reconstruct::read(&guide)).transpose()?.map(|(frame, _)| frame);
        let truth = read_npy(&folder.join("truth.npy"))?;
        Ok(Self { name, bundle: Bundle::load(folder)?, raw, unit, guide, truth })
    }
}

/// Bundles in a folder: name and path, in order of the names.
fn bundles(suite: &Path) -> Result<Vec<(String, PathBuf)>, Error> {
    let failed = |source| EvaluateError::Folder { path: suite.to_path_buf(), source };
    let mut found = Vec::new();
    for entry in std::fs::read_dir(suite).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        if path.join("calibration.toml").exists() {
            let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
            found.push((name, path));
        }
    }
    found.sort();
    if found.is_empty() {
        let nothing = std::io::Error::new(std::io::ErrorKind::NotFound, "no folder in it has a calibration.toml");
        return Err(failed(nothing).into());
    }
    Ok(found)
}

/// Simulates a built-in scene, written to files and read like any other bundle.
fn simulated(name: &str, size: usize) -> Result<Scene, Error> {
    let folder = tempfile::tempdir().map_err(|e| Error::Internal(format!("no temporary folder: {e}")))?;
    let spec = SimSpec { scene: name.to_owned(), size: Size::new(size, size), seed: SEED, ..SimSpec::default() };
    let mut simulator = simulator(spec)?;
    let capture = simulator.capture(0);
    simulate::write(&capture, simulator.spec(), |file| folder.path().join(format!("{file}.npy")))?;
    write_simulated(simulator.spec(), folder.path())?;
    Scene::load(name.to_owned(), folder.path())
}

/// Measures one scene and appends its rows.
fn measure(scene: &Scene, args: &Args, rows: &mut Vec<Row>) -> Result<(), Error> {
    let size = scene.bundle.sensor.size;
    let row = |method: String, iterations: usize, figures: Option<Figures>| Row {
        scene: scene.name.clone(),
        width: size.width,
        height: size.height,
        method,
        iterations,
        figures,
    };
    if scene.guide.is_some() {
        rows.push(row("guide-only".to_owned(), 0, Some(guide_only(scene, args)?)));
    }
    for (method, default) in ITERATIONS {
        if !args.methods.is_empty() && !args.methods.contains(&method) {
            continue;
        }
        if method == Method::Guided && scene.guide.is_none() {
            tracing::warn!("{}: no guide.npy, {method} is left out", scene.name);
            continue;
        }
        let asked: Vec<_> = args.iterations.iter().map(|n| *n as usize).collect();
        for iterations in if asked.is_empty() { default } else { &asked[..] } {
            tracing::debug!("{}: {method}, {iterations} iterations", scene.name);
            rows.push(row(method.to_string(), *iterations, solve(scene, args, method, *iterations)?));
        }
    }
    tracing::info!("{} {size} measured", scene.name);
    Ok(())
}

fn settings(method: Method, iterations: usize, threads: u32, fft: FftBackend) -> Settings {
    let (method, iterations) = (Some(method), Some(iterations));
    Settings {
        method,
        iterations,
        register: false,
        refit_psf: false,
        fft,
        threads: threads as usize,
        ..Settings::default()
    }
}

/// Settings for single frames; the guide is aligned if requested.
fn single_frame_settings(args: &Args, method: Method, iterations: usize) -> Settings {
    let register = args.register == reconstruct::Switch::On;
    Settings { register, refit_psf: register, ..settings(method, iterations, args.threads, args.fft) }
}

/// Measures one method with one number of iterations; `None` when it diverged.
fn solve(scene: &Scene, args: &Args, method: Method, iterations: usize) -> Result<Option<Figures>, Error> {
    let settings = Settings { guided: scene.guide.is_some(), ..single_frame_settings(args, method, iterations) };
    let mut pipeline = Pipeline::new(&scene.bundle, settings)?;
    let warm_up = match process(&mut pipeline, scene) {
        Err(ProcessError::Recon(e)) => {
            tracing::warn!("{}: {e}", scene.name);
            return Ok(None);
        }
        done => done?,
    };
    let ffts = pipeline.transforms();
    let mut times = vec![warm_up.recon.as_secs_f64()];
    if times[0] < LONG_RUN {
        times.clear();
        for _ in 0..RUNS {
            times.push(process(&mut pipeline, scene)?.recon.as_secs_f64());
        }
    }
    times.sort_by(f64::total_cmp);
    figures(scene, &pipeline, latest(&pipeline), times[times.len() / 2], ffts).map(Some)
}

/// Scores the guide alone: its S0, unpolarized.
fn guide_only(scene: &Scene, args: &Args) -> Result<Figures, Error> {
    let mut pipeline = Pipeline::new(&scene.bundle, single_frame_settings(args, Method::Guided, 1))?;
    process(&mut pipeline, scene)?;
    let angles = pipeline.angles().len();
    let guide = pipeline.guide();
    let image = |c: usize| guide.plane(c).iter().map(|s0| 0.5 * s0);
    let estimate = (0..guide.count()).flat_map(|c| (0..angles).flat_map(move |_| image(c))).collect();
    figures(scene, &pipeline, estimate, 0.0, 0)
}

fn process(pipeline: &mut Pipeline, scene: &Scene) -> Result<FrameReport, ProcessError> {
    let guide = scene.guide.as_ref().map(Stack::view);
    pipeline.process(scene.raw.view().in_unit(scene.unit), guide).map(ProcessedFrame::into_report)
}

fn figures(
    scene: &Scene,
    pipeline: &Pipeline,
    estimate: Vec<f32>,
    seconds: f64,
    ffts: usize,
) -> Result<Figures, Error> {
    let scores = judge(scene, pipeline, estimate)?;
    let workspace_bytes = pipeline.workspace_bytes();
    Ok(Figures { scores, seconds, time_ratio: None, ffts: ffts as f64, workspace_bytes })
}

/// Scores a pipeline's latest result.
fn scores(scene: &Scene, pipeline: &Pipeline) -> Result<Scores, Error> {
    judge(scene, pipeline, latest(pipeline))
}

/// Angle images of a pipeline's latest result.
fn latest(pipeline: &Pipeline) -> Vec<f32> {
    pipeline.result().angles.as_ref().map_or(&[][..], Stack::as_slice).to_vec()
}

fn judge(scene: &Scene, pipeline: &Pipeline, estimate: Vec<f32>) -> Result<Scores, Error> {
    let (angles, size) = (pipeline.angles(), pipeline.size());
    let mut shape = vec![angles.len(), size.height, size.width];
    if scene.raw.count() > 1 {
        shape.insert(0, scene.raw.count());
    }
    Ok(score(&Array { shape, samples: Values::F32(estimate) }, &scene.truth, angles)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_without_bundles_is_not_found() {
        let dir = tempfile::tempdir().unwrap();
        let e = bundles(dir.path()).unwrap_err();
        assert_eq!(e.exit_code(), 66);
        assert!(e.to_string().ends_with("no folder in it has a calibration.toml"), "{e}");
    }
}
