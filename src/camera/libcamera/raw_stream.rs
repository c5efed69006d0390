//! Choice of a raw stream: which mode of the sensor, in which layout, and whether the answer of libcamera keeps every reading.
//!
//! libcamera lists raw formats by the mode of the sensor, packed as on the bus. What it delivers depends on the pipeline handler: `rpi/vc4`
//! (Raspberry Pi 0 to 4) writes packed or low-aligned samples as asked; `rpi/pisp` (Raspberry Pi 5) writes 16-bit left-aligned samples, and
//! turns everything else into these or into `PISP_COMP1`, which loses up to the low four bits of a sample. So the mode is chosen by
//! bit depth and size of the sensor's output, and the layout by the pipeline handler. A flip in the sensor permutes the Bayer order;
//! the order that comes back is the true one. Source: `platformValidate` of both pipeline handlers in libcamera.

use std::fmt;
use std::time::Duration;

use super::formats::{driver_name, formats_of};
use crate::camera::Levels;
use stokescope_core::frame::{PixelFormat, Samples};
use stokescope_core::image::Size;

/// How a pipeline handler writes raw samples into memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pipeline {
    /// As asked: `rpi/vc4` with the receiver Unicam, and the handlers of other makers.
    Unicam,
    /// As 16-bit left-aligned samples, or compressed with loss: `rpi/pisp`.
    Pisp,
}

impl Pipeline {
    /// Recognizes a pipeline handler by its answer to a raw format that it lists itself; both are names of formats in libcamera.
    pub(super) fn of(listed: &str, answered: &str) -> Self {
        let depth = |name: &str| formats_of(name).find_map(PixelFormat::bits);
        let widened = depth(listed) != Some(16) && depth(answered) == Some(16);
        if widened || is_compressed(answered) { Self::Pisp } else { Self::Unicam }
    }
}

/// A raw format that libcamera lists, with the sizes of its modes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Listed {
    pub(super) name: String,
    pub(super) sizes: Vec<Size>,
}

/// Wishes for a raw stream; what is `None` is chosen here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Wanted {
    /// Format of the delivered frames. Its Bayer order is not binding, because flips change it.
    pub(super) format: Option<PixelFormat>,
    /// Bit depth of the sensor's mode.
    pub(super) bits: Option<u32>,
    /// Size of the sensor's mode.
    pub(super) size: Option<Size>,
    /// Rotation of the picture in degrees.
    pub(super) orientation: Option<u32>,
}

/// A configuration to ask libcamera for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ask {
    pipeline: Pipeline,
    /// Pixel format of the stream.
    pub(super) format: PixelFormat,
    /// Bit depth of the sensor's output.
    pub(super) bits: u32,
    /// Size of the sensor's output and of the stream.
    pub(super) size: Size,
    /// Rotation of the picture in degrees, 0 or 180; `None` leaves libcamera's default.
    pub(super) orientation: Option<u32>,
}

/// The configuration that libcamera makes of the one asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Answer {
    /// Whether the configuration can be used.
    pub(super) valid: bool,
    /// Pixel format of the stream.
    pub(super) format: String,
    /// Size of the stream.
    pub(super) size: Size,
    /// Rotation of the picture in degrees; `None` for a mirrored or transposed one.
    pub(super) orientation: Option<u32>,
}

/// A raw stream without loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Delivered {
    /// Format of the frames, with the Bayer order that the sensor has after its flips.
    pub(super) format: PixelFormat,
    /// Size of the frames.
    pub(super) size: Size,
    /// Bit depth of the sensor's mode.
    pub(super) bits: u32,
}

/// Reason why there is no lossless raw stream as requested.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// No mode of the sensor matches.
    NoMode,
    /// The pipeline handler does not deliver this layout; `remedy` is what to write.
    Layout { asked: PixelFormat, remedy: PixelFormat, bits: u32 },
    /// A sensor turns its picture by 0 or 180 degrees.
    Orientation { asked: u32 },
    /// The samples would be compressed with loss; `remedy` is what to write, if anything helps.
    Lossy { answered: String, remedy: Option<PixelFormat> },
    /// libcamera adjusts what was asked for.
    Adjusted { asked: String, answered: String },
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoMode => f.write_str("the sensor has no such mode"),
            Self::Layout { asked, remedy, bits } => write!(
                f,
                "this pipeline handler of libcamera does not deliver {} unaltered: use format = \"{}\" and bits = {bits}, or leave \
                 format out",
                asked.name(),
                remedy.name()
            ),
            Self::Orientation { asked } => {
                write!(f, "orientation = {asked}, allowed: 0 or 180 degrees, which a sensor can read out")
            }
            Self::Lossy { answered, remedy } => {
                write!(f, "libcamera would deliver {answered}, which is compressed with loss: ")?;
                match remedy {
                    Some(format) => write!(f, "use format = \"{}\", or leave format out", format.name()),
                    None => f.write_str("update libcamera, because a lossless format was asked for"),
                }
            }
            Self::Adjusted { asked, answered } => write!(f, "libcamera delivers {answered} instead of {asked}"),
        }
    }
}

/// Whether a format of this name is compressed with loss: `BGGR_PISP_COMP1`, and `BGGR16_PISP_COMP1` in older versions.
fn is_compressed(name: &str) -> bool {
    name.contains("_PISP_COMP")
}

fn samples_of(format: PixelFormat) -> Option<Samples> {
    match format {
        PixelFormat::Mono(samples) | PixelFormat::Bayer(_, samples) => Some(samples),
        _ => None,
    }
}

/// This mosaic with other samples.
fn with_samples(format: PixelFormat, samples: Samples) -> PixelFormat {
    match format {
        PixelFormat::Bayer(order, _) => PixelFormat::Bayer(order, samples),
        _ => PixelFormat::Mono(samples),
    }
}

/// The modes of the sensor, each as it is asked for by default: as listed, or as 16-bit samples from PiSP. Formats that this program
/// cannot read are left out.
pub(super) fn every(listed: &[Listed], pipeline: Pipeline) -> Vec<Ask> {
    let modes = listed.iter().flat_map(|Listed { name, sizes }| {
        let known = formats_of(name).find_map(|format| Some((format, samples_of(format)?.bits()?)));
        sizes.iter().filter_map(move |size| known.map(|(format, bits)| (format, bits, *size)))
    });
    let ask = |(format, bits, size)| {
        let format = if pipeline == Pipeline::Pisp { with_samples(format, Samples::U16) } else { format };
        Ask { pipeline, format, bits, size, orientation: None }
    };
    modes.map(ask).collect()
}

/// Chooses the mode and layout to ask for: of the modes that match, the deepest, then the largest one.
///
/// # Errors
/// [`Refusal`] when no mode matches, or the pipeline handler does not deliver the layout that is wanted.
pub(super) fn choose(listed: &[Listed], pipeline: Pipeline, wanted: &Wanted) -> Result<Ask, Refusal> {
    if let Some(asked) = wanted.orientation.filter(|degrees| ![0, 180].contains(degrees)) {
        return Err(Refusal::Orientation { asked });
    }
    let samples = wanted.format.and_then(samples_of);
    let depth = |ask: &Ask| {
        // 16-bit samples hold the readings of any mode; others have the depth of theirs
        let own = samples.and_then(Samples::bits).is_none_or(|bits| bits == 16 || bits == ask.bits);
        own && wanted.bits.is_none_or(|bits| bits == ask.bits)
    };
    let mosaic = |ask: &Ask| {
        wanted
            .format
            .is_none_or(|format| matches!(format, PixelFormat::Mono(_)) == matches!(ask.format, PixelFormat::Mono(_)))
    };
    let fits = |ask: &Ask| depth(ask) && mosaic(ask) && wanted.size.is_none_or(|size| size == ask.size);
    let modes = every(listed, pipeline).into_iter().filter(fits);
    let mut ask = modes.max_by_key(|ask| (ask.bits, ask.size.pixels())).ok_or(Refusal::NoMode)?;
    ask.orientation = wanted.orientation;
    if let (Some(asked), Some(samples)) = (wanted.format, samples) {
        let delivers = match pipeline {
            Pipeline::Pisp => samples == Samples::U16,
            Pipeline::Unicam => samples.bits() == Some(ask.bits),
        };
        if !delivers {
            return Err(Refusal::Layout { asked, remedy: ask.format, bits: ask.bits });
        }
        ask.format = with_samples(ask.format, samples);
    }
    Ok(ask)
}

/// Judges what libcamera makes of `ask`: the frames that it will deliver, or why they must not be used.
///
/// # Errors
/// [`Refusal`] when samples would lose bits, or size, mosaic or orientation differ. Another Bayer order is no error.
pub(super) fn judge(ask: &Ask, answer: &Answer) -> Result<Delivered, Refusal> {
    if !answer.valid {
        return Err(Refusal::NoMode);
    }
    if is_compressed(&answer.format) {
        let remedy = Some(with_samples(ask.format, Samples::U16)).filter(|remedy| *remedy != ask.format);
        return Err(Refusal::Lossy { answered: answer.format.clone(), remedy });
    }
    let turned = ask.orientation.is_some() && ask.orientation != answer.orientation;
    let lossless = |found: &PixelFormat| {
        let same_mosaic = matches!(found, PixelFormat::Mono(_)) == matches!(ask.format, PixelFormat::Mono(_));
        let depth = samples_of(*found).and_then(Samples::bits);
        let whole = depth == ask.format.bits() || (ask.pipeline == Pipeline::Pisp && depth == Some(16));
        same_mosaic && whole
    };
    let found = formats_of(&answer.format).find(lossless).filter(|_| !turned && answer.size == ask.size);
    let format = found.ok_or_else(|| {
        let words = |format: &str, size: Size, orientation: Option<u32>| {
            let turned = orientation.map_or_else(String::new, |degrees| format!(" turned by {degrees}°"));
            format!("{format} {size}{turned}")
        };
        Refusal::Adjusted {
            asked: words(&driver_name(ask.format).unwrap_or_default(), ask.size, ask.orientation),
            answered: words(&answer.format, answer.size, answer.orientation),
        }
    })?;
    Ok(Delivered { format, size: ask.size, bits: ask.bits })
}

impl Delivered {
    /// Factor from libcamera's 16-bit scale of black levels to counts of the frames.
    fn per_sixteen_bits(&self) -> f32 {
        1.0 / (1u32 << (16 - self.format.bits().unwrap_or(16))) as f32
    }

    /// Counts of the frames without light and of a full reading. Left-aligned samples of 12 bits are full at 65520.
    pub(super) fn levels(&self, model: &str) -> Levels {
        let unused = self.format.bits().unwrap_or(self.bits).saturating_sub(self.bits);
        let white = (((1u32 << self.bits) - 1) << unused) as f32;
        Levels { black: known_black_level(model).map(|black| black * self.per_sixteen_bits()), white }
    }

    /// Black level in counts of the frames, from the control `SensorBlackLevels`: four values on a 16-bit scale.
    pub(super) fn reported_black_level(&self, levels: [i32; 4]) -> f32 {
        levels.iter().map(|level| *level as f32).sum::<f32>() / 4.0 * self.per_sixteen_bits()
    }
}

/// Time from the read-out of the first row to that of the last one, of sensors with a rolling shutter whose drivers' line times are known.
pub(super) fn readout(model: &str, size: Size) -> Option<Duration> {
    // from the drivers in the kernel: length of a line over the pixel rate
    let line_us = match (model.split('_').next()?, size.width, size.height) {
        ("imx219", 1640 | 3280, _) => 18.9,
        ("imx708", 2304, 1296) => 13.4,
        ("imx290" | "imx327" | "imx462", 1920, 1080) => 14.8,
        _ => return None,
    };
    Some(Duration::from_secs_f64(1e-6 * line_us * size.height as f64))
}

/// Black level of a sensor on a 16-bit scale, as in the tuning files of libcamera's Raspberry Pi handlers.
fn known_black_level(model: &str) -> Option<f32> {
    // variants of a module follow an underscore: imx708_wide
    match model.split('_').next()? {
        "imx219" | "imx477" | "imx500" | "imx519" | "imx708" | "ov9281" => Some(4096.0),
        "imx290" | "imx296" | "imx327" | "imx462" => Some(3840.0),
        "ov5647" => Some(1024.0),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
