//! Recording: every frame as the sensors delivered it, its result and a sidecar that says how they belong together.
//!
//! ```text
//! DIR/session-20260102-030405Z/session.json          what was recorded, and how
//!                              calibration/          the bundle
//!                              raw/00000000.npy      counts of the lensless sensor
//!                              guide/00000000.npy    counts of the guide camera, 65535 is full scale
//!                              stokes/00000000.npy   the result; as PNG: intensity/, dolp/ and aolp/
//!                              frames/00000000.json  the sidecar
//! ```
//!
//! Files appear whole or not at all, and the sidecar last: a frame with one is complete, whatever happened meanwhile.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use serde::{Deserialize, Serialize};
use serde_json::json;

use super::events::wall_clock;
use super::hub::{Hub, Recording, Shown};
use super::pair::Pair;
use crate::array::{WriteError, write_atomic};
use crate::output::export::{self, Format};
use crate::output::{OutputError, Report};
use crate::plane::{Stack, aolp_degrees, dolp};

/// Frames that may wait for the disk; a newer one then takes the place of the oldest.
pub(super) const WAITING: usize = 2;
/// Pause after a failure, so that a full disk is not asked with every frame.
const BACK_OFF: Duration = Duration::from_secs(1);
/// Begin of a session's name.
pub(super) const SESSION: &str = "session-";
/// Description of a session, and the folder of the sidecars in it.
pub(super) const DESCRIPTION: &str = "session.json";
pub(super) const FRAMES: &str = "frames";
/// Held by whoever records into a folder.
const LOCK: &str = ".lock";
/// What is on its way out begins with this.
const REMOVED: &str = ".removed-";

/// What to record, and how much of the disk to take.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordOptions {
    /// Folder of the sessions; made if need be.
    pub dir: PathBuf,
    /// Format of the images.
    pub format: Format,
    /// Most frames kept, over all sessions; none keeps all. The oldest go first.
    pub max_frames: Option<u64>,
    /// Most bytes kept, over all sessions; none keeps all. The oldest go first.
    pub max_bytes: Option<u64>,
    /// Bytes of the disk that stay free: recording pauses below.
    pub reserve_bytes: u64,
}

/// What a session's description says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Description {
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

/// What a sidecar says.
#[derive(Clone, Debug, Serialize)]
struct Sidecar<'a> {
    frame: u64,
    time: String,
    uptime_seconds: f64,
    /// On the sensors' clocks.
    raw_seconds: f64,
    guide_seconds: Option<f64>,
    /// Names of the files, from the session's folder.
    files: Vec<String>,
    report: &'a Report,
}

/// What of a sidecar replaying needs.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub(super) struct Played {
    pub(super) raw_seconds: f64,
    pub(super) guide_seconds: Option<f64>,
    pub(super) files: Vec<String>,
}

/// Why a frame was not recorded.
#[derive(Debug, thiserror::Error)]
pub(super) enum RecordError {
    #[error(transparent)]
    Output(#[from] OutputError),
    #[error(transparent)]
    Write(#[from] WriteError),
    #[error("{}: {source}", path.display())]
    Disk { path: PathBuf, source: io::Error },
    #[error("{}: {free} bytes are free, {reserve} are to stay so and a frame takes {need}", path.display())]
    Reserve { path: PathBuf, free: u64, reserve: u64, need: u64 },
}

/// What recording does to a disk. Tests have a disk that fails.
pub(super) trait Storage: Send {
    fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteError>;
    fn folder(&self, path: &Path) -> io::Result<()>;
    fn remove(&self, path: &Path) -> io::Result<()>;
    fn free(&self, path: &Path) -> io::Result<u64>;
}

/// The disk there is.
#[derive(Debug)]
pub(super) struct Disk;

impl Storage for Disk {
    fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
        write_atomic(path, |out| out.write_all(bytes))
    }

    fn folder(&self, path: &Path) -> io::Result<()> {
        fs::create_dir(path)
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) }
    }

    fn free(&self, path: &Path) -> io::Result<u64> {
        let disk = rustix::fs::statvfs(path)?;
        Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
    }
}

/// One frame on its way to the disk.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) pair: Pair,
    pub(super) shown: Arc<Shown>,
}

/// The way from the solver to the recording thread.
#[derive(Debug, Default)]
pub(super) struct Recorder {
    waiting: Mutex<Waiting>,
    bell: Condvar,
}

#[derive(Debug, Default)]
struct Waiting {
    jobs: heapless::Deque<Job, WAITING>,
    closed: bool,
}

impl Recorder {
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        // jobs come and go as a whole
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Hands a frame over. When the disk is behind the oldest waiting one goes, or this waits if `every` frame counts.
    pub(super) fn offer(&self, hub: &Hub, job: Job, every: bool) {
        let mut waiting = self.lock();
        while every && waiting.jobs.is_full() && !hub.stop.is_set() {
            waiting = self.bell.wait_timeout(waiting, BACK_OFF).unwrap_or_else(PoisonError::into_inner).0;
        }
        let dropped = if waiting.jobs.is_full() { waiting.jobs.pop_front() } else { None };
        let fits = waiting.jobs.push_back(job).is_ok();
        debug_assert!(fits, "there is room");
        drop(waiting);
        self.bell.notify_all();
        if let Some(job) = dropped {
            hub.pairing.recycle(job.pair);
            hub.figures().recording.dropped += 1;
        }
    }

    /// Lets [`Self::run`] write what waits and end.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.bell.notify_all();
    }

    /// Records until closed. What cannot be written is reported once; recording goes on as soon as the disk takes files.
    pub(super) fn run<S: Storage>(&self, hub: &Hub, mut session: Session<S>) {
        let mut not_before = None::<Instant>;
        loop {
            let mut waiting = self.lock();
            let job = loop {
                if let Some(job) = waiting.jobs.pop_front() {
                    break job;
                }
                if waiting.closed {
                    return;
                }
                waiting = self.bell.wait_timeout(waiting, BACK_OFF).unwrap_or_else(PoisonError::into_inner).0;
            };
            drop(waiting);
            self.bell.notify_all();
            if not_before.is_none_or(|time| Instant::now() >= time) {
                let outcome = session.record(hub.started, &job);
                not_before = outcome.is_err().then(|| Instant::now() + BACK_OFF);
                report(hub, &session, outcome);
            } else {
                hub.figures().recording.failed += 1;
            }
            hub.pairing.recycle(job.pair);
        }
    }
}

/// One alarm when recording stops, one line when it goes on.
fn report<S: Storage>(hub: &Hub, session: &Session<S>, outcome: Result<(), RecordError>) {
    let mut figures = hub.figures();
    let recording: &mut Recording = &mut figures.recording;
    (recording.session, recording.removed) = (session.dir.clone(), session.removed);
    let event = match outcome {
        Ok(()) => {
            recording.written += 1;
            recording.fault.take().map(|_| ("recording-resumed", json!({ "dir": session.options.dir })))
        }
        Err(e) => {
            recording.failed += 1;
            let first = recording.fault.replace(e.to_string()).is_none();
            first.then(|| ("recording-stopped", json!({ "reason": e.to_string() })))
        }
    };
    drop(figures);
    if let Some((name, detail)) = event {
        match detail["reason"].as_str() {
            Some(reason) => tracing::error!("not recording, the live view goes on: {reason}"),
            None => tracing::info!("{}: recording again", session.options.dir.display()),
        }
        hub.events.emit(name, detail);
    }
}

/// Whoever records into a folder holds this; the system takes it back when the process ends, however it ends.
#[derive(Debug)]
pub(super) struct Lock(#[allow(dead_code, reason = "it is held, not read")] File);

/// Makes `dir`, takes its lock, and clears away what an interrupted program left in it.
///
/// # Errors
/// When it cannot be made or another process holds it.
pub(super) fn take(dir: &Path) -> io::Result<Lock> {
    fs::create_dir_all(dir)?;
    let file = File::create(dir.join(LOCK))?;
    file.try_lock().map_err(|e| match e {
        fs::TryLockError::WouldBlock => io::Error::other("another instance records into it"),
        fs::TryLockError::Error(e) => e,
    })?;
    clear(dir)?;
    Ok(Lock(file))
}

/// Removes temporary files and sessions that were being removed, in `dir` and the folders of its sessions.
fn clear(dir: &Path) -> io::Result<()> {
    for entry in fs::read_dir(dir)?.flatten() {
        let (path, name) = (entry.path(), entry.file_name());
        let name = name.to_string_lossy();
        if name.starts_with(REMOVED) {
            fs::remove_dir_all(&path)?;
        } else if name.starts_with('.') && name.ends_with(".part") {
            fs::remove_file(&path)?;
        } else if path.is_dir() && !path.is_symlink() {
            clear(&path)?;
        }
    }
    Ok(())
}

/// Sessions in `dir`, oldest first: by their names, which begin with the time of their start.
pub(super) fn sessions(dir: &Path) -> io::Result<Vec<PathBuf>> {
    let mut found: Vec<PathBuf> = fs::read_dir(dir)?
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(SESSION))
        .map(|entry| entry.path())
        .collect();
    found.sort();
    Ok(found)
}

/// Frames and bytes of a folder.
fn usage(dir: &Path) -> (u64, u64) {
    let mut sum = (0, 0);
    for entry in fs::read_dir(dir).into_iter().flatten().flatten() {
        let Ok(meta) = entry.metadata() else { continue };
        if meta.is_dir() {
            let (frames, bytes) = usage(&entry.path());
            sum = (sum.0 + frames, sum.1 + bytes);
        } else {
            sum.0 += u64::from(dir.file_name().is_some_and(|name| name == FRAMES));
            sum.1 += meta.len();
        }
    }
    sum
}

/// One frame that was recorded.
#[derive(Clone, Copy, Debug)]
struct Kept {
    frame: u64,
    bytes: u64,
    guided: bool,
}

/// The session that is being recorded.
#[derive(Debug)]
pub(super) struct Session<S: Storage = Disk> {
    options: RecordOptions,
    description: Description,
    /// The bundle's folder.
    bundle: PathBuf,
    /// Counts per unit of the raw frames, 1 for cameras that deliver counts; none for floating-point ones.
    counts: bool,
    guide_counts: bool,
    storage: S,
    /// The session's folder, once there is one.
    dir: Option<PathBuf>,
    /// Earlier sessions with their frames and bytes; only counted when something limits them.
    earlier: VecDeque<(PathBuf, u64, u64)>,
    kept: VecDeque<Kept>,
    frames: u64,
    bytes: u64,
    removed: u64,
    buffer: Vec<u8>,
    planes: Option<Stack<f32>>,
    _lock: Option<Lock>,
}

impl<S: Storage> Session<S> {
    /// A session that begins with its first frame. `counts` tells of the raw and the guide camera whether they deliver integers.
    pub(super) fn new(
        options: RecordOptions,
        description: Description,
        bundle: PathBuf,
        counts: [bool; 2],
        storage: S,
        lock: Option<Lock>,
    ) -> Self {
        let mut earlier = VecDeque::new();
        if options.max_frames.is_some() || options.max_bytes.is_some() {
            let found = sessions(&options.dir).unwrap_or_default();
            earlier.extend(found.into_iter().map(|dir| {
                let (frames, bytes) = usage(&dir);
                (dir, frames, bytes)
            }));
        }
        let sum = earlier.iter().fold((0, 0), |(frames, bytes), (_, f, b)| (frames + f, bytes + b));
        Self {
            options,
            description,
            bundle,
            counts: counts[0],
            guide_counts: counts[1],
            storage,
            dir: None,
            earlier,
            kept: VecDeque::new(),
            frames: sum.0,
            bytes: sum.1,
            removed: 0,
            buffer: Vec::new(),
            planes: None,
            _lock: lock,
        }
    }

    /// Writes a frame, after making room for it.
    fn record(&mut self, started: Instant, job: &Job) -> Result<(), RecordError> {
        let need = self.kept.back().map_or_else(|| estimate(job), |kept| kept.bytes);
        self.make_room(need)?;
        let free = self.storage.free(&self.options.dir).map_err(|source| self.disk(&self.options.dir, source))?;
        let reserve = self.options.reserve_bytes;
        if free < reserve.saturating_add(need) {
            return Err(RecordError::Reserve { path: self.options.dir.clone(), free, reserve, need });
        }
        let dir = self.open()?;
        let mut files = Vec::new();
        let outcome = self.write_frame(&dir, started, job, &mut files);
        match outcome {
            Ok(bytes) => {
                self.frames += 1;
                self.bytes += bytes;
                if self.limited() || self.kept.is_empty() {
                    let guided = job.pair.guide.is_some();
                    self.kept.push_back(Kept { frame: job.shown.index, bytes, guided });
                }
                Ok(())
            }
            Err(e) => {
                // a frame is there as a whole or not at all: while its sidecar, which comes first, cannot be removed, all stays
                for file in files {
                    match self.storage.remove(&dir.join(file)) {
                        Err(e) if e.kind() != io::ErrorKind::NotFound => break,
                        _ => {}
                    }
                }
                Err(e)
            }
        }
    }

    fn limited(&self) -> bool {
        self.options.max_frames.is_some() || self.options.max_bytes.is_some()
    }

    fn disk(&self, path: &Path, source: io::Error) -> RecordError {
        RecordError::Disk { path: path.to_path_buf(), source }
    }

    /// The session's folder with all that stands in it before the first frame. Its name is new even when the clock jumped.
    fn open(&mut self) -> Result<PathBuf, RecordError> {
        if let Some(dir) = &self.dir {
            return Ok(dir.clone());
        }
        let dir = self.make_session(SystemTime::now())?;
        let made = self.furnish(&dir);
        if made.is_err() {
            let _ = self.storage.remove(&dir);
        }
        self.bytes += made?;
        self.dir = Some(dir.clone());
        Ok(dir)
    }

    fn make_session(&self, now: SystemTime) -> Result<PathBuf, RecordError> {
        let seconds = humantime::format_rfc3339_seconds(now).to_string();
        let name = SESSION.to_owned() + &seconds.replace(['-', ':'], "").replace('T', "-");
        for attempt in 1..10_000 {
            let path = self.options.dir.join(if attempt == 1 { name.clone() } else { format!("{name}-{attempt:04}") });
            match self.storage.folder(&path) {
                Ok(()) => return Ok(path),
                Err(e) if e.kind() == io::ErrorKind::AlreadyExists => {}
                Err(e) => return Err(self.disk(&path, e)),
            }
        }
        Err(self.disk(&self.options.dir.join(name), io::ErrorKind::AlreadyExists.into()))
    }

    /// Writes what a session holds beside its frames; gives the bytes.
    fn furnish(&self, dir: &Path) -> Result<u64, RecordError> {
        let mut sum = 0;
        let folders: &[&str] = match self.options.format {
            Format::Png16 => &["raw", "intensity", "dolp", "aolp", FRAMES, "calibration"],
            _ => &["raw", "stokes", FRAMES, "calibration"],
        };
        for folder in folders.iter().chain(self.description.guide.then_some(&"guide")) {
            let path = dir.join(folder);
            self.storage.folder(&path).map_err(|e| self.disk(&path, e))?;
        }
        for entry in fs::read_dir(&self.bundle).map_err(|e| self.disk(&self.bundle, e))?.flatten() {
            if entry.path().is_file() {
                let bytes = fs::read(entry.path()).map_err(|e| self.disk(&entry.path(), e))?;
                self.storage.write(&dir.join("calibration").join(entry.file_name()), &bytes)?;
                sum += bytes.len() as u64;
            }
        }
        let mut text = serde_json::to_vec_pretty(&self.description).map_err(|e| json_error(&e))?;
        text.push(b'\n');
        self.storage.write(&dir.join(DESCRIPTION), &text)?;
        Ok(sum + text.len() as u64)
    }

    /// Writes the files of a frame, the sidecar last; gives their bytes. `files` names what was begun, in order.
    fn write_frame(
        &mut self,
        dir: &Path,
        started: Instant,
        job: &Job,
        files: &mut Vec<String>,
    ) -> Result<u64, RecordError> {
        let (frame, shown, format) = (job.shown.index, &job.shown, self.options.format);
        let mut bytes = 0;
        let mut buffer = std::mem::take(&mut self.buffer);
        let mut put = |folder: &str, ending: &str, buffer: &[u8]| -> Result<(), RecordError> {
            let name = format!("{folder}/{frame:08}.{ending}");
            files.push(name.clone());
            self.storage.write(&dir.join(name), buffer)?;
            bytes += buffer.len() as u64;
            Ok(())
        };
        let guide = job.pair.guide.as_ref();
        let images = [
            ("raw", Some(&job.pair.raw), self.counts, 1.0),
            // what is kept of a guide frame is its share of full scale
            ("guide", guide, self.guide_counts, 65_535.0),
        ];
        for (folder, image, counts, scale) in images {
            let Some(image) = image else { continue };
            if counts {
                export::encode_counts(format, &image.planes, scale, &mut buffer)?;
                put(folder, format.image_ending(), &buffer)?;
            } else {
                export::encode_real(format, &image.planes, &mut buffer)?;
                put(folder, if format == Format::Png16 { "npy" } else { format.image_ending() }, &buffer)?;
            }
        }
        let time = wall_clock();
        if let Some(ending) = format.stack_ending() {
            export::encode_stack(format, &self.description.planes, &time, &shown.stokes, &mut buffer)?;
            put("stokes", ending, &buffer)?;
        } else {
            let planes = self.planes.get_or_insert_with(|| Stack::zeros(1, shown.size()));
            for (folder, scale) in [("intensity", 32_767.5), ("dolp", 65_535.0), ("aolp", 65_536.0 / 180.0)] {
                if folder != "intensity" && !shown.polarized() {
                    continue;
                }
                for (i, out) in planes.as_mut_slice().iter_mut().enumerate() {
                    let [s0, s1, s2] = [0, 1, 2].map(|k| shown.stokes_at(k, i));
                    *out = match folder {
                        "intensity" => s0 / shown.channels as f32,
                        "dolp" => dolp(s0, s1, s2),
                        _ => aolp_degrees(s1, s2),
                    };
                }
                export::encode_counts(format, planes, scale, &mut buffer)?;
                put(folder, "png", &buffer)?;
            }
        }
        let sidecar = Sidecar {
            frame,
            time,
            uptime_seconds: started.elapsed().as_secs_f64(),
            raw_seconds: job.pair.raw.timestamp.as_secs_f64(),
            guide_seconds: guide.map(|g| g.timestamp.as_secs_f64()),
            files: files.clone(),
            report: &shown.report,
        };
        buffer.clear();
        serde_json::to_writer_pretty(&mut buffer, &sidecar).map_err(|e| json_error(&e))?;
        buffer.push(b'\n');
        let name = format!("{FRAMES}/{frame:08}.json");
        files.insert(0, name.clone());
        self.storage.write(&dir.join(name), &buffer)?;
        bytes += buffer.len() as u64;
        self.buffer = buffer;
        Ok(bytes)
    }

    /// Removes the oldest sessions, then the oldest frames of this one, until a frame of `need` bytes is within the limits.
    fn make_room(&mut self, need: u64) -> Result<(), RecordError> {
        let exceeds = |frames: u64, bytes: u64, options: &RecordOptions| {
            options.max_frames.is_some_and(|most| frames + 1 > most)
                || options.max_bytes.is_some_and(|most| bytes + need > most)
        };
        while exceeds(self.frames, self.bytes, &self.options) {
            let (frames, bytes) = if let Some((dir, frames, bytes)) = self.earlier.front() {
                self.storage.remove(dir).map_err(|e| self.disk(dir, e))?;
                let counts = (*frames, *bytes);
                self.earlier.pop_front();
                counts
            } else if let Some(kept) = self.kept.front().copied() {
                self.remove_frame(kept)?;
                self.kept.pop_front();
                (1, kept.bytes)
            } else {
                break;
            };
            self.frames -= frames.min(self.frames);
            self.bytes -= bytes.min(self.bytes);
            self.removed += frames;
        }
        Ok(())
    }

    /// The sidecar goes first: without it the others are no frame.
    fn remove_frame(&self, kept: Kept) -> Result<(), RecordError> {
        let Some(dir) = &self.dir else { return Ok(()) };
        let (format, frame) = (self.options.format, kept.frame);
        let image = |counts: bool| if format == Format::Png16 && !counts { "npy" } else { format.image_ending() };
        let mut files = vec![(FRAMES, "json"), ("raw", image(self.counts))];
        files.extend(kept.guided.then(|| ("guide", image(self.guide_counts))));
        match format.stack_ending() {
            Some(ending) => files.push(("stokes", ending)),
            None => files.extend([("intensity", "png"), ("dolp", "png"), ("aolp", "png")]),
        }
        for (folder, ending) in files {
            let path = dir.join(format!("{folder}/{frame:08}.{ending}"));
            match self.storage.remove(&path) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(self.disk(&path, e)),
                _ => {}
            }
        }
        Ok(())
    }
}

/// Bytes of a frame before any was written.
fn estimate(job: &Job) -> u64 {
    let values = |planes: &Stack<f32>| planes.as_slice().len();
    let guide = job.pair.guide.as_ref().map_or(0, |guide| values(&guide.planes));
    (2 * (values(&job.pair.raw.planes) + guide) + 4 * values(&job.shown.stokes) + 4096) as u64
}

fn json_error(e: &serde_json::Error) -> OutputError {
    OutputError::Encode { format: "JSON", message: e.to_string() }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicI64, Ordering};

    use super::*;
    use crate::array::{read_image, read_npy};
    use crate::plane::Size;
    use crate::service::pair::Captured;
    use crate::service::view;

    const SIZE: Size = Size::new(6, 4);

    /// A disk that fails after so many operations, for so many; a write fails before, half-way through or after its file.
    #[derive(Debug)]
    struct Failing {
        after: AtomicI64,
        times: i64,
    }

    impl Failing {
        fn step(&self) -> io::Result<()> {
            let left = self.after.fetch_sub(1, Ordering::Relaxed);
            if left <= 0 && left > -self.times { Err(io::ErrorKind::StorageFull.into()) } else { Ok(()) }
        }
    }

    impl Storage for Failing {
        fn write(&self, path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
            let failed = |source| WriteError::Io { path: path.to_path_buf(), source };
            self.step().map_err(failed)?;
            write_atomic(path, |out| {
                let (first, second) = bytes.split_at(bytes.len() / 2);
                out.write_all(first)?;
                out.flush()?;
                self.step()?;
                out.write_all(second)
            })?;
            // the flush of the folder after the file has its name
            self.step().map_err(failed)
        }

        fn folder(&self, path: &Path) -> io::Result<()> {
            self.step()?;
            Disk.folder(path)
        }

        fn remove(&self, path: &Path) -> io::Result<()> {
            self.step()?;
            Disk.remove(path)
        }

        fn free(&self, path: &Path) -> io::Result<u64> {
            self.step()?;
            Disk.free(path)
        }
    }

    fn description(format: Format, guide: bool) -> Description {
        Description {
            version: 1,
            program: "test".into(),
            started: String::new(),
            board: "test".into(),
            format,
            size: [6, 4],
            channels: 1,
            angles_deg: vec![0.0, 45.0, 90.0, 135.0],
            guide,
            iterations: 2,
            register: false,
            planes: ["S0", "S1", "S2"].map(str::to_owned).to_vec(),
        }
    }

    fn job(frame: u64, guide: bool) -> Job {
        let planes = |v: f32| Stack::from_vec(1, SIZE, vec![v; SIZE.pixels()]).unwrap();
        let captured = |v: f32| Captured {
            planes: planes(v),
            timestamp: Duration::from_millis(100 * frame),
            arrived: Instant::now(),
        };
        let shown = Shown {
            index: frame,
            guided: guide,
            stokes: Stack::from_vec(3, SIZE, (0..3 * SIZE.pixels()).map(|i| i as f32 / 100.0).collect()).unwrap(),
            valid: vec![true; SIZE.pixels()],
            ..view::tests::frame(1)
        };
        let pair = Pair { raw: captured(1000.0 + frame as f32), guide: guide.then(|| captured(0.5)) };
        Job { pair, shown: Arc::new(shown) }
    }

    fn options(dir: &Path, format: Format) -> RecordOptions {
        RecordOptions { dir: dir.to_path_buf(), format, max_frames: None, max_bytes: None, reserve_bytes: 0 }
    }

    fn session<S: Storage>(options: RecordOptions, storage: S) -> (Session<S>, tempfile::TempDir) {
        let bundle = tempfile::tempdir().unwrap();
        fs::write(bundle.path().join("calibration.toml"), "version = 1\n").unwrap();
        let description = description(options.format, true);
        (Session::new(options, description, bundle.path().to_path_buf(), [true; 2], storage, None), bundle)
    }

    /// Every visible file is whole, and every sidecar's files are there; gives the number of sidecars.
    fn check(dir: &Path) -> usize {
        let mut frames = 0;
        for entry in fs::read_dir(dir).unwrap().flatten() {
            let path = entry.path();
            if path.is_dir() {
                frames += check(&path);
                continue;
            }
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            assert!(!name.ends_with(".part"), "{} was left behind", path.display());
            match path.extension().and_then(|e| e.to_str()) {
                Some("npy") => drop(read_npy(&path).unwrap()),
                Some("tif" | "png") => drop(read_image(&path).unwrap()),
                Some("json") if dir.ends_with(FRAMES) => {
                    frames += 1;
                    let played: Played = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
                    for file in &played.files {
                        assert!(dir.parent().unwrap().join(file).is_file(), "{file} of {}", path.display());
                    }
                }
                Some("json") => drop(serde_json::from_slice::<Description>(&fs::read(&path).unwrap()).unwrap()),
                _ => assert_eq!(name, "calibration.toml"),
            }
        }
        frames
    }

    #[test]
    fn every_format_keeps_raw_guide_result_and_sidecar() {
        for (format, ending) in
            [(Format::Npy, "npy"), (Format::Tiff, "tif"), (Format::OmeTiff, "ome.tif"), (Format::Png16, "png")]
        {
            let dir = tempfile::tempdir().unwrap();
            let (mut session, _bundle) = session(options(dir.path(), format), Disk);
            for frame in 0..3 {
                session.record(Instant::now(), &job(frame, frame != 1)).unwrap();
            }
            assert_eq!(check(dir.path()), 3);
            let at = session.dir.unwrap();
            let raw = read_image(&at.join(format!("raw/00000002.{}", format.image_ending()))).unwrap();
            let crate::array::Samples::U16(raw) = raw else { panic!("depth") };
            assert!(raw.as_slice().iter().all(|v| *v == 1002));
            assert!(!at.join(format!("guide/00000001.{}", format.image_ending())).exists());
            let result = if format == Format::Png16 { "dolp" } else { "stokes" };
            assert!(at.join(format!("{result}/00000000.{ending}")).is_file(), "{format:?}");
            assert!(at.join("calibration/calibration.toml").is_file());
        }
    }

    #[test]
    fn row_13_whatever_write_fails_no_file_is_left_half_done_and_recording_resumes() {
        for times in [1, 3, 1000] {
            for after in (0..48).step_by(if times == 1 { 1 } else { 3 }) {
                let dir = tempfile::tempdir().unwrap();
                let storage = Failing { after: AtomicI64::new(after), times };
                let (mut session, _bundle) = session(options(dir.path(), Format::Npy), storage);
                let mut failed = 0;
                for frame in 0..3 {
                    failed += u64::from(session.record(Instant::now(), &job(frame, true)).is_err());
                    check(dir.path());
                }
                session.storage.after.store(i64::MAX, Ordering::Relaxed);
                session.record(Instant::now(), &job(3, true)).unwrap();
                assert!(failed > 0 || after > 40, "operation {after} fails nothing");
                assert!(check(dir.path()) as u64 >= 4 - failed, "operation {after}");
            }
        }
    }

    #[test]
    fn the_oldest_go_when_there_are_too_many_or_too_large() {
        let dir = tempfile::tempdir().unwrap();
        let (mut first, _bundle) = session(options(dir.path(), Format::Npy), Disk);
        for frame in 0..4 {
            first.record(Instant::now(), &job(frame, true)).unwrap();
        }
        let old = first.dir.clone().unwrap();
        let few = RecordOptions { max_frames: Some(5), ..options(dir.path(), Format::Npy) };
        let (mut second, _bundle) = session(few, Disk);
        for frame in 0..9 {
            second.record(Instant::now(), &job(frame, true)).unwrap();
            assert!(check(dir.path()) <= 5);
        }
        assert!(!old.exists() && second.removed == 8, "{}", second.removed);
        let names = |s: &Session| -> Vec<_> {
            let mut names: Vec<_> = fs::read_dir(s.dir.as_ref().unwrap().join(FRAMES))
                .unwrap()
                .flatten()
                .map(|e| e.file_name().into_string().unwrap())
                .collect();
            names.sort();
            names
        };
        assert_eq!(names(&second)[0], "00000004.json");
        let (_, bytes) = usage(dir.path());
        let small = RecordOptions { max_bytes: Some(bytes), ..options(dir.path(), Format::Npy) };
        let (mut third, _bundle) = session(small, Disk);
        for frame in 0..9 {
            third.record(Instant::now(), &job(frame, true)).unwrap();
            let (_, now) = usage(dir.path());
            assert!(now <= bytes + 1024, "{now} of {bytes}");
        }
    }

    #[test]
    fn below_the_reserve_nothing_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let greedy = RecordOptions { reserve_bytes: u64::MAX, ..options(dir.path(), Format::Npy) };
        let (mut session, _bundle) = session(greedy, Disk);
        let e = session.record(Instant::now(), &job(0, true)).unwrap_err().to_string();
        assert!(e.contains("bytes are free") && fs::read_dir(dir.path()).unwrap().next().is_none(), "{e}");
    }

    #[test]
    fn row_15_names_are_unique_whatever_the_clock_does() {
        let dir = tempfile::tempdir().unwrap();
        let (session, _bundle) = session(options(dir.path(), Format::Npy), Disk);
        let now = SystemTime::UNIX_EPOCH + Duration::from_secs(1_767_323_045);
        let year = Duration::from_secs(366 * 86_400);
        let names = [now, now, now + year, now, now - year, now + year].map(|t| session.make_session(t).unwrap());
        let distinct: std::collections::BTreeSet<_> = names.iter().collect();
        assert_eq!(distinct.len(), names.len());
        assert!(names[0].ends_with("session-20260102-030405Z") && names[1].ends_with("session-20260102-030405Z-0002"));
    }

    #[test]
    fn a_folder_has_one_recorder_and_what_an_interrupted_one_left_goes() {
        let dir = tempfile::tempdir().unwrap();
        let raw = dir.path().join("session-1/raw");
        fs::create_dir_all(&raw).unwrap();
        fs::write(raw.join(".abc.part"), "half").unwrap();
        fs::write(raw.join("0.npy"), "kept").unwrap();
        let lock = take(dir.path()).unwrap();
        assert_eq!(fs::read_dir(&raw).unwrap().count(), 1);
        assert!(take(dir.path()).unwrap_err().to_string().contains("another instance"));
        drop(lock);
        take(dir.path()).unwrap();
    }
}
