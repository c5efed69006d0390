//! A device: the sensor, its noise, the diffuser's PSF, the polarizer mask, and how the guide camera lies.

use crate::image::{Size, Stack};
use crate::optics::{Psf, Response};

/// Largest sensor side, in pixels: PSF spectra of a larger one do not fit any supported board.
pub const MAX_SIDE: usize = 4096;

/// Everything known about one device.
#[derive(Clone, Debug)]
pub struct Device {
    /// The lensless sensor.
    pub sensor: Sensor,
    /// The sensor's noise.
    pub noise: Noise,
    /// The diffuser.
    pub psf: Psf,
    /// The polarizer mask.
    pub response: Response,
    /// From scene pixels to pixels of the guide camera.
    pub guide: Homography,
    /// Dark frame in counts, one plane or one for each channel.
    pub dark: Option<Stack<f32>>,
    /// Fixed white balance: the readings of each channel are multiplied by it; 1 for a mono sensor.
    pub white: [f32; 3],
}

/// The lensless sensor's frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Frame size.
    pub size: Size,
    /// 1 (mono) or 3 (colour).
    pub channels: usize,
    /// Reading without light, in counts.
    pub black_level: f32,
    /// Reading at which a pixel is full, in counts.
    pub saturation: f32,
}

/// Noise of one reading, in fractions of full scale: variance = read² + shot·signal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Noise {
    /// Standard deviation in the dark.
    pub read: f32,
    /// Variance per unit of signal.
    pub shot: f32,
}

/// A projective map between two images' pixel coordinates, row-major 3 × 3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Homography(pub [f64; 9]);

impl Homography {
    /// Every pixel stays where it is.
    pub const IDENTITY: Self = Self([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);

    /// Where the point (x, y) goes.
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let h = &self.0;
        let w = h[6] * x + h[7] * y + h[8];
        ((h[0] * x + h[1] * y + h[2]) / w, (h[3] * x + h[4] * y + h[5]) / w)
    }
}
