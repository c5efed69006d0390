#!/usr/bin/env python3
"""Real captures with and without the light from beyond the frame.

  field.py PROGRAM DIR WORK     DIR: the lensless learning data set (see real_bundles.py pairs)

Each lensless frame is solved without its photograph, once as its bundle says and once as if a field stop ended the scene at the frame. Printed are the share
of light from beyond the frame, the residual over the noise, and the correlation of the green intensity with the photograph that an ordinary camera took, at
the best shift of up to 10 pixels. Needs numpy and pillow.
"""
import json
import pathlib
import shutil
import subprocess
import sys

import numpy as np

SHIFTS = range(-10, 11)
BORDER = 20


def correlation(image, photograph):
    """The largest correlation over shifts, the image's border left out."""
    inner = image[BORDER:-BORDER, BORDER:-BORDER]
    height, width = inner.shape
    shifted = (photograph[BORDER + dy:BORDER + dy + height, BORDER + dx:BORDER + dx + width] for dy in SHIFTS for dx in SHIFTS)
    return max(np.corrcoef(inner.ravel(), view.ravel())[0, 1] for view in shifted)


def main():
    program, data, work = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
    bundles = {"scene goes on": work / "open", "ends at frame": work / "stopped"}
    here = pathlib.Path(__file__).resolve().parent
    subprocess.run([sys.executable, here.parent / "real_bundles.py", "pairs", data, work / "open"], check=True)
    shutil.copytree(work / "open", work / "stopped", dirs_exist_ok=True)
    with open(work / "stopped" / "calibration.toml", "a") as description:
        description.write("field = { margin = 0 }\n")
    print(f"{'capture':10} {'light from beyond':>18} {'residual/noise':>23} {'correlation':>23}")
    for raw in sorted((work / "open").glob("*_raw.npy")):
        name, figures = raw.name.removesuffix("_raw.npy"), []
        photograph = np.load(work / "open" / f"{name}_guide.npy")[1].astype(float)
        for what, bundle in bundles.items():
            out = bundle / f"{name}.out"
            subprocess.run([program, "reconstruct", "--calibration", bundle, "--raw", raw, "--out", out, "--fusion", "off", "--force"], check=True,
                           capture_output=True)
            report = json.loads((out / "report.json").read_text())
            image = np.load(out / "stokes.npy").reshape(3, -1, *photograph.shape)[1, 0].astype(float)
            figures.append((report["field"]["light_from_beyond"], report["figures"]["residual_over_noise"], correlation(image, photograph)))
        (light, residual, likeness), (_, stopped, unlike) = figures
        print(f"{name:10} {light:18.3f} {residual:12.2f} ({stopped:.2f}) {likeness:16.3f} ({unlike:.3f})")
    print("in brackets: as if the scene ended at the frame")


if __name__ == "__main__":
    main()
