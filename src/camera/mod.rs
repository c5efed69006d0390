//! L2: where frames come from. Every camera, real or not, is a [`Camera`]; what can be opened stands in one list, [`BACKENDS`].
//!
//! A camera lends its [`Frame`]: format, stride and memory are the driver's, and the borrow ends before the next frame can
//! be asked for. Waiting is always bounded: a driver that hangs while it opens or closes a camera is left behind, one that
//! shows the same frame again and again is named. Simulated and replayed cameras of one scene are opened with one
//! [`Clock`], so that frames with equal timestamps show the same instant; real ones have the system's monotonic clock.
//!
//! Real cameras are built in on demand: the features `libcamera` and `v4l2` (see docs/cameras.md).
//!
//! Allocation: `open` allocates; frames of real cameras lie in the driver's memory, the simulator's reuse its buffers,
//! replayed files are read into new memory. Imports: `array`, `board`, `calibration`, `frame`, `plane`.
//!
//! ```
//! use std::time::Duration;
//! use stokescope::camera::{self, Clock, Request, Role};
//! let clock = Clock::default();
//! let request = Request { source: "wedges,size=32,stripes=8".into(), paced: false, ..Request::new(Role::Raw, &clock) };
//! let mut camera = camera::open("sim", &request)?;
//! let frame = camera.next_frame(Duration::from_secs(5))?;
//! assert_eq!((frame.size().width, frame.metadata.sequence), (32, 0));
//! # Ok::<(), stokescope::camera::CameraError>(())
//! ```

mod bounded;
mod clock;
#[cfg(feature = "libcamera")]
mod libcamera;
#[cfg(feature = "v4l2")]
mod mjpeg;
mod replay;
pub mod sim;
#[cfg(feature = "v4l2")]
mod v4l2;
mod watch;

use std::{fmt, path::PathBuf, time::Duration};

pub use clock::Clock;
pub use replay::ReplayCamera;

use self::{bounded::Stalled, sim::SimCamera, watch::Watched};
use crate::board::CameraSpec;
use crate::board::Mode;
use crate::bundle::CameraId;
use crate::files::ArrayError;
use stokescope_core::frame::{Frame, FrameError, PixelFormat, Range, Samples};
use stokescope_core::image::{Size, Stack};

/// Patience with a driver that opens a camera.
const OPENING: Duration = Duration::from_secs(10);
/// After how many frames of the same content a camera with a real sensor counts as stuck, if the board does not say.
const MAX_IDENTICAL: u32 = 10;

/// What every frame of a camera has in common.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Name for messages and logs.
    pub name: String,
    /// Name of the backend that opened it.
    pub backend: &'static str,
    /// Format of its frames.
    pub format: PixelFormat,
    /// Size of its frames in sensor pixels.
    pub size: Size,
    /// Frames per second, when it is paced.
    pub frame_rate: Option<f64>,
}

impl CameraInfo {
    /// What a bundle is tied to.
    pub fn id(&self) -> CameraId {
        CameraId { name: self.name.clone(), format: self.format.to_string(), size: self.size }
    }
}

/// A source of frames.
pub trait Camera: Send {
    /// What its frames have in common.
    fn info(&self) -> &CameraInfo;

    /// Waits for the next frame and lends it.
    ///
    /// # Errors
    /// [`CameraError::Timeout`] when none came in time, [`CameraError::Ended`] after the last one, others when it cannot
    /// be had.
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError>;
}

/// Which camera of the pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Role {
    /// The lensless polarization camera.
    Raw,
    /// The ordinary one.
    Guide,
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Raw => "raw",
            Self::Guide => "guide",
        })
    }
}

/// What to open.
#[derive(Clone, Debug)]
pub struct Request {
    /// What the backend takes for an address: a scene with settings, a folder, a device.
    pub source: String,
    /// Which camera of the pair.
    pub role: Role,
    /// Shared by the cameras of a pair.
    pub clock: Clock,
    /// Frames per second; `None` leaves it to the source.
    pub frame_rate: Option<f64>,
    /// In the source's own time; otherwise as fast as frames are taken.
    pub paced: bool,
    /// Start again after the last frame.
    pub repeat: bool,
    /// Size, format, exposure and gain of a real camera.
    pub mode: Mode,
    /// After how many frames of the same content it counts as stuck; 0 is never, none is the backend's.
    pub max_identical: Option<u32>,
}

impl Request {
    /// A paced, endless camera for `role` on `clock`, from the backend's default source.
    pub fn new(role: Role, clock: &Clock) -> Self {
        let (source, clock) = (String::new(), clock.clone());
        let (mode, max_identical) = (Mode::default(), None);
        Self { source, role, clock, frame_rate: None, paced: true, repeat: true, mode, max_identical }
    }

    /// The camera that a board describes.
    pub fn of(role: Role, spec: &CameraSpec, clock: &Clock) -> Self {
        let source = spec.source.clone();
        let (frame_rate, mode, max_identical) = (spec.frame_rate, spec.mode, spec.max_identical);
        Self { source, frame_rate, paced: spec.paced, mode, max_identical, ..Self::new(role, clock) }
    }
}

/// A camera that could be opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Offer {
    /// What to give as its source.
    pub source: String,
    /// What it is.
    pub description: String,
    /// Its modes; none where the source decides.
    pub modes: Vec<OfferedMode>,
}

/// One format of a camera with its sizes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OfferedMode {
    /// The driver's name.
    pub driver_name: String,
    /// Names in a board file; none for a format that is not supported.
    pub formats: Vec<String>,
    /// Sizes and ranges of sizes.
    pub sizes: Vec<String>,
}

/// One way to open cameras.
#[derive(Debug)]
pub struct Backend {
    /// Name in boards and on the command line.
    pub name: &'static str,
    /// What it is, and what its sources look like.
    pub description: &'static str,
    /// Whether it can work on this machine; the reason when not.
    pub available: fn() -> Result<(), String>,
    /// What it could open.
    pub list: fn() -> Result<Vec<Offer>, CameraError>,
    /// Opens one.
    pub open: fn(&Request) -> Result<Box<dyn Camera>, CameraError>,
    /// Whether there is a driver and a sensor behind it: it takes modes, its frames never repeat, and it can hang.
    pub live: bool,
}

/// Every backend there is, also those that this program was built without.
pub const BACKENDS: &[Backend] = &[
    Backend {
        name: "sim",
        description: "simulated cameras; source: SCENE[,key=value…] or a folder of angle images",
        available: || Ok(()),
        list: || {
            let offer = |&(name, text): &(&str, &str)| Offer {
                source: name.to_owned(),
                description: text.to_owned(),
                modes: Vec::new(),
            };
            Ok(sim::SCENES.iter().map(offer).collect())
        },
        open: |request| Ok(Box::new(SimCamera::open(request)?)),
        live: false,
    },
    Backend {
        name: "replay",
        description: "recorded frames; source: an NPY, PNG or TIFF file, a folder of them, or a folder with raw and guide",
        available: || Ok(()),
        list: || Ok(Vec::new()),
        open: |request| Ok(Box::new(ReplayCamera::open(request)?)),
        live: false,
    },
    LIBCAMERA,
    V4L2,
];

const LIBCAMERA: Backend = Backend {
    name: "libcamera",
    description: "cameras of libcamera; source: a camera's id, or a part of it that no other has",
    #[cfg(feature = "libcamera")]
    available: || Ok(()),
    #[cfg(feature = "libcamera")]
    list: libcamera::list,
    #[cfg(feature = "libcamera")]
    open: libcamera::open,
    #[cfg(not(feature = "libcamera"))]
    available: || Err("this program was built without it: cargo build --features libcamera".to_owned()),
    #[cfg(not(feature = "libcamera"))]
    list: || Ok(Vec::new()),
    #[cfg(not(feature = "libcamera"))]
    open: |_| Err(not_built("libcamera")),
    live: true,
};

const V4L2: Backend = Backend {
    name: "v4l2",
    description: "cameras of Video4Linux; source: a device, such as /dev/video0",
    #[cfg(feature = "v4l2")]
    available: || Ok(()),
    #[cfg(feature = "v4l2")]
    list: v4l2::list,
    #[cfg(feature = "v4l2")]
    open: v4l2::open,
    #[cfg(not(feature = "v4l2"))]
    available: || Err("this program was built without it: cargo build --features v4l2".to_owned()),
    #[cfg(not(feature = "v4l2"))]
    list: || Ok(Vec::new()),
    #[cfg(not(feature = "v4l2"))]
    open: |_| Err(not_built("v4l2")),
    live: true,
};

#[cfg(not(all(feature = "libcamera", feature = "v4l2")))]
fn not_built(name: &str) -> CameraError {
    CameraError::Backend { name: name.to_owned(), reason: "this program was built without it".to_owned() }
}

/// Opens a camera of the backend called `name`, and watches it.
///
/// # Errors
/// [`CameraError::Backend`] when there is none, it cannot work here or takes no mode, [`CameraError::Hung`] when its driver
/// does not answer, others as the backend says.
pub fn open(name: &str, request: &Request) -> Result<Box<dyn Camera>, CameraError> {
    let refuse = |reason| CameraError::Backend { name: name.to_owned(), reason };
    let backend = BACKENDS.iter().find(|backend| backend.name == name).ok_or_else(|| {
        let names: Vec<_> = BACKENDS.iter().map(|backend| backend.name).collect();
        refuse(format!("allowed: {}", names.join(", ")))
    })?;
    (backend.available)().map_err(refuse)?;
    let address = format!("{name} {}", request.source);
    if backend.live && !request.paced {
        return Err(refuse(
            "a real camera has its own time: paced = false is for simulated and replayed ones".to_owned(),
        ));
    }
    let camera = if backend.live {
        let (opening, wanted) = (backend.open, request.clone());
        bounded::within(&address, OPENING, move || opening(&wanted)).map_err(|stalled| {
            let what = match stalled {
                Stalled::Late => "does not open it in time",
                Stalled::Still => "still hangs from before",
                Stalled::Failed => "interface failed",
            };
            CameraError::Hung { camera: address.clone(), what }
        })??
    } else if request.mode == Mode::default() {
        (backend.open)(request)?
    } else {
        let keys = "width, height, format, exposure_us, gain or sync";
        return Err(refuse(format!("its source decides what frames are like, so it takes no {keys}")));
    };
    let max_identical = request.max_identical.or_else(|| backend.live.then_some(MAX_IDENTICAL));
    Ok(Box::new(Watched::new(camera, address, max_identical, backend.live)))
}

/// The format a camera is set to when none was asked for: for the lensless camera the deepest raw one, for the guide one that
/// needs no demosaicing. Unpacked samples come before packed ones: they cost bandwidth but no arithmetic.
#[cfg_attr(not(any(feature = "libcamera", feature = "v4l2")), allow(dead_code, reason = "for real cameras"))]
fn preferred(role: Role, offered: impl IntoIterator<Item = PixelFormat>) -> Option<PixelFormat> {
    let worth = |format: &PixelFormat| {
        let samples = match format {
            PixelFormat::Mono(samples) | PixelFormat::Bayer(_, samples) => Some(*samples),
            PixelFormat::Rgb(_) | PixelFormat::Nv12Luma | PixelFormat::Nv12Rgb | PixelFormat::Yuyv(_) => None,
        };
        let suits = samples.is_some() == (role == Role::Raw);
        let packed = samples.is_some_and(Samples::is_packed);
        // the colours of an NV12 frame go with its luma; USB cameras leave the ends of the range out unless they say otherwise
        let second = [PixelFormat::Nv12Luma, PixelFormat::Yuyv(Range::Full)].contains(format);
        (suits, format.bits(), !packed, !second)
    };
    offered.into_iter().max_by_key(worth)
}

/// Why there is no camera, or no frame.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// There is no such backend, or it cannot work here.
    #[error("camera backend `{name}` is not available: {reason}")]
    Backend {
        /// Its name.
        name: String,
        /// Why, or which there are.
        reason: String,
    },
    /// The simulator refuses its settings.
    #[error(transparent)]
    Sim(#[from] sim::SimError),
    /// A recorded frame cannot be read.
    #[error(transparent)]
    Array(Box<ArrayError>),
    /// Nothing to replay.
    #[error("{}: {what}", path.display())]
    Source {
        /// File or folder.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// A recorded frame differs from the first one.
    #[error("{}: {found_format} of {found_size}, the recording began with {format} of {size}", path.display())]
    Changed {
        /// The file.
        path: PathBuf,
        /// Format of the recording.
        format: PixelFormat,
        /// Size of the recording.
        size: Size,
        /// Format found.
        found_format: PixelFormat,
        /// Size found.
        found_size: Size,
    },
    /// The bytes do not fit their layout.
    #[error("{camera}: {source}")]
    Frame {
        /// Name of the camera.
        camera: String,
        /// What does not fit.
        source: FrameError,
    },
    /// It is there but cannot be opened.
    #[error("{camera}: {reason}")]
    Unavailable {
        /// Name of the camera.
        camera: String,
        /// Why, and what helps.
        reason: String,
    },
    /// It has no such mode.
    #[error("{camera}: cannot give {asked}; it offers {offered}")]
    Mode {
        /// Name of the camera.
        camera: String,
        /// What was asked for.
        asked: String,
        /// What there is.
        offered: String,
    },
    /// A control that was asked for is missing or out of range.
    #[error("{camera}: {control} = {asked}, {allowed}")]
    Control {
        /// Name of the camera.
        camera: String,
        /// The board's key.
        control: &'static str,
        /// Value asked for.
        asked: String,
        /// What the camera can do.
        allowed: String,
    },
    /// A frame that the driver itself marks as broken, or one that is too short. The next one may be whole.
    #[error("{camera}: frame {sequence} is damaged: {what}")]
    Damaged {
        /// Name of the camera.
        camera: String,
        /// Number of the frame.
        sequence: u64,
        /// What the driver says.
        what: String,
    },
    /// It goes on showing what it showed before.
    #[error("{camera}: stuck, {frames} {what}")]
    Stuck {
        /// Name of the camera.
        camera: String,
        /// In what way.
        what: &'static str,
        /// Number of frames in a row.
        frames: u64,
    },
    /// It disappeared, or its driver gave up.
    #[error("{camera}: lost: {reason}")]
    Lost {
        /// Name of the camera.
        camera: String,
        /// What the driver says.
        reason: String,
    },
    /// Its driver does not answer.
    #[error("{camera}: the driver {what}")]
    Hung {
        /// Backend and source of the camera.
        camera: String,
        /// What it does not do.
        what: &'static str,
    },
    /// No frame in time.
    #[error("{camera}: no frame within {} ms", after.as_millis())]
    Timeout {
        /// Name of the camera.
        camera: String,
        /// How long was waited.
        after: Duration,
    },
    /// All frames were shown.
    #[error("{camera}: ended after {frames} frames")]
    Ended {
        /// Name of the camera.
        camera: String,
        /// Number of frames shown.
        frames: u64,
    },
}

impl CameraError {
    /// Whether only this one frame is lost and the camera goes on.
    pub fn is_passing(&self) -> bool {
        matches!(self, Self::Frame { .. } | Self::Damaged { .. })
    }
}

impl From<ArrayError> for CameraError {
    fn from(e: ArrayError) -> Self {
        Self::Array(Box::new(e))
    }
}

/// Lays planes out as a camera does, pixel by pixel, in `bytes`.
fn interleave<T: Copy, const N: usize>(planes: &Stack<T>, bytes: &mut Vec<u8>, encode: impl Fn(T) -> [u8; N]) {
    let pixels = planes.size().pixels();
    let values = planes.as_slice();
    bytes.clear();
    bytes.reserve_exact(values.len() * N);
    for i in 0..pixels {
        for k in 0..planes.count() {
            bytes.extend(encode(values[k * pixels + i]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_backend_names_the_known_ones() {
        let e = open("usb", &Request::new(Role::Raw, &Clock::default())).err().unwrap();
        assert_eq!(e.to_string(), "camera backend `usb` is not available: allowed: sim, replay, libcamera, v4l2");
    }

    #[test]
    fn a_source_that_decides_by_itself_takes_no_mode() {
        let mode = Mode { gain: Some(2.0), ..Mode::default() };
        let e = open("sim", &Request { mode, ..Request::new(Role::Raw, &Clock::default()) }).err().unwrap();
        assert!(e.to_string().ends_with("takes no width, height, format, exposure_us, gain or sync"), "{e}");
    }

    #[test]
    fn a_camera_that_repeats_itself_is_stuck_if_the_board_says_so() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("raw.npy");
        crate::files::write_npy(&file, &[1, 2], &[0.25, 0.5]).unwrap();
        let clock = Clock::default();
        let request = Request { source: file.display().to_string(), paced: false, ..Request::new(Role::Raw, &clock) };
        let long = Duration::from_secs(5);
        let mut free = open("replay", &request).unwrap();
        assert!((0..30).all(|_| free.next_frame(long).is_ok()));
        drop(free);
        let mut watched = open("replay", &Request { max_identical: Some(3), ..request }).unwrap();
        assert!((0..2).all(|_| watched.next_frame(long).is_ok()));
        assert!(matches!(watched.next_frame(long), Err(CameraError::Stuck { frames: 3, .. })));
    }

    #[test]
    fn left_to_itself_the_raw_camera_gives_raw_frames_and_the_guide_colours() {
        let formats = ["nv12-luma", "nv12", "mono8", "mono10p", "mono10"].map(|name| name.parse().unwrap());
        let name = |role, formats: &[PixelFormat]| preferred(role, formats.iter().copied()).unwrap().name();
        assert_eq!(name(Role::Raw, &formats), "mono10");
        assert_eq!(name(Role::Raw, &formats[..4]), "mono10p");
        assert_eq!(name(Role::Guide, &formats), "nv12");
        assert_eq!(name(Role::Guide, &formats[2..]), "mono10");
        let formats = ["mono8", "yuyv", "yuyv-full"].map(|name| name.parse().unwrap());
        assert_eq!(name(Role::Guide, &formats), "yuyv");
    }

    #[cfg(not(feature = "v4l2"))]
    #[test]
    fn a_backend_that_is_not_built_in_says_how_it_would_be() {
        let e = open("v4l2", &Request::new(Role::Raw, &Clock::default())).err().unwrap().to_string();
        assert!(e.ends_with("cargo build --features v4l2"), "{e}");
    }

    #[test]
    fn every_listed_source_opens() {
        for offer in (BACKENDS[0].list)().unwrap() {
            let source = format!("{},size=24,stripes=4", offer.source);
            let request = Request { source, ..Request::new(Role::Guide, &Clock::default()) };
            assert_eq!(open("sim", &request).unwrap().info().size, Size::new(24, 24));
        }
    }
}
