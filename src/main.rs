//! The `stokescope` program: parses the command line, runs the command and returns its exit code.

use std::process::ExitCode;

use clap::Parser;
use stokescope::cli::Cli;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

fn main() -> ExitCode {
    stokescope::heap::bound();
    let wanted = std::env::var("STOKESCOPE_LOG").unwrap_or_else(|_| "info".to_owned());
    let filter = wanted.parse::<Targets>();
    let invalid = filter.is_err();
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr).without_time().with_target(false);
    let filter = filter.unwrap_or_else(|_| Targets::new().with_default(LevelFilter::INFO));
    tracing_subscriber::registry().with(lines).with(filter).init();
    if invalid {
        tracing::warn!(
            "STOKESCOPE_LOG = {wanted:?}, allowed: off, error, warn, info, debug, trace, or levels per module: warn,stokescope_core::solve=debug"
        );
    }
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            tracing::error!("{e}");
            ExitCode::from(e.exit_code())
        }
    }
}
