//! The engine: tract. Imports an ONNX file, proves its shapes, optimizes it for them and runs it.

mod int8;
mod qlinear;

use std::borrow::Cow;
use std::sync::Arc;

use tract_onnx::prelude::*;
use tract_onnx::tract_core::internal::{Cost, DimLike};
use tract_onnx::tract_core::plan::{SimplePlan, SimpleState};
use tract_onnx::tract_hir::infer::{Factoid, InferenceNode};

use super::PlanError;
use super::model::{Model, Onnx};
use crate::parallel::Workers;

/// A network of fixed shape, [`Model::ports`], f32 on both sides. Clones share it.
#[derive(Clone)]
pub(super) struct Engine {
    plan: Arc<SimplePlan<TypedFact, Box<dyn TypedOp>>>,
    shape: [usize; 4],
    file: String,
    weights: usize,
    tensors: usize,
    macs: u64,
    parameters: usize,
}

impl std::fmt::Debug for Engine {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Engine({}, {:?})", self.file, self.shape)
    }
}

/// What one thread needs to run an [`Engine`].
pub(super) type State = SimpleState<TypedFact, Box<dyn TypedOp>>;

impl Engine {
    /// Reads, proves and optimizes a model's network. Allocates.
    pub(super) fn new(model: &Model, onnx: &Onnx) -> Result<Self, PlanError> {
        // A parser of untrusted graphs that panics must not take the pipeline with it.
        std::panic::catch_unwind(|| Self::load(model, &onnx.bytes, &onnx.name)).unwrap_or_else(|_| {
            Err(PlanError::Damaged { file: onnx.name.clone(), message: "the importer gave up".to_owned() })
        })
    }

    fn load(model: &Model, bytes: &[u8], file: &str) -> Result<Self, PlanError> {
        let damaged = |e: TractError| PlanError::Damaged { file: file.to_owned(), message: format!("{e:#}") };
        let [input, output] = model.ports();
        let mut graph = qlinear::register(tract_onnx::onnx())
            .with_ignore_value_info(true)
            .model_for_read(&mut &*bytes)
            .map_err(damaged)?;
        let count = |what, found: usize| {
            if found == 1 { Ok(()) } else { Err(PlanError::Ports { file: file.to_owned(), what, found }) }
        };
        count("inputs", graph.inputs.len())?;
        count("outputs", graph.outputs.len())?;
        let unknown = |n: &_| operator_of(n).strip_prefix("Unimplemented(").map(|n| n.trim_end_matches(')').to_owned());
        if let Some(operator) = graph.nodes().iter().find_map(unknown) {
            return Err(PlanError::Operator { file: file.to_owned(), operator });
        }
        let declared = graph.input_fact(0).map_err(damaged)?;
        let found = declared.format_dt_shape();
        let wanted = InferenceFact::dt_shape(f32::datum_type(), input);
        let mismatch = |what, expected: [usize; 4], found: String| {
            Err(PlanError::Shape { file: file.to_owned(), what, expected, found })
        };
        // A side that is left open has a name there, or nothing.
        let fixed = |dim: TDim| dim.to_usize().ok();
        let dims: Vec<_> = declared.shape.dims().map(|dim| dim.concretize().and_then(fixed)).collect();
        let same_rank = if declared.shape.is_open() { dims.len() <= 4 } else { dims.len() == 4 };
        let same = same_rank && dims.iter().zip(input).all(|(found, expected)| found.is_none_or(|n| n == expected));
        if !same || declared.datum_type.concretize().is_some_and(|kind| kind != f32::datum_type()) {
            return mismatch("input", input, found);
        }
        graph.set_input_fact(0, wanted).map_err(damaged)?;
        let graph = graph.into_typed().map_err(damaged)?;
        let result = graph.output_fact(0).map_err(damaged)?;
        if result.datum_type != f32::datum_type() || result.shape.as_concrete() != Some(&output) {
            return mismatch("output", output, format!("{result:?}"));
        }
        // what is computed from constants alone is a constant then
        let graph = graph.into_decluttered().map_err(damaged)?;
        let (macs, parameters) = cost(&graph).map_err(damaged)?;
        let graph = graph.into_optimized().map_err(damaged)?;
        let weights = graph.nodes().iter().flat_map(|n| &n.outputs).filter_map(|o| o.fact.konst.as_ref());
        let weights = weights.map(|t| t.len() * t.datum_type().size_of()).sum();
        let plan = SimplePlan::new(graph).map_err(damaged)?;
        let live = plan.model().eval_tmp_memory_usage(plan.order_without_consts(), |_| true).map_err(damaged)?;
        let tensors = live.iter().filter_map(|(_, bytes)| bytes.to_usize().ok()).max().unwrap_or(0);
        let engine = Self { plan, shape: input, file: file.to_owned(), weights, tensors, macs, parameters };
        // Proves that every operator runs, so that a frame cannot fail.
        let zeros = vec![0.0; input.iter().product()];
        engine.run(&mut engine.state()?, &zeros, &Arc::new(Workers::new(1)), |_| {})?;
        Ok(engine)
    }

    /// Bytes of the weights as they lie in memory.
    pub(super) fn bytes(&self) -> usize {
        self.weights
    }

    /// Bytes that [`Self::run`] holds at its peak on one thread, at most: the tensors alive together, as much again for what a
    /// product packs, and for the holes that a heap has which keeps what is freed.
    pub(super) fn run_bytes(&self) -> usize {
        3 * self.tensors
    }

    /// Multiply-adds of one tile: convolutions and products.
    pub(super) fn macs(&self) -> u64 {
        self.macs
    }

    /// Numbers in the network.
    pub(super) fn parameters(&self) -> usize {
        self.parameters
    }

    /// What one thread needs. Allocates.
    pub(super) fn state(&self) -> Result<State, PlanError> {
        self.plan.spawn().map_err(|e| self.failed(&e))
    }

    fn failed(&self, e: &TractError) -> PlanError {
        PlanError::Damaged { file: self.file.clone(), message: format!("{e:#}") }
    }

    /// One tile, convolutions in bytes shared among `team`; `take` is given the answer. Allocates and frees its tensors.
    pub(super) fn run(
        &self,
        state: &mut State,
        input: &[f32],
        team: &Arc<Workers>,
        take: impl FnOnce(&[f32]),
    ) -> Result<(), PlanError> {
        let answer = Tensor::from_shape(&self.shape, input)
            .and_then(|input| qlinear::with_team(team, || state.run(tvec![input.into_tvalue()])));
        let answer = answer.map_err(|e| self.failed(&e))?;
        let view =
            answer[0].try_as_plain_ram().and_then(|plain| plain.as_slice::<f32>()).map_err(|e| self.failed(&e))?;
        take(view);
        Ok(())
    }
}

/// Multiply-adds, and constants.
fn cost(graph: &TypedModel) -> TractResult<(u64, usize)> {
    let (mut macs, mut parameters) = (0, 0);
    for node in graph.nodes() {
        for (kind, count) in node.op.cost(&graph.node_input_facts(node.id)?)? {
            macs += if matches!(kind, Cost::FMA(_)) { count.to_usize()? as u64 } else { 0 };
        }
        let constants = node.outputs.iter().filter_map(|o| o.fact.konst.as_ref());
        parameters += constants.map(|t| t.len()).sum::<usize>();
    }
    Ok((macs, parameters))
}

fn operator_of(node: &InferenceNode) -> Cow<'static, str> {
    node.op.name()
}
