use crate::{
    frame::{Frame, PixelFormat, Range, Samples},
    image::{Size, Stack},
};

/// The planes to be filled have another shape than the frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a {format} frame of {size} fills {} planes of {}, not {found} of {found_size}", .format.planes(), .format.plane_size(*.size))]
pub struct UnpackError {
    /// Format of the frame.
    pub format: PixelFormat,
    /// Size of the frame.
    pub size: Size,
    /// Planes there are.
    pub found: usize,
    /// Their size.
    pub found_size: Size,
}

/// Reads a frame of any format and stride into planes: one for mono, three (R, G, B) for colour.
/// Counts stay counts, floating-point samples stay in units of full scale.
///
/// A Bayer mosaic gives planes of half its size, one pixel per 2×2 cell with both greens averaged; an odd last row or
/// column is left out. NV12 and YUYV are BT.601, clipped to 0 to 255. Does not allocate.
///
/// ```
/// use stokescope_core::frame::{Frame, Metadata, PixelFormat, Samples};
/// use stokescope_core::image::{Size, Stack};
/// let size = Size::new(2, 1);
/// let frame = Frame::new(&[1, 2, 0x43], PixelFormat::Mono(Samples::Packed12), size, 3, Metadata::default())?;
/// let mut counts = Stack::zeros(1, size);
/// stokescope_core::readings::unpack(&frame, &mut counts)?;
/// assert_eq!(counts.as_slice(), [0x013 as f32, 0x024 as f32]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`UnpackError`] unless `out` has [`PixelFormat::planes`] planes of [`PixelFormat::plane_size`].
pub fn unpack(frame: &Frame<'_>, out: &mut Stack<f32>) -> Result<(), UnpackError> {
    let (format, size) = (frame.format(), frame.size());
    if out.count() != format.planes() || out.size() != format.plane_size(size) {
        return Err(UnpackError { format, size, found: out.count(), found_size: out.size() });
    }
    match format {
        PixelFormat::Mono(samples) | PixelFormat::Bayer(_, samples) | PixelFormat::Rgb(samples) => match samples {
            Samples::U8 => planes(frame, out, byte),
            Samples::U10 | Samples::U12 | Samples::U16 => planes(frame, out, word),
            Samples::Packed10 => planes(frame, out, packed10),
            Samples::Packed12 => planes(frame, out, packed12),
            Samples::F32 => planes(frame, out, float),
        },
        PixelFormat::Nv12Luma => planes(frame, out, byte),
        PixelFormat::Nv12Rgb | PixelFormat::Yuyv(_) => {
            for y in 0..size.height {
                for x in 0..size.width {
                    let color = rgb(frame, x, y);
                    (0..3).for_each(|c| out.plane_mut(c)[y * size.width + x] = color[c]);
                }
            }
        }
    }
    Ok(())
}

/// Sample `i` of a row of bytes.
#[inline(always)]
pub(super) fn byte(row: &[u8], i: usize) -> f32 {
    f32::from(row[i])
}

/// Sample `i` of a row of little-endian words of 16 bits.
#[inline(always)]
pub(super) fn word(row: &[u8], i: usize) -> f32 {
    f32::from(u16::from_le_bytes([row[2 * i], row[2 * i + 1]]))
}

/// Sample `i` of a row of groups of four in five bytes.
#[inline(always)]
pub(super) fn packed10(row: &[u8], i: usize) -> f32 {
    let (group, k) = (&row[i / 4 * 5..][..5], i % 4);
    f32::from(u16::from(group[k]) << 2 | u16::from(group[4] >> (2 * k) & 0b11))
}

/// Sample `i` of a row of pairs in three bytes.
#[inline(always)]
pub(super) fn packed12(row: &[u8], i: usize) -> f32 {
    let (group, k) = (&row[i / 2 * 3..][..3], i % 2);
    f32::from(u16::from(group[k]) << 4 | u16::from(group[2] >> (4 * k) & 0b1111))
}

/// Sample `i` of a row of native `f32`.
#[inline(always)]
pub(super) fn float(row: &[u8], i: usize) -> f32 {
    f32::from_ne_bytes([row[4 * i], row[4 * i + 1], row[4 * i + 2], row[4 * i + 3]])
}

/// Spreads samples over the planes; `sample` reads number `i` of a row.
fn planes(frame: &Frame<'_>, out: &mut Stack<f32>, sample: impl Fn(&[u8], usize) -> f32) {
    let Size { width, height } = out.size();
    let pixels = width * height;
    let planes = out.as_mut_slice();
    match frame.format() {
        PixelFormat::Bayer(order, _) => {
            // in reading order, flipping bit 0 of a place changes its column, bit 1 its row
            let red = order.red();
            let (blue, green, other_green) = (red ^ 3, red ^ 1, red ^ 2);
            for y in 0..height {
                let rows = [frame.row(2 * y), frame.row(2 * y + 1)];
                for x in 0..width {
                    let at = |k: usize| sample(rows[k / 2], 2 * x + k % 2);
                    let i = y * width + x;
                    planes[i] = at(red);
                    planes[pixels + i] = 0.5 * (at(green) + at(other_green));
                    planes[2 * pixels + i] = at(blue);
                }
            }
        }
        PixelFormat::Rgb(_) => {
            for (y, row) in frame.rows().enumerate() {
                for i in 0..3 * width {
                    planes[i % 3 * pixels + y * width + i / 3] = sample(row, i);
                }
            }
        }
        _ => {
            for (row, line) in frame.rows().zip(planes.chunks_exact_mut(width)) {
                for (i, value) in line.iter_mut().enumerate() {
                    *value = sample(row, i);
                }
            }
        }
    }
}

/// Red, green and blue of a pixel of NV12 or YUYV: BT.601, clipped to 0 to 255.
pub(super) fn rgb(frame: &Frame<'_>, x: usize, y: usize) -> [f32; 3] {
    let ([luma, cb, cr], range) = if let PixelFormat::Yuyv(range) = frame.format() {
        let pair = &frame.row(y)[x / 2 * 4..][..4];
        ([pair[x % 2 * 2], pair[1], pair[3]], range)
    } else {
        let chroma = &frame.row(frame.size().height + y / 2)[x / 2 * 2..][..2];
        ([frame.row(y)[x], chroma[0], chroma[1]], Range::Full)
    };
    let (black, luma_scale, chroma_scale) = match range {
        Range::Full => (0.0, 1.0, 1.0),
        Range::Limited => (16.0, 255.0 / 219.0, 255.0 / 224.0),
    };
    let [l, cb, cr] = [luma, cb, cr].map(f32::from);
    let (l, cb, cr) = (luma_scale * (l - black), chroma_scale * (cb - 128.0), chroma_scale * (cr - 128.0));
    [l + 1.402 * cr, l - 0.344_136 * cb - 0.714_136 * cr, l + 1.772 * cb].map(|v| v.clamp(0.0, 255.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{Bayer, Metadata};

    fn unpacked(data: &[u8], format: PixelFormat, width: usize, height: usize, stride: usize) -> Stack<f32> {
        let size = Size::new(width, height);
        let frame = Frame::new(data, format, size, stride, Metadata::default()).unwrap();
        let mut out = Stack::zeros(format.planes(), format.plane_size(size));
        out.as_mut_slice().fill(f32::NAN);
        unpack(&frame, &mut out).unwrap();
        out
    }

    #[test]
    fn golden_raw10_of_odd_width_and_padded_stride() {
        // 0x3FF 0x001 0x2AA 0x155 | 0x200, then padding that must not be read as pixels
        let low = 0b01_10_01_11;
        let row = [0xFF, 0x00, 0xAA, 0x55, low, 0x80, 0xEE, 0xEE, 0xEE, 0b00, 0xEE, 0xEE];
        let data = [row, row].concat();
        let out = unpacked(&data, PixelFormat::Mono(Samples::Packed10), 5, 2, 12);
        let line = [1023.0, 1.0, 682.0, 341.0, 512.0];
        assert_eq!(out.as_slice(), [line, line].concat());
    }

    #[test]
    fn golden_raw12_of_odd_width() {
        let data = [0xAB, 0x12, 0x3C, 0xFF, 0xEE, 0x0F];
        let out = unpacked(&data, PixelFormat::Mono(Samples::Packed12), 3, 1, 6);
        assert_eq!(out.as_slice(), [0xABC as f32, 0x123 as f32, 0xFFF as f32]);
    }

    #[test]
    fn little_endian_words_with_an_odd_stride() {
        let data = [0x01, 0x02, 0xFF, 0x0F, 9, 0x03, 0x00, 0x04, 0x00];
        let out = unpacked(&data, PixelFormat::Mono(Samples::U12), 2, 2, 5);
        assert_eq!(out.as_slice(), [513.0, 4095.0, 3.0, 4.0]);
    }

    #[test]
    fn every_bayer_order_finds_its_colours_and_drops_the_odd_edge() {
        for (order, cells) in [
            (Bayer::Rggb, [10, 20, 30, 40]),
            (Bayer::Bggr, [40, 20, 30, 10]),
            (Bayer::Grbg, [20, 10, 40, 30]),
            (Bayer::Gbrg, [20, 40, 10, 30]),
        ] {
            let data = [cells[0], cells[1], 99, cells[2], cells[3], 99, 99, 99, 99];
            let out = unpacked(&data, PixelFormat::Bayer(order, Samples::U8), 3, 3, 3);
            assert_eq!(out.as_slice(), [10.0, 25.0, 40.0], "{order:?}");
        }
    }

    #[test]
    fn interleaved_and_float_formats() {
        let rgb = unpacked(&[1, 2, 3, 4, 5, 6], PixelFormat::Rgb(Samples::U8), 2, 1, 6);
        assert_eq!(rgb.as_slice(), [1.0, 4.0, 2.0, 5.0, 3.0, 6.0]);
        let bytes: Vec<u8> = [0.25f32, -1.5].iter().flat_map(|v| v.to_ne_bytes()).collect();
        assert_eq!(unpacked(&bytes, PixelFormat::Mono(Samples::F32), 2, 1, 8).as_slice(), [0.25, -1.5]);
    }

    #[test]
    fn nv12_grey_stays_grey_and_red_is_red() {
        let data = [100, 76, 7, 0, 128, 128, 85, 255];
        let out = unpacked(&data[..8], PixelFormat::Nv12Rgb, 4, 1, 4);
        assert_eq!([out.plane(0)[0], out.plane(1)[0], out.plane(2)[0]], [100.0; 3]);
        let luma = unpacked(&data[..4], PixelFormat::Nv12Luma, 4, 1, 4);
        assert_eq!(luma.as_slice(), [100.0, 76.0, 7.0, 0.0]);
        let red = unpacked(&[76, 76, 85, 255], PixelFormat::Nv12Rgb, 2, 1, 2);
        assert!(red.plane(0)[0] > 253.0 && red.plane(1)[0] < 1.0 && red.plane(2)[0] < 1.0);
    }

    #[test]
    fn yuyv_of_odd_width_shares_its_colours_and_knows_its_range() {
        // two greys, then red with a pixel that is none, in a stride of ten
        let row = [16, 128, 235, 128, 81, 90, 99, 240, 0xEE, 0xEE];
        let out = unpacked(&[row, row].concat(), PixelFormat::Yuyv(Range::Limited), 3, 2, 10);
        let near = |plane: usize, wanted: [f32; 3]| {
            let found = out.plane(plane);
            assert!(found.iter().zip(wanted.iter().cycle()).all(|(a, b)| (a - b).abs() < 1.5), "{plane}: {found:?}");
        };
        near(0, [0.0, 255.0, 255.0]);
        near(1, [0.0, 255.0, 0.0]);
        near(2, [0.0, 255.0, 0.0]);
        let full = unpacked(&[16, 128, 235, 128], PixelFormat::Yuyv(Range::Full), 2, 1, 4);
        assert_eq!(full.as_slice(), [16.0, 235.0, 16.0, 235.0, 16.0, 235.0]);
    }

    #[test]
    fn a_wrong_shape_is_named() {
        let size = Size::new(4, 2);
        let format = PixelFormat::Bayer(Bayer::Rggb, Samples::U8);
        let frame = Frame::new(&[0; 8], format, size, 4, Metadata::default()).unwrap();
        let e = unpack(&frame, &mut Stack::zeros(1, size)).unwrap_err().to_string();
        assert_eq!(e, "a RGGB 8-bit frame of 4×2 fills 3 planes of 2×1, not 1 of 4×2");
    }
}
