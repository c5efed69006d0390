//! The program without the feature `fusion`: no engine, and whoever asks for one is told so.

use std::sync::Arc;

use super::PlanError;
use super::model::{Model, Onnx};
use crate::parallel::Workers;

/// There is none.
#[derive(Clone, Debug)]
pub(super) enum Engine {}

/// There is none.
#[derive(Debug)]
pub(super) enum State {}

impl Engine {
    pub(super) fn new(model: &Model, _: &Onnx) -> Result<Self, PlanError> {
        Err(PlanError::NoRuntime { name: model.name.clone() })
    }

    pub(super) fn bytes(&self) -> usize {
        match *self {}
    }

    pub(super) fn run_bytes(&self) -> usize {
        match *self {}
    }

    pub(super) fn macs(&self) -> u64 {
        match *self {}
    }

    pub(super) fn parameters(&self) -> usize {
        match *self {}
    }

    pub(super) fn state(&self) -> Result<State, PlanError> {
        match *self {}
    }

    pub(super) fn run(
        &self,
        _: &mut State,
        _: &[f32],
        _: &Arc<Workers>,
        _: impl FnOnce(&[f32]),
    ) -> Result<(), PlanError> {
        match *self {}
    }
}
