#!/usr/bin/env python3
"""Writes a PyTorch network as a model folder: model.onnx, model-int8.onnx and manifest.toml.

    export.py golden DIR      the small network, its answers and the broken files of tests/golden/fusion, from fixed seeds
    export.py check DIR       ONNX Runtime's answers and time, one thread, for every model in the folder

A training script calls `export(network, folder, ...)`. Needs torch, onnx, onnxruntime and numpy.

What makes a network fast here:
- plain 3x3 and 1x1 convolutions, additions and ReLU; pixel_shuffle(2) is DepthToSpace. No depthwise ones for int8;
- int8 as QOperator (QLinearConv), one scale per tensor: a QDQ graph would run in floating point.
"""
import argparse
import hashlib
import json
import time
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch
import torch.nn as nn
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

OPSET = 17


def digest(path):
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def session(path, threads=1):
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    return ort.InferenceSession(str(path), options)


class Samples(CalibrationDataReader):
    def __init__(self, batches):
        self.batches = iter(batches)

    def get_next(self):
        x = next(self.batches, None)
        return None if x is None else {"x": np.asarray(x, np.float32)}


def compact(path):
    """Names as short as they can be, and large constants that are multiples of 1/32 up to 1 (interpolation) as bytes."""
    model = onnx.load(path)
    graph, nodes = model.graph, []
    names = {"": "", "x": "x", "y": "y"}
    short = lambda name: names.setdefault(name, f"{len(names):x}")
    for node in graph.node:
        node.name, node.doc_string = "", ""
        node.input[:], node.output[:] = [short(n) for n in node.input], [short(n) for n in node.output]
        if node.op_type == "Constant" and node.attribute[0].name == "value":
            constant = node.attribute[0].t
            constant.name = node.output[0]
            graph.initializer.add().CopyFrom(constant)
        else:
            nodes.append(node)
    known = set()
    for tensor in graph.initializer:
        tensor.name = names.get(tensor.name, tensor.name)
        values = onnx.numpy_helper.to_array(tensor)
        steps = 32 * values.astype(np.float64)
        if values.dtype == np.float32 and values.size > 1000 and np.all((steps == np.rint(steps)) & (steps >= 0) & (steps <= 32)):
            as_bytes, unscaled = short(f"{tensor.name} bytes"), short(f"{tensor.name} unscaled")
            nodes[:0] = [
                onnx.helper.make_node("Cast", [as_bytes], [unscaled], to=onnx.TensorProto.FLOAT),
                onnx.helper.make_node("Mul", [unscaled, "step"], [tensor.name]),
            ]
            tensor.CopyFrom(onnx.numpy_helper.from_array(steps.astype(np.uint8), as_bytes))
            known.add("step")
    if known:
        graph.initializer.append(onnx.numpy_helper.from_array(np.float32(1 / 32), "step"))
    ordered = list(nodes)
    del graph.node[:], graph.value_info[:], model.metadata_props[:]
    graph.node.extend(ordered)
    onnx.checker.check_model(model)
    onnx.save(model, path)


def in_bytes(path):
    """Weights of convolutions as signed bytes with one scale for each output channel, which an importer multiplies out once: a quarter
    of the file, with arithmetic in floating point as before."""
    model = onnx.load(path)
    graph, tensors = model.graph, {t.name: t for t in model.graph.initializer}
    made = []
    for node in graph.node:
        if node.op_type != "Conv":
            continue
        tensor = tensors[node.input[1]]
        weights = onnx.numpy_helper.to_array(tensor)
        scale = np.maximum(np.abs(weights).max((1, 2, 3), keepdims=True), 1e-12).astype(np.float32) / 127
        name = tensor.name
        made += [
            onnx.helper.make_node("Cast", [f"{name} bytes"], [f"{name} unscaled"], to=onnx.TensorProto.FLOAT),
            onnx.helper.make_node("Mul", [f"{name} unscaled", f"{name} scales"], [name]),
        ]
        tensor.CopyFrom(onnx.numpy_helper.from_array(np.rint(weights / scale).astype(np.int8), f"{name} bytes"))
        graph.initializer.append(onnx.numpy_helper.from_array(scale, f"{name} scales"))
    ordered = made + list(graph.node)
    del graph.node[:]
    graph.node.extend(ordered)
    onnx.checker.check_model(model)
    onnx.save(model, path)


def quantize(source, target, samples):
    """int8 by the ranges that `samples`, arrays [1, C, tile, tile], show: one scale per tensor, symmetric weights."""
    quantize_static(
        str(source), str(target), Samples(samples), quant_format=QuantFormat.QOperator, per_channel=False,
        activation_type=QuantType.QUInt8, weight_type=QuantType.QInt8, op_types_to_quantize=["Conv"],
        extra_options={"WeightSymmetric": True},
    )


def export(network, folder, *, name, description, licence, trained, metrics, tile, halo, multiple, samples):
    """Writes the folder of a network with one input [1, features, height, width]. `trained`: date, data, iterations; `samples`: inputs
    for quantization."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    x = torch.zeros(samples[0].shape)
    torch.onnx.export(network.eval(), (x,), str(folder / "model.onnx"), opset_version=OPSET, dynamo=False, input_names=["x"],
                      output_names=["y"], do_constant_folding=True,
                      dynamic_axes={name: {2: "height", 3: "width"} for name in "xy"})
    compact(folder / "model.onnx")
    quantize(folder / "model.onnx", folder / "model-int8.onnx", samples)
    compact(folder / "model-int8.onnx")
    in_bytes(folder / "model.onnx")
    files = {"f32": "model.onnx", "int8": "model-int8.onnx"}
    text = [f"version = 1\nname = {json.dumps(name)}\ndescription = {json.dumps(description)}\nlicence = {json.dumps(licence)}"]
    text += ['kind = "mixes"\n']
    text += ["[trained]"] + [f"{key} = {json.dumps(trained[key])}" for key in ("date", "data", "iterations")]
    text += ["\n[metrics]"] + [f"{key} = {value}" for key, value in metrics.items()] + ["\n[files]"]
    text += [f'{key} = {{ file = "{file}", sha256 = "{digest(folder / file)}" }}' for key, file in files.items()]
    text += ["\n[input]", f"tile = {tile}", f"halo = {halo}", f"multiple = {multiple}"]
    (folder / "manifest.toml").write_text("\n".join(text) + "\n")


def golden(target):
    """A small random network, the corners of its answers to the pattern of ship.py, and broken files."""
    import network
    import ship
    torch.manual_seed(7)
    target, net = Path(target), network.Mixer((4,), (1,))
    nn.init.normal_(net.tail.weight, std=0.05)
    pattern = [torch.from_numpy(v) for v in ship.golden_input()]
    with torch.no_grad():
        features = net.candidates(*pattern)[2].numpy()
    folder = target / "mixes"
    export(network.Trunk(net), folder, name="mixes", description="A random network that mixes", licence="MIT OR Apache-2.0",
           trained={"date": "2026-01-01", "data": "none: random weights", "iterations": 10}, metrics={}, tile=network.TILE, halo=32,
           multiple=net.multiple, samples=[features])
    ship.corners(net, folder, lambda precision: folder / f"{precision}.npy")
    float_, double = onnx.TensorProto.FLOAT, onnx.TensorProto.DOUBLE
    one_node(target / "unknown.onnx", float_, onnx.helper.make_node("Refine", ["x"], ["y"], domain="own"))
    one_node(target / "double.onnx", double, onnx.helper.make_node("Identity", ["x"], ["y"]))
    one_node(target / "identity.onnx", float_, onnx.helper.make_node("Identity", ["x"], ["y"]))


def one_node(path, kind, node):
    """A graph of one node with the input of a network that mixes."""
    port = lambda name: onnx.helper.make_tensor_value_info(name, kind, [1, 55, 64, 64])
    graph = onnx.helper.make_graph([node], "one", [port("x")], [port("y")])
    opsets = [onnx.helper.make_opsetid("", OPSET), onnx.helper.make_opsetid("own", 1)]
    onnx.save(onnx.helper.make_model(graph, opset_imports=opsets, ir_version=8), path)


def check(folder):
    for file in sorted(Path(folder).rglob("*.onnx")):
        s = session(file)
        shape = s.get_inputs()[0].shape
        x = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
        times = []
        for _ in range(20):
            start = time.process_time()
            y = s.run(None, {"x": x})[0]
            times.append(time.process_time() - start)
        print(f"{file}: {shape} -> {list(y.shape)}, {1e3 * min(times):.1f} ms, {file.stat().st_size} bytes")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=["golden", "check"])
    parser.add_argument("folder")
    arguments = parser.parse_args()
    {"golden": golden, "check": check}[arguments.command](arguments.folder)
