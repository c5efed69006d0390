//! One image as a camera lends it: bytes in driver memory, their layout, and the sensor's metadata.
//!
//! A [`Frame`] borrows and never copies. Its constructor proves that the layout fits the bytes, so that readers need no further check.
//! [`unpack`](crate::readings::unpack) turns it into `f32` planes, after which the camera gets its buffer back.
//!
//! Units: integer samples are counts of the sensor, floating-point ones are fractions of full scale; timestamps are monotonic time on the
//! sensor's clock. Allocation: none, except for the text of errors.
//!
//! ```
//! use stokescope_core::frame::{Frame, Metadata, PixelFormat, Samples};
//! use stokescope_core::image::Size;
//! let format = PixelFormat::Mono(Samples::Packed10);
//! assert_eq!(format.row_bytes(5), 10); // two groups of four pixels in five bytes
//! let error = Frame::new(&[0; 30], format, Size::new(5, 4), 8, Metadata::default()).unwrap_err();
//! assert_eq!(error.to_string(), "mono 10-bit packed, 5×4: a stride of 8 bytes cannot hold rows of 10 bytes");
//! ```

mod name;

use std::{fmt, time::Duration};

pub use name::FormatNameError;

use crate::image::Size;

/// Storage of one sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Samples {
    /// One byte.
    U8,
    /// 10 bits in the low end of a little-endian 16-bit word.
    U10,
    /// 12 bits in the low end of a little-endian 16-bit word.
    U12,
    /// A little-endian 16-bit word.
    U16,
    /// MIPI CSI-2 RAW10: four bytes with the high 8 bits of four samples, one byte with their low 2 bits.
    Packed10,
    /// MIPI CSI-2 RAW12: two bytes with the high 8 bits of two samples, one byte with their low 4 bits.
    Packed12,
    /// Native `f32`, in fractions of full scale.
    F32,
}

impl Samples {
    /// Significant bits of an integer sample.
    pub const fn bits(self) -> Option<u32> {
        match self {
            Self::U8 => Some(8),
            Self::U10 | Self::Packed10 => Some(10),
            Self::U12 | Self::Packed12 => Some(12),
            Self::U16 => Some(16),
            Self::F32 => None,
        }
    }

    /// Whether several samples share a byte.
    pub const fn is_packed(self) -> bool {
        matches!(self, Self::Packed10 | Self::Packed12)
    }

    /// Bytes of `count` samples in a row; packed rows end with a whole group.
    pub const fn row_bytes(self, count: usize) -> usize {
        match self {
            Self::U8 => count,
            Self::U10 | Self::U12 | Self::U16 => 2 * count,
            Self::Packed10 => 5 * count.div_ceil(4),
            Self::Packed12 => 3 * count.div_ceil(2),
            Self::F32 => 4 * count,
        }
    }
}

impl fmt::Display for Samples {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::U8 => "8-bit",
            Self::U10 => "10-bit",
            Self::U12 => "12-bit",
            Self::U16 => "16-bit",
            Self::Packed10 => "10-bit packed",
            Self::Packed12 => "12-bit packed",
            Self::F32 => "float",
        })
    }
}

/// Colours of the 2×2 cell of a Bayer mosaic, in reading order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Bayer {
    /// Red, green / green, blue.
    Rggb,
    /// Blue, green / green, red.
    Bggr,
    /// Green, red / blue, green.
    Grbg,
    /// Green, blue / red, green.
    Gbrg,
}

impl Bayer {
    /// Place of red in the cell, 0 to 3 in reading order. Blue lies diagonally opposite; the greens fill the other diagonal.
    pub const fn red(self) -> usize {
        match self {
            Self::Rggb => 0,
            Self::Grbg => 1,
            Self::Gbrg => 2,
            Self::Bggr => 3,
        }
    }
}

/// Range of the luma byte in `YCbCr`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Range {
    /// 0 to 255, as in JPEG.
    Full,
    /// 16 to 235, as in television and most USB cameras.
    Limited,
}

/// Layout and meaning of the bytes of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum PixelFormat {
    /// One sample per pixel.
    Mono(Samples),
    /// One sample per pixel behind a colour mosaic.
    Bayer(Bayer, Samples),
    /// Red, green and blue interleaved.
    Rgb(Samples),
    /// The luma of NV12 or of any planar YCbCr 4:2:0: its chroma rows are ignored and may be absent.
    Nv12Luma,
    /// NV12 (8-bit luma rows, then half as many rows of interleaved Cb, Cr with the same stride), full-range BT.601, as RGB.
    Nv12Rgb,
    /// YUYV (8 bits, two pixels as Y, Cb, Y, Cr), BT.601, as RGB.
    Yuyv(Range),
}

impl PixelFormat {
    /// Planes that come out of [`crate::readings::unpack`]: 1 or 3.
    pub const fn planes(self) -> usize {
        match self {
            Self::Mono(_) | Self::Nv12Luma => 1,
            Self::Bayer(..) | Self::Rgb(_) | Self::Nv12Rgb | Self::Yuyv(_) => 3,
        }
    }

    /// Size of the unpacked planes: half of `size`, rounded down, for a Bayer mosaic.
    pub const fn plane_size(self, size: Size) -> Size {
        match self {
            Self::Bayer(..) => Size::new(size.width / 2, size.height / 2),
            _ => size,
        }
    }

    /// Bytes of a row of `width` pixels, without padding.
    pub const fn row_bytes(self, width: usize) -> usize {
        match self {
            Self::Mono(samples) | Self::Bayer(_, samples) => samples.row_bytes(width),
            Self::Rgb(samples) => samples.row_bytes(3 * width),
            Self::Nv12Luma => width,
            Self::Nv12Rgb => width.next_multiple_of(2),
            Self::Yuyv(_) => 4 * width.div_ceil(2),
        }
    }

    /// Rows of bytes of an image of `height` rows.
    pub const fn rows(self, height: usize) -> usize {
        match self {
            Self::Nv12Rgb => height + height.div_ceil(2),
            _ => height,
        }
    }

    /// Significant bits of a sample, `None` for floating point.
    pub const fn bits(self) -> Option<u32> {
        match self {
            Self::Mono(samples) | Self::Bayer(_, samples) | Self::Rgb(samples) => samples.bits(),
            Self::Nv12Luma | Self::Nv12Rgb | Self::Yuyv(_) => Some(8),
        }
    }
}

impl fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mono(samples) => write!(f, "mono {samples}"),
            Self::Bayer(order, samples) => write!(f, "{} {samples}", format!("{order:?}").to_uppercase()),
            Self::Rgb(samples) => write!(f, "RGB {samples}"),
            Self::Nv12Luma => f.write_str("NV12 luma"),
            Self::Nv12Rgb => f.write_str("NV12"),
            Self::Yuyv(Range::Limited) => f.write_str("YUYV"),
            Self::Yuyv(Range::Full) => f.write_str("full-range YUYV"),
        }
    }
}

/// Metadata of a frame, as the sensor reports it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Metadata {
    /// Number of the frame since the camera started; a gap means frames were lost.
    pub sequence: u64,
    /// Middle of the exposure, monotonic. Frames of two cameras on one clock belong together when their timestamps agree.
    pub timestamp: Duration,
    /// Exposure time in microseconds.
    pub exposure_us: Option<f32>,
    /// Total gain, 1 is none.
    pub gain: Option<f32>,
    /// Temperature of the sensor in degrees Celsius.
    pub temperature_c: Option<f32>,
}

/// A layout that does not fit the bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FrameError {
    /// A side of 0 pixels, or of more than 2²⁰.
    #[error("{format}: a size of {size}, allowed: 1 to 1048576 each way")]
    Size {
        /// The format.
        format: PixelFormat,
        /// The size.
        size: Size,
    },
    /// Rows would overlap.
    #[error("{format}, {size}: a stride of {stride_bytes} bytes cannot hold rows of {row_bytes} bytes")]
    Stride {
        /// The format.
        format: PixelFormat,
        /// The size.
        size: Size,
        /// Bytes from row to row.
        stride_bytes: usize,
        /// Bytes of one row.
        row_bytes: usize,
    },
    /// The buffer ends before the image does.
    #[error("{format}, {size}, stride {stride_bytes}: {found} bytes, the image takes {needed}")]
    Short {
        /// The format.
        format: PixelFormat,
        /// The size.
        size: Size,
        /// Bytes from row to row.
        stride_bytes: usize,
        /// Bytes in the buffer.
        found: usize,
        /// Bytes the image takes: whole strides and one row.
        needed: usize,
    },
}

/// One image, lent by a camera.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    data: &'a [u8],
    format: PixelFormat,
    size: Size,
    stride_bytes: usize,
    /// Metadata of the sensor.
    pub metadata: Metadata,
}

impl<'a> Frame<'a> {
    /// Takes `data` as an image of `format` and `size` with `stride_bytes` from row to row. The last row needs no padding.
    ///
    /// # Errors
    /// [`FrameError`] when the size is empty, rows would overlap or the data is too short.
    pub fn new(
        data: &'a [u8],
        format: PixelFormat,
        size: Size,
        stride_bytes: usize,
        metadata: Metadata,
    ) -> Result<Self, FrameError> {
        if size.width == 0 || size.height == 0 || size.width > 1 << 20 || size.height > 1 << 20 {
            return Err(FrameError::Size { format, size });
        }
        let row_bytes = format.row_bytes(size.width);
        if stride_bytes < row_bytes {
            return Err(FrameError::Stride { format, size, stride_bytes, row_bytes });
        }
        let needed = stride_bytes.saturating_mul(format.rows(size.height) - 1).saturating_add(row_bytes);
        if data.len() < needed {
            return Err(FrameError::Short { format, size, stride_bytes, found: data.len(), needed });
        }
        Ok(Self { data, format, size, stride_bytes, metadata })
    }

    /// Layout and meaning of the bytes.
    pub fn format(&self) -> PixelFormat {
        self.format
    }

    /// Size in sensor pixels.
    pub fn size(&self) -> Size {
        self.size
    }

    /// Bytes from row to row.
    pub fn stride_bytes(&self) -> usize {
        self.stride_bytes
    }

    /// Row `index` of bytes without its padding; chroma rows follow the luma rows.
    pub fn row(&self, index: usize) -> &'a [u8] {
        &self.data[index * self.stride_bytes..][..self.format.row_bytes(self.size.width)]
    }

    /// All rows without padding, from the top.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = &'a [u8]> + use<'a> {
        let frame = *self;
        (0..frame.format.rows(frame.size.height)).map(move |index| frame.row(index))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MONO16: PixelFormat = PixelFormat::Mono(Samples::U16);

    fn frame(bytes: usize, format: PixelFormat, size: Size, stride: usize) -> Result<(), FrameError> {
        Frame::new(&vec![0; bytes], format, size, stride, Metadata::default()).map(|_| ())
    }

    #[test]
    fn the_last_row_needs_no_padding() {
        assert!(frame(16 + 6, MONO16, Size::new(3, 2), 16).is_ok());
        assert_eq!(
            frame(21, MONO16, Size::new(3, 2), 16).unwrap_err().to_string(),
            "mono 16-bit, 3×2, stride 16: 21 bytes, the image takes 22"
        );
    }

    #[test]
    fn impossible_layouts_are_refused() {
        assert!(matches!(frame(64, MONO16, Size::new(3, 2), 5), Err(FrameError::Stride { row_bytes: 6, .. })));
        assert!(matches!(frame(64, MONO16, Size::new(0, 2), 5), Err(FrameError::Size { .. })));
        assert!(matches!(frame(64, MONO16, Size::new(3, 9), usize::MAX / 2), Err(FrameError::Short { .. })));
    }

    #[test]
    fn nv12_counts_its_chroma_rows() {
        let size = Size::new(3, 3);
        assert!(frame(4 * 4 + 4, PixelFormat::Nv12Rgb, size, 4).is_ok());
        assert!(frame(4 * 4 + 3, PixelFormat::Nv12Rgb, size, 4).is_err());
        assert!(frame(4 * 2 + 3, PixelFormat::Nv12Luma, size, 4).is_ok());
    }

    #[test]
    fn rows_skip_the_padding() {
        let data = [1, 2, 9, 3, 4, 9];
        let f = Frame::new(&data, PixelFormat::Mono(Samples::U8), Size::new(2, 2), 3, Metadata::default()).unwrap();
        assert_eq!(f.rows().collect::<Vec<_>>(), [[1, 2], [3, 4]]);
    }
}
