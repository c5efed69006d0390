#!/usr/bin/env python3
"""Counts right set-ups that are accused and wrong ones that are not named.

Each argument is a bundle with `raw.npy` and `guide.npy`. It is solved as it is, which must be credible, and, with --wrong, with eight
faults that people make: the verdict should be doubtful or worse and the right suspect first. The faults are made for grey bundles of
floating-point readings behind stripes.

Needs NumPy and the program (--program, default target/release/stokescope). Example:
  scripts/false_alarms.py --wrong bundles/camera bundles/fruits
"""
import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np


def solve(program, bundle):
    """Verdict, residual over noise, and suspects in words; a refusal counts as not credible, its message as the suspect."""
    with tempfile.TemporaryDirectory() as out:
        files = [f"--{kind}={bundle / kind}.npy" for kind in ("raw", "guide")]
        command = [program, "--json", "reconstruct", f"--calibration={bundle}", *files, f"--out={out}", "--threads=1", "--fusion=off"]
        run = subprocess.run(command, capture_output=True, text=True)
        report = Path(out) / "report.json"
        if not report.exists():
            return "not credible", float("inf"), [run.stderr]
        r = json.loads(report.read_text())
        return r["verdict"], r["figures"]["residual_over_noise"], [s["what"] for s in r["suspects"]] + r["warnings"]


def edit(name, change):
    def apply(bundle):
        path = bundle / f"{name}.npy"
        np.save(path, np.ascontiguousarray(change(np.load(path))).astype(np.float32))

    return apply


def configure(pattern, replacement):
    def apply(bundle):
        path = bundle / "calibration.toml"
        text, count = re.subn(pattern, replacement, path.read_text())
        assert count == 1, f"{path}: {pattern}"
        path.write_text(text)

    return apply


def scaled(image, factor):
    """An image about its middle, larger by the factor; values between pixels are interpolated."""
    for axis in (0, 1):
        n = image.shape[axis]
        at = (np.arange(n) - n // 2) / factor + n // 2
        line = lambda v: np.interp(at, np.arange(n), v, 0, 0)
        image = np.apply_along_axis(line, axis, image)
    return image


def turn_mask(bundle):
    """Stripes become rows."""
    path = bundle / "calibration.toml"
    text = path.read_text()
    angles = np.deg2rad(json.loads(re.search(r"angles_deg = (\[.*\])", text)[1]))
    stripes, n = int(re.search(r"stripes = (\d+)", text)[1]), np.load(bundle / "raw.npy").shape[0]
    rows = angles[np.arange(n) * stripes // n % len(angles)]
    np.save(bundle / "mask.npy", np.stack([np.repeat(np.cos(rows - a)[:, None] ** 2, n, 1) for a in angles]).astype(np.float32))
    path.write_text(re.sub(r"stripes = \d+", 'file = "mask.npy"', text.replace('kind = "stripes"', 'kind = "measured"')))


def halve(match):
    return f"stripes = {int(match[1]) // 2}"


def swap(match):
    first, second, third, *rest = match[1].split(", ")
    return f"angles_deg = [{', '.join([first, third, second, *rest])}]"


# Fault, how it is made, and words of the right suspect.
WRONG = [
    ("PSF transposed", edit("psf", np.transpose), "the psf file is transposed"),
    ("PSF 10 % smaller", edit("psf", lambda k: scaled(k, 0.9)), "the psf is about 1. % larger"),
    ("PSF 10 % larger", edit("psf", lambda k: scaled(k, 1.1)), "the psf is about (8|9|10) % smaller"),
    ("angles in another order", configure(r"angles_deg = \[(.*)\]", swap), "angles are in another order"),
    ("mask turned by 90°", turn_mask, "the mask is (turned|transposed)"),
    ("half as many stripes", configure(r"stripes = (\d+)", halve), "stripes are 0.5 times"),
    ("exposure of 1/50", edit("raw", lambda y: np.round((y - 0.002) * 0.02 * 255).clip(0) / 255 + 0), "too little light|no light|dark"),
    ("black level missing", edit("raw", lambda y: y + 0.06), "stand on a level"),
]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/stokescope")
    parser.add_argument("--wrong", action="store_true", help="make nine faults of each bundle too")
    parser.add_argument("bundles", nargs="+", type=Path)
    arguments = parser.parse_args()
    accused, counts = 0, {name: [0, 0] for name, _, _ in WRONG}
    for bundle in arguments.bundles:
        verdict, residual, suspects = solve(arguments.program, bundle)
        if verdict != "credible":
            accused += 1
            print(f"{bundle}: {verdict}, residual {residual:.2f} times the noise: {suspects[:1]}", flush=True)
        for name, make, words in WRONG if arguments.wrong else []:
            with tempfile.TemporaryDirectory() as copy:
                wrong = Path(shutil.copytree(bundle, Path(copy) / "bundle"))
                make(wrong)
                verdict, residual, suspects = solve(arguments.program, wrong)
            named = verdict not in ("credible", "not judged") and bool(suspects) and bool(re.search(words, suspects[0]))
            counts[name][0] += 1
            counts[name][1] += named
            if not named:
                print(f"{bundle}, {name}: {verdict}, residual {residual:.2f} times the noise: {suspects[:1]}", flush=True)
    print(f"{accused} of {len(arguments.bundles)} right set-ups accused")
    for name, (shown, named) in counts.items() if arguments.wrong else []:
        print(f"{name}: named in {named} of {shown} bundles")
    sys.exit(accused > 0)


main()
