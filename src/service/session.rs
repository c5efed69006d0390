//! A recorded session as a pair of cameras: its complete frames, in their order and with their times.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use super::ServiceError;
use super::record::{DESCRIPTION, Description, FRAMES, Played, sessions};

/// A session that is ready to be replayed.
#[derive(Debug)]
pub struct Playback {
    /// The session's folder.
    pub session: PathBuf,
    /// The bundle it was recorded with.
    pub calibration: PathBuf,
    /// What the replaying cameras take for a source.
    pub source: PathBuf,
    /// Whether frames have guides; those without one are left out then.
    pub guide: bool,
    /// Frames that are replayed.
    pub frames: u64,
    /// Complete frames that are left out because they have no guide.
    pub left_out: u64,
    /// Iterations the session was recorded with.
    pub iterations: usize,
    /// Whether guides were aligned.
    pub register: bool,
    /// Links to the frames; removed with this.
    _links: tempfile::TempDir,
}

impl Playback {
    /// Opens the session `dir`, or the newest one in it. What an interrupted recording left unfinished is passed over.
    ///
    /// # Errors
    /// [`ServiceError::Session`] when there is no session, it cannot be read, or it has no complete frame.
    pub fn open(dir: &Path) -> Result<Self, ServiceError> {
        let refuse = |path: &Path, what: String| ServiceError::Session { path: path.to_path_buf(), what };
        let failed = |path: &Path, e: io::Error| refuse(path, e.to_string());
        let session = if dir.join(DESCRIPTION).is_file() {
            dir.to_path_buf()
        } else {
            let found = sessions(dir).map_err(|e| failed(dir, e))?;
            let newest = found.into_iter().rev().find(|session| session.join(DESCRIPTION).is_file());
            newest.ok_or_else(|| refuse(dir, "neither a session nor a folder of sessions".to_owned()))?
        };
        let session = session.canonicalize().map_err(|e| failed(&session, e))?;
        let path = session.join(DESCRIPTION);
        let text = fs::read(&path).map_err(|e| failed(&path, e))?;
        let description: Description = serde_json::from_slice(&text).map_err(|e| refuse(&path, e.to_string()))?;
        if description.version != 1 {
            return Err(refuse(&path, format!("version = {}, allowed: 1", description.version)));
        }
        let frames = frames(&session)?;
        let guided = frames.iter().filter(|frame| frame.guide_seconds.is_some()).count();
        let guide = guided > 0;
        let complete = frames.len();
        let frames: Vec<_> = frames.into_iter().filter(|frame| frame.guide_seconds.is_some() == guide).collect();
        if frames.is_empty() {
            return Err(refuse(&session, "has no complete frame".to_owned()));
        }
        let links = tempfile::tempdir().map_err(|e| failed(&std::env::temp_dir(), e))?;
        for (role, time) in [
            ("raw", Box::new(|f: &Played| Some(f.raw_seconds)) as Box<dyn Fn(&Played) -> Option<f64>>),
            ("guide", Box::new(|f: &Played| f.guide_seconds)),
        ] {
            if role == "guide" && !guide {
                continue;
            }
            link(&session, links.path(), role, &frames, &*time).map_err(|e| failed(&session, e))?;
        }
        Ok(Self {
            calibration: session.join("calibration"),
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

/// The complete frames of a session in the order they were taken.
fn frames(session: &Path) -> Result<Vec<Played>, ServiceError> {
    let folder = session.join(FRAMES);
    let refuse = |path: &Path, what: String| ServiceError::Session { path: path.to_path_buf(), what };
    let mut sidecars: Vec<PathBuf> = fs::read_dir(&folder)
        .map_err(|e| refuse(&folder, e.to_string()))?
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| path.extension().is_some_and(|e| e == "json"))
        .collect();
    sidecars.sort();
    let mut frames: Vec<Played> = Vec::with_capacity(sidecars.len());
    for path in sidecars {
        let text = fs::read(&path).map_err(|e| refuse(&path, e.to_string()))?;
        let frame: Played = serde_json::from_slice(&text).map_err(|e| refuse(&path, e.to_string()))?;
        let plain = |file: &String| Path::new(file).components().all(|c| matches!(c, std::path::Component::Normal(_)));
        if !frame.files.iter().all(plain) {
            return Err(refuse(&path, "names a file outside its session".to_owned()));
        }
        // a camera that was opened again begins its times anew: only what goes on in time is one recording
        if frames.last().is_none_or(|last| last.raw_seconds < frame.raw_seconds) {
            frames.push(frame);
        }
    }
    Ok(frames)
}

/// Links the files of `role` into a folder of their own, with their times beside them.
fn link(
    session: &Path,
    links: &Path,
    role: &str,
    frames: &[Played],
    time: &dyn Fn(&Played) -> Option<f64>,
) -> io::Result<()> {
    let folder = links.join(role);
    fs::create_dir(&folder)?;
    let mut times = String::new();
    for (n, frame) in frames.iter().enumerate() {
        let prefix = format!("{role}/");
        let file = frame.files.iter().find(|file| file.starts_with(&prefix));
        let (Some(file), Some(seconds)) = (file, time(frame)) else {
            return Err(io::Error::other(format!("a frame has no {role} file")));
        };
        let ending = Path::new(file).extension().and_then(|e| e.to_str()).unwrap_or_default();
        let target = folder.join(format!("{n:08}.{ending}"));
        #[cfg(unix)]
        std::os::unix::fs::symlink(session.join(file), target)?;
        #[cfg(not(unix))]
        fs::copy(session.join(file), target).map(drop)?;
        times += &format!("{seconds:.9}\n");
    }
    fs::write(folder.join("timestamps.txt"), times)
}
