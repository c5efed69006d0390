use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// A file that could not be written. Nothing stands under its final name that did not stand there before.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The file or its folder cannot be created.
    #[error("{}: cannot be created: {source}", path.display())]
    Create {
        /// The final name.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// Writing failed half-way: disk full, device error.
    #[error("{}: writing failed: {source}", path.display())]
    Io {
        /// The final name.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The values do not fill the shape.
    #[error("{}: {found} values cannot have the shape {shape:?}", path.display())]
    Shape {
        /// The final name.
        path: PathBuf,
        /// Shape asked for.
        shape: Vec<usize>,
        /// Number of values there are.
        found: usize,
    },
}

/// Writes a file so that it appears whole or not at all, whatever happens meanwhile: `fill` writes to a temporary file in the
/// same folder, which is flushed to the device, renamed to `path`, and the folder flushed too.
///
/// # Errors
/// [`WriteError::Create`] when the folder does not take the file, [`WriteError::Io`] when `fill` or the device fails.
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
    // The rename itself survives a power cut only once the folder is on the device.
    if cfg!(unix) { File::open(folder).and_then(|f| f.sync_all()).map_err(failed) } else { Ok(()) }
}

/// A hidden temporary file that others may read as the umask allows, unlike tempfile's private default.
fn temporary_in(folder: &Path) -> io::Result<tempfile::NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".").suffix(".part");
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
    fn a_failure_half_way_leaves_the_old_file_and_no_other() {
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
