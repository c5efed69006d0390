//! Replay of a recorded session as a pair of cameras: its complete frames, in their order and with their times.

use std::fmt::Write as _;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::SessionError;
use super::layout::{CALIBRATION, Content, DESCRIPTION, Description, FrameEntry, MAX_TEXT, SIDECARS, VERSION, list};
use crate::files::{self, TEMPORARY};

/// Most iterations of a recording that are taken over.
const MAX_ITERATIONS: usize = 1_000_000;
/// Longest time between two frames, in seconds; one that is longer is damaged.
const MAX_GAP: f64 = 1e6;

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
    /// Number of frames that are replayed, if they can be read.
    pub frames: u64,
    /// Number of frames that are left out because they have no guide.
    pub left_out: u64,
    /// Number of frames that are left out because their sidecar cannot be used or one of their files is missing. Each is named in the log.
    pub damaged: u64,
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
        let (frames, damaged) = frames(&session)?;
        let complete = frames.len();
        let guide = frames.iter().any(|frame| frame.guide_seconds.is_some());
        let frames: Vec<_> = frames.into_iter().filter(|frame| frame.guide_seconds.is_some() == guide).collect();
        if frames.is_empty() {
            return Err(refuse(
                &session,
                "no complete frame: a frame is one when it has a sidecar in frames/ and its files",
            ));
        }
        if description.guide && !guide {
            tracing::warn!("{}: recorded without guide frames, so results are unguided", session.display());
        }
        let links = tempfile::tempdir().map_err(|e| refuse(&std::env::temp_dir(), &e))?;
        let times = timeline(&frames);
        link(&session, links.path(), Content::Raw, &frames, &times)?;
        if guide {
            link(&session, links.path(), Content::Guide, &frames, &times)?;
        }
        Ok(Self {
            calibration: session.join(CALIBRATION),
            source: links.path().to_path_buf(),
            guide,
            frames: frames.len() as u64,
            left_out: (complete - frames.len()) as u64,
            damaged,
            iterations: description.iterations,
            register: description.register,
            session,
            _links: links,
        })
    }
}

pub(super) fn refuse(path: &Path, problem: &(impl ToString + ?Sized)) -> SessionError {
    SessionError::Replay { path: path.to_path_buf(), problem: problem.to_string() }
}

/// Folder of the session `dir`, or of the newest session in it.
pub(super) fn find(dir: &Path) -> Result<PathBuf, SessionError> {
    let is_session = |path: &Path| path.join(DESCRIPTION).exists();
    let session = if is_session(dir) {
        dir.to_path_buf()
    } else {
        let found = list(dir).map_err(|e| refuse(dir, &e))?.sessions;
        let newest = found.into_iter().rev().find(|session| is_session(session));
        newest.ok_or_else(|| refuse(dir, "no session: give a folder with session.json, or one of such folders"))?
    };
    session.canonicalize().map_err(|e| refuse(&session, &e))
}

pub(super) fn describe(path: &Path) -> Result<Description, SessionError> {
    let text = files::read_bytes(path, MAX_TEXT).map_err(|e| refuse(path, &e))?;
    let description: Description = serde_json::from_slice(&text).map_err(|e| refuse(path, &e))?;
    if description.version != VERSION {
        return Err(refuse(path, &format!("version = {}, allowed: {VERSION}", description.version)));
    }
    if !(1..=MAX_ITERATIONS).contains(&description.iterations) {
        let found = description.iterations;
        return Err(refuse(path, &format!("iterations = {found}, allowed: 1 to {MAX_ITERATIONS}")));
    }
    Ok(description)
}

/// Complete frames of a session in the order they were recorded, and the number of those that are damaged, which are named.
pub(super) fn frames(session: &Path) -> Result<(Vec<FrameEntry>, u64), SessionError> {
    let folder = session.join(SIDECARS);
    let visible = |path: &PathBuf| path.file_name().is_some_and(|name| !name.to_string_lossy().starts_with(TEMPORARY));
    let mut sidecars: Vec<PathBuf> = fs::read_dir(&folder)
        .map_err(|e| refuse(&folder, &e))?
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|e| e == "json") && visible(path))
        .collect();
    sidecars.sort();
    let (mut frames, mut damaged) = (Vec::with_capacity(sidecars.len()), 0);
    for path in sidecars {
        match complete(session, &path) {
            Ok(frame) => frames.push(frame),
            Err(problem) => {
                tracing::warn!("left out: {}: {problem}", path.display());
                damaged += 1;
            }
        }
    }
    Ok((frames, damaged))
}

/// Reads a sidecar of a frame whose files of the cameras are there.
fn complete(session: &Path, sidecar: &Path) -> Result<FrameEntry, String> {
    let frame = FrameEntry::read(sidecar)?;
    let guide = frame.guide_seconds.map(|_| Content::Guide);
    for content in std::iter::once(Content::Raw).chain(guide) {
        let file = frame.file(content).ok_or_else(|| format!("the frame has no file in {}/", content.folder()))?;
        let path = session.join(file);
        if !path.is_file() {
            return Err(format!("{}: missing or not a regular file", path.display()));
        }
    }
    Ok(frame)
}

/// Times of frames in seconds, which increase: they follow the raw camera's clock, and go on where that camera was opened again and began
/// its clock anew. Raw and guide frame of a pair are replayed with the same time.
fn timeline(frames: &[FrameEntry]) -> Vec<f64> {
    let step = |pair: &[FrameEntry]| {
        Some(pair[1].raw_seconds - pair[0].raw_seconds).filter(|step| (1e-6..MAX_GAP).contains(step))
    };
    let mut steps: Vec<f64> = frames.windows(2).filter_map(step).collect();
    steps.sort_by(f64::total_cmp);
    let usual = steps.get(steps.len() / 2).copied().unwrap_or(0.1);
    let mut time = 0.0;
    let later = frames.windows(2).map(|pair| {
        time += step(pair).unwrap_or(usual);
        time
    });
    std::iter::once(0.0).chain(later).collect()
}

/// Links the files of one camera into a folder of their own, with the frames' times in seconds beside them.
fn link(
    session: &Path,
    links: &Path,
    content: Content,
    frames: &[FrameEntry],
    times: &[f64],
) -> Result<(), SessionError> {
    let folder = links.join(content.folder());
    fs::create_dir(&folder).map_err(|e| refuse(&folder, &e))?;
    let mut text = String::new();
    for (n, (frame, seconds)) in frames.iter().zip(times).enumerate() {
        let Some(file) = frame.file(content) else { continue };
        let ending = Path::new(file).extension().and_then(|e| e.to_str()).unwrap_or_default();
        link_file(&session.join(file), &folder.join(format!("{n:08}.{ending}"))).map_err(|e| refuse(session, &e))?;
        // writing to a string cannot fail
        let _ = writeln!(text, "{seconds:.9}");
    }
    fs::write(folder.join("timestamps.txt"), text).map_err(|e| refuse(&folder, &e))
}

/// Makes the contents of `file` available at `target`, without a copy where the system has symbolic links.
fn link_file(file: &Path, target: &Path) -> io::Result<()> {
    #[cfg(unix)]
    return std::os::unix::fs::symlink(file, target);
    #[cfg(not(unix))]
    return fs::copy(file, target).map(drop);
}
