//! Lensless polarization imaging: frames in memory become Stokes images in memory.
//!
//! Allocation: plans and workspaces allocate when they are made; processing a frame does not.

pub mod calibrate;
pub mod device;
pub mod frame;
pub mod guide;
pub mod image;
pub mod optics;
pub mod parallel;
pub mod pipeline;
pub mod polarization;
pub mod readings;
pub mod refine;
pub mod solve;
