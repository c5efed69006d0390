//! A board file as it is typed.

use std::path::Path;

use serde::Deserialize;

use super::{Board, Bundle, CameraSpec, MAX_QUEUE_FRAMES, Preview};
use crate::config::{Checker, Spanned};
use crate::optics::FftBackend;

const MIB: i64 = 1 << 20;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BoardFile {
    description: String,
    soc: String,
    memory: Memory,
    solver: SolverTable,
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
        let mut camera = |key: &str, table: CameraTable| CameraSpec {
            frame_rate: table.frame_rate.map(|rate| {
                let ok = *rate.get_ref() > 0.0 && *rate.get_ref() <= 1000.0;
                check.check(&format!("cameras.{key}.frame_rate"), &rate, ok, "above 0, to 1000 frames per second")
            }),
            backend: table.backend,
            source: table.source,
        };
        let raw = camera("raw", self.cameras.raw);
        let guide = self.cameras.guide.map(|table| camera("guide", table));
        let folder = path.parent().unwrap_or(Path::new(""));
        Board {
            name: path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
            description: self.description,
            soc: self.soc,
            memory_limit_bytes,
            threads,
            fft: self.solver.fft,
            iterations,
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
