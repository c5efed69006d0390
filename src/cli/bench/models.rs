//! `stokescope bench --models`: measures cost and gain of every fusion model, compared with more iterations.

use serde::Serialize;

use super::{Args, Machine, RUNS, Scene, as_json, bundles, describe, process, scores, settings, simulated};
use crate::Error;
use crate::camera::sim::SCENES;
use crate::evaluate::Scores;
use crate::heap;
use crate::model::{Model, Network, OpenError, Precision};
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::solve::Method;

/// Iterations of stage I before the network.
const ITERATIONS: usize = 10;
/// Number of runs of the network alone; the result is the shortest.
const NETWORK_RUNS: usize = 40;
/// Largest number of iterations for the comparison at equal time.
const MAX_ITERATIONS: usize = 300;

/// Result of a model in one precision; gains are means over the scenes.
#[derive(Debug, Default, Serialize)]
struct Row {
    model: String,
    precision: Precision,
    /// Multiply-adds per tile, and parameters of the network.
    macs: u64,
    parameters: usize,
    file_bytes: usize,
    /// Milliseconds of stage II for a frame, and of the network alone for one tile, with one thread.
    fusion_ms: f64,
    network_ms: f64,
    /// Guided iterations that take as long as [`ITERATIONS`] and the network together.
    iterations_at_equal_time: f64,
    /// Gain in S1, S2 PSNR over stage I with as many iterations: mean, and of the worst scene.
    gain_db: f64,
    least_gain_db: f64,
    /// Gain in S1, S2 PSNR over stage I in as much time.
    gain_at_equal_time_db: f64,
    /// Relative change of the AoLP error against as many iterations: of the mean error, which weakly polarized scenes dominate, and
    /// the mean over the changes of each scene. The next two compare with stage I in as much time.
    aolp: f64,
    aolp_by_scene: f64,
    aolp_at_equal_time: f64,
    aolp_by_scene_at_equal_time: f64,
    /// Rejected tiles and all tiles.
    refused: usize,
    tiles: usize,
}

#[derive(Serialize)]
struct Output {
    machine: Machine,
    threads: u32,
    scenes: Vec<String>,
    rows: Vec<Row>,
}

#[allow(clippy::print_stdout, reason = "output of the command")]
pub(super) fn run(args: &Args, json: bool) -> Result<(), Error> {
    let scenes: Vec<Scene> = match &args.suite {
        Some(suite) => {
            bundles(suite)?.into_iter().map(|(name, path)| Scene::load(name, &path)).collect::<Result<_, _>>()?
        }
        None => SCENES.iter().map(|(name, _)| simulated(name, args.size[0] as usize)).collect::<Result<_, _>>()?,
    };
    let mut rows = Vec::new();
    for name in Model::shipped().map(str::to_owned).chain(Model::local()) {
        let model = Model::load(&name).map_err(OpenError::from)?;
        let networks = model.precisions().into_iter().map(|precision| model.open(precision));
        let networks = networks.collect::<Result<Vec<_>, _>>()?;
        // multiply-adds and parameters are those of f32, which always exists and is the first
        let reference = &networks[0];
        heap::keep();
        let network_seconds = Network::shortest_runs(&networks, NETWORK_RUNS).map_err(OpenError::from)?;
        for (network, seconds) in networks.iter().zip(network_seconds) {
            rows.push(measure(&scenes, network, seconds, reference, args)?);
            tracing::info!("{name} {} measured", network.precision());
        }
    }
    let names = scenes.into_iter().map(|scene| scene.name).collect();
    let output = Output { machine: Machine::this(), threads: args.threads, scenes: names, rows };
    if json {
        println!("{}", as_json(&output)?);
        return Ok(());
    }
    print_table(&output);
    Ok(())
}

#[allow(clippy::print_stdout, reason = "output of the command")]
fn print_table(output: &Output) {
    println!("{}, {} thread(s)", describe(&output.machine), output.threads);
    println!("mean of {}; {ITERATIONS} guided iterations, then the network", output.scenes.join(", "));
    println!(
        "AoLP: change of the mean error in degrees (weakly polarized scenes weigh most), and mean change over scenes (all weigh the same)"
    );
    println!(
        "                                                    net | at equal iterations            | at equal time"
    );
    println!(
        "model     numbers  GMAC   params  file kB      ms  alone | S1,S2 dB  worst   AoLP  scenes |  its.  S1,S2 dB   AoLP  scenes | refused"
    );
    for r in &output.rows {
        println!(
            "{:9} {:7} {:5.3}  {:6}  {:7.0}  {:6.1}  {:5.1} | {:+8.2}  {:+5.2} {:+5.1}%  {:+5.1}% | {:5.0}  {:+8.2} {:+5.1}%  {:+5.1}% | {}/{}",
            r.model,
            r.precision.to_string(),
            r.macs as f64 / 1e9,
            r.parameters,
            r.file_bytes as f64 / 1e3,
            r.fusion_ms,
            r.network_ms,
            r.gain_db,
            r.least_gain_db,
            100.0 * r.aolp,
            100.0 * r.aolp_by_scene,
            r.iterations_at_equal_time,
            r.gain_at_equal_time_db,
            100.0 * r.aolp_at_equal_time,
            100.0 * r.aolp_by_scene_at_equal_time,
            r.refused,
            r.tiles,
        );
    }
}

/// Makes a pipeline for `scene`. As by default, it aligns the guide and refits the PSF before stage I.
fn pipeline(scene: &Scene, iterations: usize, fusion: Option<Network>, args: &Args) -> Result<Pipeline, Error> {
    let settings = Settings {
        fusion,
        register: true,
        refit_psf: true,
        ..settings(Method::Guided, iterations, args.threads, args.fft)
    };
    Ok(Pipeline::new(&scene.bundle, settings)?)
}

/// Duration of the pipeline's shortest iteration in seconds.
fn shortest_iteration(pipeline: &Pipeline) -> f64 {
    pipeline.shortest_iteration().map_or(f64::INFINITY, |t| t.as_secs_f64())
}

/// Scores stage I alone; also returns the seconds of its shortest iteration.
fn stage_one(scene: &Scene, iterations: usize, args: &Args) -> Result<(Scores, f64), Error> {
    let mut pipeline = pipeline(scene, iterations, None, args)?;
    process(&mut pipeline, scene)?;
    Ok((scores(scene, &pipeline)?, shortest_iteration(&pipeline)))
}

/// Result of stage II on one scene.
struct Fused {
    scores: Scores,
    /// Seconds of stage II, and of the shortest iteration before it.
    seconds: f64,
    iteration: f64,
    refused: usize,
    tiles: usize,
}

fn fused(scene: &Scene, network: &Network, args: &Args) -> Result<Fused, Error> {
    let mut pipeline = pipeline(scene, ITERATIONS, Some(network.clone()), args)?;
    let fusion = process(&mut pipeline, scene)?.fusion.unwrap_or_default();
    let scores = scores(scene, &pipeline)?;
    let (mut seconds, mut iteration) = (f64::INFINITY, f64::INFINITY);
    // every other frame is darker, so that no tile reuses its previous output
    let darker = scene.darker();
    for frame in [&darker, scene].into_iter().cycle().take(2 * RUNS) {
        seconds = seconds.min(process(&mut pipeline, frame)?.fusion_time.as_secs_f64());
        iteration = iteration.min(shortest_iteration(&pipeline));
    }
    Ok(Fused { scores, seconds, iteration, refused: fusion.refused, tiles: fusion.tiles })
}

fn measure(scenes: &[Scene], network: &Network, seconds: f64, reference: &Network, args: &Args) -> Result<Row, Error> {
    let mut row = Row {
        model: network.model().name.clone(),
        precision: network.precision(),
        macs: reference.macs(),
        parameters: reference.parameters(),
        file_bytes: network.file_bytes(),
        network_ms: 1e3 * seconds,
        least_gain_db: f64::INFINITY,
        ..Row::default()
    };
    let mut angles = [0.0; 3];
    let guided: Vec<_> = scenes.iter().filter(|s| s.guide.is_some()).collect();
    for scene in &guided {
        let (before, iteration) = stage_one(scene, ITERATIONS, args)?;
        let after = fused(scene, network, args)?;
        let more = (after.seconds / iteration.min(after.iteration)).round() as usize;
        let more = (ITERATIONS + more).min(MAX_ITERATIONS);
        let (longer, _) = stage_one(scene, more, args)?;
        let gain = after.scores.s12_psnr - before.s12_psnr;
        (row.refused, row.tiles) = (row.refused + after.refused, row.tiles + after.tiles);
        row.fusion_ms += 1e3 * after.seconds;
        row.iterations_at_equal_time += more as f64;
        row.gain_db += gain;
        row.least_gain_db = row.least_gain_db.min(gain);
        row.gain_at_equal_time_db += after.scores.s12_psnr - longer.s12_psnr;
        let errors = [after.scores, before, longer].map(|s| s.aolp_mae_deg);
        let change = |of: f64| if of > 0.0 { errors[0] / of - 1.0 } else { 0.0 };
        row.aolp_by_scene += change(errors[1]);
        row.aolp_by_scene_at_equal_time += change(errors[2]);
        angles.iter_mut().zip(errors).for_each(|(sum, error)| *sum += error);
    }
    let n = guided.len().max(1) as f64;
    for mean in [
        &mut row.fusion_ms,
        &mut row.iterations_at_equal_time,
        &mut row.gain_db,
        &mut row.gain_at_equal_time_db,
        &mut row.aolp_by_scene,
        &mut row.aolp_by_scene_at_equal_time,
    ] {
        *mean /= n;
    }
    (row.aolp, row.aolp_at_equal_time) = (angles[0] / angles[1] - 1.0, angles[0] / angles[2] - 1.0);
    Ok(row)
}
