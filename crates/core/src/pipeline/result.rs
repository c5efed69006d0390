//! The result of one frame: its images, the pixels that can be trusted, and its report.

#[cfg(doc)]
use super::Settings;
use super::{FrameReport, Pipeline, Warning};
use crate::image::{Size, Stack};

/// The polarization of one frame.
#[derive(Debug)]
pub struct Polarization {
    /// `[C, 3, H, W]`: S0, S1, S2; without a mask `[C, 1, H, W]`. Fractions of full scale.
    pub stokes: Stack<f32>,
    /// Standard errors, shaped like `stokes`: σ of each of its values. Fractions of full scale.
    pub errors: Stack<f32>,
    /// `[C, P, H, W]`: intensities behind ideal polarizers; none without a mask, or where [`Settings::angles`] does without.
    pub angles: Option<Stack<f32>>,
    /// For each pixel whether it can be trusted: it is not dark, and its reading has weight.
    pub valid: Vec<bool>,
}

impl Polarization {
    /// Images of `channels` channels and `angles` polarizer angles, none without a mask. Allocates.
    pub(super) fn zeros(channels: usize, size: Size, angles: usize, with_angles: bool) -> Self {
        let planes = if angles == 0 { 1 } else { 3 };
        Self {
            stokes: Stack::zeros(channels * planes, size),
            errors: Stack::zeros(channels * planes, size),
            angles: (with_angles && angles > 0).then(|| Stack::zeros(channels * angles, size)),
            valid: vec![false; size.pixels()],
        }
    }

    /// Bytes held.
    pub(super) fn bytes(&self) -> usize {
        self.stokes.bytes() + self.errors.bytes() + self.angles.as_ref().map_or(0, Stack::bytes) + self.valid.len()
    }
}

/// A processed frame: its report, and its images in the pipeline's memory until the next frame.
#[derive(Debug)]
pub struct ProcessedFrame<'a> {
    pub(super) report: FrameReport,
    pub(super) pipeline: &'a Pipeline,
}

impl<'a> ProcessedFrame<'a> {
    /// Figures and warnings of the frame.
    pub fn report(&self) -> &FrameReport {
        &self.report
    }

    /// Figures and warnings of the frame, without its images.
    pub fn into_report(self) -> FrameReport {
        self.report
    }

    /// Facts to know before trusting the result.
    pub fn warnings(&self) -> &[Warning] {
        &self.report.warnings
    }

    /// S0, S1, S2 of each channel, `[C, 3, H, W]`; without a mask S0 alone, `[C, 1, H, W]`. Fractions of full scale.
    pub fn stokes(&self) -> &'a Stack<f32> {
        &self.pipeline.result.stokes
    }

    /// Standard errors, shaped like [`Self::stokes`]: σ of each of its values.
    pub fn errors(&self) -> &'a Stack<f32> {
        &self.pipeline.result.errors
    }

    /// Intensities behind ideal polarizers, `[C, P, H, W]`, fractions of full scale; none without a mask, or where [`Settings::angles`]
    /// does without.
    pub fn angles(&self) -> Option<&'a Stack<f32>> {
        self.pipeline.result.angles.as_ref()
    }

    /// For each pixel whether its result can be trusted: it is neither dark nor read through a pixel that could not be trusted.
    pub fn valid(&self) -> &'a [bool] {
        &self.pipeline.result.valid
    }
}
