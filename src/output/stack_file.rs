//! OME-TIFF files of many frames, made page by page: every part of a file is given away as soon as no later page changes it.

use std::io::{self, Seek, SeekFrom, Write};
use std::sync::{Arc, Mutex, PoisonError};

use tiff::encoder::{TiffEncoder, TiffKindBig};

use super::OutputError;
use super::export::{imagej_metadata, ome_xml, refused, write_page};
use stokescope_core::image::Size;

/// Bytes at the end of a page that the next page changes: the place of the next page's directory.
const LINK: usize = size_of::<u64>();

/// The end of a file, whose bytes before `begin` were given away.
#[derive(Debug, Default)]
struct Tail {
    begin: u64,
    bytes: Vec<u8>,
    /// Place of the next byte in `bytes`.
    at: usize,
}

/// A [`Tail`] that the encoder writes and its owner reads.
#[derive(Clone, Debug, Default)]
struct Shared(Arc<Mutex<Tail>>);

impl Shared {
    fn with<T>(&self, work: impl FnOnce(&mut Tail) -> T) -> T {
        work(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Write for Shared {
    fn write(&mut self, given: &[u8]) -> io::Result<usize> {
        self.with(|tail| {
            let over = given.len().min(tail.bytes.len() - tail.at);
            tail.bytes[tail.at..tail.at + over].copy_from_slice(&given[..over]);
            tail.bytes.extend_from_slice(&given[over..]);
            tail.at += given.len();
        });
        Ok(given.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Seek for Shared {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        self.with(|tail| {
            let to = match to {
                SeekFrom::Start(to) => Some(to),
                SeekFrom::Current(by) => (tail.begin + tail.at as u64).checked_add_signed(by),
                SeekFrom::End(by) => (tail.begin + tail.bytes.len() as u64).checked_add_signed(by),
            };
            let at = to.and_then(|to| to.checked_sub(tail.begin)).and_then(|at| usize::try_from(at).ok());
            tail.at = at
                .filter(|at| *at <= tail.bytes.len())
                .ok_or_else(|| io::Error::other("a place in the file that was given away, or is not yet there"))?;
            Ok(tail.begin + tail.at as u64)
        })
    }
}

/// An OME-TIFF file (BigTIFF) of the named planes of many frames, one page a plane, in the order of time.
pub struct StackFile {
    tiff: TiffEncoder<Shared, TiffKindBig>,
    tail: Shared,
    size: Size,
    /// Pages that are still to be written.
    left: usize,
    /// Description of the first page, until it is written.
    first: Option<(String, Vec<u8>, Vec<u32>)>,
    /// Bytes of a page after the first.
    page_bytes: usize,
    total_bytes: u64,
}

impl StackFile {
    /// Begins a file of `frames` frames, `interval` seconds apart.
    ///
    /// # Errors
    /// [`OutputError::Encode`] for planes that are too large.
    pub fn new(names: &[String], size: Size, frames: usize, interval: Option<f64>) -> Result<Self, OutputError> {
        // a page begins at a multiple of four bytes: all pages after the second take the same number
        let mut sample = Self::begin(names, size, frames, interval)?;
        let blank = vec![0.0; size.pixels()];
        let mut measure = || {
            sample.left = 2;
            sample.write(&blank)?;
            Ok::<_, OutputError>(sample.take().len())
        };
        // the link of a page is given with the page after it
        let (first, second, later) = (measure()? + LINK, measure()?, measure()?);
        let total = |pages: usize| match pages {
            0 | 1 => first as u64,
            _ => (first + second) as u64 + (pages - 2) as u64 * later as u64,
        };
        let total_bytes = total(frames * names.len());
        Ok(Self { page_bytes: later, total_bytes, ..Self::begin(names, size, frames, interval)? })
    }

    fn begin(names: &[String], size: Size, frames: usize, interval: Option<f64>) -> Result<Self, OutputError> {
        let (metadata, counts) = imagej_metadata(names, frames);
        let first = Some((ome_xml(size, names, frames, interval, ""), metadata, counts));
        let tail = Shared::default();
        let tiff = TiffEncoder::new_big(tail.clone()).map_err(|e| refused("TIFF", &e))?;
        Ok(Self { tiff, tail, size, left: frames * names.len(), first, page_bytes: 0, total_bytes: 0 })
    }

    /// Bytes of the whole file.
    pub fn total_bytes(&self) -> u64 {
        self.total_bytes
    }

    /// Whether every page was written.
    pub fn is_complete(&self) -> bool {
        self.left == 0
    }

    /// Writes the next page.
    ///
    /// # Errors
    /// [`OutputError::Encode`] for a plane of another size, or one too many.
    pub fn write(&mut self, plane: &[f32]) -> Result<(), OutputError> {
        if plane.len() != self.size.pixels() || self.left == 0 {
            let (found, left) = (plane.len(), self.left);
            return Err(refused("TIFF", &format!("{found} values for one of {left} planes of {}", self.size)));
        }
        self.tail.with(|tail| tail.bytes.reserve_exact(self.page_bytes));
        let first = self.first.take();
        let tags = first.as_ref().map(|(text, metadata, counts)| (&**text, &**metadata, &**counts));
        write_page(&mut self.tiff, self.size, plane, tags, None)?;
        self.left -= 1;
        Ok(())
    }

    /// The bytes that follow those given before and that no later page changes.
    pub fn take(&mut self) -> Vec<u8> {
        let kept = if self.left == 0 { 0 } else { LINK };
        self.tail.with(|tail| {
            let link = tail.bytes.split_off(tail.bytes.len().saturating_sub(kept));
            tail.begin += tail.bytes.len() as u64;
            tail.at = link.len();
            std::mem::replace(&mut tail.bytes, link)
        })
    }
}

#[cfg(test)]
mod tests {
    use tiff::decoder::{Decoder, DecodingResult};
    use tiff::tags::Tag;

    use super::*;

    #[test]
    fn the_parts_of_a_file_have_the_length_that_was_told_and_are_read_back() {
        for (name, size, frames) in [("a", Size::new(3, 1), 1), ("bc", Size::new(2, 3), 3), ("def", Size::new(5, 4), 7)]
        {
            let names = [name.to_owned(), "S1".to_owned()];
            let mut file = StackFile::new(&names, size, frames, Some(0.125)).unwrap();
            let (total, mut bytes) = (file.total_bytes(), Vec::new());
            let plane = |page: usize| vec![page as f32 + 0.5; size.pixels()];
            for page in 0..2 * frames {
                assert!(!file.is_complete());
                file.write(&plane(page)).unwrap();
                let part = file.take();
                assert!(page == 0 || part.len() <= file.page_bytes + LINK + 3, "{} bytes of one page", part.len());
                bytes.extend(part);
            }
            assert!(file.is_complete() && file.write(&plane(0)).is_err());
            assert_eq!(bytes.len() as u64, total, "{name} {size} {frames}");
            let mut read = Decoder::new(io::Cursor::new(bytes)).unwrap();
            let text = read.get_tag_ascii_string(Tag::ImageDescription).unwrap();
            assert!(text.contains(&format!("SizeT=\"{frames}\" TimeIncrement=\"0.125\"")), "{text}");
            for page in 0..2 * frames {
                let DecodingResult::F32(found) = read.read_image().unwrap() else { panic!("depth") };
                assert_eq!(found, plane(page));
                assert_eq!(read.more_images(), page + 1 < 2 * frames);
                if read.more_images() {
                    read.next_image().unwrap();
                }
            }
        }
    }

    #[test]
    fn a_plane_of_another_size_is_refused() {
        let mut file = StackFile::new(&["S0".to_owned()], Size::new(2, 2), 1, None).unwrap();
        assert!(file.write(&[0.0; 3]).unwrap_err().to_string().contains("3 values for one of 1 planes of 2×2"));
    }
}
