//! `stokescope replay`: runs a recorded session through the pipeline again.

use std::net::SocketAddr;
use std::path::PathBuf;

use crate::Error;
use crate::board::{Board, BundleSource, CameraSpec};
use crate::live::{Options, Preview, Target};
use crate::session::Playback;

/// Options of `stokescope replay`.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Folder of a session, or a folder of sessions, of which the newest is replayed.
    #[arg(value_name = "DIR")]
    pub session: PathBuf,
    /// Folder of the results; made if it does not exist.
    #[arg(long, value_name = "DIR", default_value = "out")]
    pub out: PathBuf,
    /// Name of a shipped board, or the file of one, for memory, threads and preview. Its cameras are not used.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// Iterations of the solver [default: as recorded].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1_000_000))]
    pub iterations: Option<u32>,
    /// Replay at the recorded frame rate in a loop with a preview, skipping frames that come too fast; otherwise every frame once,
    /// as fast as possible.
    #[arg(long)]
    pub live: bool,
    /// Address of the preview. Port 0 takes a free one.
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:8080", requires = "live")]
    pub listen: SocketAddr,
    /// Secret that clients of the preview must send.
    #[arg(long, value_name = "TOKEN", requires = "live")]
    pub token: Option<String>,
}

/// Replays a session; prints the summary.
///
/// # Errors
/// The failure to open the session or to replay it.
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
        &Options {
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
