//! Names of a session's files and folders, and the contents of its description and sidecars.

use std::fs;
use std::io;
use std::path::{Component, Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use crate::board::Board;
use crate::bundle::Bundle;
use crate::output::Report;
use crate::output::export::Format;

/// Start of the name of every session's folder.
pub(super) const PREFIX: &str = "session-";
/// File in a session that describes it.
pub(super) const DESCRIPTION: &str = "session.json";
/// Folder in a session that holds the bundle.
pub(super) const CALIBRATION: &str = "calibration";
/// Folder in a session that holds the sidecars.
pub(super) const SIDECARS: &str = "frames";
/// Start of the name of a session or sidecar that is being removed. Readers pass over it.
pub(super) const REMOVED: &str = ".removed-";
/// Version of the layout that this program writes and reads.
pub(super) const VERSION: u32 = 1;

/// Wall-clock time in RFC 3339, for people to read. Durations are measured with a monotonic clock instead.
pub(crate) fn timestamp() -> String {
    humantime::format_rfc3339_millis(SystemTime::now()).to_string()
}

/// Contents of `session.json`: how the session was recorded.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Description {
    pub(super) version: u32,
    pub(super) program: String,
    pub(super) started: String,
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
        let components: &[&str] = if angles.is_empty() { &["S0"] } else { &["S0", "S1", "S2"] };
        let channel = |c: usize| if channels == 3 { ["red ", "green ", "blue "][c] } else { "" };
        Self {
            version: VERSION,
            program: format!("stokescope {}", env!("CARGO_PKG_VERSION")),
            started: timestamp(),
            board: board.name.clone(),
            format,
            size: [size.width, size.height],
            channels,
            angles_deg: angles.iter().map(|a| a.degrees()).collect(),
            guide: board.guide.is_some(),
            iterations,
            register: board.register,
            planes: (0..channels).flat_map(|c| components.iter().map(move |s| format!("{}{s}", channel(c)))).collect(),
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
        let text = fs::read(path).map_err(|e| e.to_string())?;
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

/// Folders of the sessions in `dir`, oldest first: names begin with the time of the start.
///
/// # Errors
/// When the folder cannot be read.
pub(super) fn sessions(dir: &Path) -> io::Result<Vec<PathBuf>> {
    let mut found: Vec<PathBuf> = fs::read_dir(dir)?
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(PREFIX))
        .map(|entry| entry.path())
        .collect();
    found.sort();
    Ok(found)
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
}
