use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use ::image::codecs::png::PngDecoder;
use ::image::{ColorType, ImageDecoder};
use tiff::decoder::{Decoder, DecodingResult};
use tiff::tags::Tag;

use super::{Array, ArrayError, MAX_PIXELS, Samples, Values, checked_size, npy, open, unsupported};
use stokescope_core::image::{Size, Stack};

/// Upper bound of decoded bytes per byte of a PNG or TIFF file (deflate 1032, LZW of TIFF about 2600). An image that claims more is
/// damaged and refused before memory is allocated.
const MAX_RATIO: u64 = 4096;
/// Largest decoded image in bytes: three channels and alpha of 32 bit.
const MAX_BYTES: usize = MAX_PIXELS * 16;
const SHAPES: &str = "[H, W], [1, H, W], [3, H, W] or [H, W, 3]";
const COLORS: &str = "gray or RGB of 8 or 16 bit (TIFF also 32 or 64 bit floating point), opaque";
const NO_JPEG: &str =
    "NPY, PNG or TIFF; save a guide as PNG, and record raw frames without loss: JPEG changes the readings";
const NO_BAYER: &str =
    "gray or RGB; write the colour planes of Bayer data as NPY [3, H/2, W/2]. The library rawpy reads DNG files";

/// Reads an NPY, PNG or TIFF image; the content of the file decides its type.
///
/// NPY arrays have the shape `[H, W]`, `[1, H, W]`, `[3, H, W]` or `[H, W, 3]` (if the first axis is neither 1 nor 3); PNG and TIFF
/// are gray or RGB. Colour is returned as three planes. Palettes and fewer than 8 bits of a PNG are expanded to 8 bits. An opaque
/// alpha channel is dropped.
///
/// # Errors
/// [`ArrayError`]: the file is missing, damaged, of another type, shape or colour type, transparent, or larger than [`MAX_PIXELS`].
pub fn read_image(path: &Path) -> Result<Samples, ArrayError> {
    let (file, length) = open(path)?;
    decode(path, BufReader::new(file), length)
}

/// Reads an image of `length` bytes from `reader`; `path` is for messages.
fn decode(path: &Path, mut reader: impl BufRead + Seek, length: u64) -> Result<Samples, ArrayError> {
    match FileType::of(path, &mut reader)? {
        FileType::Npy => from_array(path, npy::decode(path, reader, length)?),
        FileType::Png => read_png(path, reader, length),
        FileType::Tiff => read_tiff(path, reader, length),
    }
}

/// Types of image files.
pub(super) enum FileType {
    Npy,
    Png,
    Tiff,
}

impl FileType {
    /// The type that the first bytes of a file tell; `reader` is then at its beginning.
    pub(super) fn of(path: &Path, mut reader: impl Read + Seek) -> Result<Self, ArrayError> {
        let io = |source| ArrayError::Io { path: path.to_path_buf(), source };
        let mut magic = Vec::with_capacity(8);
        reader.by_ref().take(8).read_to_end(&mut magic).map_err(io)?;
        reader.seek(SeekFrom::Start(0)).map_err(io)?;
        match magic.as_slice() {
            m if m.starts_with(npy::MAGIC) => Ok(Self::Npy),
            m if m.starts_with(b"\x89PNG\r\n\x1a\n") => Ok(Self::Png),
            [b'I', b'I', 42 | 43, 0, ..] | [b'M', b'M', 0, 42 | 43, ..] => Ok(Self::Tiff),
            m if m.starts_with(b"\xff\xd8\xff") => Err(unsupported(path, "file type", "JPEG", NO_JPEG)),
            m => Err(unsupported(path, "file type", format!("{m:02x?}"), "NPY, PNG or TIFF")),
        }
    }
}

pub(super) fn from_array(path: &Path, array: Array) -> Result<Samples, ArrayError> {
    let (channels, planar, height, width) = match array.shape[..] {
        [height, width] => (1, true, height, width),
        [channels @ (1 | 3), height, width] => (channels, true, height, width),
        [height, width, 3] => (3, false, height, width),
        _ => return Err(unsupported(path, "shape", format!("{:?}", array.shape), SHAPES)),
    };
    let layout = Layout { size: checked_size(path, width, height)?, channels, planar };
    match array.samples {
        Values::U8(v) => layout.planes(path, v, u8::MAX).map(Samples::U8),
        Values::U16(v) => layout.planes(path, v, u16::MAX).map(Samples::U16),
        Values::F32(v) => layout.planes(path, v, 1.0).map(Samples::F32),
    }
}

fn read_png(path: &Path, reader: impl BufRead + Seek, length: u64) -> Result<Samples, ArrayError> {
    let mut limits = ::image::Limits::default();
    limits.max_alloc = Some(MAX_BYTES as u64);
    let damaged = |e: ::image::ImageError| match e {
        ::image::ImageError::Unsupported(e) => unsupported(path, "colour type", e.to_string(), COLORS),
        e => ArrayError::Damaged { path: path.to_path_buf(), format: "PNG", message: e.to_string() },
    };
    let decoder = PngDecoder::with_limits(reader, limits).map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    let size = checked_size(path, width as usize, height as usize)?;
    let color = decoder.color_type();
    let bytes = decoder.total_bytes();
    plausible(path, "PNG", bytes, length)?;
    let layout = Layout { size, channels: usize::from(color.channel_count()), planar: false };
    match color {
        ColorType::L8 | ColorType::La8 | ColorType::Rgb8 | ColorType::Rgba8 => {
            let mut values = vec![0; bytes as usize];
            decoder.read_image(&mut values).map_err(damaged)?;
            layout.planes(path, values, u8::MAX).map(Samples::U8)
        }
        ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16 => {
            let mut raw = vec![0; bytes as usize];
            decoder.read_image(&mut raw).map_err(damaged)?;
            let values = raw.as_chunks().0.iter().map(|&b| u16::from_ne_bytes(b)).collect();
            layout.planes(path, values, u16::MAX).map(Samples::U16)
        }
        other => Err(unsupported(path, "colour type", format!("{other:?}"), COLORS)),
    }
}

fn read_tiff(path: &Path, reader: impl BufRead + Seek, length: u64) -> Result<Samples, ArrayError> {
    let mut decoder = tiff_decoder(path, reader)?;
    check_page(path, &mut decoder)?;
    let count = pages(path, &mut decoder)?.len();
    if count > 1 {
        let allowed = "1; save each page as a file, or give `reconstruct` a stack of raw frames and one of guides";
        return Err(unsupported(path, "number of pages", count.to_string(), allowed));
    }
    decode_page(path, &mut decoder, length)
}

/// The error of a TIFF decoder.
pub(super) fn damaged_tiff(path: &Path, e: tiff::TiffError) -> ArrayError {
    match e {
        tiff::TiffError::UnsupportedError(tiff::TiffUnsupportedError::UnknownInterpretation) => {
            unsupported(path, "colour type", "none of images, as of Bayer data and of DNG files", NO_BAYER)
        }
        tiff::TiffError::UnsupportedError(e) => unsupported(path, "colour type", e.to_string(), COLORS),
        e => ArrayError::Damaged { path: path.to_path_buf(), format: "TIFF", message: e.to_string() },
    }
}

/// A decoder with limits, at the first page.
pub(super) fn tiff_decoder<R: Read + Seek>(path: &Path, reader: R) -> Result<Decoder<R>, ArrayError> {
    let mut limits = tiff::decoder::Limits::default();
    limits.decoding_buffer_size = MAX_BYTES;
    Ok(Decoder::new(reader).map_err(|e| damaged_tiff(path, e))?.with_limits(limits))
}

/// Refuses a page whose samples are not those of an image as they are stored.
pub(super) fn check_page<R: Read + Seek>(path: &Path, decoder: &mut Decoder<R>) -> Result<(), ArrayError> {
    let mut tag = |tag| decoder.find_tag_unsigned::<u32>(tag).ok().flatten();
    if tag(Tag::NewSubfileType).is_some_and(|kind| kind & 1 == 1) {
        let allowed =
            "the full image: this one is a preview, as the first of a DNG file is; convert the raw data to TIFF or NPY";
        return Err(unsupported(path, "first page", "a reduced image", allowed));
    }
    if tag(Tag::FillOrder).is_some_and(|order| order != 1) {
        return Err(unsupported(
            path,
            "fill order",
            "2 (reversed bits)",
            "1; save the file again, with tifffile for example",
        ));
    }
    let real = tag(Tag::SampleFormat).is_some_and(|format| format == 3);
    if real && tag(Tag::PhotometricInterpretation) == Some(0) {
        let allowed = "black is zero, for floating-point values; save the file again with photometric = minisblack";
        return Err(unsupported(path, "photometric interpretation", "white is zero", allowed));
    }
    Ok(())
}

/// Pages that are not reduced copies; the decoder is then at the first page again.
pub(super) fn pages<R: Read + Seek>(path: &Path, decoder: &mut Decoder<R>) -> Result<Vec<usize>, ArrayError> {
    let mut pages = vec![0];
    for page in 1.. {
        if !decoder.more_images() {
            break;
        }
        decoder.next_image().map_err(|e| damaged_tiff(path, e))?;
        let kind = decoder.find_tag_unsigned::<u32>(Tag::NewSubfileType).ok().flatten().unwrap_or(0);
        pages.extend((kind & 1 == 0).then_some(page));
    }
    decoder.seek_to_image(0).map_err(|e| damaged_tiff(path, e))?;
    Ok(pages)
}

/// Reads the present page of a file of `length` bytes.
pub(super) fn decode_page<R: Read + Seek>(
    path: &Path,
    decoder: &mut Decoder<R>,
    length: u64,
) -> Result<Samples, ArrayError> {
    let damaged = |e| damaged_tiff(path, e);
    let (width, height) = decoder.dimensions().map_err(damaged)?;
    let size = checked_size(path, width as usize, height as usize)?;
    let color = decoder.colortype().map_err(damaged)?;
    let channels = match color {
        tiff::ColorType::Gray(8 | 16 | 32 | 64) => 1,
        tiff::ColorType::GrayA(8 | 16 | 32) => 2,
        tiff::ColorType::RGB(8 | 16 | 32 | 64) => 3,
        tiff::ColorType::RGBA(8 | 16 | 32) => 4,
        other => return Err(unsupported(path, "colour type", format!("{other:?}"), COLORS)),
    };
    let stored = decoder.image_buffer_layout().map_err(damaged)?;
    plausible(path, "TIFF", stored.complete_len as u64, length)?;
    let mut values = DecodingResult::U8(Vec::new());
    decoder.read_image_to_buffer(&mut values).map_err(damaged)?;
    let layout = Layout { size, channels, planar: stored.planes > 1 };
    match values {
        DecodingResult::U8(v) => layout.planes(path, v, u8::MAX).map(Samples::U8),
        DecodingResult::U16(v) => layout.planes(path, v, u16::MAX).map(Samples::U16),
        DecodingResult::F32(v) => layout.planes(path, v, 1.0).map(Samples::F32),
        DecodingResult::F64(v) => layout.planes(path, v.into_iter().map(|v| v as f32).collect(), 1.0).map(Samples::F32),
        _ => Err(unsupported(path, "colour type", format!("{color:?} of another number format"), COLORS)),
    }
}

fn plausible(path: &Path, format: &'static str, decoded: u64, length: u64) -> Result<(), ArrayError> {
    if decoded <= length.saturating_mul(MAX_RATIO) {
        return Ok(());
    }
    let message = format!("{decoded} bytes of pixels cannot come from a file of {length} bytes");
    Err(ArrayError::Damaged { path: path.to_path_buf(), format, message })
}

/// Memory layout of a decoded image: planar (channel after channel) or interleaved (pixel after pixel).
struct Layout {
    size: Size,
    channels: usize,
    planar: bool,
}

impl Layout {
    /// Converts decoded values to colour planes; `opaque` is the alpha value of an opaque pixel.
    fn planes<T: Copy + Default + PartialEq>(
        &self,
        path: &Path,
        mut values: Vec<T>,
        opaque: T,
    ) -> Result<Stack<T>, ArrayError> {
        let Self { size, channels, planar } = *self;
        let shape = |e: stokescope_core::image::ShapeError| unsupported(path, "pixel data", e.to_string(), COLORS);
        let colors = if channels < 3 { 1 } else { 3 };
        let n = size.pixels();
        if values.len() != channels * n {
            return Stack::from_vec(channels, size, values).map_err(shape);
        }
        let at = |channel: usize, pixel: usize| if planar { channel * n + pixel } else { pixel * channels + channel };
        if colors < channels && (0..n).any(|pixel| values[at(colors, pixel)] != opaque) {
            return Err(unsupported(path, "colour type", "partly transparent", COLORS));
        }
        if planar || channels == 1 {
            values.truncate(colors * n);
            return Stack::from_vec(colors, size, values).map_err(shape);
        }
        let mut stack = Stack::zeros(colors, size);
        for (channel, plane) in stack.planes_mut().enumerate() {
            for (pixel, value) in plane.iter_mut().enumerate() {
                *value = values[at(channel, pixel)];
            }
        }
        Ok(stack)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use ::image::{ExtendedColorType, ImageEncoder};
    use tiff::encoder::{Compression, DeflateLevel, TiffEncoder, colortype};

    use super::*;

    fn of_bytes(bytes: &[u8]) -> Result<Samples, ArrayError> {
        decode(Path::new("a"), Cursor::new(bytes), bytes.len() as u64)
    }

    fn png(width: u32, height: u32, color: ExtendedColorType, values: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        ::image::codecs::png::PngEncoder::new(&mut out).write_image(values, width, height, color).unwrap();
        out
    }

    fn tiff<C: colortype::ColorType>(width: u32, height: u32, values: &[C::Inner]) -> Vec<u8>
    where
        [C::Inner]: tiff::encoder::TiffValue,
    {
        let mut out = Cursor::new(Vec::new());
        TiffEncoder::new(&mut out).unwrap().write_image::<C>(width, height, values).unwrap();
        out.into_inner()
    }

    fn shape(height: usize, width: usize, channels: usize) -> Array {
        let samples = Values::U8((0..height * width * channels).map(|i| i as u8).collect());
        Array { shape: vec![height, width, channels], samples }
    }

    #[test]
    fn colour_comes_as_planes_whatever_the_file() {
        let interleaved = [1u8, 2, 3, 4, 5, 6];
        let wide = interleaved.map(u16::from);
        let real = interleaved.map(f32::from);
        let expected = Stack::from_vec(3, Size::new(2, 1), vec![1u8, 4, 2, 5, 3, 6]).unwrap();
        let to = |f: fn(u8) -> f32| expected.as_slice().iter().map(|&v| f(v)).collect::<Vec<_>>();
        let native: Vec<u8> = wide.iter().flat_map(|v| v.to_ne_bytes()).collect();
        assert_eq!(of_bytes(&png(2, 1, ExtendedColorType::Rgb8, &interleaved)).unwrap(), Samples::U8(expected.clone()));
        assert_eq!(of_bytes(&tiff::<colortype::RGB8>(2, 1, &interleaved)).unwrap(), Samples::U8(expected.clone()));
        for bytes in [png(2, 1, ExtendedColorType::Rgb16, &native), tiff::<colortype::RGB16>(2, 1, &wide)] {
            let Samples::U16(s) = of_bytes(&bytes).unwrap() else { panic!("not 16 bit") };
            assert_eq!(s.as_slice(), [1, 4, 2, 5, 3, 6]);
        }
        let Samples::F32(s) = of_bytes(&tiff::<colortype::RGB32Float>(2, 1, &real)).unwrap() else {
            panic!("not real")
        };
        assert_eq!(s.as_slice(), to(f32::from));
    }

    #[test]
    fn gray_keeps_its_depth() {
        let Samples::U16(s) = of_bytes(&tiff::<colortype::Gray16>(1, 2, &[7, 40_000])).unwrap() else {
            panic!("depth")
        };
        assert_eq!((s.size(), s.as_slice()), (Size::new(1, 2), [7, 40_000].as_slice()));
        let Samples::F32(s) = of_bytes(&tiff::<colortype::Gray32Float>(2, 1, &[-0.5, 2.0])).unwrap() else {
            panic!("real")
        };
        assert_eq!(s.as_slice(), [-0.5, 2.0]);
        let native: Vec<u8> = [7u16, 40_000].iter().flat_map(|v| v.to_ne_bytes()).collect();
        let Samples::U16(s) = of_bytes(&png(1, 2, ExtendedColorType::L16, &native)).unwrap() else { panic!("depth") };
        assert_eq!(s.as_slice(), [7, 40_000]);
    }

    #[test]
    fn only_an_opaque_alpha_channel_is_dropped() {
        let opaque = png(1, 1, ExtendedColorType::Rgba8, &[1, 2, 3, 255]);
        assert_eq!(of_bytes(&opaque).unwrap().count(), 3);
        let e = of_bytes(&png(1, 1, ExtendedColorType::La8, &[1, 254])).unwrap_err().to_string();
        assert!(e.starts_with("a: colour type is partly transparent, allowed: gray or RGB"), "{e}");
    }

    #[test]
    fn an_npy_image_is_told_by_its_axes() {
        let path = Path::new("a");
        for (array, count, size) in [
            (shape(1, 4, 3), 1, Size::new(3, 4)),
            (shape(3, 4, 5), 3, Size::new(5, 4)),
            (shape(3, 5, 3), 3, Size::new(3, 5)),
            (shape(4, 5, 3), 3, Size::new(5, 4)),
        ] {
            let name = format!("{:?}", array.shape);
            let s = from_array(path, array).unwrap();
            assert_eq!((s.count(), s.size()), (count, size), "{name}");
        }
        let Samples::U8(s) = from_array(path, shape(4, 5, 3)).unwrap() else { panic!("depth") };
        assert_eq!(s.plane(1)[..3], [1, 4, 7]);
        let e = from_array(path, shape(4, 5, 2)).unwrap_err().to_string();
        assert!(e.ends_with("shape is [4, 5, 2], allowed: [H, W], [1, H, W], [3, H, W] or [H, W, 3]"), "{e}");
    }

    #[test]
    fn absurd_sizes_are_refused_before_decoding() {
        let mut huge = png(1, 1, ExtendedColorType::L8, &[0]);
        huge[16..24].copy_from_slice(&[0x3b, 0x9a, 0xca, 0, 0x3b, 0x9a, 0xca, 0]);
        // with a valid checksum, so that the size itself is refused
        let crc = crc(&huge[12..29]);
        huge[29..33].copy_from_slice(&crc.to_be_bytes());
        let e = of_bytes(&huge).unwrap_err().to_string();
        assert!(e.contains("1000000000×1000000000 pixels, allowed: 1 to 67108864"), "{e}");
        assert!(plausible(Path::new("a"), "PNG", 4096 * 100, 100).is_ok());
        assert!(plausible(Path::new("a"), "PNG", 4096 * 100 + 1, 100).is_err());
    }

    /// CRC-32 of PNG.
    fn crc(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0, |crc, &b| {
            (0..8).fold(crc ^ u32::from(b), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 })
        })
    }

    #[test]
    fn no_single_byte_and_no_cut_makes_it_panic() {
        let native: Vec<u8> = (0..24u8).collect();
        let packed = |compression| {
            let mut out = Cursor::new(Vec::new());
            let mut encoder = TiffEncoder::new(&mut out).unwrap().with_compression(compression);
            encoder.write_image::<colortype::Gray8>(6, 4, &native).unwrap();
            out.into_inner()
        };
        let files = [
            packed(Compression::Lzw),
            packed(Compression::Deflate(DeflateLevel::Fast)),
            png(4, 3, ExtendedColorType::L16, &native),
            png(4, 2, ExtendedColorType::Rgb8, &native),
            tiff::<colortype::RGB8>(4, 2, &native),
            tiff::<colortype::Gray32Float>(2, 2, &[0.0, 0.25, 0.5, 1.0]),
        ];
        for good in &files {
            assert!(of_bytes(good).is_ok());
            for at in 0..good.len() {
                // only returning matters: the cut may be behind the last pixel
                drop(of_bytes(&good[..at]));
                for flip in [1, 0x80, 0xff] {
                    let mut bytes = good.clone();
                    bytes[at] ^= flip;
                    drop(of_bytes(&bytes));
                }
            }
        }
    }

    #[test]
    fn other_files_are_named_by_their_first_bytes() {
        let e = of_bytes(b"GIF89a").unwrap_err().to_string();
        assert_eq!(e, "a: file type is [47, 49, 46, 38, 39, 61], allowed: NPY, PNG or TIFF");
        let e = of_bytes(b"\xff\xd8\xff\xe0\0\x10JFIF").unwrap_err().to_string();
        assert!(e.starts_with("a: file type is JPEG, allowed: NPY, PNG or TIFF; save a guide as PNG"), "{e}");
    }
}
