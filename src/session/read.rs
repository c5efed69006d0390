//! Replay of a recorded session as a pair of cameras: its complete frames, in their order and with their times.

use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::SessionError;
use super::layout::{CALIBRATION, Content, DESCRIPTION, Description, FrameEntry, REMOVED, SIDECARS, VERSION, list};

/// A session that is ready to be replayed.
#[derive(Debug)]
pub struct Playback {
    /// Folder of the session.
    pub session: PathBuf,
    /// Folder of the bundle it was recorded with.
    pub calibration: PathBuf,
    /// Source of the replaying cameras.
    pub source: PathBuf,
    /// Whether the replayed frames have guides. Frames without one are left out then.
    pub guide: bool,
    /// Number of frames that are replayed.
    pub frames: u64,
    /// Number of complete frames that are left out because they have no guide.
    pub left_out: u64,
    /// Iterations the session was recorded with.
    pub iterations: usize,
    /// Whether guides were aligned.
    pub register: bool,
    /// Links to the frames; removed when this is dropped.
    _links: tempfile::TempDir,
}

impl Playback {
    /// Opens the session `dir`, or the newest one in it. Frames that an interrupted recording left unfinished are passed over.
    ///
    /// # Errors
    /// [`SessionError::Replay`] when there is no session, it cannot be read, or it has no complete frame.
    pub fn open(dir: &Path) -> Result<Self, SessionError> {
        let session = find(dir)?;
        let description = describe(&session.join(DESCRIPTION))?;
        let frames = frames(&session)?;
        let complete = frames.len();
        let guide = frames.iter().any(|frame| frame.guide_seconds.is_some());
        let frames: Vec<_> = frames.into_iter().filter(|frame| frame.guide_seconds.is_some() == guide).collect();
        if frames.is_empty() {
            return Err(refuse(&session, "no complete frame: a frame is one when it has a sidecar in frames/"));
        }
        let links = tempfile::tempdir().map_err(|e| refuse(&std::env::temp_dir(), &e))?;
        link(&session, links.path(), Content::Raw, &frames, |frame| Some(frame.raw_seconds))?;
        if guide {
            link(&session, links.path(), Content::Guide, &frames, |frame| frame.guide_seconds)?;
        }
        Ok(Self {
            calibration: session.join(CALIBRATION),
            source: links.path().to_path_buf(),
            guide,
            frames: frames.len() as u64,
            left_out: (complete - frames.len()) as u64,
            iterations: description.iterations,
            register: description.register,
            session,
            _links: links,
        })
    }
}

fn refuse(path: &Path, problem: &(impl ToString + ?Sized)) -> SessionError {
    SessionError::Replay { path: path.to_path_buf(), problem: problem.to_string() }
}

/// Folder of the session `dir`, or of the newest session in it.
fn find(dir: &Path) -> Result<PathBuf, SessionError> {
    let is_session = |path: &Path| path.join(DESCRIPTION).is_file();
    let session = if is_session(dir) {
        dir.to_path_buf()
    } else {
        let found = list(dir).map_err(|e| refuse(dir, &e))?.sessions;
        let newest = found.into_iter().rev().find(|session| is_session(session));
        newest.ok_or_else(|| refuse(dir, "no session: give a folder with session.json, or one of such folders"))?
    };
    session.canonicalize().map_err(|e| refuse(&session, &e))
}

fn describe(path: &Path) -> Result<Description, SessionError> {
    let text = fs::read(path).map_err(|e| refuse(path, &e))?;
    let description: Description = serde_json::from_slice(&text).map_err(|e| refuse(path, &e))?;
    if description.version != VERSION {
        return Err(refuse(path, &format!("version = {}, allowed: {VERSION}", description.version)));
    }
    Ok(description)
}

/// Complete frames of a session in the order they were taken.
fn frames(session: &Path) -> Result<Vec<FrameEntry>, SessionError> {
    let folder = session.join(SIDECARS);
    let visible = |path: &PathBuf| path.file_name().is_some_and(|name| !name.to_string_lossy().starts_with(REMOVED));
    let mut sidecars: Vec<PathBuf> = fs::read_dir(&folder)
        .map_err(|e| refuse(&folder, &e))?
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|e| e == "json") && visible(path))
        .collect();
    sidecars.sort();
    let mut frames: Vec<FrameEntry> = Vec::with_capacity(sidecars.len());
    for path in sidecars {
        let frame = FrameEntry::read(&path).map_err(|problem| refuse(&path, &problem))?;
        // a camera that was opened again starts its clock anew: only frames of increasing times are one recording
        if frames.last().is_none_or(|last| last.raw_seconds < frame.raw_seconds) {
            frames.push(frame);
        }
    }
    Ok(frames)
}

/// Links the files of one camera into a folder of their own, with their times beside them.
fn link(
    session: &Path,
    links: &Path,
    content: Content,
    frames: &[FrameEntry],
    time: impl Fn(&FrameEntry) -> Option<f64>,
) -> Result<(), SessionError> {
    let folder = links.join(content.folder());
    fs::create_dir(&folder).map_err(|e| refuse(&folder, &e))?;
    let mut times = String::new();
    for (n, frame) in frames.iter().enumerate() {
        let (Some(file), Some(seconds)) = (frame.file(content), time(frame)) else {
            return Err(refuse(session, &format!("a frame has no file in {}/", content.folder())));
        };
        let ending = Path::new(file).extension().and_then(|e| e.to_str()).unwrap_or_default();
        link_file(&session.join(file), &folder.join(format!("{n:08}.{ending}"))).map_err(|e| refuse(session, &e))?;
        // writing to a string cannot fail
        let _ = writeln!(times, "{seconds:.9}");
    }
    fs::write(folder.join("timestamps.txt"), times).map_err(|e| refuse(&folder, &e))
}

/// Makes the contents of `file` available at `target`, without a copy where the system has symbolic links.
fn link_file(file: &Path, target: &Path) -> io::Result<()> {
    #[cfg(unix)]
    return std::os::unix::fs::symlink(file, target);
    #[cfg(not(unix))]
    return fs::copy(file, target).map(drop);
}
