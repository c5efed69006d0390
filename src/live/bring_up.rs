//! The setup: brings up a device that has no bundle yet. Its cameras are shown as they are, and calibration steps are taken over HTTP
//! until the bundle is complete; the live service then goes on at the same address.
//!
//! One thread captures from each camera, one takes the steps of calibration, one serves HTTP. A frame is unpacked into one of two buffers that change
//! places; pictures and figures are made when somebody asks for them. Steady state: capture allocates nothing per frame.

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::http::{Server, SetupContext};
use super::memory::PROCESS_BYTES;
use super::options::Options;
use super::setup::{Calibration, SetupCamera, Workspace};
use super::startup::{guard, listen, lock_results};
use super::stop::Stop;
use super::threads::{join, spawn};
use super::{http, memory};
use crate::Error;
use crate::board::{Board, BundleSource};
use crate::bundle::DESCRIPTION;
use crate::camera::Role;
use crate::session::FolderLock;
use stokescope_core::calibrate::Step;
use stokescope_core::pipeline::PlanError;

/// Time that the threads have to end.
const FAREWELL: Duration = Duration::from_secs(4);
/// Pace of [`Setup::wait`].
const PACE: Duration = Duration::from_millis(50);
/// Time that the answer to the last request has to leave.
const LAST_ANSWER: Duration = Duration::from_millis(300);
/// Frames of a camera that exist at once: the latest, the one that arrives, and as much again in its driver, whose samples have two bytes.
const FRAMES: usize = 4;
/// Share of the free memory that averaged frames of steps may take; the steps compute with the rest.
const TAKEN: usize = 3;

/// A running setup, until [`Setup::wait`] ends it.
#[derive(Debug)]
pub struct Setup {
    context: Arc<SetupContext>,
    stop: Arc<Stop>,
    threads: Vec<JoinHandle<()>>,
    listener: TcpListener,
    address: SocketAddr,
    _out_lock: FolderLock,
}

/// State of a running setup.
#[derive(Clone, Debug)]
pub struct SetupProgress {
    /// Frames of the lensless camera so far.
    pub frames: u64,
    /// Names of the steps that the bundle still needs.
    pub missing: Vec<&'static str>,
}

/// Outcome of a setup.
#[derive(Debug, Serialize)]
pub struct SetupSummary {
    /// Always `setup`.
    pub mode: &'static str,
    /// Folder of the board's bundle.
    pub bundle: std::path::PathBuf,
    /// Steps that the bundle still needs.
    pub missing: Vec<Step>,
    /// Socket that goes on listening, where the bundle is in place; none where the setup was interrupted.
    #[serde(skip)]
    pub listener: Option<TcpListener>,
}

impl Setup {
    /// Whether a board names a bundle that does not exist yet.
    pub fn is_needed(board: &Board) -> bool {
        matches!(&board.calibration, BundleSource::Folder(dir) if !dir.join(DESCRIPTION).exists())
    }

    /// Opens the cameras and serves the setup.
    ///
    /// # Errors
    /// A board without a bundle of its own, an address that cannot be listened on, a camera that cannot be opened, or frames that do not
    /// fit into the board's memory.
    pub fn start(options: &Options) -> Result<Self, Error> {
        let board = &options.board;
        let (BundleSource::Folder(dir), Some(preview)) = (&board.calibration, &options.preview) else {
            return Err(Error::Usage(format!(
                "--setup: board {} has calibration = \"simulated\", which needs no setup; allowed: the folder of a bundle, and a preview",
                board.name
            )));
        };
        let listener = listen(preview)?;
        let folder = Arc::new(Workspace::open(dir, board.readout, board.mounted)?);
        let out_lock = lock_results(&options.out)?;
        let orientation = folder.orientation()?;
        let (raw, raw_device) = SetupCamera::open(Role::Raw, &board.raw, orientation)?;
        let mut devices = vec![(Arc::new(raw), raw_device)];
        if let Some(spec) = &board.guide {
            let (guide, device) = SetupCamera::open(Role::Guide, spec, orientation)?;
            devices.push((Arc::new(guide), device));
        }
        let cameras: Vec<_> = devices.iter().map(|(camera, _)| Arc::clone(camera)).collect();
        let free = check_memory(board, &cameras)?;
        let (raw, guide) = (Arc::clone(&cameras[0]), cameras.get(1).cloned());
        let budget = (free / TAKEN, board.threads);
        let calibration = Calibration::new(Arc::clone(&raw), guide.clone(), Arc::clone(&folder), budget);
        let calibration = Arc::new(calibration);
        let allowed = options.control || preview.token.is_some();
        let context = Arc::new(SetupContext {
            board: board.name.clone(),
            started: Instant::now(),
            raw,
            guide,
            folder,
            calibration: Arc::clone(&calibration),
            allowed,
            clients: Arc::default(),
            finished: AtomicBool::new(false),
        });
        let failed = |source| super::options::ServiceError::Listen { listen: preview.listen, source };
        let address = listener.local_addr().map_err(failed)?;
        let own = listener.try_clone().map_err(failed)?;
        let stop = Arc::<Stop>::default();
        let mut setup = Self { context, stop, threads: Vec::new(), listener, address, _out_lock: out_lock };
        for (camera, device) in devices {
            let stop = Arc::clone(&setup.stop);
            setup.threads.push(spawn("capture", move || camera.run(device, &stop))?);
        }
        let own_stop = Arc::clone(&setup.stop);
        setup.threads.push(spawn("calibrate", move || calibration.run(&own_stop))?);
        let (guard, clients) = (guard(options, allowed), board.preview.max_clients);
        let server = Server::of_setup(Arc::clone(&setup.context), guard, clients, Arc::clone(&setup.stop));
        let serve = move || {
            if let Err(e) = server.run(own) {
                tracing::error!("preview: {e}");
            }
        };
        setup.threads.push(spawn("preview", serve)?);
        Ok(setup)
    }

    /// Address of the page, with its real port.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Waits until the bundle is in place or `stop` says so; it is asked some twenty times a second. Then ends every thread.
    ///
    /// # Errors
    /// A thread that panicked.
    pub fn wait(mut self, mut stop: impl FnMut(&SetupProgress) -> bool) -> Result<SetupSummary, Error> {
        let finished = || self.context.finished.load(Ordering::Acquire);
        while !finished() && !stop(&self.progress()) {
            thread::sleep(PACE);
        }
        let complete = finished();
        if complete {
            thread::sleep(LAST_ANSWER);
        }
        self.stop.set();
        let deadline = Instant::now() + FAREWELL;
        for thread in std::mem::take(&mut self.threads) {
            join(thread, deadline, "setup")?;
        }
        Ok(SetupSummary {
            mode: "setup",
            bundle: self.context.folder.dir.clone(),
            missing: self.context.folder.parts().missing().collect(),
            listener: if complete { self.listener.try_clone().ok() } else { None },
        })
    }

    fn progress(&self) -> SetupProgress {
        let missing = self.context.folder.parts().missing().map(Step::name).collect();
        SetupProgress { frames: self.context.raw.latest().number, missing }
    }
}

impl Drop for Setup {
    /// Ends the threads of a setup that did not start as a whole.
    fn drop(&mut self) {
        self.stop.set();
    }
}

/// Bytes that frames, pictures and clients leave of the board's limit, or of that of the system.
///
/// # Errors
/// [`PlanError::Memory`] where they exceed it.
fn check_memory(board: &Board, cameras: &[Arc<SetupCamera>]) -> Result<usize, PlanError> {
    let values = |camera: &SetupCamera| camera.latest().planes.as_slice().len();
    let frames: usize = cameras.iter().map(|camera| FRAMES * values(camera) * size_of::<f32>()).sum();
    // the pixels of each camera's picture, and the JPEG made of them, which is smaller than they are
    let pictures: usize = cameras.iter().map(|camera| 2 * 3 * camera.latest().planes.size().pixels()).sum();
    let clients = board.preview.max_clients * http::CLIENT_BYTES;
    let stages = vec![("process", PROCESS_BYTES), ("frames", frames), ("pictures", pictures), ("clients", clients)];
    let system = memory::system_limit()?.map_or(usize::MAX, |system| system.bytes);
    let limit = board.memory_limit_bytes.min(system);
    let total: usize = stages.iter().map(|(_, bytes)| bytes).sum();
    if total > limit { Err(PlanError::Memory { stages, total, limit }) } else { Ok(limit - total) }
}
