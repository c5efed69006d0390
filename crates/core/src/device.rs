//! A device: the sensor, its noise, the diffuser's PSF, the polarizer mask, and how the guide camera lies.
//!
//! [`Device::builder`] makes one from arrays and checks everything once: whatever holds a `Device` needs no checks of its own.
//! Allocation: the builder allocates.

use crate::image::{Size, Stack};
use crate::optics::{Margin, Mask, MaskError, Psf, PsfError, Response};

/// Largest sensor side, in pixels: PSF spectra of a larger one do not fit any supported board.
pub const MAX_SIDE: usize = 4096;

/// Everything known about one device. Made by [`Device::builder`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Device {
    /// The lensless sensor.
    pub sensor: Sensor,
    /// The sensor's noise.
    pub noise: Noise,
    /// The diffuser.
    pub psf: Psf,
    /// The polarizer mask.
    pub response: Response,
    /// Margin around the frame from which light may reach the sensor, in pixels; none behind a field stop.
    pub margin: Margin,
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
    /// Width and height in pixels.
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

    /// This map of points that are shifted first, by (dx, dy).
    #[must_use]
    pub fn after_shift(&self, dx: f64, dy: f64) -> Self {
        let mut h = self.0;
        for row in h.chunks_exact_mut(3) {
            row[2] += row[0] * dx + row[1] * dy;
        }
        Self(h)
    }

    /// The image of the point (x, y).
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let h = &self.0;
        let w = h[6] * x + h[7] * y + h[8];
        ((h[0] * x + h[1] * y + h[2]) / w, (h[3] * x + h[4] * y + h[5]) / w)
    }
}

/// A device that cannot be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DeviceError {
    /// No pixels, or more than any supported board can work with.
    #[error("sensor of {found} pixels, allowed: 1 to {MAX_SIDE} each way")]
    Size {
        /// The size given.
        found: Size,
    },
    /// Neither mono nor colour.
    #[error("sensor of {found} channels, allowed: 1 or 3")]
    Channels {
        /// The number given.
        found: usize,
    },
    /// Black and full cannot be told apart.
    #[error(
        "black level {black_level}, saturation {saturation}; allowed: finite, the saturation above the black level"
    )]
    Levels {
        /// Counts without light.
        black_level: f32,
        /// Counts at which a pixel is full.
        saturation: f32,
    },
    /// Noise that is no noise.
    #[error("read noise {}, shot noise {}; allowed: 0 to 1, fractions of full scale", .0.read, .0.shot)]
    Noise(Noise),
    /// No PSF.
    #[error("the device has no PSF: give one by `psf`")]
    NoPsf,
    /// A PSF that cannot be used.
    #[error(transparent)]
    Psf(#[from] PsfError),
    /// A mask that cannot be used.
    #[error(transparent)]
    Mask(#[from] MaskError),
    /// A dark frame of another shape than the sensor's frames.
    #[error("dark frame of {found_planes} plane(s) of {found}, expected {} of {size} (the sensor's)", if *channels == 1 { "1" } else { "1 or 3" })]
    DarkShape {
        /// Planes given.
        found_planes: usize,
        /// Their size.
        found: Size,
        /// Channels of the sensor.
        channels: usize,
        /// Size of the sensor.
        size: Size,
    },
    /// A dark frame with values that are no counts in the dark.
    #[error("dark frame: sample {at} is {value}, expected finite counts below the saturation of {saturation}")]
    DarkValue {
        /// Index of the sample.
        at: usize,
        /// Value of the sample, counts.
        value: f32,
        /// Saturation of the sensor, counts.
        saturation: f32,
    },
    /// White balance that would remove or invert a channel.
    #[error("white balance {found:?}, allowed: 3 numbers from 0.01 to 100")]
    White {
        /// The gains given.
        found: [f32; 3],
    },
    /// A homography that maps pixels to nowhere.
    #[error("guide homography {:?}, allowed: finite numbers of a non-zero determinant", .0.0)]
    Homography(Homography),
}

/// A device in the making.
#[derive(Clone, Debug)]
pub struct DeviceBuilder {
    sensor: Sensor,
    noise: Noise,
    psf: Option<Stack<f32>>,
    mask: Mask,
    margin: Option<usize>,
    guide: Homography,
    dark: Option<Stack<f32>>,
    white: [f32; 3],
}

impl Device {
    /// Bytes held.
    pub fn bytes(&self) -> usize {
        let planes = self.psf.count() + 1 + if self.response.is_polarized() { 2 } else { 0 };
        planes * self.sensor.size.pixels() * size_of::<f32>() + self.dark.as_ref().map_or(0, Stack::bytes)
    }

    /// Begins a device whose lensless sensor has `size` pixels. Until told otherwise it is mono, has no mask, full-scale readings from 0 to
    /// 65535 counts and read noise of 0.002, and its guide camera sees the scene pixel for pixel.
    pub fn builder(size: Size) -> DeviceBuilder {
        DeviceBuilder {
            sensor: Sensor { size, channels: 1, black_level: 0.0, saturation: f32::from(u16::MAX) },
            noise: Noise { read: 0.002, shot: 0.0 },
            psf: None,
            mask: Mask::None,
            margin: None,
            guide: Homography::IDENTITY,
            dark: None,
            white: [1.0; 3],
        }
    }
}

impl DeviceBuilder {
    /// Channels of the sensor: 1 (mono) or 3 (colour).
    #[must_use]
    pub fn channels(mut self, channels: usize) -> Self {
        self.sensor.channels = channels;
        self
    }

    /// Counts of a pixel without light and of a full one.
    #[must_use]
    pub fn levels(mut self, black_level: f32, saturation: f32) -> Self {
        (self.sensor.black_level, self.sensor.saturation) = (black_level, saturation);
        self
    }

    /// Noise of a reading in fractions of full scale: standard deviation in the dark, and variance per unit of signal.
    #[must_use]
    pub fn noise(mut self, read: f32, shot: f32) -> Self {
        self.noise = Noise { read, shot };
        self
    }

    /// The image of a point source, `[H, W]` or `[C, H, W]`, of any positive scale; a displacement of zero lies at half the size.
    #[must_use]
    pub fn psf(mut self, psf: Stack<f32>) -> Self {
        self.psf = Some(psf);
        self
    }

    /// Pixels around the frame from which light may reach the sensor; 0 for a field stop. Unless it is given it is the reach of the PSF, and
    /// it is never more.
    #[must_use]
    pub fn margin(mut self, pixels: usize) -> Self {
        self.margin = Some(pixels);
        self
    }

    /// The polarizer mask on the sensor.
    #[must_use]
    pub fn mask(mut self, mask: Mask) -> Self {
        self.mask = mask;
        self
    }

    /// Dark frame in counts, one plane or one for each channel; it takes the place of the black level.
    #[must_use]
    pub fn dark(mut self, dark: Stack<f32>) -> Self {
        self.dark = Some(dark);
        self
    }

    /// Factors of red, green and blue readings.
    #[must_use]
    pub fn white(mut self, gains: [f32; 3]) -> Self {
        self.white = gains;
        self
    }

    /// The map from scene pixels to pixels of the guide camera.
    #[must_use]
    pub fn guide(mut self, homography: Homography) -> Self {
        self.guide = homography;
        self
    }

    /// The device, checked.
    ///
    /// # Errors
    /// [`DeviceError`] with the first thing that cannot be.
    pub fn build(self) -> Result<Device, DeviceError> {
        let Self { sensor, noise, psf, mask, margin, guide, dark, white } = self;
        let Sensor { size, channels, black_level, saturation } = sensor;
        if !(1..=MAX_SIDE).contains(&size.width) || !(1..=MAX_SIDE).contains(&size.height) {
            return Err(DeviceError::Size { found: size });
        }
        if ![1, 3].contains(&channels) {
            return Err(DeviceError::Channels { found: channels });
        }
        if !black_level.is_finite() || !saturation.is_finite() || saturation <= black_level {
            return Err(DeviceError::Levels { black_level, saturation });
        }
        if ![noise.read, noise.shot].iter().all(|v| (0.0..=1.0).contains(v)) {
            return Err(DeviceError::Noise(noise));
        }
        if !white.iter().all(|gain| (0.01..=100.0).contains(gain)) {
            return Err(DeviceError::White { found: white });
        }
        let determinant = nalgebra::Matrix3::from_row_slice(&guide.0).determinant();
        if !determinant.is_finite() || determinant == 0.0 {
            return Err(DeviceError::Homography(guide));
        }
        let psf = Psf::new(psf.ok_or(DeviceError::NoPsf)?, size, channels)?;
        let response = mask.response(size)?;
        if let Some(dark) = &dark {
            check_dark(dark, &sensor)?;
        }
        let reach = Margin::of_reach(psf.reach());
        let margin = margin.map_or(reach, |pixels| Margin::uniform(pixels).at_most(reach));
        Ok(Device { sensor, noise, psf, response, margin, guide, dark, white })
    }
}

/// Refuses a dark frame that is not the sensor's.
///
/// # Errors
/// [`DeviceError::DarkShape`], [`DeviceError::DarkValue`].
pub fn check_dark(dark: &Stack<f32>, sensor: &Sensor) -> Result<(), DeviceError> {
    let Sensor { size, channels, saturation, .. } = *sensor;
    if dark.size() != size || ![1, channels].contains(&dark.count()) {
        return Err(DeviceError::DarkShape { found_planes: dark.count(), found: dark.size(), channels, size });
    }
    match dark.as_slice().iter().position(|v| !v.is_finite() || *v >= saturation) {
        Some(at) => Err(DeviceError::DarkValue { at, value: dark.as_slice()[at], saturation }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(8, 8);

    fn psf() -> Stack<f32> {
        Stack::from_vec(1, SIZE, (0..64).map(|i| (i % 7) as f32).collect()).unwrap()
    }

    fn refusal(builder: DeviceBuilder) -> String {
        builder.build().unwrap_err().to_string()
    }

    #[test]
    fn a_device_is_made_of_arrays() {
        let mask = Mask::stripes(&[0.0, 45.0, 90.0], 6);
        let device = Device::builder(SIZE).psf(psf()).mask(mask).levels(64.0, 4095.0).build().unwrap();
        assert_eq!(device.response.angles().len(), 3);
        assert_eq!((device.sensor.black_level, device.sensor.channels), (64.0, 1));
        assert!((device.psf.channel(0).iter().sum::<f32>() - 1.0).abs() < 1e-6);
    }

    #[test]
    fn everything_is_checked_and_named() {
        let begun = || Device::builder(SIZE).psf(psf());
        let dark = |size, value| Stack::from_vec(1, size, vec![value; size.pixels()]).unwrap();
        for (builder, expected) in [
            (Device::builder(SIZE), "no PSF"),
            (Device::builder(Size::new(0, 8)).psf(psf()), "0×8 pixels"),
            (begun().channels(2), "2 channels, allowed: 1 or 3"),
            (begun().levels(100.0, 100.0), "black level 100, saturation 100"),
            (begun().noise(f32::NAN, 0.0), "read noise NaN"),
            (begun().white([1.0, 0.0, 1.0]), "white balance [1.0, 0.0, 1.0]"),
            (begun().guide(Homography([0.0; 9])), "non-zero determinant"),
            (begun().mask(Mask::stripes(&[0.0, 45.0], 6)), "angles"),
            (begun().dark(dark(Size::new(4, 8), 0.0)), "1 plane(s) of 4×8, expected 1 of 8×8"),
            (begun().dark(dark(SIZE, 65535.0)), "sample 0 is 65535"),
        ] {
            let message = refusal(builder);
            assert!(message.contains(expected), "{message:?} lacks {expected:?}");
        }
    }
}
