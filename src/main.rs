//! The `stokescope` program: parse, run, exit code.

use std::process::ExitCode;

use clap::Parser;
use stokescope::cli::Cli;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::prelude::*;

fn main() -> ExitCode {
    stokescope::heap::bound();
    let wanted = std::env::var("STOKESCOPE_LOG").ok().map(|text| (text.parse::<Targets>(), text));
    let info = || Targets::new().with_default(LevelFilter::INFO);
    let (filter, mistake) = match wanted {
        Some((Ok(filter), _)) => (filter, None),
        Some((Err(_), text)) => (info(), Some(text)),
        None => (info(), None),
    };
    let lines = tracing_subscriber::fmt::layer().with_writer(std::io::stderr).without_time().with_target(false);
    tracing_subscriber::registry().with(lines).with(filter).init();
    if let Some(text) = mistake {
        tracing::warn!(
            "STOKESCOPE_LOG = {text:?}, allowed: off, error, warn, info, debug, trace, or such for modules: warn,stokescope::recon=debug"
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
