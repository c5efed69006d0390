//! What is asked of a camera: its mode, and how it keeps step with the other one.

use std::fmt;

use stokescope_core::frame::PixelFormat;
use stokescope_core::image::Size;

/// How the frames of two cameras are made to show the same instants.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Sync {
    /// Each camera runs freely, or hardware joins them.
    #[default]
    Off,
    /// libcamera's software synchronization: this camera tells the time.
    Server,
    /// libcamera's software synchronization: this camera follows the server.
    Client,
    /// A frame is asked for when the clock that the cameras share ticks; for sources without a pace of their own.
    Clock,
}

impl Sync {
    /// Every kind with its name in a board file.
    pub const NAMES: [(Self, &'static str); 4] =
        [(Self::Off, "off"), (Self::Server, "server"), (Self::Client, "client"), (Self::Clock, "clock")];
}

/// What is asked of a camera; what is not given is left to it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Mode {
    /// Size of the frames in sensor pixels.
    pub size: Option<Size>,
    /// Format of the frames.
    pub format: Option<PixelFormat>,
    /// Exposure time in microseconds; fixed, and automatic exposure off.
    pub exposure_us: Option<f32>,
    /// Gain; fixed, and automatic gain off. A factor for libcamera, the driver's own number for Video4Linux.
    pub gain: Option<f32>,
    /// How it keeps step with the other camera.
    pub sync: Sync,
}

impl fmt::Display for Mode {
    /// What was asked for, as it stands in a board file.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size = self.size.map(|size| size.to_string());
        let format = self.format.map(PixelFormat::name);
        let words: Vec<String> = size.into_iter().chain(format).collect();
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
    }
}
