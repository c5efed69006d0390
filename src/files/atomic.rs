use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Start of the names of files and folders that this program is writing or removing. Nothing else is named so.
pub(crate) const TEMPORARY: &str = ".stokescope-";
/// End of the names of files that this program is writing.
pub(crate) const UNFINISHED: &str = ".part";

/// A file that cannot be written. An existing file of that name is unchanged.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The file or folder cannot be created.
    #[error("{}: cannot be created: {source}", path.display())]
    Create {
        /// Final path.
        path: PathBuf,
        /// Reason.
        source: io::Error,
    },
    /// Writing failed midway: disk full or device error.
    #[error("{}: writing failed: {source}", path.display())]
    Io {
        /// Final path.
        path: PathBuf,
        /// Reason.
        source: io::Error,
    },
    /// The number of values does not match the shape.
    #[error("{}: {found} values cannot have the shape {shape:?}", path.display())]
    Shape {
        /// Final path.
        path: PathBuf,
        /// Requested shape.
        shape: Vec<usize>,
        /// Number of values given.
        found: usize,
    },
}

/// Writes a file so that it appears whole or not at all, even after a power cut.
///
/// `fill` writes to a temporary file in the same folder. The file is then flushed to the device and renamed to `path`, and the
/// folder is flushed.
///
/// # Errors
/// [`WriteError::Create`] when the folder refuses the file, [`WriteError::Io`] when `fill` or the device fails.
pub fn write_atomic(path: &Path, fill: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> Result<(), WriteError> {
    let create = |source| WriteError::Create { path: path.to_path_buf(), source };
    let failed = |source| WriteError::Io { path: path.to_path_buf(), source };
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    let temporary = temporary_in(folder).map_err(create)?;
    let mut out = BufWriter::new(temporary.as_file());
    fill(&mut out).and_then(|()| out.flush()).map_err(failed)?;
    drop(out);
    temporary.as_file().sync_all().map_err(failed)?;
    temporary.persist(path).map_err(|e| create(e.error))?;
    // the rename survives a power cut only after the folder is flushed
    if cfg!(unix) { File::open(folder).and_then(|f| f.sync_all()).map_err(failed) } else { Ok(()) }
}

/// Creates a hidden temporary file with the permissions of an ordinary file; tempfile's default is private.
fn temporary_in(folder: &Path) -> io::Result<tempfile::NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY).suffix(UNFINISHED);
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(dir: &Path) -> Vec<String> {
        std::fs::read_dir(dir).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn a_failure_midway_leaves_the_old_file_and_no_other() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        write_atomic(&path, |f| f.write_all(b"old")).unwrap();
        let e = write_atomic(&path, |f| {
            f.write_all(&[0; 100_000])?;
            Err(io::Error::from(io::ErrorKind::StorageFull))
        });
        assert!(matches!(e, Err(WriteError::Io { .. })), "{e:?}");
        assert_eq!((std::fs::read(&path).unwrap(), names(dir.path())), (b"old".to_vec(), vec!["a".to_owned()]));
    }

    #[test]
    fn a_missing_folder_or_a_folder_in_the_way_cannot_be_created() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("taken")).unwrap();
        for path in [dir.path().join("no/a"), dir.path().join("taken")] {
            let e = write_atomic(&path, |f| f.write_all(b"x"));
            assert!(matches!(e, Err(WriteError::Create { .. })), "{e:?}");
        }
        assert_eq!(names(dir.path()), ["taken"]);
    }

    #[cfg(unix)]
    #[test]
    fn the_file_has_the_mode_of_an_ordinary_one() {
        use std::os::unix::fs::PermissionsExt;
        let dir = tempfile::tempdir().unwrap();
        let (path, ordinary) = (dir.path().join("a"), dir.path().join("b"));
        write_atomic(&path, |f| f.write_all(b"x")).unwrap();
        std::fs::write(&ordinary, b"x").unwrap();
        let mode = |p: &Path| std::fs::metadata(p).unwrap().permissions().mode();
        assert_eq!(mode(&path), mode(&ordinary));
    }
}
