//! `stokescope replay`: processes a recorded session again.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use super::run::{interrupts, serve};
use crate::Error;
use crate::board::{Board, BundleSource, CameraSpec};
use crate::live::{Options, Preview, Target};
use crate::session::{Playback, SessionError};

/// Process a recorded session again.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Session, or a folder of sessions of which the newest is taken.
    #[arg(value_name = "DIR")]
    pub session: PathBuf,
    /// Folder for the results; created if needed.
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Shipped board, or a board file, for memory limit, threads and preview; its cameras are not used.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// Solver iterations [default: as recorded].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Option<u32>,
    /// Show the session at its recorded speed, repeatedly, with a preview [default: process every frame once, as fast as possible].
    #[arg(long)]
    pub live: bool,
    /// Address of the preview; port 0 takes a free port.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080", requires = "live")]
    pub listen: SocketAddr,
    /// Token that clients of the preview must send.
    #[arg(long, value_name = "TOKEN", requires = "live")]
    pub token: Option<String>,
}

/// Replays a session and prints the summary.
///
/// # Errors
/// A session that cannot be replayed, an error of the service, or frames that were left out because they are missing or damaged.
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let playback = Playback::open(&args.session)?;
    let session = playback.session.display();
    tracing::info!("{session}: {} frames", playback.frames);
    if playback.left_out > 0 {
        tracing::warn!("{session}: {} frames were recorded without a guide and are left out", playback.left_out);
    }
    let source = playback.source.display().to_string();
    let camera = CameraSpec::new("replay", source);
    let board = Board {
        guide: playback.guide.then(|| camera.clone()),
        raw: camera,
        calibration: BundleSource::Folder(playback.calibration.clone()),
        register: playback.register,
        // raw and guide frame of a pair have the same time
        max_skew_us: 0,
        ..Board::load(&args.board)?
    };
    let options = Options {
        frames: (!args.live).then_some(playback.frames),
        iterations: Some(args.iterations.map_or(playback.iterations, |n| n as usize)),
        preview: args.live.then(|| Preview { listen: args.listen, token: args.token.clone(), hosts: Vec::new() }),
        target: if args.live { Target::Camera } else { Target::Off },
        every: !args.live,
        ..Options::new(board, args.out.clone())
    };
    let interrupted = interrupts()?;
    let summary = serve(&options, None, &interrupted, json)?;
    let unread = playback.frames.saturating_sub(summary.frames + summary.failed);
    let lost = playback.damaged + if interrupted.load(Ordering::Relaxed) || args.live { 0 } else { unread };
    if lost > 0 {
        let frames = playback.frames + playback.damaged;
        return Err(SessionError::Incomplete { path: playback.session, lost, frames }.into());
    }
    Ok(())
}
