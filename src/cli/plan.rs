//! `stokescope plan`: predicts memory and frame time of a board without running it.

use crate::Error;
use crate::board::{Board, FrameTimes};
use crate::plan::{BinningPlan, Plan};
use stokescope_core::image::Size;

/// Predict memory and frame time of a board, stage by stage.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Shipped board, or a board file.
    #[arg(long, value_name = "NAME|FILE")]
    pub board: String,
    /// Size of the result, for a simulated bundle [default: that of the board's bundle, or 250x250 if it is not on this machine].
    #[arg(long, value_name = "N|WxH", value_parser = size)]
    pub size: Option<Size>,
}

fn size(text: &str) -> Result<Size, String> {
    let (width, height) = text.split_once('x').unwrap_or((text, text));
    match (width.parse(), height.parse()) {
        (Ok(width), Ok(height)) => Ok(Size::new(width, height)),
        _ => Err("allowed: 16 to 2048 pixels, as N or WxH".to_owned()),
    }
}

/// Prints the plan as a table or one JSON object.
///
/// # Errors
/// A board or bundle that is not usable; [`stokescope_core::pipeline::PlanError::Memory`] when the stages exceed the limit.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let board = Board::load(&args.board)?;
    let plan = Plan::new(&board, args.size)?;
    let refusal = plan.refusal();
    if json {
        println!("{}", to_json(&plan));
    } else {
        print_memory(&plan);
        print_times(&plan, &board);
    }
    refusal.map_or(Ok(()), |refusal| Err(refusal.into()))
}

/// The plan as one JSON object.
fn to_json(plan: &Plan) -> serde_json::Value {
    let stages: serde_json::Map<_, _> = plan.stages.iter().map(|(name, b)| ((*name).into(), (*b).into())).collect();
    let times: serde_json::Map<_, _> =
        plan.times.stages.iter().map(|(name, ms)| ((*name).into(), ms.as_slice().into())).collect();
    serde_json::json!({
            "board": plan.board, "size": [plan.size.width, plan.size.height], "channels": plan.channels,
            "bundle": plan.bundle, "stages": stages, "total_bytes": plan.total_bytes(),
            "limit_bytes": plan.limit_bytes, "fits": plan.refusal().is_none(), "planning_bytes": plan.planning_bytes,
            "field_bytes": plan.field_bytes, "field_fits": plan.models_light(), "fusion": plan.selection,
            "binning": plan.binning.map(|b| serde_json::json!({ "frame": [b.frame.width, b.frame.height],
            "crop": [b.crop.width, b.crop.height], "bin": b.bin, "milliseconds": b.milliseconds })),
            "peak_rss_bytes": plan.peak_bytes(), "times": { "measured": plan.times.measured,
            "milliseconds": times, "frames_per_second": plan.times.frames_per_second(),
            "frames_per_second_with_margin": plan.times_with_margin.as_ref().map(FrameTimes::frames_per_second) },
    })
}

/// Prints the memory of every stage.
#[allow(clippy::print_stdout, reason = "output of the command")]
fn print_memory(plan: &Plan) {
    println!("{}: {} pixels, {} channel(s), bundle: {}", plan.board, plan.size, plan.channels, plan.bundle);
    let line = |name: &str, bytes: usize| println!("{name:>12} {:>8.2} MiB", bytes as f64 / f64::from(1 << 20));
    plan.stages.iter().for_each(|(name, bytes)| line(name, *bytes));
    line("together", plan.total_bytes());
    if plan.field_bytes > 0 {
        line("light beyond", plan.field_bytes);
    }
    line("at start", plan.planning_bytes);
    line("peak", plan.peak_bytes());
    line("limit", plan.limit_bytes);
    if !plan.models_light() {
        println!("light from beyond the frame does not fit and will be warned of: smaller frames, or a field stop");
    }
    let model = plan.selection.model.as_deref().unwrap_or("none");
    let precision = plan.selection.precision.map(|precision| format!(", {precision}")).unwrap_or_default();
    println!("fusion model: {model}{precision} ({})", plan.selection.why);
}

/// Prints the times of every stage, and the rates.
#[allow(clippy::print_stdout, reason = "output of the command")]
fn print_times(plan: &Plan, board: &Board) {
    let cpu = board.cpu;
    let how = if plan.times.measured { "measured on the board" } else { "estimated from counted instructions" };
    let (threads, core, clock) = (board.threads, cpu.core.name(), cpu.clock_mhz);
    println!("a frame of a moving scene on {threads} × {core} at {clock} MHz, {} iterations, {how}:", plan.iterations);
    let line = |name: &str, [least, most]: [f64; 2]| println!("{name:>12} {least:>8.1} to {most:.1} ms");
    plan.times.stages.iter().for_each(|(name, ms)| line(name, *ms));
    line("together", plan.times.total_ms());
    let frames = |times: &FrameTimes| {
        let [least, most] = times.frames_per_second();
        println!("{:>12} {least:>8.1} to {most:.1} a second", "frames");
    };
    frames(&plan.times);
    if let Some(times) = &plan.times_with_margin {
        println!("where light comes from beyond the frame:");
        line("together", times.total_ms());
        frames(times);
    }
    if let Some(BinningPlan { frame, crop, bin, milliseconds: [least, most] }) = plan.binning {
        println!(
            "the lensless camera's {frame}, of which {crop} in blocks of {bin} × {bin}, by the thread that captures, estimated:"
        );
        println!("{:>12} {least:>8.1} to {most:.1} ms, {:.0} to {:.0} frames a second", "bin", 1e3 / most, 1e3 / least);
    }
}
