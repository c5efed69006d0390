//! Sessions as the user sees them: listed, named, removed, and packed into a ZIP file that is never whole in memory.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::layout::{
    CALIBRATION, DESCRIPTION, Description, FOLDERS, Label, MAX_TEXT, SIDECARS, THUMBNAIL, list, number,
};
use super::prune::{remove_session, usage};
use super::storage::{Disk, RecordError, Storage};
use crate::files::{TEMPORARY, Zip, read_bytes};
use crate::output::export::Format;

/// Bytes of a part of an archive.
const CHUNK: usize = 32 << 10;
/// Most bytes of a thumbnail that are read.
const MAX_THUMBNAIL: u64 = 1 << 20;

/// One session in a list.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Entry {
    /// Name of its folder.
    id: String,
    #[serde(flatten)]
    label: Label,
    started: String,
    board: String,
    format: Format,
    frames: u64,
    bytes: u64,
}

/// The sessions in `dir`, newest first. One whose description cannot be read is left out.
///
/// # Errors
/// When the folder cannot be read.
pub(crate) fn sessions(dir: &Path) -> io::Result<Vec<Entry>> {
    let entry = |path: PathBuf| {
        let Description { label, started, board, format, .. } = describe(&path).ok()?;
        let (frames, bytes) = usage(&path);
        Some(Entry {
            id: path.file_name()?.to_string_lossy().into_owned(),
            label,
            started,
            board,
            format,
            frames,
            bytes,
        })
    };
    Ok(list(dir)?.sessions.into_iter().rev().filter_map(entry).collect())
}

/// Folder of the session `id` in `dir`; none if there is no such session of this program.
pub(crate) fn session(dir: &Path, id: &str) -> Option<PathBuf> {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '-';
    let path = dir.join(id);
    (id.chars().all(plain) && number(&path).is_some()).then_some(path)
}

/// Removes a session. Files in it that are no recording stay.
///
/// # Errors
/// When the disk refuses.
pub(crate) fn remove(session: &Path) -> Result<(), RecordError> {
    remove_session(&Disk, session)
}

/// Gives a session another label.
///
/// # Errors
/// When its description cannot be read or written.
pub(crate) fn relabel(session: &Path, label: Label) -> Result<(), RecordError> {
    let path = session.join(DESCRIPTION);
    let disk = |source| RecordError::disk(&path, source);
    let description = Description { label, ..describe(session).map_err(disk)? };
    let mut text = serde_json::to_vec_pretty(&description).map_err(|e| disk(e.into()))?;
    text.push(b'\n');
    Ok(Disk.write(&path, &text)?)
}

/// The thumbnail of a session, a PNG file.
///
/// # Errors
/// When it cannot be read.
pub(crate) fn read_thumbnail(session: &Path) -> io::Result<Vec<u8>> {
    read_bytes(&session.join(THUMBNAIL), MAX_THUMBNAIL)
}

fn describe(session: &Path) -> io::Result<Description> {
    Ok(serde_json::from_slice(&read_bytes(&session.join(DESCRIPTION), MAX_TEXT)?)?)
}

/// A session as a ZIP file, part by part. It holds the files that are there when it is opened.
#[derive(Debug)]
pub(crate) struct Archive {
    /// Folder that the names begin in.
    root: PathBuf,
    zip: Zip,
    /// Entry to go on with.
    next: usize,
    /// File of the entry before it, and its bytes that are left.
    open: Option<(File, u64)>,
    /// Entry of the directory to go on with, and where its file begins.
    directory: (usize, u64),
    ended: bool,
    buffer: Vec<u8>,
}

impl Archive {
    /// Lists the files of `session`. Images come frame by frame within each kind; sidecars are the last.
    ///
    /// # Errors
    /// When a folder cannot be read, or there are too many or too large files.
    pub(crate) fn open(session: &Path) -> io::Result<Self> {
        let root = session.parent().unwrap_or(Path::new(".")).to_path_buf();
        let id = session.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let mut zip = Zip::default();
        for name in [DESCRIPTION, THUMBNAIL] {
            if let Ok(meta) = fs::symlink_metadata(session.join(name)) {
                zip.add(&format!("{id}/{name}"), meta.len())?;
            }
        }
        let images = FOLDERS.into_iter().filter(|part| ![CALIBRATION, SIDECARS].contains(part));
        for part in [CALIBRATION].into_iter().chain(images).chain([SIDECARS]) {
            let folder = session.join(part);
            if !folder.is_dir() {
                continue;
            }
            let file = |entry: fs::DirEntry| {
                let meta = entry.metadata().ok().filter(fs::Metadata::is_file)?;
                let name = entry.file_name().into_string().ok().filter(|name| !name.starts_with(TEMPORARY))?;
                Some((name, meta.len()))
            };
            let mut files: Vec<_> = fs::read_dir(folder)?.flatten().filter_map(file).collect();
            files.sort();
            files.iter().try_for_each(|(name, size)| zip.add(&format!("{id}/{part}/{name}"), *size).map(drop))?;
        }
        Ok(Self { root, zip, next: 0, open: None, directory: (0, 0), ended: false, buffer: vec![0; CHUNK] })
    }

    /// Bytes of the whole file.
    pub(crate) fn total_bytes(&self) -> u64 {
        self.zip.total_bytes()
    }

    /// The next part; none after the last.
    ///
    /// # Errors
    /// A file that cannot be read or has changed its length.
    pub(crate) fn part(&mut self) -> io::Result<Option<Vec<u8>>> {
        if let Some((file, left)) = &mut self.open {
            let wanted = (*left).min(CHUNK as u64) as usize;
            file.read_exact(&mut self.buffer[..wanted])?;
            *left -= wanted as u64;
            if *left == 0 {
                self.open = None;
            }
            return Ok(Some(self.buffer[..wanted].to_vec()));
        }
        if self.next < self.zip.len() {
            return self.begin().map(Some);
        }
        if self.directory.0 < self.zip.len() {
            let mut records = Vec::with_capacity(CHUNK + 256);
            self.directory = self.zip.directory(self.directory.0, self.directory.1, CHUNK, &mut records);
            return Ok(Some(records));
        }
        Ok((!std::mem::replace(&mut self.ended, true)).then(|| self.zip.end()))
    }

    /// Opens the next file and gives its header, whose checksum takes a first reading of the file.
    fn begin(&mut self) -> io::Result<Vec<u8>> {
        let path = self.root.join(self.zip.name(self.next));
        let size = self.zip.size(self.next);
        let mut file = File::open(&path)?;
        let (mut sum, mut found) = (crc32fast::Hasher::new(), 0);
        loop {
            let read = file.read(&mut self.buffer)?;
            if read == 0 {
                break;
            }
            sum.update(&self.buffer[..read]);
            found += read as u64;
        }
        if found != size {
            return Err(io::Error::other(format!("{}: {found} bytes instead of {size}", path.display())));
        }
        io::Seek::rewind(&mut file)?;
        self.open = (size > 0).then_some((file, size));
        self.next += 1;
        Ok(self.zip.header(self.next - 1, sum.finalize()))
    }
}

#[cfg(test)]
mod tests {
    use super::super::write::tests::{options, record, writer};
    use super::*;

    #[test]
    fn sessions_are_listed_named_packed_and_removed() {
        let dir = tempfile::tempdir().unwrap();
        let (mut writer, _bundle) = writer(options(dir.path(), Format::Npy), Disk);
        (0..3).for_each(|number| record(&mut writer, number, true).unwrap());
        let label = Label { name: "leaf".into(), note: "from below".into() };
        writer.begin(label.clone());
        record(&mut writer, 3, true).unwrap();
        let found = sessions(dir.path()).unwrap();
        let frames: Vec<_> = found.iter().map(|entry| (entry.label.name.as_str(), entry.frames)).collect();
        assert_eq!(frames, [("leaf", 1), ("", 3)]);
        for id in ["", "..", ".lock", "session-none", "../x"] {
            assert_eq!(session(dir.path(), id), None, "{id}");
        }
        let first = session(dir.path(), &found[1].id).unwrap();
        relabel(&first, label.clone()).unwrap();
        assert_eq!(describe(&first).unwrap().label, label);
        assert!(read_thumbnail(&first).unwrap().starts_with(b"\x89PNG"));

        let mut archive = Archive::open(&first).unwrap();
        let (total, mut file) = (archive.total_bytes(), Vec::new());
        while let Some(part) = archive.part().unwrap() {
            assert!(part.len() <= CHUNK + 256);
            file.extend(part);
        }
        assert_eq!(file.len() as u64, total);
        assert!(file.ends_with(&archive.zip.end()) && archive.zip.len() == 2 + 1 + 4 * 3);

        let mut changed = Archive::open(&first).unwrap();
        fs::write(first.join("raw/00000001.npy"), "short").unwrap();
        let mut outcome = Ok(Some(Vec::new()));
        while let Ok(Some(_)) = outcome {
            outcome = changed.part();
        }
        assert!(outcome.unwrap_err().to_string().contains("5 bytes instead of"));

        remove(&first).unwrap();
        assert_eq!(sessions(dir.path()).unwrap().len(), 1);
    }
}
