//! Backend for libcamera: sensors on a camera connector, with or without an ISP, and USB cameras.
//!
//! [`names`] finds a camera, [`raw_stream`] chooses the mode and judges what libcamera makes of it, [`sync`] follows the synchronization
//! of two cameras; all are functions of plain values and are tested without libcamera. `device` carries their decisions out.

#[cfg(feature = "libcamera")]
mod device;
mod formats;
#[cfg(feature = "libcamera")]
mod memory;
mod names;
mod raw_stream;
mod sync;

#[cfg(feature = "libcamera")]
pub(super) use device::{list, open};
