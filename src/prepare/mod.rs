//! L2: from the camera's bytes to `f32` planes in the units the solver takes.
//!
//! Units: [`unpack`] gives counts. Allocation: none. Imports: `frame`, `plane`.
//!
//! ```
//! use stokescope::frame::{Frame, Metadata, PixelFormat, Samples};
//! use stokescope::plane::{Size, Stack};
//! let size = Size::new(2, 1);
//! let frame = Frame::new(&[1, 2, 0x43], PixelFormat::Mono(Samples::Packed12), size, 3, Metadata::default())?;
//! let mut counts = Stack::zeros(1, size);
//! stokescope::prepare::unpack(&frame, &mut counts)?;
//! assert_eq!(counts.as_slice(), [0x013 as f32, 0x024 as f32]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod unpack;

pub use unpack::{UnpackError, unpack};
