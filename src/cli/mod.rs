//! L4: the command line, one file per command. Results go to stdout, everything else to stderr.

pub mod bench;
pub mod boards;
pub mod calibrate;
pub mod cameras;
pub mod capture;
pub mod doctor;
pub mod evaluate;
pub mod models;
pub mod plan;
pub mod reconstruct;
pub mod replay;
pub mod run;
pub mod simulate;
mod values;

use clap::{Parser, Subcommand};

use crate::Error;

/// Polarization images from a lensless polarization camera and an ordinary one.
#[derive(Debug, Parser)]
#[command(version, about, disable_help_subcommand = true)]
pub struct Cli {
    /// Print one JSON object on stdout instead of text.
    #[arg(long, global = true)]
    pub json: bool,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Capture, reconstruct and show polarization images, live.
    ///
    /// The newest result always stands in the output folder: angles.npy, stokes.npy, PNG panels and report.json, the first as soon
    /// as there is one, then every two seconds, and the last before the program ends. With --frames N up to 100, every frame is
    /// also kept, in OUT/frame-000000 and so on; with more, or without --frames, only the newest. A disk that is full or read-only
    /// stops neither capture nor preview: saving goes on once it can.
    ///
    /// Without --frames it runs until interrupted (SIGINT, SIGTERM), which is a normal end.
    Run(run::Args),
    /// Play a recorded session through the pipeline again.
    ///
    /// Every complete frame is processed once and in order, with the bundle the session was recorded with, and ends in OUT like the
    /// frames of `run --frames N`. With --live it is shown in its own time instead.
    Replay(replay::Args),
    /// Reconstruct one capture from files.
    Reconstruct(reconstruct::Args),
    /// List the shipped boards.
    Boards,
    /// List cameras and their modes, and the backends this program was built without.
    Cameras,
    /// Capture frames of a board's cameras into files, as they are.
    Capture(capture::Args),
    /// Simulate a capture: a bundle, a raw frame, a guide and the truth.
    Simulate(simulate::Args),
    /// Make or update a device bundle, step by step.
    Calibrate(calibrate::Args),
    /// Judge results against the truth.
    Evaluate(evaluate::Args),
    /// Speed against error: every method over iterations.
    Bench(bench::Args),
    /// Find what keeps a board from running, and what to do about it.
    Doctor(doctor::Args),
    /// Bytes that a board needs, stage by stage, against its limit; refuses like `run` would.
    Plan(plan::Args),
    /// List the fusion models: the shipped ones and those in models/.
    Models,
}

impl Cli {
    /// Runs the command.
    ///
    /// # Errors
    /// Whatever ended it; [`Error::exit_code`] tells the process's exit code.
    pub fn run(&self) -> Result<(), Error> {
        match &self.command {
            Command::Reconstruct(args) => reconstruct::run(args, self.json),
            Command::Boards => boards::run(self.json),
            Command::Cameras => cameras::run(self.json),
            Command::Capture(args) => capture::run(args, self.json),
            Command::Simulate(args) => simulate::run(args, self.json),
            Command::Calibrate(args) => calibrate::run(args, self.json),
            Command::Evaluate(args) => evaluate::run(args, self.json),
            Command::Bench(args) => bench::run(args, self.json),
            Command::Run(args) => run::run(args, self.json),
            Command::Replay(args) => replay::run(args, self.json),
            Command::Doctor(args) => doctor::run(args, self.json),
            Command::Plan(args) => plan::run(args, self.json),
            Command::Models => models::run(self.json),
        }
    }
}

/// `--fusion`: every text is a choice; whether it can be had shows later.
fn parse_fusion(typed: &str) -> Result<crate::model::Choice, std::convert::Infallible> {
    Ok(typed.to_owned().into())
}
