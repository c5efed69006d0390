#!/usr/bin/env python3
"""Captures of polarized scenes, with what can go wrong, and what stage I makes of them.

    captures.py OUT [--scenes DIR] [--groups N] [--seed N]

A group is one device and FRAMES frames, solved by the program itself, the package in crates/python. OUT/train/NNNN.npz and, where
there are measured scenes, OUT/check/CHECK.npz hold stokes, truth [F, 3, N, N] and residual [F, N, N] as f16, psf [N, N], mask [N]
(e = m1 + i·m2 of each column) and the source of every frame. Checks also hold what stage I makes of the same readings in LONGER iterations
(`longer`), and once it knows what is wrong with PSF (but for where it lies), mask and guide (`undone`). `residual` is what the readings
have beyond the answer and beyond the light from outside of the frame that the program found. Networks learn from aligned
guides and from PSFs as they are given. The program refits the PSF and aligns guides, so in checks of these flaws stokes, residual and psf
are those after that, and `given` is the answer before. Existing files are kept.
"""
import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import scipy.fft
from PIL import Image
from scipy.ndimage import affine_transform, gaussian_filter

import scenes
import stokescope as ss

N, FRAMES = 250, 16
IDEAL = 1e9  # extinction ratio of a mask without a flaw
# Pixels beyond the frame from which light reaches the sensor where the scene goes on: the reach of the widest PSF.
MARGIN = 60
# From this group on all scenes are reflecting ones: what is mirrored is what networks overlook most.
REFLECTING = 100
ANGLES = {3: np.deg2rad([0, 45, 90]), 4: np.deg2rad([0, 45, 90, 135])}
# What a group may suffer from. The checks are named after them; `nominal` is none, `small` a PSF of half as many pixels, `views` are
# of parts of the scenes (a whole one is but one number), and `extinction` a mask taken for an ideal one: readings behind it are those
# of less polarized light behind an ideal one, so that learning from them would only teach to overstate it. In `surroundings` the scene
# goes on beyond the frame and the guide sees that, in `unseen` it does not.
FLAWS = ("noise", "shift", "psf", "gamma")
CHECKS = ("nominal", *FLAWS, "extinction", "small", "views", "surroundings", "unseen")
VIEWS = 6  # of each scene
LONGER = 20  # iterations, some more than take as long as 10 and a network


def middle(x, n):
    """The n × n pixels in the middle of [..., m, m]."""
    first = (x.shape[-1] - n) // 2
    return x[..., first:first + n, first:first + n]


def blur(x, k):
    """Linear convolution of [..., n, n] with a PSF [m, m] centred at (m/2, m/2), m ≤ n, cropped."""
    n, m = x.shape[-1], k.shape[-1]
    f = scipy.fft.next_fast_len(n + m, real=True)
    big = np.zeros((f, f), np.float32)
    big[:m, :m] = k
    big = np.roll(big, (-(m // 2), -(m // 2)), (0, 1))
    return scipy.fft.irfft2(scipy.fft.rfft2(np.float32(x), (f, f)) * scipy.fft.rfft2(big), (f, f))[..., :n, :n]


def moved(x, dx, dy, margin=16):
    """Shifted by a fraction of a pixel, the border repeated."""
    x = np.pad(x, margin, "edge")
    f = np.fft.fftfreq(x.shape[0])
    ramp = np.exp(-2j * np.pi * (f[:, None] * dy + f[None] * dx))
    return np.fft.ifft2(np.fft.fft2(x) * ramp).real[margin:-margin, margin:-margin]


def disc(pattern, diameter, n=N):
    """A square pattern shrunk into a disc in the middle of a frame of n × n, sum 1."""
    m = pattern.shape[0]
    yy, xx = np.mgrid[:m, :m]
    pattern = pattern * (np.hypot(yy - m / 2, xx - m / 2) < m / 2)
    small = np.asarray(Image.fromarray(pattern.astype(np.float32)).resize((diameter, diameter), Image.BOX), float)
    out, o = np.zeros((n, n)), n // 2 - diameter // 2
    out[o:o + diameter, o:o + diameter] = small
    return out / out.sum()


class Diffusers:
    """Point-spread functions: caustics of random smooth phases, speckle and, from `diffusercam/psf_sample.tif` of the folder of
    measured scenes, a photographed one."""

    def __init__(self, folder):
        path = Path(folder or "/nowhere") / "diffusercam/psf_sample.tif"
        self.photo = None
        if path.exists():
            photo = scenes.gray(path)
            self.photo = np.clip(photo - np.percentile(photo, 20), 0, None)[200:1000, 400:1200]

    def photographed(self, diameter=0.44, n=N):
        return disc(self.photo, round(diameter * n), n)

    def draw(self, rng):
        """Half of them as wide as the sensor allows; a smaller one is what coarse pixels see, or a sensor far from its diffuser."""
        diameter = rng.uniform(0.36, 0.46) if rng.random() < 0.5 else np.exp(rng.uniform(np.log(0.16), np.log(0.36)))
        kind = rng.random()
        if self.photo is not None and kind < 0.35:
            return self.photographed(diameter)
        m = 400
        if kind < 0.45:
            return disc(gaussian_filter(rng.exponential(size=(m, m)), rng.uniform(2, 6)), round(diameter * N))
        f = np.hypot(np.fft.fftfreq(m)[:, None], np.fft.fftfreq(m)[None]) * m
        phase = np.fft.ifft2(np.fft.fft2(rng.standard_normal((m, m))) * np.exp(-(f**2) / 2 / rng.uniform(10, 25) ** 2)).real
        lines = np.exp(-np.abs(phase / phase.std() / rng.uniform(0.1, 0.3)) ** rng.uniform(1, 2)) + rng.uniform(0, 0.05)
        return disc(lines, round(diameter * N))


def drifted(k, rng, amount, shift=1):
    """A point-spread function after its calibration: a little scaled, shifted and blurred."""
    zoom, c = 1 + 0.01 * amount * rng.normal(), N // 2
    k = affine_transform(k, [1 / zoom] * 2, offset=c - c / zoom + shift * 0.2 * amount * rng.normal(size=2), order=1)
    k = gaussian_filter(k, 0.4 * amount * abs(rng.normal()))
    return k / k.sum()


def striped(n, angles, stripes):
    """The response e = m1 + i·m2 of each column behind ideal stripes."""
    return 0.5 * np.exp(2j * ANGLES[angles][np.arange(n) * stripes // n % angles])


def readings(stokes, k, e):
    """What a sensor of len(e)² pixels reads of [F, 3, n, n] in its middle, behind the PSF k and a mask e = m1 + i·m2 of each column."""
    b = middle(blur(stokes, k), len(e))
    return 0.5 * b[:, 0] + e.real * b[:, 1] + e.imag * b[:, 2]


def cubic(t):
    """Weights of four neighbours for a place t in [0, 1) behind the second (Catmull and Rom); crates/core/src/image/cubic.rs has the same."""
    return 0.5 * np.array([-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2])


def stretched(k, scale):
    """A PSF spread over `scale` times the distances; crates/core/src/optics/psf.rs has the same."""
    if scale == 1:
        return k
    centre = len(k) // 2
    at = centre + (np.arange(len(k)) - centre) / scale
    first = np.floor(at).astype(int)
    by = np.zeros(k.shape)
    for row, from_, taps in zip(by, first, cubic(at - first).T):
        for place, tap in enumerate(taps, from_ - 1):
            if 0 <= place < len(k):
                row[place] = tap
    k = np.clip(k @ by.T, 0, None)
    k = np.clip(by @ k, 0, None)
    return k / k.sum()


def stage1(raw, guide, psf, sigma, angles, stripes, iterations, *, register=False, refit=False, method=None, extinction=IDEAL):
    """The program's answer to readings [F, N, N], beside guides [F, G, G] or None that see as far beyond the frame on every side:
    Stokes images, the scale of the PSF that it took for each of them, and the readings less the light that it found beyond the frame."""
    mask = ss.stripes([0, 45, 90, 135][:angles], stripes, extinction_ratio=extinction)
    sees = 0 if guide is None else (guide.shape[-1] - raw.shape[-1]) // 2
    device = ss.Device(psf, mask, noise=sigma, homography=[[1, 0, sees], [0, 1, sees], [0, 0, 1]])
    solve = ss.Pipeline(device, guided=guide is not None, method=method, iterations=iterations, register=register, refit_psf=refit,
                        fusion="off", threads=1)
    results = [solve(*frame) for frame in zip(raw, [None] * len(raw) if guide is None else guide)]
    # the shortest decimals of the single-precision figures
    scales = [float(str(np.float32(r.report["psf_scale"]))) for r in results]
    return np.stack([r.stokes for r in results]), scales, np.stack([r.readings for r in results])


def solve(target, fields, guides, sources, *, psf, true_psf, sigma, angles, stripes, register, iterations, rng, extinction=IDEAL,
          right=None):
    """Captures of the middle of `fields`, whose light reaches the sensor from all of them, and stage I's answer, as one file; with
    `right`, guides and PSF as they should be, also its answer had it known what is wrong, and in more iterations, and the file's own is
    the one after all that the program undoes."""
    truth, guide = middle(np.array(fields), N), np.array(guides, np.float32)
    e = striped(N, angles, stripes)
    raw = readings(np.array(fields), true_psf, e * (extinction - 1) / (extinction + 1))
    raw = np.float32(raw + rng.normal(0, sigma, raw.shape))
    answer = lambda iterations, **how: stage1(raw, guide, psf, sigma, angles, stripes, iterations, **how)
    (stokes, scales, own), more = answer(iterations, register=register), {}
    if right is not None:
        told, its_psf = right
        known, *_ = stage1(raw, np.array(told, np.float32), its_psf, sigma, angles, stripes, iterations, register=True, extinction=extinction)
        longer, *_ = answer(LONGER, register=register)
        more = {"undone": np.float16(known), "longer": np.float16(longer)}
        undoing, scales, own = answer(iterations, register=True, refit=True)
        if (undoing != stokes).any():
            more["given"], stokes = np.float16(stokes), undoing
    residual = np.array([y - readings(s[None], stretched(psf, scale), e)[0] for y, s, scale in zip(own, stokes, scales)])
    psf = stretched(psf, scales[-1])
    part = target.with_suffix(".part.npz")
    np.savez(part, stokes=np.float16(stokes), truth=np.float16(truth), residual=np.float16(residual),
             psf=np.float32(psf), mask=np.complex64(e), source=sources, **more)
    os.replace(part, target)


def drawn(rng, measured, source, n):
    """A procedural scene, or a view of the measured one `source`, half of them with parts of the others of its fold on it."""
    if source == "procedural":
        return scenes.made(rng, n)
    if rng.random() < 0.5:
        return measured.view(rng, source, n)
    fold = next(names for names in measured.FOLDS.values() if source in names)
    return measured.composed(rng, source, [name for name in fold if name in measured.files], n)


def train_group(target, rng, measured, diffusers, reflecting):
    """One device and its frames: half of the groups as good as a bench allows, half with one or two of FLAWS; half of them with scenes
    that go on beyond the frame, which two thirds of those guides see; half of the frames made of measured scenes, or, where
    `reflecting`, all of them mirrors of procedural ones."""
    psf = diffusers.draw(rng)
    angles, stripes = int(rng.choice([3, 4, 4, 4])), int(rng.choice([8, 12, 16, 16, 16, 20]))
    flaws = set(rng.choice(FLAWS, rng.choice([1, 1, 2]), replace=False)) if rng.random() < 0.5 else set()
    between = lambda low, high: float(np.exp(rng.uniform(np.log(low), np.log(high))))
    true_psf = drifted(psf, rng, rng.uniform(0.5, 2)) if "psf" in flaws else psf
    beyond = MARGIN if rng.random() < 0.5 else 0
    side, seen = N + 2 * beyond, N + 2 * int(rng.choice([0, beyond, beyond]))
    fields, guides, sources = [], [], []
    for _ in range(FRAMES):
        names = measured.names("AB")
        source = str(rng.choice(names)) if names and rng.random() < 0.5 else "procedural"
        if reflecting:
            source, field = "procedural", scenes.reflecting(rng, side)
        else:
            field = drawn(rng, measured, source, side)
        guide = field[0]
        if "shift" in flaws or rng.random() < 0.3:
            radius, turn = rng.uniform(0, 4), rng.uniform(0, 2 * np.pi)
            guide = np.clip(moved(guide, radius * np.cos(turn), radius * np.sin(turn)), 0, None)
        if "gamma" in flaws:
            guide = guide ** rng.uniform(0.65, 1.5)
        guide = middle(guide, seen) * rng.uniform(0.5, 1.5)
        fields.append(field)
        guides.append(np.clip(guide + rng.normal(0, between(0.003, 0.01), guide.shape), 0, None))
        sources.append(source)
    solve(target, fields, guides, sources, psf=psf, true_psf=true_psf, angles=angles, stripes=stripes,
          register=True, sigma=between(0.005, 0.013) if "noise" in flaws else between(0.001, 0.004),
          iterations=int(rng.choice([5, 10, 10, 10, 20])), rng=rng)


def check_group(target, rng, measured, diffusers, flaw):
    """The measured scenes as a whole, or views of them, through one device, with one flaw or none."""
    sources = measured.names("AB")
    psf = diffusers.photographed(0.22 if flaw == "small" else 0.44)
    side = N + 2 * MARGIN if flaw in ("surroundings", "unseen") else N
    if flaw == "views":
        sources = [name for name in sources for _ in range(VIEWS)]
        fields = [measured.view(rng, name, N) for name in sources]
    else:
        fields = [measured.standard(name, side) for name in sources]
    seen = [middle(field[0], N if flaw == "unseen" else side) for field in fields]
    guides = seen
    if flaw == "shift":
        guides = [moved(g, 1.6, -1.2) for g in guides]
    if flaw == "gamma":
        guides = [0.7 * g**1.3 for g in guides]
    noise = rng.normal(0, 0.005, (len(guides), *guides[0].shape))
    drift = lambda shift: drifted(psf, np.random.default_rng(5), 1.5, shift) if flaw == "psf" else psf
    # A shift of the PSF nobody can know: it is one of the scene.
    right = [np.clip(g + n, 0, None) for g, n in zip(seen, noise)], drift(0)
    guides = [np.clip(g + n, 0, None) for g, n in zip(guides, noise)]
    solve(target, fields, guides, sources, right=right, psf=psf, true_psf=drift(1), angles=4, stripes=16, iterations=10,
          register=flaw != "shift", rng=rng, sigma=0.01 if flaw == "noise" else 0.002, extinction=20 if flaw == "extinction" else IDEAL)


def gain(path, what, scenes=None):
    """What stage I gains on a check over taking PSF and guide as they are given, of the scenes named or of all, S1/S2 PSNR in the mean
    [dB]: when it is told what is wrong ("undone"), undoes what it can ("stokes"), or has LONGER iterations ("longer")."""
    z = np.load(path)
    counted = np.isin(z["source"], scenes) if scenes else slice(None)
    given = "given" if "given" in z else "stokes"
    truth, found, other = (np.float32(z[name])[counted, 1:] for name in ("truth", given, what))
    square = lambda v: ((v - truth) ** 2).mean((1, 2, 3))
    return float(10 * np.log10(square(found) / square(other)).mean())


def group(out, folder, seed, check, k):
    """One file of OUT; nothing where it is there already."""
    name = CHECKS[k] if check else f"{k:04}"
    target = out / ("check" if check else "train") / f"{name}.npz"
    if target.exists():
        return
    measured, diffusers, rng = scenes.Measured(folder), Diffusers(folder), np.random.default_rng([seed, int(not check), k])
    if check:
        check_group(target, rng, measured, diffusers, name)
    else:
        train_group(target, rng, measured, diffusers, k >= REFLECTING)
    told = f": {gain(target, 'stokes'):+.2f} dB undone, {gain(target, 'undone'):+.2f} dB if stage I were told what is wrong" if check else ""
    print(f"{target.parent.name} {name}{told}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--groups", type=int, default=120)
    parser.add_argument("--seed", type=int, default=1)
    a = parser.parse_args()
    for part in ("train", "check"):
        (a.out / part).mkdir(parents=True, exist_ok=True)
    judged = scenes.Measured(a.scenes).files and Diffusers(a.scenes).photo is not None
    tasks = [(True, k) for k in range(len(CHECKS)) if judged] + [(False, k) for k in range(a.groups)]
    with ProcessPoolExecutor() as workers:
        for done in [workers.submit(group, a.out, a.scenes, a.seed, *task) for task in tasks]:
            done.result()


if __name__ == "__main__":
    main()
