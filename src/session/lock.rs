//! Exclusive use of a folder.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};

/// Exclusive right to write into a folder. The system takes it back when the process ends, however it ends.
#[derive(Debug)]
pub(crate) struct FolderLock {
    file: File,
    path: PathBuf,
}

impl FolderLock {
    /// Makes `dir` and takes the lock of its file `name`, which is made if need be and never changed.
    ///
    /// # Errors
    /// When the folder or file cannot be made, the file is a symbolic link, or another process holds the lock.
    pub(crate) fn take(dir: &Path, name: &str) -> io::Result<Self> {
        fs::create_dir_all(dir)?;
        let path = dir.join(name);
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(false);
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, libc::O_NOFOLLOW);
        let file = options.open(&path).map_err(|e| match fs::symlink_metadata(&path) {
            Ok(meta) if meta.is_symlink() => io::Error::other(format!("{name} is a symbolic link: remove it")),
            _ => e,
        })?;
        file.try_lock().map_err(|e| match e {
            fs::TryLockError::WouldBlock => io::Error::other("another instance writes into it; choose another folder"),
            fs::TryLockError::Error(e) => e,
        })?;
        Ok(Self { file, path })
    }

    /// Whether the folder of this path is still the one that was locked: it was not removed, replaced or made anew.
    pub(crate) fn is_current(&self) -> bool {
        let own = self.file.metadata().ok().map(|meta| identity(&meta));
        own.is_some() && own == fs::symlink_metadata(&self.path).ok().map(|meta| identity(&meta))
    }
}

/// Device and number of a file or folder, which no other has at the same time.
#[cfg(unix)]
pub(super) fn identity(meta: &fs::Metadata) -> (u64, u64) {
    use std::os::unix::fs::MetadataExt;
    (meta.dev(), meta.ino())
}

/// Device and number of a file or folder; the same for all where the system does not tell.
#[cfg(not(unix))]
pub(super) fn identity(_: &fs::Metadata) -> (u64, u64) {
    (0, 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_has_one_writer_and_a_lock_knows_whether_it_is_still_the_folder() {
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("dir");
        let lock = FolderLock::take(&dir, ".lock").unwrap();
        assert!(FolderLock::take(&dir, ".lock").unwrap_err().to_string().contains("another instance"));
        FolderLock::take(&dir, ".other").unwrap();
        assert!(lock.is_current());
        fs::remove_dir_all(&dir).unwrap();
        assert!(!lock.is_current());
        let anew = FolderLock::take(&dir, ".lock").unwrap();
        assert!(!lock.is_current() && anew.is_current());
        drop(anew);
        FolderLock::take(&dir, ".lock").unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn a_link_in_the_place_of_the_lock_is_refused_and_its_target_untouched() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("precious");
        fs::write(&target, "text").unwrap();
        std::os::unix::fs::symlink(&target, dir.path().join(".lock")).unwrap();
        let e = FolderLock::take(dir.path(), ".lock").unwrap_err().to_string();
        assert!(e.contains(".lock is a symbolic link: remove it"), "{e}");
        assert_eq!(fs::read_to_string(target).unwrap(), "text");
    }
}
