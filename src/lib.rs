//! stokescope: polarization images from a lensless polarization camera and an ordinary one, in bounded memory.
pub mod array;
pub mod camera;
pub mod config;
pub mod error;
pub mod frame;
pub mod plane;
pub mod prepare;

pub use error::Error;
