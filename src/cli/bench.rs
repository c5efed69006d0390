//! `stokescope bench`: speed against error of every method, over built-in scenes or a folder of bundles.

mod models;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use num_complex::Complex32;
use rand::{Rng, SeedableRng, rngs::StdRng};
use rand_distr::StandardNormal;
use serde::Serialize;

use super::{reconstruct, simulate};
use crate::Error;
use crate::array::{Array, Values, read_npy, write_atomic};
use crate::calibration::Calibration;
use crate::camera::sim::{SCENES, SimSpec, Simulator};
use crate::evaluate::bench::{Figures, REFERENCE, Row, at_equal_error, csv, means, picture, relate, table};
use crate::evaluate::{EvaluateError, Scores, score};
use crate::optics::{Convolver, FftBackend};
use crate::output::panel::write_png;
use crate::parallel::Workers;
use crate::pipeline::{FrameReport, Pipeline, ProcessError, Settings};
use crate::plane::{Size, Stack};
use crate::prepare::Unit;
use crate::recon::Method;

/// Measure speed against error: every method over iterations and sizes, then a table, bench.csv and bench.png.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder of bundles, each a folder with calibration.toml, raw.npy, truth.npy and mostly guide.npy [default: the built-in
    /// scenes, simulated].
    #[arg(long, value_name = "DIR")]
    pub suite: Option<PathBuf>,
    /// Folder for bench.csv and bench.png; made if need be.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Methods [default: all].
    #[arg(long, value_name = "METHOD", value_delimiter = ',', value_enum)]
    pub methods: Vec<Method>,
    /// Iterations of every method [default: each method's own list].
    #[arg(long, value_name = "N", value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Vec<u32>,
    /// Sizes of the simulated frames in pixels a side.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "250", conflicts_with = "suite",
          value_parser = clap::value_parser!(u32).range(16..=2048))]
    pub size: Vec<u32>,
    /// Threads of the solver. One repeats best.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub threads: u32,
    /// FFT library.
    #[arg(long, value_name = "LIBRARY", value_enum, default_value_t)]
    pub fft: FftBackend,
    /// Instead: a guided iteration against its own four FFTs, two threads against one, and the preparation of a frame.
    #[arg(long, conflicts_with_all = ["suite", "out", "methods", "iterations", "threads"])]
    pub solver: bool,
    /// Instead: frames of videos that go on from each other, against frames solved by themselves.
    #[arg(long, conflicts_with_all = ["suite", "out", "methods", "iterations", "solver"])]
    pub video: bool,
    /// Instead: what every fusion model costs, and what it gains over stage I at equal iterations and at equal time.
    #[arg(long, conflicts_with_all = ["out", "methods", "iterations", "solver", "video"])]
    pub models: bool,
}

/// Iterations when none are asked for: from useless to as good as the method gets, as far as time allows.
const ITERATIONS: [(Method, &[usize]); 6] = [
    (Method::Guided, &[1, 5, 10, 20, 60]),
    (Method::Stokes, &[1, 5, 20, 60]),
    (Method::Fista, &[5, 20, 60, 200]),
    (Method::FistaPublished, &[20, 60, 200, 500]),
    (Method::Admm, &[5, 20, 60, 200]),
    (Method::AdmmPublished, &[1, 5, 20]),
];
/// Measured runs after a warm-up, of which the median counts.
const RUNS: usize = 3;
/// A run of so many seconds needs neither a warm-up nor repetition.
const LONG: f64 = 1.0;
/// Seed of the simulated scenes.
const SEED: u64 = 1;

/// The machine, as far as it says.
#[derive(Clone, Debug, Serialize)]
struct Machine {
    processor: String,
    cores: usize,
}

impl Machine {
    fn this() -> Self {
        let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        // x86 has a model name for each core, ARM boards a model for the board.
        let field = |name: &str| {
            info.lines()
                .find_map(|line| line.split_once(':').filter(|(key, _)| key.trim() == name).map(|(_, v)| v.trim()))
        };
        let processor = field("model name").or_else(|| field("Model")).unwrap_or("unknown processor").to_owned();
        Self { processor, cores: std::thread::available_parallelism().map_or(1, usize::from) }
    }
}

/// The answer.
#[derive(Serialize)]
struct Answer {
    machine: Machine,
    threads: u32,
    scenes: Vec<String>,
    rows: Vec<Row>,
    mean: Vec<Row>,
    at_equal_error: Vec<String>,
}

/// Measures, prints the means (with `json` all rows in one object) and writes the files.
///
/// # Errors
/// A suite that cannot be read or judged, an output folder that cannot be written. A method that diverges is a row without
/// figures.
#[allow(clippy::print_stdout, reason = "the command's answer")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    if args.solver {
        return run_solver(args, json);
    }
    if args.video {
        return run_video(args, json);
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
    relate(&mut rows);
    let mean = means(&rows);
    if let Some(out) = &args.out {
        std::fs::create_dir_all(out)
            .map_err(|source| crate::array::WriteError::Create { path: out.clone(), source })?;
        let all: Vec<_> = rows.iter().chain(&mean).cloned().collect();
        write_atomic(&out.join("bench.csv"), |file| file.write_all(csv(&all).as_bytes()))?;
        write_png(&out.join("bench.png"), &picture(&mean))?;
    }
    let at_equal_error = at_equal_error(&mean);
    let answer = Answer { machine: Machine::this(), threads: args.threads, scenes, rows, mean, at_equal_error };
    if json {
        println!("{}", as_json(&answer)?);
    } else {
        println!("{}, {} thread(s)", describe(&answer.machine), answer.threads);
        println!("mean of {}", answer.scenes.join(", "));
        println!("time ratio: over {REFERENCE} with its most iterations");
        print!("{}", table(&answer.mean));
        answer.at_equal_error.iter().for_each(|line| println!("{line}"));
    }
    Ok(())
}

fn as_json(answer: &impl Serialize) -> Result<String, Error> {
    serde_json::to_string(answer).map_err(|e| Error::Internal(e.to_string()))
}

fn describe(machine: &Machine) -> String {
    format!("{}, {} cores", machine.processor, machine.cores)
}

/// A capture and its truth.
#[derive(Clone)]
struct Scene {
    name: String,
    calibration: Calibration,
    raw: Stack<f32>,
    unit: Unit,
    guide: Option<Stack<f32>>,
    truth: Array,
}

impl Scene {
    /// The same scene in less light, to be processed and not to be judged.
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
        Ok(Self { name, calibration: Calibration::load(folder)?, raw, unit, guide, truth })
    }
}

/// The bundles in a folder, by name.
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

/// A built-in scene, by way of files as any other bundle.
fn simulated(name: &str, size: usize) -> Result<Scene, Error> {
    let folder = tempfile::tempdir().map_err(|e| Error::Internal(format!("no temporary folder: {e}")))?;
    let spec = SimSpec { scene: name.to_owned(), size: Size::new(size, size), seed: SEED, ..SimSpec::default() };
    let mut simulator = Simulator::new(spec)?;
    let capture = simulator.capture(0);
    simulate::write(&capture, simulator.spec(), |file| folder.path().join(format!("{file}.npy")))?;
    simulator.spec().write_bundle(folder.path())?;
    Scene::load(name.to_owned(), folder.path())
}

/// Adds the rows of one scene.
fn measure(scene: &Scene, args: &Args, rows: &mut Vec<Row>) -> Result<(), Error> {
    let size = scene.calibration.sensor.size;
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
    for (method, usual) in ITERATIONS {
        if !args.methods.is_empty() && !args.methods.contains(&method) {
            continue;
        }
        if method == Method::Guided && scene.guide.is_none() {
            tracing::warn!("{}: no guide.npy, {method} is left out", scene.name);
            continue;
        }
        let asked: Vec<_> = args.iterations.iter().map(|n| *n as usize).collect();
        for iterations in if asked.is_empty() { usual } else { &asked[..] } {
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
        fft,
        threads: threads as usize,
        memory_limit_bytes: usize::MAX,
        fusion: None,
        video: false,
        angles: true,
    }
}

/// One method with one number of iterations; none when it diverged.
fn solve(scene: &Scene, args: &Args, method: Method, iterations: usize) -> Result<Option<Figures>, Error> {
    let settings = settings(method, iterations, args.threads, args.fft);
    let mut pipeline = Pipeline::plan(&scene.calibration, scene.guide.is_some(), &settings)?;
    let warm_up = match process(&mut pipeline, scene) {
        Err(ProcessError::Recon(e)) => {
            tracing::warn!("{}: {e}", scene.name);
            return Ok(None);
        }
        done => done?,
    };
    let ffts = pipeline.transforms();
    let mut times = vec![warm_up.recon.as_secs_f64()];
    if times[0] < LONG {
        times.clear();
        for _ in 0..RUNS {
            times.push(process(&mut pipeline, scene)?.recon.as_secs_f64());
        }
    }
    times.sort_by(f64::total_cmp);
    let estimate = pipeline.result().angles.as_ref().map_or(&[][..], Stack::as_slice);
    figures(scene, &pipeline, estimate.to_vec(), times[times.len() / 2], ffts).map(Some)
}

/// What the guide alone gives: its S0, unpolarized.
fn guide_only(scene: &Scene, args: &Args) -> Result<Figures, Error> {
    let mut pipeline = Pipeline::plan(&scene.calibration, true, &settings(Method::Guided, 1, args.threads, args.fft))?;
    process(&mut pipeline, scene)?;
    let angles = pipeline.angles().len();
    let guide = pipeline.guide();
    let image = |c: usize| guide.plane(c).iter().map(|s0| 0.5 * s0);
    let estimate = (0..guide.count()).flat_map(|c| (0..angles).flat_map(move |_| image(c))).collect();
    figures(scene, &pipeline, estimate, 0.0, 0)
}

fn process(pipeline: &mut Pipeline, scene: &Scene) -> Result<FrameReport, ProcessError> {
    pipeline.process(&scene.raw, scene.unit, scene.guide.as_ref())
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

/// Errors of a pipeline's latest result.
fn scores(scene: &Scene, pipeline: &Pipeline) -> Result<Scores, Error> {
    judge(scene, pipeline, pipeline.result().angles.as_ref().map_or(&[][..], Stack::as_slice).to_vec())
}

fn judge(scene: &Scene, pipeline: &Pipeline, estimate: Vec<f32>) -> Result<Scores, Error> {
    let (angles, size) = (pipeline.angles(), pipeline.size());
    let mut shape = vec![angles.len(), size.height, size.width];
    if scene.raw.count() > 1 {
        shape.insert(0, scene.raw.count());
    }
    Ok(score(&Array { shape, samples: Values::F32(estimate) }, &scene.truth, angles)?)
}

/// What `--solver` finds, in milliseconds; the least of many rounds, for other load only adds.
#[derive(Debug, Serialize)]
struct SolverAnswer {
    machine: Machine,
    width: usize,
    height: usize,
    padded_width: usize,
    padded_height: usize,
    /// One guided iteration, one thread.
    iteration_ms: f64,
    /// Four plain complex 2-D FFTs of the padded size, every row and column of them.
    four_ffts_ms: f64,
    /// `iteration_ms / four_ffts_ms`
    iteration_per_four_ffts: f64,
    /// One guided iteration, two threads.
    two_threads_ms: f64,
    /// `iteration_ms / two_threads_ms`
    speed_up_of_two_threads: f64,
    /// Preparing a frame with one thread and finding its guide: of a first frame, and of one whose guide is as the last one's.
    first_preparation_ms: f64,
    next_preparation_ms: f64,
    /// Bytes of the solver's buffers with one thread, by part and together. What belongs to the camera (its spectrum, the maps,
    /// the direct start's equations) and the frame itself are not among them.
    workspace_parts: Vec<(&'static str, usize)>,
    workspace_bytes: usize,
}

/// Rounds of `--solver`, and iterations and FFTs of each.
const ROUNDS: usize = 40;
const MANY: usize = 20;

#[allow(clippy::print_stdout, reason = "the command's answer")]
fn run_solver(args: &Args, json: bool) -> Result<(), Error> {
    let scene = simulated(SCENES[0].0, args.size[0] as usize)?;
    let plan = |threads| Pipeline::plan(&scene.calibration, true, &settings(Method::Guided, MANY, threads, args.fft));
    let mut pipelines = [plan(1)?, plan(2)?];
    let registered = Settings { register: true, ..settings(Method::Guided, 1, 1, args.fft) };
    let mut registering = Pipeline::plan(&scene.calibration, true, &registered)?;
    let mut preparations = [f64::INFINITY; 2];
    let psf = &scene.calibration.psf;
    let convolver = Convolver::new(psf.size(), psf.reach(), args.fft, Arc::new(Workers::new(1)))
        .map_err(crate::pipeline::PlanError::from)?;
    let padded = convolver.padded();
    let mut fft = Fft2::new(padded);
    // Both are short, about as long, and timed one by one, so that some fall into the gaps of other load.
    let (mut iterations, mut ffts) = ([f64::INFINITY; 2], f64::INFINITY);
    for _ in 0..ROUNDS {
        registering.forget_guide();
        for least in &mut preparations {
            let report = process(&mut registering, &scene)?;
            *least = (report.prepare + report.register).as_secs_f64().min(*least);
        }
        for (least, pipeline) in iterations.iter_mut().zip(&mut pipelines) {
            process(pipeline, &scene)?;
            *least = pipeline.shortest_iteration().map_or(f64::INFINITY, |t| t.as_secs_f64()).min(*least);
            for _ in 0..MANY {
                let start = Instant::now();
                (0..4).for_each(|_| fft.run());
                ffts = ffts.min(start.elapsed().as_secs_f64());
            }
        }
    }
    let [iteration, two_threads] = iterations;
    let workspace_parts = pipelines[0].solver_parts();
    let answer = SolverAnswer {
        machine: Machine::this(),
        width: psf.size().width,
        height: psf.size().height,
        padded_width: padded.width,
        padded_height: padded.height,
        iteration_ms: 1e3 * iteration,
        four_ffts_ms: 1e3 * ffts,
        iteration_per_four_ffts: iteration / ffts,
        two_threads_ms: 1e3 * two_threads,
        speed_up_of_two_threads: iteration / two_threads,
        first_preparation_ms: 1e3 * preparations[0],
        next_preparation_ms: 1e3 * preparations[1],
        workspace_bytes: workspace_parts.iter().map(|(_, bytes)| bytes).sum(),
        workspace_parts,
    };
    if json {
        println!("{}", as_json(&answer)?);
    } else {
        println!("{}", describe(&answer.machine));
        println!("guided, {} padded to {padded}, {:?}", psf.size(), args.fft);
        println!("one iteration, 1 thread     {:8.2} ms", answer.iteration_ms);
        println!("four complex 2-D FFTs       {:8.2} ms", answer.four_ffts_ms);
        println!("ratio                       {:8.2}", answer.iteration_per_four_ffts);
        println!("one iteration, 2 threads    {:8.2} ms", answer.two_threads_ms);
        println!("speed-up of 2 threads       {:8.2}", answer.speed_up_of_two_threads);
        println!("preparation, first frame    {:8.2} ms", answer.first_preparation_ms);
        println!("preparation, next frame     {:8.2} ms", answer.next_preparation_ms);
        println!("workspace, 1 thread         {:8} bytes", answer.workspace_bytes);
        answer.workspace_parts.iter().for_each(|(part, bytes)| println!("  {part:<30} {bytes:8}"));
    }
    Ok(())
}

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

/// One frame of a video.
#[derive(Debug, Serialize)]
struct VideoRow {
    video: &'static str,
    frame: u64,
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
fn run_video(args: &Args, json: bool) -> Result<(), Error> {
    let size = args.size[0] as usize;
    let mut rows: Vec<VideoRow> = Vec::new();
    if !json {
        println!("{}", describe(&Machine::this()));
        println!("frame  course  iterations  averaged  S1,S2 [dB]  cold [dB]  time [ms]  cold [ms]");
    }
    for (video, scene, frame_rate) in VIDEOS {
        if !json {
            println!("{video}, {}", Size::new(size, size));
        }
        let spec = SimSpec {
            scene: scene.to_owned(),
            size: Size::new(size, size),
            seed: SEED,
            frame_rate: frame_rate.unwrap_or(1.0),
            ..SimSpec::default()
        };
        // The simulator's time stands still in its first frame alone: its noise is added here.
        let noise = [spec.read_noise * f32::from(spec.saturation() - spec.black_level), spec.guide_noise];
        let still = frame_rate.is_none();
        let spec = if still { SimSpec { read_noise: 0.0, shot_noise: 0.0, guide_noise: 0.0, ..spec } } else { spec };
        let mut rng = StdRng::seed_from_u64(SEED);
        let mut simulator = Simulator::new(spec)?;
        let folder = tempfile::tempdir().map_err(|e| Error::Internal(format!("no temporary folder: {e}")))?;
        simulator.spec().write_bundle(folder.path())?;
        let calibration = Calibration::load(folder.path())?;
        let by_itself = Settings { register: true, ..settings(Method::Guided, COLD, args.threads, args.fft) };
        let mut next = Pipeline::plan(&calibration, true, &Settings { video: true, ..by_itself.clone() })?;
        let mut cold = Pipeline::plan(&calibration, true, &by_itself)?;
        for frame in 0..FRAMES {
            let mut capture = simulator.capture(if still { 0 } else { frame });
            let counts = capture.raw.as_slice().iter().map(|v| f32::from(*v)).collect();
            let mut raw = Stack::from_vec(capture.raw.count(), capture.raw.size(), counts)
                .map_err(|e| Error::Internal(e.to_string()))?;
            for (image, sigma) in [&mut raw, &mut capture.guide].into_iter().zip(noise).filter(|_| still) {
                image.as_mut_slice().iter_mut().for_each(|v| *v += sigma * rng.sample::<f32, _>(StandardNormal));
            }
            let truth = Array {
                shape: vec![capture.truth.count(), size, size],
                samples: Values::F32(capture.truth.as_slice().to_vec()),
            };
            let solve = |pipeline: &mut Pipeline| -> Result<(FrameReport, f64), Error> {
                let report = pipeline.process(&raw, Unit::Counts, Some(&capture.guide))?;
                let angles = pipeline.result().angles.as_ref().map_or(&[][..], Stack::as_slice).to_vec();
                let estimate = Array { shape: truth.shape.clone(), samples: Values::F32(angles) };
                Ok((report, score(&estimate, &truth, pipeline.angles())?.s12_psnr))
            };
            let ((report, s12_psnr), (alone, s12_psnr_cold)) = (solve(&mut next)?, solve(&mut cold)?);
            let row = VideoRow {
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
            if !json {
                println!(
                    "{:5}  {:6}  {:10}  {:8}  {:10.2}  {:9.2}  {:9.1}  {:9.1}",
                    row.frame,
                    row.course,
                    row.iterations,
                    row.averaged,
                    row.s12_psnr,
                    row.s12_psnr_cold,
                    1e3 * row.seconds,
                    1e3 * row.seconds_cold
                );
            }
            rows.push(row);
        }
    }
    if json {
        println!("{}", as_json(&rows)?);
    }
    Ok(())
}

/// The yardstick: a plain complex 2-D FFT by rustfft on one thread, whatever the solver uses. All rows, then all columns,
/// copied eight at a time, a cache line of each row, into lines and back; nothing is left out for being zero or not needed.
struct Fft2 {
    row: Arc<dyn rustfft::Fft<f32>>,
    column: Arc<dyn rustfft::Fft<f32>>,
    image: Vec<Complex32>,
    columns: Vec<Complex32>,
    scratch: Vec<Complex32>,
}

impl Fft2 {
    /// Columns at a time: a cache line.
    const COLUMNS: usize = 8;

    fn new(padded: Size) -> Self {
        let mut planner = rustfft::FftPlanner::new();
        let (row, column) = (planner.plan_fft_forward(padded.width), planner.plan_fft_forward(padded.height));
        let scratch = row.get_inplace_scratch_len().max(column.get_inplace_scratch_len());
        Self {
            row,
            column,
            image: vec![Complex32::ZERO; padded.pixels()],
            columns: vec![Complex32::ZERO; Self::COLUMNS * padded.height],
            scratch: vec![Complex32::ZERO; scratch],
        }
    }

    fn run(&mut self) {
        let (width, height) = (self.row.len(), self.column.len());
        self.row.process_with_scratch(&mut self.image, &mut self.scratch);
        for first in (0..width).step_by(Self::COLUMNS) {
            let count = Self::COLUMNS.min(width - first);
            for (y, row) in self.image.chunks_exact(width).enumerate() {
                (0..count).for_each(|x| self.columns[x * height + y] = row[first + x]);
            }
            self.column.process_with_scratch(&mut self.columns[..count * height], &mut self.scratch);
            for (y, row) in self.image.chunks_exact_mut(width).enumerate() {
                (0..count).for_each(|x| row[first + x] = self.columns[x * height + y]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_plain_fft_of_an_impulse_is_a_wave_in_both_directions() {
        let mut fft = Fft2::new(Size::new(20, 8));
        fft.image[20 + 1] = Complex32::ONE;
        fft.run();
        for (i, v) in fft.image.iter().enumerate() {
            let phase = -std::f32::consts::TAU * ((i % 20) as f32 / 20.0 + (i / 20) as f32 / 8.0);
            assert!((v - Complex32::cis(phase)).norm() < 1e-5, "{i}: {v}");
        }
    }

    #[test]
    fn a_folder_without_bundles_is_not_found() {
        let dir = tempfile::tempdir().unwrap();
        let e = bundles(dir.path()).unwrap_err();
        assert_eq!(e.exit_code(), 66);
        assert!(e.to_string().ends_with("no folder in it has a calibration.toml"), "{e}");
    }
}
