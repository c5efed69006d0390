//! Cameras: real, simulated and replayed ones share the trait [`Camera`], and [`BACKENDS`] lists the ways to open one.
//!
//! A camera lends its [`Frame`] until the next one is requested; format, stride and memory are the driver's. Every wait has a time
//! limit: a driver that hangs while it opens or closes a camera is abandoned, and a camera that repeats the same frame is an error.
//! Simulated and replayed cameras of one scene share a [`Clock`], so that frames with equal time stamps show the same instant. Time
//! stamps of real cameras are on the system's monotonic clock.
//!
//! The backends `libcamera`, `v4l2` and `genicam` are cargo features (see docs/cameras.md).
//!
//! Allocation: `open` allocates. Frames of real cameras lie in the driver's memory, the simulator reuses its buffers, and replayed
//! files are read into new memory.
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
#[cfg(feature = "genicam")]
mod genicam;
#[cfg(any(test, feature = "libcamera"))]
mod libcamera;
#[cfg(feature = "v4l2")]
mod mjpeg;
mod replay;
pub mod sim;
mod timing;
#[cfg(feature = "v4l2")]
mod v4l2;
mod watch;

use std::{fmt, path::PathBuf, time::Duration};

pub use clock::Clock;
pub use replay::ReplayCamera;

use self::{bounded::CallError, sim::SimCamera, timing::Exposure, watch::WatchedCamera};
use crate::board::{CameraSpec, Mode, Stamp, Timing};
use crate::bundle::CameraId;
use crate::files::ArrayError;
use stokescope_core::frame::{Frame, FrameError, PixelFormat, Range, Samples};
use stokescope_core::image::{Size, Stack};

/// Time limit for a driver to open a camera.
const OPEN_LIMIT: Duration = Duration::from_secs(10);
/// Default number of identical frames in a row after which a real camera counts as stuck.
const MAX_IDENTICAL: u32 = 10;

/// Properties that all frames of a camera share.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Name of the camera.
    pub name: String,
    /// Name of the backend that opened it.
    pub backend: &'static str,
    /// Pixel format of the frames.
    pub format: PixelFormat,
    /// Size of the frames in sensor pixels.
    pub size: Size,
    /// Frames per second; `None` if unknown or not paced.
    pub frame_rate: Option<f64>,
    /// Black level and white of a raw stream, if the backend knows them.
    pub levels: Option<Levels>,
    /// Time from the read-out of the first row to that of the last one, if the backend knows it.
    pub readout: Option<Duration>,
    /// Ranges of its settings, as far as the backend knows them.
    pub limits: Limits,
}

/// Ranges of the settings that a camera takes, both ends included; none of what it does not take, or the backend does not know.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Limits {
    /// Exposure time in microseconds, at the frame rate that the camera has.
    pub exposure_us: Option<[f64; 2]>,
    /// Gain, in the units of the board file.
    pub gain: Option<[f64; 2]>,
    /// Frames per second.
    pub frame_rate: Option<[f64; 2]>,
}

impl CameraInfo {
    /// Identity that a bundle is tied to; none of a replayed camera, whose frames may come from any camera.
    pub fn id(&self) -> Option<CameraId> {
        let id = || CameraId { name: self.name.clone(), format: self.format.to_string(), size: self.size };
        (self.backend != "replay").then(id)
    }
}

/// Counts at both ends of the range of a sensor, on the scale of the delivered frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Levels {
    /// Count without light, if known.
    pub black: Option<f32>,
    /// Count of a full reading; larger counts do not occur.
    pub white: f32,
}

/// A source of frames.
pub trait Camera: Send {
    /// Properties of the frames.
    fn info(&self) -> &CameraInfo;

    /// Waits for the next frame and lends it.
    ///
    /// # Errors
    /// [`CameraError::Timeout`] without a frame within `timeout`, [`CameraError::Ended`] after the last frame of a recording, others
    /// when the camera fails.
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError>;
}

/// Role of a camera in the pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Role {
    /// Lensless polarization camera.
    Raw,
    /// Guide camera: an ordinary camera with a lens.
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

/// Request to open a camera.
#[derive(Clone, Debug)]
pub struct Request {
    /// Address of the camera within its backend: a scene with settings, a folder or a device.
    pub source: String,
    /// Role of the camera.
    pub role: Role,
    /// Clock shared by the cameras of a pair.
    pub clock: Clock,
    /// Frames per second; the camera decides when `None`.
    pub frame_rate: Option<f64>,
    /// Whether frames arrive at the frame rate; if not, they arrive as fast as they are taken.
    pub paced: bool,
    /// Whether a recording starts again after its last frame.
    pub repeat: bool,
    /// Whether a simulated camera renders a clip ahead and shows it to and fro ([`sim::SimSpec::clip`]), instead of a scene that goes on and
    /// costs as much as a solver.
    pub clip: bool,
    /// Requested size, format, exposure and gain of a real camera.
    pub mode: Mode,
    /// When it exposes, and what its time stamps mean.
    pub timing: Timing,
    /// Rotation of the picture in degrees, 0 or 180, made in the sensor. `None` leaves the driver's default, which
    /// turns a sensor that is mounted upside down.
    pub orientation: Option<u32>,
    /// Number of identical frames in a row after which the camera counts as stuck: 0 is never, `None` the backend's default.
    pub max_identical: Option<u32>,
}

impl Request {
    /// Request for a paced, repeating camera of `role` on `clock`, from the backend's default source.
    pub fn new(role: Role, clock: &Clock) -> Self {
        let (source, clock) = (String::new(), clock.clone());
        let (frame_rate, mode, timing) = (None, Mode::default(), Timing::default());
        Self {
            source,
            role,
            clock,
            frame_rate,
            paced: true,
            repeat: true,
            clip: false,
            mode,
            timing,
            orientation: None,
            max_identical: None,
        }
    }

    /// Request for the camera that a board describes. `orientation` is that of the bundle: the lensless camera is turned so, because its
    /// calibration is true for no other. The guide camera keeps the driver's.
    pub fn of(role: Role, spec: &CameraSpec, clock: &Clock, orientation: Option<u32>) -> Self {
        let orientation = orientation.filter(|_| role == Role::Raw);
        let source = spec.source.clone();
        let CameraSpec { frame_rate, mode, timing, max_identical, paced, .. } = *spec;
        Self { source, frame_rate, paced, mode, timing, max_identical, orientation, ..Self::new(role, clock) }
    }
}

/// A camera that can be opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AvailableCamera {
    /// Source to request it by.
    pub source: String,
    /// Description, such as the model.
    pub description: String,
    /// Modes; empty where the source decides.
    pub modes: Vec<AvailableMode>,
}

/// A format of a camera with its sizes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AvailableMode {
    /// Name of the format in the driver.
    pub driver_name: String,
    /// Names of the format in board files; empty if it is not supported.
    pub formats: Vec<String>,
    /// Bit depth of the sensor's mode, where it is chosen apart from the format.
    pub bits: Option<u32>,
    /// Sizes or ranges of sizes.
    pub sizes: Vec<String>,
}

/// A kind of camera and how to open it.
#[derive(Debug)]
pub struct Backend {
    /// Name in board files.
    pub name: &'static str,
    /// Description of the backend and of its sources.
    pub description: &'static str,
    /// Checks whether the backend works on this machine; the error is the reason why not.
    pub available: fn() -> Result<(), String>,
    /// Lists the cameras that can be opened.
    pub list: fn() -> Result<Vec<AvailableCamera>, CameraError>,
    /// Opens a camera.
    pub open: fn(&Request) -> Result<Box<dyn Camera>, CameraError>,
    /// Whether cameras are real: they take modes, their frames never repeat, and their drivers can hang.
    pub live: bool,
    /// Whether cameras take an exposure time and a gain.
    pub exposes: bool,
    /// Instant that its time stamps name; `None` for frames stamped with the middle of their exposure.
    pub stamp: Option<Stamp>,
}

/// All backends, including those that this program was built without.
pub const BACKENDS: &[Backend] = &[
    Backend {
        name: "sim",
        description: "simulated cameras; source: SCENE[,key=value…] or a folder of angle images",
        available: || Ok(()),
        list: || {
            let scene = |&(name, text): &(&str, &str)| AvailableCamera {
                source: name.to_owned(),
                description: text.to_owned(),
                modes: Vec::new(),
            };
            Ok(sim::SCENES.iter().map(scene).collect())
        },
        open: |request| Ok(Box::new(SimCamera::open(request)?)),
        live: false,
        exposes: true,
        stamp: None,
    },
    Backend {
        name: "replay",
        description: "recorded frames; source: an NPY, PNG or TIFF file, a folder of them, or a folder with raw and guide",
        available: || Ok(()),
        list: || Ok(Vec::new()),
        open: |request| Ok(Box::new(ReplayCamera::open(request)?)),
        live: false,
        exposes: false,
        stamp: None,
    },
    LIBCAMERA,
    V4L2,
    GENICAM,
];

const LIBCAMERA: Backend = Backend {
    name: "libcamera",
    description: "cameras of libcamera; source: the place, sensor or id of a camera",
    #[cfg(feature = "libcamera")]
    available: || Ok(()),
    #[cfg(feature = "libcamera")]
    list: libcamera::list,
    #[cfg(feature = "libcamera")]
    open: libcamera::open,
    #[cfg(not(feature = "libcamera"))]
    available: || Err("this program was built without it; build with cargo build --features libcamera".to_owned()),
    #[cfg(not(feature = "libcamera"))]
    list: || Ok(Vec::new()),
    #[cfg(not(feature = "libcamera"))]
    open: |_| Err(not_built("libcamera")),
    live: true,
    exposes: true,
    // drivers stamp the start of the read-out, or the first data
    stamp: Some(Stamp::ExposureEnd),
};

const V4L2: Backend = Backend {
    name: "v4l2",
    description: "cameras of Video4Linux; source: a device such as /dev/video0",
    #[cfg(feature = "v4l2")]
    available: || Ok(()),
    #[cfg(feature = "v4l2")]
    list: v4l2::list,
    #[cfg(feature = "v4l2")]
    open: v4l2::open,
    #[cfg(not(feature = "v4l2"))]
    available: || Err("this program was built without it; build with cargo build --features v4l2".to_owned()),
    #[cfg(not(feature = "v4l2"))]
    list: || Ok(Vec::new()),
    #[cfg(not(feature = "v4l2"))]
    open: |_| Err(not_built("v4l2")),
    live: true,
    exposes: true,
    // drivers stamp the start of the read-out, or the first data
    stamp: Some(Stamp::ExposureEnd),
};

const GENICAM: Backend = Backend {
    name: "genicam",
    description: "GigE Vision and USB3 Vision cameras; source: ID[,bin=N,offset=XxY,trigger=INPUT]",
    #[cfg(feature = "genicam")]
    available: || Ok(()),
    #[cfg(feature = "genicam")]
    list: genicam::list,
    #[cfg(feature = "genicam")]
    open: genicam::open,
    #[cfg(not(feature = "genicam"))]
    available: || Err("this program was built without it; build with cargo build --features genicam".to_owned()),
    #[cfg(not(feature = "genicam"))]
    list: || Ok(Vec::new()),
    #[cfg(not(feature = "genicam"))]
    open: |_| Err(not_built("genicam")),
    live: true,
    exposes: true,
    stamp: Some(Stamp::Arrival),
};

#[cfg(not(all(feature = "libcamera", feature = "v4l2", feature = "genicam")))]
fn not_built(name: &str) -> CameraError {
    CameraError::Backend { name: name.to_owned(), reason: "this program was built without it".to_owned() }
}

/// Opens a camera of the backend `name`; the returned camera also detects frames that repeat.
///
/// # Errors
/// [`CameraError::Backend`] when there is no such backend, it does not work here or takes no mode; [`CameraError::Hung`] when the
/// driver does not respond; others from the backend.
pub fn open(name: &str, request: &Request) -> Result<Box<dyn Camera>, CameraError> {
    let refuse = |reason| CameraError::Backend { name: name.to_owned(), reason };
    let backend = BACKENDS.iter().find(|backend| backend.name == name).ok_or_else(|| {
        let names: Vec<_> = BACKENDS.iter().map(|backend| backend.name).collect();
        refuse(format!("allowed: {}", names.join(", ")))
    })?;
    (backend.available)().map_err(refuse)?;
    let address = format!("{name} {}", request.source);
    if backend.live && !request.paced {
        return Err(refuse("paced = false is allowed for simulated and replayed cameras only".to_owned()));
    }
    let camera = if backend.live {
        let (opening, wanted) = (backend.open, request.clone());
        bounded::within(&address, OPEN_LIMIT, move || opening(&wanted)).map_err(|e| {
            let what = match e {
                CallError::TimedOut => "does not open it in time",
                CallError::Busy => "still hangs in an earlier call",
                CallError::Failed => "call failed",
            };
            CameraError::Hung { camera: address.clone(), what }
        })??
    } else if takes(backend, request) {
        (backend.open)(request)?
    } else {
        let settings = if backend.exposes { "" } else { "exposure_us, gain, " };
        let keys = format!("width, height, format, bits, {settings}sync, trigger, clock or readout_us");
        return Err(refuse(format!("its source determines the frames; it takes no {keys}")));
    };
    let max_identical = request.max_identical.or_else(|| backend.live.then_some(MAX_IDENTICAL));
    let exposure = Exposure::new(backend.stamp, camera.info().readout, &request.timing, request.mode.exposure_us);
    let watched = WatchedCamera::new(camera, address, max_identical, backend.live);
    Ok(Box::new(watched.timed(exposure, request.timing.triggered)))
}

/// Whether the cameras of a backend that are not real take the mode and the timing that are asked for.
fn takes(backend: &Backend, request: &Request) -> bool {
    let Mode { exposure_us, gain, .. } = request.mode;
    let settings = if backend.exposes { Mode { exposure_us, gain, ..Mode::default() } } else { Mode::default() };
    request.mode == settings && request.timing == Timing::default()
}

/// Default format of a camera: the deepest raw format for the lensless camera, a format without mosaic for the guide camera. Unpacked
/// samples are preferred to packed ones; they take bandwidth but no arithmetic.
#[cfg_attr(
    not(any(feature = "libcamera", feature = "v4l2", feature = "genicam")),
    allow(dead_code, reason = "for real cameras")
)]
fn preferred(role: Role, offered: impl IntoIterator<Item = PixelFormat>) -> Option<PixelFormat> {
    let rank = |format: &PixelFormat| {
        let samples = match format {
            PixelFormat::Mono(samples) | PixelFormat::Bayer(_, samples) => Some(*samples),
            PixelFormat::Rgb(_) | PixelFormat::Nv12Luma | PixelFormat::Nv12Rgb | PixelFormat::Yuyv(_) => None,
        };
        let suits = samples.is_some() == (role == Role::Raw);
        let packed = samples.is_some_and(Samples::is_packed);
        // NV12 with colour comes before its luma alone, and limited range is usual for USB cameras
        let unusual = [PixelFormat::Nv12Luma, PixelFormat::Yuyv(Range::Full)].contains(format);
        (suits, format.bits(), !packed, !unusual)
    };
    offered.into_iter().max_by_key(rank)
}

/// Reason why a camera cannot be opened or has no frame.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// The backend does not exist or does not work here.
    #[error("camera backend `{name}` is not available: {reason}")]
    Backend {
        /// Name of the backend.
        name: String,
        /// Reason, or the names of the backends.
        reason: String,
    },
    /// The settings of a simulated camera are not valid.
    #[error(transparent)]
    Sim(#[from] sim::SimError),
    /// A recorded frame cannot be read.
    #[error(transparent)]
    Array(Box<ArrayError>),
    /// There is nothing to replay.
    #[error("{}: {what}", path.display())]
    Source {
        /// File or folder.
        path: PathBuf,
        /// Problem found.
        what: String,
    },
    /// Times of recorded frames that are not valid.
    #[error("{}: {what}", path.display())]
    Times {
        /// The file.
        path: PathBuf,
        /// Problem found.
        what: String,
    },
    /// A recorded frame differs in format or size from the first one.
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
    /// The bytes of a frame do not match its layout.
    #[error("{camera}: {source}")]
    Frame {
        /// Name of the camera.
        camera: String,
        /// Mismatch found.
        source: FrameError,
    },
    /// The camera cannot be opened.
    #[error("{camera}: {reason}")]
    Unavailable {
        /// Name of the camera.
        camera: String,
        /// Reason and remedy.
        reason: String,
    },
    /// The camera does not have the requested mode.
    #[error("{camera}: does not support {asked}; allowed: {offered}")]
    Mode {
        /// Name of the camera.
        camera: String,
        /// Requested mode.
        asked: String,
        /// Available modes.
        offered: String,
    },
    /// The raw stream would lose readings or differ from what the board file and the bundle say.
    #[error("{camera}: {reason}")]
    Stream {
        /// Name of the camera.
        camera: String,
        /// Difference and remedy.
        reason: String,
    },
    /// A requested control does not exist or its value is out of range.
    #[error("{camera}: {control} = {asked}, {allowed}")]
    Control {
        /// Name of the camera.
        camera: String,
        /// Key in the board file.
        control: &'static str,
        /// Requested value.
        asked: String,
        /// Allowed values.
        allowed: String,
    },
    /// The driver marks a frame as broken, or it is truncated. The next one may be good.
    #[error("{camera}: frame {sequence} is damaged: {what}")]
    Damaged {
        /// Name of the camera.
        camera: String,
        /// Sequence number of the frame.
        sequence: u64,
        /// Description of the damage.
        what: String,
    },
    /// The camera repeats the same frame.
    #[error("{camera}: stuck, {frames} {what}")]
    Stuck {
        /// Name of the camera.
        camera: String,
        /// Kind of repetition.
        what: &'static str,
        /// Number of frames in a row.
        frames: u64,
    },
    /// The camera was disconnected, or its driver failed.
    #[error("{camera}: lost: {reason}")]
    Lost {
        /// Name of the camera.
        camera: String,
        /// Message of the driver.
        reason: String,
    },
    /// The driver does not respond.
    #[error("{camera}: the driver {what}")]
    Hung {
        /// Backend and source of the camera.
        camera: String,
        /// Call that hangs.
        what: &'static str,
    },
    /// No frame arrived in time.
    #[error("{camera}: no frame within {} ms", after.as_millis())]
    Timeout {
        /// Name of the camera.
        camera: String,
        /// Time waited.
        after: Duration,
    },
    /// The camera works and waits: for an external trigger, or until both cameras are synchronized.
    #[error("{camera}: waits for {what}")]
    Waiting {
        /// Name of the camera.
        camera: String,
        /// Event that it waits for.
        what: &'static str,
    },
    /// All frames of a recording were shown.
    #[error("{camera}: ended after {frames} frames")]
    Ended {
        /// Name of the camera.
        camera: String,
        /// Number of frames shown.
        frames: u64,
    },
}

impl CameraError {
    /// Whether only one frame is lost and the camera continues.
    pub fn is_passing(&self) -> bool {
        matches!(self, Self::Frame { .. } | Self::Damaged { .. } | Self::Changed { .. })
    }
}

impl From<ArrayError> for CameraError {
    fn from(e: ArrayError) -> Self {
        Self::Array(Box::new(e))
    }
}

/// Encodes planes pixel by pixel, as cameras deliver them, into `bytes`.
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
        assert_eq!(
            e.to_string(),
            "camera backend `usb` is not available: allowed: sim, replay, libcamera, v4l2, genicam"
        );
    }

    #[test]
    fn cameras_that_are_not_real_refuse_what_their_source_determines() {
        let refused = |name: &str, mode: Mode| {
            let request = Request { mode, ..Request::new(Role::Raw, &Clock::default()) };
            open(name, &request).err().unwrap().to_string()
        };
        let said = refused("sim", Mode { bits: Some(12), ..Mode::default() });
        assert!(said.ends_with("takes no width, height, format, bits, sync, trigger, clock or readout_us"), "{said}");
        let said = refused("replay", Mode { gain: Some(2.0), ..Mode::default() });
        assert!(said.contains("takes no width, height, format, bits, exposure_us, gain, sync"), "{said}");
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
    fn the_default_is_a_raw_format_for_the_raw_camera_and_colour_for_the_guide() {
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
    fn a_backend_that_is_not_built_in_names_its_feature() {
        let e = open("v4l2", &Request::new(Role::Raw, &Clock::default())).err().unwrap().to_string();
        assert!(e.ends_with("cargo build --features v4l2"), "{e}");
    }

    #[test]
    fn every_listed_source_opens() {
        for camera in (BACKENDS[0].list)().unwrap() {
            let source = format!("{},size=24,stripes=4", camera.source);
            let request = Request { source, ..Request::new(Role::Raw, &Clock::default()) };
            assert_eq!(open("sim", &request).unwrap().info().size, Size::new(24, 24));
        }
    }
}
