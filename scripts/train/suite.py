#!/usr/bin/env python3
"""Bundles of the measured scenes, for `stokescope bench --suite OUT`: captures simulated here, apart from the program.

    suite.py OUT --scenes DIR [--unlike] [--surround] [--size N] [--noise X] [--guide HOW] [--psf photographed|speckle] [--seed N]

Of every scene of DIR (see Measured in scenes.py) OUT/SCENE holds calibration.toml, psf.npy, raw.npy, truth.npy and, but for `--guide
none`, guide.npy: the whole scene at N × N pixels in f32, behind a diffuser of .44 N pixels and ideal stripes of 4 angles. Noise of the
guide is .005. With `--unlike` the scenes are those of unlike.py, with `--surround` they go on beyond the frame, where the guide sees them.
"""
import argparse
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, rotate

import captures
import scenes
import unlike

SIDE, STRIPES, GUIDE_NOISE = 0.44, 16, 0.005


def darker_corners(guide):
    """Vignetting: 40 % in the corners."""
    y, x = (np.linspace(-1, 1, n) for n in guide.shape)
    return guide * (1 - 0.2 * (y[:, None] ** 2 + x**2))


def two_depths(guide, far):
    """Parallax: the left half lies far pixels to the right, the right half as many to the left."""
    left = np.arange(guide.shape[1]) < guide.shape[1] // 2
    return np.where(left, captures.moved(guide, far, 0), captures.moved(guide, -far, 0))


def colored(guide, weights):
    """Red, green and blue of surfaces of many colours, which a mono sensor of these weights sees as the guide."""
    y, x = np.mgrid[0:1:1j * guide.shape[0], 0:1:1j * guide.shape[1]]
    shades = [1 + 0.8 * np.sin(a * x + b * y) for a, b in ((31, 9), (-17, 23), (8, -37))]
    mixed = sum(w * shade for w, shade in zip(weights, shades))
    return np.stack([guide * shade / mixed for shade in shades])


def write_bundle(folder, psf, noise, angles, seen):
    """The description of the simulated camera, whose guide sees `seen` pixels beyond the frame, and its PSF."""
    np.save(folder / "psf.npy", psf.astype(np.float32))
    (folder / "calibration.toml").write_text(f"""version = 1
name = "simulated"
sensor = {{ width = {psf.shape[-1]}, height = {psf.shape[-1]}, channels = 1 }}
noise = {{ read = {noise} }}
psf = {{ file = "psf.npy" }}
mask = {{ kind = "stripes", angles_deg = {[0, 45, 90, 135][:angles]}, stripes = {STRIPES} }}
guide = {{ homography = [1, 0, {seen}, 0, 1, {seen}, 0, 0, 1] }}
""")


# Guides, perfect and otherwise.
GUIDES = {
    "perfect": lambda g: g,
    "shifted": lambda g: captures.moved(g, 3, -5),
    "turned": lambda g: rotate(captures.moved(g, 1, -2), 1, reshape=False, mode="nearest"),
    "bent": lambda g: g**1.02,
    "contrasty": lambda g: 0.7 * g**1.3,
    "flat": lambda g: g**0.8,
    "encoded": lambda g: np.where(g < 0.0031308, 12.92 * g, 1.055 * g ** (1 / 2.4) - 0.055),  # as sRGB files are
    "vignetted": darker_corners,
    "parallax2": lambda g: two_depths(g, 2),
    "parallax4": lambda g: two_depths(g, 4),
    "colors": lambda g: colored(g, (0.15, 0.6, 0.25)),
    "red": lambda g: colored(g, (0.8, 0.15, 0.05)),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--unlike", action="store_true")
    parser.add_argument("--surround", action="store_true")
    parser.add_argument("--size", type=int, default=250)
    parser.add_argument("--noise", type=float, default=0.002, help="standard deviation of the readings")
    parser.add_argument("--guide", choices=[*GUIDES, "none"], default="perfect")
    parser.add_argument("--psf", choices=["photographed", "speckle"], default="photographed")
    parser.add_argument("--seed", type=int, default=1)
    a = parser.parse_args()
    measured, diffusers = scenes.Measured(a.scenes), captures.Diffusers(a.scenes)
    if not measured.files or diffusers.photo is None:
        parser.error(f"{a.scenes}: needs polanalyser/*_IMX250MZR.png or underwater/*/, and diffusercam/psf_sample.tif")
    if a.psf == "photographed":
        psf = diffusers.photographed(SIDE, a.size)
    else:
        light = np.random.default_rng(a.seed).exponential(size=(400, 400))
        psf = captures.disc(gaussian_filter(light, 4), round(SIDE * a.size), a.size)
    angles = captures.ANGLES[4]
    mask = captures.striped(a.size, len(angles), STRIPES)
    beyond = captures.MARGIN if a.surround else 0
    side = a.size + 2 * beyond
    chosen = unlike.made(side) if a.unlike else {name: measured.standard(name, side) for name in sorted(measured.files)}
    for name, field in chosen.items():
        rng = np.random.default_rng(a.seed)
        s0, s1, s2 = captures.middle(field, a.size)
        raw = captures.readings(field[None], psf, mask)[0]
        raw = raw + rng.normal(0, a.noise, raw.shape)
        images = {"raw": raw, "truth": np.stack([(s0 + s1 * np.cos(2 * t) + s2 * np.sin(2 * t)) / 2 for t in angles])}
        if a.guide in GUIDES:
            guide = np.clip(field[0] + rng.normal(0, GUIDE_NOISE, field[0].shape), 0, None)
            images["guide"] = np.clip(GUIDES[a.guide](guide), 0, None)
        folder = a.out / name
        folder.mkdir(parents=True, exist_ok=True)
        write_bundle(folder, psf, a.noise, len(angles), beyond)
        (folder / "guide.npy").unlink(missing_ok=True)  # of an earlier run
        for file, image in images.items():
            np.save(folder / f"{file}.npy", image.astype(np.float32))


if __name__ == "__main__":
    main()
