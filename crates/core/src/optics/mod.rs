//! L1: the lensless camera as a linear operator.
//!
//! y = Σ_k m_k ⊙ crop(psf * S_k), k = 0, 1, 2: three *response maps* m_k describe any polarizer mask (see [`Response`]),
//! the *psf* describes the diffuser. Images are `[height, width]`, f32, in units of the sensor's full scale; S0 ≥ 0 and
//! |S1 + i·S2| ≤ S0. The Stokes form costs one real and one complex convolution for any number of angles.
//!
//! Allocation: plans, kernels and scratch are made once; applying an operator allocates nothing.
//! Imports: [`crate::image`], [`crate::parallel`].

mod coarse;
mod convolve;
mod fft;
mod field;
pub(crate) mod lanes;
mod operator;
mod psf;
mod response;

pub use coarse::{Coarse, CoarseWorkspace};
pub use convolve::{Convolver, Kernel, LengthError, Reach, Scratch};
pub use fft::{Direction, Fft, FftBackend, FftScratch};
pub use field::{Field, Margin};
pub use lanes::{LANES, Lanes};
pub use operator::{AngleOperator, StokesOperator};
pub use psf::{LENS_SPREAD, Psf, PsfError};
pub use response::{Mask, MaskError, Mosaic, Response};
