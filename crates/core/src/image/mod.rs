//! Images in memory: sizes, windows, planar images, complex numbers, pictures for display.
//!
//! Every image of the library is row-major and contiguous. One *plane* holds one channel, angle or Stokes component; several planes of
//! one size make a [`Stack`]. Strides exist only in a camera's [`Frame`](crate::frame::Frame) and end in [`crate::readings`].
//!
//! Allocation: constructors allocate, everything else borrows.
//!
//! ```
//! use stokescope_core::image::{Size, Stack};
//! let mut stokes = Stack::<f32>::zeros(3, Size::new(4, 2));
//! stokes.plane_mut(0).fill(1.0);
//! assert_eq!(stokes.plane(0).len(), 8);
//! ```

mod buffers;
mod change;
mod cubic;
mod mean;
pub mod noise;
mod picture;
mod scale;
mod stack;
mod view;
mod window;

pub use buffers::Buffers;
pub use change::{correlation, is_cut};
pub use cubic::cubic;
pub(crate) use mean::local_mean;
pub use num_complex::Complex32;
pub use picture::Picture;
pub use scale::OffScale;
pub(crate) use scale::{Top, common_step};
pub use stack::{ShapeError, Stack};
pub use view::{ImageView, Planes, Samples, Unit};
pub use window::{MAX_BIN, Window, WindowError};

use std::fmt;

/// Width and height of an image, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Size {
    /// Pixels in a row.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
}

impl Size {
    /// A size of `width` by `height` pixels.
    pub const fn new(width: usize, height: usize) -> Self {
        Self { width, height }
    }

    /// Number of pixels.
    pub const fn pixels(self) -> usize {
        self.width * self.height
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}×{}", self.width, self.height)
    }
}
