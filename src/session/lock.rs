//! Exclusive use of a folder of sessions.

use std::fs::{self, File};
use std::io;
use std::path::Path;

use super::prune;

/// File whose lock the recording process holds.
const LOCK: &str = ".lock";

/// Exclusive right to record into a folder. The system takes it back when the process ends, however it ends.
#[derive(Debug)]
pub(crate) struct FolderLock(#[allow(dead_code, reason = "it is held, not read")] File);

impl FolderLock {
    /// Makes `dir`, takes its lock, and finishes the removals that an interrupted process began.
    ///
    /// # Errors
    /// When the folder cannot be made or another process holds the lock.
    pub(crate) fn take(dir: &Path) -> io::Result<Self> {
        fs::create_dir_all(dir)?;
        let file = File::create(dir.join(LOCK))?;
        file.try_lock().map_err(|e| match e {
            fs::TryLockError::WouldBlock => io::Error::other("another instance records into it; choose another folder"),
            fs::TryLockError::Error(e) => e,
        })?;
        prune::finish_removals(dir)?;
        Ok(Self(file))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_has_one_recorder_and_what_an_interrupted_one_left_is_removed() {
        let dir = tempfile::tempdir().unwrap();
        let raw = dir.path().join("session-1/raw");
        fs::create_dir_all(&raw).unwrap();
        fs::write(raw.join(".abc.part"), "half").unwrap();
        fs::write(raw.join("0.npy"), "kept").unwrap();
        let lock = FolderLock::take(dir.path()).unwrap();
        assert_eq!(fs::read_dir(&raw).unwrap().count(), 1);
        assert!(FolderLock::take(dir.path()).unwrap_err().to_string().contains("another instance"));
        drop(lock);
        FolderLock::take(dir.path()).unwrap();
    }
}
