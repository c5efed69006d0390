#!/usr/bin/env python3
"""Device bundles and frames from public lensless captures, to run the program on real light.

  real_bundles.py diffusercam DIR OUT [--size WxH]    psf_sample.tif and rawdata_hand_sample.tif of the DiffuserCam tutorial
  real_bundles.py pairs DIR OUT                       diffuser/*.npy and lensed/*.npy of the lensless learning data set, with the
                                                      psf_estimated_270x480_rgb.npy and background_rgb.npy beside them

Needs numpy and pillow. No polarizer was used in either, so the bundles' mask is of kind "none".
"""
import argparse
import pathlib

import numpy as np
from PIL import Image


def bundle(out, name, psf, read):
    channels, (height, width) = (1 if psf.ndim == 2 else 3), psf.shape[-2:]
    out.mkdir(parents=True, exist_ok=True)
    np.save(out / "psf.npy", psf.astype(np.float32))
    (out / "calibration.toml").write_text(f"""version = 1
name = "{name}"
sensor = {{ width = {width}, height = {height}, channels = {channels} }}
noise = {{ read = {read} }}
psf = {{ file = "psf.npy" }}
mask = {{ kind = "none" }}
""")


def diffusercam(a):
    width, height = map(int, a.size.split("x"))

    def load(name):
        image = np.asarray(Image.open(a.dir / name), dtype=np.float64)
        # A corner that no light of the scene reaches gives the background.
        image = (image - image[5:15, 5:15].mean()) / 65535
        full_h, full_w = image.shape
        scale = min(full_h / height, full_w / width)
        crop_h, crop_w = round(height * scale), round(width * scale)
        top, left = (full_h - crop_h) // 2, (full_w - crop_w) // 2
        image = image[top:top + crop_h, left:left + crop_w].astype(np.float32)
        return np.asarray(Image.fromarray(image, "F").resize((width, height), Image.BOX))

    bundle(a.out, "DiffuserCam tutorial", np.clip(load("psf_sample.tif"), 0, None), 0.001)
    np.save(a.out / "raw.npy", load("rawdata_hand_sample.tif"))


def pairs(a):
    planar = lambda x: np.ascontiguousarray(np.moveaxis(x, -1, 0), dtype=np.float32)
    bundle(a.out, "lensless learning", planar(np.load(a.dir / "psf_estimated_270x480_rgb.npy")), 0.002)
    background = np.load(a.dir / "background_rgb.npy")
    for path in sorted((a.dir / "diffuser").glob("*.npy")):
        np.save(a.out / f"{path.stem}_raw.npy", planar(np.load(path) - background))
        np.save(a.out / f"{path.stem}_guide.npy", planar(np.load(a.dir / "lensed" / path.name)))


def main():
    ap = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    sub = ap.add_subparsers(dest="what", required=True)
    for name, run in (("diffusercam", diffusercam), ("pairs", pairs)):
        p = sub.add_parser(name)
        p.add_argument("dir", type=pathlib.Path)
        p.add_argument("out", type=pathlib.Path)
        p.set_defaults(run=run)
        if name == "diffusercam":
            p.add_argument("--size", default="400x300", metavar="WxH")
    a = ap.parse_args()
    a.run(a)


if __name__ == "__main__":
    main()
