//! Files of many images of one size: NPY arrays with a leading axis, TIFF with several pages.

use std::fs::File;
use std::io::{BufReader, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use tiff::decoder::Decoder;

use super::{Array, ArrayError, Samples, image, npy, open, unsupported};

/// An opened file of several images. They are read one by one.
pub struct ImageStack {
    path: PathBuf,
    length: u64,
    content: Content,
}

enum Content {
    /// `[N, H, W]`, `[N, C, H, W]` or `[N, H, W, 3]`.
    Npy {
        file: File,
        header: npy::Header,
        kind: npy::Kind,
    },
    Tiff {
        decoder: Box<Decoder<BufReader<File>>>,
        pages: Vec<usize>,
    },
}

impl ImageStack {
    /// Opens a file of several images; none for a file of one.
    ///
    /// # Errors
    /// [`ArrayError`]: the file is missing, damaged, or an array whose images are not stored one after another.
    pub fn open(path: &Path) -> Result<Option<Self>, ArrayError> {
        let (file, length) = open(path)?;
        let content = match image::FileType::of(path, &file)? {
            image::FileType::Npy => {
                let header = npy::read_header(path, &mut BufReader::new(&file))?;
                let many = match header.shape[..] {
                    [count, _, last] => !matches!(count, 1 | 3) && last != 3,
                    [_, 1 | 3, _, _] | [_, _, _, 3] => true,
                    _ => false,
                };
                if !many {
                    return Ok(None);
                }
                if header.fortran {
                    return Err(unsupported(path, "order", "Fortran", "C, for a stack: numpy.ascontiguousarray"));
                }
                let kind = npy::check(path, &header, length)?;
                Content::Npy { file, header, kind }
            }
            image::FileType::Tiff => {
                let mut decoder = Box::new(image::tiff_decoder(path, BufReader::new(file))?);
                let pages = image::pages(path, &mut decoder)?;
                if pages.len() < 2 {
                    return Ok(None);
                }
                Content::Tiff { decoder, pages }
            }
            image::FileType::Png => return Ok(None),
        };
        Ok(Some(Self { path: path.to_path_buf(), length, content }))
    }

    /// Number of images.
    pub fn count(&self) -> usize {
        match &self.content {
            Content::Npy { header, .. } => header.shape[0],
            Content::Tiff { pages, .. } => pages.len(),
        }
    }

    /// Reads image `index`.
    ///
    /// # Errors
    /// [`ArrayError`] as [`super::read_image`].
    ///
    /// # Panics
    /// Unless `index` is below [`Self::count`].
    pub fn read(&mut self, index: usize) -> Result<Samples, ArrayError> {
        let path = &self.path;
        match &mut self.content {
            Content::Npy { file, header, kind } => {
                let shape = header.shape[1..].to_vec();
                let values = shape.iter().product::<usize>();
                let io = |source| ArrayError::Io { path: path.clone(), source };
                let first = header.bytes as u64 + (index * values * kind.width()) as u64;
                file.seek(SeekFrom::Start(first)).map_err(io)?;
                let samples = npy::read_samples(&mut BufReader::new(&*file), kind, values).map_err(io)?;
                image::from_array(path, Array { shape, samples })
            }
            Content::Tiff { decoder, pages } => {
                decoder.seek_to_image(pages[index]).map_err(|e| image::damaged_tiff(path, e))?;
                image::check_page(path, decoder)?;
                image::decode_page(path, decoder, self.length)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use tiff::encoder::{TiffEncoder, colortype};

    use super::*;
    use crate::files::{read_image, write_npy};

    fn value(samples: Samples) -> f32 {
        match samples {
            Samples::U16(s) => f32::from(s.as_slice()[0]),
            Samples::F32(s) => s.as_slice()[0],
            Samples::U8(_) => panic!("8 bit"),
        }
    }

    #[test]
    fn arrays_of_many_frames_are_stacks_and_colours_are_not() {
        let dir = tempfile::tempdir().unwrap();
        for (shape, count) in [
            (&[5, 2, 4][..], Some(5)),
            (&[3, 2, 4], None),
            (&[2, 4], None),
            (&[2, 4, 3], None),
            (&[6, 3, 2, 4], Some(6)),
        ] {
            let path = dir.path().join("a.npy");
            let n: usize = shape.iter().product();
            write_npy(&path, shape, &(0..n).map(|i| i as f32).collect::<Vec<_>>()).unwrap();
            let stack = ImageStack::open(&path).unwrap();
            assert_eq!(stack.as_ref().map(ImageStack::count), count, "{shape:?}");
            if let Some(mut stack) = stack {
                let last = stack.count() - 1;
                for index in [last, 0, 1] {
                    assert_eq!(value(stack.read(index).unwrap()), (index * n / (last + 1)) as f32);
                }
            }
        }
    }

    #[test]
    fn pages_of_a_tiff_are_read_each_and_previews_are_passed_over() {
        let mut out = Cursor::new(Vec::new());
        let mut tiff = TiffEncoder::new(&mut out).unwrap();
        for (level, preview) in [(7, false), (8, true), (9, false)] {
            let mut page = tiff.new_image::<colortype::Gray16>(3, 2).unwrap();
            page.encoder().write_tag(tiff::tags::Tag::NewSubfileType, u32::from(preview)).unwrap();
            page.write_data(&[level; 6]).unwrap();
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        std::fs::write(&path, out.into_inner()).unwrap();
        let mut stack = ImageStack::open(&path).unwrap().unwrap();
        assert_eq!((stack.count(), value(stack.read(1).unwrap()), value(stack.read(0).unwrap())), (2, 9.0, 7.0));
        let e = read_image(&path).unwrap_err().to_string();
        assert!(e.contains("number of pages is 2, allowed: 1"), "{e}");
    }
}
