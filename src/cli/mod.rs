//! L4: the command line, one file per command. Results go to stdout, everything else to stderr.

pub mod bench;
pub mod boards;
pub mod evaluate;
pub mod reconstruct;
pub mod simulate;

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
    /// Reconstruct one capture from files.
    Reconstruct(reconstruct::Args),
    /// List the shipped boards.
    Boards,
    /// Simulate a capture: a bundle, a raw frame, a guide and the truth.
    Simulate(simulate::Args),
    /// Judge results against the truth.
    Evaluate(evaluate::Args),
    /// Speed against error: every method over iterations.
    Bench(bench::Args),
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
            Command::Simulate(args) => simulate::run(args, self.json),
            Command::Evaluate(args) => evaluate::run(args, self.json),
            Command::Bench(args) => bench::run(args, self.json),
        }
    }
}
