//! `calibration.toml` as written, before validation.

use serde::Deserialize;

use super::CameraId;
use crate::config::{Checker, Spanned};
use stokescope_core::device::{Homography, MAX_FRAME_SIDE, MAX_SIDE, Noise, Sensor};
use stokescope_core::image::{Size, Window, WindowError};
use stokescope_core::optics::{MaskError, Mosaic};
use stokescope_core::polarization::Angle;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Bundle {
    pub(super) version: Spanned<i64>,
    pub(super) name: String,
    /// Number of calibration steps taken; information for users.
    #[allow(dead_code, reason = "accepted, not used")]
    revision: Option<i64>,
    pub(super) camera: Option<CameraTable>,
    pub(super) sensor: Option<SensorTable>,
    pub(super) noise: Option<NoiseTable>,
    pub(super) psf: Option<ArrayFile>,
    pub(super) mask: Option<Mask>,
    #[serde(default)]
    pub(super) field: Field,
    #[serde(default)]
    pub(super) guide: Guide,
    pub(super) dark: Option<ArrayFile>,
    #[serde(default)]
    pub(super) white: White,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct CameraTable {
    name: String,
    format: String,
    width: usize,
    height: usize,
}

impl From<CameraTable> for CameraId {
    fn from(table: CameraTable) -> Self {
        let CameraTable { name, format, width, height } = table;
        Self { name, format, size: Size::new(width, height) }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SensorTable {
    width: Spanned<i64>,
    height: Spanned<i64>,
    channels: Spanned<i64>,
    crop: Option<Spanned<Vec<i64>>>,
    bin: Option<Spanned<i64>>,
    orientation: Option<Spanned<i64>>,
    bit_depth: Option<Spanned<i64>>,
    black_level: Option<Spanned<f64>>,
    saturation: Option<Spanned<f64>>,
}

impl SensorTable {
    pub(super) fn validate(&self, check: &mut Checker<'_>) -> Sensor {
        let mut side = |key: &str, v: &Spanned<i64>| {
            let ok = (1..=MAX_FRAME_SIDE as i64).contains(v.get_ref());
            check.check(key, v, ok, &format!("1 to {MAX_FRAME_SIDE}")).clamp(1, MAX_FRAME_SIDE as i64) as usize
        };
        let frame = Size::new(side("sensor.width", &self.width), side("sensor.height", &self.height));
        let window = self.window(frame, check);
        let ok = [1, 3].contains(self.channels.get_ref());
        let channels = check.check("sensor.channels", &self.channels, ok, "1 or 3") as usize;
        let bits = self.bit_depth.as_ref().map_or(16, |b| {
            check.check("sensor.bit_depth", b, [8, 10, 12, 14, 16].contains(b.get_ref()), "8, 10, 12, 14 or 16")
        });
        let full_scale = f64::from((1u32 << bits.clamp(1, 16)) - 1);
        let black_level = self.black_level.as_ref().map_or(0.0, |b| {
            let ok = (0.0..full_scale).contains(b.get_ref());
            check.check("sensor.black_level", b, ok, &format!("0 to below {full_scale} counts"))
        });
        let saturation = self.saturation.as_ref().map_or(full_scale, |s| {
            let ok = *s.get_ref() > black_level && *s.get_ref() <= full_scale;
            check.check(
                "sensor.saturation",
                s,
                ok,
                &format!("above the black level {black_level}, to {full_scale} counts"),
            )
        });
        let (black_level, saturation) = (black_level as f32, saturation as f32);
        Sensor { size: window.working(), window, channels, black_level, saturation }
    }

    /// The used part of frames of size `frame` and its binning.
    fn window(&self, frame: Size, check: &mut Checker<'_>) -> Window {
        let whole = Window::whole(frame);
        let (key, place) = match (&self.crop, &self.bin) {
            (Some(crop), _) => ("sensor.crop", crop.span().start),
            (None, Some(bin)) => ("sensor.bin", bin.span().start),
            (None, None) => ("sensor.width", self.width.span().start),
        };
        let numbers = self.crop.as_ref().map(|crop| {
            let numbers = crop.get_ref().iter().map(|v| usize::try_from(*v)).collect::<Result<Vec<_>, _>>();
            numbers.ok().and_then(|numbers| <[usize; 4]>::try_from(numbers).ok())
        });
        let (first, size) = match numbers {
            None => ([0, 0], frame),
            Some(Some([x, y, width, height])) => ([x, y], Size::new(width, height)),
            Some(None) => {
                let found = format!("{:?}", self.crop.as_ref().map(Spanned::get_ref).unwrap_or(&Vec::new()));
                check.reject(key, Some(place), found, "[x, y, width, height], whole numbers that are not negative");
                return whole;
            }
        };
        let bin = self.bin.as_ref().map_or(1, |bin| usize::try_from(*bin.get_ref()).unwrap_or(0));
        match Window::new(frame, first, size, bin) {
            Ok(window) if window.working().width.max(window.working().height) <= MAX_SIDE => window,
            Ok(window) => {
                let allowed = format!("a crop/bin of at most {MAX_SIDE} pixels each way: crop less or bin more");
                check.reject(key, Some(place), format!("{} pixels to work with", window.working()), &allowed);
                whole
            }
            Err(WindowError::Crop { .. }) => {
                let found = format!("[{}, {}, {}, {}]", first[0], first[1], size.width, size.height);
                let allowed = format!("a part of the {frame} pixels of sensor.width and sensor.height");
                check.reject("sensor.crop", Some(place), found, &allowed);
                whole
            }
            // blocks of a mosaic's cells are checked where the mask is known
            Err(WindowError::Bin { .. } | WindowError::Cells { .. }) => {
                let allowed = format!("{}, of the {size} pixels of the crop", WindowError::divisors(size));
                let place = self.bin.as_ref().map_or(place, |bin| bin.span().start);
                check.reject(
                    "sensor.bin",
                    Some(place),
                    self.bin.as_ref().map_or(1, |b| *b.get_ref()).to_string(),
                    &allowed,
                );
                whole
            }
        }
    }

    /// Rotation of the mounted sensor in degrees.
    pub(super) fn orientation(&self, check: &mut Checker<'_>) -> Option<u32> {
        let typed = self.orientation.as_ref()?;
        let ok = [0, 180].contains(typed.get_ref());
        Some(check.check("sensor.orientation", typed, ok, "0 or 180 degrees") as u32)
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct NoiseTable {
    read: Spanned<f64>,
    shot: Option<Spanned<f64>>,
}

impl NoiseTable {
    pub(super) fn validate(&self, check: &mut Checker<'_>) -> Noise {
        let mut fraction = |key: &str, v: &Spanned<f64>| {
            check.check(key, v, (0.0..=1.0).contains(v.get_ref()), "0 to 1, a fraction of full scale") as f32
        };
        let read = fraction("noise.read", &self.read);
        Noise { read, shot: self.shot.as_ref().map_or(0.0, |s| fraction("noise.shot", s)) }
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Field {
    margin: Option<Spanned<i64>>,
}

impl Field {
    /// Pixels around the frame from which light may reach the sensor; none for the reach of the PSF.
    pub(super) fn validate(&self, check: &mut Checker<'_>) -> Option<usize> {
        let margin = self.margin.as_ref()?;
        let ok = (0..=MAX_SIDE as i64).contains(margin.get_ref());
        Some(check.check("field.margin", margin, ok, &format!("0 (a field stop) to {MAX_SIDE} pixels")) as usize)
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct White {
    gains: Option<Spanned<Vec<f64>>>,
}

impl White {
    pub(super) fn validate(&self, channels: usize, check: &mut Checker<'_>) -> [f32; 3] {
        let Some(typed) = &self.gains else { return [1.0; 3] };
        let gains = typed.get_ref();
        if channels != 3 || gains.len() != 3 || !gains.iter().all(|g| (0.01..=100.0).contains(g)) {
            let allowed = "3 numbers from 0.01 to 100 (red, green, blue), on a sensor of 3 channels";
            check.reject("white.gains", Some(typed.span().start), format!("{gains:?}"), allowed);
            return [1.0; 3];
        }
        [gains[0] as f32, gains[1] as f32, gains[2] as f32]
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ArrayFile {
    pub(super) file: String,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum MaskKind {
    Stripes,
    Measured,
    Mosaic,
    None,
}

/// Table `[mask]` of all kinds; a tagged enum would lose the line numbers.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Mask {
    pub(super) kind: Spanned<MaskKind>,
    angles_deg: Option<Spanned<Vec<f64>>>,
    stripes: Option<Spanned<i64>>,
    extinction_ratio: Option<Spanned<f64>>,
    layout: Option<Spanned<Vec<Vec<f64>>>>,
    file: Option<Spanned<String>>,
}

/// Validated description of a mask.
#[derive(Debug, PartialEq)]
pub(super) enum MaskSpec {
    Stripes { angles: Vec<Angle>, stripes: usize, extinction_ratio: f64 },
    Measured { angles: Vec<Angle>, file: String },
    Mosaic { layout: Mosaic, extinction_ratio: f64 },
    None,
}

impl MaskSpec {
    /// Name of the array file, if the mask has one.
    pub(super) fn file(&self) -> Option<&str> {
        match self {
            Self::Measured { file, .. } => Some(file),
            Self::Stripes { .. } | Self::Mosaic { .. } | Self::None => None,
        }
    }
}

impl Mask {
    pub(super) fn validate(self, check: &mut Checker<'_>) -> MaskSpec {
        let kind = *self.kind.get_ref();
        let at = self.kind.span().start;
        // (key, its place in the text, whether this kind requires it, whether this kind permits it)
        let listed = matches!(kind, MaskKind::Stripes | MaskKind::Measured);
        let described = matches!(kind, MaskKind::Stripes | MaskKind::Mosaic);
        for (key, span, required, permitted) in [
            ("angles_deg", self.angles_deg.as_ref().map(Spanned::span), listed, listed),
            ("stripes", self.stripes.as_ref().map(Spanned::span), kind == MaskKind::Stripes, kind == MaskKind::Stripes),
            ("extinction_ratio", self.extinction_ratio.as_ref().map(Spanned::span), false, described),
            ("layout", self.layout.as_ref().map(Spanned::span), kind == MaskKind::Mosaic, kind == MaskKind::Mosaic),
            ("file", self.file.as_ref().map(Spanned::span), kind == MaskKind::Measured, kind == MaskKind::Measured),
        ] {
            let key = format!("mask.{key}");
            match span {
                None if required => {
                    check.reject(&key, Some(at), "missing".into(), &format!("a value, for kind {kind:?}"));
                }
                Some(span) if !permitted => {
                    check.reject(&key, Some(span.start), "given".into(), &format!("no value, for kind {kind:?}"));
                }
                _ => {}
            }
        }
        let stripes = self.stripes.as_ref().map_or(0, |s| {
            let ok = (1..=MAX_SIDE as i64).contains(s.get_ref());
            check.check("mask.stripes", s, ok, &format!("1 to {MAX_SIDE}")) as usize
        });
        let extinction_ratio = self
            .extinction_ratio
            .as_ref()
            .map_or(f64::INFINITY, |ratio| check.check("mask.extinction_ratio", ratio, *ratio.get_ref() > 1.0, "> 1"));
        let layout = self.layout.as_ref().and_then(|layout| {
            let refused = |e: MaskError| {
                check.reject(
                    "mask.layout",
                    Some(layout.span().start),
                    format!("{:?}", layout.get_ref()),
                    &e.to_string(),
                );
            };
            Mosaic::new(layout.get_ref()).map_err(refused).ok()
        });
        let degrees = self.angles_deg.map(Spanned::into_inner).unwrap_or_default();
        let angles = degrees.into_iter().map(Angle::from_degrees).collect();
        match kind {
            MaskKind::Stripes => MaskSpec::Stripes { angles, stripes, extinction_ratio },
            MaskKind::Measured => {
                MaskSpec::Measured { angles, file: self.file.map(Spanned::into_inner).unwrap_or_default() }
            }
            // without a layout the description was refused
            MaskKind::Mosaic => layout.map_or(MaskSpec::None, |layout| MaskSpec::Mosaic { layout, extinction_ratio }),
            MaskKind::None => MaskSpec::None,
        }
    }
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Guide {
    homography: Option<Spanned<Vec<f64>>>,
    weights: Option<Spanned<Vec<f32>>>,
}

impl Guide {
    /// Weights of a colour guide's channels beside a mono sensor.
    pub(super) fn weights(&self, check: &mut Checker<'_>) -> Option<[f32; 3]> {
        let typed = self.weights.as_ref()?;
        let usable = |w: &[f32; 3]| w.iter().all(|v| v.is_finite() && *v >= 0.0) && w.iter().sum::<f32>() > 0.0;
        let found = <[f32; 3]>::try_from(typed.get_ref().as_slice()).ok().filter(usable);
        if found.is_none() {
            let allowed = "red, green and blue: 3 numbers from 0 upwards, not all of them 0";
            check.reject("guide.weights", Some(typed.span().start), format!("{:?}", typed.get_ref()), allowed);
        }
        found
    }

    pub(super) fn homography(&self, check: &mut Checker<'_>) -> Option<Homography> {
        let typed = self.homography.as_ref()?;
        let allowed = "9 finite numbers, row-major, with a determinant that is not 0";
        let usable = |h: &[f64; 9]| {
            let det = h[0] * (h[4] * h[8] - h[5] * h[7]) - h[1] * (h[3] * h[8] - h[5] * h[6])
                + h[2] * (h[3] * h[7] - h[4] * h[6]);
            h.iter().all(|v| v.is_finite()) && det.abs() > 1e-12
        };
        let found = <[f64; 9]>::try_from(typed.get_ref().as_slice()).ok().filter(usable);
        if found.is_none() {
            check.reject("guide.homography", Some(typed.span().start), format!("{:?}", typed.get_ref()), allowed);
        }
        found.map(Homography)
    }
}
