//! The `stokescope` program: a lensless polarization camera and a guide camera become live polarization images, in bounded memory.
//!
//! A diffuser and a striped polarizer mask in front of a bare sensor form the lensless camera; its raw frame looks like noise. From
//! the PSF of the diffuser, the response of the mask and a frame of an ordinary camera, [`stokescope_core`] reconstructs intensity,
//! degree and angle of linear polarization. This crate adds cameras, files, the live service and the command line.
//!
//! ```text
//!  camera ────▶ stokescope_core: readings, guide, solve, refine ────▶ output: NPY, PNG, JSON
//!  sim, replay,    ▲                                            └───▶ live, session: preview, recording
//!  libcamera,      │
//!  v4l2         bundle (the device), board (the machine), model (fusion network)
//! ```
//!
//! 1. **Sizes and memory are fixed at start.** [`plan`] sums the bytes of all stages and refuses what exceeds the limit; processing
//!    a frame allocates nothing.
//! 2. **Modules import only those before them** in the order that `tests/layers.rs` checks.
//! 3. **Files appear whole or not at all**, and contain finite values only.
//! 4. **Errors name** the file, the place, the value found and the allowed values.
//!
//! The feature `program` adds cameras, the live service and the command line. Without it the crate reads bundles, arrays and models, and
//! writes and scores results.

#![warn(clippy::too_many_lines)]

pub mod bundle;
pub mod config;
pub mod evaluate;
pub mod files;
pub mod model;
pub mod output;

#[cfg(feature = "program")]
pub mod board;
#[cfg(feature = "program")]
pub mod camera;
#[cfg(feature = "program")]
pub mod cli;
#[cfg(feature = "program")]
pub mod error;
#[cfg(feature = "program")]
pub mod heap;
#[cfg(feature = "program")]
pub mod live;
#[cfg(feature = "program")]
pub mod plan;
#[cfg(feature = "program")]
pub mod session;

#[cfg(feature = "program")]
pub use error::Error;
