//! Polarization images from a lensless polarization camera and an ordinary one, in bounded memory.
//!
//! A diffuser and a striped polarizer mask turn a bare sensor into a camera whose raw frame looks like noise. With the PSF of the
//! diffuser, the response of the mask and one frame of an ordinary camera, this crate solves for what was in front of it:
//! intensity, degree and angle of linear polarization.
//!
//! ```text
//!  camera ──lease──▶ prepare ──f32 planes──▶ recon ──Stokes──▶ polar ──▶ output
//!  sim, replay       black level, weights,   stage I           angles,    NPY, PNG,
//!                    guide, gain                               DoLP, AoLP JSON, JPEG
//!       ▲                 ▲                    ▲
//!  board (what machine)   └─ calibration ──────┴─ optics: A·x, Aᵀ·y
//! ```
//!
//! 1. **Plans prove, runs run.** Shapes, sizes and memory are settled when a plan is made; a run neither fails on them nor
//!    allocates. [`pipeline::Pipeline::plan`] sums the bytes of all stages and refuses what does not fit.
//! 2. **Model only what a scene needs.** Linear polarization is one complex image, S1 + i·S2, whatever the number of angles; with
//!    a guide S0 is known, without a mask S0 is all there is.
//! 3. **Rooms have levels** and import lower ones only; stages meet in [`pipeline`] alone.
//! 4. **Files appear whole or not at all**, and never hold a value that is not finite.
//! 5. **Errors say** the file, the place, what was found and what is allowed.
//!
//! The order of the modules is the order of the flow.

pub mod config;
pub mod files;
pub mod heap;

pub mod board;
pub mod bundle;
pub mod model;

pub mod camera;
pub mod evaluate;
pub mod output;
pub mod session;

pub mod cli;
pub mod error;
pub mod live;
pub mod plan;

pub use error::Error;
