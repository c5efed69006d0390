//! Start of the service: everything that can be refused, before any thread runs.

use std::net::TcpListener;
use std::path::Path;
use std::sync::Arc;
use std::thread;

use super::cameras::CameraSource;
use super::http::Guard;
use super::memory::{self, MemoryBudget, Uses};
use super::options::{MIN_TOKEN, Options, Preview, ServiceError};
use crate::Error;
use crate::board::{Board, BundleSource};
use crate::bundle::{Bundle, write_simulated};
use crate::camera::sim::SimSpec;
use crate::camera::{Camera, CameraInfo, Clock, Levels, Role};
use crate::files::WriteError;
use crate::session::{
    Description, Disk, FolderLock, Kinds, Lock, SampleKind, SessionError, SessionWriter, remove_unfinished,
};
use stokescope_core::parallel::Workers;
use stokescope_core::readings::Binning;

/// Difference of black levels, as a share of white, from which on a bundle seems to be for another mode.
const BLACK_TOLERANCE: f32 = 0.01;
/// File in the folder of the results whose lock the service holds.
const OUT_LOCK: &str = ".stokescope.lock";

/// A camera that is open, and the means to open it again.
pub(super) struct OpenCamera {
    pub(super) source: CameraSource,
    pub(super) camera: Box<dyn Camera>,
    /// Binning of its frames to the working size; none where they are used as they are.
    pub(super) binning: Option<Binning>,
}

impl OpenCamera {
    pub(super) fn info(&self) -> &CameraInfo {
        self.camera.info()
    }

    /// Bytes of one unpacked frame, of a binned one with its weights.
    fn frame_bytes(&self) -> usize {
        let info = self.info();
        let values = match &self.binning {
            Some(binning) => 2 * binning.window().working().pixels(),
            None => info.format.plane_size(info.size).pixels(),
        };
        info.format.planes() * values * size_of::<f32>()
    }

    /// Type of the values in a frame.
    pub(super) fn samples(&self) -> SampleKind {
        if self.info().format.bits().is_some() || self.binning.is_some() {
            SampleKind::Counts
        } else {
            SampleKind::Real
        }
    }
}

/// Resources of a service that is about to run.
pub(super) struct Resources {
    pub(super) listener: Option<TcpListener>,
    pub(super) raw: OpenCamera,
    pub(super) guide: Option<OpenCamera>,
    pub(super) bundle: Bundle,
    pub(super) budget: MemoryBudget,
    /// Exclusive right to write into the folder of the results.
    pub(super) out_lock: FolderLock,
    lock: Option<Lock>,
}

impl Resources {
    /// Listens, unless it is given a `listener`, takes the folders, opens the cameras and reads the bundle.
    ///
    /// # Errors
    /// [`ServiceError`], a camera or bundle that cannot be used, or memory that does not suffice.
    pub(super) fn acquire(options: &Options, listener: Option<TcpListener>) -> Result<Self, Error> {
        let Options { board, out, preview, record, every, .. } = options;
        let system = memory::system_limit()?;
        let listener = listener.map_or_else(|| preview.as_ref().map(listen).transpose(), |given| Ok(Some(given)))?;
        let out_lock = lock_results(out)?;
        let lock = record.as_ref().map(|record| {
            let refuse = |source| SessionError::Record { dir: record.dir.clone(), source };
            Lock::take(&record.dir).map_err(refuse)
        });
        let lock = lock.transpose()?;
        let clock = Clock::default();
        // the calibration is true for cameras that are turned as it says
        let orientation = board.orientation()?;
        let source = |role, spec| CameraSource::new(role, spec, &clock, orientation, *every);
        let raw = source(Role::Raw, &board.raw);
        let guide = board.guide.as_ref().map(|spec| source(Role::Guide, spec));
        // opening a camera takes time, and neither the other camera nor the rest of the bundle depends on it
        let (raw, guide, bundle) = thread::scope(|scope| {
            let start = |source| {
                let builder = thread::Builder::new().name("open".to_owned());
                let thread = builder.spawn_scoped(scope, || open(source));
                thread.map_err(|source| ServiceError::Thread { name: "open", source })
            };
            let raw = start(raw)?;
            let guide = guide.map(start).transpose()?;
            let bundle = read_bundle(board, out);
            Ok::<_, ServiceError>((raw.join(), guide.map(thread::ScopedJoinHandle::join), bundle))
        })?;
        let panicked = |_| Error::Internal("a camera's driver panicked".to_owned());
        let mut raw = raw.map_err(panicked)??;
        let guide = guide.transpose().map_err(panicked)?.transpose()?;
        let bundle = bundle?;
        check_bundle(&bundle, raw.info())?;
        let size = raw.info().format.plane_size(raw.info().size);
        // one thread: the team belongs to the solver
        raw.binning =
            Binning::new(&bundle, Arc::new(Workers::new(1))).filter(|binning| binning.window().frame() == size);
        let frames = [raw.frame_bytes(), guide.as_ref().map_or(0, OpenCamera::frame_bytes)];
        let uses = Uses { preview: preview.is_some(), record: record.is_some() };
        let reserve = memory::reserve(board, &bundle, frames, uses);
        let budget = MemoryBudget::new(board, &bundle, reserve, system.as_ref())?;
        Ok(Self { listener, raw, guide, bundle, budget, out_lock, lock })
    }

    /// The session that frames are recorded into; none where nothing is to be recorded.
    pub(super) fn session(&mut self, options: &Options, iterations: usize) -> Option<SessionWriter> {
        let record = options.record.clone()?;
        let description = Description::new(&options.board, &self.bundle, record.format, iterations);
        let kinds = Kinds {
            raw: self.raw.samples(),
            guide: self.guide.as_ref().map(OpenCamera::samples),
            polarized: !self.bundle.response.angles().is_empty(),
        };
        let folder = self.bundle.dir.clone();
        Some(SessionWriter::new(record, description, kinds, folder, Disk, self.lock.take()?))
    }
}

fn open(source: CameraSource) -> Result<OpenCamera, Error> {
    let camera = source.open()?;
    Ok(OpenCamera { source, camera, binning: None })
}

/// Takes the exclusive right to write into the folder of the results, and removes what was left unfinished there.
///
/// # Errors
/// [`WriteError::Create`].
pub(super) fn lock_results(out: &Path) -> Result<FolderLock, WriteError> {
    let refuse = |source| WriteError::Create { path: out.to_path_buf(), source };
    let lock = FolderLock::take(out, OUT_LOCK).map_err(refuse)?;
    remove_unfinished(out);
    Ok(lock)
}

/// Listens at the address of the preview.
///
/// # Errors
/// [`ServiceError::Token`] where a token is needed, [`ServiceError::Listen`].
pub(super) fn listen(preview: &Preview) -> Result<TcpListener, ServiceError> {
    let listen = preview.listen;
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.~".contains(c);
    let protected = match &preview.token {
        Some(token) => token.len() >= MIN_TOKEN && token.chars().all(plain),
        None => listen.ip().is_loopback(),
    };
    if !protected {
        return Err(ServiceError::Token { listen });
    }
    TcpListener::bind(listen).map_err(|source| ServiceError::Listen { listen, source })
}

/// Conditions that requests to the preview must meet; `control` says whether anything may be changed.
pub(super) fn guard(options: &Options, control: bool) -> Guard {
    let preview = options.preview.as_ref();
    let token = preview.and_then(|preview| preview.token.clone());
    let allowed = options.board.preview.allowed_hosts.iter().cloned();
    let names =
        preview.into_iter().flat_map(|preview| preview.hosts.clone()).chain(allowed).chain(host_names()).collect();
    Guard { names, token, control, ..Guard::default() }
}

/// Names of this machine, by itself and on the local link.
fn host_names() -> Vec<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default().trim().to_owned();
    if name.is_empty() { Vec::new() } else { vec![format!("{name}.local"), name] }
}

/// Reads the board's bundle. The bundle of a simulated camera is written into `out` first and read like any other.
fn read_bundle(board: &Board, out: &Path) -> Result<Bundle, Error> {
    let dir = match &board.calibration {
        BundleSource::Folder(dir) => dir.clone(),
        BundleSource::Simulated if board.raw.backend == "sim" => {
            let dir = out.join("calibration");
            write_simulated(&board.raw.source.parse::<SimSpec>()?, &dir)?;
            dir
        }
        BundleSource::Simulated => {
            let (board, backend) = (board.name.clone(), board.raw.backend.clone());
            return Err(ServiceError::NotSimulated { board, backend }.into());
        }
    };
    Ok(Bundle::load(&dir)?)
}

fn check_bundle(bundle: &Bundle, camera: &CameraInfo) -> Result<(), Error> {
    if let (Some(own), Some(found)) = (&bundle.camera, camera.id()) {
        own.check(&found, &bundle.dir)?;
    }
    let (found, found_channels) = (camera.format.plane_size(camera.size), camera.format.planes());
    let (size, channels) = (bundle.sensor.window.frame(), bundle.sensor.channels);
    // a recording may hold frames that were binned before
    if found_channels != channels || ![size, bundle.sensor.size].contains(&found) {
        let (bundle, camera) = (bundle.dir.clone(), camera.name.clone());
        return Err(ServiceError::Bundle { bundle, channels, size, camera, found_channels, found }.into());
    }
    check_levels(bundle, camera)
}

/// Checks that the bundle's counts are on the scale of the camera's frames: readings above a saturation that never occurs would not count
/// as saturated, and a saturation far below means samples of another alignment.
fn check_levels(bundle: &Bundle, camera: &CameraInfo) -> Result<(), Error> {
    let Some(Levels { black, white }) = camera.levels else { return Ok(()) };
    let own = &bundle.sensor;
    if !(white / 2.0..=white).contains(&own.saturation) {
        let (bundle, saturation, camera) = (bundle.dir.clone(), own.saturation, camera.name.clone());
        return Err(ServiceError::Levels { bundle, saturation, camera, white }.into());
    }
    if let Some(black) = black.filter(|black| (black - own.black_level).abs() > BLACK_TOLERANCE * white) {
        tracing::warn!(
            "{}: black_level = {}, but the sensor of {} gives {black} counts without light: calibrate the dark frame again",
            bundle.dir.display(),
            own.black_level,
            camera.name
        );
    }
    Ok(())
}
