#!/usr/bin/env python3
"""Other networks on the same data, small: the paper's architecture and its ablations, each a row of one table.

    table.py WORK [--groups N] [--steps N] [--only ROW ...]

WORK is what run.sh has made; answers of other solvers, checkpoints and ONNX files go to WORK/table, and what is there is kept. Every
network learns as long as the others, from the first groups and without the scenes of fold B. Gains are those over guided stage I with
10 iterations, S1/S2 PSNR in the mean of scenes. Times are ONNX Runtime's, one thread, network alone; of those that mix, of the trunk.
"""
import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F

import captures
import export
import network
import train
from network import TILE, conv

CELL, WINDOW = 4, 8  # pixels of a token's side, tokens of a window's
STEP = 0.1  # what a painted correction of 1 means, of rms(S0)
# Stage I without a guide and its iterations: the program's solver of Stokes images by FISTA, and the paper's ADMM over intensities.
SOLVERS = {"fista": ("stokes", 100), "admm": ("admm", 50)}
WIENER = (1e-4, 1e-3, 1e-2, 1e-1)  # regularization of inversions, of the peak of |H|²


class Attention(nn.Module):
    """A Swin layer: attention within windows, every second layer with shifted ones, to itself or to another image; then an MLP."""

    def __init__(self, width, heads, shift):
        super().__init__()
        self.heads, self.shift = heads, shift
        self.norm, self.other, self.last = nn.LayerNorm(width), nn.LayerNorm(width), nn.LayerNorm(width)
        self.q, self.kv, self.out = nn.Linear(width, width), nn.Linear(width, 2 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        self.bias = nn.Parameter(torch.zeros((2 * WINDOW - 1) ** 2, heads))
        y, x = torch.meshgrid(torch.arange(WINDOW), torch.arange(WINDOW), indexing="ij")
        y, x = y.flatten(), x.flatten()
        at = (y[:, None] - y + WINDOW - 1) * (2 * WINDOW - 1) + x[:, None] - x + WINDOW - 1
        self.register_buffer("at", at, persistent=False)

    def windows(self, x):
        """[B, S, S, C] as [B·windows, heads, WINDOW², C/heads]."""
        b, s, _, c = x.shape
        n = s // WINDOW
        x = x.reshape(b, n, WINDOW, n, WINDOW, self.heads, c // self.heads).permute(0, 1, 3, 5, 2, 4, 6)
        return x.reshape(b * n * n, self.heads, WINDOW * WINDOW, c // self.heads)

    def forward(self, x, other=None):
        b, s, _, c = x.shape
        n = s // WINDOW
        moved = lambda v, by: torch.roll(v, (by, by), (1, 2)) if self.shift else v
        seen = moved(self.norm(x), -WINDOW // 2)
        about = seen if other is None else moved(self.other(other), -WINDOW // 2)
        q = self.windows(self.q(seen))
        k, v = (self.windows(part) for part in self.kv(about).chunk(2, -1))
        bias = self.bias[self.at].permute(2, 0, 1)
        a = torch.softmax(q @ k.transpose(-1, -2) * (c // self.heads) ** -0.5 + bias, -1) @ v
        a = a.reshape(b, n, n, self.heads, WINDOW, WINDOW, c // self.heads).permute(0, 1, 4, 2, 5, 3, 6).reshape(b, s, s, c)
        x = x + self.out(moved(a, WINDOW // 2))
        return x + self.mlp(self.last(x))


class Swin(nn.Module):
    """SwinFuSR as the paper adapts it, small: tokens of 4 × 4 pixels, two layers for each image, two of cross attention each way,
    and two of both together. With one image (or `simple`: both at once) it is a plain stack of as many layers."""

    def __init__(self, images, simple=False, width=48, heads=4):
        super().__init__()
        self.images = [sum(images, [])] if simple else images
        layers = lambda n: nn.ModuleList(Attention(width, heads, k % 2 == 1) for k in range(n))
        self.heads = nn.ModuleList(conv(CELL * CELL * len(planes), width) for planes in self.images)
        self.alone = nn.ModuleList(layers(2) for _ in self.images)
        self.across = nn.ModuleList(layers(2) for _ in self.images) if len(self.images) == 2 else None
        self.merge = conv(2 * width, width, 1) if self.across else None
        self.together = layers(2 if self.across else 4)
        self.tail = conv(width, 2 * CELL * CELL)
        nn.init.zeros_(self.tail.weight)
        nn.init.zeros_(self.tail.bias)

    def forward(self, x, _=None):
        first = [head(F.pixel_unshuffle(x[:, planes], CELL)) for head, planes in zip(self.heads, self.images)]
        found = [v.permute(0, 2, 3, 1) for v in first]
        for k, layers in enumerate(self.alone):
            for layer in layers:
                found[k] = layer(found[k])
        if self.across:
            for one, two in zip(*self.across):
                found = [one(found[0], found[1]), two(found[1], found[0])]
            merged = self.merge(torch.cat(found, -1).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        else:
            merged = found[0]
        for layer in self.together:
            merged = layer(merged)
        return STEP * F.pixel_shuffle(self.tail(merged.permute(0, 3, 1, 2) + first[0]), CELL)


class Painter(nn.Module):
    """A U-Net from a quarter of the resolution down, of the largest trunk's shape, which paints the correction itself."""

    def __init__(self, planes, widths=(32, 48, 64), blocks=(1, 1, 2)):
        super().__init__()
        self.planes = planes
        self.trunk = network.Mixer(widths, blocks)
        self.trunk.head = conv(CELL * CELL * len(planes), widths[0])
        self.trunk.tail = conv(widths[0], 2 * CELL * CELL, 1)
        nn.init.zeros_(self.trunk.tail.weight)
        nn.init.zeros_(self.trunk.tail.bias)

    def forward(self, x, _=None):
        return STEP * F.pixel_shuffle(self.trunk.weights(F.pixel_unshuffle(x[:, self.planes], CELL)), CELL)


class Unrolled(nn.Module):
    """Two networks that mix, each as a step towards what is likely, with a step towards the readings after each: solve, net, solve,
    net. The readings' step is that of `train.kept`, in closed form with the mask taken for an even one."""

    def __init__(self):
        super().__init__()
        self.first, self.second = (network.Mixer(*network.SIZES["default"]) for _ in range(2))

    def forward(self, x, power):
        once = train.kept(self.first(x, power), power)
        # what the first one changed is not missing any more: AᵀA = ⅛ |K|²
        shown = torch.fft.ifft2(torch.fft.fft2(once) * power.float() / 8).real
        x = torch.cat([x[:, :1], x[:, 1:3] + once, x[:, 3:4], x[:, 4:] - network.SCALES[4] * shown], 1)
        return once + self.second(x, power)


GUIDE, LIGHT, ALL = [0], [1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]
# Name: what it starts from, and the network. Planes: S0, S1, S2, then R0, R1, R2 behind guided stage I, the unguided S0 behind the
# others, and the inversions for `flatnet`.
ROWS = {
    "mixes": ("guided", lambda: network.Mixer(*network.SIZES["default"])),
    "mixes, large": ("guided", lambda: network.Mixer(*network.SIZES["large"])),
    "mixes twice": ("guided", Unrolled),
    "U-Net that paints": ("guided", lambda: Painter(ALL)),
    "Swin": ("guided", lambda: Swin([LIGHT, GUIDE])),
    "Swin, simple fusion": ("guided", lambda: Swin([LIGHT, GUIDE], simple=True)),
    "Swin, FISTA start": ("fista", lambda: Swin([[1, 2, 3], GUIDE])),
    "Swin, ADMM start": ("admm", lambda: Swin([[1, 2, 3], GUIDE])),
    "Swin, no guide": ("fista", lambda: Swin([[1, 2, 3]])),
    "Swin, guide only": ("nothing", lambda: Swin([GUIDE])),
    "FlatNet": ("inversions", lambda: Painter(list(range(3, 3 + 3 * len(WIENER))))),
}


def raw_of(z):
    """The readings of a file of captures.py, as good as its f16 numbers are."""
    return np.float32(z["residual"]) + captures.readings(np.float32(z["stokes"]), z["psf"], z["mask"])


def unguided(z, kind):
    """Stokes images that SOLVERS[kind] finds without a guide."""
    method, iterations = SOLVERS[kind]
    degrees = np.rint(np.rad2deg(np.angle(z["mask"]) / 2) % 180)
    stripes = 1 + np.count_nonzero(np.diff(degrees))
    sigma = max(float(np.float32(z["residual"]).std()), 1e-3)
    return captures.stage1(raw_of(z), None, z["psf"], sigma, len(set(degrees)), stripes, iterations, method=method)[0]


def inversions(z):
    """[F, 3·len(WIENER), N, N]: readings, and readings times the mask's conjugate phase, through regularized inverses of the PSF."""
    n, f = captures.N, 2 * captures.N
    h = np.zeros((f, f), np.float32)
    h[:n, :n] = z["psf"]
    h = np.fft.rfft2(np.roll(h, (-(n // 2), -(n // 2)), (0, 1)))
    raw = raw_of(z)
    spectra = [np.fft.rfft2(v, (f, f)) for v in (2 * raw, 4 * raw * z["mask"].real, 4 * raw * z["mask"].imag)]
    made = []
    for share in WIENER:
        inverse = h.conj() / (abs(h) ** 2 + share)
        made += [np.fft.irfft2(s * inverse, (f, f))[:, :n, :n] for s in spectra]
    return np.stack(made, 1).astype(np.float32)


def load(path, start, wanted, cache):
    """As train.load, for what a row starts from; and what guided stage I lacks. What has not been through a solver is added whole."""
    x, y, power, sources, *_ = train.load(path, wanted)
    if start == "guided":
        return x, y, power, sources, y
    if start in ("nothing", "inversions"):
        power = np.zeros_like(power)
    z = np.load(path)
    keep = [k for k, source in enumerate(z["source"]) if wanted is None or source in wanted]
    stokes = np.float32(z["stokes"][keep])
    _, rms = train.features(stokes, np.zeros((len(keep), 3, captures.N, captures.N), np.float32))
    truth = y + x[:, 1:3]
    if start == "nothing":
        other = np.zeros_like(x)
    elif start == "inversions":
        other = np.concatenate([np.zeros_like(x[:, :3]), train.tile(np.float16(inversions(z)[keep] / rms))], 1)
    else:
        file = cache / start / f"{path.parent.name}-{path.stem}.npy"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            np.save(file, np.float16(unguided(z, start)))
        found = train.tile(np.float16(np.float32(np.load(file))[keep] / rms))
        other = np.zeros_like(x)
        other[:, 1:3], other[:, 3] = found[:, 1:3], found[:, 0] - x[:, 0]
    other[:, 0] = x[:, 0]
    return other, truth - other[:, 1:3], power, sources, y


def size_and_time(net, folder, xs, powers):
    """Bytes and milliseconds of the ONNX files in f32 and int8 for tiles `xs`; convolutions alone have int8 arithmetic. Of networks
    that mix they hold the trunk; of two, they are twice those of one."""
    samples, times_over = [np.float32(x[None]) for x in xs], 1
    if isinstance(net, Unrolled):
        net, times_over = net.first, 2
    if isinstance(net, network.Mixer):
        with torch.no_grad():
            samples = [net.candidates(torch.from_numpy(x), torch.from_numpy(np.float32(p[None])))[2].numpy() for x, p in zip(samples, powers)]
        net = network.Trunk(net)
    folder.mkdir(parents=True, exist_ok=True)
    files = {"f32": folder / "model.onnx", "int8": folder / "model-int8.onnx"}
    torch.onnx.export(net, (torch.from_numpy(samples[0]),), str(files["f32"]), opset_version=export.OPSET, dynamo=False,
                      input_names=["x"], output_names=["y"], do_constant_folding=True)
    export.quantize(files["f32"], files["int8"], samples)
    out = {}
    for precision, file in files.items():
        session, times = export.session(file), []
        for _ in range(10):
            begun = time.process_time()
            session.run(None, {"x": samples[0]})
            times.append(time.process_time() - begun)
        out[precision] = (times_over * file.stat().st_size, times_over * 1e3 * min(times))
    return out


def macs_of(net, planes):
    """Multiply-adds of one tile: convolutions, linear layers, and both products of attention."""
    total = 0

    def count(layer, given, out):
        nonlocal total
        if isinstance(layer, nn.Conv2d):
            total += out.shape[2] * out.shape[3] * layer.weight.numel()
        elif isinstance(layer, nn.Linear):
            total += out.numel() // out.shape[-1] * layer.weight.numel()
        else:
            total += 2 * given[0].numel() * WINDOW * WINDOW

    hooks = [m.register_forward_hook(count) for m in net.modules() if isinstance(m, (nn.Conv2d, nn.Linear, Attention))]
    with torch.no_grad():
        net(torch.zeros(1, planes, TILE, TILE), torch.ones(1, 1, TILE, TILE))
    for hook in hooks:
        hook.remove()
    return total


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--only", nargs="+", metavar="ROW", choices=ROWS, default=list(ROWS))
    parser.add_argument("--groups", type=int, default=60)
    parser.add_argument("--steps", type=int, default=800)
    a = parser.parse_args()
    torch.set_num_threads(1)
    learned = {"procedural", *train.Measured.FOLDS["A"]}
    lines = ["| network | starts from | all scenes | unseen scenes | GMAC | thousand parameters | f32: kB | ms | int8: kB | ms |", "|---" * 10 + "|"]
    for name in a.only:
        start, make = ROWS[name]
        folder = a.work / "table" / name.replace(",", "").replace(" ", "-").lower()
        torch.manual_seed(1)
        given = lambda path, wanted: load(path, start, wanted, a.work / "table")
        checks = {"nominal": given(a.work / "data/check/nominal.npz", None)}
        net, planes = make(), checks["nominal"][0].shape[1]
        if not (folder / "run.pt").exists():
            parts = [given(path, learned) for path in sorted(a.work.glob("data/train/????.npz"))[:a.groups]]
            xs, ys, power = (np.concatenate([part[k] for part in parts]) for k in (0, 1, 2))
            frames = train.Frames(xs, ys, power, np.arange(len(xs)))
            print(f"{name}: {len(frames)} frames", flush=True)
            folder.mkdir(parents=True, exist_ok=True)

            def report(mean, step):
                result = train.judge(mean, checks, learned)
                train.show(result)
                torch.save({"weights": mean.state_dict(), "steps": step, "checks": json.dumps(result)}, folder / "run.part")

            # attention does not learn at the rate of convolutions
            rate = 5e-4 if isinstance(net, Swin) else 2e-3
            train.fit(net, frames, steps=a.steps, batch=4, rate=rate, seed=1, report=report)
            (folder / "run.part").replace(folder / "run.pt")
        run = torch.load(folder / "run.pt", weights_only=True)
        net.load_state_dict(run["weights"])
        files = size_and_time(net.eval(), folder, checks["nominal"][0], checks["nominal"][2])
        result = json.loads(run["checks"])["nominal"]
        cells = [name, start, f"{result['all']:+.2f} dB", f"{result['unseen']:+.2f} dB", f"{macs_of(net, planes) / 1e9:.2f}",
                 f"{sum(p.numel() for p in net.parameters()) / 1e3:.0f}"]
        cells += [part for size, ms in files.values() for part in (f"{size / 1e3:.0f}", f"{ms:.0f}")]
        lines.append("| " + " | ".join(cells) + " |")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
