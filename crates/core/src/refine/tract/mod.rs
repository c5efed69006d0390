//! The engine for ONNX files: tract. Imports a file, checks its shapes, optimizes it for them and runs it.

mod int8;
mod qlinear;

use std::fmt;
use std::sync::Arc;

use tract_onnx::prelude::*;
use tract_onnx::tract_core::internal::{Cost, DimLike};
use tract_onnx::tract_core::plan::{SimplePlan, SimpleState};
use tract_onnx::tract_hir::infer::{Factoid, InferenceNode};

use super::model::{Model, Onnx};
use super::network::{Engine, PlanError, Runner};
use crate::parallel::Workers;

/// A network of fixed shape, f32 on both sides.
struct Tract {
    plan: Arc<SimplePlan<TypedFact, Box<dyn TypedOp>>>,
    shape: [usize; 4],
    file: String,
    weights: usize,
    tensors: usize,
    macs: u64,
    parameters: usize,
}

impl fmt::Debug for Tract {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Tract({}, {:?})", self.file, self.shape)
    }
}

/// One thread's state of a [`Tract`].
struct State {
    state: SimpleState<TypedFact, Box<dyn TypedOp>>,
    shape: [usize; 4],
    file: String,
}

impl fmt::Debug for State {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "State({}, {:?})", self.file, self.shape)
    }
}

/// Imports, checks and optimizes an ONNX file for the tiles of `model`. Allocates.
pub(super) fn import(model: &Model, onnx: &Onnx) -> Result<Arc<dyn Engine>, PlanError> {
    // The importer reads untrusted graphs. A panic in it must not end the pipeline.
    std::panic::catch_unwind(|| Tract::load(model, &onnx.bytes, &onnx.name)).unwrap_or_else(|_| {
        Err(PlanError::Damaged { file: onnx.name.clone(), message: "the importer gave up".to_owned() })
    })
}

impl Tract {
    fn load(model: &Model, bytes: &[u8], file: &str) -> Result<Arc<dyn Engine>, PlanError> {
        let damaged = |e: TractError| failed(file, &e);
        let [input, output] = model.shapes();
        let mut graph = qlinear::register(tract_onnx::onnx())
            .with_ignore_value_info(true)
            .model_for_read(&mut &*bytes)
            .map_err(damaged)?;
        check_ports(&graph, input, file)?;
        graph.set_input_fact(0, InferenceFact::dt_shape(f32::datum_type(), input)).map_err(damaged)?;
        let graph = graph.into_typed().map_err(damaged)?;
        let result = graph.output_fact(0).map_err(damaged)?;
        if result.datum_type != f32::datum_type() || result.shape.as_concrete() != Some(&output) {
            return Err(mismatch(file, "output", output, format!("{result:?}")));
        }
        // Decluttering folds constants, so that the counts below are those of what runs.
        let graph = graph.into_decluttered().map_err(damaged)?;
        let (macs, parameters) = cost(&graph).map_err(damaged)?;
        let graph = graph.into_optimized().map_err(damaged)?;
        let weights = graph.nodes().iter().flat_map(|n| &n.outputs).filter_map(|o| o.fact.konst.as_ref());
        let weights = weights.map(|t| t.len() * t.datum_type().size_of()).sum();
        let plan = SimplePlan::new(graph).map_err(damaged)?;
        let live = plan.model().eval_tmp_memory_usage(plan.order_without_consts(), |_| true).map_err(damaged)?;
        let tensors = live.iter().filter_map(|(_, bytes)| bytes.to_usize().ok()).max().unwrap_or(0);
        let network = Self { plan, shape: input, file: file.to_owned(), weights, tensors, macs, parameters };
        // One run proves that every operator works, so that none fails on a frame.
        let zeros = vec![0.0; input.iter().product()];
        network.runner()?.run(&zeros, &Arc::new(Workers::new(1)), &mut |_| {})?;
        Ok(Arc::new(network))
    }
}

impl Engine for Tract {
    fn runner(&self) -> Result<Box<dyn Runner>, PlanError> {
        let state = self.plan.spawn().map_err(|e| failed(&self.file, &e))?;
        Ok(Box::new(State { state, shape: self.shape, file: self.file.clone() }))
    }

    fn weight_bytes(&self) -> usize {
        self.weights
    }

    /// Three times the tensors that live at once: the tensors, as much for the operands that a matrix product packs, and as much
    /// for the gaps in a heap that keeps freed blocks.
    fn run_bytes(&self) -> usize {
        3 * self.tensors
    }

    fn macs(&self) -> u64 {
        self.macs
    }

    fn parameters(&self) -> usize {
        self.parameters
    }
}

impl Runner for State {
    fn run(&mut self, features: &[f32], team: &Arc<Workers>, take: &mut dyn FnMut(&[f32])) -> Result<(), PlanError> {
        let Self { state, shape, file } = self;
        let output = Tensor::from_shape(shape, features)
            .and_then(|input| qlinear::with_team(team, || state.run(tvec![input.into_tvalue()])))
            .map_err(|e| failed(file, &e))?;
        let plain = output[0].try_as_plain_ram().map_err(|e| failed(file, &e))?;
        take(plain.as_slice::<f32>().map_err(|e| failed(file, &e))?);
        Ok(())
    }
}

fn failed(file: &str, e: &TractError) -> PlanError {
    PlanError::Damaged { file: file.to_owned(), message: format!("{e:#}") }
}

fn mismatch(file: &str, what: &'static str, expected: [usize; 4], found: String) -> PlanError {
    PlanError::Shape { file: file.to_owned(), what, expected, found }
}

/// Checks that the graph knows all its operators and has one output and one input, which takes f32 of shape `input`.
fn check_ports(graph: &InferenceModel, input: [usize; 4], file: &str) -> Result<(), PlanError> {
    for (what, found) in [("inputs", graph.inputs.len()), ("outputs", graph.outputs.len())] {
        if found != 1 {
            return Err(PlanError::Ports { file: file.to_owned(), what, found });
        }
    }
    let unknown = |n: &InferenceNode| {
        n.op.name().strip_prefix("Unimplemented(").map(|name| name.trim_end_matches(')').to_owned())
    };
    if let Some(operator) = graph.nodes().iter().find_map(unknown) {
        return Err(PlanError::Operator { file: file.to_owned(), operator });
    }
    let declared = graph.input_fact(0).map_err(|e| failed(file, &e))?;
    // An axis that the file leaves open has a symbol as its length, or nothing.
    let fixed = |dim: TDim| dim.to_usize().ok();
    let dims: Vec<_> = declared.shape.dims().map(|dim| dim.concretize().and_then(fixed)).collect();
    let same_rank = if declared.shape.is_open() { dims.len() <= 4 } else { dims.len() == 4 };
    let same = same_rank && dims.iter().zip(input).all(|(found, expected)| found.is_none_or(|n| n == expected));
    if !same || declared.datum_type.concretize().is_some_and(|kind| kind != f32::datum_type()) {
        return Err(mismatch(file, "input", input, declared.format_dt_shape()));
    }
    Ok(())
}

/// Multiply-adds and the number of constants.
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
