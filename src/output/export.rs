//! Encoders of recorded images: NPY, TIFF, OME-TIFF and 16-bit PNG, in memory.
//!
//! Raw and guide frames are counts or fractions of full scale, in one plane or three (red, green, blue). A result is a stack of
//! named planes.

use std::fmt::Write as _;
use std::io::{Cursor, Seek, Write};

use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use tiff::encoder::{TiffEncoder, TiffKind, TiffValue, colortype};
use tiff::tags::Tag;

use super::zarr::display_range;
use super::{OutputError, ResultImages};
use crate::files::encode_npy;
use stokescope_core::image::{Size, Stack};
use stokescope_core::polarization::{aolp_degrees, dolp};

/// File format of recorded images.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[cfg_attr(feature = "program", derive(clap::ValueEnum))]
#[serde(rename_all = "kebab-case")]
pub enum Format {
    /// NumPy arrays.
    #[default]
    Npy,
    /// TIFF as ImageJ writes it: frames of 16 bit, results as channels of 32-bit floating point.
    Tiff,
    /// TIFF with OME-XML that names the planes of a result.
    OmeTiff,
    /// PNG of 16 bit: frames, and intensity, DoLP and AoLP of results.
    Png16,
}

impl Format {
    /// File name extension of a single image.
    pub fn image_ending(self) -> &'static str {
        match self {
            Self::Npy => "npy",
            Self::Tiff | Self::OmeTiff => "tif",
            Self::Png16 => "png",
        }
    }

    /// File name extension of a stack of named planes; `None` for a format without stacks.
    pub fn stack_ending(self) -> Option<&'static str> {
        match self {
            Self::Npy => Some("npy"),
            Self::Tiff => Some("tif"),
            Self::OmeTiff => Some("ome.tif"),
            Self::Png16 => None,
        }
    }
}

/// Encodes a gray or colour image into `out`, which is overwritten: values times `scale`, rounded to 16 bit.
///
/// # Errors
/// [`OutputError::Encode`] when the encoder refuses the image.
pub fn encode_counts(format: Format, image: &Stack<f32>, scale: f32, out: &mut Vec<u8>) -> Result<(), OutputError> {
    let size = image.size();
    let count = |v: f32| (v * scale).round().clamp(0.0, 65_535.0) as u16;
    out.clear();
    if format == Format::Npy {
        let counts: Vec<u16> = image.as_slice().iter().map(|v| count(*v)).collect();
        return encode_npy(out, &npy_shape(image), counts).map_err(|e| refused("NPY", &e));
    }
    let (n, planes) = (size.pixels(), image.count());
    let values = image.as_slice();
    let pixels: Vec<u16> =
        (0..n).flat_map(|i| (0..planes).map(move |c| c * n + i)).map(|at| count(values[at])).collect();
    let (width, height) = sides(size)?;
    if format == Format::Png16 {
        let bytes: Vec<u8> = pixels.iter().flat_map(|v| v.to_ne_bytes()).collect();
        let color = if planes == 3 { ExtendedColorType::Rgb16 } else { ExtendedColorType::L16 };
        return PngEncoder::new(out).write_image(&bytes, width, height, color).map_err(|e| refused("PNG", &e));
    }
    let mut tiff = TiffEncoder::new(Cursor::new(out)).map_err(|e| refused("TIFF", &e))?;
    if planes == 3 {
        tiff.write_image::<colortype::RGB16>(width, height, &pixels)
    } else {
        tiff.write_image::<colortype::Gray16>(width, height, &pixels)
    }
    .map_err(|e| refused("TIFF", &e))
}

/// Encodes a gray or colour image of floating-point values into `out`, which is overwritten. PNG has no floating point; NPY is
/// written instead.
///
/// # Errors
/// [`OutputError::Encode`] when the encoder refuses the image.
pub fn encode_real(format: Format, image: &Stack<f32>, out: &mut Vec<u8>) -> Result<(), OutputError> {
    out.clear();
    if matches!(format, Format::Npy | Format::Png16) {
        return encode_npy(out, &npy_shape(image), image.as_slice().iter().copied()).map_err(|e| refused("NPY", &e));
    }
    let (n, planes) = (image.size().pixels(), image.count());
    let values = image.as_slice();
    let (width, height) = sides(image.size())?;
    let mut tiff = TiffEncoder::new(Cursor::new(out)).map_err(|e| refused("TIFF", &e))?;
    if planes == 3 {
        let pixels: Vec<f32> = (0..n).flat_map(|i| (0..planes).map(move |c| values[c * n + i])).collect();
        tiff.write_image::<colortype::RGB32Float>(width, height, &pixels)
    } else {
        tiff.write_image::<colortype::Gray32Float>(width, height, values)
    }
    .map_err(|e| refused("TIFF", &e))
}

/// Encodes a stack of named planes into `out`, which is overwritten; `taken` is the time of capture as in RFC 3339, or empty. NPY does not
/// keep the names. PNG has no stacks; NPY is written instead.
///
/// # Errors
/// [`OutputError::Encode`] when the encoder refuses the stack, or the number of names differs from that of the planes.
pub fn encode_stack(
    format: Format,
    names: &[String],
    taken: &str,
    stack: &Stack<f32>,
    out: &mut Vec<u8>,
) -> Result<(), OutputError> {
    out.clear();
    let Size { width, height } = stack.size();
    if matches!(format, Format::Npy | Format::Png16) {
        let shape = [stack.count(), height, width];
        return encode_npy(out, &shape, stack.as_slice().iter().copied()).map_err(|e| refused("NPY", &e));
    }
    if names.len() != stack.count() {
        return Err(refused("TIFF", &format!("{} names for {} planes", names.len(), stack.count())));
    }
    let description = match format {
        Format::OmeTiff => ome_xml(stack.size(), names, 1, None, taken),
        _ => imagej_description(names.len()),
    };
    let (labels, counts) = imagej_metadata(names, 1);
    let mut tiff = TiffEncoder::new(Cursor::new(out)).map_err(|e| refused("TIFF", &e))?;
    for (page, (plane, name)) in stack.planes().zip(names).enumerate() {
        let tags = (page == 0).then_some((&*description, &*labels, &*counts));
        let name = (format == Format::Tiff && page > 0).then_some(&**name);
        write_page(&mut tiff, stack.size(), plane, tags, name)?;
    }
    Ok(())
}

/// Text of the first page, and what ImageJ reads beside it: names and ranges, and how many bytes they take.
pub(super) type FirstTags<'a> = (&'a str, &'a [u8], &'a [u32]);

pub(super) fn write_page<W: Write + Seek, K: TiffKind>(
    tiff: &mut TiffEncoder<W, K>,
    size: Size,
    plane: &[f32],
    first: Option<FirstTags<'_>>,
    name: Option<&str>,
) -> Result<(), OutputError> {
    let (width, height) = sides(size)?;
    let mut write = || -> Result<(), tiff::TiffError> {
        let mut image = tiff.new_image::<colortype::Gray32Float>(width, height)?;
        if let Some(text) = first.map(|(text, ..)| text).or(name) {
            image.encoder().write_tag(Tag::ImageDescription, Utf8(text))?;
        }
        if let Some((_, metadata, counts)) = first {
            image.encoder().write_tag(IMAGEJ_COUNTS, counts)?;
            image.encoder().write_tag(IMAGEJ_METADATA, metadata)?;
        }
        image.write_data(plane)
    };
    write().map_err(|e| refused("TIFF", &e))
}

/// Tags of ImageJ: names of the pages and display ranges, and the bytes that each takes.
const IMAGEJ_METADATA: Tag = Tag::Unknown(50839);
const IMAGEJ_COUNTS: Tag = Tag::Unknown(50838);

/// Description with which ImageJ opens a file as channels of one image.
fn imagej_description(planes: usize) -> String {
    format!("ImageJ=1.53k\nimages={planes}\nchannels={planes}\nhyperstack=true\nmode=grayscale\nloop=false\n")
}

/// Values of the tags [`IMAGEJ_METADATA`] and [`IMAGEJ_COUNTS`], in the machine's byte order as the rest of the file.
pub(super) fn imagej_metadata(names: &[String], frames: usize) -> (Vec<u8>, Vec<u32>) {
    let label = |name: &String| name.encode_utf16().flat_map(u16::to_ne_bytes).collect::<Vec<u8>>();
    let labels: Vec<Vec<u8>> = names.iter().map(label).collect();
    let ranges: Vec<u8> = names.iter().flat_map(|name| display_range(name)).flat_map(f64::to_ne_bytes).collect();
    let entry = |kind: &[u8; 4], count: usize| [u32::from_be_bytes(*kind), count as u32].map(u32::to_ne_bytes).concat();
    let pages = frames * labels.len();
    let header =
        [u32::from_be_bytes(*b"IJIJ").to_ne_bytes().to_vec(), entry(b"labl", pages), entry(b"rang", 1)].concat();
    let lengths: Vec<u32> = labels.iter().map(|label| label.len() as u32).collect();
    let counts = [vec![header.len() as u32], lengths.repeat(frames), vec![ranges.len() as u32]].concat();
    let parts = [header, labels.concat().repeat(frames), ranges];
    (parts.concat(), counts)
}

/// Names of the Stokes images of a sensor of 1 or 3 channels, in the order of a result's planes.
pub fn stokes_names(channels: usize, polarized: bool) -> Vec<String> {
    let components: &[&str] = if polarized { &["S0", "S1", "S2"] } else { &["S0"] };
    let channel = |c: usize| if channels == 3 { ["red ", "green ", "blue "][c] } else { "" };
    (0..channels).flat_map(|c| components.iter().map(move |s| format!("{}{s}", channel(c)))).collect()
}

/// Encodes a whole result into `out`, which is overwritten. NPY holds the Stokes images as `stokes.npy` does. TIFF also has planes of DoLP
/// and AoLP in degrees, of colours summed, and of validity, 0 or 1; all are named.
///
/// # Errors
/// [`OutputError`]: sizes that do not match, values that are not finite, or an encoder that refuses them.
pub fn encode_result(format: Format, images: &ResultImages<'_>, out: &mut Vec<u8>) -> Result<(), OutputError> {
    if matches!(format, Format::Npy | Format::Png16) {
        super::files::check(images)?;
        let ResultImages { size, channels, stokes, .. } = *images;
        out.clear();
        let shape = [channels, stokes.count() / channels, size.height, size.width];
        let values = stokes.as_slice().iter().copied();
        return encode_npy(out, &shape[usize::from(channels == 1)..], values).map_err(|e| refused("NPY", &e));
    }
    let (names, stack) = result_planes(images)?;
    encode_stack(format, &names, "", &stack, out)
}

/// Names of the planes of a whole result: Stokes images, DoLP and AoLP where there is polarization, and validity.
pub fn result_names(channels: usize, polarized: bool) -> Vec<String> {
    let mut names = stokes_names(channels, polarized);
    if polarized {
        names.extend(["DoLP".to_owned(), "AoLP (degrees)".to_owned()]);
    }
    names.push("valid".to_owned());
    names
}

/// A whole result as planes of single precision with their names, those of [`result_names`]. DoLP and AoLP are those of colours summed;
/// validity is 0 or 1.
///
/// # Errors
/// [`OutputError`]: sizes that do not match, values that are not finite.
pub fn result_planes(images: &ResultImages<'_>) -> Result<(Vec<String>, Stack<f32>), OutputError> {
    let polarized = super::files::check(images)?;
    let ResultImages { size, channels, stokes, valid, .. } = *images;
    let mut planes = stokes.as_slice().to_vec();
    if polarized {
        push_angles(stokes, channels, &mut planes);
    }
    planes.extend(valid.iter().map(|valid| f32::from(u8::from(*valid))));
    let names = result_names(channels, polarized);
    let stack = Stack::from_vec(names.len(), size, planes).map_err(|e| refused("planes", &e))?;
    Ok((names, stack))
}

/// Appends planes of DoLP and AoLP of Stokes images of one or three channels.
pub(crate) fn push_angles(stokes: &Stack<f32>, channels: usize, planes: &mut Vec<f32>) {
    planes.extend(dolp_plane(stokes, channels));
    planes.extend(aolp_plane(stokes, channels));
}

/// DoLP of the pixels of Stokes images of one or three channels, of colours summed.
pub(crate) fn dolp_plane(stokes: &Stack<f32>, channels: usize) -> impl Iterator<Item = f32> {
    summed(stokes, channels).map(|[s0, s1, s2]| dolp(s0, s1, s2))
}

/// AoLP in degrees of the pixels of Stokes images of one or three channels, of colours summed.
pub(crate) fn aolp_plane(stokes: &Stack<f32>, channels: usize) -> impl Iterator<Item = f32> {
    summed(stokes, channels).map(|[_, s1, s2]| aolp_degrees(s1, s2))
}

fn summed(stokes: &Stack<f32>, channels: usize) -> impl Iterator<Item = [f32; 3]> {
    let at = move |component: usize, i: usize| (0..channels).map(|c| stokes.plane(3 * c + component)[i]).sum();
    (0..stokes.size().pixels()).map(move |i| [0, 1, 2].map(|component| at(component, i)))
}

/// OME-XML (data model 2016-06) of frames, `interval` seconds apart: one channel and one page per plane.
pub(super) fn ome_xml(size: Size, names: &[String], frames: usize, interval: Option<f64>, taken: &str) -> String {
    const OME: &str = "http://www.openmicroscopy.org/Schemas/OME/2016-06";
    let order = if cfg!(target_endian = "big") { "true" } else { "false" };
    let mut xml = format!(
        "<?xml version=\"1.0\" encoding=\"UTF-8\"?><OME xmlns=\"{OME}\" xmlns:xsi=\"http://www.w3.org/2001/XMLSchema-instance\" \
         xsi:schemaLocation=\"{OME} {OME}/ome.xsd\" Creator=\"stokescope {}\"><Image ID=\"Image:0\" Name=\"Stokes\">\
         {}<Pixels ID=\"Pixels:0\" DimensionOrder=\"XYCZT\" Type=\"float\" \
         BigEndian=\"{order}\" SizeX=\"{}\" SizeY=\"{}\" SizeC=\"{}\" SizeZ=\"1\" SizeT=\"{frames}\"{}>",
        env!("CARGO_PKG_VERSION"),
        if taken.is_empty() { String::new() } else { format!("<AcquisitionDate>{}</AcquisitionDate>", escaped(taken)) },
        size.width,
        size.height,
        names.len(),
        interval.map_or(String::new(), |s| format!(" TimeIncrement=\"{s}\" TimeIncrementUnit=\"s\"")),
    );
    // writing to a string cannot fail
    for (c, name) in names.iter().enumerate() {
        let _ = write!(xml, "<Channel ID=\"Channel:0:{c}\" Name=\"{}\" SamplesPerPixel=\"1\"/>", escaped(name));
    }
    let _ = write!(xml, "<TiffData IFD=\"0\" PlaneCount=\"{}\"/>", frames * names.len());
    xml + "</Pixels></Image></OME>"
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Text of a TIFF tag as zero-terminated UTF-8, as OME requires; the encoder's own text type is ASCII only.
struct Utf8<'a>(&'a str);

impl TiffValue for Utf8<'_> {
    const BYTE_LEN: u8 = 1;
    const FIELD_TYPE: tiff::tags::Type = tiff::tags::Type::ASCII;

    fn count(&self) -> usize {
        self.0.len() + 1
    }

    fn data(&self) -> std::borrow::Cow<'_, [u8]> {
        [self.0.as_bytes(), &[0]].concat().into()
    }
}

fn npy_shape(image: &Stack<f32>) -> Vec<usize> {
    let Size { width, height } = image.size();
    if image.count() == 1 { vec![height, width] } else { vec![image.count(), height, width] }
}

fn sides(size: Size) -> Result<(u32, u32), OutputError> {
    let side = |n: usize| u32::try_from(n).map_err(|e| refused("TIFF", &e));
    Ok((side(size.width)?, side(size.height)?))
}

pub(super) fn refused(format: &'static str, why: &dyn std::fmt::Display) -> OutputError {
    OutputError::Encode { format, message: why.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::files::{Samples, read_image, read_npy};

    const SIZE: Size = Size::new(5, 4);

    fn stack(count: usize) -> Stack<f32> {
        let data = (0..count * SIZE.pixels()).map(|i| i as f32 / 64.0).collect();
        Stack::from_vec(count, SIZE, data).unwrap()
    }

    fn names(count: usize) -> Vec<String> {
        (0..count).map(|i| format!("S{i}")).collect()
    }

    fn read_back(ending: &str, bytes: &[u8]) -> Samples {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(format!("a.{ending}"));
        std::fs::write(&path, bytes).unwrap();
        read_image(&path).unwrap()
    }

    #[test]
    fn readings_come_back_as_counts_from_every_format() {
        for format in [Format::Npy, Format::Tiff, Format::OmeTiff, Format::Png16] {
            for count in [1, 3] {
                let mut bytes = vec![9; 3];
                encode_counts(format, &stack(count), 64.0, &mut bytes).unwrap();
                let Samples::U16(read) = read_back(format.image_ending(), &bytes) else { panic!("{format:?}") };
                let expected: Vec<u16> = (0..(count * SIZE.pixels()) as u16).collect();
                assert_eq!((read.size(), read.as_slice()), (SIZE, &expected[..]), "{format:?}");
            }
        }
    }

    #[test]
    fn floating_point_readings_come_back_bit_for_bit() {
        for (format, ending) in [(Format::Npy, "npy"), (Format::Tiff, "tif"), (Format::Png16, "npy")] {
            for count in [1, 3] {
                let mut bytes = Vec::new();
                encode_real(format, &stack(count), &mut bytes).unwrap();
                assert_eq!(read_back(ending, &bytes), Samples::F32(stack(count)), "{format:?}");
            }
        }
    }

    #[test]
    fn a_stack_has_a_page_for_each_plane_and_ome_names_them() {
        for format in [Format::Tiff, Format::OmeTiff] {
            let mut bytes = Vec::new();
            encode_stack(format, &names(3), "2026-01-02T03:04:05Z", &stack(3), &mut bytes).unwrap();
            let mut tiff = tiff::decoder::Decoder::new(Cursor::new(&bytes)).unwrap();
            let text = tiff.get_tag_ascii_string(Tag::ImageDescription).unwrap();
            if format == Format::OmeTiff {
                for part in
                    ["SizeC=\"3\"", "Name=\"S2\"", "<TiffData IFD=\"0\" PlaneCount=\"3\"", "2026-01-02T03:04:05Z"]
                {
                    assert!(text.contains(part), "{part} in {text}");
                }
            } else {
                assert!(text.starts_with("ImageJ=") && text.contains("channels=3"), "{text}");
            }
            for k in 0..3 {
                let tiff::decoder::DecodingResult::F32(plane) = tiff.read_image().unwrap() else { panic!("depth") };
                assert_eq!(plane, stack(3).plane(k));
                assert_eq!(tiff.more_images(), k < 2);
                if k < 2 {
                    tiff.next_image().unwrap();
                }
            }
        }
        let mut bytes = Vec::new();
        encode_stack(Format::Npy, &[], "", &stack(3), &mut bytes).unwrap();
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("a.npy"), &bytes).unwrap();
        let read = read_npy(&dir.path().join("a.npy")).unwrap();
        assert_eq!((read.shape.clone(), read.into_f32()), (vec![3, 4, 5], stack(3).as_slice().to_vec()));
    }

    #[test]
    fn names_cannot_break_the_xml_and_must_be_as_many_as_planes() {
        assert!(ome_xml(SIZE, &["a<\"&".to_owned()], 1, None, "").contains("Name=\"a&lt;&quot;&amp;\""));
        assert!(encode_stack(Format::OmeTiff, &names(2), "", &stack(3), &mut Vec::new()).is_err());
    }
}
