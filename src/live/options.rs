//! Settings of a run, and failures to start it.

use std::net::SocketAddr;
use std::path::PathBuf;

use crate::board::Board;
use crate::session::RecordOptions;
use stokescope_core::image::Size;

/// Environment variable for the token; unlike the option, other users cannot see it.
pub const TOKEN_VARIABLE: &str = "STOKESCOPE_TOKEN";
/// Most frames whose results are kept in folders of their own.
pub const MAX_KEPT: u64 = 100;
/// Shortest token that is accepted: shorter ones can be guessed.
pub(super) const MIN_TOKEN: usize = 8;

/// Board to run and the settings of the run.
#[derive(Clone, Debug)]
pub struct Options {
    /// Machine and cameras.
    pub board: Board,
    /// Folder of the results.
    pub out: PathBuf,
    /// Frames to process; none runs until told to stop. Each result is kept in a folder of its own if there are at most
    /// [`MAX_KEPT`].
    pub frames: Option<u64>,
    /// Iterations of the solver; none takes the board's.
    pub iterations: Option<usize>,
    /// Address of the preview; none serves no preview.
    pub preview: Option<Preview>,
    /// Settings of recording; none records nothing.
    pub record: Option<RecordOptions>,
    /// Whether recording begins with the first frame, not when a watcher asks for it.
    pub record_at_once: bool,
    /// Whether watchers without a token may change settings. Those with a token always may.
    pub control: bool,
    /// Frame rate that is held by lowering the quality.
    pub target: Target,
    /// Shell command that reads events, one JSON object a line.
    pub on_event: Option<String>,
    /// Whether every frame is processed, in order and however long it takes. Otherwise the newest frame wins.
    pub every: bool,
    /// Folder in which the kernel reports the machine's state: `/sys` except in tests.
    pub sysfs: PathBuf,
}

/// Frame rate that is held by lowering the quality.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Target {
    /// None: the quality that is asked for is kept, however long it takes.
    Off,
    /// Rate of the raw camera.
    Camera,
    /// Frames per second.
    Rate(f64),
}

/// Address that the preview is served at.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Preview {
    /// Address and port; port 0 takes a free one.
    pub listen: SocketAddr,
    /// Secret that clients must send; needed unless the address is a loopback one.
    pub token: Option<String>,
    /// Names of this machine beside its own, such as that of a proxy.
    pub hosts: Vec<String>,
}

impl Options {
    /// Runs `board` until told to stop, with a preview on a free loopback port.
    pub fn new(board: Board, out: PathBuf) -> Self {
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        Self {
            board,
            out,
            frames: None,
            iterations: None,
            preview: Some(Preview { listen, token: None, hosts: Vec::new() }),
            record: None,
            record_at_once: true,
            control: false,
            target: Target::Off,
            on_event: None,
            every: false,
            sysfs: PathBuf::from("/sys"),
        }
    }
}

/// Failure to start the service.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// The address cannot be listened on.
    #[error(
        "preview: cannot listen on {listen}: {source}; is it in use by another instance? choose another with --listen, or --no-preview"
    )]
    Listen {
        /// The address.
        listen: SocketAddr,
        /// Cause.
        source: std::io::Error,
    },
    /// Other machines could reach the preview without a token.
    #[error(
        "preview: {listen} can be reached from other machines, so it needs --token TOKEN of at least {MIN_TOKEN} letters, digits, `-`, `_`, `.` or `~`"
    )]
    Token {
        /// The address.
        listen: SocketAddr,
    },
    /// The bundle belongs to another camera.
    #[error("{}: the bundle is for {channels} channel(s) of {size} pixels, {camera} gives {found_channels} of {found}: use the bundle of this camera", bundle.display())]
    Bundle {
        /// Folder of the bundle.
        bundle: PathBuf,
        /// Channels of the bundle.
        channels: usize,
        /// Size of the bundle.
        size: Size,
        /// Name of the camera.
        camera: String,
        /// Channels of the camera.
        found_channels: usize,
        /// Size of the camera's frames.
        found: Size,
    },
    /// The bundle has counts of another scale than the camera's frames.
    #[error("{}: [sensor] saturation = {saturation}, allowed: {} to {white}, because a full reading of {camera} has {white} counts: calibrate the dark frame again", bundle.display(), white / 2.0)]
    Levels {
        /// Folder of the bundle.
        bundle: PathBuf,
        /// Saturation in the bundle.
        saturation: f32,
        /// Name of the camera.
        camera: String,
        /// Count of a full reading.
        white: f32,
    },
    /// A board asks for a simulated bundle of a camera that is not simulated.
    #[error(
        "board {board}: calibration = \"simulated\", allowed with cameras of the backend sim alone; the raw camera is of {backend}: give the folder of its bundle"
    )]
    NotSimulated {
        /// Name of the board.
        board: String,
        /// Backend of the raw camera.
        backend: String,
    },
    /// The system gives no thread.
    #[error("cannot start the {name} thread: {source}")]
    Thread {
        /// Name of the thread.
        name: &'static str,
        /// Cause.
        source: std::io::Error,
    },
}
