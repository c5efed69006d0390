//! Operations that recording does on a disk, behind a trait: tests record to a disk that fails.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::files::{WriteError, write_atomic};
use crate::output::OutputError;

/// Failure to record a frame.
#[derive(Debug, thiserror::Error)]
pub(crate) enum RecordError {
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("{}: {source}", path.display())]
    Disk { path: PathBuf, source: io::Error },
    #[error(
        "{}: {free} bytes are free; a frame takes {need} and {reserve} must stay free: free space or lower the reserve",
        path.display()
    )]
    Reserve { path: PathBuf, free: u64, reserve: u64, need: u64 },
}

impl RecordError {
    /// Failure of an operation on `path`.
    pub(super) fn disk(path: &Path, source: io::Error) -> Self {
        Self::Disk { path: path.to_path_buf(), source }
    }
}

/// Operations on a disk.
pub(crate) trait Storage: Send {
    /// Writes a file that appears whole or not at all and survives a power cut from then on.
    fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteError>;
    /// Makes a folder that must not exist yet.
    fn create_folder(&self, path: &Path) -> io::Result<()>;
    /// Renames a file or folder within its folder.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Removes a file.
    fn remove_file(&self, path: &Path) -> io::Result<()>;
    /// Removes an empty folder.
    fn remove_folder(&self, path: &Path) -> io::Result<()>;
    /// Makes the names in a folder survive a power cut.
    fn sync_folder(&self, path: &Path) -> io::Result<()>;
    /// Bytes that are free.
    fn free(&self, path: &Path) -> io::Result<u64>;
}

/// The machine's own disk.
#[derive(Debug)]
pub(crate) struct Disk;

impl Storage for Disk {
    fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
        write_atomic(path, |out| out.write_all(bytes))
    }

    fn create_folder(&self, path: &Path) -> io::Result<()> {
        fs::create_dir(path)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        fs::remove_file(path)
    }

    fn remove_folder(&self, path: &Path) -> io::Result<()> {
        fs::remove_dir(path)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        // Folders can be opened as files on Unix alone.
        if cfg!(unix) { fs::File::open(path)?.sync_all() } else { Ok(()) }
    }

    fn free(&self, path: &Path) -> io::Result<u64> {
        let disk = rustix::fs::statvfs(path)?;
        Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
    }
}

#[cfg(test)]
pub(super) mod tests {
    use std::cell::RefCell;

    use super::*;

    /// A disk that fails a number of operations in a row, after a number that succeed. Writing a file and removing a folder
    /// are several operations each and can fail in between. It remembers how to undo changes of names that no folder was
    /// synced after: a power cut may lose these.
    #[derive(Debug, Default)]
    pub(in crate::session) struct FailingDisk {
        state: RefCell<State>,
    }

    #[derive(Debug, Default)]
    struct State {
        after: i64,
        times: i64,
        unsynced: Vec<Change>,
    }

    /// A change of the names in `folder`.
    #[derive(Debug)]
    struct Change {
        folder: PathBuf,
        undo: Undo,
    }

    #[derive(Debug)]
    enum Undo {
        Rename { from: PathBuf, to: PathBuf },
        File { path: PathBuf, bytes: Vec<u8> },
        Folder { path: PathBuf },
        Made { path: PathBuf },
    }

    impl FailingDisk {
        /// Succeeds `after` times, then fails `times` times, then succeeds.
        pub(in crate::session) fn new(after: i64, times: i64) -> Self {
            Self { state: RefCell::new(State { after, times, unsynced: Vec::new() }) }
        }

        /// Succeeds from now on.
        pub(in crate::session) fn repair(&self) {
            self.state.borrow_mut().after = i64::MAX;
        }

        /// Folders with changes that a power cut may lose.
        pub(in crate::session) fn unsynced(&self) -> Vec<PathBuf> {
            let mut folders: Vec<_> = self.state.borrow().unsynced.iter().map(|change| change.folder.clone()).collect();
            folders.sort();
            folders.dedup();
            folders
        }

        /// Cuts the power: the unsynced changes in `lost` are undone, all others have reached the disk.
        pub(in crate::session) fn cut_power(&self, lost: &Path) {
            for change in std::mem::take(&mut self.state.borrow_mut().unsynced).into_iter().rev() {
                if change.folder != lost {
                    continue;
                }
                // a name comes back in a folder that is still there
                match change.undo {
                    Undo::Rename { from, to } if to.exists() => fs::rename(to, from).unwrap(),
                    Undo::File { path, bytes } if lost.exists() => fs::write(path, bytes).unwrap(),
                    Undo::Folder { path } if lost.exists() => fs::create_dir(path).unwrap(),
                    Undo::Made { path } if path.exists() => fs::remove_dir_all(path).unwrap(),
                    _ => {}
                }
            }
        }

        fn step(&self) -> io::Result<()> {
            let mut state = self.state.borrow_mut();
            let State { after, times, .. } = *state;
            state.after = after.saturating_sub(1);
            if after <= 0 && after > -times { Err(io::ErrorKind::StorageFull.into()) } else { Ok(()) }
        }

        fn changed(&self, path: &Path, undo: Undo) {
            let folder = path.parent().unwrap().to_path_buf();
            self.state.borrow_mut().unsynced.push(Change { folder, undo });
        }
    }

    impl Storage for FailingDisk {
        fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
            let failed = |source| WriteError::Io { path: path.to_path_buf(), source };
            self.step().map_err(failed)?;
            write_atomic(path, |out| {
                let (first, second) = bytes.split_at(bytes.len() / 2);
                out.write_all(first)?;
                out.flush()?;
                self.step()?;
                out.write_all(second)
            })?;
            // the folder is flushed after the file has its name
            self.step().map_err(failed)
        }

        fn create_folder(&self, path: &Path) -> io::Result<()> {
            self.step()?;
            Disk.create_folder(path)?;
            self.changed(path, Undo::Made { path: path.to_path_buf() });
            Ok(())
        }

        fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
            self.step()?;
            Disk.rename(from, to)?;
            self.changed(from, Undo::Rename { from: from.to_path_buf(), to: to.to_path_buf() });
            Ok(())
        }

        fn remove_file(&self, path: &Path) -> io::Result<()> {
            self.step()?;
            let bytes = fs::read(path)?;
            Disk.remove_file(path)?;
            self.changed(path, Undo::File { path: path.to_path_buf(), bytes });
            Ok(())
        }

        fn remove_folder(&self, path: &Path) -> io::Result<()> {
            self.step()?;
            fs::remove_dir(path)?;
            self.changed(path, Undo::Folder { path: path.to_path_buf() });
            Ok(())
        }

        fn sync_folder(&self, path: &Path) -> io::Result<()> {
            self.step()?;
            Disk.sync_folder(path)?;
            self.state.borrow_mut().unsynced.retain(|change| change.folder != path);
            Ok(())
        }

        fn free(&self, path: &Path) -> io::Result<u64> {
            self.step()?;
            Disk.free(path)
        }
    }
}
