//! Readings of the lensless sensor: bytes of a camera's frame → counts → fractions of full scale, each with a weight of 0 to 1.
//!
//! [`unpack`] reads any pixel format into `f32` planes. [`Binning`] crops and bins a frame of any format to the working size of a device
//! that uses less than its camera's whole frame. Normalization removes the black level or dark frame, gives saturated, missing and
//! defective readings the weight 0, and fills them with an estimate.
//!
//! Allocation: none.

mod binning;
mod lines;
mod normalize;
mod unpack;

pub use crate::image::Unit;
pub use binning::{Binned, Binning};
pub(crate) use normalize::{Plan, Readings};
pub use normalize::{Quality, ReadingsError, saturation_found};
pub use unpack::{UnpackError, unpack};
