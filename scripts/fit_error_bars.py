#!/usr/bin/env python3
"""Fits the constants of `crates/core/src/uncertainty.rs` and prints how well they predict errors of scenes left out.

Each argument is CONDITION=BUNDLE=RESULT: any name for the kind of capture, a bundle with `truth.npy` (intensities behind the mask's
polarizers, [P, H, W]) and the folder that `stokescope reconstruct` wrote for it. Scenes are told apart by the name of the bundle's folder.
Fit captures with a guide and captures without one in two runs: the program has constants of their own for each.

The variance is a non-negative sum of local quantities of the result. Constants maximise the likelihood of a Student t distribution, with
equal weight for each capture, and are then scaled so that the median capture has 68 % of its pixels within one sigma.

Needs NumPy. Example:
  scripts/fit_error_bars.py plain=bundles/camera=results/camera plain=bundles/fruits=results/fruits
"""
import json
import sys
from pathlib import Path

import numpy as np

TERMS = ["noise", "polarization", "mixed", "intensity", "light"]
COMPONENTS = {"S0": [0], "S1, S2": [1, 2]}


def box(x, r):
    """Mean over a square of 2 r + 1 pixels a side, of the part within the image."""
    for axis in (-1, -2):
        y = np.moveaxis(x, axis, 0)
        total = np.concatenate([np.zeros_like(y[:1]), np.cumsum(y, 0)])
        i = np.arange(len(y))
        first, last = np.maximum(i - r, 0), np.minimum(i + r + 1, len(y))
        x = np.moveaxis((total[last] - total[first]) / (last - first).reshape((-1,) + (1,) * (y.ndim - 1)), 0, axis)
    return x


def energy(x, r):
    """Local energy of an image less its mean over 2 r + 1 pixels."""
    return box((x - box(x, r)) ** 2, 2)


def stokes_of(intensities):
    """S0, S1, S2 from intensities behind polarizers at 0, 45, 90 (, 135) degrees."""
    t = np.deg2rad(45.0 * np.arange(len(intensities)))
    analyzers = 0.5 * np.stack([np.ones_like(t), np.cos(2 * t), np.sin(2 * t)], 1)
    return np.tensordot(np.linalg.pinv(analyzers), intensities, 1)


def load(argument):
    condition, bundle, result = argument.split("=")
    stokes = np.load(Path(result) / "stokes.npy").astype(float)
    truth = stokes_of(np.load(Path(bundle) / "truth.npy").astype(float))
    noise = json.loads((Path(result) / "report.json").read_text())["residual_rms"]
    polarization = energy(stokes[1], 3) + energy(stokes[2], 3)
    terms = [
        np.full(stokes.shape[1:], noise**2),
        polarization,
        np.sqrt(polarization * energy(stokes[0], 3)),
        energy(stokes[0], 1),
        box(stokes[0] ** 2, 2),
    ]
    return {"condition": condition, "scene": Path(bundle).name, "error": stokes - truth, "terms": np.stack(terms)}


def fit(items, components, rounds=400, nu=4.0):
    """Constants of the terms for these components."""
    terms = np.concatenate([i["terms"][:, ::3, ::3].reshape(len(TERMS), -1) for i in items], 1)
    square = np.concatenate([np.mean(i["error"][components, ::3, ::3] ** 2, 0).ravel() for i in items])
    scale = terms.mean(1)
    terms /= scale[:, None]
    w = np.full(len(TERMS), square.mean() / len(TERMS))
    for _ in range(rounds):
        v = w @ terms + 1e-12
        u = (nu + 2) / (nu + 2 * square / v)
        w *= np.sqrt((terms @ (u * square / v**2)) / (terms @ (1 / v)))
    w /= scale
    excess = [np.quantile(np.abs(i["error"][components]) / sigma(w, i), 0.68) for i in items]
    return w * np.median(excess) ** 2


def sigma(w, item):
    return np.sqrt(np.tensordot(w, item["terms"], 1) + 1e-14)


def blocks(x):
    """Means over blocks of 8 x 8 pixels."""
    h, w = (n // 8 * 8 for n in x.shape)
    return x[:h, :w].reshape(h // 8, 8, w // 8, 8).mean((1, 3)).ravel()


def rank_correlation(a, b):
    return np.corrcoef(a.argsort().argsort(), b.argsort().argsort())[0, 1]


def judge(w, item, components):
    """Share of pixels within one sigma for each component, and rank correlation of sigma and mean error over blocks."""
    s = sigma(w, item)
    coverage = [np.mean(np.abs(item["error"][c]) < s) for c in components]
    rank = [rank_correlation(blocks(s), blocks(np.abs(item["error"][c]))) for c in components]
    return coverage, np.mean(rank)


def main(arguments):
    if not arguments or any(a.count("=") != 2 for a in arguments):
        sys.exit(__doc__)
    items = [load(a) for a in arguments]
    for name, components in COMPONENTS.items():
        print(f"{name}: constants", " ".join(f"{t} {v:.3g}" for t, v in zip(TERMS, fit(items, components))))
        figures = {}
        for scene in sorted({i["scene"] for i in items}):
            others = [i for i in items if i["scene"] != scene]
            if not others:
                sys.exit("one scene alone cannot be left out; give bundles of two scenes or more")
            w = fit(others, components)
            for item in (i for i in items if i["scene"] == scene):
                figures.setdefault(item["condition"], []).append((scene, *judge(w, item, components)))
        for condition, rows in figures.items():
            coverage, ranks = np.array([r[1] for r in rows]), [r[2] for r in rows]
            least = rows[int(np.argmin(coverage.min(1)))][0]
            most = rows[int(np.argmax(coverage.max(1)))][0]
            print(f"  {condition}, scene left out: within 1 sigma {coverage.mean():.1%}, "
                  f"from {coverage.min():.1%} ({least}) to {coverage.max():.1%} ({most}); rank correlation {np.mean(ranks):.2f}")


main(sys.argv[1:])
