use jpeg_encoder::{ColorType, Encoder};

use super::OutputError;
use stokescope_core::image::Size;

/// Encodes a colour picture as JPEG into `out`, which is overwritten and keeps its capacity, so a stream of frames reuses one buffer.
/// `quality` is clamped to 1 … 100.
///
/// # Errors
/// [`OutputError::Encode`] for a picture without pixels, with a side above 65535 pixels, or with another number of pixels than `size`.
pub fn encode_jpeg(size: Size, pixels: &[[u8; 3]], quality: u8, out: &mut Vec<u8>) -> Result<(), OutputError> {
    encode(size, pixels.as_flattened(), ColorType::Rgb, quality, out)
}

/// Encodes a gray picture of one byte per pixel, otherwise like [`encode_jpeg`].
///
/// # Errors
/// Those of [`encode_jpeg`].
pub fn encode_jpeg_gray(size: Size, pixels: &[u8], quality: u8, out: &mut Vec<u8>) -> Result<(), OutputError> {
    encode(size, pixels, ColorType::Luma, quality, out)
}

fn encode(size: Size, bytes: &[u8], color: ColorType, quality: u8, out: &mut Vec<u8>) -> Result<(), OutputError> {
    let refused = |message: String| OutputError::Encode { format: "JPEG", message };
    let side = |n: usize| u16::try_from(n).map_err(|_| refused(format!("{size} pixels, at most 65535 a side")));
    let (width, height) = (side(size.width)?, side(size.height)?);
    let per_pixel = if matches!(color, ColorType::Rgb) { 3 } else { 1 };
    if bytes.len() != size.pixels() * per_pixel {
        return Err(refused(format!("{} bytes cannot be {size} pixels", bytes.len())));
    }
    out.clear();
    Encoder::new(out, quality.clamp(1, 100)).encode(bytes, width, height, color).map_err(|e| refused(e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_reuses_one_buffer() {
        let (size, mut out) = (Size::new(40, 30), Vec::new());
        let pixels: Vec<[u8; 3]> = (0..size.pixels()).map(|i| [i as u8, (i / 40) as u8, 90]).collect();
        encode_jpeg(size, &pixels, 80, &mut out).unwrap();
        let (first, place) = (out.clone(), out.as_ptr());
        assert!(first.starts_with(&[0xff, 0xd8]) && first.ends_with(&[0xff, 0xd9]));
        encode_jpeg(size, &pixels, 80, &mut out).unwrap();
        assert_eq!((&out, out.as_ptr()), (&first, place));
        encode_jpeg_gray(size, &vec![9; size.pixels()], 80, &mut out).unwrap();
        assert!(out.len() < first.len());
    }

    #[test]
    fn impossible_pictures_are_refused() {
        let mut out = Vec::new();
        for (size, n) in [(Size::new(0, 0), 0), (Size::new(70_000, 1), 70_000), (Size::new(2, 2), 3)] {
            let e = encode_jpeg_gray(size, &vec![0; n], 80, &mut out);
            assert!(matches!(e, Err(OutputError::Encode { format: "JPEG", .. })), "{size}: {e:?}");
        }
    }
}
