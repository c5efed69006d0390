//! Resources that a board needs before it runs: memory of every stage in bytes, and the processing time of a frame in milliseconds.
//!
//! The plan makes the real pipeline, with the board's bundle or, where that is missing, with a simulated one. The result is therefore
//! what [`crate::live::Service::start`] checks. Planning takes as much memory as the pipeline for a moment.
//!
//! ```
//! use stokescope::{board::Board, plan::Plan};
//! use stokescope_core::image::Size;
//! let plan = Plan::new(&Board::load("x86-sim")?, Some(Size::new(48, 48)))?;
//! assert!(plan.total_bytes() <= plan.limit_bytes && plan.refusal().is_none());
//! # Ok::<(), stokescope::Error>(())
//! ```

use std::path::Path;

use crate::Error;
use crate::board::{Board, BundleSource, CameraSpec, FrameTimes, Readout};
use crate::bundle::{Bundle, BundleError, write_simulated};
use crate::camera::sim::SimSpec;
use crate::config::ConfigError;
use crate::live::{self, PROCESS_BYTES, Uses};
use crate::model::Selection;
use stokescope_core::image::Size;
use stokescope_core::optics::{Coarse, Field};
use stokescope_core::pipeline::{Pipeline, PlanError, Settings};

/// Size planned for when neither the option nor the bundle gives one.
const DEFAULT_SIZE: Size = Size::new(250, 250);

/// Memory and time that a board needs.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Name of the board.
    pub board: String,
    /// Size of the result.
    pub size: Size,
    /// Colour channels.
    pub channels: usize,
    /// Source of the bundle, for messages.
    pub bundle: String,
    /// Memory of every stage while frames are processed, in bytes.
    pub stages: Vec<(&'static str, usize)>,
    /// Memory that modelling light from beyond the frame takes beside the stages, from the first frame on that shows such light.
    pub field_bytes: usize,
    /// The fusion model, and why it is this one.
    pub selection: Selection,
    /// Temporary memory at start, before the workspaces are made, in bytes.
    pub planning_bytes: usize,
    /// Memory limit of all stages together, in bytes.
    pub limit_bytes: usize,
    /// Processing time of a frame of a moving scene.
    pub times: FrameTimes,
    /// Processing time where light from beyond the frame is modelled; none for a device whose scene ends at the frame, and where the memory limit has
    /// no room for the margin.
    pub times_with_margin: Option<FrameTimes>,
    /// Solver iterations of such a frame.
    pub iterations: usize,
    /// Camera's frame and its cropping and binning; none where every reading is used by itself.
    pub binning: Option<BinningPlan>,
}

/// Cropping and binning of the lensless camera's frames, by the thread that captures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BinningPlan {
    /// Size of the camera's planes.
    pub frame: Size,
    /// Size of the part that is used.
    pub crop: Size,
    /// Readings on a side of a block.
    pub bin: usize,
    /// Estimated time of a frame in milliseconds, least and most.
    pub milliseconds: [f64; 2],
}

impl BinningPlan {
    /// None for a device that uses every reading by itself.
    fn new(board: &Board, bundle: &Bundle) -> Option<Self> {
        let window = bundle.sensor.window;
        // of four readings of a Bayer cell two are green, and one plane holds both
        let mosaic = if bundle.sensor.channels == 3 { 4 } else { 1 };
        (!window.is_whole()).then(|| Self {
            frame: window.frame(),
            crop: window.size(),
            bin: window.bin(),
            milliseconds: board.binning_ms(mosaic * window.size().pixels()),
        })
    }
}

/// Bytes of a frame of the lensless camera and of one of the guide camera; 0 without one.
fn frame_bytes(bundle: &Bundle, guide: Option<&CameraSpec>) -> [usize; 2] {
    let frame = bundle.sensor.channels * bundle.sensor.size.pixels() * size_of::<f32>();
    // a binned frame comes with its weights
    let raw = if bundle.sensor.window.is_whole() { frame } else { 2 * frame };
    // a simulated guide may see more than the frame
    let seen = |spec: &CameraSpec| match spec.source.parse::<SimSpec>() {
        Ok(sim) if spec.backend == "sim" => sim.channels() * sim.guide_size().pixels() * size_of::<f32>(),
        _ => frame,
    };
    [raw, guide.map_or(0, seen)]
}

impl Plan {
    /// Plans `board` with its bundle, or with a simulated bundle of `size`.
    ///
    /// # Errors
    /// A bundle that exists but is not usable, or a size that the FFT does not support.
    pub fn new(board: &Board, size: Option<Size>) -> Result<Self, Error> {
        let folder = tempfile::tempdir().map_err(|e| Error::Internal(format!("temporary folder: {e}")))?;
        let (bundle, source) = load_bundle(board, size, folder.path())?;
        let size = bundle.sensor.size;
        let guided = board.guide.is_some();
        // simulated cameras deliver frames of the planned size
        let mut sized = board.clone();
        let cameras = [Some(&mut sized.raw), sized.guide.as_mut()];
        for camera in cameras.into_iter().flatten().filter(|camera| camera.backend == "sim") {
            camera.source += &format!(",size={}x{}", size.width, size.height);
        }
        let frames = frame_bytes(&bundle, sized.guide.as_ref());
        let uses = Uses { preview: true, record: false };
        let mut service = live::reserve(&sized, &bundle, frames, uses);
        let refined = uses.fusion_bytes(&bundle);
        let served = service.iter().map(|(_, bytes)| bytes).sum::<usize>();
        let left = board.memory_limit_bytes.saturating_sub(served);
        let plan =
            |memory_limit_bytes| Pipeline::new(&bundle, Settings { guided, memory_limit_bytes, ..board.settings() });
        let mut pipeline = match plan(left) {
            // What does not fit is shown as it is.
            Err(PlanError::Memory { .. }) => plan(usize::MAX)?,
            planned => planned?,
        };
        let selection = board.select_model(&mut pipeline, left.saturating_sub(refined))?;
        service.extend(selection.model.is_some().then_some(("stage I", refined)));
        let stages = pipeline.stages().chain(service).collect();
        let load = board.workload(&pipeline);
        let times = board.times(&load);
        let field = Field::new(size, bundle.margin);
        let mut plan = Self {
            board: board.name.clone(),
            size,
            channels: bundle.sensor.channels,
            bundle: source,
            stages,
            planning_bytes: if guided { Coarse::planning_bytes(size, pipeline.settings().threads) } else { 0 },
            limit_bytes: board.memory_limit_bytes,
            times_with_margin: (!field.margin().is_none()).then(|| times.on_field(size, field.size())),
            times,
            iterations: load.iterations,
            binning: BinningPlan::new(board, &bundle),
            field_bytes: pipeline.field_bytes(),
            selection,
        };
        plan.times_with_margin = plan.times_with_margin.take().filter(|_| plan.models_light());
        Ok(plan)
    }

    /// Memory of the process with all stages, in bytes.
    pub fn total_bytes(&self) -> usize {
        self.stages.iter().map(|(_, bytes)| bytes).sum()
    }

    /// Largest resident memory of the process in bytes: all stages and, where it is modelled, light from beyond the frame.
    pub fn peak_bytes(&self) -> usize {
        let field = if self.models_light() { self.field_bytes } else { 0 };
        (self.total_bytes() + field).max(PROCESS_BYTES + self.planning_bytes)
    }

    /// Whether light from beyond the frame can be modelled within the limit.
    pub fn models_light(&self) -> bool {
        self.total_bytes() + self.field_bytes <= self.limit_bytes
    }

    /// Error if the process exceeds the limit.
    pub fn refusal(&self) -> Option<PlanError> {
        let (total, limit) = (self.total_bytes(), self.limit_bytes);
        (total > limit).then(|| PlanError::Memory { stages: self.stages.clone(), total, limit })
    }
}

/// Loads the board's bundle, or simulates one in `folder`; returns it with a description of its source.
fn load_bundle(board: &Board, size: Option<Size>, folder: &Path) -> Result<(Bundle, String), Error> {
    let mut source = String::from("simulated");
    if let (BundleSource::Folder(dir), None) = (&board.calibration, size) {
        match Bundle::load(dir) {
            Ok(bundle) => return Ok((bundle, dir.display().to_string())),
            Err(BundleError::Config(ConfigError::Missing(_))) => {
                source = format!("simulated, because {} is not on this machine", dir.display());
            }
            Err(e) => return Err(e.into()),
        }
    }
    let simulated = board.raw.backend == "sim";
    let mut spec =
        if simulated { board.raw.source.parse()? } else { SimSpec { size: DEFAULT_SIZE, ..SimSpec::default() } };
    let readout = board.readout.filter(|_| size.is_none() && !simulated);
    if let Some(Readout { channels, window }) = readout {
        (spec.size, spec.color) = (window.working(), channels == 3);
    }
    spec.size = size.unwrap_or(spec.size);
    spec.check()?;
    write_simulated(&spec, folder)?;
    let mut bundle = Bundle::load(folder)?;
    if let Some(Readout { window, .. }) = readout {
        bundle.device.sensor.window = window;
    }
    Ok((bundle, source))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_limit_below_the_sum_is_refused_with_stage_need_and_limit() {
        let mut board = Board::load("x86-sim").unwrap();
        board.memory_limit_bytes = 1 << 20;
        let plan = Plan::new(&board, Some(Size::new(64, 48))).unwrap();
        let refusal = plan.refusal().unwrap().to_string();
        for part in ["recon ", "queues ", &format!("need {} bytes", plan.total_bytes()), "the limit is 1048576"] {
            assert!(refusal.contains(part), "{refusal}");
        }
    }

    #[test]
    fn a_board_without_its_bundle_is_planned_with_a_simulated_one() {
        let mut board = Board::load("rpi5").unwrap();
        board.calibration = BundleSource::Folder("nowhere".into());
        let plan = Plan::new(&board, None).unwrap();
        assert_eq!((plan.size, plan.refusal().is_none()), (DEFAULT_SIZE, true), "{:?}", plan.stages);
        assert!(plan.bundle.contains("not on this machine"), "{}", plan.bundle);
        let binning = plan.binning.unwrap();
        assert_eq!((binning.frame, binning.crop, binning.bin), (Size::new(1456, 1088), Size::new(1000, 1000), 4));
    }

    #[test]
    fn sensors_of_shipped_boards_are_binned_at_their_frame_rate() {
        // imx296 runs at 60 frames a second at most
        for (name, least) in [("rpi5", 60.0), ("rpi-zero-2w", 20.0)] {
            let [_, slowest] = Board::load(name).unwrap().binning_ms(1456 * 1088);
            assert!(1e3 / slowest >= least, "{name}: {slowest} ms");
        }
    }
}
