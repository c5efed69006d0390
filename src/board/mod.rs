//! Board descriptions: a TOML file, such as those in `boards/`, is read and validated into a [`Board`].
//!
//! The shipped boards are compiled into the program, so it needs no data folder; `--board` also takes the path of a file.
//!
//! ```
//! let board = stokescope::board::Board::load("x86-sim").unwrap();
//! assert_eq!(board.raw.backend, "sim");
//! ```

mod cost;
mod cpu;
mod limit;
mod mode;
mod raw;
mod workload;

use std::net::IpAddr;
use std::path::{Path, PathBuf};

pub use cost::{FrameTimes, FusionWorkload, MeasuredTimes, Workload};
pub use cpu::{Core, Cpu};
pub use limit::SystemLimit;

use crate::bundle::{Bundle, BundleError};
use crate::config::{self, Checker, ConfigError};
use crate::model::{Choice, Precision};
pub use mode::{Mode, Stamp, Sync, Timing};
use stokescope_core::image::Window;
use stokescope_core::optics::FftBackend;
use stokescope_core::pipeline::Settings;

/// Largest number of frames per camera that a board may let wait for processing.
pub const MAX_QUEUE_FRAMES: usize = 8;

/// Longest chain of boards that inherit from one another.
const MAX_ANCESTORS: usize = 4;

/// Shipped boards: name and content of each file in `boards/`.
const SHIPPED: &[(&str, &str)] = &[
    ("rpi-zero-2w", include_str!("../../boards/rpi-zero-2w.toml")),
    ("rpi3b-plus", include_str!("../../boards/rpi3b-plus.toml")),
    ("rpi4", include_str!("../../boards/rpi4.toml")),
    ("cm4-endoscope", include_str!("../../boards/cm4-endoscope.toml")),
    ("cm4-microscope", include_str!("../../boards/cm4-microscope.toml")),
    ("rpi5", include_str!("../../boards/rpi5.toml")),
    ("rock-5b", include_str!("../../boards/rock-5b.toml")),
    ("orange-pi-5", include_str!("../../boards/orange-pi-5.toml")),
    ("x86-sim", include_str!("../../boards/x86-sim.toml")),
    ("x86-libcamera-virtual", include_str!("../../boards/x86-libcamera-virtual.toml")),
];

/// A machine, its cameras and the settings that suit it.
#[derive(Clone, Debug, PartialEq)]
pub struct Board {
    /// File name without `.toml`.
    pub name: String,
    /// One-line description.
    pub description: String,
    /// Name of the system on a chip.
    pub soc: String,
    /// Processor.
    pub cpu: Cpu,
    /// Memory limit of the pipeline in bytes.
    pub memory_limit_bytes: usize,
    /// Temperatures at which the service warns and reduces quality.
    pub thermal: Thermal,
    /// Solver threads.
    pub threads: usize,
    /// FFT implementation of the solver.
    pub fft: FftBackend,
    /// Solver iterations.
    pub iterations: usize,
    /// Whether a frame starts from the result of the frame before.
    pub video: bool,
    /// Whether the guide is aligned with the raw frame.
    pub register: bool,
    /// Whether the scale of the PSF is refitted when it has changed since calibration.
    pub refit_psf: bool,
    /// Fusion model (stage II).
    pub fusion: Fusion,
    /// Lensless camera.
    pub raw: CameraSpec,
    /// Part of its frames that is used where there is no bundle to say so.
    pub readout: Option<Readout>,
    /// Rotation of the mounted lensless sensor in degrees where there is no bundle to say so.
    pub mounted: Option<u32>,
    /// Guide camera; without one the solver runs unguided.
    pub guide: Option<CameraSpec>,
    /// Largest time difference between the two frames of a pair, in microseconds.
    pub max_skew_us: u64,
    /// Frames per camera that may wait for processing; when the queue is full a new frame replaces the oldest.
    pub queue_frames: usize,
    /// Whether a pair is processed only when it is asked for, by HTTP or a signal.
    pub single_shots: bool,
    /// Source of the device bundle.
    pub calibration: BundleSource,
    /// Settings of the live preview.
    pub preview: Preview,
    /// Processing times measured on the board, if any.
    pub measured: Option<MeasuredTimes>,
}

/// Part of the planes of a camera that is used, as its bundle says or will say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Readout {
    /// Colour channels: 1 or 3.
    pub channels: usize,
    /// The part, and the blocks of its readings.
    pub window: Window,
}

/// Source of the device bundle.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BundleSource {
    /// The simulated camera describes its own device.
    Simulated,
    /// A folder; a relative path starts at the folder of the board file.
    Folder(PathBuf),
}

/// Fusion model of a board and the number format that is fastest on it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Fusion {
    /// Model.
    pub model: Choice,
    /// Number format of the model.
    pub precision: Precision,
}

/// Description of one camera of a board.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraSpec {
    /// Name of the backend, as listed by `stokescope cameras`.
    pub backend: String,
    /// Address of the camera within its backend.
    pub source: String,
    /// Frames per second; the camera decides when `None`.
    pub frame_rate: Option<f64>,
    /// Whether frames arrive at the frame rate. If not, they arrive as fast as they are processed (simulated and replayed cameras
    /// only).
    pub paced: bool,
    /// Requested size, format, exposure and gain.
    pub mode: Mode,
    /// When it exposes, and what its time stamps mean.
    pub timing: Timing,
    /// Number of identical frames in a row after which the camera counts as stuck: 0 is never, `None` the backend's default.
    pub max_identical: Option<u32>,
}

impl CameraSpec {
    /// Describes the camera `source` of `backend` without requesting a mode.
    pub fn new(backend: &str, source: String) -> Self {
        let (frame_rate, mode, timing) = (None, Mode::default(), Timing::default());
        Self { backend: backend.to_owned(), source, frame_rate, paced: true, mode, timing, max_identical: None }
    }
}

/// Temperature thresholds, compared with the hottest thermal zone.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Thermal {
    /// The live page warns from this temperature on, in °C.
    pub warn_celsius: f32,
    /// Solver iterations are reduced from this temperature on, in °C.
    pub limit_celsius: f32,
}

impl Thermal {
    /// Thresholds for the supported boards, whose firmware throttles from 80 °C.
    pub const DEFAULT: Self = Self { warn_celsius: 70.0, limit_celsius: 78.0 };
}

/// Settings of the live preview.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Preview {
    /// JPEG quality, 1 to 100.
    pub jpeg_quality: u8,
    /// Largest number of clients at once.
    pub max_clients: usize,
    /// Names and addresses under which routers and proxies present this machine.
    pub allowed_hosts: Vec<String>,
}

/// Takes a name or an address of a machine as requests carry it, without scheme and port.
///
/// # Errors
/// The text that is none, and what is allowed.
pub fn host_name(text: &str) -> Result<String, String> {
    let label = |label: &str| {
        !label.is_empty()
            && label.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_')
            && label.len() < 64
    };
    if text.parse::<IpAddr>().is_ok() || text.split('.').all(label) {
        return Ok(text.to_owned());
    }
    Err(format!("{text:?}, allowed: {HOST_NAME}"))
}

/// Values that [`host_name`] takes, for messages.
const HOST_NAME: &str = "a name such as microscope.lab or an address, without scheme and port";

impl Board {
    /// Pipeline settings of this board for live frames, without a fusion model.
    pub fn settings(&self) -> Settings {
        Settings {
            guided: self.guide.is_some(),
            iterations: Some(self.iterations),
            register: self.register,
            refit_psf: self.refit_psf,
            fft: self.fft,
            threads: self.threads,
            video: self.video,
            angles: false,
            ..Settings::default()
        }
    }

    /// Rotation of the mounted lensless sensor in degrees, by the board's bundle or else by the board; `None` leaves it to the driver.
    ///
    /// # Errors
    /// [`BundleError`] for a bundle whose description cannot be read.
    pub fn orientation(&self) -> Result<Option<u32>, BundleError> {
        let own = match &self.calibration {
            BundleSource::Folder(dir) => Bundle::orientation_in(dir)?,
            BundleSource::Simulated => None,
        };
        Ok(own.or(self.mounted))
    }

    /// Loads the shipped board `name`, or the board file at the path `name`.
    ///
    /// # Errors
    /// [`ConfigError`]; for an unknown name it lists the shipped boards.
    pub fn load(name: &str) -> Result<Self, ConfigError> {
        if let Some((shipped, text)) = SHIPPED.iter().find(|(shipped, _)| *shipped == name) {
            return Self::parse(Path::new(&format!("boards/{shipped}.toml")), text);
        }
        let path = Path::new(name);
        if path.extension().is_none() && !path.exists() {
            let names: Vec<_> = Self::shipped().collect();
            return Err(ConfigError::Missing(PathBuf::from(format!(
                "board {name} (allowed: {}, or the path of a TOML file)",
                names.join(", ")
            ))));
        }
        Self::parse(path, &config::read(path)?)
    }

    /// Names of the shipped boards.
    pub fn shipped() -> impl Iterator<Item = &'static str> {
        SHIPPED.iter().map(|(name, _)| *name)
    }

    /// Validates `text`, the content of the board file `path`. Missing keys are taken from the shipped board that it inherits from.
    ///
    /// # Errors
    /// [`ConfigError`] with file, line, key and what is allowed.
    pub fn parse(path: &Path, text: &str) -> Result<Self, ConfigError> {
        let mut check = Checker::new(path, text);
        let mut file: raw::BoardFile = config::parse(path, text)?;
        let mut chain = heapless::Vec::<&str, MAX_ANCESTORS>::new();
        while let Some(name) = file.take_base() {
            let known = SHIPPED.iter().find(|(shipped, _)| shipped == name.get_ref());
            let Some((base, text)) = known.filter(|(base, _)| !chain.contains(base) && chain.push(base).is_ok()) else {
                let names: Vec<_> = Self::shipped().collect();
                let allowed = format!("a shipped board that does not inherit from this one: {}", names.join(", "));
                check.reject("inherit", Some(name.span().start), format!("{:?}", name.get_ref()), &allowed);
                break;
            };
            file = file.inherit(config::parse(Path::new(&format!("boards/{base}.toml")), text)?);
        }
        let board = file.validate(path, &mut check);
        check.finish()?;
        Ok(board)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_file_in_boards_is_shipped_and_valid() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("boards");
        let mut files: Vec<_> = std::fs::read_dir(folder)
            .unwrap()
            .map(|e| e.unwrap().path())
            .filter(|p| p.extension().is_some_and(|e| e == "toml"))
            .map(|p| p.file_stem().unwrap().to_str().unwrap().to_owned())
            .collect();
        files.sort();
        let mut shipped: Vec<_> = Board::shipped().collect();
        shipped.sort_unstable();
        assert_eq!(files, shipped);
        for name in shipped {
            assert_eq!(Board::load(name).unwrap().name, name);
        }
    }

    #[test]
    fn missing_keys_are_inherited() {
        let (base, board) = (Board::load("rpi4").unwrap(), Board::load("rpi5").unwrap());
        assert_eq!((board.cpu.core, board.cpu.clock_mhz, board.cpu.cores), (Core::CortexA76, 2400, base.cpu.cores));
        assert_eq!((board.threads, board.preview, &board.calibration), (base.threads, base.preview, &base.calibration));
        assert_eq!(Board::load("cm4-microscope").unwrap().raw.backend, base.raw.backend, "over two steps");
        let parse = |text: &str| Board::parse(Path::new("b.toml"), text);
        let alone = parse("inherit = \"rpi5\"\ndescription = \"one camera\"\n[cameras]\nguided = false").unwrap();
        assert_eq!((alone.guide, alone.raw), (None, board.raw.clone()));
        // a mode is one of a camera of this backend
        let other = parse("inherit = \"rpi5\"\n[cameras.raw]\nbackend = \"sim\"\nsource = \"plastic\"").unwrap().raw;
        assert_eq!((other.mode, other.frame_rate), (Mode::default(), board.raw.frame_rate));
    }

    #[test]
    fn a_key_that_is_neither_given_nor_inherited_is_named() {
        let parse = |text: &str| Board::parse(Path::new("b.toml"), text).unwrap_err().to_string();
        let e = parse("soc = \"any\"");
        for key in ["description", "cpu.core", "memory.limit_bytes", "solver.threads", "cameras.raw.backend"] {
            assert!(e.contains(&format!("{key} = nothing, allowed: a value")), "{key} in {e}");
        }
        let e = parse("inherit = \"rpi6\"");
        assert!(e.contains("b.toml:1: inherit = \"rpi6\", allowed: a shipped board"), "{e}");
    }

    #[test]
    fn wrong_values_are_reported_together_with_their_lines() {
        let text = include_str!("../../boards/x86-sim.toml")
            .replace("threads = 2", "threads = 0")
            .replace("\"x86-64\"", "\"z80\"")
            .replace("jpeg_quality = 85", "jpeg_quality = 101");
        let e = Board::parse(Path::new("b.toml"), &text).unwrap_err().to_string();
        assert_eq!(e.lines().count(), 3, "{e}");
        assert!(e.contains("cpu.core = \"z80\", allowed: cortex-a53"), "{e}");
        assert!(e.contains("solver.threads = 0, allowed: 1 to 64"), "{e}");
        assert!(e.contains("preview.jpeg_quality = 101, allowed: 1 to 100"), "{e}");
    }

    #[test]
    fn the_mode_of_a_camera_is_read_and_every_fault_of_it_named() {
        use stokescope_core::frame::{PixelFormat, Samples};
        use stokescope_core::image::Size;
        let shipped = include_str!("../../boards/x86-sim.toml");
        let with = |keys: &str| {
            let text = shipped.replacen("frame_rate = 10.0", keys, 1);
            Board::parse(Path::new("b.toml"), &text)
        };
        let keys = "width = 64\nheight = 48\nformat = \"mono10p\"\nbits = 10\nexposure_us = 5000.0\ngain = 2.0\n\
                    sync = \"server\"\nmax_identical = 0";
        let raw = with(keys).unwrap().raw;
        let format = Some(PixelFormat::Mono(Samples::Packed10));
        let size = Some(Size::new(64, 48));
        let (exposure_us, gain) = (Some(5000.0), Some(2.0));
        let bits = Some(10);
        assert_eq!(raw.mode, Mode { size, format, bits, exposure_us, gain, sync: Sync::Server });
        assert_eq!(raw.max_identical, Some(0));
        let keys = "width = 64\nformat = \"raw\"\nexposure_us = 0.0\ngain = -1.0\nsync = \"loose\"\nmax_identical = -1";
        let e = with(keys).unwrap_err().to_string();
        assert_eq!(e.lines().count(), 6, "{e}");
        let deep = with("format = \"mono10p\"\nbits = 12").unwrap_err().to_string();
        assert!(deep.contains("cameras.raw.bits = 12, allowed: 10 with this format"), "{deep}");
        assert_eq!(with("format = \"mono16\"\nbits = 12").unwrap().raw.mode.bits, Some(12));
        for part in [
            "cameras.raw.width = 64, allowed: with height",
            "cameras.raw.format = \"raw\", allowed: mono8,",
            "cameras.raw.exposure_us = 0.0, allowed: 1 to 1000000000",
            "cameras.raw.gain = -1.0",
            "cameras.raw.sync = \"loose\", allowed: off, server, client, clock",
            "cameras.raw.max_identical = -1",
        ] {
            assert!(e.contains(part), "{part} in {e}");
        }
        let timed = "exposure_us = 900.0\ntrigger = \"external\"\nclock = \"arrival\"\nreadout_us = 14800.0";
        let timing = with(timed).unwrap().raw.timing;
        assert_eq!(timing, Timing { clock: Some(Stamp::Arrival), readout_us: Some(14_800.0), triggered: true });
        let e = with("trigger = \"external\"\nclock = \"exposure\"\nreadout_us = -1.0").unwrap_err().to_string();
        for part in [
            "cameras.raw.trigger = \"external\", allowed: with exposure_us",
            "cameras.raw.clock = \"exposure\", allowed: exposure-start, exposure-end, arrival",
            "cameras.raw.readout_us = -1.0, allowed: 0 to 1000000",
        ] {
            assert!(e.contains(part), "{part} in {e}");
        }
        let e = with("sync = \"clock\"").unwrap_err().to_string();
        assert!(e.contains("cameras.raw.sync = \"clock\", allowed: with frame_rate"), "{e}");
    }

    #[test]
    fn boards_name_a_part_of_a_mode_that_fits() {
        for (name, working, channels) in
            [("rpi-zero-2w", 192, 1), ("rpi4", 250, 3), ("rpi5", 250, 1), ("cm4-endoscope", 128, 1)]
        {
            let readout = Board::load(name).unwrap().readout.unwrap();
            assert_eq!((readout.window.working().width, readout.channels), (working, channels), "{name}");
        }
        let parse = |text: &str| Board::parse(Path::new("b.toml"), text).unwrap_err().to_string();
        let e = parse("inherit = \"rpi5\"\n[sensor]\ncrop = [500, 44, 1000, 1000]");
        assert!(
            e.contains("sensor.crop = [500, 44, 1000, 1000]") && e.contains("within the frame of 1456×1088"),
            "{e}"
        );
        let e = parse("inherit = \"rpi5\"\n[sensor]\nbin = 3");
        assert!(e.contains("bin = 3 in a crop of 1000×1000 pixels"), "{e}");
        let turned = Board::parse(Path::new("b.toml"), "inherit = \"rpi5\"\n[sensor]\norientation = 180").unwrap();
        assert_eq!((turned.mounted, turned.orientation().unwrap()), (Some(180), Some(180)), "there is no bundle yet");
        let e = parse("inherit = \"rpi5\"\n[sensor]\norientation = 90");
        assert!(e.contains("sensor.orientation = 90, allowed: 0 or 180 degrees"), "{e}");
    }

    #[test]
    fn a_mistyped_key_names_the_nearest() {
        let text = include_str!("../../boards/x86-sim.toml").replace("iterations", "iteration");
        let e = Board::parse(Path::new("b.toml"), &text).unwrap_err().to_string();
        assert!(e.contains("did you mean `iterations`?"), "{e}");
    }

    #[test]
    fn an_unknown_name_lists_the_shipped_boards() {
        let e = Board::load("raspberry").unwrap_err().to_string();
        assert!(e.contains("board raspberry (allowed: rpi-zero-2w"), "{e}");
    }
}
