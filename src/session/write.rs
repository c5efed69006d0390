//! Recording of a session, frame by frame.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::RecordOptions;
use super::layout::{
    CALIBRATION, Content, DESCRIPTION, Description, FrameFile, FrameFiles, Kinds, LOCK, Label, NEW, PREFIX, SampleKind,
    Sidecar, THUMBNAIL, is_folder, list, sidecar, timestamp,
};
use super::lock::{FolderLock, identity};
use super::prune::{self, Inventory};
use super::storage::{Disk, RecordError, Storage};
use crate::files::read_bytes;
use crate::output::export;
use crate::output::panel::encode_png;
use crate::output::{OutputError, Report, ResultImages, thumbnail};
use stokescope_core::image::Stack;
use stokescope_core::polarization::{aolp_degrees, dolp};

/// Most bytes of one file of a bundle that is copied into a session.
const MAX_BUNDLE: u64 = 4 << 30;
/// Attempts to find a name for a session that no other has.
const NAMES: u32 = 10_000;

/// Image of one camera, borrowed, as it is recorded.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CapturedImage<'a> {
    /// Counts, or fractions of full scale.
    pub(crate) planes: &'a Stack<f32>,
    /// On the sensor's clock.
    pub(crate) timestamp: Duration,
}

/// Everything that is recorded of one frame, borrowed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameData<'a> {
    /// Number of the frame in its session.
    pub(crate) number: u64,
    /// Time since the recording program started.
    pub(crate) uptime: Duration,
    pub(crate) raw: CapturedImage<'a>,
    pub(crate) guide: Option<CapturedImage<'a>>,
    pub(crate) result: ResultImages<'a>,
    pub(crate) report: &'a Report,
}

impl FrameData<'_> {
    /// Bytes that the frame takes, before any frame was written.
    fn estimate(&self) -> u64 {
        let values = |planes: &Stack<f32>| planes.as_slice().len();
        let guide = self.guide.map_or(0, |guide| values(guide.planes));
        (2 * (values(self.raw.planes) + guide) + 4 * values(self.result.stokes) + 4096) as u64
    }
}

/// The session that is being recorded. Its folder is made with the first frame.
#[derive(Debug)]
pub(crate) struct SessionWriter<S: Storage = Disk> {
    options: RecordOptions,
    description: Description,
    files: FrameFiles,
    /// Folder of the bundle that is copied into the session.
    bundle: PathBuf,
    storage: S,
    folder: Option<SessionFolder>,
    inventory: Inventory,
    /// Bytes of the newest frame.
    last_bytes: Option<u64>,
    /// One encoded file.
    encoded: Vec<u8>,
    /// One plane computed from Stokes images.
    plane: Option<Stack<f32>>,
    lock: Lock,
}

/// Folder of a session, and what tells it from another one of the same name.
#[derive(Debug)]
struct SessionFolder {
    path: PathBuf,
    identity: (u64, u64),
}

/// Right to record into the folder of the sessions.
#[derive(Debug)]
pub(crate) enum Lock {
    Held(FolderLock),
    /// The folder was removed or replaced. It is locked again before the next frame.
    Lost,
    /// Tests record several sessions into one folder.
    #[cfg(test)]
    Shared,
}

impl Lock {
    /// Makes the folder `dir` of sessions, locks it, and removes what an interrupted process left there.
    ///
    /// # Errors
    /// When the folder cannot be made or read, or another process holds the lock.
    pub(crate) fn take(dir: &Path) -> io::Result<Self> {
        let lock = FolderLock::take(dir, LOCK)?;
        prune::finish_removals(dir)?;
        Ok(Self::Held(lock))
    }

    fn is_current(&self) -> bool {
        match self {
            Self::Held(lock) => lock.is_current(),
            Self::Lost => false,
            #[cfg(test)]
            Self::Shared => true,
        }
    }
}

impl<S: Storage> SessionWriter<S> {
    /// Prepares a session with frames of these kinds; `bundle` is the folder of the bundle. Writes nothing yet.
    pub(crate) fn new(
        options: RecordOptions,
        description: Description,
        kinds: Kinds,
        bundle: PathBuf,
        storage: S,
        lock: Lock,
    ) -> Self {
        Self {
            files: FrameFiles::of(options.format, kinds),
            inventory: Inventory::scan(&options),
            options,
            description,
            bundle,
            storage,
            folder: None,
            last_bytes: None,
            encoded: Vec::new(),
            plane: None,
            lock,
        }
    }

    /// Folder of the sessions.
    pub(crate) fn dir(&self) -> &Path {
        &self.options.dir
    }

    /// Folder of the session; none before the first frame.
    pub(crate) fn folder(&self) -> Option<&Path> {
        self.folder.as_ref().map(|folder| folder.path.as_path())
    }

    /// Recorded frames that were removed to make room.
    pub(crate) fn removed(&self) -> u64 {
        self.inventory.removed
    }

    /// Lets the next frame begin a new session with this label.
    pub(crate) fn begin(&mut self, label: Label) {
        self.folder = None;
        self.description.label = label;
        self.recount();
    }

    /// Counts the sessions anew: the last one ended, or some were removed by somebody else.
    pub(crate) fn recount(&mut self) {
        let removed = self.inventory.removed;
        let mut inventory = Inventory::scan(&self.options);
        inventory.removed = removed;
        self.inventory = inventory;
    }

    /// Records a frame, after making room for it.
    ///
    /// # Errors
    /// [`RecordError`]. No part of the frame is visible then, unless the disk refuses to remove it: then it is whole.
    pub(crate) fn record(&mut self, frame: &FrameData<'_>) -> Result<(), RecordError> {
        self.settle()?;
        let need = self.last_bytes.unwrap_or_else(|| frame.estimate());
        let folder = self.folder.as_ref().map(|folder| folder.path.as_path());
        self.inventory.make_room(&self.storage, folder, &self.files, need);
        self.check_free(need)?;
        let folder = self.open(frame)?;
        match self.write_frame(&folder, frame) {
            Ok(bytes) => {
                self.last_bytes = Some(bytes);
                self.inventory.add_frame(frame.number, bytes);
                Ok(())
            }
            Err(e) => {
                // the failure to write is the one to report
                let _ = prune::remove_frame(&self.storage, &folder, &self.files, frame.number);
                Err(e)
            }
        }
    }

    /// Takes the folder of the sessions again where it was removed, replaced or made anew, and gives up a session that is no longer whole:
    /// the next frame begins a new one.
    fn settle(&mut self) -> Result<(), RecordError> {
        let dir = &self.options.dir;
        let is_intact = |folder: &SessionFolder| {
            let same = fs::symlink_metadata(&folder.path).is_ok_and(|meta| identity(&meta) == folder.identity);
            same && self.files.folders().all(|part| is_folder(&folder.path.join(part)))
        };
        let is_current = self.lock.is_current();
        if is_current && self.folder.as_ref().is_none_or(is_intact) {
            return Ok(());
        }
        if let Some(folder) = self.folder.take() {
            tracing::warn!(
                "{}: was removed or replaced while it was recorded; a new session begins",
                folder.path.display()
            );
        }
        if !is_current {
            self.lock = Lock::Lost;
            self.lock = Lock::take(dir).map_err(|e| RecordError::disk(dir, e))?;
        }
        self.recount();
        Ok(())
    }

    fn check_free(&self, need: u64) -> Result<(), RecordError> {
        let (dir, reserve) = (&self.options.dir, self.options.reserve_bytes);
        let free = self.storage.free(dir).map_err(|e| RecordError::disk(dir, e))?;
        if free < reserve.saturating_add(need) {
            return Err(RecordError::Reserve { path: dir.clone(), free, reserve, need });
        }
        Ok(())
    }

    /// Folder of the session, made now if it is not there yet.
    fn open(&mut self, frame: &FrameData<'_>) -> Result<PathBuf, RecordError> {
        if let Some(folder) = &self.folder {
            return Ok(folder.path.clone());
        }
        self.description.started = timestamp();
        let (path, mut bytes) = self.make_folder(SystemTime::now())?;
        bytes += self.write_thumbnail(&path, &frame.result)?;
        self.inventory.add_bytes(bytes);
        let meta = fs::symlink_metadata(&path).map_err(|e| RecordError::disk(&path, e))?;
        self.folder = Some(SessionFolder { path: path.clone(), identity: identity(&meta) });
        Ok(path)
    }

    /// Makes a folder named after the time, with the bundle and the description; gives it and the bytes written. It gets its name when it is
    /// complete. The name is new even when the clock jumped back, and the number in the description tells the order.
    fn make_folder(&mut self, now: SystemTime) -> Result<(PathBuf, u64), RecordError> {
        let dir = &self.options.dir;
        let seconds = humantime::format_rfc3339_seconds(now).to_string();
        let name = PREFIX.to_owned() + &seconds.replace(['-', ':'], "").replace('T', "-");
        let names = (1..NAMES).map(|n| if n == 1 { name.clone() } else { format!("{name}-{n:04}") });
        let is_free = |name: &String| fs::symlink_metadata(dir.join(name)).is_err();
        let Some(name) = names.into_iter().find(is_free) else {
            return Err(RecordError::disk(&dir.join(name), io::ErrorKind::AlreadyExists.into()));
        };
        self.description.number = list(dir).map_err(|e| RecordError::disk(dir, e))?.next;
        let (made, path) = (dir.join(format!("{NEW}{name}")), dir.join(name));
        if is_folder(&made) {
            // an earlier attempt failed
            prune::remove_own(&self.storage, &made)?;
        }
        self.storage.create_folder(&made).map_err(|e| RecordError::disk(&made, e))?;
        let named = self.write_head(&made).and_then(|bytes| {
            self.storage.rename(&made, &path).map_err(|e| RecordError::disk(&path, e))?;
            Ok(bytes)
        });
        if named.is_err() {
            // the failure to write is the one to report
            let _ = prune::remove_own(&self.storage, &made);
        }
        let bytes = named?;
        self.storage.sync_folder(dir).map_err(|e| RecordError::disk(dir, e))?;
        Ok((path, bytes))
    }

    /// Writes a small picture of the first frame; gives its bytes.
    fn write_thumbnail(&self, folder: &Path, result: &ResultImages<'_>) -> Result<u64, RecordError> {
        let mut bytes = Vec::new();
        let encoded = encode_png(&thumbnail(result), &mut bytes);
        encoded.map_err(|e| OutputError::Encode { format: "PNG", message: e.to_string() })?;
        self.storage.write(&folder.join(THUMBNAIL), &bytes)?;
        Ok(bytes.len() as u64)
    }

    /// Makes the folders of a session and writes its bundle and description; gives the bytes written.
    fn write_head(&self, folder: &Path) -> Result<u64, RecordError> {
        let mut sum = 0;
        for name in self.files.folders() {
            let path = folder.join(name);
            self.storage.create_folder(&path).map_err(|e| RecordError::disk(&path, e))?;
        }
        for entry in fs::read_dir(&self.bundle).map_err(|e| RecordError::disk(&self.bundle, e))?.flatten() {
            if entry.path().is_file() {
                let bytes = read_bytes(&entry.path(), MAX_BUNDLE).map_err(|e| RecordError::disk(&entry.path(), e))?;
                self.storage.write(&folder.join(CALIBRATION).join(entry.file_name()), &bytes)?;
                sum += bytes.len() as u64;
            }
        }
        let mut text = serde_json::to_vec_pretty(&self.description).map_err(|e| json_error(&e))?;
        text.push(b'\n');
        self.storage.write(&folder.join(DESCRIPTION), &text)?;
        Ok(sum + text.len() as u64)
    }

    /// Writes the files of a frame, the sidecar last; gives their bytes.
    fn write_frame(&mut self, folder: &Path, frame: &FrameData<'_>) -> Result<u64, RecordError> {
        let time = timestamp();
        let present = |file: &FrameFile| file.content != Content::Guide || frame.guide.is_some();
        let files: Vec<FrameFile> = self.files.iter().filter(present).collect();
        let (mut bytes, mut paths) = (0, Vec::with_capacity(files.len()));
        for file in files {
            self.encode(file, frame, &time)?;
            let path = file.path(frame.number);
            self.storage.write(&folder.join(&path), &self.encoded)?;
            bytes += self.encoded.len() as u64;
            paths.push(path);
        }
        let contents = Sidecar {
            frame: frame.number,
            time,
            uptime_seconds: frame.uptime.as_secs_f64(),
            raw_seconds: frame.raw.timestamp.as_secs_f64(),
            guide_seconds: frame.guide.map(|guide| guide.timestamp.as_secs_f64()),
            files: paths,
            report: frame.report,
        };
        self.encoded.clear();
        serde_json::to_writer_pretty(&mut self.encoded, &contents).map_err(|e| json_error(&e))?;
        self.encoded.push(b'\n');
        self.storage.write(&folder.join(sidecar(frame.number)), &self.encoded)?;
        Ok(bytes + self.encoded.len() as u64)
    }

    /// Encodes one image of a frame into the buffer.
    fn encode(&mut self, file: FrameFile, frame: &FrameData<'_>, time: &str) -> Result<(), OutputError> {
        let (format, encoded, result) = (self.options.format, &mut self.encoded, &frame.result);
        let camera = match file.content {
            Content::Raw => Some((frame.raw.planes, 1.0)),
            // guides are fractions of full scale
            Content::Guide => frame.guide.map(|guide| (guide.planes, 65_535.0)),
            _ => None,
        };
        if let Some((planes, scale)) = camera {
            return match file.samples {
                SampleKind::Counts => export::encode_counts(format, planes, scale, encoded),
                SampleKind::Real => export::encode_real(format, planes, encoded),
            };
        }
        if file.content == Content::Stokes {
            return export::encode_stack(format, &self.description.planes, time, result.stokes, encoded);
        }
        let plane = self.plane.get_or_insert_with(|| Stack::zeros(1, result.size));
        let derive = |i: usize| {
            let [s0, s1, s2] = [0, 1, 2].map(|k| result.stokes_at(k, i));
            match file.content {
                Content::Dolp => dolp(s0, s1, s2),
                Content::Aolp => aolp_degrees(s1, s2),
                _ => s0 / result.channels as f32,
            }
        };
        plane.as_mut_slice().iter_mut().enumerate().for_each(|(i, out)| *out = derive(i));
        export::encode_counts(format, plane, full_scale(file.content), encoded)
    }
}

/// Counts per unit of an image that PNG keeps in 16 bits.
fn full_scale(content: Content) -> f32 {
    match content {
        Content::Intensity => 32_767.5,
        Content::Aolp => 65_536.0 / 180.0,
        _ => 65_535.0,
    }
}

fn json_error(e: &serde_json::Error) -> OutputError {
    OutputError::Encode { format: "JSON", message: e.to_string() }
}

#[cfg(test)]
pub(super) mod tests {
    use std::sync::LazyLock;

    use super::super::layout::{FrameEntry, REMOVED, SIDECARS, VERSION};
    use super::super::storage::tests::FailingDisk;
    use super::*;
    use crate::files::{ImageStack, read_image, read_npy};
    use crate::output::export::Format;
    use stokescope_core::image::Size;

    const SIZE: Size = Size::new(6, 4);

    impl<S: Storage> SessionWriter<S> {
        /// Ends the recording and gives its disk back.
        pub(in crate::session) fn into_storage(self) -> S {
            self.storage
        }
    }

    fn description(format: Format) -> Description {
        Description {
            version: VERSION,
            program: "stokescope test".into(),
            number: 0,
            started: String::new(),
            label: Label::default(),
            board: "test".into(),
            format,
            size: [6, 4],
            channels: 1,
            angles_deg: vec![0.0, 45.0, 90.0, 135.0],
            guide: true,
            iterations: 2,
            register: false,
            planes: ["S0", "S1", "S2"].map(str::to_owned).to_vec(),
        }
    }

    /// Options without limits.
    pub(in crate::session) fn options(dir: &Path, format: Format) -> RecordOptions {
        RecordOptions { dir: dir.to_path_buf(), format, max_frames: None, max_bytes: None, reserve_bytes: 0 }
    }

    /// A session of cameras that count, with the folder of its bundle.
    pub(in crate::session) fn writer<S: Storage>(
        options: RecordOptions,
        storage: S,
    ) -> (SessionWriter<S>, tempfile::TempDir) {
        let bundle = tempfile::tempdir().unwrap();
        fs::write(bundle.path().join("calibration.toml"), "version = 1\n").unwrap();
        let kinds = Kinds { raw: SampleKind::Counts, guide: Some(SampleKind::Counts), polarized: true };
        let description = description(options.format);
        (SessionWriter::new(options, description, kinds, bundle.path().to_path_buf(), storage, Lock::Shared), bundle)
    }

    /// Records a frame whose raw counts are 1000 plus its number.
    pub(in crate::session) fn record<S: Storage>(
        writer: &mut SessionWriter<S>,
        number: u64,
        guided: bool,
    ) -> Result<(), RecordError> {
        static REPORT: LazyLock<Report> = LazyLock::new(Report::default);
        let planes = |v: f32| Stack::from_vec(1, SIZE, vec![v; SIZE.pixels()]).unwrap();
        let (raw, guide) = (planes(1000.0 + number as f32), planes(0.5));
        let stokes = Stack::from_vec(3, SIZE, (0..3 * SIZE.pixels()).map(|i| i as f32 / 100.0).collect()).unwrap();
        let timestamp = Duration::from_millis(100 * number);
        writer.record(&FrameData {
            number,
            uptime: Duration::ZERO,
            raw: CapturedImage { planes: &raw, timestamp },
            guide: guided.then_some(CapturedImage { planes: &guide, timestamp }),
            result: ResultImages {
                size: SIZE,
                channels: 1,
                angles: None,
                angle_list: &[],
                stokes: &stokes,
                errors: None,
                valid: &[true; SIZE.pixels()],
                stage1: None,
            },
            report: &REPORT,
        })
    }

    /// Checks that every visible file is whole and every sidecar's files are there; gives the number of sidecars.
    pub(in crate::session) fn check(dir: &Path) -> usize {
        let mut frames = 0;
        for entry in fs::read_dir(dir).unwrap().flatten() {
            let path = entry.path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            if [REMOVED, NEW].iter().any(|hidden| name.starts_with(hidden)) || name == ".lock" {
                continue;
            }
            if path.is_dir() {
                frames += check(&path);
                continue;
            }
            assert!(!name.ends_with(".part"), "{} was left behind", path.display());
            match path.extension().and_then(|e| e.to_str()) {
                Some("npy") => drop(read_npy(&path).unwrap()),
                Some("tif" | "png") => match ImageStack::open(&path).unwrap() {
                    Some(mut pages) => (0..pages.count()).for_each(|page| drop(pages.read(page).unwrap())),
                    None => drop(read_image(&path).unwrap()),
                },
                Some("json") if dir.ends_with(SIDECARS) => {
                    frames += 1;
                    for file in &FrameEntry::read(&path).unwrap().files {
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
            let (mut session, _bundle) = writer(options(dir.path(), format), Disk);
            (0..3).for_each(|number| record(&mut session, number, number != 1).unwrap());
            assert_eq!(check(dir.path()), 3);
            let at = session.folder().unwrap();
            let raw = read_image(&at.join(format!("raw/00000002.{}", format.image_ending()))).unwrap();
            let crate::files::Samples::U16(raw) = raw else { panic!("depth") };
            assert!(raw.as_slice().iter().all(|v| *v == 1002));
            assert!(!at.join(format!("guide/00000001.{}", format.image_ending())).exists());
            let result = if format == Format::Png16 { "dolp" } else { "stokes" };
            assert!(at.join(format!("{result}/00000000.{ending}")).is_file(), "{format:?}");
            assert!(at.join("calibration/calibration.toml").is_file());
        }
    }

    #[test]
    fn fault_13_whatever_write_fails_no_file_is_left_half_done_and_recording_resumes() {
        for times in [1, 3, 1000] {
            for after in (0..48).step_by(if times == 1 { 1 } else { 3 }) {
                let dir = tempfile::tempdir().unwrap();
                let (mut session, _bundle) = writer(options(dir.path(), Format::Npy), FailingDisk::new(after, times));
                let mut failed = 0;
                for number in 0..3 {
                    failed += usize::from(record(&mut session, number, true).is_err());
                    check(dir.path());
                }
                session.storage.repair();
                record(&mut session, 3, true).unwrap();
                assert!(failed > 0 || after > 40, "operation {after} fails nothing");
                assert!(check(dir.path()) >= 4 - failed, "operation {after}");
            }
        }
    }

    #[test]
    fn the_oldest_are_removed_when_there_are_too_many_or_too_large() {
        let dir = tempfile::tempdir().unwrap();
        let (mut first, _bundle) = writer(options(dir.path(), Format::Npy), Disk);
        (0..4).for_each(|number| record(&mut first, number, true).unwrap());
        let old = first.folder().unwrap().to_path_buf();
        let few = RecordOptions { max_frames: Some(5), ..options(dir.path(), Format::Npy) };
        let (mut second, _bundle) = writer(few, Disk);
        for number in 0..9 {
            record(&mut second, number, true).unwrap();
            assert!(check(dir.path()) <= 5);
        }
        assert!(!old.exists() && second.removed() == 8, "{}", second.removed());
        let sidecars = fs::read_dir(second.folder().unwrap().join(SIDECARS)).unwrap();
        let oldest = sidecars.flatten().map(|e| e.file_name().into_string().unwrap()).min();
        assert_eq!(oldest.as_deref(), Some("00000004.json"));
        let used = || -> u64 {
            let sessions = list(dir.path()).unwrap().sessions;
            sessions.iter().map(|session| prune::usage(session).1).sum()
        };
        let bytes = used();
        let small = RecordOptions { max_bytes: Some(bytes), ..options(dir.path(), Format::Npy) };
        let (mut third, _bundle) = writer(small, Disk);
        for number in 0..9 {
            record(&mut third, number, true).unwrap();
            assert!(used() <= bytes + 1024, "{} of {bytes}", used());
        }
    }

    #[test]
    fn below_the_reserve_nothing_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let greedy = RecordOptions { reserve_bytes: u64::MAX, ..options(dir.path(), Format::Npy) };
        let (mut session, _bundle) = writer(greedy, Disk);
        let e = record(&mut session, 0, true).unwrap_err().to_string();
        assert!(e.contains("bytes are free") && fs::read_dir(dir.path()).unwrap().next().is_none(), "{e}");
    }

    #[test]
    fn fault_15_names_are_unique_whatever_the_clock_does() {
        let dir = tempfile::tempdir().unwrap();
        let (mut session, _bundle) = writer(options(dir.path(), Format::Npy), Disk);
        let now = SystemTime::UNIX_EPOCH + Duration::from_secs(1_767_323_045);
        let year = Duration::from_secs(366 * 86_400);
        let names = [now, now, now + year, now, now - year, now + year].map(|t| session.make_folder(t).unwrap().0);
        let distinct: std::collections::BTreeSet<_> = names.iter().collect();
        assert_eq!(distinct.len(), names.len());
        assert!(names[0].ends_with("session-20260102-030405Z") && names[1].ends_with("session-20260102-030405Z-0002"));
        assert_eq!(list(dir.path()).unwrap().sessions, names, "in the order they were made");
    }

    #[test]
    fn a_new_session_survives_a_power_cut_from_its_first_frame_on() {
        let dir = tempfile::tempdir().unwrap();
        let (mut session, _bundle) = writer(options(dir.path(), Format::Npy), FailingDisk::new(i64::MAX, 0));
        record(&mut session, 0, true).unwrap();
        let unsynced = session.storage.unsynced();
        assert!(!unsynced.contains(&dir.path().to_path_buf()), "{unsynced:?}");
        session.storage.cut_power(dir.path());
        assert_eq!(check(dir.path()), 1);
    }

    /// A folder of sessions and a writer that holds its lock.
    fn exclusive() -> (tempfile::TempDir, PathBuf, SessionWriter, tempfile::TempDir) {
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("sessions");
        let (mut session, bundle) = writer(options(&dir, Format::Npy), Disk);
        session.lock = Lock::take(&dir).unwrap();
        record(&mut session, 0, true).unwrap();
        (parent, dir, session, bundle)
    }

    #[test]
    fn recording_resumes_in_a_folder_that_was_removed_swapped_or_made_anew() {
        type Change = fn(&Path, &Path);
        let changes: [Change; 5] = [
            |dir, _| fs::remove_dir_all(dir).unwrap(),
            |dir, _| (fs::remove_dir_all(dir).unwrap(), fs::create_dir(dir).unwrap()).1,
            |dir, _| (fs::rename(dir, dir.with_extension("old")).unwrap(), fs::create_dir(dir).unwrap()).1,
            |_, session| fs::remove_dir_all(session).unwrap(),
            |_, session| fs::remove_dir_all(session.join("guide")).unwrap(),
        ];
        for (n, change) in changes.into_iter().enumerate() {
            let (_parent, dir, mut session, _bundle) = exclusive();
            change(&dir, session.folder().unwrap());
            record(&mut session, 1, true).unwrap();
            let folder = session.folder().unwrap();
            assert!(folder.join("frames/00000001.json").is_file() && folder.join(DESCRIPTION).is_file(), "{n}");
            assert!(Lock::take(&dir).is_err(), "{n}: the new folder is locked");
        }
    }

    #[test]
    fn a_folder_that_another_instance_took_over_is_not_written_to() {
        let (_parent, dir, mut session, _bundle) = exclusive();
        fs::remove_dir_all(&dir).unwrap();
        let other = Lock::take(&dir).unwrap();
        let e = record(&mut session, 1, true).unwrap_err().to_string();
        assert!(e.contains("another instance"), "{e}");
        drop(other);
        record(&mut session, 2, true).unwrap();
    }
}
