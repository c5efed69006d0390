//! Reading of NPY, PNG and TIFF files, writing of NPY, and atomic writing of any file.
//!
//! Shapes: [`Array`] is n-dimensional in C order; [`Samples`] is one (gray) or three (red, green, blue) planes. Integers are counts,
//! not scaled; floating-point values are unchanged, NaN included.
//!
//! Every size is checked against the length of the file and against [`MAX_PIXELS`] before memory is allocated.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use stokescope::files::{read_image, read_npy, write_npy};
//! let dir = tempfile::tempdir()?;
//! let path = dir.path().join("s0.npy");
//! write_npy(&path, &[1, 2, 3], &[0.0, 0.1, 0.2, 0.3, 0.4, 0.5])?;
//! assert_eq!(read_npy(&path)?.shape, [1, 2, 3]);
//! assert_eq!(read_image(&path)?.size().to_string(), "3×2");
//! # Ok(()) }
//! ```

mod atomic;
mod image;
mod names;
mod npy;
mod stack;
#[cfg(feature = "program")]
mod zip;

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

#[cfg(feature = "program")]
pub(crate) use atomic::{TEMPORARY, UNFINISHED};
pub use atomic::{WriteError, write_atomic};
pub use image::read_image;
pub use names::{NamePart, has_extension, is_visible, name_parts, natural_order};
#[cfg(feature = "program")]
pub(crate) use npy::npy_header;
pub use npy::{Element, encode_npy, read_npy, write_npy};
#[cfg(feature = "program")]
pub(crate) use zip::Zip;

pub use stack::ImageStack;
use stokescope_core::image::{Size, Stack};

/// Largest image that is read, in pixels: 64 Mi, four times the largest sensors in use.
pub const MAX_PIXELS: usize = 64 << 20;

/// An image in the number format of its file: one plane (gray) or three (red, green, blue).
#[derive(Clone, Debug, PartialEq)]
pub enum Samples {
    /// 8 bit counts.
    U8(Stack<u8>),
    /// 16 bit counts.
    U16(Stack<u16>),
    /// Floating point, in units of full scale.
    F32(Stack<f32>),
}

impl Samples {
    /// Number of planes: 1 or 3.
    pub fn count(&self) -> usize {
        match self {
            Self::U8(s) => s.count(),
            Self::U16(s) => s.count(),
            Self::F32(s) => s.count(),
        }
    }

    /// Size of each plane.
    pub fn size(&self) -> Size {
        match self {
            Self::U8(s) => s.size(),
            Self::U16(s) => s.size(),
            Self::F32(s) => s.size(),
        }
    }
}

/// An n-dimensional array in C order: the last axis varies fastest.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    /// Length of each axis; none is 0.
    pub shape: Vec<usize>,
    /// Values; their number is the product of `shape`.
    pub samples: Values,
}

/// Values of an [`Array`] in the number format of its file.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// 8 bit counts.
    U8(Vec<u8>),
    /// 16 bit counts.
    U16(Vec<u16>),
    /// Floating point; double precision is rounded to single precision.
    F32(Vec<f32>),
}

impl Array {
    /// Converts the values to `f32` without scaling.
    pub fn into_f32(self) -> Vec<f32> {
        match self.samples {
            Values::U8(v) => v.into_iter().map(f32::from).collect(),
            Values::U16(v) => v.into_iter().map(f32::from).collect(),
            Values::F32(v) => v,
        }
    }
}

/// A file that cannot be read as an array or image.
#[derive(Debug, thiserror::Error)]
pub enum ArrayError {
    /// The file does not exist.
    #[error("{}: no such file", .0.display())]
    Missing(PathBuf),
    /// The file exists but cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Reason.
        source: std::io::Error,
    },
    /// A property of the file is not supported.
    #[error("{}: {what} is {found}, allowed: {allowed}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// Property: file type, data type, header or shape.
        what: &'static str,
        /// Value found.
        found: String,
        /// Supported values.
        allowed: &'static str,
    },
    /// The length of the file does not match its header.
    #[error("{}: shape {shape:?} of {dtype} takes {expected} bytes after the header, the file holds {found}", path.display())]
    Length {
        /// The file.
        path: PathBuf,
        /// Shape in the header.
        shape: Vec<usize>,
        /// Data type in the header.
        dtype: String,
        /// Bytes according to shape and data type.
        expected: u128,
        /// Bytes after the header.
        found: u64,
    },
    /// The image has no pixels or more than [`MAX_PIXELS`].
    #[error("{}: {width}×{height} pixels, allowed: 1 to {MAX_PIXELS}", path.display())]
    Pixels {
        /// The file.
        path: PathBuf,
        /// Width of the image.
        width: usize,
        /// Height of the image.
        height: usize,
    },
    /// The content of the file is damaged.
    #[error("{}: damaged {format} file: {message}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// PNG or TIFF.
        format: &'static str,
        /// Message of the decoder.
        message: String,
    },
}

/// Opens a regular file and returns its length in bytes. Folders, devices and pipes are refused.
fn open(path: &Path) -> Result<(File, u64), ArrayError> {
    let io = |source: std::io::Error| match source.kind() {
        std::io::ErrorKind::NotFound => ArrayError::Missing(path.to_path_buf()),
        _ => ArrayError::Io { path: path.to_path_buf(), source },
    };
    let meta = std::fs::metadata(path).map_err(io)?;
    if !meta.is_file() {
        let found = if meta.is_dir() { "a folder" } else { "a device or pipe" }.to_owned();
        return Err(unsupported(path, "this", found, "a regular file"));
    }
    Ok((File::open(path).map_err(io)?, meta.len()))
}

/// Reads a regular file of at most `most` bytes. Folders, devices and pipes are refused without being opened.
///
/// # Errors
/// That of the system, or the value found and what is allowed.
pub(crate) fn read_bytes(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    if !std::fs::metadata(path)?.is_file() {
        return Err(io::Error::other("a folder, device or pipe, allowed: a regular file"));
    }
    let mut bytes = Vec::new();
    // the length of a file may change while it is read
    File::open(path)?.take(most.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(io::Error::other(format!("the file is too large, allowed: {most} bytes")));
    }
    Ok(bytes)
}

fn unsupported(path: &Path, what: &'static str, found: impl Into<String>, allowed: &'static str) -> ArrayError {
    ArrayError::Unsupported { path: path.to_path_buf(), what, found: found.into(), allowed }
}

/// Checks the size of an image against [`MAX_PIXELS`].
fn checked_size(path: &Path, width: usize, height: usize) -> Result<Size, ArrayError> {
    match width.checked_mul(height) {
        Some(1..=MAX_PIXELS) => Ok(Size::new(width, height)),
        _ => Err(ArrayError::Pixels { path: path.to_path_buf(), width, height }),
    }
}
