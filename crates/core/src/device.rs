//! A device: the sensor, its noise, the diffuser's PSF, the polarizer mask, and how the guide camera lies.
//!
//! [`Device::builder`] makes one from arrays and checks everything once: whatever holds a `Device` needs no checks of its own.
//! Allocation: the builder allocates.

use std::sync::Arc;

use crate::image::{Size, Stack, Window, WindowError};
use crate::optics::{Margin, Mask, MaskError, Psf, PsfError, Response};

/// Largest side of the working size, in pixels: PSF spectra of a larger one do not fit any supported board.
pub const MAX_SIDE: usize = 4096;
/// Largest side of a camera's frame, in pixels.
pub const MAX_FRAME_SIDE: usize = 1 << 14;

/// Everything known about one device. Made by [`Device::builder`].
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Device {
    /// The lensless sensor.
    pub sensor: Sensor,
    /// Noise of a reading of the working size: of the mean of a block.
    pub noise: Noise,
    /// The diffuser.
    pub psf: Psf,
    /// The polarizer mask.
    pub response: Response,
    /// Margin around the frame from which light may reach the sensor, in pixels; none behind a field stop.
    pub margin: Margin,
    /// From scene pixels of the working size to pixels of the guide camera.
    pub guide: Homography,
    /// Weights of a colour guide's red, green and blue beside a mono sensor, of sum 1; none finds them from the readings.
    pub guide_weights: Option<[f32; 3]>,
    /// Dark frame in counts, one plane or one for each channel, of the camera's frame or of the working size.
    pub dark: Option<Arc<Stack<f32>>>,
    /// Fixed white balance: the readings of each channel are multiplied by it; 1 for a mono sensor.
    pub white: [f32; 3],
}

/// The lensless sensor's frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensor {
    /// Working size: width and height of the images that are worked with, in pixels.
    pub size: Size,
    /// The part of the camera's frame that they are made of, and its binning.
    pub window: Window,
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

impl Noise {
    /// Noise that is assumed where none was measured: that of 10 to 12 bits and of pixels that hold 10 000 electrons.
    pub const TYPICAL: Self = Self { read: 0.002, shot: 1e-4 };
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

    /// This map of pixels of a camera's frame as a map of pixels of `window`'s working size.
    #[must_use]
    pub fn of_working(&self, window: &Window) -> Self {
        let (bin, [x, y]) = (window.bin() as f64, centre(window));
        self.each_row(|[a, b, c]| [bin * a, bin * b, a * x + b * y + c])
    }

    /// This map of pixels of `window`'s working size as a map of pixels of the camera's frame.
    #[must_use]
    pub fn of_frame(&self, window: &Window) -> Self {
        let (bin, [x, y]) = (window.bin() as f64, centre(window));
        self.each_row(|[a, b, c]| [a / bin, b / bin, c - (a * x + b * y) / bin])
    }

    fn each_row(&self, change: impl Fn([f64; 3]) -> [f64; 3]) -> Self {
        let [a, b, c, d, e, f, g, h, i] = self.0;
        let [[a, b, c], [d, e, f], [g, h, i]] = [[a, b, c], [d, e, f], [g, h, i]].map(change);
        Self([a, b, c, d, e, f, g, h, i])
    }
}

/// Centre of the first block of `window`, in pixels of the camera's frame.
fn centre(window: &Window) -> [f64; 2] {
    window.first().map(|at| at as f64 + 0.5 * (window.bin() - 1) as f64)
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
    /// A camera's frame without pixels, or a larger one than any camera's.
    #[error("frames of {found} pixels, allowed: 1 to {MAX_FRAME_SIDE} each way")]
    Frame {
        /// The size given.
        found: Size,
    },
    /// A crop or binning that does not fit the camera's frame.
    #[error(transparent)]
    Window(#[from] WindowError),
    /// A PSF, mask or dark frame of a size that is neither the camera's nor the working size.
    #[error("{map} of {found} pixels, allowed: {} (the camera's frame) or {} (the working size, crop/bin)", window.frame(), window.working())]
    MapSize {
        /// The array.
        map: Map,
        /// Size of the map.
        found: Size,
        /// The sensor's window.
        window: Window,
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
    /// Weights of a colour guide that mix nothing.
    #[error("guide weights {found:?}, allowed: red, green and blue from 0 upwards, not all of them 0")]
    GuideWeights {
        /// The weights.
        found: [f32; 3],
    },
    /// A homography that maps pixels to nowhere.
    #[error("guide homography {:?}, allowed: finite numbers of a non-zero determinant", .0.0)]
    Homography(Homography),
}

/// An array that describes a device pixel by pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Map {
    /// The point spread function.
    Psf,
    /// The measured polarizer mask.
    Mask,
    /// The dark frame.
    Dark,
}

impl std::fmt::Display for Map {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Psf => "psf",
            Self::Mask => "mask",
            Self::Dark => "dark frame",
        })
    }
}

/// A device in the making.
#[derive(Clone, Debug)]
pub struct DeviceBuilder {
    sensor: Sensor,
    crop: Option<([usize; 2], Size)>,
    bin: usize,
    noise: Noise,
    psf: Option<Stack<f32>>,
    mask: Mask,
    margin: Option<usize>,
    guide: Option<Homography>,
    guide_weights: Option<[f32; 3]>,
    dark: Option<Stack<f32>>,
    white: [f32; 3],
}

impl Device {
    /// Bytes held.
    pub fn bytes(&self) -> usize {
        let planes = self.psf.count() + 1 + if self.response.is_polarized() { 2 } else { 0 };
        planes * self.sensor.size.pixels() * size_of::<f32>() + self.dark.as_ref().map_or(0, |dark| dark.bytes())
    }

    /// Begins a device whose lensless camera delivers planes of `size` pixels. Until told otherwise it is mono, has no mask, full-scale
    /// readings from 0 to 65535 counts and [`Noise::TYPICAL`], every pixel is used, and its guide camera sees the scene pixel for pixel of
    /// the working size.
    pub fn builder(size: Size) -> DeviceBuilder {
        DeviceBuilder {
            sensor: Sensor {
                size,
                window: Window::whole(size),
                channels: 1,
                black_level: 0.0,
                saturation: f32::from(u16::MAX),
            },
            crop: None,
            bin: 1,
            noise: Noise::TYPICAL,
            psf: None,
            mask: Mask::None,
            margin: None,
            guide: None,
            guide_weights: None,
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

    /// The part of the camera's planes that is used: `size` pixels from column and row `first`.
    #[must_use]
    pub fn crop(mut self, first: [usize; 2], size: Size) -> Self {
        self.crop = Some((first, size));
        self
    }

    /// Blocks of `bin` × `bin` readings become one, their mean.
    #[must_use]
    pub fn bin(mut self, bin: usize) -> Self {
        self.bin = bin;
        self
    }

    /// Counts of a pixel without light and of a full one.
    #[must_use]
    pub fn levels(mut self, black_level: f32, saturation: f32) -> Self {
        (self.sensor.black_level, self.sensor.saturation) = (black_level, saturation);
        self
    }

    /// Noise of one reading of the camera in fractions of full scale: standard deviation in the dark, and variance per unit of signal.
    /// The noise of the mean of a block follows from it.
    #[must_use]
    pub fn noise(mut self, read: f32, shot: f32) -> Self {
        self.noise = Noise { read, shot };
        self
    }

    /// The image of a point source, `[H, W]` or `[C, H, W]`, of any positive scale; a displacement of zero lies at half the size.
    /// Like mask and dark frame it has the size of the camera's planes or the working size.
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

    /// Dark frame in counts, one plane or one for each channel; it takes the place of the black level. One of the camera's planes also
    /// tells which pixels are hot.
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

    /// The map from scene pixels, which are those of the camera's planes, to pixels of the guide camera.
    #[must_use]
    pub fn guide(mut self, homography: Homography) -> Self {
        self.guide = Some(homography);
        self
    }

    /// Weights of a colour guide's red, green and blue beside a mono sensor; their sum is of no account. Without them they are found from the
    /// readings of every frame.
    #[must_use]
    pub fn guide_weights(mut self, weights: [f32; 3]) -> Self {
        self.guide_weights = Some(weights);
        self
    }

    /// The device, checked.
    ///
    /// # Errors
    /// [`DeviceError`] with the first thing that cannot be.
    pub fn build(self) -> Result<Device, DeviceError> {
        let Self { mut sensor, crop, bin, noise, psf, mask, margin, guide, guide_weights, dark, white } = self;
        let frame = sensor.size;
        if ![frame.width, frame.height].iter().all(|side| (1..=MAX_FRAME_SIDE).contains(side)) {
            return Err(DeviceError::Frame { found: frame });
        }
        let (first, crop) = crop.unwrap_or(([0, 0], frame));
        let window = Window::new(frame, first, crop, bin)?.of_cells(mask.cell())?;
        (sensor.window, sensor.size) = (window, window.working());
        let Sensor { size, channels, black_level, saturation, .. } = sensor;
        if size.width.max(size.height) > MAX_SIDE {
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
        let guide = guide.map_or(Homography::IDENTITY, |guide| guide.of_working(&window));
        let determinant = nalgebra::Matrix3::from_row_slice(&guide.0).determinant();
        if !determinant.is_finite() || determinant == 0.0 {
            return Err(DeviceError::Homography(guide));
        }
        let guide_weights = guide_weights.map(normalized).transpose()?;
        let psf = reduced_psf(psf.ok_or(DeviceError::NoPsf)?, &window, channels)?;
        let response = reduced_response(mask, &window)?;
        if let Some(dark) = &dark {
            check_dark(dark, &sensor)?;
        }
        let reach = Margin::of_reach(psf.reach());
        let margin = margin.map_or(reach, |pixels| Margin::uniform(pixels).at_most(reach));
        let noise =
            Noise { read: noise.read / (window.readings() as f32).sqrt(), shot: noise.shot / window.readings() as f32 };
        Ok(Device { sensor, noise, psf, response, margin, guide, guide_weights, dark: dark.map(Arc::new), white })
    }
}

/// Weights of a colour guide's channels, of sum 1.
fn normalized(weights: [f32; 3]) -> Result<[f32; 3], DeviceError> {
    let sum: f32 = weights.iter().sum();
    if !(weights.iter().all(|weight| (0.0..=f32::MAX).contains(weight)) && sum > 0.0 && sum.is_finite()) {
        return Err(DeviceError::GuideWeights { found: weights });
    }
    Ok(weights.map(|weight| weight / sum))
}

/// The PSF at the working size, from one of the camera's planes or of the working size.
fn reduced_psf(psf: Stack<f32>, window: &Window, channels: usize) -> Result<Psf, DeviceError> {
    let (found, working) = (psf.size(), window.working());
    if found == working || window.is_whole() {
        return Ok(Psf::new(psf, working, channels)?);
    }
    check_size(Map::Psf, found, window)?;
    // checked as it is given: means of blocks hide a clipped peak
    let count = psf.count();
    let full = Psf::new(psf, window.frame(), channels)?;
    let planes: Vec<f32> = (0..count).flat_map(|c| full.channel(c).iter().copied()).collect();
    let planes = Stack::from_vec(count, window.frame(), planes).map_err(|_| DeviceError::NoPsf)?;
    Ok(Psf::new(window.psf(&planes), working, channels)?)
}

/// The response at the working size. A measured mask is one of the camera's planes or of the working size.
///
/// # Errors
/// [`DeviceError::MapSize`] and those of [`Mask::binned`].
pub fn reduced_response(mask: Mask, window: &Window) -> Result<Response, DeviceError> {
    match &mask {
        Mask::Measured { transmission, .. } if !window.is_whole() => {
            check_size(Map::Mask, transmission.size(), window)?;
        }
        _ => {}
    }
    Ok(mask.binned(window)?)
}

/// Refuses a map that has neither the size of the camera's frame nor the working size.
fn check_size(map: Map, found: Size, window: &Window) -> Result<(), DeviceError> {
    if [window.frame(), window.working()].contains(&found) {
        return Ok(());
    }
    Err(DeviceError::MapSize { map, found, window: *window })
}

/// Refuses a dark frame that is not the sensor's.
///
/// # Errors
/// [`DeviceError::MapSize`], [`DeviceError::DarkShape`], [`DeviceError::DarkValue`].
pub fn check_dark(dark: &Stack<f32>, sensor: &Sensor) -> Result<(), DeviceError> {
    let Sensor { size, window, channels, saturation, .. } = *sensor;
    if !window.is_whole() {
        check_size(Map::Dark, dark.size(), &window)?;
    }
    if ![size, window.frame()].contains(&dark.size()) || ![1, channels].contains(&dark.count()) {
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
            (begun().crop([2, 0], SIZE), "crop of 8×8 pixels at (2, 0)"),
            (begun().bin(3), "bin = 3 in a crop of 8×8 pixels, allowed: 1, 2, 4, 8"),
            (Device::builder(Size::new(5000, 4)).psf(psf()), "sensor of 5000×4 pixels"),
            (
                Device::builder(Size::new(16, 16)).bin(4).psf(psf()),
                "psf of 8×8 pixels, allowed: 16×16 (the camera's frame) or 4×4",
            ),
            (begun().bin(2).dark(dark(Size::new(2, 2), 0.0)), "dark frame of 2×2 pixels, allowed: 8×8"),
            (begun().channels(2), "2 channels, allowed: 1 or 3"),
            (begun().levels(100.0, 100.0), "black level 100, saturation 100"),
            (begun().noise(f32::NAN, 0.0), "read noise NaN"),
            (begun().white([1.0, 0.0, 1.0]), "white balance [1.0, 0.0, 1.0]"),
            (begun().guide(Homography([0.0; 9])), "non-zero determinant"),
            (begun().guide_weights([0.5, -0.1, 0.6]), "guide weights [0.5, -0.1, 0.6]"),
            (begun().guide_weights([0.0; 3]), "guide weights [0.0, 0.0, 0.0]"),
            (begun().mask(Mask::stripes(&[0.0, 45.0], 6)), "angles"),
            (begun().dark(dark(Size::new(4, 8), 0.0)), "1 plane(s) of 4×8, expected 1 of 8×8"),
            (begun().dark(dark(SIZE, 65535.0)), "sample 0 is 65535"),
        ] {
            let message = refusal(builder);
            assert!(message.contains(expected), "{message:?} lacks {expected:?}");
        }
    }
}
