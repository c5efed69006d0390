"""Time to equal error of S1 and S2: the program beside NumPy versions of the published FISTA (Waller-Lab/SpectralDiffuserCam,
Python/fista_spectral_cupy.py) and of a plain guided FISTA.

polarization.py BUNDLES WORK     BUNDLES: folders with calibration.toml (gray, stripes), raw.npy, guide.npy, truth.npy
"""
import json
import os
import pathlib
import subprocess
import sys
import time
import tomllib

import numpy as np
import scipy.fft as sf

STOKESCOPE = os.environ["STOKESCOPE"]
F, C = np.float32, np.complex64


def ask(*args):
    done = subprocess.run([STOKESCOPE, "--json", *map(str, args)], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, args))}: {done.stderr.strip()}")
    return json.loads(done.stdout)


class Bundle:
    """Readings in fractions of full scale, guide, unit-sum PSF with zero displacement at half the size, stripes."""

    def __init__(self, folder):
        self.folder = folder
        about = tomllib.loads((folder / "calibration.toml").read_text())
        sensor, mask = about["sensor"], about["mask"]
        if sensor.get("channels", 1) != 1 or mask["kind"] != "stripes":
            raise ValueError("not a gray bundle with stripes")
        self.y = np.load(folder / "raw.npy")
        if self.y.dtype != F:
            black = sensor.get("black_level", 0)
            full = sensor.get("saturation", 2 ** sensor.get("bit_depth", 16) - 1)
            self.y = ((self.y.astype(np.float64) - black) / (full - black)).astype(F)
        self.guide = np.load(folder / "guide.npy").astype(F)
        self.psf = np.load(folder / about["psf"]["file"]).astype(np.float64)
        self.psf /= self.psf.sum()
        self.angles = np.deg2rad(mask["angles_deg"])
        self.number = np.arange(self.y.shape[1]) * mask["stripes"] // self.y.shape[1] % len(self.angles)

    def spectrum(self, shape, transform):
        """Transform of the PSF on a circle of `shape`, zero displacement first."""
        h, w = self.psf.shape
        padded = np.zeros(shape)
        padded[:h, :w] = self.psf
        return transform(np.roll(padded, (-(h // 2), -(w // 2)), (0, 1)).astype(F))


def haar(x, thresholds):
    """The closed form of tvHaar: x + 1/12 sum over axes of (f_i - f_(i-1)), f = clip(x_(i+1) - x_i, +-12 t)."""
    out = x.copy()
    for axis, t in enumerate(thresholds):
        f = np.clip(np.roll(x, -1, axis) - x, -12 * t, 12 * t)
        out += (f - np.roll(f, 1, axis)) / 12
    return out.astype(F)


def published(b, checkpoints):
    """FISTA over angle images as published: unit-l2 PSF, an unknown of twice the sensor's sides that is cropped at the end, L = 45 times
    the eigenvalue of one blur by power iteration, threshold lambda / L, its momentum."""
    h, w = b.y.shape
    shape = (2 * h, 2 * w)
    frame = (..., slice(h // 2, h // 2 + h), slice(w // 2, w // 2 + w))
    l2 = np.sqrt((b.psf ** 2).sum())
    k = (b.spectrum(shape, sf.rfft2) / l2).astype(C)
    masks = np.stack([np.broadcast_to(b.number == p, b.y.shape) for p in range(len(b.angles))]).astype(F)

    def convolve(x, k):
        return sf.irfft2(sf.rfft2(x, shape, workers=1) * k, shape, workers=1)

    def padded(x):
        out = np.zeros((*x.shape[:-2], *shape), F)
        out[frame] = x
        return out

    v = np.ones(b.y.shape, F)
    for _ in range(11):
        v /= np.linalg.norm(v)
        blurred = masks.sum(0) * convolve(padded(v), k)[frame]
        eigenvalue, v = (v * blurred).sum(), blurred
    lipschitz = F(45 * eigenvalue)
    tau = 5e-5 / lipschitz
    x = z = np.zeros((len(masks), *shape), F)
    t, start = 1.0, time.perf_counter()
    for i in range(1, max(checkpoints) + 1):
        r = (masks * convolve(z, k)[frame]).sum(0) - b.y
        v = z - convolve(padded(masks * r), k.conj()) / lipschitz
        new = F(0.5) * (np.maximum(v, 0) + haar(v, (5e-5 * tau, tau, tau)))
        t_new = 1 + 0.5 * np.sqrt(1 + 4 * t * t)
        z = (new + F((t - 1) / t_new) * (new - x)).astype(F)
        x, t = new, t_new
        if i in checkpoints:
            yield i, time.perf_counter() - start, np.maximum(x[frame], 0) / F(l2)


def guided(b, checkpoints, lam=7e-5):
    """FISTA for L = S1 + i S2 with S0 = gain times the guide: coupled TV in one pass, |L| <= S0."""
    h, w = b.y.shape
    shape = tuple(sf.next_fast_len(n + n // 2) for n in b.y.shape)
    k = b.spectrum(shape, sf.fft2).astype(C)
    e = np.broadcast_to(0.5 * np.exp(2j * b.angles[b.number]), b.y.shape).astype(C)

    def convolve(x, k):
        return sf.ifft2(sf.fft2(x, shape, workers=1) * k, workers=1, overwrite_x=True)[:h, :w]

    def forward(x):
        return (e.conj() * convolve(x, k)).real

    r, norm = np.ones_like(b.y), 1.0
    for _ in range(30):
        r = forward(convolve(e * r, k.conj()))
        norm = F(np.sqrt((r ** 2).sum()))
        r /= norm
    norm *= F(1.02)

    start = time.perf_counter()
    share = 0.5 * convolve(b.guide.astype(C), k).real
    gain = F((share * b.y).sum() / (share * share).sum())
    s0 = np.maximum(gain * b.guide, 0)
    rest = b.y - gain * share
    x = z = np.zeros(b.y.shape, C)
    t = 1.0
    for i in range(1, max(checkpoints) + 1):
        v = z + convolve(e * (rest - forward(z)), k.conj()) / norm
        gx, gy = np.roll(v, -1, 1) - v, np.roll(v, -1, 0) - v
        size = np.sqrt(np.abs(gx) ** 2 + np.abs(gy) ** 2)
        f = np.minimum(1, 8 * lam / norm / np.maximum(size, 1e-20)).astype(F)
        gx, gy = gx * f, gy * f
        v = v + F(0.125) * (gx - np.roll(gx, 1, 1) + gy - np.roll(gy, 1, 0))
        new = (v * np.minimum(1, s0 / np.maximum(np.abs(v), 1e-20))).astype(C)
        t_new = 0.5 * (1 + np.sqrt(1 + 4 * t * t))
        z = (new + F((t - 1) / t_new) * (new - x)).astype(C)
        x, t = new, t_new
        if i in checkpoints:
            images = [0.5 * (s0 + x.real * np.cos(2 * a) + x.imag * np.sin(2 * a)) for a in b.angles]
            yield i, time.perf_counter() - start, np.stack(images).astype(F)


def program(b, method, counts, work):
    for n in counts:
        # The median of three: single runs of milliseconds scatter.
        runs = [ask("reconstruct", "--calibration", b.folder, "--raw", b.folder / "raw.npy", "--guide", b.folder / "guide.npy",
                    "--method", method, "--iterations", n, "--threads", 1, "--out", work)["seconds"]["recon"] for _ in range(3)]
        yield n, sorted(runs)[1], np.load(work / "angles.npy")


def curve(b, work, runs):
    """[(iterations, seconds, PSNR of S1 and S2)]"""
    points = []
    for n, seconds, images in runs:
        np.save(work / "estimate.npy", images)
        points.append((n, seconds, ask("evaluate", work / "estimate.npy", b.folder / "truth.npy")["s12_psnr"]))
    return points


def main():
    bundles, work = map(pathlib.Path, sys.argv[1:3])
    work.mkdir(parents=True, exist_ok=True)
    print("\nTime to equal error of S1 and S2, one thread, seconds of the solver alone")
    print(f"{'bundle':12} {'NumPy solver':16} {'iterations':>10} {'dB':>6} {'s':>8}   {'guided: iterations':>18} {'dB':>6} {'s':>8}  ratio")
    ratios = {"published": [], "guided": []}
    speed = []
    for folder in sorted(p.parent for p in bundles.glob("*/calibration.toml")):
        try:
            b = Bundle(folder)
        except (ValueError, KeyError) as why:
            print(f"{folder.name:12} skipped: {why}")
            continue
        ours = curve(b, work, program(b, "guided", (1, 2, 5, 10, 20, 60), work / "out"))
        for name, solver, checkpoints in (("published", published, (20, 60, 200)), ("guided", guided, (5, 20, 60, 200))):
            points = curve(b, work, solver(b, checkpoints))
            n, seconds, reached = max(points, key=lambda p: p[2])
            good = [p for p in ours if p[2] >= reached]
            line = f"{folder.name:12} {name + ' FISTA':16} {n:10} {reached:6.2f} {seconds:8.3f}   "
            if not good:
                print(line + f"not reached (best {max(p[2] for p in ours):.2f} dB)")
                continue
            m, fast, better = min(good, key=lambda p: p[1])
            ratios[name].append(seconds / fast)
            print(line + f"{m:18} {better:6.2f} {fast:8.3f}  {seconds / fast:.0f}")
            if name == "published":
                same = curve(b, work, program(b, "fista-published", checkpoints, work / "out"))
                speed += [(slow / fast, ours - theirs) for (_, slow, theirs), (_, fast, ours) in zip(points, same)]
    for name, values in ratios.items():
        if values:
            print(f"{name} FISTA in NumPy over guided: median ratio of times {np.median(values):.0f}, least {min(values):.0f}")
    if speed:
        print(f"the same published FISTA, NumPy over fista-published: median ratio {np.median([s for s, _ in speed]):.1f};"
              f" S1,S2 PSNR differs by at most {max(abs(d) for _, d in speed):.2f} dB")


if __name__ == "__main__":
    main()
