//! Recorded results of a session, one frame at a time.

use std::path::{Path, PathBuf};

use super::SessionError;
use super::layout::{Content, DESCRIPTION, Description, FrameEntry};
use super::read::{describe, find, frames, refuse};
use crate::files::{self, Array, ImageStack, Samples};
use crate::output::export::push_angles;
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
        let path = self.session.join(self.frames[index].file(Content::Stokes).unwrap_or_default());
        let wrong = |e: &dyn std::fmt::Display| refuse(&path, &e.to_string());
        let recorded = self.description.planes.len();
        let mut values = stokes(&path, recorded * self.size.pixels()).map_err(|e| wrong(&e))?;
        if self.planes.len() > recorded {
            let stack = Stack::from_vec(recorded, self.size, values).map_err(|e| wrong(&e))?;
            let mut planes = stack.as_slice().to_vec();
            push_angles(&stack, self.description.channels, &mut planes);
            values = planes;
        }
        Stack::from_vec(self.planes.len(), self.size, values).map_err(|e| wrong(&e))
    }
}

/// The `count` values of a file of Stokes images.
fn stokes(path: &Path, count: usize) -> Result<Vec<f32>, String> {
    let values = if files::has_extension(path, &["npy"]) {
        Array::into_f32(files::read_npy(path).map_err(|e| e.to_string())?)
    } else {
        let mut pages = Vec::new();
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
