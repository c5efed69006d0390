#!/usr/bin/env python3
"""From a PyTorch network to a model folder: model.onnx, model-int8.onnx and manifest.toml.

    export.py golden DIR      the small networks and answers of tests/golden/fusion, from fixed seeds
    export.py check DIR       ONNX Runtime's answers and time, one thread, for every model in the folder

A training script calls `export(network, folder, ...)`. Needs torch, onnx, onnxruntime and numpy.

What makes a network fast here, and what `folded` does where it can:
- pixel_unshuffle(2) before a 3x3 convolution is one 6x6 convolution of stride 2, average pooling before it as well;
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
import torch.nn.functional as F
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

OPSET = 17


def folded(conv, planes, pooled=0):
    """pixel_unshuffle(2) of the first planes, 2x2 averages of the last `pooled` ones, then a 3x3 convolution of both with
    padding 1, as one 6x6 convolution of stride 2 with padding 2."""
    weight = conv.weight.detach()
    out, shuffled = weight.shape[0], planes - pooled
    whole = torch.zeros(out, planes, 6, 6)
    for plane in range(planes):
        for dy in range(2):
            for dx in range(2):
                if plane < shuffled:
                    part = weight[:, 4 * plane + 2 * dy + dx]
                else:
                    part = weight[:, 4 * shuffled + plane - shuffled] / 4
                whole[:, plane, dy::2, dx::2] = part
    merged = nn.Conv2d(planes, out, 6, 2, 2, bias=conv.bias is not None)
    merged.weight.data = whole
    if conv.bias is not None:
        merged.bias.data = conv.bias.detach().clone()
    return merged


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


def export(network, folder, *, name, description, licence, trained, metrics, tile, halo, multiple, planes=(), output=(), scale=1,
           samples=None, any_size=False, shape=None):
    """Writes the folder. `planes`: (plane, scale, offset) each; `trained`: date, data, iterations; `samples`: inputs for
    quantization, none leaves int8 out; `any_size`: leave the tile's side to the manifest; `shape`: input of a network that mixes,
    which has neither planes nor output of its own."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    network = network.eval()
    x = torch.zeros(shape or (1, len(planes), tile, tile))
    torch.onnx.export(network, (x,), str(folder / "model.onnx"), opset_version=OPSET, dynamo=False, input_names=["x"],
                      output_names=["y"], do_constant_folding=True,
                      dynamic_axes={name: {2: "height", 3: "width"} for name in "xy"} if any_size else None)
    compact(folder / "model.onnx")
    files = {"f32": "model.onnx"}
    if samples is not None:
        quantize(folder / "model.onnx", folder / "model-int8.onnx", samples)
        compact(folder / "model-int8.onnx")
        in_bytes(folder / "model.onnx")
        files["int8"] = "model-int8.onnx"
    text = [f"version = 1\nname = {json.dumps(name)}\ndescription = {json.dumps(description)}\nlicence = {json.dumps(licence)}"]
    text += ['kind = "mixes"\n' if shape else ""]
    text += ["[trained]"] + [f"{key} = {json.dumps(trained[key])}" for key in ("date", "data", "iterations")]
    text += ["\n[metrics]"] + [f"{key} = {value}" for key, value in metrics.items()] + ["\n[files]"]
    text += [f'{key} = {{ file = "{file}", sha256 = "{digest(folder / file)}" }}' for key, file in files.items()]
    text += ["\n[input]", f"tile = {tile}", f"halo = {halo}", f"multiple = {multiple}"]
    if not shape:
        text += ["planes = ["] + [f'    {{ plane = "{p}", scale = {float(s)}, offset = {float(o)} }},' for p, s, o in planes]
        text += ["]\n", "[output]", f"planes = {json.dumps(output)}", f"scale = {scale}"]
    (folder / "manifest.toml").write_text("\n".join(text) + "\n")


class Plain(nn.Module):
    """Two 3x3 convolutions: sees 2 pixels far."""

    def __init__(self):
        super().__init__()
        self.a, self.b = nn.Conv2d(4, 8, 3, padding=1), nn.Conv2d(8, 2, 3, padding=1)

    def forward(self, x):
        return self.b(F.relu(self.a(x)))


class Small(nn.Module):
    """Every operator of the shipped networks once: folded unshuffle, residual block, stride 2, shuffle, all three outputs."""

    def __init__(self):
        super().__init__()
        conv = lambda i, o, k=3, s=1: nn.Conv2d(i, o, k, s, k // 2)
        self.head = conv(15, 8)
        self.a, self.b, self.down, self.c = conv(8, 8), conv(8, 8), conv(8, 12, 3, 2), conv(12, 12)
        self.up, self.d, self.out = conv(12, 32, 1), conv(8, 8), conv(8, 12)
        self.folded = None

    def forward(self, x):
        if self.folded is None:
            x = self.head(torch.cat([F.pixel_unshuffle(x[:, :3], 2), F.avg_pool2d(x[:, 3:], 2)], 1))
        else:
            x = self.folded(x)
        x = F.relu(x)
        x = x + self.b(F.relu(self.a(x)))
        y = self.c(F.relu(self.down(x)))
        x = F.relu(x + F.pixel_shuffle(self.up(F.relu(y)), 2))
        return F.pixel_shuffle(self.out(self.d(x)), 2)


def answers(folder, x):
    np.save(folder / "input.npy", x)
    for file, name in (("model.onnx", "f32"), ("model-int8.onnx", "int8")):
        np.save(folder / f"{name}.npy", session(folder / file).run(None, {"x": x})[0])


def golden(target):
    torch.manual_seed(7)
    rng = np.random.default_rng(7)
    trained = {"date": "2026-01-01", "data": "none: random weights", "iterations": 10}
    common = dict(licence="MIT OR Apache-2.0", trained=trained, metrics={})
    stokes = [("s0", 1, -1), ("s1", 3, 0), ("s2", 3, 0)]
    noise = lambda planes, tile: rng.standard_normal((1, planes, tile, tile)).astype(np.float32)
    plain = Path(target) / "plain"
    export(Plain(), plain, name="plain", description="Two random convolutions", tile=24, halo=4, multiple=1,
           planes=stokes + [("r1", 100, 0)], output=["s1", "s2"], scale=0.05, samples=[noise(4, 24) for _ in range(8)], any_size=True, **common)
    answers(plain, noise(4, 24))
    small, network = Path(target) / "small", Small()
    back = [("r1", 100, 0), ("r2", 100, 0), ("r0", 100, 0)]
    x = torch.from_numpy(noise(6, 32))
    before = network(x)
    network.folded = folded(network.head, 6, 3)
    assert torch.allclose(before, network(x), atol=1e-5)
    export(network, small, name="small", description="A random network of all operators", tile=32, halo=8, multiple=4,
           planes=stokes + back, output=["s0", "s1", "s2"], scale=0.05, samples=[noise(6, 32) for _ in range(8)], **common)
    answers(small, noise(6, 32))
    mixes(Path(target) / "mixes", common)
    one_node(Path(target) / "unknown.onnx", onnx.TensorProto.FLOAT, onnx.helper.make_node("Refine", ["x"], ["y"], domain="own"))
    one_node(Path(target) / "double.onnx", onnx.TensorProto.DOUBLE, onnx.helper.make_node("Identity", ["x"], ["y"]))


def mixes(folder, common):
    """A small random network that mixes, and the corners of its answers to the pattern of ship.py."""
    import network
    import ship
    net = network.Mixer((4,), (1,))
    nn.init.normal_(net.tail.weight, std=0.05)
    pattern = [torch.from_numpy(v) for v in ship.golden_input()]
    with torch.no_grad():
        seen = net.candidates(*pattern)[2].numpy()
    export(network.Trunk(net), folder, name="mixes", description="A random network that mixes", tile=network.TILE, halo=32,
           multiple=net.multiple, samples=[seen], any_size=True, shape=seen.shape, **common)
    ship.corners(net, folder, lambda precision: folder / f"{precision}.npy")


def one_node(path, kind, node):
    """A graph of one node, as wide as the input of `plain`."""
    port = lambda name: onnx.helper.make_tensor_value_info(name, kind, [1, 4, 24, 24])
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
