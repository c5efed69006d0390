//! stokescope: polarization images from a lensless polarization camera and an ordinary one, in bounded memory.
pub mod parallel;
pub mod plane;

pub mod array;
pub mod config;
pub mod frame;

pub mod board;
pub mod calibration;
pub mod model;
pub mod optics;

pub mod camera;
pub mod output;
pub mod polar;
pub mod prepare;
pub mod recon;

pub mod evaluate;
pub mod pipeline;

pub mod cli;
pub mod error;
pub mod service;

pub use error::Error;
