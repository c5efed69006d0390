//! `stokescope replay`: a recorded session once more, through the pipeline of today.

use std::net::SocketAddr;
use std::path::PathBuf;

use crate::Error;
use crate::board::{Board, BundleSource, CameraSpec};
use crate::service::{Options, Playback, Preview, Target};

/// What to replay, and how.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Session, or the folder of sessions whose newest is taken.
    #[arg(value_name = "DIR")]
    pub session: PathBuf,
    /// Folder of the results; made if need be.
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Shipped board, or the file of one: memory, threads and preview; its cameras rest.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// Iterations of the solver [default: as recorded].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Option<u32>,
    /// Replay in the recording's own time, again and again, the newest frame first, with a preview; else every frame once and as
    /// fast as it goes.
    #[arg(long)]
    pub live: bool,
    /// Address of the preview. Port 0 takes a free one.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080", requires = "live")]
    pub listen: SocketAddr,
    /// What clients of the preview must know.
    #[arg(long, value_name = "TOKEN", requires = "live")]
    pub token: Option<String>,
}

/// Replays a session; prints the summary.
///
/// # Errors
/// What keeps the session from being replayed.
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let playback = Playback::open(&args.session)?;
    let session = playback.session.display();
    tracing::info!("{session}: {} frames, {} without a guide left out", playback.frames, playback.left_out);
    let source = playback.source.display().to_string();
    let camera = CameraSpec::new("replay", source);
    let board = Board {
        guide: playback.guide.then(|| camera.clone()),
        raw: camera,
        calibration: BundleSource::Folder(playback.calibration.clone()),
        register: playback.register,
        ..Board::load(&args.board)?
    };
    super::run::serve(
        Options {
            frames: (!args.live).then_some(playback.frames),
            iterations: Some(args.iterations.map_or(playback.iterations, |n| n as usize)),
            preview: args.live.then(|| Preview { listen: args.listen, token: args.token.clone() }),
            target: if args.live { Target::Camera } else { Target::Off },
            every: !args.live,
            ..Options::new(board, args.out.clone())
        },
        json,
    )
}
