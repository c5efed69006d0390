//! Removal of the oldest recorded frames and sessions.
//!
//! A removal first hides a sidecar or a whole session under the name `.removed-…`, makes that name durable, and only then deletes
//! files. A process that is killed or a power cut in between leaves hidden remains, never a sidecar without its files. The next
//! process that records into the folder deletes the remains.

use std::collections::VecDeque;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::RecordOptions;
use super::layout::{FrameEntry, FrameFiles, REMOVED, SIDECARS, hidden, sessions, sidecar};
use super::storage::{RecordError, Storage};

/// One recorded frame of the current session.
#[derive(Clone, Copy, Debug)]
struct RecordedFrame {
    number: u64,
    bytes: u64,
}

/// One session that was recorded before the current one.
#[derive(Clone, Debug)]
struct RecordedSession {
    folder: PathBuf,
    frames: u64,
    bytes: u64,
}

/// Recorded frames and bytes of all sessions in a folder, and the limits on them.
///
/// Nothing is counted or remembered of single frames and earlier sessions when there are no limits: memory stays bounded then,
/// and with limits the number of frames is.
#[derive(Debug)]
pub(super) struct Inventory {
    max_frames: Option<u64>,
    max_bytes: Option<u64>,
    /// Oldest first.
    earlier: VecDeque<RecordedSession>,
    /// Oldest first.
    current: VecDeque<RecordedFrame>,
    frames: u64,
    bytes: u64,
    /// Recorded frames that were removed to make room.
    pub(super) removed: u64,
}

impl Inventory {
    /// Counts the sessions that are there.
    pub(super) fn scan(options: &RecordOptions) -> Self {
        let &RecordOptions { max_frames, max_bytes, .. } = options;
        let limited = max_frames.is_some() || max_bytes.is_some();
        let found = if limited { sessions(&options.dir).unwrap_or_default() } else { Vec::new() };
        let count = |folder: PathBuf| {
            let (frames, bytes) = usage(&folder);
            RecordedSession { folder, frames, bytes }
        };
        let earlier: VecDeque<_> = found.into_iter().map(count).collect();
        let frames = earlier.iter().map(|session| session.frames).sum();
        let bytes = earlier.iter().map(|session| session.bytes).sum();
        Self { max_frames, max_bytes, earlier, current: VecDeque::new(), frames, bytes, removed: 0 }
    }

    /// Counts bytes that the current session takes beside its frames.
    pub(super) fn add_bytes(&mut self, bytes: u64) {
        self.bytes += bytes;
    }

    /// Counts a frame that was recorded into the current session.
    pub(super) fn add_frame(&mut self, number: u64, bytes: u64) {
        self.frames += 1;
        self.bytes += bytes;
        if self.max_frames.is_some() || self.max_bytes.is_some() {
            self.current.push_back(RecordedFrame { number, bytes });
        }
    }

    fn is_full(&self, need: u64) -> bool {
        self.max_frames.is_some_and(|most| self.frames + 1 > most)
            || self.max_bytes.is_some_and(|most| self.bytes + need > most)
    }

    /// Removes the oldest sessions, then the oldest frames of the current one in `folder`, until a frame of `need` bytes is
    /// within the limits.
    ///
    /// # Errors
    /// [`RecordError::Disk`] when a removal fails. The next call goes on with it.
    pub(super) fn make_room<S: Storage>(
        &mut self,
        storage: &S,
        folder: Option<&Path>,
        files: &FrameFiles,
        need: u64,
    ) -> Result<(), RecordError> {
        while self.is_full(need) {
            let (frames, bytes) = if let Some(session) = self.earlier.front() {
                remove_session(storage, &session.folder)?;
                (session.frames, session.bytes)
            } else if let (Some(folder), Some(frame)) = (folder, self.current.front()) {
                remove_frame(storage, folder, files, frame.number)?;
                (1, frame.bytes)
            } else {
                break;
            };
            if self.earlier.pop_front().is_none() {
                self.current.pop_front();
            }
            self.frames = self.frames.saturating_sub(frames);
            self.bytes = self.bytes.saturating_sub(bytes);
            self.removed += frames;
        }
        Ok(())
    }
}

/// Frames and bytes of a folder.
pub(super) fn usage(dir: &Path) -> (u64, u64) {
    let mut sum = (0, 0);
    for entry in fs::read_dir(dir).into_iter().flatten().flatten() {
        let Ok(meta) = entry.metadata() else { continue };
        if meta.is_dir() {
            let (frames, bytes) = usage(&entry.path());
            sum = (sum.0 + frames, sum.1 + bytes);
        } else {
            sum.0 += u64::from(dir.ends_with(SIDECARS));
            sum.1 += meta.len();
        }
    }
    sum
}

/// Turns the absence of what is to be removed into success: an earlier attempt got this far.
fn absent_is_done(path: &Path, outcome: io::Result<()>) -> Result<(), RecordError> {
    match outcome {
        Err(e) if e.kind() != io::ErrorKind::NotFound => Err(RecordError::disk(path, e)),
        _ => Ok(()),
    }
}

/// Renames `path` to its hidden name, durably.
fn hide<S: Storage>(storage: &S, path: &Path) -> Result<PathBuf, RecordError> {
    let hidden = hidden(path);
    absent_is_done(path, storage.rename(path, &hidden))?;
    let folder = path.parent().unwrap_or(Path::new("."));
    storage.sync_folder(folder).map_err(|e| RecordError::disk(folder, e))?;
    Ok(hidden)
}

/// Removes a frame. Can be called again when it fails.
///
/// # Errors
/// [`RecordError::Disk`]. The frame is then whole or without a visible sidecar.
pub(super) fn remove_frame<S: Storage>(
    storage: &S,
    session: &Path,
    files: &FrameFiles,
    number: u64,
) -> Result<(), RecordError> {
    let hidden = hide(storage, &session.join(sidecar(number)))?;
    for path in files.iter().map(|file| session.join(file.path(number))).chain([hidden]) {
        absent_is_done(&path, storage.remove_file(&path))?;
    }
    Ok(())
}

/// Removes a session. Can be called again when it fails.
///
/// # Errors
/// [`RecordError::Disk`]. The session is then whole or hidden.
pub(super) fn remove_session<S: Storage>(storage: &S, session: &Path) -> Result<(), RecordError> {
    let hidden = hide(storage, session)?;
    absent_is_done(&hidden, storage.remove_folder(&hidden))
}

/// Finishes the removals that an interrupted process began in `dir` and its sessions, and deletes temporary files.
///
/// # Errors
/// When a folder cannot be read or a file cannot be removed.
pub(super) fn finish_removals(dir: &Path) -> io::Result<()> {
    for entry in fs::read_dir(dir)?.flatten() {
        let (path, name) = (entry.path(), entry.file_name());
        let (name, is_folder) = (name.to_string_lossy(), entry.file_type().is_ok_and(|kind| kind.is_dir()));
        if name.starts_with(REMOVED) && is_folder {
            fs::remove_dir_all(&path)?;
        } else if name.starts_with(REMOVED) {
            finish_frame(dir, &path)?;
        } else if name.starts_with('.') && name.ends_with(".part") {
            fs::remove_file(&path)?;
        } else if is_folder {
            finish_removals(&path)?;
        }
    }
    Ok(())
}

/// Removes the files that a hidden sidecar in the folder `sidecars` names, then the sidecar.
fn finish_frame(sidecars: &Path, path: &Path) -> io::Result<()> {
    let session = sidecars.parent().unwrap_or(sidecars);
    // a sidecar that cannot be read names no files: it is removed alone
    let files = FrameEntry::read(path).map(|entry| entry.files).unwrap_or_default();
    for file in files {
        match fs::remove_file(session.join(file)) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
    }
    fs::remove_file(path)
}

#[cfg(test)]
mod tests {
    use super::super::lock::FolderLock;
    use super::super::storage::tests::FailingDisk;
    use super::super::write::tests::{check, options, record, writer};
    use super::*;
    use crate::output::export::Format;
    use crate::session::Disk;

    /// A folder in memory where there is one: a disk would be synced thousands of times.
    fn memory() -> tempfile::TempDir {
        tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap()
    }

    /// Records two sessions and keeps two frames, so that the first session and then a frame of the second one are removed, on a
    /// disk that fails for good after `after` operations. Gives the disk and the number of frames that were not recorded.
    fn prune(dir: &Path, after: i64) -> (FailingDisk, usize) {
        let (mut first, _bundle) = writer(options(dir, Format::Npy), Disk);
        (0..2).for_each(|number| record(&mut first, number, true).unwrap());
        let few = RecordOptions { max_frames: Some(2), ..options(dir, Format::Npy) };
        let (mut second, _bundle) = writer(few, FailingDisk::new(after, i64::MAX / 2));
        let failed = (0..3).filter(|&number| record(&mut second, number, number != 1).is_err()).count();
        (second.into_storage(), failed)
    }

    /// Names of the hidden files and folders under `dir`.
    fn remains(dir: &Path) -> Vec<PathBuf> {
        let mut found = Vec::new();
        for path in fs::read_dir(dir).unwrap().flatten().map(|entry| entry.path()) {
            if path.file_name().unwrap().to_string_lossy().starts_with(REMOVED) {
                found.push(path);
            } else if path.is_dir() {
                found.extend(remains(&path));
            }
        }
        found
    }

    #[test]
    fn a_removal_that_is_interrupted_leaves_no_sidecar_without_its_files() {
        let (mut interrupted, mut cuts) = (0, 0);
        for after in 0.. {
            let dir = memory();
            let (disk, failed) = prune(dir.path(), after);
            // the process is killed: everything that was done is there
            check(dir.path());
            interrupted += remains(dir.path()).len();
            // the power is cut: in one folder, the changes that were not synced are lost
            for folder in 0..disk.unsynced().len() {
                let dir = memory();
                let (disk, _) = prune(dir.path(), after);
                disk.cut_power(&disk.unsynced()[folder]);
                check(dir.path());
                cuts += 1;
                // the next process finishes what was begun
                drop(FolderLock::take(dir.path()).unwrap());
                assert!(remains(dir.path()).is_empty() && check(dir.path()) <= 2, "operation {after}");
            }
            if failed == 0 {
                break;
            }
        }
        assert!(interrupted > 10 && cuts > 10, "{interrupted} removals interrupted, {cuts} power cuts");
    }
}
