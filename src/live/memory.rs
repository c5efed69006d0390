//! Memory plan of the service: bytes that it holds beside the pipeline, and the limit that is left for the pipeline.

use std::sync::Arc;

use super::http;
use super::limits::{self, FRAMES_IN_WORK, RECORDER_FRAMES};
use super::preview::Painter;
use super::solver::result_bytes;
use super::threads::STACKS;
use crate::board::{Board, CameraSpec, SystemLimit};
use crate::bundle::Bundle;
use crate::camera::Role;
use crate::camera::sim::SimSpec;
use crate::session::OmeTiff;
use stokescope_core::optics::Coarse;
use stokescope_core::parallel::Workers;
use stokescope_core::pipeline::PlanError;
use stokescope_core::readings::Binning;

/// Bytes of the process itself: the program's pages, what its libraries and threads hold, and small things. Measured
/// (`tests/memory.rs`): the network's library alone is more code than all the rest, and its pages count where they are touched.
pub const PROCESS_BYTES: usize = if cfg!(feature = "fusion") { 14 << 20 } else { 10 << 20 };
/// Frames that a driver fills in turn.
const DRIVER_BUFFERS: usize = 4;

/// Parts of the service that take memory of their own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Uses {
    /// The preview.
    pub preview: bool,
    /// Recording.
    pub record: bool,
}

impl Uses {
    /// Bytes that results take beyond those of [`reserve`] where a fusion model refines them: the intensities of stage I.
    pub fn fusion_bytes(self, bundle: &Bundle) -> usize {
        let bytes = |fusion| result_bytes(bundle, self.preview, fusion);
        limits::results(self.preview, self.record) * (bytes(true) - bytes(false))
    }
}

/// Bytes of each part of the service beside a pipeline without a fusion model: the process itself, cameras, frames in queues, results, saving, pictures and clients of the
/// preview. `frames` are the bytes of one unpacked frame of the raw and of the guide camera, 0 without one; those of a binned raw frame
/// with its weights.
pub fn reserve(board: &Board, bundle: &Bundle, frames: [usize; 2], uses: Uses) -> Vec<(&'static str, usize)> {
    let Uses { preview, record } = uses;
    let pixels = bundle.sensor.size.pixels();
    let recorded = if record { RECORDER_FRAMES } else { 0 };
    let queues = (board.queue_frames + FRAMES_IN_WORK + recorded) * frames.iter().sum::<usize>();
    let results = limits::results(preview, record) * result_bytes(bundle, preview, false);
    // one picture is drawn at a time, encoded as JPEG or PNG, and held for its watchers; one more may be that of a held frame
    let drawing = if preview { Painter::bytes(bundle.sensor.size) + 3 * 3 * pixels } else { 0 };
    let downloads = http::DOWNLOAD_BYTES + if record { OmeTiff::bytes(pixels, bundle.sensor.channels) } else { 0 };
    let clients = if preview { board.preview.max_clients * http::CLIENT_BYTES + downloads } else { 0 };
    // one picture at a time, drawn and encoded
    let saving = 4 * 3 * pixels;
    let camera = |spec: &CameraSpec, role, frame: usize| match spec.source.parse::<SimSpec>() {
        Ok(sim) if spec.backend == "sim" => {
            let [raw, guide] =
                sim.delivered_bytes().map(|frame| if spec.paced { frame * sim.clip_frames() } else { 0 });
            match role {
                Role::Raw => sim.raw_camera_bytes() + raw,
                Role::Guide => sim.guide_camera_bytes() + guide,
            }
        }
        // two bytes a sample at most
        _ => DRIVER_BUFFERS * frame / 2,
    };
    // the driver's buffers hold whole frames, and binning has its maps
    let window = bundle.sensor.window;
    let whole = bundle.sensor.channels * window.frame().pixels() * size_of::<f32>();
    let raw = if window.is_whole() { frames[0] } else { whole };
    let binning = Binning::new(bundle, Arc::new(Workers::new(1))).map_or(0, |binning| binning.bytes());
    let guide = board.guide.as_ref().map_or(0, |spec| camera(spec, Role::Guide, frames[1]));
    vec![
        ("process", PROCESS_BYTES),
        ("cameras", camera(&board.raw, Role::Raw, raw) + guide + binning),
        ("queues", queues),
        ("results", results),
        ("saving", saving),
        ("preview", drawing),
        ("clients", clients),
    ]
}

/// Limit on memory and the part of it that the service takes beside the pipeline.
#[derive(Debug)]
pub(super) struct MemoryBudget {
    reserve: Vec<(&'static str, usize)>,
    limit: usize,
}

/// Limit that the system sets this process, if it sets one.
///
/// # Errors
/// [`PlanError::Memory`] when not even the process itself is within it.
pub(super) fn system_limit() -> Result<Option<SystemLimit>, PlanError> {
    let system = SystemLimit::of_this_process(STACKS);
    match &system {
        Some(system) if system.bytes < PROCESS_BYTES => Err(PlanError::Memory {
            stages: vec![("process", PROCESS_BYTES)],
            total: PROCESS_BYTES,
            limit: system.bytes,
        }),
        _ => Ok(system),
    }
}

impl MemoryBudget {
    /// MemoryBudget of a service whose parts take `reserve`, under the board's limit or the lower one of the system.
    ///
    /// # Errors
    /// [`PlanError::Memory`] when planning does not fit.
    pub(super) fn new(
        board: &Board,
        bundle: &Bundle,
        reserve: Vec<(&'static str, usize)>,
        system: Option<&SystemLimit>,
    ) -> Result<Self, PlanError> {
        let mut limit = board.memory_limit_bytes;
        if let Some(system) = system.filter(|system| system.bytes < limit) {
            tracing::info!("memory: {} allows less than the board: {} bytes", system.source, system.bytes);
            limit = system.bytes;
        }
        // this memory is freed before the workspaces are made
        let planning =
            if board.guide.is_some() { Coarse::planning_bytes(bundle.sensor.size, board.threads) } else { 0 };
        let total = planning + PROCESS_BYTES;
        if total > limit {
            let stages = vec![("planning", planning), ("process", PROCESS_BYTES)];
            return Err(PlanError::Memory { stages, total, limit });
        }
        Ok(Self { reserve, limit })
    }

    fn reserved(&self) -> usize {
        self.reserve.iter().map(|(_, bytes)| bytes).sum()
    }

    /// Bytes that the pipeline may take.
    pub(super) fn pipeline_bytes(&self) -> usize {
        self.limit.saturating_sub(self.reserved())
    }

    /// Adds the service's own needs to the pipeline's refusal.
    pub(super) fn explain(&self, error: PlanError) -> PlanError {
        match error {
            PlanError::Memory { mut stages, total, .. } => {
                stages.extend(&self.reserve);
                PlanError::Memory { stages, total: total + self.reserved(), limit: self.limit }
            }
            other => other,
        }
    }
}
