//! stokescope: polarization images from a lensless polarization camera and an ordinary one, in bounded memory.
pub mod array;
pub mod cli;
pub mod config;
pub mod error;
pub mod evaluate;
pub mod output;
pub mod plane;

pub use error::Error;
