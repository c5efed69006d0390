//! Progress and result of a run, for the caller.

use std::path::PathBuf;

use serde::Serialize;

/// State of the run.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// Frames processed.
    pub frames: u64,
    /// Recent frames per second.
    pub fps: f64,
    /// Frames per second that quality is given up for; none if none is.
    pub target_fps: Option<f64>,
    /// Median time from a frame's arrival to its result, in milliseconds.
    pub latency_ms: Option<f32>,
    /// Frames that arrived and were not processed.
    pub dropped: u64,
    /// Whether no frame is due: a camera waits for its trigger, or no pair is asked for.
    pub idle: bool,
}

/// Result of the run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// Name of the board.
    pub board: String,
    /// Frames processed.
    pub frames: u64,
    /// Frames without a result.
    pub failed: u64,
    /// Frames per second, from the first result to the last.
    pub fps: Option<f64>,
    /// Frames per second that quality was given up for; none if none was.
    pub target_fps: Option<f64>,
    /// Time from the start to the first result, in seconds.
    pub first_result_seconds: Option<f64>,
    /// Time from a frame's arrival to its result, in milliseconds.
    pub latency_ms: Latency,
    /// Frames that were not processed.
    pub dropped: Dropped,
    /// Most memory that the process ever held.
    pub peak_rss_bytes: Option<u64>,
    /// Folder of the newest result.
    pub out: PathBuf,
    /// Address of the preview.
    pub preview: Option<String>,
    /// Results on disk.
    pub results: Written,
    /// Recording; none if nothing was to be recorded.
    pub recording: Option<Recorded>,
}

/// Counts of a recording.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Recorded {
    /// Folder of the session; none before its first frame.
    pub session: Option<PathBuf>,
    /// Frames recorded.
    pub written: u64,
    /// Frames that could not be recorded.
    pub failed: u64,
    /// Frames left out because the disk was too slow.
    pub dropped: u64,
    /// Recorded frames removed to make room.
    pub removed: u64,
}

/// Quantiles of a time over the recent frames, in milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Latency {
    /// Median.
    pub p50: Option<f32>,
    /// 95th percentile.
    pub p95: Option<f32>,
}

/// Frames that arrived and were not processed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Dropped {
    /// Raw frames that made room for newer ones.
    pub raw: u64,
    /// Guide frames that made room for newer ones.
    pub guide: u64,
    /// Raw frames without a guide frame of their instant.
    pub unpaired: u64,
}

/// Results on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Written {
    /// Written, each replacing the one before or in a folder of its own.
    pub written: u64,
    /// Not written: the disk was full or read-only.
    pub failed: u64,
}
