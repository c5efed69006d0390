//! Suspects of the latest frame.

use std::sync::Arc;

use super::{FrameReport, Pipeline, PlanError};
use crate::diagnose::{self, Suspect};
use crate::image::ImageView;
use crate::solve::Method;

impl Pipeline {
    /// Tries other set-ups on the latest frame, whose `guide` this is and whose report is `report`, and names those that explain its
    /// readings better, the likeliest first; without a guide what the frame's figures say. It takes about as long as the first frame's
    /// preparation. Nothing is tried where the memory limit does not allow for [`diagnose::TRIAL_BYTES`] more. Allocates.
    ///
    /// # Errors
    /// [`PlanError`] when the frame is too large for a transform.
    pub fn diagnose<'a>(
        &mut self,
        report: &FrameReport,
        guide: impl Into<Option<ImageView<'a>>>,
    ) -> Result<Vec<Suspect>, PlanError> {
        let mut suspects = Vec::new();
        let held: usize = self.stages().map(|(_, bytes)| bytes).sum();
        let fits = held + diagnose::TRIAL_BYTES <= self.settings.memory_limit_bytes;
        if let Some(guide) = guide.into().filter(|_| fits) {
            let mended =
                self.copies.mender.mend(guide.to_planes(&mut self.copies.guide), self.method == Method::Guided);
            let light = self.outliers.is_none_or(|(_, light)| light);
            let guide = mended.smoothed.filter(|_| !light).unwrap_or(mended.given);
            let workers = Arc::clone(&self.workers);
            let solved = diagnose::Solved {
                shift_px: report.shift_px,
                noise: report.noise,
                explained: report.figures.explains(),
                light_modelled: !report.field.margin.is_none(),
                weights: report.guide_weights.or(self.device.guide_weights),
            };
            suspects = diagnose::suspects(&self.device, &self.readings, guide, &solved, workers)?;
        }
        Ok(report.figures.suspects_with(&suspects))
    }
}
