//! `stokescope capture`: writes frames of a board's cameras to files, unprocessed.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Serialize;

use super::exposure;
use crate::Error;
use crate::board::{Board, CameraSpec};
use crate::camera::{self, Camera, CameraError, Clock, Request, Role};
use crate::files::{WriteError, write_atomic, write_npy};
use stokescope_core::frame::Metadata;
use stokescope_core::image::Stack;
use stokescope_core::readings::unpack;

/// Time limit for a frame; cameras with a low frame rate get three frame intervals.
const FRAME_LIMIT: Duration = Duration::from_secs(2);
/// Largest number of frames that are skipped for each pair, because they are broken or unpaired.
const MAX_SKIPPED: u32 = 50;

/// Write frames of a board's cameras to files: DIR/raw, DIR/guide (NPY, counts) and session.json.
///
/// The files can be replayed (backend = "replay", source = DIR) and used for calibration.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Shipped board, or a board file.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// Number of frame pairs.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub frames: u64,
    /// Folder to write; it must not exist yet.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Capture only from the lensless camera.
    #[arg(long)]
    pub raw_only: bool,
}

/// Record of one camera in `session.json`.
#[derive(Serialize)]
struct CameraRecord {
    role: String,
    camera: String,
    backend: &'static str,
    format: String,
    width: usize,
    height: usize,
    /// Number of frames skipped because they were broken or unpaired.
    passed_over: u64,
    /// Share of saturated readings, of the frame that has most.
    saturated: f64,
    frames: Vec<FrameRecord>,
}

/// Metadata of one frame in `session.json`.
#[derive(Serialize)]
struct FrameRecord {
    sequence: u64,
    timestamp_seconds: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    exposure_us: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    gain: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    temperature_c: Option<f32>,
}

impl From<Metadata> for FrameRecord {
    fn from(m: Metadata) -> Self {
        let Metadata { sequence, exposure_us, gain, temperature_c, .. } = m;
        Self { sequence, timestamp_seconds: m.timestamp.as_secs_f64(), exposure_us, gain, temperature_c }
    }
}

/// A camera that is being captured.
struct CapturedCamera {
    role: Role,
    camera: Box<dyn Camera>,
    planes: Stack<f32>,
    latest: Metadata,
    record: CameraRecord,
}

impl CapturedCamera {
    fn open(spec: &CameraSpec, request: &Request) -> Result<Self, CameraError> {
        let (role, camera) = (request.role, camera::open(&spec.backend, request)?);
        let info = camera.info().clone();
        let record = CameraRecord {
            role: role.to_string(),
            camera: info.name,
            backend: info.backend,
            format: info.format.name(),
            width: info.size.width,
            height: info.size.height,
            passed_over: 0,
            saturated: 0.0,
            frames: Vec::new(),
        };
        let planes = Stack::zeros(info.format.planes(), info.format.plane_size(info.size));
        Ok(Self { role, camera, planes, latest: Metadata::default(), record })
    }

    /// Captures the next intact frame into `planes`.
    fn next(&mut self) -> Result<(), CameraError> {
        let rate = self.camera.info().frame_rate;
        let timeout = rate.map_or(FRAME_LIMIT, |rate| FRAME_LIMIT.max(Duration::from_secs_f64(3.0 / rate)));
        for _ in 0..MAX_SKIPPED {
            match self.camera.next_frame(timeout) {
                Ok(frame) => {
                    self.latest = frame.metadata;
                    return unpack(&frame, &mut self.planes).map_err(|e| CameraError::Backend {
                        name: self.record.backend.to_owned(),
                        reason: e.to_string(),
                    });
                }
                Err(e) if e.is_passing() => self.record.passed_over += 1,
                Err(e) => return Err(e),
            }
        }
        let camera = self.record.camera.clone();
        Err(CameraError::Lost { camera, reason: format!("{MAX_SKIPPED} broken frames in a row") })
    }

    /// Writes the latest frame as number `index` into the session folder `dir`.
    fn write(&mut self, dir: &Path, index: u64) -> Result<(), WriteError> {
        let path = dir.join(self.role.to_string()).join(format!("{index:06}.npy"));
        let (count, size) = (self.planes.count(), self.planes.size());
        let shape = [count, size.height, size.width];
        let shape = if count == 1 { &shape[1..] } else { &shape[..] };
        if self.camera.info().format.bits().is_some() {
            let counts: Vec<u16> = self.planes.as_slice().iter().map(|v| v.round() as u16).collect();
            write_npy(&path, shape, &counts)?;
        } else {
            write_npy(&path, shape, self.planes.as_slice())?;
        }
        let share = exposure::saturated(&self.planes, self.camera.info());
        self.record.saturated = self.record.saturated.max(share);
        self.record.frames.push(self.latest.into());
        Ok(())
    }
}

/// Captures frames, then prints one line, or with `json` one object.
///
/// # Errors
/// A board or camera that is not usable, cameras whose frames do not pair, or a folder that cannot be written.
#[allow(clippy::print_stdout, reason = "output of the command")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let board = Board::load(&args.board)?;
    if args.out.exists() {
        return Err(Error::Usage(format!("--out {}: exists already; choose a new folder", args.out.display())));
    }
    let fail = |source| WriteError::Create { path: args.out.clone(), source };
    let parent = args.out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(parent).map_err(fail)?;
    // renamed to its final name when complete
    let work = tempfile::Builder::new().prefix(".capture-").tempdir_in(parent).map_err(fail)?;

    let clock = Clock::default();
    let orientation = board.orientation()?;
    let open = |role, spec| CapturedCamera::open(spec, &Request::of(role, spec, &clock, orientation));
    let mut raw = open(Role::Raw, &board.raw)?;
    let guide = board.guide.as_ref().filter(|_| !args.raw_only);
    let mut guide = guide.map(|spec| open(Role::Guide, spec)).transpose()?;
    for camera in std::iter::once(&raw).chain(&guide) {
        std::fs::create_dir(work.path().join(camera.role.to_string())).map_err(fail)?;
    }
    for index in 0..args.frames {
        raw.next()?;
        if let Some(guide) = &mut guide {
            guide.next()?;
            pair(&mut raw, guide, Duration::from_micros(board.max_skew_us))?;
            guide.write(work.path(), index)?;
        }
        raw.write(work.path(), index)?;
    }
    let captured: Vec<CapturedCamera> = std::iter::once(raw).chain(guide).collect();
    for camera in &captured {
        let times: String = camera.record.frames.iter().map(|frame| format!("{}\n", frame.timestamp_seconds)).collect();
        let path = work.path().join(camera.role.to_string()).join("timestamps.txt");
        write_atomic(&path, |out| out.write_all(times.as_bytes()))?;
    }
    let cameras: Vec<CameraRecord> = captured.into_iter().map(|camera| camera.record).collect();
    let session = serde_json::json!({ "board": board.name, "cameras": cameras });
    write_atomic(&work.path().join("session.json"), |out| writeln!(out, "{session:#}"))?;
    std::fs::rename(work.path(), &args.out).map_err(fail)?;

    for camera in cameras.iter().filter(|camera| camera.saturated > exposure::WARN_SHARE) {
        let (role, percent) = (&camera.role, 100.0 * camera.saturated);
        tracing::warn!("{role} camera: {percent:.1} % of the readings of a frame are saturated: {}", exposure::REMEDY);
    }
    let passed_over: u64 = cameras.iter().map(|camera| camera.passed_over).sum();
    if json {
        let saturated: Vec<f64> = cameras.iter().map(|camera| camera.saturated).collect();
        let formats: Vec<&str> = cameras.iter().map(|camera| camera.format.as_str()).collect();
        println!(
            "{}",
            serde_json::json!({
                "out": args.out, "frames": args.frames, "formats": formats, "passed_over": passed_over,
                "saturated": saturated,
            })
        );
    } else {
        println!("{}: {} frames of each camera, {passed_over} skipped", args.out.display(), args.frames);
    }
    Ok(())
}

/// Skips frames of the camera that is behind, until the time stamps of both differ by at most `max_skew`.
fn pair(raw: &mut CapturedCamera, guide: &mut CapturedCamera, max_skew: Duration) -> Result<(), CameraError> {
    for _ in 0..MAX_SKIPPED {
        if raw.latest.timestamp.abs_diff(guide.latest.timestamp) <= max_skew {
            return Ok(());
        }
        let behind = if raw.latest.timestamp < guide.latest.timestamp { &mut *raw } else { &mut *guide };
        behind.record.passed_over += 1;
        behind.next()?;
    }
    let skew = raw.latest.timestamp.abs_diff(guide.latest.timestamp);
    let reason = format!(
        "its frames and those of {} are {skew:?} apart, allowed: cameras.max_skew_us = {} µs",
        raw.record.camera,
        max_skew.as_micros()
    );
    Err(CameraError::Lost { camera: guide.record.camera.clone(), reason })
}
