//! L2: results for people and for files. False colours, panels with legends, the folder a reconstruction leaves, its report,
//! and JPEG for the live preview.
//!
//! Shapes: pictures are `[[u8; 3]]`, row-major, one triple per pixel; Stokes images are planes S0, S1, S2 per channel. Units:
//! those of the sensor's full scale; angles in degrees. Only display clamps: files hold what was computed, and every file is
//! refused if a value in it is not finite.
//!
//! Allocation: the mappings of [`color`] and [`encode_jpeg`] write to the caller's buffers; panels and files allocate.
//! Imports: [`crate::files`], [`stokescope_core::image`].
//!
//! ```
//! use stokescope::output::color::{AolpMode, MASKED, aolp};
//! let stokes = [[1.0, 1.0].as_slice(), &[1.0, 0.5], &[0.0, 0.0]];
//! let mut picture = [[0; 3]; 2];
//! aolp(stokes, &[true, false], AolpMode::Value, &mut picture);
//! assert_eq!(picture, [[255, 0, 0], MASKED]); // horizontal is red
//! ```

pub mod export;
mod files;
mod font;
mod jpeg;
pub mod panel;
pub mod plot;
mod report;

use std::path::PathBuf;

pub use files::{ResultImages, write_all};
pub use jpeg::{encode_jpeg, encode_jpeg_gray};
pub use report::{Fusion, Modelled, Report, Seconds, images, peak_rss_bytes};

use crate::files::WriteError;

/// A result that could not be written.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// A file could not be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The folder cannot be made, or a file of an earlier result in it not removed.
    #[error("{}: {source}", path.display())]
    Folder {
        /// The folder or file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The parts of a result do not belong together.
    #[error("{what}: {found}, allowed: {allowed}")]
    Shape {
        /// Which part.
        what: &'static str,
        /// What it is.
        found: String,
        /// What it may be.
        allowed: String,
    },
    /// A result holds a value that is not finite.
    #[error("{what}: value {index} is {value}, allowed: finite values")]
    NonFinite {
        /// Which part.
        what: &'static str,
        /// Position among its values.
        index: usize,
        /// NaN or an infinity.
        value: f32,
    },
    /// The encoder refuses the picture.
    #[error("{format}: {message}")]
    Encode {
        /// JPEG, PNG, TIFF or JSON.
        format: &'static str,
        /// What the encoder says.
        message: String,
    },
}
