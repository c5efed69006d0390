//! A board file as it is typed.

use std::path::Path;

use serde::Deserialize;

use super::{Board, Bundle, CameraSpec, Fusion, MAX_QUEUE_FRAMES, Preview};
use crate::config::{Checker, Spanned};
use crate::frame::{FormatNameError, Mode, PixelFormat, Sync};
use crate::model::Precision;
use crate::optics::FftBackend;
use crate::plane::Size;

const MIB: i64 = 1 << 20;
/// Longest side of a frame, in pixels.
const MAX_SIDE: i64 = 16_384;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BoardFile {
    description: String,
    soc: String,
    memory: Memory,
    solver: SolverTable,
    #[serde(default)]
    fusion: FusionTable,
    cameras: Cameras,
    preview: PreviewTable,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Memory {
    limit_bytes: Spanned<i64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SolverTable {
    threads: Spanned<i64>,
    #[serde(default)]
    fft: FftBackend,
    iterations: Spanned<i64>,
    #[serde(default = "yes")]
    register: bool,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct FusionTable {
    model: Option<String>,
    #[serde(default)]
    precision: Precision,
}

fn yes() -> bool {
    true
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Cameras {
    calibration: String,
    max_skew_us: Spanned<i64>,
    #[serde(default = "queue_frames")]
    queue_frames: Spanned<i64>,
    raw: CameraTable,
    guide: Option<CameraTable>,
}

fn queue_frames() -> Spanned<i64> {
    Spanned::new(0..0, 3)
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraTable {
    backend: String,
    source: String,
    frame_rate: Option<Spanned<f64>>,
    #[serde(default = "yes")]
    paced: bool,
    width: Option<Spanned<i64>>,
    height: Option<Spanned<i64>>,
    format: Option<Spanned<String>>,
    exposure_us: Option<Spanned<f64>>,
    gain: Option<Spanned<f64>>,
    sync: Option<Spanned<String>>,
    max_identical: Option<Spanned<i64>>,
}

impl CameraTable {
    /// `name` is the table's: `cameras.raw` or `cameras.guide`.
    fn validate(self, name: &str, check: &mut Checker<'_>) -> CameraSpec {
        let key = |key: &str| format!("{name}.{key}");
        let frame_rate = self.frame_rate.map(|rate| {
            let ok = *rate.get_ref() > 0.0 && *rate.get_ref() <= 1000.0;
            check.check(&key("frame_rate"), &rate, ok, "above 0, to 1000 frames per second")
        });
        let mut side = |of: &str, value: &Spanned<i64>| {
            let ok = (1..=MAX_SIDE).contains(value.get_ref());
            check.check(&key(of), value, ok, &format!("1 to {MAX_SIDE}")) as usize
        };
        let size = match (&self.width, &self.height) {
            (Some(width), Some(height)) => Some(Size::new(side("width", width), side("height", height))),
            (Some(one), None) | (None, Some(one)) => {
                let (own, other) = if self.width.is_some() { ("width", "height") } else { ("height", "width") };
                let (at, found) = (Some(one.span().start), one.get_ref().to_string());
                check.reject(&key(own), at, found, &format!("with {other}"));
                None
            }
            (None, None) => None,
        };
        let format = self.format.and_then(|name| {
            let format = name.get_ref().parse::<PixelFormat>().ok();
            if format.is_none() {
                let found = format!("{:?}", name.get_ref());
                check.reject(&key("format"), Some(name.span().start), found, &FormatNameError::allowed());
            }
            format
        });
        let exposure_us = self.exposure_us.map(|time| {
            let ok = (1.0..=1e9).contains(time.get_ref());
            check.check(&key("exposure_us"), &time, ok, "1 to 1000000000 microseconds") as f32
        });
        let gain = self.gain.map(|gain| {
            let ok = (0.0..=1e6).contains(gain.get_ref());
            check.check(&key("gain"), &gain, ok, "0 to 1000000") as f32
        });
        let mut sync = Sync::Off;
        if let Some(name) = self.sync {
            let found = Sync::NAMES.iter().find(|(_, known)| known == name.get_ref());
            let names = Sync::NAMES.map(|(_, name)| name).join(", ");
            let allowed = match found {
                None => Some(names.as_str()),
                Some((Sync::Clock, _)) if frame_rate.is_none() => Some("with frame_rate"),
                Some(_) => None,
            };
            if let Some(allowed) = allowed {
                check.reject(&key("sync"), Some(name.span().start), format!("{:?}", name.get_ref()), allowed);
            }
            sync = found.map_or(sync, |(sync, _)| *sync);
        }
        let max_identical = self.max_identical.map(|frames| {
            let ok = (0..=100_000).contains(frames.get_ref());
            check.check(&key("max_identical"), &frames, ok, "0 to 100000 frames, 0 is never") as u32
        });
        let mode = Mode { size, format, exposure_us, gain, sync };
        CameraSpec { backend: self.backend, source: self.source, frame_rate, paced: self.paced, mode, max_identical }
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct PreviewTable {
    jpeg_quality: Spanned<i64>,
    max_clients: Spanned<i64>,
}

impl BoardFile {
    pub(super) fn validate(self, path: &Path, check: &mut Checker<'_>) -> Board {
        let mut within = |key: &str, v: &Spanned<i64>, low: i64, high: i64| {
            check.check(key, v, (low..=high).contains(v.get_ref()), &format!("{low} to {high}"))
        };
        let memory_limit_bytes =
            within("memory.limit_bytes", &self.memory.limit_bytes, 8 * MIB, 64 * 1024 * MIB) as usize;
        let threads = within("solver.threads", &self.solver.threads, 1, 64) as usize;
        let iterations = within("solver.iterations", &self.solver.iterations, 1, 10_000) as usize;
        let max_skew_us = within("cameras.max_skew_us", &self.cameras.max_skew_us, 0, 1_000_000) as u64;
        let queue = MAX_QUEUE_FRAMES as i64;
        let queue_frames = within("cameras.queue_frames", &self.cameras.queue_frames, 1, queue) as usize;
        let jpeg_quality = within("preview.jpeg_quality", &self.preview.jpeg_quality, 1, 100) as u8;
        let max_clients = within("preview.max_clients", &self.preview.max_clients, 1, 1000) as usize;
        let raw = self.cameras.raw.validate("cameras.raw", check);
        let guide = self.cameras.guide.map(|table| table.validate("cameras.guide", check));
        let folder = path.parent().unwrap_or(Path::new(""));
        Board {
            name: path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
            description: self.description,
            soc: self.soc,
            memory_limit_bytes,
            threads,
            fft: self.solver.fft,
            iterations,
            register: self.solver.register,
            fusion: Fusion {
                model: self.fusion.model.map(Into::into).unwrap_or_default(),
                precision: self.fusion.precision,
            },
            raw,
            guide,
            max_skew_us,
            queue_frames,
            calibration: match self.cameras.calibration.as_str() {
                "simulated" => Bundle::Simulated,
                dir => Bundle::Folder(folder.join(dir)),
            },
            preview: Preview { jpeg_quality, max_clients },
        }
    }
}
