//! L0: images in memory. Sizes, planar `f32` images, complex numbers, polarizer angles.
//!
//! Every image of the library is row-major and contiguous, one *plane* per channel, angle or Stokes component; several
//! planes of one size make a [`Stack`]. Strides exist only at the camera's edge and end in `prepare`.
//!
//! Allocation: constructors allocate, everything else borrows. Imports: nothing of this crate.
//!
//! ```
//! use stokescope::plane::{Angle, Size, Stack};
//! let mut stokes = Stack::<f32>::zeros(3, Size::new(4, 2));
//! stokes.plane_mut(0).fill(1.0);
//! assert_eq!(stokes.plane(0).len(), 8);
//! assert!((Angle::from_degrees(90.0).cos2() + 1.0).abs() < 1e-6);
//! ```

mod angle;
mod change;
mod cubic;
pub mod noise;
mod stack;
mod stokes;

pub use angle::Angle;
pub use change::{correlation, is_cut};
pub use cubic::cubic;
pub use num_complex::Complex32;
pub use stack::{ShapeError, Stack};
pub use stokes::{aolp_degrees, dolp, least_intensity};

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
