#!/usr/bin/env python3
"""A trained network as a model folder: ONNX in f32 and int8, manifest, model card, and the golden answers of the tests.

    ship.py DATA RUN.pt FOLDER [--twin RUN.pt] --golden DIR --date YYYY-MM-DD
"""
import argparse
import copy
from pathlib import Path

import numpy as np
import torch

import captures
import network
import train
from export import export, session

# Shares of what was learned that are shipped. On scenes of a kind that they have not seen networks overstate how smooth L is, and that
# its detail is the guide's. The readings' own shares of that detail stay as they are.
BELIEVED = ((network.SMOOTHING, 0.7), (network.UNIFORM, 0.6))
TEXT = {
    "default": "Mixes stage I, its blurs and the guide's detail; for 250x250",
    "preview": "The same with half the arithmetic, for previews",
}


class Answers:
    """A network whose trunk runs in ONNX Runtime."""

    def __init__(self, net, path):
        self.net, self.session = net, session(path)

    def __call__(self, x, power):
        with torch.no_grad():
            return self.net.mixed(x, power, lambda seen: torch.from_numpy(self.session.run(None, {"x": seen.numpy()})[0]))


def best_shares(net, checks, learned):
    """With what factors the part of the answer made of the guide's detail and the smoothing part would have come closest to the
    truth, in the mean of the scenes that are not `learned`, for every check."""
    detailed = copy.deepcopy(net)
    detailed.believe(network.SMOOTHING, 0)
    out = {}
    for name, (x, y, power, sources, *_) in checks.items():
        found = []
        for k in [k for k, source in enumerate(sources) if source not in learned]:
            x_, y_, power_ = (torch.from_numpy(np.float32(v[k:k + 1])) for v in (x, y, power))
            with torch.no_grad():
                both, detail = (train.kept(n(x_, power_), power_)[train.INNER].flatten() for n in (net, detailed))
            parts = torch.stack([detail, both - detail])
            found.append(torch.linalg.solve(parts @ parts.T, parts @ y_[train.INNER].flatten()))
        out[name] = torch.stack(found).mean(0).tolist()
    return out


def card(name, run, twin, held, results, sizes, captured):
    """The model card: what it is, what it learned from, and what it is worth, above all on scenes that `twin` has not seen: the same
    training without them; `captured` are the checks' files."""
    folds = train.Measured.FOLDS
    scenes = lambda which: [s for fold in which for s in folds[fold]]
    held_out = scenes(fold for fold in "AB" if fold not in twin["folds"])
    lines = [
        f"# {name}", "",
        f"{TEXT[run['size']]}. {run['macs'] / 1e9:.2f} GMAC for a tile of {network.TILE} × {network.TILE} pixels, "
        f"{run['parameters'] / 1e3:.0f} thousand parameters, "
        + ", ".join(f"{size / 1e3:.0f} kB in {precision}" for precision, size in sizes.items()) + ".", "",
        f"*Data*: {run['frames']} frames of 250 × 250 pixels: procedural scenes and random views of {', '.join(scenes(run['folds']))} "
        "(polanalyser, MIT; underwater, BSD), behind random diffusers of 40 to 115 pixels and random masks, solved by this program with 5, "
        "10 or 20 iterations, half of them with noise of .005 to .013, a guide off by up to 4 pixels, a drifted point-spread function, or "
        "a guide of another gamma.", "",
        "*Training*: `scripts/train/run.sh`, seeded. *Licence*: MIT OR Apache-2.0.", "",
        "Gain over stage I at 10 iterations, 250 × 250 pixels, 4 angles, noise .002: S1/S2 PSNR in the mean and in the worst scene, and "
        "the change of the AoLP error, all scenes alike. *Held out*: " + ", ".join(held_out) + ", by a twin of the network that has seen nothing of them "
        "(its AoLP over all eight scenes). The other columns are over all eight scenes"
        + (", all of which this network has seen views of." if run["folds"] != twin["folds"] else ", half of which it has seen views of."), "",
        "*Told*: what stage I itself gains when it knows the true point-spread function (but for a shift of it, which is one of the scene), "
        "extinction and guide: what undoing the flaw is worth, all eight scenes. *Undone*: what the program undoes of it by itself, by refitting "
        "the size of the point-spread function and by aligning the guide; it counts in the gains, of all scenes and of those held out. "
        f"*Longer*: what it gains with {captures.LONGER} iterations in place of 10, on the scenes held out.", "",
        "| | told | undone | longer | held out: mean | worst | AoLP | " + " | ".join(f"{p}: mean | worst | AoLP" for p in results) + " |",
        "|---" * (7 + 3 * len(results)) + "|",
    ]
    rows = {}
    for flaw, out in held.items():
        rows[flaw] = [*(captures.gain(captured[flaw], what) for what in ("undone", "stokes")), captures.gain(captured[flaw], "longer", held_out),
                      out["unseen"], out["least"], out["aolp"]]
        for r in (result[flaw] for result in results.values()):
            rows[flaw] += [r["all"], min(r["scenes"].values()), r["aolp"]]
    rows["the five flaws, in the mean"] = np.mean([rows[flaw] for flaw in (*captures.FLAWS, "extinction")], 0)
    for name, row in rows.items():
        # the angle's change is every third column from the sixth on
        cells = [f"{100 * v:+.1f} %" if k > 3 and k % 3 == 2 else f"{v:+.2f} dB" for k, v in enumerate(row)]
        lines.append(f"| {name.replace('small', 'PSF half as wide')} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--twin", type=Path, help="the run that held scenes back; default RUN")
    parser.add_argument("--golden", type=Path, required=True)
    parser.add_argument("--date", required=True)
    a = parser.parse_args()
    run, twin = (torch.load(path, weights_only=True) for path in (a.run, a.twin or a.run))
    net, held_out = (network.Mixer(*network.SIZES[r["size"]]) for r in (run, twin))
    net.load_state_dict(run["weights"])
    held_out.load_state_dict(twin["weights"])
    captured = {path.stem: path for path in sorted(a.data.glob("check/*.npz"))}
    checks = {name: train.load(path) for name, path in captured.items()}
    learned, known = ({"procedural", *(s for fold in r["folds"] for s in train.Measured.FOLDS[fold])} for r in (run, twin))
    for check, shares in best_shares(held_out, checks, known).items():
        print(f"  {check:10} held out, best factors: {shares[0]:.2f} of what the guide's detail adds, {shares[1]:.2f} of what smooths", flush=True)
    for believed in BELIEVED:
        net.believe(*believed)
        held_out.believe(*believed)
    run["macs"], run["parameters"] = network.cost(net)
    paths = sorted(a.data.glob("train/????.npz"))
    samples = [train.load(path, learned) for path in paths[:: max(1, len(paths) // 32)]]
    samples = [[torch.from_numpy(np.float32(v[k:k + 1])) for v in (x, power)] for x, _, power, _ in samples for k in range(2)]
    with torch.no_grad():
        samples = [net.candidates(x, power)[2].numpy() for x, power in samples]
    held = train.judge(held_out, checks, known)
    metrics = {"held_out_s12_psnr_gain_db": held["nominal"]["unseen"], "macs": run["macs"], "parameters": run["parameters"]}
    export(network.Trunk(net), a.folder, name=a.folder.name, description=TEXT[run["size"]], licence="MIT OR Apache-2.0", metrics=metrics,
           trained={"date": a.date, "data": f"{run['frames']} frames, see MODEL_CARD.md", "iterations": 10},
           tile=network.TILE, halo=32, multiple=net.multiple, samples=samples)
    files = {"f32": a.folder / "model.onnx", "int8": a.folder / "model-int8.onnx"}
    results = {p: train.judge(Answers(net, file), checks, learned) for p, file in files.items()}
    for precision, result in results.items():
        print(precision)
        train.show(result)
    sizes = {p: f.stat().st_size for p, f in files.items()}
    (a.folder / "MODEL_CARD.md").write_text(card(a.folder.name, run, twin, held, results, sizes, captured))
    a.golden.mkdir(parents=True, exist_ok=True)
    corners(net, a.folder, lambda precision: a.golden / f"{a.folder.name}-{precision}.npy")


def corners(net, folder, path):
    """Two corners, for borders count, of the answers to `golden_input` by the files in `folder`, as golden files."""
    for precision, file in (("f32", "model.onnx"), ("int8", "model-int8.onnx")):
        answer = Answers(net, folder / file)(*(torch.from_numpy(v) for v in golden_input())).numpy()
        np.save(path(precision), np.concatenate([answer[:, :, :32, :32], answer[:, :, -32:, -32:]], 1))


def golden_input():
    """A smooth polarized pattern and a PSF's power, of which a test can make the same from their formulas."""
    y, x = np.mgrid[:network.TILE, :network.TILE].astype(np.float32)
    wave = lambda a, b, c: np.sin(a * x + b * y + c)
    s0 = 1 + 0.3 * wave(0.11, 0.05, 0) + 0.1 * wave(0.7, -0.4, 1)
    planes = [s0, 0.2 * s0 * wave(0.03, 0.02, 2), 0.2 * s0 * wave(-0.02, 0.04, 3), 0.03 * wave(0.09, 0.1, 4),
              # The residual contains detail of the guide.
              0.03 * wave(0.08, -0.1, 5) + 0.2 * wave(0.7, -0.4, 1) * wave(0.03, 0.02, 2),
              0.03 * wave(0.1, 0.03, 6) + 0.2 * wave(0.7, -0.4, 1) * wave(-0.02, 0.04, 3)]
    f = np.fft.fftfreq(network.TILE, 1 / network.TILE)
    power = 1 / (1 + (f[:, None] ** 2 + f[None] ** 2) / 100)
    return np.stack(planes)[None].astype(np.float32), power[None, None].astype(np.float32)


if __name__ == "__main__":
    main()
