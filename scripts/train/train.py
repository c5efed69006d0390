#!/usr/bin/env python3
"""Trains a network on the captures of captures.py and judges it on scenes it has not seen.

    train.py DATA [OUT.pt] [--size default|preview] [--folds A|B|AB] [--steps N] [--start RUN.pt] [--bytes]

DATA/gathered becomes what all runs read, unless it is there; without OUT that is all. `--start` goes on from another run, `--bytes`
with the rounding of int8 in the loop. `--folds` says which measured scenes it learns from; the checks report those left out apart.
Seeded. One thread unless there is a GPU.
"""
import argparse
import json
import time
from pathlib import Path

import numpy as np
import scipy.fft
import torch

import network
from scenes import Measured

MARGIN = 3  # 250 pixels become a tile of 256
INNER = (..., slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
ANGLE = 1.0  # weight of the angle of polarization in the loss, against S1 and S2
VISIBLE = 0.1  # power of the PSF's spectrum, of its largest, from which on the readings know better; crates/core/src/refine/mod.rs has it too


def tile(x):
    return np.pad(x, ((0, 0),) * (x.ndim - 2) + ((MARGIN, MARGIN),) * 2, "edge")


def back_projected(residual, psf, mask):
    """R0, R1, R2 of residuals [F, N, N]: k̃ * (½ r) and k̃ * (e ⊙ r), as docs/models.md defines them."""
    n = psf.shape[0]
    rows, columns = (np.flatnonzero(psf.any(axis)) for axis in (1, 0))
    reach = max(abs(np.concatenate([rows, columns]) - n // 2)) + 1
    f = scipy.fft.next_fast_len(n + int(reach))
    big = np.zeros((f, f), np.float32)
    big[:n, :n] = psf
    spectrum = scipy.fft.fft2(np.roll(big, (-(n // 2), -(n // 2)), (0, 1))).conj()
    both = np.stack([0.5 * residual + 0j, mask * residual], 1).astype(np.complex64)
    both = scipy.fft.ifft2(scipy.fft.fft2(both, (f, f)) * spectrum)[..., :n, :n]
    return np.stack([both[:, 0].real, both[:, 1].real, both[:, 1].imag], 1)


def features(stokes, back, s0):
    """A network's input, with S0 as `s0` has it, and rms(S0) of every frame."""
    rms = np.sqrt((stokes[:, :1] ** 2).mean((2, 3), keepdims=True))
    planes = np.concatenate([s0, stokes[:, 1:], back], 1) / rms
    for k, (_, scale, offset) in enumerate(network.INPUTS):
        planes[:, k] = scale * planes[:, k] + offset
    return planes, rms


def power_of(psf):
    """|K|²/max|K|² of each frequency of a tile, [T, T]."""
    n = psf.shape[0]
    big = np.zeros((network.TILE,) * 2, np.float32)
    big[:n, :n] = psf
    power = abs(scipy.fft.fft2(big)) ** 2
    return power / power.max()


def kept(d, power):
    """The part of corrections [B, 2, T, T] that is added: what would show in the readings, stage I has found."""
    hides = VISIBLE / (VISIBLE + power.float())
    return torch.fft.ifft2(torch.fft.fft2(d.float()) * hides).real


def load(path, wanted=None):
    """Inputs [F, 6, T, T], wanted outputs [F, 2, T, T] in the network's unit, `power_of` the PSF [F, 1, T, T] and sources; f16 tiles. Of
    checks in which something was undone also what the answer lacked before that, [F, 2, T, T]."""
    z = np.load(path)
    keep = [k for k, source in enumerate(z["source"]) if wanted is None or source in wanted]
    stokes, truth, residual = (np.float32(z[name][keep]) for name in ("stokes", "truth", "residual"))
    s0 = np.float32(z["placed"][keep])[:, None] if "placed" in z else stokes[:, :1]
    x, rms = features(stokes, back_projected(residual, z["psf"], z["mask"]), s0)
    y = (truth - stokes)[:, 1:] / (rms * network.SCALE)
    power = np.broadcast_to(np.float16(power_of(z["psf"])), (len(keep), 1, network.TILE, network.TILE))
    lacks = [np.float16(tile((truth - np.float32(z["given"][keep]))[:, 1:] / (rms * network.SCALE)))] if "given" in z else []
    return np.float16(tile(x)), np.float16(tile(y)), power, z["source"][keep], *lacks


class Frames:
    """What a network learns from: inputs, wanted outputs and the power of PSFs, of the frames `chosen`; on disk, where they are many."""

    def __init__(self, xs, ys, powers, chosen, of=lambda k: k):
        self.xs, self.ys, self.powers, self.chosen, self.of = xs, ys, powers, chosen, of

    def __len__(self):
        return len(self.chosen)

    def __getitem__(self, picked):
        k = self.chosen[picked]
        return [torch.from_numpy(np.float32(v)) for v in (self.xs[k], self.ys[k], self.powers[self.of(k)])]


def gather(data):
    """One array of each kind in DATA/gathered, of all of DATA/train, which every process maps: together they need memory for one."""
    whole, part = data / "gathered", data / "gathered.part"
    if not whole.exists():
        part.mkdir(exist_ok=True)
        files, arrays, sources = sorted(data.glob("train/????.npz")), None, []
        for k, file in enumerate(files):
            x, y, power, source = load(file)
            if arrays is None:
                arrays = [np.lib.format.open_memmap(part / f"{name}.npy", "w+", np.float16, (len(files) * n, *v.shape[1:]))
                          for name, v, n in (("x", x, len(x)), ("y", y, len(x)), ("power", power, 1))]
            for array, v in zip(arrays, (x, y, power[:1])):
                array[k * len(v):(k + 1) * len(v)] = v
            sources.extend(source)
        np.save(part / "source.npy", np.array(sources))
        part.replace(whole)
    return [np.load(whole / f"{name}.npy", mmap_mode="r") for name in ("x", "y", "power", "source")]


def augmented(x, y, power, generator):
    """Mirrored and transposed frames, of planes that come in threes: a mirror turns S2 into -S2, the diagonal S1 into -S1. And the
    power of their PSF, where frequency 0 stays where it is."""
    triples = x.shape[1] // 3
    flipped = lambda v, planes: v * torch.tensor(planes).reshape(1, -1, 1, 1)
    for dim in (2, 3):
        if torch.rand((), generator=generator) < 0.5:
            x, y = flipped(x.flip(dim), [1, 1, -1] * triples), flipped(y.flip(dim), [1, -1])
            power = power.flip(dim).roll(1, dim)
    if torch.rand((), generator=generator) < 0.5:
        x, y, power = flipped(x.mT, [1, -1, 1] * triples), flipped(y.mT, [-1, 1]), power.mT
    return x, y, power


def polarized(x):
    """S0, S1, S2 over rms(S0) of tiles without their margin, from a network's input."""
    inner = x[:, :3][INNER].float()
    return torch.stack([(inner[:, k] - offset) / factor for k, (_, factor, offset) in enumerate(network.INPUTS[:3])], 1)


def wrong_angle(l, truth, s0):
    """The AoLP error of every frame [2·rad], in the mean over pixels whose light and polarization are not too weak to have one."""
    across = l[:, 0] * truth[:, 1] - l[:, 1] * truth[:, 0]
    along = (l * truth).sum(1)
    counted = (truth.square().sum(1) > (0.1 * s0) ** 2) & (s0 > 0.1)
    angle = torch.atan2(across, along + 1e-6 * (along == 0))
    return (angle.abs() * counted).sum((1, 2)) / counted.sum((1, 2)).clamp(min=1)


def judge(net, checks, learned):
    """For every check the gain in PSNR of S1 and S2 [dB] and the change of the AoLP error, scene by scene: against what the network
    starts from, or, with a fifth member of the check, against that which lacks so much."""
    out = {}
    for name, (x, y, power, sources, *lacks) in checks.items():
        x, y, power, lacks = (torch.from_numpy(np.float32(v)) for v in (x, y, power, *(lacks or [y])))
        with torch.no_grad():
            d = torch.cat([kept(net(x[k:k + 1], power[k:k + 1]), power[k:k + 1]) for k in range(len(x))])
        stokes, d, y, lacks = polarized(x), *(network.SCALE * v[INNER] for v in (d, y, lacks))
        s0, truth = stokes[:, :1], stokes[:, 1:] + y
        before, after = truth - lacks, stokes[:, 1:] + d
        after = after * (s0 / after.norm(dim=1, keepdim=True).clamp(min=1e-6)).clamp(max=1)
        square = lambda v: ((v - truth) ** 2).mean((1, 2, 3))
        gain = 10 * torch.log10(square(before) / square(after))
        wrong = [wrong_angle(v, truth, s0[:, 0]) for v in (before, after)]
        aolp = (wrong[1] / wrong[0] - 1).mean()  # all scenes alike
        degrees = wrong[1].mean() / wrong[0].mean() - 1  # weak polarization weighs most
        by_scene = {str(s): round(float(gain[torch.from_numpy(sources == s)].mean()), 3) for s in dict.fromkeys(sources)}
        unseen = [g for s, g in by_scene.items() if s not in learned]
        out[name] = {"all": round(float(gain.mean()), 3), "unseen": round(float(np.mean(unseen)), 3) if unseen else None,
                     "least": min(unseen or by_scene.values()), "aolp": round(float(aolp), 3), "degrees": round(float(degrees), 3),
                     "scenes": by_scene}
    return out


def show(result):
    for name, r in result.items():
        unseen = "" if r["unseen"] is None else f" unseen {r['unseen']:+.2f}"
        print(f"  {name:10} all {r['all']:+.2f}{unseen} dB, least {r['least']:+.2f}, AoLP {100 * r['aolp']:+.1f} % "
              f"(degrees {100 * r['degrees']:+.1f} %)  "
              + " ".join(f"{s} {g:+.2f}" for s, g in r["scenes"].items()), flush=True)


def fit(net, frames, *, steps, batch, rate, seed, report):
    """Trains `net` on `frames`; before, now and then and at the end, `report(net, step)` with the mean of its last weights."""
    device = next(net.parameters()).device
    mean = torch.optim.swa_utils.AveragedModel(net, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.997))
    optimizer = torch.optim.AdamW(net.parameters(), rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, steps, pct_start=0.05)
    generator = torch.Generator().manual_seed(seed)
    report(net.cpu().eval(), 0)
    net.to(device).train()
    start, gains, order = time.time(), [], torch.empty(0, dtype=torch.long)
    for step in range(1, steps + 1):
        if len(order) < batch:
            order = torch.randperm(len(frames), generator=generator)
        picked, order = order[:batch], order[batch:]
        x, y, power = (v.to(device) for v in augmented(*frames[picked.numpy()], generator))
        # Processors without arithmetic of 16 bits imitate it, at a third of the speed.
        with torch.autocast(device.type, dtype=torch.bfloat16, enabled=device.type == "cuda"):
            d = net(x, power)
        d = kept(d, power)
        # What is left of the error, of every frame alike, whatever its brightness and however well stage I did. Not in decibels:
        # those would let what is gained in smooth scenes pay for what is spoilt in others. Squared, so that most is learned from
        # frames in which much is left.
        before, after = (v.pow(2).mean((1, 2, 3)) + 1e-5 for v in (y, d - y))
        loss = (after / before).square().mean()
        gains.append(10 * torch.log10(before / after).mean().item())
        # And so the error of the angle, which dark and weakly polarized parts have a say in too.
        stokes = polarized(x)
        truth = stokes[:, 1:] + network.SCALE * y[INNER]
        angles = [wrong_angle(v, truth, stokes[:, 0]) + 1e-3 for v in (stokes[:, 1:] + network.SCALE * d[INNER], stokes[:, 1:])]
        loss = loss + ANGLE * (angles[0] / angles[1]).mean()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        mean.update_parameters(net)
        if step % 100 == 0:
            print(f"{step}: gain {np.mean(gains[-100:]):.3f} dB, {(time.time() - start) / step:.2f} s a step", flush=True)
        if step % 1000 == 0 or step == steps:
            report(mean.module.cpu().eval(), step)
            mean.to(device)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path, nargs="?")
    parser.add_argument("--size", choices=network.SIZES, default="default")
    parser.add_argument("--folds", choices=["A", "B", "AB"], default="AB")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--rate", type=float, default=2e-3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", type=Path)
    parser.add_argument("--bytes", action="store_true")
    a = parser.parse_args()
    torch.manual_seed(a.seed)
    torch.set_num_threads(1)
    learned = {"procedural", *(name for fold in a.folds for name in Measured.FOLDS[fold])}
    xs, ys, powers, sources = gather(a.data)
    if a.out is None:
        return
    each = len(xs) // len(powers)
    frames = Frames(xs, ys, powers, np.flatnonzero(np.isin(sources, list(learned))), lambda k: k // each)
    checks = {path.stem: load(path) for path in sorted(a.data.glob("check/*.npz"))}
    net = network.Mixer(*network.SIZES[a.size])
    start = torch.load(a.start, weights_only=True) if a.start else {"steps": 0}
    if a.start:
        net.load_state_dict(start["weights"])
    macs, parameters = network.cost(net)
    if a.bytes:
        network.in_bytes(net)
    net.to("cuda" if torch.cuda.is_available() else "cpu")
    print(f"{len(frames)} frames, {macs / 1e9:.3f} GMAC, {parameters / 1e3:.0f} k parameters", flush=True)
    part = a.out.with_suffix(".part")

    def report(mean, step):
        result = judge(mean, checks, learned)
        show(result)
        weights = {name: v for name, v in mean.state_dict().items() if not name.endswith(".ranges")}
        torch.save({"weights": weights, "size": a.size, "folds": a.folds, "steps": start["steps"] + step, "batch": a.batch, "seed": a.seed,
                    "frames": len(frames), "macs": macs, "parameters": parameters, "checks": json.dumps(result)}, part)

    fit(net, frames, steps=a.steps, batch=a.batch, rate=a.rate, seed=a.seed, report=report)
    part.replace(a.out)


if __name__ == "__main__":
    main()
