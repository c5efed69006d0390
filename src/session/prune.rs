//! Removal of the oldest recorded frames and sessions, and of what an interrupted process left.
//!
//! A removal first hides a sidecar or a whole session under a name of our own, makes that name durable, and only then deletes
//! files. A process that is killed or a power cut in between leaves hidden remains, never a sidecar without its files. The next
//! process that records into the folder deletes the remains.
//!
//! Only files that this program makes are deleted: those with its names in the folders of a session, which are looked into one by one,
//! never through a symbolic link. Anything else stays, and is named in a warning.

use std::collections::VecDeque;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::RecordOptions;
use super::layout::{
    CALIBRATION, DESCRIPTION, FOLDERS, FrameEntry, FrameFiles, NEW, REMOVED, SIDECARS, THUMBNAIL, hidden, is_folder,
    list, number, sidecar,
};
use super::storage::{Disk, RecordError, Storage};
use crate::files::{TEMPORARY, UNFINISHED};

/// Most names in one warning.
const NAMED: usize = 8;

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
    /// Whether the last removal of a frame failed, which is said once.
    stuck: bool,
}

impl Inventory {
    /// Counts the sessions that are there.
    pub(super) fn scan(options: &RecordOptions) -> Self {
        let &RecordOptions { max_frames, max_bytes, .. } = options;
        let limited = max_frames.is_some() || max_bytes.is_some();
        let found = if limited { list(&options.dir).unwrap_or_default().sessions } else { Vec::new() };
        let count = |folder: PathBuf| {
            let (frames, bytes) = usage(&folder);
            RecordedSession { folder, frames, bytes }
        };
        let earlier: VecDeque<_> = found.into_iter().map(count).collect();
        let frames = earlier.iter().map(|session| session.frames).sum();
        let bytes = earlier.iter().map(|session| session.bytes).sum();
        Self { max_frames, max_bytes, earlier, current: VecDeque::new(), frames, bytes, removed: 0, stuck: false }
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
    /// within the limits. What cannot be removed stays, is named, and no longer counts towards the limits until they are counted anew.
    pub(super) fn make_room<S: Storage>(&mut self, storage: &S, folder: Option<&Path>, files: &FrameFiles, need: u64) {
        while self.is_full(need) {
            let (frames, bytes, outcome) = if let Some(session) = self.earlier.pop_front() {
                let outcome = remove_session(storage, &session.folder);
                if let Err(e) = &outcome {
                    tracing::warn!("{}: cannot be removed to make room and stays: {e}", session.folder.display());
                }
                (session.frames, session.bytes, outcome)
            } else if let (Some(folder), Some(frame)) = (folder, self.current.pop_front()) {
                let outcome = remove_frame(storage, folder, files, frame.number);
                if let (Err(e), false) = (&outcome, self.stuck) {
                    tracing::warn!("frame {} cannot be removed to make room and stays: {e}", frame.number);
                }
                self.stuck = outcome.is_err();
                (1, frame.bytes, outcome)
            } else {
                break;
            };
            self.frames = self.frames.saturating_sub(frames);
            self.bytes = self.bytes.saturating_sub(bytes);
            self.removed += if outcome.is_ok() { frames } else { 0 };
        }
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

/// Removes a session. Can be called again when it fails. A folder of this name without a description stays where the session held files
/// that are not ours.
///
/// # Errors
/// [`RecordError::Disk`]. The session is then whole or hidden.
pub(super) fn remove_session<S: Storage>(storage: &S, session: &Path) -> Result<(), RecordError> {
    let hidden = hide(storage, session)?;
    if is_folder(&hidden) && !remove_own(storage, &hidden)? {
        storage.rename(&hidden, session).map_err(|e| RecordError::disk(&hidden, e))?;
        tracing::warn!("{}: holds files that are no recording: they stay", session.display());
    }
    Ok(())
}

/// Whether this program makes files called `name` in the folder `folder` of a session. A bundle's files have names of any kind.
fn is_own(folder: &str, name: &str) -> bool {
    let digits = name.bytes().take_while(u8::is_ascii_digit).count();
    let frame = digits >= 8 && [".npy", ".tif", ".ome.tif", ".png", ".json"].contains(&&name[digits..]);
    let unfinished = name.starts_with(TEMPORARY) && name.ends_with(UNFINISHED);
    frame || unfinished || folder == CALIBRATION || (folder == SIDECARS && name.starts_with(REMOVED))
}

/// Removes the files of this program from the session `folder`, then the folders that are empty. Gives whether nothing is left.
///
/// # Errors
/// [`RecordError::Disk`].
pub(super) fn remove_own<S: Storage>(storage: &S, folder: &Path) -> Result<bool, RecordError> {
    let remove_folder = |path: &Path| match storage.remove_folder(path) {
        Err(e) if e.kind() == io::ErrorKind::DirectoryNotEmpty => Ok(false),
        outcome => absent_is_done(path, outcome).map(|()| true),
    };
    for part in FOLDERS {
        let path = folder.join(part);
        if !is_folder(&path) {
            continue;
        }
        for entry in fs::read_dir(&path).map_err(|e| RecordError::disk(&path, e))?.flatten() {
            let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
            if is_file && is_own(part, &entry.file_name().to_string_lossy()) {
                absent_is_done(&entry.path(), storage.remove_file(&entry.path()))?;
            }
        }
        remove_folder(&path)?;
    }
    let own = [DESCRIPTION, THUMBNAIL];
    let unfinished = unfinished(folder).map_err(|e| RecordError::disk(folder, e))?;
    for path in own.iter().map(|name| folder.join(name)).chain(unfinished) {
        absent_is_done(&path, storage.remove_file(&path))?;
    }
    remove_folder(folder)
}

/// Files in `folder` itself that were not finished.
fn unfinished(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let is_unfinished = |entry: &fs::DirEntry| {
        let name = entry.file_name().to_string_lossy().into_owned();
        name.starts_with(TEMPORARY) && name.ends_with(UNFINISHED) && entry.file_type().is_ok_and(|kind| kind.is_file())
    };
    Ok(fs::read_dir(folder)?.flatten().filter(is_unfinished).map(|entry| entry.path()).collect())
}

/// Deletes the files in `folder` itself that an interrupted process did not finish. One that cannot be deleted stays.
pub(crate) fn remove_unfinished(folder: &Path) {
    for path in unfinished(folder).unwrap_or_default() {
        complain(&path, fs::remove_file(&path).err());
    }
}

fn complain(path: &Path, problem: Option<impl std::fmt::Display>) {
    if let Some(e) = problem {
        tracing::warn!("{}: what an interrupted recording left cannot be removed and stays: {e}", path.display());
    }
}

/// Finishes the removals that an interrupted process began in `dir` and its sessions, and deletes its temporary files. Names everything in
/// `dir` that is not ours, which stays.
///
/// # Errors
/// When `dir` cannot be read. What cannot be removed stays, with a warning.
pub(super) fn finish_removals(dir: &Path) -> io::Result<()> {
    remove_unfinished(dir);
    for entry in fs::read_dir(dir)?.flatten() {
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        if !is_folder(&path) {
            continue;
        }
        if let Some(visible) = name.strip_prefix(REMOVED) {
            match remove_own(&Disk, &path) {
                // files that are not ours are shown again
                Ok(false) => complain(&path, fs::rename(&path, dir.join(visible)).err()),
                outcome => complain(&path, outcome.err()),
            }
        } else if name.starts_with(NEW) {
            complain(&path, remove_own(&Disk, &path).err());
        } else if number(&path).is_some() {
            finish_session(&path);
        }
    }
    let foreign = list(dir)?.foreign;
    if !foreign.is_empty() {
        let (more, names) = (foreign.len().saturating_sub(NAMED), foreign[..foreign.len().min(NAMED)].join(", "));
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        tracing::warn!("{}: left alone, because these are no sessions of this program: {names}{more}", dir.display());
    }
    Ok(())
}

/// Finishes the removals of frames that an interrupted process began in a session, and deletes its temporary files.
fn finish_session(session: &Path) {
    remove_unfinished(session);
    for folder in FOLDERS.map(|part| session.join(part)).iter().filter(|folder| is_folder(folder)) {
        remove_unfinished(folder);
    }
    let sidecars = session.join(SIDECARS);
    for entry in fs::read_dir(&sidecars).into_iter().flatten().flatten().filter(|_| is_folder(&sidecars)) {
        let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
        if is_file && entry.file_name().to_string_lossy().starts_with(REMOVED) {
            complain(&entry.path(), finish_frame(session, &entry.path()).err());
        }
    }
}

/// Removes the files that the hidden sidecar `path` of a session names, then the sidecar.
fn finish_frame(session: &Path, path: &Path) -> io::Result<()> {
    // a sidecar that cannot be read names no files: it is removed alone
    let files = FrameEntry::read(path).map(|entry| entry.files).unwrap_or_default();
    for file in files.iter().map(Path::new) {
        let (folder, name) = (file.parent().and_then(Path::to_str), file.file_name().and_then(|name| name.to_str()));
        let (Some(folder), Some(name)) = (folder, name) else { continue };
        if !FOLDERS.contains(&folder) || !is_own(folder, name) || !is_folder(&session.join(folder)) {
            continue;
        }
        match fs::remove_file(session.join(file)) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
            _ => {}
        }
    }
    fs::remove_file(path)
}

#[cfg(test)]
mod tests {
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
                finish_removals(dir.path()).unwrap();
                assert!(remains(dir.path()).is_empty() && check(dir.path()) <= 2, "operation {after}");
            }
            if failed == 0 {
                break;
            }
        }
        assert!(interrupted > 10 && cuts > 10, "{interrupted} removals interrupted, {cuts} power cuts");
    }

    /// Contents of a folder and everything below it, without what links lead to.
    fn tree(dir: &Path) -> Vec<(PathBuf, Option<Vec<u8>>)> {
        let mut found = Vec::new();
        for path in fs::read_dir(dir).unwrap().flatten().map(|entry| entry.path()) {
            found
                .push((path.clone(), fs::symlink_metadata(&path).unwrap().is_file().then(|| fs::read(&path).unwrap())));
            if is_folder(&path) {
                found.extend(tree(&path));
            }
        }
        found.sort();
        found
    }

    /// Puts things of other makers into a folder of sessions; gives all of them.
    #[cfg(unix)]
    fn strangers(dir: &Path) -> Vec<(PathBuf, Option<Vec<u8>>)> {
        for folder in ["session-notes/raw", "photos/.removed-2025", ".removed-mine", "lost+found", ".stokescope-mine"] {
            fs::create_dir_all(dir.join(folder)).unwrap();
            fs::write(dir.join(folder).join("00000000.npy"), "precious").unwrap();
        }
        for file in ["session-zzz.txt", "photos/.a.part", ".b.part", "session-notes/session.json"] {
            fs::write(dir.join(file), "{}").unwrap();
        }
        std::os::unix::fs::symlink("photos", dir.join("session-00000000-000000Z")).unwrap();
        tree(dir)
    }

    #[cfg(unix)]
    #[test]
    fn recording_and_pruning_touch_only_what_they_made() {
        let dir = memory();
        let precious = strangers(dir.path());
        finish_removals(dir.path()).unwrap();
        let (mut first, _bundle) = writer(options(dir.path(), Format::Npy), Disk);
        (0..2).for_each(|number| record(&mut first, number, true).unwrap());
        let old = first.folder().unwrap().to_path_buf();
        // a note in a session that will be pruned, and a folder of it that leads elsewhere
        fs::write(old.join("raw/note.txt"), "precious").unwrap();
        fs::remove_dir_all(old.join("guide")).unwrap();
        std::os::unix::fs::symlink("../session-notes/raw", old.join("guide")).unwrap();
        let few = RecordOptions { max_frames: Some(1), max_bytes: Some(1), ..options(dir.path(), Format::Npy) };
        let (mut second, _bundle) = writer(few, Disk);
        (0..3).for_each(|number| record(&mut second, number, true).unwrap());
        finish_removals(dir.path()).unwrap();
        let now = tree(dir.path());
        for thing in precious {
            assert!(now.contains(&thing), "{thing:?}");
        }
        assert_eq!(fs::read_to_string(old.join("raw/note.txt")).unwrap(), "precious");
        assert!(!old.join(DESCRIPTION).exists() && !old.join("raw/00000000.npy").exists());
        assert_eq!(second.removed(), 4);
    }

    #[cfg(unix)]
    #[test]
    fn what_an_interrupted_process_left_is_removed_and_nothing_else() {
        let dir = memory();
        let (mut session, _bundle) = writer(options(dir.path(), Format::Npy), Disk);
        record(&mut session, 0, true).unwrap();
        let precious = strangers(dir.path());
        let own = session.folder().unwrap();
        let remains = [
            own.join("raw/.stokescope-abc.part"),
            own.join(".stokescope-abc.part"),
            dir.path().join(".stokescope-removed-session-x/raw/00000000.npy"),
            dir.path().join(".stokescope-new-session-y/raw/.stokescope-z.part"),
        ];
        for path in &remains {
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, "half").unwrap();
        }
        finish_removals(dir.path()).unwrap();
        assert_eq!(tree(dir.path()), precious);
    }

    #[test]
    fn a_session_that_cannot_be_removed_does_not_stop_recording() {
        let dir = memory();
        let (mut first, _bundle) = writer(options(dir.path(), Format::Npy), Disk);
        record(&mut first, 0, true).unwrap();
        // its hidden name is taken by a folder of another maker
        let folder = hidden(first.folder().unwrap());
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("x"), "").unwrap();
        let few = RecordOptions { max_frames: Some(2), ..options(dir.path(), Format::Npy) };
        let (mut second, _bundle) = writer(few, Disk);
        (0..4).for_each(|number| record(&mut second, number, true).unwrap());
        assert_eq!((check(first.folder().unwrap()), check(second.folder().unwrap()), second.removed()), (1, 2, 2));
    }
}
