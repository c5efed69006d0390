//! The `stokescope` program: parse, run, exit code.

use std::process::ExitCode;

use clap::Parser;
use stokescope::cli::Cli;
use tracing_subscriber::EnvFilter;

fn main() -> ExitCode {
    bound_heap();
    let filter = EnvFilter::try_from_env("STOKESCOPE_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .without_time()
        .with_target(false)
        .init();
    match Cli::parse().run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            tracing::error!("{e}");
            ExitCode::from(e.exit_code())
        }
    }
}

/// Keeps the memory of the process near what it uses: images that are freed go back to the system at once, and threads share
/// the heap of the others instead of keeping one each.
fn bound_heap() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[allow(unsafe_code, reason = "glibc's settings have no safe interface")]
    // SAFETY: mallopt takes numbers alone, and no other thread runs yet that could allocate meanwhile. What it refuses stays.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 64 << 10);
        libc::mallopt(libc::M_TRIM_THRESHOLD, 128 << 10);
        libc::mallopt(libc::M_ARENA_MAX, 2);
    }
}
