//! Imports ONNX's `QLinearConv` nodes as operators that run the convolution of `int8.rs`.

use std::cell::RefCell;
use std::sync::Arc;

use tract_onnx::Onnx;
use tract_onnx::model::ParsingContext;
use tract_onnx::pb::NodeProto;
use tract_onnx::tract_hir::internal::*;

use tract_onnx::tract_core::ops::element_wise::ElementWiseOp;
use tract_onnx::tract_core::ops::quant::{DequantizeLinearF32, QuantizeLinearU8};

use super::int8::{Conv, Geometry, Quantization, Source, Target};
use crate::parallel::Workers;

const OPERATOR: &str = "QLinearConv";

thread_local! {
    /// The threads that share the rows of a convolution. The engine passes no context to its operators.
    static TEAM: RefCell<Option<Arc<Workers>>> = const { RefCell::new(None) };
}

/// Calls `run` with a team for the convolutions in it.
pub(super) fn with_team<T>(team: &Arc<Workers>, run: impl FnOnce() -> T) -> T {
    TEAM.set(Some(Arc::clone(team)));
    let result = run();
    TEAM.take();
    result
}

/// Lets the importer use this operator where it applies: one group, no dilation, explicit padding.
pub(super) fn register(mut onnx: Onnx) -> Onnx {
    onnx.op_register.insert(OPERATOR, parse);
    onnx
}

fn parse(context: &ParsingContext, node: &NodeProto) -> TractResult<(Box<dyn InferenceOp>, Vec<String>)> {
    let list = |name: &str| node.get_attr_opt_tvec::<usize>(name);
    let group = node.get_attr_opt::<usize>("group")?.unwrap_or(1);
    let dilated = list("dilations")?.is_some_and(|d| d.iter().any(|d| *d != 1));
    let automatic = node.get_attr_opt::<&str>("auto_pad")?.is_some_and(|pad| pad != "NOTSET");
    let strides = list("strides")?.unwrap_or_else(|| tvec![1, 1]);
    let pads = list("pads")?.unwrap_or_else(|| tvec![0; 4]);
    if group != 1 || dilated || automatic || strides.len() != 2 || pads.len() != 4 {
        return tract_onnx::onnx().op_register.0[OPERATOR](context, node);
    }
    let node = QLinearConv { strides: [strides[0], strides[1]], pads: [pads[0], pads[1], pads[2], pads[3]] };
    Ok((expand(node), vec![]))
}

/// The node before its constants are known.
#[derive(Clone, Debug)]
struct QLinearConv {
    strides: [usize; 2],
    /// Above, left, below, right.
    pads: [usize; 4],
}

/// Indices of the inputs in ONNX.
mod slot {
    pub(super) const X: usize = 0;
    pub(super) const X_SCALE: usize = 1;
    pub(super) const X_ZERO: usize = 2;
    pub(super) const W: usize = 3;
    pub(super) const W_SCALE: usize = 4;
    pub(super) const W_ZERO: usize = 5;
    pub(super) const Y_SCALE: usize = 6;
    pub(super) const Y_ZERO: usize = 7;
    pub(super) const BIAS: usize = 8;
}

impl QLinearConv {
    fn outputs(&self, axis: usize, len: TDim, kernel: TDim) -> TDim {
        (len + self.pads[axis] + self.pads[axis + 2] - kernel) / self.strides[axis] + 1
    }
}

impl Expansion for QLinearConv {
    fn name(&self) -> StaticName {
        OPERATOR.into()
    }

    fn rules<'r, 'p: 'r, 's: 'r>(
        &'s self,
        s: &mut Solver<'r>,
        inputs: &'p [TensorProxy],
        outputs: &'p [TensorProxy],
    ) -> InferenceResult {
        s.equals(&inputs[slot::X].rank, 4)?;
        s.equals(&inputs[slot::W].rank, 4)?;
        s.equals(&outputs[0].rank, 4)?;
        s.equals(&outputs[0].datum_type, &inputs[slot::Y_ZERO].datum_type)?;
        s.equals(&outputs[0].shape[0], &inputs[slot::X].shape[0])?;
        s.equals(&outputs[0].shape[1], &inputs[slot::W].shape[0])?;
        s.equals(&inputs[slot::X].shape[1], &inputs[slot::W].shape[1])?;
        s.given_2(&inputs[slot::X].shape, &inputs[slot::W].shape, move |s, x, w| {
            for axis in 0..2 {
                s.equals(&outputs[0].shape[2 + axis], self.outputs(axis, x[2 + axis].clone(), w[2 + axis].clone()))?;
            }
            Ok(())
        })
    }

    fn wire(&self, prefix: &str, model: &mut TypedModel, inputs: &[OutletId]) -> TractResult<TVec<OutletId>> {
        let constant = |i: usize| model.outlet_fact(inputs[i])?.konst.clone().context("a parameter is not constant");
        let floats = |i: usize| Ok::<_, TractError>(constant(i)?.try_as_plain_ram()?.as_slice::<f32>()?.to_vec());
        let integers = |i: usize| {
            let cast = constant(i)?.cast_to::<i32>()?.into_owned();
            Ok::<_, TractError>(cast.try_as_plain_ram()?.as_slice::<i32>()?.to_vec())
        };
        let x = model.outlet_fact(inputs[slot::X])?;
        let shape = x.shape.as_concrete().context("the input's shape is not fixed")?;
        ensure!(shape[0] == 1, "one image at a time, not {}", shape[0]);
        let weights = constant(slot::W)?;
        let [co, ci, kh, kw] = *weights.shape() else { bail!("weights of rank {}", weights.rank()) };
        let length = |axis: usize, kernel: usize| {
            let padded = shape[2 + axis] + self.pads[axis] + self.pads[axis + 2];
            ensure!(padded >= kernel, "a kernel of {kernel} on {padded} values");
            Ok((padded - kernel) / self.strides[axis] + 1)
        };
        let geometry = Geometry {
            input: [ci, shape[2], shape[3]],
            output: [co, length(0, kh)?, length(1, kw)?],
            kernel: [kh, kw],
            stride: self.strides,
            pad: [self.pads[0], self.pads[1]],
        };
        let (x_scale, y_scale) = (floats(slot::X_SCALE)?[0], floats(slot::Y_SCALE)?[0]);
        let (w_scale, w_zero) = (floats(slot::W_SCALE)?, integers(slot::W_ZERO)?);
        let each = |list: &[f32], o: usize| if list.len() == 1 { list[0] } else { list[o] };
        ensure!(w_scale.len() == 1 || w_scale.len() == co, "{} scales for {co} channels", w_scale.len());
        ensure!(w_zero.len() == 1 || w_zero.len() == co, "{} zero points for {co} channels", w_zero.len());
        let centred = integers(slot::W)?.into_iter().enumerate().map(|(i, w)| {
            let zero = if w_zero.len() == 1 { w_zero[0] } else { w_zero[i / (ci * kh * kw)] };
            i8::try_from(w - zero).context("weights less their zero point exceed 8 bits")
        });
        let quantization = Quantization {
            weights: centred.collect::<TractResult<_>>()?,
            bias: if inputs.len() > slot::BIAS { integers(slot::BIAS)? } else { vec![0; co] },
            multiplier: (0..co).map(|o| x_scale * each(&w_scale, o) / y_scale).collect(),
            zero: [integers(slot::X_ZERO)?[0], integers(slot::Y_ZERO)?[0]],
            signed: [x.datum_type.is_signed(), constant(slot::Y_ZERO)?.datum_type().is_signed()],
        };
        ensure!(quantization.bias.len() == co, "{} biases for {co} channels", quantization.bias.len());
        let kind = constant(slot::Y_ZERO)?.datum_type();
        let conv = Arc::new(Conv::new(geometry, &quantization));
        model.wire_node(prefix, Fused { conv, kind, quantize: None, dequantize: None }, &inputs[..1])
    }
}

/// The node as it runs, fused with a quantization before it and a dequantization after it.
#[derive(Clone, Debug)]
struct Fused {
    conv: Arc<Conv>,
    /// Type of the quantized output.
    kind: DatumType,
    /// 1/scale of an f32 input; none for a quantized one.
    quantize: Option<f32>,
    /// Zero point and scale of an f32 output; none for a quantized one.
    dequantize: Option<(i32, f32)>,
}

impl PartialEq for Fused {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.conv, &other.conv)
            && (self.quantize, self.dequantize, self.kind) == (other.quantize, other.dequantize, other.kind)
    }
}

impl Eq for Fused {}

impl Fused {
    fn output_kind(&self) -> DatumType {
        if self.dequantize.is_some() { f32::datum_type() } else { self.kind }
    }

    fn shape(&self) -> [usize; 4] {
        let [channels, height, width] = self.conv.output();
        [1, channels, height, width]
    }
}

impl Op for Fused {
    fn name(&self) -> StaticName {
        "FusedInt8Conv".into()
    }

    op_as_typed_op!();
}

impl EvalOp for Fused {
    op_out_of_plan!();

    fn eval(&self, _: &EvalContext, inputs: TVec<TValue>) -> TractResult<TVec<TValue>> {
        // SAFETY: the convolution writes every value.
        #[allow(unsafe_code)]
        let mut output = unsafe { Tensor::uninitialized_dt(self.output_kind(), &self.shape())? };
        let source = match self.quantize {
            None => Source::Bytes(inputs[0].as_bytes()),
            Some(factor) => Source::Floats(inputs[0].try_as_plain_ram()?.as_slice::<f32>()?, factor),
        };
        let team = TEAM.with_borrow(Clone::clone).context("a plan that is run without a team")?;
        match self.dequantize {
            None => self.conv.run(source, Target::Bytes(output.as_bytes_mut()), &team),
            Some((zero, scale)) => {
                let mut view = output.try_as_plain_ram_mut()?;
                self.conv.run(source, Target::Floats(view.as_slice_mut::<f32>()?, zero, scale), &team);
            }
        }
        Ok(tvec![output.into_tvalue()])
    }
}

impl TypedOp for Fused {
    as_op!();

    fn output_facts(&self, _: &[&TypedFact]) -> TractResult<TVec<TypedFact>> {
        Ok(tvec![self.output_kind().fact(self.shape())])
    }

    fn cost(&self, _: &[&TypedFact]) -> TractResult<TVec<(Cost, TDim)>> {
        Ok(tvec![(Cost::FMA(i8::datum_type()), self.conv.macs().into())])
    }

    /// Fuses the quantization before and the dequantization after the convolution, which would be passes of their own.
    fn declutter(&self, model: &TypedModel, node: &TypedNode) -> TractResult<Option<TypedModelPatch>> {
        let before = model.node(node.inputs[0].node);
        let quantize = before.op_as::<ElementWiseOp>().and_then(|op| op.0.downcast_ref::<QuantizeLinearU8>());
        if let (None, Some(q)) = (self.quantize, quantize)
            && i32::from(q.zero_point) == self.conv.zero_in()
            && model.outlet_fact(before.inputs[0])?.datum_type == f32::datum_type()
        {
            let fused = Self { quantize: Some(q.scale), ..self.clone() };
            return TypedModelPatch::replace_single_op(model, node, &before.inputs, fused).map(Some);
        }
        let after = model.single_succ(node.id)?.and_then(|next| next.op_as::<DequantizeLinearF32>());
        if let (None, Some(d)) = (self.dequantize, after) {
            let fused = Self { dequantize: Some((d.zero_point, d.scale)), ..self.clone() };
            return TypedModelPatch::fuse_with_next(model, node, fused).map(Some);
        }
        Ok(None)
    }
}
