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

TERMS = ["noise", "degree", "polarization", "intensity", "texture"]
AREA = 16
# Share of the residual squared that is in every variance: no error is zero.
LEAST_NOISE = 0.1
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


def smooth(x, r):
    """Mean over 2 r + 1 pixels, twice."""
    return box(box(x, r), r)


def stokes_of(intensities):
    """S0, S1, S2 from intensities behind polarizers at 0, 45, 90 (, 135) degrees."""
    t = np.deg2rad(45.0 * np.arange(len(intensities)))
    analyzers = 0.5 * np.stack([np.ones_like(t), np.cos(2 * t), np.sin(2 * t)], 1)
    return np.tensordot(np.linalg.pinv(analyzers), intensities, 1)


def load(argument):
    condition, bundle, result = argument.split("=")
    stokes = np.load(Path(result) / "stokes.npy").astype(float)
    truth = stokes_of(np.load(Path(bundle) / "truth.npy").astype(float))
    report = json.loads((Path(result) / "report.json").read_text())
    noise = report["residual_rms"]
    detail = box((smooth(stokes[0], 1) - smooth(stokes[0], 2)) ** 2, 3)
    light, polarized = box(stokes[0] ** 2, 6), box(stokes[1] ** 2 + stokes[2] ** 2, 6)
    terms = [
        np.full(stokes.shape[1:], noise**2),
        noise * np.sqrt(detail * polarized / np.maximum(light, 1e-12)),
        np.sqrt(detail * polarized),
        detail,
        sum(box((s - smooth(s, 3)) ** 2, 3) for s in stokes[1:]),
    ]
    return {
        "condition": condition,
        "scene": Path(bundle).name,
        "beyond": report["field"]["margin_px"] > 0,
        "error": stokes - truth,
        "terms": np.stack(terms).astype(np.float32),
    }


def fit(items, components, rounds=200, nu=4.0):
    """Constants of the terms for these components, and the last one: the factor of the variance where light from beyond the frame is
    modelled."""
    usual = [i for i in items if not i["beyond"]]
    w = fit_terms(usual or items, components, rounds, nu)
    scale = lambda chosen: np.median([np.quantile(np.abs(i["error"][components]) / sigma([*w, 1], i), 0.68) for i in chosen]) ** 2
    beyond = [i for i in items if i["beyond"]]
    usual = scale(usual or items)
    return [*(w * usual), scale(beyond) / usual if beyond else 1.0]


def fit_terms(items, components, rounds, nu):
    """Constants of the terms up to a common factor."""
    terms = np.concatenate([i["terms"][:, ::7, ::7].reshape(len(TERMS), -1) for i in items], 1)
    square = np.concatenate([np.mean(i["error"][components, ::7, ::7] ** 2, 0).ravel() for i in items])
    scale = terms.mean(1)
    terms /= scale[:, None]
    w = np.full(len(TERMS), square.mean() / len(TERMS))
    for _ in range(rounds):
        v = w @ terms + 1e-12
        u = (nu + 2) / (nu + 2 * square / v)
        w *= np.sqrt((terms @ (u * square / v**2)) / (terms @ (1 / v)))
    w /= scale
    w[0] = max(w[0], LEAST_NOISE)
    return w


def sigma(w, item):
    *w, beyond = w
    return np.sqrt((beyond if item["beyond"] else 1.0) * np.tensordot(w, item["terms"], 1) + 1e-14)


def blocks(x):
    """Means over blocks of 8 x 8 pixels."""
    h, w = (n // 8 * 8 for n in x.shape)
    return x[:h, :w].reshape(h // 8, 8, w // 8, 8).mean((1, 3)).ravel()


def rank_correlation(a, b):
    return np.corrcoef(a.argsort().argsort(), b.argsort().argsort())[0, 1]


def judge(w, item, components):
    """Share of pixels within one sigma for each component, rank correlation over blocks of sigma and error, the length of (S1, S2), and
    the one that would come of knowing the true mean square error of the area around each pixel."""
    s = sigma(w, item)
    coverage = [np.mean(np.abs(item["error"][c]) < s) for c in components]
    length = np.sqrt(np.sum(item["error"][components] ** 2, 0))
    return coverage, [rank_correlation(blocks(of), blocks(length)) for of in (s, np.sqrt(box(length**2, AREA)))]


def main(arguments):
    if not arguments or any(a.count("=") != 2 for a in arguments):
        sys.exit(__doc__)
    items = [load(a) for a in arguments]
    for name, components in COMPONENTS.items():
        print(f"{name}: constants", " ".join(f"{t} {v:.3g}" for t, v in zip([*TERMS, "beyond"], fit(items, components))))
        figures = {}
        for scene in sorted({i["scene"] for i in items}):
            others = [i for i in items if i["scene"] != scene]
            if not others:
                sys.exit("one scene alone cannot be left out; give bundles of two scenes or more")
            w = fit(others, components)
            for item in (i for i in items if i["scene"] == scene):
                figures.setdefault(item["condition"], []).append((scene, *judge(w, item, components)))
        print("  scene left out: condition, pixels within 1 sigma of each component [least and most of a scene], rank correlation, and "
              f"that of the true error over {2 * AREA + 1} pixels")
        for condition, rows in figures.items():
            coverage, ranks = 100 * np.array([r[1] for r in rows]), np.mean([r[2] for r in rows], 0)
            within = ", ".join(f"{c.mean():.0f} [{c.min():.0f} {c.max():.0f}] %" for c in coverage.T)
            print(f"  {condition:12} {within}  {ranks[0]:.2f}  {ranks[1]:.2f}")


main(sys.argv[1:])
