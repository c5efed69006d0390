//! stokescope: polarization images from a lensless polarization camera and an ordinary one, in bounded memory.
pub mod array;
pub mod calibration;
pub mod config;
pub mod error;
pub mod optics;
pub mod parallel;
pub mod plane;

pub use error::Error;
pub mod polar;
pub mod prepare;
pub mod recon;
