//! The `stokescope` program: parses the command line, runs the command and returns its exit code.

use std::io::Write;
use std::panic::{AssertUnwindSafe, PanicHookInfo, catch_unwind, set_hook};
use std::process::{ExitCode, exit};

use clap::Parser;
use stokescope::cli::Cli;
use stokescope::heap::Checked;
use stokescope::live::LogTail;
use tracing_subscriber::filter::{LevelFilter, Targets};
use tracing_subscriber::fmt::writer::MakeWriterExt;
use tracing_subscriber::prelude::*;

/// Exit code after a defect of this program.
const DEFECT: u8 = 70;

#[global_allocator]
static HEAP: Checked = Checked;

fn main() -> ExitCode {
    set_hook(Box::new(report));
    stokescope::heap::bound();
    stokescope::model::trial::guard();
    let wanted = std::env::var("STOKESCOPE_LOG").unwrap_or_else(|_| "info".to_owned());
    let filter = wanted.parse::<Targets>();
    let invalid = filter.is_err();
    // a log that cannot be written is no reason to end
    let lines = tracing_subscriber::fmt::layer()
        .with_writer((|| LogTail).and(std::io::stderr))
        .without_time()
        .with_target(false)
        .log_internal_errors(false);
    let filter = filter.unwrap_or_else(|_| Targets::new().with_default(LevelFilter::INFO));
    tracing_subscriber::registry().with(lines).with(filter).init();
    if invalid {
        tracing::warn!(
            "STOKESCOPE_LOG = {wanted:?}, allowed: off, error, warn, info, debug, trace, or levels per module: warn,stokescope_core::solve=debug"
        );
    }
    catch_unwind(AssertUnwindSafe(run)).unwrap_or(ExitCode::from(DEFECT))
}

/// Runs the command of the command line.
fn run() -> ExitCode {
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            tracing::error!("{e}");
            ExitCode::from(e.exit_code())
        }
    }
}

/// Reports a defect in one line. Ends the program at once where it is built to abort.
fn report(defect: &PanicHookInfo<'_>) {
    let place = defect.location().map(|place| format!(" at {place}")).unwrap_or_default();
    let what = defect.payload_as_str().unwrap_or("unknown");
    // there is nobody else to tell
    let _ = writeln!(std::io::stderr(), "ERROR a defect of this program, please report it: {what}{place}");
    if cfg!(panic = "abort") {
        exit(i32::from(DEFECT));
    }
}
