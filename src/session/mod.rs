//! L3: sessions, the recordings of a running instrument: written frame by frame, kept within limits, read back for replay.
//!
//! ```text
//! DIR/session-20260102-030405Z/session.json          how the session was recorded
//!                              calibration/          the bundle
//!                              thumbnail.png         a small picture of the first frame
//!                              raw/00000000.npy      counts of the lensless sensor
//!                              guide/00000000.npy    counts of the guide camera, 65535 is full scale
//!                              stokes/00000000.npy   the result; as PNG: intensity/, dolp/ and aolp/
//!                              frames/00000000.json  the sidecar
//! ```
//!
//! A session is a folder of this name with our `session.json`. Its number tells the order of the sessions, whatever the clock said.
//! Nothing else in DIR is ever changed.
//!
//! Every file appears whole or not at all, and so does a session. A frame's sidecar is written last and removed first, so a frame that has a sidecar
//! is complete, even after a power cut.
//!
//! Allocation: buffers for encoding are made with the first frame and used again. Imports: arrays, boards, bundles, output.

pub(crate) mod archive;
mod layout;
mod lock;
mod prune;
mod read;
mod recording;
mod storage;
mod write;

use std::path::PathBuf;

pub(crate) use layout::{Description, Kinds, Label, SampleKind, timestamp};
pub(crate) use lock::FolderLock;
pub(crate) use prune::remove_unfinished;
pub use read::Playback;
pub(crate) use recording::OmeTiff;
pub use recording::Recording;
pub(crate) use storage::{Disk, RecordError, Storage};
pub(crate) use write::{CapturedImage, FrameData, Lock, SessionWriter};

use crate::output::export::Format;

/// Settings of a recording: where it goes, in which format, and how much of the disk it may take.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordOptions {
    /// Folder of the sessions; made if need be.
    pub dir: PathBuf,
    /// Format of the images.
    pub format: Format,
    /// Most frames kept, over all sessions; none keeps all. The oldest are removed first.
    pub max_frames: Option<u64>,
    /// Most bytes kept, over all sessions; none keeps all. The oldest frames are removed first.
    pub max_bytes: Option<u64>,
    /// Bytes of the disk that stay free. Recording pauses while fewer are free.
    pub reserve_bytes: u64,
}

/// Failure to open a folder of sessions for recording or a session for replay.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    /// The folder of the sessions cannot be used.
    #[error("{}: cannot record: {source}", dir.display())]
    Record {
        /// The folder.
        dir: PathBuf,
        /// Cause.
        source: std::io::Error,
    },
    /// Frames of a session were left out.
    #[error("{}: {lost} of {frames} frames are missing or damaged and were left out; they are named above", path.display())]
    Incomplete {
        /// Folder of the session.
        path: PathBuf,
        /// Frames that were left out.
        lost: u64,
        /// Frames that the session should have.
        frames: u64,
    },
    /// A session cannot be replayed.
    #[error("{}: {problem}", path.display())]
    Replay {
        /// File or folder.
        path: PathBuf,
        /// Problem, with the value found and what is allowed.
        problem: String,
    },
}
