//! L4: what a board will need, before it runs: bytes of every stage against its limits, and a frame's milliseconds.
//!
//! The stages are planned for real, with the board's bundle where it can be read and with a simulated one of the same size where
//! it cannot, so what is said here is what [`crate::live::Service::start`] checks.
//!
//! Units: bytes, milliseconds. Allocation: as much as the pipeline takes, for a moment. Imports: everything below, and the
//! service's own needs.
//!
//! ```
//! use stokescope::{board::Board, plan::Plan, plane::Size};
//! let plan = Plan::new(&Board::load("x86-sim")?, Some(Size::new(48, 48)))?;
//! assert!(plan.total_bytes() <= plan.limit_bytes && plan.refusal().is_none());
//! # Ok::<(), stokescope::Error>(())
//! ```

use std::path::Path;

use crate::Error;
use crate::board::{Board, BundleSource, Learned, Load, Times};
use crate::bundle::{Bundle, BundleError, write_simulated};
use crate::camera::sim::SimSpec;
use crate::config::ConfigError;
use crate::live::{self, PROCESS_BYTES, Uses};
use crate::model;
use stokescope_core::image::Size;
use stokescope_core::optics::Coarse;
use stokescope_core::pipeline::{Pipeline, PlanError, Settings};
use stokescope_core::solve::WarmStart;

/// Size that is planned for when nobody says one.
const USUAL: Size = Size::new(250, 250);

/// What a board will need.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Name of the board.
    pub board: String,
    /// Size of the result.
    pub size: Size,
    /// Colour channels.
    pub channels: usize,
    /// Where the bundle came from, for people.
    pub bundle: String,
    /// Bytes of every stage while frames are processed.
    pub stages: Vec<(&'static str, usize)>,
    /// Bytes for a moment at the start, before the workspaces are made.
    pub planning_bytes: usize,
    /// What the stages may hold together.
    pub limit_bytes: usize,
    /// How long a frame takes of a scene that moves.
    pub times: Times,
    /// Iterations of such a frame.
    pub iterations: usize,
}

impl Plan {
    /// Plans `board`; with `size` for a simulated bundle of that size.
    ///
    /// # Errors
    /// A bundle that is there and cannot be used, or a size that no FFT takes.
    pub fn new(board: &Board, size: Option<Size>) -> Result<Self, Error> {
        let folder = tempfile::tempdir().map_err(|e| Error::Internal(format!("temporary folder: {e}")))?;
        let (calibration, bundle) = calibration(board, size, folder.path())?;
        let size = calibration.sensor.size;
        let guided = board.guide.is_some();
        let settings = Settings {
            guided,
            fusion: model::choose(&board.fusion.model, board.fusion.precision)?,
            ..board.settings()
        };
        let pipeline = Pipeline::new(&calibration, settings)?;
        // a scene that moves is what has to be kept up with
        let start = if board.video { WarmStart::Moving } else { WarmStart::Cold };
        let fusion = pipeline.fusion().map(|plan| {
            let network = plan.network();
            Learned { precision: network.precision(), macs: network.macs_per_pixel(size) }
        });
        let load = Load {
            size,
            channels: calibration.sensor.channels,
            iterations: start.iterations(board.iterations),
            fusion,
        };
        let frame = calibration.sensor.channels * size.pixels() * size_of::<f32>();
        let mut stages: Vec<_> = pipeline.stages().collect();
        // the simulated cameras give frames of the size that is planned for
        let mut sized = board.clone();
        let cameras = [Some(&mut sized.raw), sized.guide.as_mut()];
        for camera in cameras.into_iter().flatten().filter(|camera| camera.backend == "sim") {
            camera.source += &format!(",size={}x{}", size.width, size.height);
        }
        let frames = [frame, if guided { frame } else { 0 }];
        let uses = Uses { preview: true, record: false, fusion: fusion.is_some() };
        stages.extend(live::reserve(&sized, &calibration, frames, uses));
        Ok(Self {
            board: board.name.clone(),
            size,
            channels: calibration.sensor.channels,
            bundle,
            stages,
            planning_bytes: if guided { Coarse::planning_bytes(size) } else { 0 },
            limit_bytes: board.memory_limit_bytes,
            times: board.times(&load),
            iterations: load.iterations,
        })
    }

    /// Bytes of all stages together.
    pub fn total_bytes(&self) -> usize {
        self.stages.iter().map(|(_, bytes)| bytes).sum()
    }

    /// Bytes that the process holds at most, resident: its own beside the stages'.
    pub fn peak_bytes(&self) -> usize {
        PROCESS_BYTES + self.total_bytes().max(self.planning_bytes)
    }

    /// The refusal, if the stages exceed the limit.
    pub fn refusal(&self) -> Option<PlanError> {
        let (total, limit) = (self.total_bytes(), self.limit_bytes);
        (total > limit).then(|| PlanError::Memory { stages: self.stages.clone(), total, limit })
    }
}

/// The board's bundle, or one that is simulated in `folder`, and what it is.
fn calibration(board: &Board, size: Option<Size>, folder: &Path) -> Result<(Bundle, String), Error> {
    let mut why = String::from("simulated");
    if let (BundleSource::Folder(dir), None) = (&board.calibration, size) {
        match Bundle::load(dir) {
            Ok(calibration) => return Ok((calibration, dir.display().to_string())),
            Err(BundleError::Config(ConfigError::Missing(_))) => {
                why = format!("simulated, for {} is not on this machine", dir.display());
            }
            Err(e) => return Err(e.into()),
        }
    }
    let simulated = board.raw.backend == "sim";
    let mut spec = if simulated { board.raw.source.parse()? } else { SimSpec { size: USUAL, ..SimSpec::default() } };
    spec.size = size.unwrap_or(spec.size);
    spec.check()?;
    write_simulated(&spec, folder)?;
    Ok((Bundle::load(folder)?, why))
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
        assert_eq!((plan.size, plan.refusal().is_none()), (USUAL, true), "{:?}", plan.stages);
        assert!(plan.bundle.contains("not on this machine"), "{}", plan.bundle);
    }
}
