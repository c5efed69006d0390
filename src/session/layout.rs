//! Names of a session's files and folders, and the contents of its description and sidecars.

use std::fs;
use std::io;
use std::path::{Component, Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use crate::board::Board;
use crate::bundle::Bundle;
use crate::files::{self, TEMPORARY};
use crate::output::Report;
use crate::output::export::{Format, stokes_names};

/// Start of the name of every session's folder.
pub(super) const PREFIX: &str = "session-";
/// File whose lock the recording process holds.
pub(super) const LOCK: &str = ".lock";
/// File in a session that describes it.
pub(super) const DESCRIPTION: &str = "session.json";
/// Picture of the first frame, for lists of sessions.
pub(super) const THUMBNAIL: &str = "thumbnail.png";
/// Folder in a session that holds the bundle.
pub(super) const CALIBRATION: &str = "calibration";
/// Folder in a session that holds the sidecars.
pub(super) const SIDECARS: &str = "frames";
/// Start of the name of a session or sidecar that is being removed. Readers pass over it.
pub(super) const REMOVED: &str = ".stokescope-removed-";
/// Start of the name of a session whose description is not complete yet. Readers pass over it.
pub(super) const NEW: &str = ".stokescope-new-";
/// Start of `program` in a description.
const PROGRAM: &str = "stokescope ";
/// Folders that a session may have: those of the images, of the sidecars and of the bundle.
pub(super) const FOLDERS: [&str; 8] = ["raw", "guide", "stokes", "intensity", "dolp", "aolp", SIDECARS, CALIBRATION];
/// Most bytes of a description or sidecar that are read.
pub(super) const MAX_TEXT: u64 = 1 << 20;
/// Version of the layout that this program writes and reads.
pub(super) const VERSION: u32 = 1;

/// Wall-clock time in RFC 3339, for people to read. Durations are measured with a monotonic clock instead.
pub(crate) fn timestamp() -> String {
    humantime::format_rfc3339_millis(SystemTime::now()).to_string()
}

/// Name and note of a session, as the user gave them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Label {
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub(crate) name: String,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub(crate) note: String,
}

/// Contents of `session.json`: how the session was recorded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Description {
    pub(super) version: u32,
    pub(super) program: String,
    /// Position among the sessions of a folder, which does not follow the clock; 0 before it is recorded.
    #[serde(default)]
    pub(super) number: u64,
    pub(super) started: String,
    /// Name and note that the user gave.
    #[serde(flatten)]
    pub(super) label: Label,
    pub(super) board: String,
    pub(super) format: Format,
    pub(super) size: [usize; 2],
    pub(super) channels: usize,
    pub(super) angles_deg: Vec<f64>,
    pub(super) guide: bool,
    pub(super) iterations: usize,
    pub(super) register: bool,
    /// Names of the planes of a result.
    pub(super) planes: Vec<String>,
}

impl Description {
    /// Describes a session that `board` records with this bundle, in `format`, from now on.
    pub(crate) fn new(board: &Board, bundle: &Bundle, format: Format, iterations: usize) -> Self {
        let (size, channels) = (bundle.sensor.size, bundle.sensor.channels);
        let angles = bundle.response.angles();
        Self {
            version: VERSION,
            program: format!("{PROGRAM}{}", env!("CARGO_PKG_VERSION")),
            number: 0,
            started: timestamp(),
            label: Label::default(),
            board: board.name.clone(),
            format,
            size: [size.width, size.height],
            channels,
            angles_deg: angles.iter().map(|a| a.degrees()).collect(),
            guide: board.guide.is_some(),
            iterations,
            register: board.register,
            planes: stokes_names(channels, !angles.is_empty()),
        }
    }
}

/// Type of the values that a camera delivers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SampleKind {
    /// Integer counts, recorded in 16 bits.
    Counts,
    /// Floating point, recorded as it is.
    Real,
}

/// Images that a session has of every frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Kinds {
    /// Values of the raw camera.
    pub(crate) raw: SampleKind,
    /// Values of the guide camera; none without one.
    pub(crate) guide: Option<SampleKind>,
    /// Whether results have S1 and S2.
    pub(crate) polarized: bool,
}

/// Image that a file of a recorded frame holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Content {
    Raw,
    Guide,
    Stokes,
    Intensity,
    Dolp,
    Aolp,
}

impl Content {
    /// Name of the folder of such files.
    pub(super) fn folder(self) -> &'static str {
        match self {
            Self::Raw => "raw",
            Self::Guide => "guide",
            Self::Stokes => "stokes",
            Self::Intensity => "intensity",
            Self::Dolp => "dolp",
            Self::Aolp => "aolp",
        }
    }
}

/// One image file that a recorded frame has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FrameFile {
    /// Image in the file.
    pub(super) content: Content,
    /// Type of its values.
    pub(super) samples: SampleKind,
    ending: &'static str,
}

impl FrameFile {
    /// Path of the file of frame `number`, relative to the session.
    pub(super) fn path(self, number: u64) -> String {
        format!("{}/{number:08}.{}", self.content.folder(), self.ending)
    }
}

/// Image files of a recorded frame in the order they are written. The sidecar is not among them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct FrameFiles(Vec<FrameFile>);

impl FrameFiles {
    /// Files of a frame in a session of this format with images of these kinds.
    pub(super) fn of(format: Format, kinds: Kinds) -> Self {
        use SampleKind::{Counts, Real};
        let camera = |content, samples| {
            // PNG holds no floating-point values
            let ending = if (format, samples) == (Format::Png16, Real) { "npy" } else { format.image_ending() };
            FrameFile { content, samples, ending }
        };
        let mut files = vec![camera(Content::Raw, kinds.raw)];
        files.extend(kinds.guide.map(|samples| camera(Content::Guide, samples)));
        if let Some(ending) = format.stack_ending() {
            files.push(FrameFile { content: Content::Stokes, samples: Real, ending });
        } else {
            let derived: &[Content] = if kinds.polarized {
                &[Content::Intensity, Content::Dolp, Content::Aolp]
            } else {
                &[Content::Intensity]
            };
            let ending = format.image_ending();
            files.extend(derived.iter().map(|&content| FrameFile { content, samples: Counts, ending }));
        }
        Self(files)
    }

    /// The files, in the order they are written.
    pub(super) fn iter(&self) -> impl Iterator<Item = FrameFile> {
        self.0.iter().copied()
    }

    /// Folders of a session with such frames: those of the images, of the sidecars and of the bundle.
    pub(super) fn folders(&self) -> impl Iterator<Item = &'static str> {
        self.iter().map(|file| file.content.folder()).chain([SIDECARS, CALIBRATION])
    }
}

/// Path of the sidecar of frame `number`, relative to the session.
pub(super) fn sidecar(number: u64) -> String {
    format!("{SIDECARS}/{number:08}.json")
}

/// Contents of a sidecar as they are written.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Sidecar<'a> {
    pub(super) frame: u64,
    pub(super) time: String,
    pub(super) uptime_seconds: f64,
    /// On the raw sensor's clock.
    pub(super) raw_seconds: f64,
    /// On the guide sensor's clock; none for a frame without a guide.
    pub(super) guide_seconds: Option<f64>,
    /// Paths of the images, relative to the session.
    pub(super) files: Vec<String>,
    pub(super) report: &'a Report,
}

/// Part of a sidecar that is read back: the times and the files of a frame.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(super) struct FrameEntry {
    pub(super) raw_seconds: f64,
    pub(super) guide_seconds: Option<f64>,
    pub(super) files: Vec<String>,
}

impl FrameEntry {
    /// Reads a sidecar.
    ///
    /// # Errors
    /// The problem, for people: the file cannot be read, is no sidecar, or names a file outside its session.
    pub(super) fn read(path: &Path) -> Result<Self, String> {
        let text = files::read_bytes(path, MAX_TEXT).map_err(|e| e.to_string())?;
        let entry: Self = serde_json::from_slice(&text).map_err(|e| e.to_string())?;
        let inside = |file: &&String| Path::new(file).components().all(|c| matches!(c, Component::Normal(_)));
        match entry.files.iter().find(|file| !inside(file)) {
            Some(file) => Err(format!("files: {file:?}, allowed: paths inside the session")),
            None => Ok(entry),
        }
    }

    /// Path of the file with this image, relative to the session; none if the frame has none.
    pub(super) fn file(&self, content: Content) -> Option<&str> {
        let inside = |file: &&String| Path::new(file).parent() == Some(Path::new(content.folder()));
        self.files.iter().find(inside).map(String::as_str)
    }
}

/// Part of a description that tells sessions from other folders.
#[derive(Deserialize)]
struct Identity {
    version: u32,
    program: String,
    #[serde(default)]
    number: u64,
}

/// Position of the session `folder` among those beside it; none if it is no session of this program: its name does not begin like one, it
/// is a symbolic link, or it has no description of this program.
pub(super) fn number(folder: &Path) -> Option<u64> {
    let named = folder.file_name()?.to_string_lossy().starts_with(PREFIX);
    if !named || !is_folder(folder) {
        return None;
    }
    let text = files::read_bytes(&folder.join(DESCRIPTION), MAX_TEXT).ok()?;
    let identity: Identity = serde_json::from_slice(&text).ok()?;
    (identity.version == VERSION && identity.program.starts_with(PROGRAM)).then_some(identity.number)
}

/// Whether `path` is a folder itself, not a link to one.
pub(super) fn is_folder(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok_and(|meta| meta.is_dir())
}

/// Contents of a folder of sessions.
#[derive(Debug, Default)]
pub(super) struct Listing {
    /// Folders of the sessions in the order they were recorded, oldest first, whatever the clock said.
    pub(super) sessions: Vec<PathBuf>,
    /// Position of the next session.
    pub(super) next: u64,
    /// Names of everything that this program did not make.
    pub(super) foreign: Vec<String>,
}

/// Lists the sessions in `dir`.
///
/// # Errors
/// When the folder cannot be read.
pub(super) fn list(dir: &Path) -> io::Result<Listing> {
    let (mut found, mut foreign) = (Vec::new(), Vec::new());
    for entry in fs::read_dir(dir)?.flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        match number(&entry.path()) {
            Some(number) => found.push((number, entry.path())),
            // what file systems and this program keep there
            None if name == "lost+found" || name == LOCK || name.starts_with(TEMPORARY) => {}
            None => foreign.push(name),
        }
    }
    found.sort();
    foreign.sort();
    let next = found.last().map_or(0, |(number, _)| *number) + 1;
    Ok(Listing { sessions: found.into_iter().map(|(_, folder)| folder).collect(), next, foreign })
}

/// Name of `path` while it is being removed: hidden, in the same folder.
pub(super) fn hidden(path: &Path) -> PathBuf {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{REMOVED}{name}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_format_and_the_kinds_of_images_decide_the_files_of_a_frame() {
        use SampleKind::{Counts, Real};
        let paths = |format, raw, guide, polarized| -> Vec<String> {
            FrameFiles::of(format, Kinds { raw, guide, polarized }).iter().map(|file| file.path(7)).collect()
        };
        let (n, t) = ("00000007.npy", "00000007.tif");
        assert_eq!(paths(Format::Npy, Counts, None, true), [format!("raw/{n}"), format!("stokes/{n}")]);
        assert_eq!(
            paths(Format::OmeTiff, Real, Some(Counts), true),
            [format!("raw/{t}"), format!("guide/{t}"), "stokes/00000007.ome.tif".into()]
        );
        let png = |folder: &str| format!("{folder}/00000007.png");
        assert_eq!(
            paths(Format::Png16, Real, Some(Counts), true),
            [format!("raw/{n}"), png("guide"), png("intensity"), png("dolp"), png("aolp")]
        );
        assert_eq!(paths(Format::Png16, Counts, None, false), [png("raw"), png("intensity")]);
    }

    #[test]
    fn a_sidecar_names_files_inside_its_session_alone() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("0.json");
        let read = |files: &str| {
            fs::write(&path, format!("{{\"raw_seconds\": 0, \"guide_seconds\": null, \"files\": [{files}]}}")).unwrap();
            FrameEntry::read(&path)
        };
        let entry = read("\"raw/0.npy\", \"stokes/0.npy\"").unwrap();
        assert_eq!((entry.file(Content::Raw), entry.file(Content::Guide)), (Some("raw/0.npy"), None));
        for outside in ["\"../0.npy\"", "\"/etc/passwd\"", "\"raw/../../0.npy\""] {
            assert!(read(outside).unwrap_err().contains("allowed: paths inside the session"), "{outside}");
        }
    }

    #[test]
    fn fault_31_the_order_of_sessions_does_not_follow_the_clock_and_other_things_are_no_sessions() {
        let dir = tempfile::tempdir().unwrap();
        let make = |name: &str, text: &str| {
            fs::create_dir(dir.path().join(name)).unwrap();
            fs::write(dir.path().join(name).join(DESCRIPTION), text).unwrap();
        };
        let own = |number: u64| format!("{{\"version\": 1, \"program\": \"stokescope 1\", \"number\": {number}}}");
        // the clock was a year ahead when the first one was recorded
        make("session-20270101-000000Z", &own(1));
        make("session-20260101-000000Z", &own(2));
        make("session-notes", "{}");
        make("session-other", &own(3).replace("stokescope", "scope"));
        make("session-newer", &own(3).replace("version\": 1", "version\": 2"));
        fs::write(dir.path().join("session-zzz.txt"), "").unwrap();
        fs::create_dir(dir.path().join("lost+found")).unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(dir.path().join("session-20260101-000000Z"), dir.path().join("session-link"))
            .unwrap();
        let found = list(dir.path()).unwrap();
        let names: Vec<_> = found.sessions.iter().map(|path| path.file_name().unwrap().to_str().unwrap()).collect();
        assert_eq!(names, ["session-20270101-000000Z", "session-20260101-000000Z"]);
        assert_eq!(found.next, 3);
        assert_eq!(
            found.foreign,
            ["session-link", "session-newer", "session-notes", "session-other", "session-zzz.txt"]
        );
    }
}
