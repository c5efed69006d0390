//! Output of results: the files of a reconstruction and its report, recorded images, panels with legends, figures of
//! calibration steps, and JPEG for the preview.
//!
//! Shapes: pictures are `[[u8; 3]]`, row-major, one triple per pixel; Stokes images are planes S0, S1, S2 per channel, in units of
//! full scale. Values are clamped for display only, never in files. A result with a value that is not finite is refused.

pub mod explain;
pub mod export;
mod figure;
mod files;
mod font;
mod jpeg;
pub mod panel;
pub mod plot;
mod report;
pub mod stack_file;
mod thumbnail;
pub mod zarr;

use std::path::PathBuf;

pub use figure::figure;
pub use files::{ResultImages, write_all};
pub use jpeg::{encode_jpeg, encode_jpeg_gray};
pub use report::{Fusion, Modelled, Report, Seconds, images, peak_rss_bytes};
pub use thumbnail::thumbnail;

use crate::files::WriteError;

/// Reason why a result cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// A file cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// The folder cannot be created, or a file of an earlier result cannot be removed.
    #[error("{}: {source}", path.display())]
    Folder {
        /// The folder or file.
        path: PathBuf,
        /// Reason.
        source: std::io::Error,
    },
    /// The sizes of a result do not match.
    #[error("{what}: {found}, allowed: {allowed}")]
    Shape {
        /// Part of the result.
        what: &'static str,
        /// Size found.
        found: String,
        /// Allowed sizes.
        allowed: String,
    },
    /// The folder of an array has other contents, which are kept.
    #[error("{}: holds {what}, allowed: a new folder, or an array of the same frames and settings; give another folder", path.display())]
    Occupied {
        /// The folder.
        path: PathBuf,
        /// Contents found.
        what: &'static str,
    },
    /// A result holds a value that is not finite.
    #[error("{what}: value {index} is {value}, allowed: finite values")]
    NonFinite {
        /// Part of the result.
        what: &'static str,
        /// Position of the value in that part.
        index: usize,
        /// NaN or an infinity.
        value: f32,
    },
    /// The encoder refuses the picture.
    #[error("{format}: {message}")]
    Encode {
        /// JPEG, PNG, TIFF or JSON.
        format: &'static str,
        /// Message of the encoder.
        message: String,
    },
}
