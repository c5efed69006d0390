//! L4: the live service. Two cameras → pairs of frames → the pipeline → preview and disk, until told to stop.
//!
//! ```text
//! raw camera ──thread──┐                         ┌─ Saver ──thread──▶ OUT
//!                      ├▶ Pairing ▶ solver thread ┼─ Recorder ─thread─▶ sessions
//! guide camera ─thread─┘  (bounded)              └─ Broadcast ▶ encoder thread ▶ HTTP thread ▶ watchers
//! ```
//!
//! Every queue is bounded and the newest frame wins: a slow solver, disk or watcher skips frames and delays nobody else. A raw
//! frame is processed with the guide frame of its own instant. While the guide camera is offline it is processed without one and
//! marked, never with an earlier one. Results are fractions of the sensor's full scale, as in [`stokescope_core::pipeline`].
//!
//! Each thread holds the parts of the service that it needs, and no others; `service.rs` makes the parts and wires them.
//!
//! A device without a bundle is brought up by the [`Setup`], which the service follows at the same address.
//!
//! Allocation: [`Service::start`] plans and allocates; frames and results circulate in buffers that are used again, pictures
//! are allocated once per encoding. Imports: everything below.
//!
//! ```
//! use stokescope::board::Board;
//! use stokescope::live::{Options, Service};
//! # let dir = tempfile::tempdir()?;
//! let mut board = Board::load("x86-sim")?;
//! board.raw.source = "wedges,size=32,stripes=8".into();
//! board.guide.as_mut().unwrap().source = board.raw.source.clone();
//! let options = Options { frames: Some(2), preview: None, ..Options::new(board, dir.path().into()) };
//! let summary = Service::start(&options)?.wait(|_| false)?;
//! assert_eq!(summary.frames, 2);
//! assert!(dir.path().join("frame-000001/stokes.npy").exists());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod bring_up;
mod cameras;
mod controls;
mod events;
mod frame;
mod http;
mod limits;
mod log;
mod machine;
mod memory;
mod options;
mod pairing;
mod preview;
mod quality;
mod recorder;
mod saver;
mod service;
mod setup;
mod solver;
mod startup;
mod statistics;
mod stop;
mod summary;
mod threads;

pub use bring_up::{Setup, SetupProgress, SetupSummary};
pub use log::LogTail;
pub use memory::{PROCESS_BYTES, Uses, reserve};
pub use options::{MAX_KEPT, Options, Preview, ServiceError, TOKEN_VARIABLE, Target};
pub use service::{Service, Shutter};
pub use summary::{Dropped, Latency, Progress, Recorded, Summary, Written};
