//! `stokescope bench --models`: cost of every fusion model, and its gain compared with more iterations of stage I.

use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use super::{Args, Machine, RUNS, Scene, as_json, bundles, describe, process, scores, settings, simulated};
use crate::Error;
use crate::camera::sim::SCENES;
use crate::evaluate::Scores;
use crate::heap;
use crate::model::{Model, Network, NetworkError, OpenError, Precision};
use stokescope_core::parallel::Workers;
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::solve::Method;

/// Iterations of stage I before the network.
const BEHIND: usize = 10;
/// Runs of a network alone, of which the shortest counts.
const ALONE: usize = 40;
/// Largest number of iterations that a network's time is compared with.
const MOST: usize = 300;

/// A model in one precision; gains are means over the scenes.
#[derive(Debug, Serialize)]
struct Row {
    model: String,
    precision: Precision,
    /// Multiply-adds for a tile.
    macs: u64,
    /// Constants of the network.
    parameters: usize,
    file_bytes: usize,
    /// Time of stage II for a frame.
    fusion_ms: f64,
    /// Time of the network alone, on one thread, for a tile of its manifest's size.
    network_ms: f64,
    /// Iterations of stage I that take as long as [`BEHIND`] iterations and the network.
    iterations_at_equal_time: f64,
    /// Gain of the PSNR of S1 and S2 over stage I with the same iterations.
    gain_db: f64,
    /// `gain_db` of the scene that gains least.
    least_gain_db: f64,
    /// Gain of the PSNR of S1 and S2 over stage I in the same time.
    gain_at_equal_time_db: f64,
    /// Relative change of the mean AoLP error in degrees, against the same iterations. Scenes of weak polarization dominate it.
    aolp: f64,
    /// Mean of the scenes' relative changes, against the same iterations.
    aolp_by_scene: f64,
    /// As `aolp`, against the same time.
    aolp_at_equal_time: f64,
    /// As `aolp_by_scene`, against the same time.
    aolp_by_scene_at_equal_time: f64,
    /// Refused tiles.
    refused: usize,
    tiles: usize,
}

#[derive(Serialize)]
struct Answer {
    machine: Machine,
    threads: u32,
    scenes: Vec<String>,
    rows: Vec<Row>,
}

/// One scene, refined by a network and solved without it.
struct Comparison {
    /// Scores with the network, of stage I with the same iterations, and of stage I in the same time.
    scores: [Scores; 3],
    fusion_ms: f64,
    /// Iterations in the same time.
    iterations: f64,
    refused: usize,
    tiles: usize,
}

#[allow(clippy::print_stdout, reason = "the command's answer")]
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
        heap::keep();
        let alone = shortest_runs(&networks).map_err(OpenError::from)?;
        for (network, seconds) in networks.iter().zip(alone) {
            let row = Row {
                // The multiply-adds and constants of the f32 network, which comes first, are those of the model.
                macs: networks[0].macs(),
                parameters: networks[0].engine().parameters(),
                file_bytes: model.onnx(network.precision()).map_err(OpenError::from)?.bytes.len(),
                network_ms: 1e3 * seconds,
                ..measure(&scenes, network, args)?
            };
            rows.push(row);
            tracing::info!("{name} {} measured", network.precision());
        }
    }
    let names = scenes.into_iter().map(|scene| scene.name).collect();
    let answer = Answer { machine: Machine::this(), threads: args.threads, scenes: names, rows };
    if json {
        println!("{}", as_json(&answer)?);
    } else {
        print(&answer);
    }
    Ok(())
}

#[allow(clippy::print_stdout, reason = "the command's answer")]
fn print(answer: &Answer) {
    println!("{}, {} thread(s)", describe(&answer.machine), answer.threads);
    println!("mean of {}; {BEHIND} guided iterations, then the network", answer.scenes.join(", "));
    println!(
        "AoLP: change of its error, in the mean of degrees (weak polarization weighs most) and of scenes (all weigh alike)"
    );
    println!(
        "                                                    net | the same iterations            | as many as take as long"
    );
    println!(
        "model     numbers  GMAC   params  file kB      ms  alone | S1,S2 dB  worst   AoLP  scenes |  its.  S1,S2 dB   AoLP  scenes | refused"
    );
    for r in &answer.rows {
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

/// The shortest time of [`ALONE`] runs of each network on one tile, without candidates, on one thread \[s\]. The networks take turns, so
/// that a slow moment of the machine affects all of them.
fn shortest_runs(networks: &[Network]) -> Result<Vec<f64>, NetworkError> {
    let alone = Arc::new(Workers::new(1));
    let mut shortest = vec![f64::INFINITY; networks.len()];
    let mut runners = Vec::new();
    for network in networks {
        let features = vec![0.0; network.model().shapes()[0].iter().product()];
        runners.push((network.engine().runner()?, features));
    }
    for _ in 0..ALONE {
        for ((runner, features), shortest) in runners.iter_mut().zip(&mut shortest) {
            let start = Instant::now();
            runner.run(features, &alone, &mut |_| ())?;
            *shortest = shortest.min(start.elapsed().as_secs_f64());
        }
    }
    Ok(shortest)
}

/// The means of a network's comparisons over all scenes with a guide. Cost and size of the network are left 0.
fn measure(scenes: &[Scene], network: &Network, args: &Args) -> Result<Row, Error> {
    let judged = scenes.iter().filter(|scene| scene.guide.is_some());
    let all = judged.map(|scene| compare(scene, network, args)).collect::<Result<Vec<_>, _>>()?;
    let mean = |value: &dyn Fn(&Comparison) -> f64| all.iter().map(value).sum::<f64>() / all.len().max(1) as f64;
    let gain = |c: &Comparison, of: usize| c.scores[0].s12_psnr - c.scores[of].s12_psnr;
    let error = |k: usize| all.iter().map(|c| c.scores[k].aolp_mae_deg).sum::<f64>();
    let change = |c: &Comparison, of: usize| match c.scores[of].aolp_mae_deg {
        before if before > 0.0 => c.scores[0].aolp_mae_deg / before - 1.0,
        _ => 0.0,
    };
    Ok(Row {
        model: network.model().name.clone(),
        precision: network.precision(),
        macs: 0,
        parameters: 0,
        file_bytes: 0,
        network_ms: 0.0,
        fusion_ms: mean(&|c| c.fusion_ms),
        iterations_at_equal_time: mean(&|c| c.iterations),
        gain_db: mean(&|c| gain(c, 1)),
        least_gain_db: all.iter().map(|c| gain(c, 1)).fold(f64::INFINITY, f64::min),
        gain_at_equal_time_db: mean(&|c| gain(c, 2)),
        aolp: error(0) / error(1) - 1.0,
        aolp_by_scene: mean(&|c| change(c, 1)),
        aolp_at_equal_time: error(0) / error(2) - 1.0,
        aolp_by_scene_at_equal_time: mean(&|c| change(c, 2)),
        refused: all.iter().map(|c| c.refused).sum(),
        tiles: all.iter().map(|c| c.tiles).sum(),
    })
}

/// Refines a scene with a network, and solves it without one: with the same iterations, and with those that take as long.
fn compare(scene: &Scene, network: &Network, args: &Args) -> Result<Comparison, Error> {
    let plan = |iterations, fusion| {
        let settings = Settings {
            fusion,
            register: true,
            refit_psf: true,
            ..settings(Method::Guided, iterations, args.threads, args.fft)
        };
        Pipeline::new(&scene.bundle, settings)
    };
    let seconds_of = |pipeline: &Pipeline| pipeline.shortest_iteration().map_or(f64::INFINITY, |t| t.as_secs_f64());
    let solve = |iterations| -> Result<_, Error> {
        let mut pipeline = plan(iterations, None)?;
        process(&mut pipeline, scene)?;
        Ok((scores(scene, &pipeline)?, seconds_of(&pipeline)))
    };
    let (before, mut iteration) = solve(BEHIND)?;
    let mut pipeline = plan(BEHIND, Some(network.clone()))?;
    let fusion = process(&mut pipeline, scene)?.fusion.unwrap_or_default();
    let after = scores(scene, &pipeline)?;
    // Every other frame is darker, so that no tile keeps its correction of the one before.
    let mut seconds = f64::INFINITY;
    let darker = scene.darker();
    for frame in [&darker, scene].into_iter().cycle().take(2 * RUNS) {
        seconds = seconds.min(process(&mut pipeline, frame)?.fusion_time.as_secs_f64());
        iteration = iteration.min(seconds_of(&pipeline));
    }
    let iterations = (BEHIND + (seconds / iteration).round() as usize).min(MOST);
    let (longer, _) = solve(iterations)?;
    Ok(Comparison {
        scores: [after, before, longer],
        fusion_ms: 1e3 * seconds,
        iterations: iterations as f64,
        refused: fusion.refused,
        tiles: fusion.tiles,
    })
}
