//! Work of a frame on a board, and the fusion model that the board has time and memory for.

use super::{Board, FusionWorkload, Workload};
use crate::model::{Allowance, Model, Selection, SelectionError};
use stokescope_core::pipeline::Pipeline;
use stokescope_core::solve::WarmStart;

impl Board {
    /// Work of a frame of `pipeline`, with its fusion model if it has one. A moving scene takes the most iterations.
    pub fn workload(&self, pipeline: &Pipeline) -> Workload {
        let (size, start) = (pipeline.size(), if self.video { WarmStart::Moving } else { WarmStart::Cold });
        Workload {
            size,
            channels: pipeline.raw().count(),
            iterations: start.iterations(self.iterations),
            fusion: pipeline.fusion().map(|plan| FusionWorkload::new(plan.network(), size)),
        }
    }

    /// Adds the board's fusion model to `pipeline`. `auto` is the best shipped model with which the board may reach the frame rate of its
    /// raw camera, and which fits into `limit` bytes with the pipeline. Allocates.
    ///
    /// # Errors
    /// Those of [`Selection::add`].
    pub fn select_model(&self, pipeline: &mut Pipeline, limit: usize) -> Result<Selection, SelectionError> {
        let plain = self.workload(pipeline);
        let too_slow = |model: &Model, precision| {
            let asked = self.raw.frame_rate?;
            let fusion = FusionWorkload::stated(model, precision, plain.size);
            let [_, most] = self.times(&Workload { fusion, ..plain }).frames_per_second();
            (most < asked).then(|| format!("{most:.1} frames per second, {asked:.1} are asked for"))
        };
        let allowance = Allowance { too_slow: &too_slow, limit };
        Selection::add(pipeline, &self.fusion.model, self.fusion.precision, &allowance)
    }
}
