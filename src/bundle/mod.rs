//! Device bundles: a folder with `calibration.toml` and array files is read and validated into a [`Bundle`].
//!
//! Arrays: psf `[H, W]` or `[C, H, W]`, any positive scale; mask `[P, H, W]`, transmission; dark `[H, W]` or `[C, H, W]`,
//! counts; each of the camera's frame, or of the working size crop/bin. A [`Draft`] is an incomplete bundle that calibration steps fill in.
//!
//! ```
//! # let dir = tempfile::tempdir().unwrap();
//! # use stokescope::{files::write_npy, bundle::Bundle};
//! write_npy(&dir.path().join("psf.npy"), &[8, 8], &(0..64).map(|i| (i % 7) as f32).collect::<Vec<_>>()).unwrap();
//! std::fs::write(dir.path().join("calibration.toml"), r#"
//!     version = 1
//!     name = "bench"
//!     sensor = { width = 8, height = 8, channels = 1 }
//!     noise = { read = 0.002 }
//!     psf = { file = "psf.npy" }
//!     mask = { kind = "stripes", angles_deg = [0, 45, 90], stripes = 6 }
//! "#).unwrap();
//! let bundle = Bundle::load(dir.path()).unwrap();
//! assert_eq!(bundle.response.angles().len(), 3);
//! ```

mod digest;
mod draft;
mod raw;
mod results;
mod simulated;

use std::path::{Path, PathBuf};

#[cfg(feature = "program")]
pub(crate) use draft::DESCRIPTION;
pub use draft::{Draft, DraftError, Partial};
pub use simulated::write_simulated;
use stokescope_core::device::{Device, DeviceError, Map, Noise};

use crate::config::{self, Checker, ConfigError};
use crate::files::{self, ArrayError};
use raw::MaskSpec;
use stokescope_core::image::{Size, Stack};
use stokescope_core::optics::Mask;

/// A device as described by the files of a folder. Dereferences to its [`Device`].
#[derive(Clone, Debug)]
pub struct Bundle {
    /// Name of the bundle.
    pub name: String,
    /// Folder of the bundle.
    pub dir: PathBuf,
    /// Device that the bundle describes.
    pub device: Device,
    /// Camera that the bundle belongs to; `None` accepts any camera with frames of this size.
    pub camera: Option<CameraId>,
    /// Rotation of the mounted sensor in degrees, 0 or 180, for cameras that can turn their frames; `None` takes the camera's default.
    pub orientation: Option<u32>,
    /// SHA-256 over the description in canonical form and the array files, as hexadecimal digits.
    pub digest: String,
}

impl std::ops::Deref for Bundle {
    type Target = Device;

    fn deref(&self) -> &Device {
        &self.device
    }
}

/// Identity of the camera and mode that a bundle belongs to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CameraId {
    /// Name of the camera.
    pub name: String,
    /// Pixel format of the frames.
    pub format: String,
    /// Size of the frames in sensor pixels.
    pub size: Size,
}

impl std::fmt::Display for CameraId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}, {}, {} pixels", self.name, self.format, self.size)
    }
}

impl CameraId {
    /// Checks that `found` is this camera; `dir` is the folder of the bundle.
    ///
    /// # Errors
    /// [`BundleError::Camera`] with both identities.
    pub fn check(&self, found: &Self, dir: &Path) -> Result<(), BundleError> {
        if self == found {
            return Ok(());
        }
        let (own, found) = (Box::new(self.clone()), Box::new(found.clone()));
        Err(BundleError::Camera { dir: dir.to_path_buf(), own, found })
    }
}

/// Why a bundle cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum BundleError {
    /// `calibration.toml` is not usable.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// An array file cannot be read.
    #[error(transparent)]
    Array(#[from] ArrayError),
    /// The files do not describe a valid device.
    #[error("{}: {source}", file.display())]
    Device {
        /// The array file, or `calibration.toml`.
        file: PathBuf,
        /// Reason.
        source: Box<DeviceError>,
    },
    /// An array has the wrong shape.
    #[error("{}: shape {found:?}, expected {expected}", file.display())]
    Shape {
        /// The array file.
        file: PathBuf,
        /// Shape found.
        found: Vec<usize>,
        /// Expected shape, in words.
        expected: String,
    },
    /// A board uses its frames otherwise than the bundle that it calibrates.
    #[error("{}: [sensor] says {own}, and that of the board {found}: make them the same, or calibrate a new bundle", dir.display())]
    Readout {
        /// Folder of the bundle.
        dir: PathBuf,
        /// Part of the frame and orientation of the bundle.
        own: String,
        /// Those of the board.
        found: String,
    },
    /// The bundle belongs to another camera or mode.
    #[error("{}: belongs to camera {own}; found {found}: use a bundle calibrated with this camera", dir.display())]
    Camera {
        /// Folder of the bundle.
        dir: PathBuf,
        /// Camera of the bundle.
        own: Box<CameraId>,
        /// Camera in use.
        found: Box<CameraId>,
    },
}

impl Bundle {
    /// Reads and checks the bundle in `dir`.
    ///
    /// # Errors
    /// [`BundleError`] with file, place, value found and allowed values.
    pub fn load(dir: &Path) -> Result<Self, BundleError> {
        let path = dir.join(draft::DESCRIPTION);
        Self::parse(dir, &path, &config::read(&path)?)
    }

    /// Rotation of the mounted sensor that the bundle in `dir` is for, in degrees: the part of a bundle, complete or not, that a camera has to
    /// know before it is opened. `None` without a bundle, or where it leaves the orientation to the driver.
    ///
    /// # Errors
    /// [`BundleError`] for a description that cannot be read.
    pub fn orientation_in(dir: &Path) -> Result<Option<u32>, BundleError> {
        let path = dir.join(draft::DESCRIPTION);
        let text = match config::read(&path) {
            Err(ConfigError::Missing(_)) => return Ok(None),
            text => text?,
        };
        let raw: raw::Bundle = config::parse(&path, &text)?;
        let mut check = Checker::new(&path, &text);
        let orientation = raw.sensor.and_then(|sensor| sensor.orientation(&mut check));
        check.finish()?;
        Ok(orientation)
    }

    /// Checks the bundle in `dir` whose description at `path` is `text`.
    fn parse(dir: &Path, path: &Path, text: &str) -> Result<Self, BundleError> {
        let raw: raw::Bundle = config::parse(path, text)?;
        let mut check = Checker::new(path, text);
        reject_missing(&raw, &mut check);
        let (Some(sensor), Some(psf), Some(mask)) = (raw.sensor, raw.psf, raw.mask) else {
            return Err(check.finish().err().unwrap_or_else(|| ConfigError::Missing(path.to_path_buf())).into());
        };
        let orientation = sensor.orientation(&mut check);
        let sensor = sensor.validate(&mut check);
        let noise = raw.noise.map(|noise| noise.validate(&mut check)).unwrap_or_else(|| {
            let Noise { read, shot } = Noise::TYPICAL;
            let place = path.display();
            tracing::warn!(
                "{place}: no [noise]: it is measured in every frame, and read = {read} and shot = {shot} are assumed where it cannot \
                 be; `stokescope calibrate dark` measures it"
            );
            Noise::TYPICAL
        });
        let guide = raw.guide.homography(&mut check);
        let guide_weights = raw.guide.weights(&mut check);
        let margin = raw.field.validate(&mut check);
        check.check("version", &raw.version, *raw.version.get_ref() == 1, "1");
        let mask = mask.validate(&mut check);
        let white = raw.white.validate(sensor.channels, &mut check);
        check.finish()?;

        let (psf_file, mask_file) = (dir.join(&psf.file), mask.file().map(|file| dir.join(file)));
        let dark_file = raw.dark.map(|dark| dir.join(dark.file));
        let frame = sensor.window.frame();
        let mut device = Device::builder(frame)
            .crop(sensor.window.first(), sensor.window.size())
            .bin(sensor.window.bin())
            .channels(sensor.channels)
            .levels(sensor.black_level, sensor.saturation)
            .noise(noise.read, noise.shot)
            .white(white)
            .psf(planes(&psf_file, frame)?)
            .mask(load_mask(dir, mask, frame)?);
        if let Some(guide) = guide {
            device = device.guide(guide);
        }
        if let Some(weights) = guide_weights {
            device = device.guide_weights(weights);
        }
        if let Some(margin) = margin {
            device = device.margin(margin);
        }
        if let Some(file) = &dark_file {
            device = device.dark(planes(file, frame)?);
        }
        let files = [Some(psf_file), mask_file, dark_file];
        let device = device.build().map_err(|source| BundleError::of_device(path, &files, source))?;
        let digest = content_digest(path, text, files.into_iter().flatten())?;
        let camera = raw.camera.map(Into::into);
        Ok(Self { name: raw.name, dir: dir.to_path_buf(), device, camera, orientation, digest })
    }
}

/// Rejects a description without a table that calibration makes.
fn reject_missing(raw: &raw::Bundle, check: &mut Checker<'_>) {
    for (key, there, step) in [
        ("sensor", raw.sensor.is_some(), "dark"),
        ("psf", raw.psf.is_some(), "psf"),
        ("mask", raw.mask.is_some(), "mask"),
    ] {
        if !there {
            check.reject(key, None, "missing".to_owned(), &format!("made by `stokescope calibrate {step}`"));
        }
    }
}

impl BundleError {
    /// Error of a device that cannot be, with the file that is to blame: the PSF, the mask or the dark frame of `files`, or the description
    /// at `path`.
    fn of_device(path: &Path, [psf, mask, dark]: &[Option<PathBuf>; 3], source: DeviceError) -> Self {
        let file = match &source {
            DeviceError::Psf(_) | DeviceError::MapSize { map: Map::Psf, .. } => psf,
            DeviceError::Mask(_) | DeviceError::MapSize { map: Map::Mask, .. } => mask,
            DeviceError::MapSize { map: Map::Dark, .. }
            | DeviceError::DarkShape { .. }
            | DeviceError::DarkValue { .. } => dark,
            _ => &None,
        };
        Self::Device { file: file.clone().unwrap_or_else(|| path.to_path_buf()), source: source.into() }
    }
}

/// Digest of a bundle: its description in canonical form and its array files.
fn content_digest(path: &Path, text: &str, arrays: impl Iterator<Item = PathBuf>) -> Result<String, BundleError> {
    let mut parts = vec![config::parse::<toml::Table>(path, text)?.to_string().into_bytes()];
    for file in arrays {
        let read = files::read_bytes(&file, u64::MAX - 1);
        parts.push(read.map_err(|source| ArrayError::Io { path: file, source })?);
    }
    Ok(digest::of(parts.iter().map(Vec::as_slice)))
}

fn load_mask(dir: &Path, mask: MaskSpec, frame: Size) -> Result<Mask, BundleError> {
    Ok(match mask {
        MaskSpec::None => Mask::None,
        MaskSpec::Stripes { angles, stripes, extinction_ratio } => {
            Mask::Stripes { angles, count: stripes, extinction_ratio }
        }
        MaskSpec::Mosaic { layout, extinction_ratio } => Mask::Mosaic { layout, extinction_ratio },
        MaskSpec::Measured { angles, file } => Mask::Measured { angles, transmission: planes(&dir.join(file), frame)? },
    })
}

/// Most values of an array of a bundle for each pixel of the camera's frame: planes of the mask.
const MAX_PLANES: usize = 64;
/// Most bytes of one value and of the header of an array file.
const VALUE_BYTES: u64 = 8;
const HEADER_BYTES: u64 = 1 << 16;

/// Reads an array of shape `[H, W]` or `[C, H, W]` as planes. The camera's frame bounds the size of the file, before it is read.
fn planes(file: &Path, frame: Size) -> Result<Stack<f32>, BundleError> {
    let most = (frame.pixels() * MAX_PLANES) as u64 * VALUE_BYTES + HEADER_BYTES;
    // a file that is missing is reported by the reader
    let found = std::fs::metadata(file).map_or(0, |meta| meta.len());
    if found > most {
        let what = format!("{found} bytes, allowed: at most {most} for frames of {frame}");
        return Err(ArrayError::Io { path: file.to_path_buf(), source: std::io::Error::other(what) }.into());
    }
    let array = files::read_npy(file)?;
    let found = array.shape.clone();
    let (count, size) = match found[..] {
        [h, w] => (1, Size::new(w, h)),
        // as most image libraries hold colours: told apart from planes, of which there are few
        [h, w, 3] if h > 3 && w > 3 => {
            return Err(BundleError::Shape {
                file: file.to_path_buf(),
                found,
                expected: "[height, width] or [planes, height, width]; colours come first: numpy.moveaxis(array, 2, 0)"
                    .to_owned(),
            });
        }
        [c, h, w] => (c, Size::new(w, h)),
        _ => (0, Size::new(0, 0)),
    };
    Stack::from_vec(count, size, array.into_f32()).map_err(|_| BundleError::Shape {
        file: file.to_path_buf(),
        found,
        expected: "[height, width] or [planes, height, width]".to_owned(),
    })
}
