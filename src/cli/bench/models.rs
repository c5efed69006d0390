//! `stokescope bench --models`: what every fusion model costs, and what it is worth against more iterations.

use serde::Serialize;

use super::{Args, Machine, RUNS, Scene, as_json, bundles, describe, process, scores, settings, simulated};
use crate::Error;
use crate::camera::sim::SCENES;
use crate::evaluate::Scores;
use crate::heap;
use crate::model::{Model, Network, OpenError, Precision};
use stokescope_core::pipeline::{Pipeline, Settings};
use stokescope_core::solve::Method;

/// Iterations before the network.
const BEHIND: usize = 10;
/// Runs of a network alone, of which the shortest counts.
const ALONE: usize = 40;
/// Most iterations that a network's time is compared with.
const MOST: usize = 300;

/// A model in one precision; gains are means over the scenes.
#[derive(Debug, Serialize)]
struct Row {
    model: String,
    precision: Precision,
    /// Multiply-adds for a tile, and the constants of the network.
    macs: u64,
    parameters: usize,
    file_bytes: usize,
    /// Stage II of a frame, and the network alone on a tile of its manifest's size, one thread.
    fusion_ms: f64,
    network_ms: f64,
    /// Guided iterations in all that take as long as those before the network and the network together.
    iterations_at_equal_time: f64,
    /// S1, S2 PSNR over that of stage I with as many iterations: in the mean, and in the worst scene.
    gain_db: f64,
    least_gain_db: f64,
    /// S1, S2 PSNR over that of stage I in as much time.
    gain_at_equal_time_db: f64,
    /// Change of the AoLP error against as many iterations: of the mean in degrees, which scenes of weak polarization make, and the
    /// mean of the scenes' own changes. Then the same against as much time.
    aolp: f64,
    aolp_by_scene: f64,
    aolp_at_equal_time: f64,
    aolp_by_scene_at_equal_time: f64,
    /// Tiles whose answer was not used, of how many.
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
        // Multiply-adds and parameters are those of f32, which is always there, and first.
        let exact = &networks[0];
        heap::keep();
        let alone = Network::shortest_runs(&networks, ALONE).map_err(OpenError::from)?;
        for (network, seconds) in networks.iter().zip(alone) {
            rows.push(measure(&scenes, network, seconds, exact, args)?);
            tracing::info!("{name} {} measured", network.precision());
        }
    }
    let names = scenes.into_iter().map(|scene| scene.name).collect();
    let answer = Answer { machine: Machine::this(), threads: args.threads, scenes: names, rows };
    if json {
        println!("{}", as_json(&answer)?);
        return Ok(());
    }
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
    Ok(())
}

fn measure(scenes: &[Scene], network: &Network, alone: f64, exact: &Network, args: &Args) -> Result<Row, Error> {
    let model = network.model();
    let mut row = Row {
        model: model.name.clone(),
        precision: network.precision(),
        macs: exact.macs(),
        parameters: exact.parameters(),
        file_bytes: network.file_bytes(),
        fusion_ms: 0.0,
        network_ms: 1e3 * alone,
        iterations_at_equal_time: 0.0,
        gain_db: 0.0,
        least_gain_db: f64::INFINITY,
        gain_at_equal_time_db: 0.0,
        aolp: 0.0,
        aolp_by_scene: 0.0,
        aolp_at_equal_time: 0.0,
        aolp_by_scene_at_equal_time: 0.0,
        refused: 0,
        tiles: 0,
    };
    let plan = |scene: &Scene, iterations, fusion| {
        // an aligned guide, as by default: stage II need not ask where it lies
        let settings = Settings {
            fusion,
            register: true,
            refit_psf: true,
            ..settings(Method::Guided, iterations, args.threads, args.fft)
        };
        Pipeline::new(&scene.calibration, settings)
    };
    let solve = |scene: &Scene, iterations| -> Result<_, Error> {
        let mut pipeline = plan(scene, iterations, None)?;
        process(&mut pipeline, scene)?;
        let iteration = pipeline.shortest_iteration().map_or(f64::INFINITY, |t| t.as_secs_f64());
        Ok((scores(scene, &pipeline)?, iteration))
    };
    let mut angles = [0.0; 3];
    let judged: Vec<_> = scenes.iter().filter(|s| s.guide.is_some()).collect();
    for scene in &judged {
        let (before, mut iteration) = solve(scene, BEHIND)?;
        let mut pipeline = plan(scene, BEHIND, Some(network.clone()))?;
        let fusion = process(&mut pipeline, scene)?.fusion.unwrap_or_default();
        (row.refused, row.tiles) = (row.refused + fusion.refused, row.tiles + fusion.tiles);
        let after: Scores = scores(scene, &pipeline)?;
        // Every other frame is darker, so that no tile keeps its answer to the one before.
        let mut seconds = f64::INFINITY;
        let darker = scene.darker();
        for frame in [&darker, *scene].into_iter().cycle().take(2 * RUNS) {
            seconds = seconds.min(process(&mut pipeline, frame)?.fusion_time.as_secs_f64());
            iteration = iteration.min(pipeline.shortest_iteration().map_or(f64::INFINITY, |t| t.as_secs_f64()));
        }
        let more = (BEHIND + (seconds / iteration).round() as usize).min(MOST);
        let (longer, _) = solve(scene, more)?;
        let gain = after.s12_psnr - before.s12_psnr;
        row.fusion_ms += 1e3 * seconds;
        row.iterations_at_equal_time += more as f64;
        row.gain_db += gain;
        row.least_gain_db = row.least_gain_db.min(gain);
        row.gain_at_equal_time_db += after.s12_psnr - longer.s12_psnr;
        let errors = [after, before, longer].map(|s| s.aolp_mae_deg);
        let change = |of: f64| if of > 0.0 { errors[0] / of - 1.0 } else { 0.0 };
        row.aolp_by_scene += change(errors[1]);
        row.aolp_by_scene_at_equal_time += change(errors[2]);
        angles.iter_mut().zip(errors).for_each(|(sum, error)| *sum += error);
    }
    let n = judged.len().max(1) as f64;
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
