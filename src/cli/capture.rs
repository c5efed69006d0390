//! `stokescope capture`: frames of a board's cameras into files, as they are.

use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::Serialize;

use crate::Error;
use crate::board::{Board, CameraSpec};
use crate::camera::{self, Camera, CameraError, Clock, Request, Role};
use crate::files::{WriteError, write_atomic, write_npy};
use stokescope_core::frame::Metadata;
use stokescope_core::image::Stack;
use stokescope_core::readings::unpack;

/// A camera that is silent this long gives no frame, unless its frames are meant to be farther apart.
const SILENCE: Duration = Duration::from_secs(2);
/// Broken frames, or frames without a partner, that are passed over for each pair.
const CHANCES: u32 = 50;

/// Frames of a board's cameras into files: DIR/raw, DIR/guide (NPY, counts) and session.json.
///
/// What it writes can be replayed (backend = "replay", source = DIR) and calibrated from.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Shipped board, or the file of one.
    #[arg(long, value_name = "NAME|FILE", default_value = "x86-sim")]
    pub board: String,
    /// Pairs of frames.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub frames: u64,
    /// Folder of the session; it must not exist yet.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Only the lensless camera.
    #[arg(long)]
    pub raw_only: bool,
}

/// One camera of the session, with what its frames said.
#[derive(Serialize)]
struct Recorded {
    role: String,
    camera: String,
    backend: &'static str,
    format: String,
    width: usize,
    height: usize,
    /// Broken frames, and frames without a partner.
    passed_over: u64,
    frames: Vec<Said>,
}

#[derive(Serialize)]
struct Said {
    sequence: u64,
    timestamp_seconds: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    exposure_us: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    gain: Option<f32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    temperature_c: Option<f32>,
}

impl From<Metadata> for Said {
    fn from(m: Metadata) -> Self {
        let Metadata { sequence, exposure_us, gain, temperature_c, .. } = m;
        Self { sequence, timestamp_seconds: m.timestamp.as_secs_f64(), exposure_us, gain, temperature_c }
    }
}

/// A camera being recorded.
struct Source {
    role: Role,
    camera: Box<dyn Camera>,
    planes: Stack<f32>,
    latest: Metadata,
    recorded: Recorded,
}

impl Source {
    fn open(role: Role, spec: &CameraSpec, clock: &Clock) -> Result<Self, CameraError> {
        let camera = camera::open(&spec.backend, &Request::of(role, spec, clock))?;
        let info = camera.info().clone();
        let recorded = Recorded {
            role: role.to_string(),
            camera: info.name,
            backend: info.backend,
            format: info.format.name(),
            width: info.size.width,
            height: info.size.height,
            passed_over: 0,
            frames: Vec::new(),
        };
        let planes = Stack::zeros(info.format.planes(), info.format.plane_size(info.size));
        Ok(Self { role, camera, planes, latest: Metadata::default(), recorded })
    }

    /// Takes the next whole frame.
    fn next(&mut self) -> Result<(), CameraError> {
        let rate = self.camera.info().frame_rate;
        let timeout = rate.map_or(SILENCE, |rate| SILENCE.max(Duration::from_secs_f64(3.0 / rate)));
        for _ in 0..CHANCES {
            match self.camera.next_frame(timeout) {
                Ok(frame) => {
                    self.latest = frame.metadata;
                    return unpack(&frame, &mut self.planes).map_err(|e| CameraError::Backend {
                        name: self.recorded.backend.to_owned(),
                        reason: e.to_string(),
                    });
                }
                Err(e) if e.is_passing() => self.recorded.passed_over += 1,
                Err(e) => return Err(e),
            }
        }
        let camera = self.recorded.camera.clone();
        Err(CameraError::Lost { camera, reason: format!("{CHANCES} broken frames in a row") })
    }

    /// Writes the frame it has as number `index` of the session in `dir`.
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
        self.recorded.frames.push(self.latest.into());
        Ok(())
    }
}

/// Captures, then prints one line, or with `json` one object.
///
/// # Errors
/// A board or cameras that cannot be used, cameras whose frames do not belong together, a folder that cannot be written.
#[allow(clippy::print_stdout, reason = "the command's answer")]
pub fn run(args: &Args, json: bool) -> Result<(), Error> {
    let board = Board::load(&args.board)?;
    if args.out.exists() {
        return Err(Error::Usage(format!("--out {}: exists already", args.out.display())));
    }
    let fail = |source| WriteError::Create { path: args.out.clone(), source };
    let parent = args.out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(parent).map_err(fail)?;
    // under its final name once it is whole
    let work = tempfile::Builder::new().prefix(".capture-").tempdir_in(parent).map_err(fail)?;

    let clock = Clock::default();
    let mut raw = Source::open(Role::Raw, &board.raw, &clock)?;
    let guide = board.guide.as_ref().filter(|_| !args.raw_only);
    let mut guide = guide.map(|spec| Source::open(Role::Guide, spec, &clock)).transpose()?;
    for source in std::iter::once(&raw).chain(&guide) {
        std::fs::create_dir(work.path().join(source.role.to_string())).map_err(fail)?;
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
    let sources: Vec<Source> = std::iter::once(raw).chain(guide).collect();
    for source in &sources {
        let times: String = source.recorded.frames.iter().map(|said| format!("{}\n", said.timestamp_seconds)).collect();
        let path = work.path().join(source.role.to_string()).join("timestamps.txt");
        write_atomic(&path, |out| out.write_all(times.as_bytes()))?;
    }
    let cameras: Vec<Recorded> = sources.into_iter().map(|source| source.recorded).collect();
    let session = serde_json::json!({ "board": board.name, "cameras": cameras });
    write_atomic(&work.path().join("session.json"), |out| writeln!(out, "{session:#}"))?;
    std::fs::rename(work.path(), &args.out).map_err(fail)?;

    let passed_over: u64 = cameras.iter().map(|camera| camera.passed_over).sum();
    if json {
        let formats: Vec<&str> = cameras.iter().map(|camera| camera.format.as_str()).collect();
        println!(
            "{}",
            serde_json::json!({
                "out": args.out, "frames": args.frames, "formats": formats, "passed_over": passed_over,
            })
        );
    } else {
        println!("{}: {} frames of each camera, {passed_over} passed over", args.out.display(), args.frames);
    }
    Ok(())
}

/// Passes over frames of the camera that is behind, until both show the same instant.
fn pair(raw: &mut Source, guide: &mut Source, max_skew: Duration) -> Result<(), CameraError> {
    for _ in 0..CHANCES {
        if raw.latest.timestamp.abs_diff(guide.latest.timestamp) <= max_skew {
            return Ok(());
        }
        let behind = if raw.latest.timestamp < guide.latest.timestamp { &mut *raw } else { &mut *guide };
        behind.recorded.passed_over += 1;
        behind.next()?;
    }
    let skew = raw.latest.timestamp.abs_diff(guide.latest.timestamp);
    let reason = format!(
        "its frames and those of {} are {skew:?} apart, allowed: cameras.max_skew_us = {} µs",
        raw.recorded.camera,
        max_skew.as_micros()
    );
    Err(CameraError::Lost { camera: guide.recorded.camera.clone(), reason })
}
