//! L2: where frames come from. Every camera, real or not, is a [`Camera`]; what can be opened stands in one list, [`BACKENDS`].
//!
//! A camera lends its [`Frame`]: format, stride and memory are the driver's, and the borrow ends before the next frame can
//! be asked for. Waiting is always bounded. Cameras that show the same scene are opened with one [`Clock`], so that frames
//! with equal timestamps show the same instant.
//!
//! Allocation: `open` allocates; the simulator's frames reuse its buffers, replayed files are read into new memory.
//! Imports: `array`, `calibration`, `frame`, `plane`.
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

mod clock;
mod replay;
pub mod sim;

use std::{fmt, path::PathBuf, time::Duration};

pub use clock::Clock;
pub use replay::ReplayCamera;

use self::sim::SimCamera;
use crate::{
    array::ArrayError,
    calibration::CameraId,
    frame::{Frame, FrameError, PixelFormat},
    plane::{Size, Stack},
};

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
}

impl Request {
    /// A paced, endless camera for `role` on `clock`, from the backend's default source.
    pub fn new(role: Role, clock: &Clock) -> Self {
        Self { source: String::new(), role, clock: clock.clone(), frame_rate: None, paced: true, repeat: true }
    }
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
    /// What it could open: source and description.
    pub list: fn() -> Vec<(String, String)>,
    /// Opens one.
    pub open: fn(&Request) -> Result<Box<dyn Camera>, CameraError>,
}

/// Every backend this program was built with.
pub const BACKENDS: &[Backend] = &[
    Backend {
        name: "sim",
        description: "simulated cameras; source: SCENE[,key=value…] or a folder of angle images",
        available: || Ok(()),
        list: || sim::SCENES.iter().map(|&(name, text)| (name.to_owned(), text.to_owned())).collect(),
        open: |request| Ok(Box::new(SimCamera::open(request)?)),
    },
    Backend {
        name: "replay",
        description: "recorded frames; source: an NPY, PNG or TIFF file, a folder of them, or a folder with raw and guide",
        available: || Ok(()),
        list: Vec::new,
        open: |request| Ok(Box::new(ReplayCamera::open(request)?)),
    },
];

/// Opens a camera of the backend called `name`.
///
/// # Errors
/// [`CameraError::Backend`] when there is none or it cannot work here, others as the backend says.
pub fn open(name: &str, request: &Request) -> Result<Box<dyn Camera>, CameraError> {
    let refuse = |reason| CameraError::Backend { name: name.to_owned(), reason };
    let backend = BACKENDS.iter().find(|backend| backend.name == name).ok_or_else(|| {
        let names: Vec<_> = BACKENDS.iter().map(|backend| backend.name).collect();
        refuse(format!("allowed: {}", names.join(", ")))
    })?;
    (backend.available)().map_err(refuse)?;
    (backend.open)(request)
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
        assert_eq!(e.to_string(), "camera backend `usb` is not available: allowed: sim, replay");
    }

    #[test]
    fn every_listed_source_opens() {
        for (source, _) in (BACKENDS[0].list)() {
            let source = format!("{source},size=24,stripes=4");
            let request = Request { source, ..Request::new(Role::Guide, &Clock::default()) };
            assert_eq!(open("sim", &request).unwrap().info().size, Size::new(24, 24));
        }
    }
}
