"""Time to equal residual on a real capture without polarizers: the program beside ADMM of LenslessPiCam, used as installed.

A sensor without a field stop also sees what lies beyond the image that is returned. Both solve for that light on a padded frame and cut
it off at the end, so there are two residuals: of what was solved for, and of the returned image alone.

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


def program(bundle, work, n, y):
    """Least seconds of three runs, the residual that the program reports, and the returned image."""
    runs = []
    for _ in range(3):
        done = subprocess.run([STOKESCOPE, "--json", "reconstruct", "--calibration", bundle, "--raw", bundle / "raw.npy",
                               "--method", "stokes", "--iterations", str(n), "--threads", "1", "--out", work],
                              capture_output=True, text=True)
        if done.returncode:
            sys.exit(done.stderr.strip())
        runs.append(json.loads(done.stdout))
    stokes = np.load(work / "stokes.npy")
    image = stokes.reshape(-1, *stokes.shape[-2:])[0].astype(np.float64)
    return min(r["seconds"]["recon"] for r in runs), runs[0]["residual_rms"] / np.sqrt((y.astype(np.float64) ** 2).mean()), image


def theirs(solver, n, y):
    """The same of LenslessPiCam. Its model, too, has light from beyond the sensor, which it returns no image of: the residual is that of
    the padded image of its last iteration, before it is cut and clipped."""
    seconds = []
    for _ in range(3):
        solver.reset()
        start = time.perf_counter()
        x = solver.apply(n_iter=n, disp_iter=None, plot=False, save=False)
        seconds.append(time.perf_counter() - start)
    h, w = y.shape
    shown = np.squeeze(np.asarray(solver._forward_out))
    top, left = (shown.shape[0] - h) // 2, (shown.shape[1] - w) // 2
    shown, data = shown[top:top + h, left:left + w], y / y.max()
    x = np.asarray(x[0] if isinstance(x, tuple) else x, dtype=np.float64)
    return min(seconds), np.linalg.norm(shown - data) / np.linalg.norm(data), np.squeeze(x)


def compare(title, ours, other):
    """Points are (iterations, seconds, residual)."""
    print(f"\n{title}")
    print(f"{'ADMM: iterations':>16} {'residual':>9} {'s':>8}   {'stokes: iterations':>18} {'residual':>9} {'s':>8}  ratio")
    for n, seconds, reached in other:
        line = f"{n:16} {reached:9.4f} {seconds:8.3f}   "
        good = [p for p in ours if p[2] <= reached]
        if good:
            m, fast, better = min(good, key=lambda p: p[1])
            print(line + f"{m:18} {better:9.4f} {fast:8.3f}  {seconds / fast:.1f}")
        else:
            print(line + f"not reached (least {min(p[2] for p in ours):.4f})")


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
        other = [(n, *theirs(solver, n, y)) for n in (3, 5, 10, 20, 50)]
    except Exception as why:
        print(f"skipped: LenslessPiCam comparison: ADMM of this version: {why!r}")
        return
    ours = [(n, *program(bundle, work / "out", n, y)) for n in (3, 4, 5, 6, 8, 10, 12, 16, 20, 60)]

    version = getattr(lensless, "__version__", "of unknown version")
    print(f"\nTime to equal residual |A x - y| / |y| on a real frame, {y.shape[1]}x{y.shape[0]}, one thread; lensless {version}")
    model = lambda points: [(n, s, r) for n, s, r, _ in points]
    returned = lambda points: [(n, s, residual(psf, y, x)) for n, s, _, x in points]
    compare("of what is solved for, light from beyond the sensor included", model(ours), model(other))
    compare("of the returned image alone", returned(ours), returned(other))


if __name__ == "__main__":
    main()
