//! The command line, one file per command. Results are printed to stdout, everything else to stderr.

#[macro_use]
mod stdout;

pub mod bench;
pub mod boards;
pub mod calibrate;
pub mod cameras;
pub mod capture;
pub mod doctor;
pub mod evaluate;
pub mod explain;
pub mod export;
mod exposure;
pub mod models;
pub mod plan;
pub mod reconstruct;
pub mod replay;
pub mod run;
pub mod simulate;
pub mod trial;
mod values;

use clap::{Parser, Subcommand};

use crate::Error;

/// Polarization images from a lensless polarization camera and a guide camera.
#[derive(Debug, Parser)]
#[command(version, about, disable_help_subcommand = true)]
pub struct Cli {
    /// Print one JSON object on stdout instead of text.
    #[arg(long, global = true)]
    pub json: bool,
    /// Command to run.
    #[command(subcommand)]
    pub command: Command,
}

/// Commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Capture, reconstruct and show live polarization images.
    ///
    /// The output folder contains the newest result: angles.npy, stokes.npy, PNG panels and report.json. It is written for the first
    /// frame, then every two seconds, and for the last frame before the program ends. With --frames N up to 100, every frame is
    /// also kept, in OUT/frame-000000 and so on. A full or read-only disk stops neither capture nor preview; saving resumes when
    /// the disk accepts files again.
    ///
    /// Without --frames it runs until it is interrupted (SIGINT, SIGTERM), which is a normal end.
    Run(run::Args),
    /// Process a recorded session again.
    ///
    /// Every complete frame is processed once, in order, with the bundle of the recording. Results are written to OUT as by
    /// `run --frames N`. With --live the session is shown at its recorded speed instead.
    Replay(replay::Args),
    /// Export the results of a recorded session as OME-Zarr or OME-TIFF, for napari, ImageJ and Python.
    Export(export::Args),
    /// Reconstruct one capture from files.
    Reconstruct(reconstruct::Args),
    /// List the shipped boards.
    Boards,
    /// List cameras and their modes, and backends that this program was built without.
    Cameras,
    /// Write frames of a board's cameras to files, unprocessed.
    Capture(capture::Args),
    /// Simulate a capture: a bundle, a raw frame, a guide and the truth.
    Simulate(simulate::Args),
    /// Make or update a device bundle in steps.
    Calibrate(calibrate::Args),
    /// Score results against the truth.
    Evaluate(evaluate::Args),
    /// Explain a result in plain sentences and pictures: what was modelled, what the readings say, what to do next.
    Explain(explain::Args),
    /// Measure speed against error of every method.
    Bench(bench::Args),
    /// Check whether a board can run, and name remedies for problems.
    Doctor(doctor::Args),
    /// Predict memory and frame time of a board, stage by stage; fails like `run` if the memory limit is exceeded.
    Plan(plan::Args),
    /// List the shipped fusion models and those in models/.
    Models,
    /// Open a network that is not shipped, within bounds of memory.
    #[command(hide = true)]
    Trial(trial::Args),
}

impl Cli {
    /// Runs the command.
    ///
    /// # Errors
    /// The error that ends the command; [`Error::exit_code`] is the exit code of the process.
    pub fn run(&self) -> Result<(), Error> {
        self.dispatch()?;
        stdout::finish()
    }

    fn dispatch(&self) -> Result<(), Error> {
        match &self.command {
            Command::Reconstruct(args) => reconstruct::run(args, self.json),
            Command::Export(args) => export::run(args, self.json),
            Command::Boards => boards::run(self.json),
            Command::Cameras => cameras::run(self.json),
            Command::Capture(args) => capture::run(args, self.json),
            Command::Simulate(args) => simulate::run(args, self.json),
            Command::Calibrate(args) => calibrate::run(args, self.json),
            Command::Evaluate(args) => evaluate::run(args, self.json),
            Command::Explain(args) => explain::run(args, self.json),
            Command::Bench(args) => bench::run(args, self.json),
            Command::Run(args) => run::run(args, self.json),
            Command::Replay(args) => replay::run(args, self.json),
            Command::Doctor(args) => doctor::run(args, self.json),
            Command::Plan(args) => plan::run(args, self.json),
            Command::Models => models::run(self.json),
            Command::Trial(args) => trial::run(args),
        }
    }
}

/// Parses `--fusion`. Any text is accepted here; an unknown model is an error when it is opened.
fn parse_fusion(typed: &str) -> Result<crate::model::Choice, std::convert::Infallible> {
    Ok(typed.to_owned().into())
}
