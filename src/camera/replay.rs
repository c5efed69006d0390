//! Replay of recorded frames.

use std::{
    borrow::Cow,
    collections::BTreeSet,
    path::{Path, PathBuf},
    time::Duration,
};

use super::{Camera, CameraError, CameraInfo, Limits, Request, clock::Trigger, interleave};
use crate::files::{self, Samples as Array};
use stokescope_core::frame::{Frame, Metadata, PixelFormat, Samples};
use stokescope_core::image::Size;

/// File name extensions of frames.
const EXTENSIONS: [&str; 4] = ["npy", "png", "tif", "tiff"];
/// File with the time of each frame, one per line: in seconds, or in milliseconds after the line [`TIMECODES`].
const TIMES: &str = "timestamps.txt";
/// Most bytes of that file that are read.
const MAX_TIMES: u64 = 256 << 20;
/// First line of a file of time codes in milliseconds, as `rpicam-vid --save-pts` and mkvtoolnix write it.
const TIMECODES: [&str; 2] = ["# timecode format v2", "# timestamp format v2"];
/// Frames per second of recordings without time stamps.
const FRAME_RATE: f64 = 10.0;

/// Camera that replays recorded frames: one file, or the files of a folder in the order of their names. In the folder of a whole
/// capture these are the file `raw.*` or `guide.*`, or the folder `raw` or `guide`, depending on the role.
///
/// Time stamps come from `timestamps.txt` in the same folder; otherwise frames have the requested rate or 10 per second. A frame that
/// is missing or damaged is named in the log once, and an error that the next frame follows. Frames that are neither paced nor repeated come
/// in their order, every one of them, however late they are taken; others follow the clock.
pub struct ReplayCamera {
    info: CameraInfo,
    files: Vec<PathBuf>,
    /// Time of each frame from the first one, and the time at which a repetition starts.
    times: Vec<Duration>,
    paced: bool,
    repeat: bool,
    shown: u64,
    trigger: Trigger,
    bytes: Vec<u8>,
    /// Frames that were named as missing or damaged.
    named: BTreeSet<usize>,
}

impl ReplayCamera {
    /// Opens the recording `request.source` for `request.role`.
    ///
    /// # Errors
    /// [`CameraError::Source`] without frames or with invalid times, [`CameraError::Array`] when no frame can be read.
    pub fn open(request: &Request) -> Result<Self, CameraError> {
        let path = Path::new(&request.source);
        let (files, folder) = frames(path, &request.role.to_string())?;
        if files.is_empty() {
            let what = format!("contains no frames ({})", EXTENSIONS.join(", "));
            return Err(CameraError::Source { path: path.to_path_buf(), what });
        }
        let recorded = folder.map(|folder| folder.join(TIMES)).filter(|file| file.exists());
        let times = match (recorded, request.frame_rate) {
            (Some(file), None) => read_times(&file, files.len())?,
            (_, rate) => {
                let period = 1.0 / rate.filter(|r| *r > 0.0).unwrap_or(FRAME_RATE);
                (0..=files.len()).map(|n| Duration::from_secs_f64(n as f64 * period)).collect()
            }
        };
        let mut bytes = Vec::new();
        let mut readable = files.iter().map(|file| read(file, &mut bytes));
        let first = readable.next().unwrap_or(Ok((PixelFormat::Mono(Samples::U8), Size::new(0, 0))));
        let (format, size) = first.or_else(|e| readable.find_map(Result::ok).ok_or(e))?;
        let length = times[files.len()].as_secs_f64();
        Ok(Self {
            info: CameraInfo {
                name: format!("replayed {} camera, {}", request.role, path.display()),
                backend: "replay",
                format,
                size,
                frame_rate: (request.paced && length > 0.0).then(|| files.len() as f64 / length),
                levels: None,
                readout: None,
                limits: Limits::default(),
            },
            files,
            times,
            paced: request.paced,
            repeat: request.repeat,
            shown: 0,
            trigger: request.clock.join(),
            bytes,
            named: BTreeSet::new(),
        })
    }

    /// Time of frame `index`; it increases over repetitions.
    fn time(&self, index: u64) -> Duration {
        let count = self.files.len();
        let (round, n) = (index / count as u64, (index % count as u64) as usize);
        self.times[n] + self.times[count].saturating_mul(round.min(u64::from(u32::MAX)) as u32)
    }

    /// Reads file `n`, which is frame `sequence`.
    ///
    /// # Errors
    /// [`CameraError::Damaged`] or [`CameraError::Changed`], named once; another one when the whole folder is gone.
    fn read(&mut self, n: usize, sequence: u64) -> Result<(), CameraError> {
        let path = &self.files[n];
        let error = match read(path, &mut self.bytes) {
            Ok(found) if found == (self.info.format, self.info.size) => return Ok(()),
            Ok((found_format, found_size)) => {
                let (format, size) = (self.info.format, self.info.size);
                CameraError::Changed { path: origin(path).into_owned(), format, size, found_format, found_size }
            }
            Err(e) if !origin(path).parent().is_some_and(Path::is_dir) => return Err(e),
            Err(e) => CameraError::Damaged { camera: self.info.name.clone(), sequence, what: e.to_string() },
        };
        if self.named.insert(n) {
            tracing::warn!("left out: {error}");
        }
        Err(error)
    }
}

impl Camera for ReplayCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame<'_>, CameraError> {
        let ended = |index: u64| !self.repeat && index >= self.files.len() as u64;
        let name = || self.info.name.clone();
        if ended(self.shown) {
            return Err(CameraError::Ended { camera: name(), frames: self.shown });
        }
        let wait = match self.shown.checked_sub(1) {
            Some(last) if self.paced => self.time(self.shown).saturating_sub(self.time(last)),
            _ => Duration::ZERO,
        };
        let index = if self.paced || self.repeat {
            let tick = self.trigger.next(wait, timeout);
            tick.ok_or_else(|| CameraError::Timeout { camera: name(), after: timeout })?.number
        } else {
            self.shown
        };
        if ended(index) {
            return Err(CameraError::Ended { camera: name(), frames: self.shown });
        }
        self.shown = index + 1;
        let n = (index % self.files.len() as u64) as usize;
        self.read(n, index)?;
        let (format, size) = (self.info.format, self.info.size);
        let metadata = Metadata { sequence: index, timestamp: self.time(index), ..Metadata::default() };
        Frame::new(&self.bytes, format, size, format.row_bytes(size.width), metadata)
            .map_err(|source| CameraError::Frame { camera: self.info.name.clone(), source })
    }
}

/// Files of `role` under `path`, and their folder if they are a sequence.
fn frames(path: &Path, role: &str) -> Result<(Vec<PathBuf>, Option<PathBuf>), CameraError> {
    if !path.is_dir() {
        return Ok((vec![path.to_path_buf()], None));
    }
    let sequence = path.join(role);
    let single =
        EXTENSIONS.iter().map(|extension| path.join(format!("{role}.{extension}"))).find(|file| file.is_file());
    let folder = match single {
        _ if sequence.is_dir() => sequence,
        Some(file) => return Ok((vec![file], None)),
        None => path.to_path_buf(),
    };
    let failed = |e: std::io::Error| CameraError::Source { path: folder.clone(), what: e.to_string() };
    let mut found = Vec::new();
    for entry in std::fs::read_dir(&folder).map_err(failed)? {
        let file = entry.map_err(failed)?.path();
        if files::is_visible(&file) && files::has_extension(&file, &EXTENSIONS) {
            found.push(file);
        }
    }
    found.sort_by(|a, b| files::natural_order(a, b));
    Ok((found, Some(folder)))
}

/// Reads the times in `file`, relative to the first, and appends the end: one mean interval after the last.
fn read_times(file: &Path, count: usize) -> Result<Vec<Duration>, CameraError> {
    let refuse = |what: String| CameraError::Times { path: file.to_path_buf(), what };
    let bytes = files::read_bytes(file, MAX_TIMES)
        .map_err(|e| CameraError::Source { path: file.to_path_buf(), what: e.to_string() })?;
    let text = String::from_utf8(bytes).map_err(|e| refuse(e.to_string()))?;
    let mut seconds = Vec::with_capacity(count + 1);
    let codes = text.lines().next().is_some_and(|line| TIMECODES.contains(&line.trim()));
    let unit = if codes { 1e-3 } else { 1.0 };
    for (line, word) in text.lines().enumerate().skip(usize::from(codes)) {
        match word.trim().parse::<f64>().map(|t| t * unit) {
            Ok(t) if t.is_finite() && t.abs() < 1e12 && seconds.last().is_none_or(|last| t > *last) => seconds.push(t),
            _ => return Err(refuse(format!("line {}: `{word}`, allowed: seconds that increase", line + 1))),
        }
    }
    if seconds.len() != count {
        return Err(refuse(format!("{} times for {count} frames", seconds.len())));
    }
    let length = seconds[count - 1] - seconds[0];
    let period = if count > 1 { length / (count - 1) as f64 } else { 1.0 / FRAME_RATE };
    seconds.push(seconds[count - 1] + period);
    Ok(seconds.iter().map(|t| Duration::from_secs_f64(t - seconds[0])).collect())
}

/// File that a link of our own leads to; other files are their own origin.
fn origin(path: &Path) -> Cow<'_, Path> {
    let target = std::fs::read_link(path).ok().filter(|target| target.is_absolute());
    target.map_or(Cow::Borrowed(path), Cow::Owned)
}

/// Reads a file into `bytes` as a camera would deliver the frame; returns its format and size.
fn read(path: &Path, bytes: &mut Vec<u8>) -> Result<(PixelFormat, Size), CameraError> {
    let image = files::read_image(&origin(path))?;
    let samples = match &image {
        Array::U8(planes) => {
            interleave(planes, bytes, |v| [v]);
            Samples::U8
        }
        Array::U16(planes) => {
            interleave(planes, bytes, u16::to_le_bytes);
            Samples::U16
        }
        Array::F32(planes) => {
            interleave(planes, bytes, f32::to_ne_bytes);
            Samples::F32
        }
    };
    let format = if image.count() == 3 { PixelFormat::Rgb(samples) } else { PixelFormat::Mono(samples) };
    Ok((format, image.size()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Clock, Role};

    const LONG: Duration = Duration::from_secs(5);

    fn request(path: &Path, role: Role, clock: &Clock) -> Request {
        Request { source: path.display().to_string(), paced: false, ..Request::new(role, clock) }
    }

    fn recording(role: &str, count: usize) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join(role)).unwrap();
        for n in 0..count {
            let file = dir.path().join(role).join(format!("{n:03}.npy"));
            files::write_npy(&file, &[1, 2], &[n as f32, 0.5]).unwrap();
        }
        dir
    }

    fn value(frame: &Frame<'_>) -> f32 {
        f32::from_ne_bytes(frame.row(0)[..4].try_into().unwrap())
    }

    #[test]
    fn frames_come_in_order_and_repeat_with_increasing_times() {
        let dir = recording("raw", 2);
        std::fs::write(dir.path().join("raw").join(TIMES), "7.5\n7.75\n").unwrap();
        let mut camera = ReplayCamera::open(&request(dir.path(), Role::Raw, &Clock::default())).unwrap();
        let seen: Vec<_> = (0..4)
            .map(|_| {
                let frame = camera.next_frame(LONG).unwrap();
                (value(&frame), frame.metadata.sequence, frame.metadata.timestamp.as_millis())
            })
            .collect();
        assert_eq!(seen, [(0.0, 0, 0), (1.0, 1, 250), (0.0, 2, 500), (1.0, 3, 750)]);
    }

    #[test]
    fn a_recording_shown_once_ends() {
        let dir = recording("guide", 1);
        let once = Request { repeat: false, ..request(dir.path(), Role::Guide, &Clock::default()) };
        let mut camera = ReplayCamera::open(&once).unwrap();
        camera.next_frame(LONG).unwrap();
        assert!(matches!(camera.next_frame(LONG), Err(CameraError::Ended { frames: 1, .. })));
    }

    #[test]
    fn colour_is_interleaved() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("guide.npy");
        files::write_npy(&file, &[3, 1, 2], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]).unwrap();
        let mut camera = ReplayCamera::open(&request(dir.path(), Role::Guide, &Clock::default())).unwrap();
        let frame = camera.next_frame(LONG).unwrap();
        assert_eq!(frame.format(), PixelFormat::Rgb(Samples::F32));
        let row: Vec<f32> = frame.row(0).chunks_exact(4).map(|b| f32::from_ne_bytes(b.try_into().unwrap())).collect();
        assert_eq!(row, [1.0, 3.0, 5.0, 2.0, 4.0, 6.0]);
    }

    #[test]
    fn faults_are_named() {
        let dir = recording("raw", 2);
        let open = || ReplayCamera::open(&request(dir.path(), Role::Raw, &Clock::default()));
        let times = dir.path().join("raw").join(TIMES);
        std::fs::write(&times, "1\n1\n").unwrap();
        assert!(open().err().unwrap().to_string().contains("line 2: `1`"));
        std::fs::remove_file(&times).unwrap();
        files::write_npy(&dir.path().join("raw/001.npy"), &[1, 3], &[0.0; 3]).unwrap();
        let mut camera = open().unwrap();
        camera.next_frame(LONG).unwrap();
        let e = camera.next_frame(LONG).unwrap_err().to_string();
        assert!(e.ends_with("001.npy: mono float of 3×1, the recording began with mono float of 2×1"), "{e}");
        let empty = tempfile::tempdir().unwrap();
        let e = ReplayCamera::open(&request(empty.path(), Role::Raw, &Clock::default())).err().unwrap().to_string();
        assert!(e.ends_with("contains no frames (npy, png, tif, tiff)"), "{e}");
    }

    #[test]
    fn a_missing_or_damaged_frame_is_left_out_and_a_folder_that_is_gone_is_a_lost_camera() {
        let dir = recording("raw", 6);
        let file = |n: usize| dir.path().join(format!("raw/{n:03}.npy"));
        std::fs::write(file(0), "damaged").unwrap();
        let once = Request { repeat: false, ..request(dir.path(), Role::Raw, &Clock::default()) };
        let mut camera = ReplayCamera::open(&once).unwrap();
        std::fs::remove_file(file(2)).unwrap();
        let seen: Vec<_> = (0..5).map(|_| camera.next_frame(LONG).map(|frame| value(&frame))).collect();
        let broken = |k: usize| seen[k].as_ref().is_err_and(|e| e.is_passing() && e.to_string().contains(".npy"));
        assert!(broken(0) && broken(2), "{seen:?}");
        assert!([1, 3, 4].iter().all(|&k| seen[k].as_ref().is_ok_and(|v| *v == k as f32)), "{seen:?}");
        std::fs::remove_dir_all(dir.path().join("raw")).unwrap();
        assert!(camera.next_frame(LONG).is_err_and(|e| !e.is_passing()));
        assert!(matches!(camera.next_frame(LONG), Err(CameraError::Ended { .. })));
    }
}
