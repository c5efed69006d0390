//! Decoder of Motion JPEG frames. Each frame is a complete JPEG, often without Huffman tables; those of the JPEG standard's example
//! then apply.

use zune_jpeg::{
    JpegDecoder,
    zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions},
};

use stokescope_core::image::Size;

const START: [u8; 2] = [0xff, 0xd8];
const END: [u8; 2] = [0xff, 0xd9];
/// Segment that makes the decoder use the standard's tables where a frame has none.
const AVI1: [u8; 9] = [0xff, 0xe0, 0, 7, b'A', b'V', b'I', b'1', 0];

/// Decoder of frames of one size, with its own buffers.
pub(super) struct Decoder {
    size: Size,
    jpeg: Vec<u8>,
    rgb: Vec<u8>,
}

impl Decoder {
    pub(super) fn new(size: Size) -> Self {
        Self { size, jpeg: Vec::new(), rgb: vec![0; 3 * size.pixels()] }
    }

    /// Decodes `frame` to interleaved RGB without padding.
    ///
    /// # Errors
    /// A description of the damage: truncated, of another size, or not decodable. A part missing in the middle can go unnoticed; only
    /// the driver knows of it.
    pub(super) fn decode(&mut self, frame: &[u8]) -> Result<&[u8], String> {
        // some drivers fill the rest of their buffer with zeros
        let end = frame.iter().rposition(|byte| *byte != 0).map_or(0, |last| last + 1);
        let picture = frame[..end].strip_prefix(&START).ok_or("is no JPEG")?;
        if !picture.ends_with(&END) {
            return Err(format!("its JPEG is cut short after {end} bytes"));
        }
        self.jpeg.clear();
        self.jpeg.extend(START.iter().chain(&AVI1).chain(picture));
        let options = DecoderOptions::default().set_strict_mode(true).jpeg_set_out_colorspace(ColorSpace::RGB);
        let mut decoder = JpegDecoder::new_with_options(ZCursor::new(&self.jpeg[..]), options);
        decoder.decode_headers().map_err(|e| format!("its JPEG is damaged: {e}"))?;
        let found = decoder.dimensions().map_or(Size::new(0, 0), |(width, height)| Size::new(width, height));
        if found != self.size {
            return Err(format!("its JPEG has {found} pixels, not {}", self.size));
        }
        decoder.decode_into(&mut self.rgb).map_err(|e| format!("its JPEG is damaged: {e}"))?;
        Ok(&self.rgb)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: Size = Size::new(48, 33);

    fn colour(x: usize, y: usize) -> [u8; 3] {
        [4 * x as u8, 6 * y as u8, 200 - 3 * x as u8]
    }

    fn jpeg(size: Size) -> Vec<u8> {
        let pixels: Vec<u8> = (0..size.pixels()).flat_map(|i| colour(i % size.width, i / size.width)).collect();
        let mut bytes = Vec::new();
        let encoder = jpeg_encoder::Encoder::new(&mut bytes, 95);
        encoder.encode(&pixels, size.width as u16, size.height as u16, jpeg_encoder::ColorType::Rgb).unwrap();
        bytes
    }

    /// Removes the Huffman tables, as most cameras do.
    fn without_tables(jpeg: &[u8]) -> Vec<u8> {
        let (mut left, mut rest) = (jpeg[..2].to_vec(), &jpeg[2..]);
        while rest[1] != 0xda {
            let (segment, next) = rest.split_at(2 + usize::from(u16::from_be_bytes([rest[2], rest[3]])));
            if segment[1] != 0xc4 {
                left.extend(segment);
            }
            rest = next;
        }
        left.extend(rest);
        left
    }

    fn assert_is_the_picture(rgb: &[u8]) {
        let error = |(i, found): (usize, &[u8])| {
            let wanted = colour(i % SIZE.width, i / SIZE.width);
            found.iter().zip(wanted).map(|(a, b)| a.abs_diff(b)).max().unwrap()
        };
        let worst = rgb.chunks_exact(3).enumerate().map(error).max();
        assert!(rgb.len() == 3 * SIZE.pixels() && worst < Some(24), "{worst:?}");
    }

    #[test]
    fn frames_with_and_without_tables_and_with_padding_are_pictures() {
        let whole = jpeg(SIZE);
        let bare = without_tables(&whole);
        assert!(bare.len() + 400 < whole.len());
        let mut decoder = Decoder::new(SIZE);
        for frame in [&whole[..], &bare, &[&bare[..], &[0; 64]].concat()] {
            assert_is_the_picture(decoder.decode(frame).unwrap());
        }
    }

    #[test]
    fn broken_frames_are_refused_and_the_next_one_is_a_picture() {
        let whole = jpeg(SIZE);
        let mut decoder = Decoder::new(SIZE);
        let mut refused = |frame: &[u8]| decoder.decode(frame).unwrap_err();
        assert_eq!(refused(&[]), "is no JPEG");
        assert_eq!(refused(&[7; 90]), "is no JPEG");
        assert_eq!(
            refused(&whole[..whole.len() / 2]),
            format!("its JPEG is cut short after {} bytes", whole.len() / 2)
        );
        assert_eq!(refused(&jpeg(Size::new(16, 16))), "its JPEG has 16×16 pixels, not 48×33");
        // its first segment extends beyond the end
        let damaged = [&whole[..4], &[0xff, 0xff], &whole[6..]].concat();
        assert!(refused(&damaged).starts_with("its JPEG is damaged: "));
        assert_is_the_picture(decoder.decode(&whole).unwrap());
    }

    #[test]
    fn no_bytes_make_it_panic() {
        let whole = jpeg(SIZE);
        let mut decoder = Decoder::new(SIZE);
        let mut state = 1u32;
        for _ in 0..2000 {
            let mut bytes = whole.clone();
            for _ in 0..3 {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let at = (state >> 8) as usize % bytes.len();
                bytes[at] ^= state as u8 | 1;
            }
            let _ = decoder.decode(&bytes);
        }
    }
}
