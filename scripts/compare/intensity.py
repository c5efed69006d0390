"""Time to equal residual on a real capture without polarizers: the program beside ADMM of LenslessPiCam, used as installed.

intensity.py BUNDLE WORK     BUNDLE: made by real_bundles.py diffusercam
"""
import json
import os
import pathlib
import subprocess
import sys
import time

import numpy as np

STOKESCOPE = os.environ["STOKESCOPE"]


def residual(psf, y, x):
    """min over a scale (and a pixel of displacement: conventions of the PSF's centre differ) of |A x - y| / |y|."""
    h, w = y.shape
    big = np.zeros((2 * h, 2 * w))
    big[:h, :w] = psf / psf.sum()
    k = np.fft.rfft2(np.roll(big, (-(h // 2), -(w // 2)), (0, 1)))
    blurred = np.fft.irfft2(np.fft.rfft2(x, big.shape) * k, big.shape)
    found = []
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            ax = np.roll(blurred, (dy, dx), (0, 1))[:h, :w]
            scale = (ax * y).sum() / max((ax * ax).sum(), 1e-30)
            found.append(np.linalg.norm(scale * ax - y) / np.linalg.norm(y))
    return min(found)


def program(bundle, work, n):
    runs = []
    for _ in range(3):
        done = subprocess.run([STOKESCOPE, "--json", "reconstruct", "--calibration", bundle, "--raw", bundle / "raw.npy",
                               "--method", "stokes", "--iterations", str(n), "--threads", "1", "--out", work],
                              capture_output=True, text=True)
        if done.returncode:
            sys.exit(done.stderr.strip())
        runs.append(json.loads(done.stdout)["seconds"]["recon"])
    stokes = np.load(work / "stokes.npy")
    return sorted(runs)[1], stokes.reshape(-1, *stokes.shape[-2:])[0].astype(np.float64)


def main():
    bundle, work = map(pathlib.Path, sys.argv[1:3])
    work.mkdir(parents=True, exist_ok=True)
    try:
        import lensless
        from lensless import ADMM
    except Exception as why:  # a package that is installed but cannot be loaded is a reason to skip, whatever it raises
        print(f"skipped: LenslessPiCam comparison: import lensless: {why}")
        return
    psf = np.load(bundle / "psf.npy").astype(np.float32)
    y = np.load(bundle / "raw.npy").astype(np.float32)

    # It takes [depth, height, width, channels], the PSF scaled to unit l2 norm, the data to a peak of 1.
    try:
        solver = ADMM((psf / np.linalg.norm(psf))[None, ..., None], n_iter=100)
        solver.set_data((y / y.max())[None, ..., None])
        theirs = []
        for n in (5, 10, 20, 50, 100, 200):
            solver.reset()
            start = time.perf_counter()
            x = solver.apply(n_iter=n, disp_iter=None, plot=False, save=False)
            seconds = time.perf_counter() - start
            x = np.asarray(x[0] if isinstance(x, tuple) else x, dtype=np.float64)
            theirs.append((n, seconds, residual(psf, y, np.squeeze(x))))
    except Exception as why:
        print(f"skipped: LenslessPiCam comparison: ADMM of this version: {why!r}")
        return
    ours = [(n, s, residual(psf, y, x)) for n in (1, 2, 5, 10, 20, 60, 200) for s, x in (program(bundle, work / "out", n),)]

    version = getattr(lensless, "__version__", "of unknown version")
    print(f"\nTime to equal residual |A x - y| / |y| on a real frame, {y.shape[1]}x{y.shape[0]}, one thread; lensless {version}")
    print(f"{'ADMM: iterations':>16} {'residual':>9} {'s':>8}   {'stokes: iterations':>18} {'residual':>9} {'s':>8}  ratio")
    for n, seconds, reached in theirs:
        good = [p for p in ours if p[2] <= reached]
        line = f"{n:16} {reached:9.4f} {seconds:8.3f}   "
        if good:
            m, fast, better = min(good, key=lambda p: p[1])
            print(line + f"{m:18} {better:9.4f} {fast:8.3f}  {seconds / fast:.1f}")
        else:
            print(line + f"not reached (least {min(p[2] for p in ours):.4f})")
    print("stokes: " + ", ".join(f"{n} iterations {reached:.4f} in {seconds:.3f} s" for n, seconds, reached in ours))


if __name__ == "__main__":
    main()
