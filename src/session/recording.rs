//! Recorded results of a session: one frame at a time, or as an OME-TIFF file that is never whole in memory.

use std::path::{Path, PathBuf};

use super::SessionError;
use super::layout::{Content, DESCRIPTION, Description, FrameEntry};
use super::read::{describe, find, frames, refuse};
use crate::files::{self, Array, ImageStack, Samples};
use crate::output::export::{aolp_plane, dolp_plane, push_angles};
use crate::output::stack_file::StackFile;
use stokescope_core::image::{Size, Stack};

/// The results of a session. Their planes are the recorded Stokes images, and DoLP and AoLP where there is polarization.
#[derive(Debug)]
pub struct Recording {
    /// Folder of the session.
    pub session: PathBuf,
    /// Names of the planes of a frame.
    pub planes: Vec<String>,
    /// Size of every plane.
    pub size: Size,
    /// Number of frames that are left out because their sidecar cannot be used or one of their files is missing. Each is named in the log.
    pub damaged: u64,
    description: Description,
    frames: Vec<FrameEntry>,
}

impl Recording {
    /// Opens the session `dir`, or the newest one in it.
    ///
    /// # Errors
    /// [`SessionError::Replay`] when there is no session, it cannot be read, or it has no frame with Stokes images.
    pub fn open(dir: &Path) -> Result<Self, SessionError> {
        let session = find(dir)?;
        let description = describe(&session.join(DESCRIPTION))?;
        let (mut frames, mut damaged) = frames(&session)?;
        if frames.iter().all(|frame| frame.file(Content::Stokes).is_none()) {
            let problem = "no frame with Stokes images, as in a recording of the format png16: `stokescope replay` solves its frames again";
            return Err(refuse(&session, problem));
        }
        frames.retain(|frame| {
            let there = frame.file(Content::Stokes).is_some_and(|file| session.join(file).is_file());
            if !there {
                tracing::warn!("left out: {}: a frame without its file in stokes/", session.display());
                damaged += 1;
            }
            there
        });
        let [width, height] = description.size;
        let mut planes = description.planes.clone();
        if planes.len() == 3 * description.channels {
            planes.extend(["DoLP".to_owned(), "AoLP (degrees)".to_owned()]);
        }
        Ok(Self { session, planes, size: Size::new(width, height), damaged, description, frames })
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether there is no frame.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Name of frame `index`: that of its file without folder and ending.
    pub fn name(&self, index: usize) -> String {
        let file = self.frames[index].file(Content::Stokes).and_then(|file| Path::new(file).file_name()?.to_str());
        file.and_then(|name| name.split('.').next()).unwrap_or_default().to_owned()
    }

    /// Usual time between two frames in seconds; none for a single frame.
    pub fn interval(&self) -> Option<f64> {
        let step = |pair: &[FrameEntry]| pair[1].raw_seconds - pair[0].raw_seconds;
        let mut steps: Vec<f64> = self.frames.windows(2).map(step).filter(|step| *step > 0.0).collect();
        steps.sort_by(f64::total_cmp);
        steps.get(steps.len() / 2).copied()
    }

    /// Reads the planes of frame `index`.
    ///
    /// # Errors
    /// [`SessionError::Replay`] for a file that cannot be read, or has other planes than the session says.
    pub fn read(&self, index: usize) -> Result<Stack<f32>, SessionError> {
        let stack = self.stokes(index)?;
        if self.planes.len() == stack.count() {
            return Ok(stack);
        }
        let mut planes = stack.as_slice().to_vec();
        push_angles(&stack, self.description.channels, &mut planes);
        Stack::from_vec(self.planes.len(), self.size, planes).map_err(|e| refuse(&self.session, &e))
    }

    /// Reads the Stokes images of frame `index`.
    fn stokes(&self, index: usize) -> Result<Stack<f32>, SessionError> {
        let path = self.session.join(self.frames[index].file(Content::Stokes).unwrap_or_default());
        let recorded = self.description.planes.len();
        let values = stokes(&path, recorded * self.size.pixels()).map_err(|e| refuse(&path, &e))?;
        Stack::from_vec(recorded, self.size, values).map_err(|e| refuse(&path, &e))
    }
}

/// Bytes of a part of a file.
const CHUNK: usize = 32 << 10;

/// All planes of a session's frames as an OME-TIFF file, part by part. Holds the Stokes images of one frame and one page.
pub(crate) struct OmeTiff {
    recording: Recording,
    file: StackFile,
    /// Stokes images of the frame that is being written.
    stokes: Stack<f32>,
    /// Number of the next page.
    page: usize,
    /// Bytes of a page, of which this many were given.
    ready: Vec<u8>,
    given: usize,
}

impl OmeTiff {
    /// A file of the frames of `recording`.
    ///
    /// # Errors
    /// [`SessionError::Replay`] for frames that are too large.
    pub(crate) fn new(recording: Recording) -> Result<Self, SessionError> {
        let Recording { planes, size, .. } = &recording;
        let file = StackFile::new(planes, *size, recording.len(), recording.interval());
        let file = file.map_err(|e| refuse(&recording.session, &e))?;
        Ok(Self { recording, file, stokes: Stack::default(), page: 0, ready: Vec::new(), given: 0 })
    }

    /// Bytes that are held at most while a file of frames of `pixels` pixels and so many `channels` is made: Stokes images, a plane that
    /// is computed from them, and a page.
    pub(crate) fn bytes(pixels: usize, channels: usize) -> usize {
        (3 * channels + 2) * pixels * size_of::<f32>()
    }

    /// Bytes of the whole file.
    pub(crate) fn total_bytes(&self) -> u64 {
        self.file.total_bytes()
    }

    /// The next part; none after the last.
    ///
    /// # Errors
    /// [`SessionError::Replay`] for a frame that cannot be read.
    pub(crate) fn part(&mut self) -> Result<Option<Vec<u8>>, SessionError> {
        if self.given == self.ready.len() {
            if self.file.is_complete() {
                return Ok(None);
            }
            self.ready = Vec::new();
            self.write_page()?;
            (self.ready, self.given) = (self.file.take(), 0);
        }
        let part = &self.ready[self.given..];
        let part = part[..part.len().min(CHUNK)].to_vec();
        self.given += part.len();
        Ok(Some(part))
    }

    fn write_page(&mut self) -> Result<(), SessionError> {
        let Self { recording, file, stokes, page, .. } = self;
        let (frame, plane) = (*page / recording.planes.len(), *page % recording.planes.len());
        if plane == 0 {
            // the memory of the frame before is free before the next one takes some
            *stokes = Stack::default();
            *stokes = recording.stokes(frame)?;
        }
        let channels = recording.description.channels;
        let written = match plane.checked_sub(stokes.count()) {
            None => file.write(stokes.plane(plane)),
            Some(0) => file.write(&dolp_plane(stokes, channels).collect::<Vec<_>>()),
            Some(_) => file.write(&aolp_plane(stokes, channels).collect::<Vec<_>>()),
        };
        *page += 1;
        written.map_err(|e| refuse(&recording.session, &e))
    }
}

/// The `count` values of a file of Stokes images.
fn stokes(path: &Path, count: usize) -> Result<Vec<f32>, String> {
    let values = if files::has_extension(path, &["npy"]) {
        Array::into_f32(files::read_npy(path).map_err(|e| e.to_string())?)
    } else {
        let mut pages = Vec::with_capacity(count);
        let mut take = |page: Samples| match page {
            Samples::F32(page) => {
                pages.extend_from_slice(page.as_slice());
                Ok(())
            }
            _ => Err("integers, allowed: floating point".to_owned()),
        };
        match ImageStack::open(path).map_err(|e| e.to_string())? {
            Some(mut stack) => {
                (0..stack.count()).try_for_each(|page| take(stack.read(page).map_err(|e| e.to_string())?))?;
            }
            None => take(files::read_image(path).map_err(|e| e.to_string())?)?,
        }
        pages
    };
    let finite = values.iter().all(|v| v.is_finite());
    match values.len() == count {
        true if finite => Ok(values),
        true => Err("a value that is not finite".to_owned()),
        false => Err(format!("{} values, allowed: {count}, as session.json says", values.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::super::storage::Disk;
    use super::super::write::tests::{options, record, writer};
    use super::*;
    use crate::output::export::Format;

    #[test]
    fn a_file_of_all_frames_is_made_in_parts_and_a_frame_that_goes_away_ends_it() {
        for format in [Format::Npy, Format::Tiff, Format::OmeTiff] {
            let dir = tempfile::tempdir().unwrap();
            let (mut writer, _bundle) = writer(options(dir.path(), format), Disk);
            (0..3).for_each(|number| record(&mut writer, number, true).unwrap());
            let recording = Recording::open(dir.path()).unwrap();
            let (session, last) = (recording.session.clone(), recording.read(2).unwrap());
            let mut file = OmeTiff::new(recording).unwrap();
            let (total, mut bytes) = (file.total_bytes(), Vec::new());
            while let Some(part) = file.part().unwrap() {
                assert!(!part.is_empty() && part.len() <= CHUNK);
                bytes.extend(part);
            }
            assert_eq!(bytes.len() as u64, total, "{format:?}");
            let path = dir.path().join("all.ome.tif");
            std::fs::write(&path, bytes).unwrap();
            let mut stack = ImageStack::open(&path).unwrap().unwrap();
            let count = last.count();
            assert_eq!(stack.count(), 3 * count);
            for plane in 0..count {
                let Samples::F32(page) = stack.read(2 * count + plane).unwrap() else { panic!("depth") };
                assert_eq!(page.as_slice(), last.plane(plane), "{format:?} plane {plane}");
            }

            let mut file = OmeTiff::new(Recording::open(dir.path()).unwrap()).unwrap();
            std::fs::remove_dir_all(session.join("stokes")).unwrap();
            let error = file.part().unwrap_err().to_string();
            assert!(error.contains("stokes") && error.contains("00000000"), "{error}");
        }
    }
}
