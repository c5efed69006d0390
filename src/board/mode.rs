//! The mode requested from a camera, and how it is synchronized with the other camera.

use std::fmt;

use stokescope_core::frame::PixelFormat;
use stokescope_core::image::Size;

/// How the exposures of the two cameras are synchronized.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Sync {
    /// Cameras run freely, or a hardware trigger synchronizes them.
    #[default]
    Off,
    /// Software synchronization by libcamera: this camera sets the time.
    Server,
    /// Software synchronization by libcamera: this camera follows the server.
    Client,
    /// Each frame is requested at a tick of a clock that both cameras share; for cameras without a frame rate of their own.
    Clock,
}

impl Sync {
    /// All variants with their names in board files.
    pub const NAMES: [(Self, &'static str); 4] =
        [(Self::Off, "off"), (Self::Server, "server"), (Self::Client, "client"), (Self::Clock, "clock")];
}

/// Instant that the time stamps of a camera name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Stamp {
    /// Start of the exposure of the first row.
    ExposureStart,
    /// End of the exposure of the first row, which is the start of its read-out.
    ExposureEnd,
    /// Arrival of the frame on this machine; the camera's own time stamps are not used.
    Arrival,
}

impl Stamp {
    /// All variants with their names in board files.
    pub const NAMES: [(Self, &'static str); 3] =
        [(Self::ExposureStart, "exposure-start"), (Self::ExposureEnd, "exposure-end"), (Self::Arrival, "arrival")];
}

/// When a camera exposes, and what its time stamps mean.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Timing {
    /// Meaning of its time stamps; `None` is what the backend knows.
    pub clock: Option<Stamp>,
    /// Time from the read-out of the first row to that of the last one, in microseconds; `None` is what the backend knows.
    pub readout_us: Option<f32>,
    /// Whether an external trigger starts each exposure: silence is no fault.
    pub triggered: bool,
}

/// Requested mode of a camera; the camera chooses what is `None`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Mode {
    /// Size of the frames in sensor pixels.
    pub size: Option<Size>,
    /// Pixel format of the frames.
    pub format: Option<PixelFormat>,
    /// Bit depth of the sensor's mode; of several depths the deepest is chosen.
    pub bits: Option<u32>,
    /// Fixed exposure time in microseconds; turns automatic exposure off.
    pub exposure_us: Option<f32>,
    /// Fixed gain; turns automatic gain off. A factor with libcamera, the driver's own number with Video4Linux.
    pub gain: Option<f32>,
    /// Synchronization with the other camera.
    pub sync: Sync,
}

impl fmt::Display for Mode {
    /// Size, format and bit depth as written in a board file.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size = self.size.map(|size| size.to_string());
        let format = self.format.map(PixelFormat::name);
        let bits = self.bits.map(|bits| format!("of {bits} bits"));
        let words: Vec<String> = size.into_iter().chain(format).chain(bits).collect();
        f.write_str(if words.is_empty() { "any mode" } else { "" })?;
        f.write_str(&words.join(" "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mode_says_what_was_asked_for() {
        assert_eq!(Mode::default().to_string(), "any mode");
        let mode = Mode { size: Some(Size::new(64, 48)), format: Some(PixelFormat::Nv12Luma), ..Mode::default() };
        assert_eq!(mode.to_string(), "64×48 nv12-luma");
        let mode = Mode { size: Some(Size::new(64, 48)), bits: Some(10), ..Mode::default() };
        assert_eq!(mode.to_string(), "64×48 of 10 bits");
    }
}
