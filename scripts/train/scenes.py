"""Polarized scenes for training: procedural ones, and views of measured ones where a folder of them is at hand.

A scene is S0, S1, S2 as [3, N, N]; S0 reaches about 1, and S1² + S2² ≤ S0².
"""
from pathlib import Path

import numpy as np
from PIL import Image

KINDS = ("matt", "gloss", "ball", "stress", "relief", "patch")


def finish(s0, light):
    """Makes S0 and L = S1 + i·S2 physical, and S0's 99.5th percentile 1."""
    s0 = np.clip(s0, 0.002, None)
    light = light * np.minimum(1, s0 / np.maximum(np.abs(light), 1e-9))
    white = np.percentile(s0, 99.5)
    return np.stack([s0 / white, light.real / white, light.imag / white])


def field(rng, n, slope, std=1.0):
    """Random texture with a spectrum of amplitude 1/f^slope, mean 0."""
    f = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n)[None])
    f[0, 0] = 1
    spectrum = np.fft.fft2(rng.standard_normal((n, n))) * f ** -slope
    spectrum[0, 0] = 0
    texture = np.fft.ifft2(spectrum).real
    return std * texture / texture.std()


def outline(rng, n, yy, xx, r):
    """Signed distance to a random ellipse, box, flower or bar of radius r, and its centre."""
    cy, cx = rng.uniform(-0.1, 1.1, 2) * n
    turn = rng.uniform(0, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    u, v = (yy - cy) * c + (xx - cx) * s, -(yy - cy) * s + (xx - cx) * c
    aspect = rng.uniform(0.3, 1)
    kind = rng.integers(4)
    if kind == 0:
        d = np.hypot(u, v / aspect) - r
    elif kind == 1:
        d = np.maximum(np.abs(u), np.abs(v) / aspect) - r
    elif kind == 2:
        d = np.hypot(u, v / aspect) - r * (1 + 0.3 * np.sin(np.arctan2(v, u) * rng.integers(2, 7) + rng.uniform(0, 6)))
    else:
        d = np.abs(u) - r * rng.uniform(0.05, 0.3)
    return d, (cy, cx)


def fresnel(cos, mirror, index=1.5):
    """DoLP of a dielectric seen at an angle: of what it mirrors, or of what comes out of it."""
    sin2 = 1 - cos * cos
    if mirror:
        root = np.sqrt(index**2 - sin2)
        return 2 * sin2 * cos * root / (index**2 - sin2 - index**2 * sin2 + 2 * sin2**2 + 1e-9)
    return (index - 1 / index) ** 2 * sin2 / (
        2 + 2 * index**2 - (index + 1 / index) ** 2 * sin2 + 4 * cos * np.sqrt(index**2 - sin2))


def procedural(rng, n=250, texture=1.0):
    """Overlapping things of several materials under one light, sometimes behind a polarized veil (haze, water). `texture` scales
    how uneven surfaces are: with 0 they are as smooth as a rendering's, and detail is where things end."""
    yy, xx = np.mgrid[:n, :n].astype(float)
    grain = [field(rng, n, slope, texture) for slope in (0.8, 1.2, 1.7)]
    slow = [field(rng, n, 2.2, texture) for _ in range(3)]
    rolled = lambda texture: np.roll(texture, rng.integers(0, n, 2), (0, 1))
    azimuth = rng.uniform(0, np.pi)
    umov = rng.uniform(0, 1) if rng.random() < 0.7 else 0  # how far dark surfaces polarize more
    things = rng.integers(3, 60)
    least, most = rng.uniform(3, 15), rng.uniform(20, 120)

    def material(centre=None, r=None):
        """S0 and L of one surface over the whole frame."""
        albedo = rng.uniform(0.03, 1) * np.exp(rng.choice([0.02, 0.08, 0.2, 0.4]) * rolled(grain[rng.integers(3)]))
        shade = np.clip(1 + 0.25 * rolled(slow[0]), 0.2, 2)
        angle = azimuth + rng.normal(0, 0.6) + rng.choice([0.05, 0.2, 0.6]) * rolled(slow[1])
        kind = rng.choice(KINDS if centre is not None else [k for k in KINDS if k != "ball"])
        if kind == "matt":
            degree = rng.uniform(0, 0.12) * np.clip(1 + 0.4 * rolled(slow[2]), 0, None) * (albedo / 0.5) ** -umov
        elif kind == "gloss":  # a reflection, added to both
            glare = np.clip(rolled(slow[2]), 0, None) ** 2 * rng.uniform(0.02, 0.3) + rng.uniform(0, 0.1)
            return albedo * shade + glare, glare * rng.uniform(0.3, 0.95) * np.exp(2j * angle)
        elif kind == "ball":
            off = np.clip(np.hypot(yy - centre[0], xx - centre[1]) / (r * rng.uniform(1, 1.5)), 0, 0.98)
            cos, mirror = np.sqrt(1 - off**2), rng.random() < 0.5
            degree = fresnel(cos, mirror) * (rng.uniform(0.2, 0.9) if mirror else 1)
            angle = np.arctan2(yy - centre[0], xx - centre[1]) + (np.pi / 2 if mirror else 0)
            shade = 0.3 + 0.7 * cos
        elif kind == "stress":  # films and strained plastic: strong, and quickly turning
            degree = rng.uniform(0.3, 0.9)
            angle = angle + rng.uniform(0.5, 3) * rolled(slow[0])
        elif kind == "relief":  # degree and angle follow the slopes of a rough surface
            gy, gx = np.gradient(field(rng, n, rng.uniform(1.6, 2.4)))
            slope = np.hypot(gy, gx)
            slope /= slope.std() + 1e-9
            degree = rng.uniform(0.02, 0.25) * slope**2 / (1 + slope**2)
            angle = np.arctan2(gy, gx) + np.pi / 2 * rng.integers(2)
            shade = shade * np.clip(1 + rng.uniform(0, 0.4) * gx / (gx.std() + 1e-9), 0.1, 3)
        else:
            degree = rng.uniform(0, 1) ** 2
        s0 = albedo * shade
        return s0, s0 * np.clip(degree, 0, 1) * np.exp(2j * angle)

    s0, light = material()
    edge = rng.uniform(0.3, 1.0)
    for _ in range(things):
        r = np.exp(rng.uniform(np.log(least), np.log(most)))
        distance, centre = outline(rng, n, yy, xx, r)
        cover = np.clip(0.5 - distance / (2 * edge), 0, 1)
        if cover.max() > 0:
            over, over_light = material(centre, r)
            s0, light = s0 * (1 - cover) + over * cover, light * (1 - cover) + over_light * cover
    if rng.random() < 0.3:
        veil = rng.uniform(0.1, 0.6) * np.clip(1 + 0.4 * slow[0], 0.2, None)
        polarized = veil * rng.uniform(0.1, 0.8) * np.exp(2j * (rng.uniform(0, np.pi) + 0.1 * slow[1]))
        through = rng.uniform(0.3, 0.9)
        s0, light = s0 * through + veil * (1 - through), light * through + polarized * (1 - through)
    return finish(s0, light * rng.choice([0.15, 0.3, 0.6, 1.0], p=[0.3, 0.3, 0.25, 0.15]))


def reflecting(rng, n=250):
    """A procedural scene behind water or glass: what is mirrored, the sky or another scene, is strongly polarized and knows nothing
    of the texture behind it."""
    behind = procedural(rng, n)
    if rng.random() < 0.5:
        mirrored = np.clip(1 + rng.uniform(0, 0.5) * field(rng, n, rng.uniform(1.8, 2.6)), 0, None)
    else:
        mirrored = procedural(rng, n)[0]
    mirrored = mirrored * np.exp(rng.uniform(np.log(0.1), np.log(3)))
    angle = rng.uniform(0, np.pi) + rng.choice([0, 0.05, 0.3]) * field(rng, n, 2.4)
    degree = np.clip(rng.uniform(0.2, 0.95) * (1 + rng.choice([0, 0.1, 0.3]) * field(rng, n, 2.4)), 0, 1)
    light = behind[1] + 1j * behind[2] + mirrored * degree * np.exp(2j * angle)
    return finish(behind[0] + mirrored, light)


def made(rng, n=250):
    """A procedural scene of any sort."""
    sort = rng.random()
    if sort < 0.2:
        return reflecting(rng, n)
    return procedural(rng, n, texture=rng.choice([0, 0.1, 0.4]) if sort < 0.45 else 1.0)


def gray(path):
    a = np.asarray(Image.open(path))
    a = a.astype(np.float64) / (255.0 if a.dtype == np.uint8 else 65535.0)
    return a if a.ndim == 2 else a[..., :3].mean(-1)


class Measured:
    """Measured scenes of a folder: `polanalyser/*_IMX250MZR.png` (Sony polarization mosaics, MIT) and
    `underwater/*/{0,45,90,135}.png` (angle images, BSD). None without the folder."""

    FOLDS = {
        "A": ["fruits", "camera", "Scene1_HT", "Scene1_LT"],
        "B": ["carps", "polarizer", "Scene2_HT", "Scene2_LT"],
    }

    def __init__(self, folder):
        self.files, self.images = {}, {}
        if folder:
            self.files |= {p.stem.split("_")[0]: p for p in Path(folder).glob("polanalyser/*_IMX250MZR.png")}
            self.files |= {p.name: p for p in Path(folder).glob("underwater/*/")}

    def names(self, folds):
        return [name for fold in folds for name in self.FOLDS[fold] if name in self.files]

    def stokes(self, name):
        """S0, S1, S2 of the whole image, freed of the sensor's imbalance between the two pairs of angles."""
        if name not in self.images:
            path = self.files[name]
            if path.is_dir():
                i = np.stack([gray(path / f"{a}.png") for a in (0, 45, 90, 135)])
            else:  # a cell is 90 45 / 135 0; that of the polarizer is stored gamma-coded
                m = gray(path)
                i = np.stack([m[1::2, 1::2], m[0::2, 1::2], m[0::2, 0::2], m[1::2, 0::2]])
                i = i**2.2 if name == "polarizer" else i
            k = np.sqrt(np.median(i[1] + i[3]) / max(np.median(i[0] + i[2]), 1e-9))
            i = i * np.array([k, 1 / k, k, 1 / k])[:, None, None]
            self.images[name] = np.stack([i.sum(0) / 2, i[0] - i[2], i[1] - i[3]])
        return self.images[name]

    def standard(self, name, n=250):
        """The whole scene: its central square."""
        s = self.stokes(name)
        m = min(s.shape[1:])
        y, x = ((side - m) // 2 for side in s.shape[1:])
        return self.cut(s, y, x, m, n)

    def view(self, rng, name, n=250):
        """A square somewhere in it, mirrored, its polarization turned and now and then scaled; mostly a large one, for a whole scene
        has more detail for each pixel than a close-up."""
        s = self.stokes(name)
        least = min(s.shape[1:])
        close = np.log(min(n, least / 2) / least) if rng.random() < 0.3 else np.log(0.6)
        m = int(least * np.exp(rng.uniform(close, 0)))
        y, x = (rng.integers(0, side - m + 1) for side in s.shape[1:])
        s0, s1, s2 = self.cut(s, y, x, m, n)
        light = s1 + 1j * s2
        if rng.random() < 0.5:
            s0, light = s0[:, ::-1], light[:, ::-1].conj()
        if rng.random() < 0.5:
            s0, light = s0[::-1], light[::-1].conj()
        if rng.random() < 0.5:
            s0, light = s0.T, -light.T.conj()  # mirrored at 45°: 2θ becomes 180° - 2θ
        turn = np.exp(1j * rng.uniform(0, 2 * np.pi))
        return finish(s0, light * turn * rng.choice([1, rng.uniform(0.3, 1.5)]))

    def composed(self, rng, name, others, n=250):
        """A view of `name` with cut-outs of `others` and of itself on it, or a mirror image of one over all of it: what is known of a
        few measured scenes as many more. Surfaces keep their own detail of S0 and L; what lies beside what does not repeat."""
        kin = lambda: self.view(rng, name if rng.random() < 0.3 else str(rng.choice(others)), n)
        part = lambda: made(rng, n) if rng.random() < 0.15 else kin()
        s0, s1, s2 = self.view(rng, name, n)
        # another contrast of light, and dark surfaces that polarize more or less than these do
        contrast, umov = np.exp(rng.normal(0, 0.25)), rng.normal(0, 0.2)
        light = (s1 + 1j * s2) * (s0 + 0.05) ** (contrast - 1 - umov)
        s0 = s0 * (s0 + 0.05) ** (contrast - 1)
        if rng.random() < 0.2:
            over, share = part(), np.exp(rng.uniform(np.log(0.1), np.log(2)))
            return finish(s0 + share * over[0], light + share * (over[1] + 1j * over[2]))
        yy, xx = np.mgrid[:n, :n].astype(float)
        edge = rng.uniform(0.3, 1.0)
        for _ in range(rng.integers(1, 4)):
            over, bright = part(), np.exp(rng.normal(0, 0.4))
            for _ in range(rng.integers(1, 6)):
                distance, _ = outline(rng, n, yy, xx, np.exp(rng.uniform(np.log(12), np.log(110))))
                cover = np.clip(0.5 - distance / (2 * edge), 0, 1)
                s0 = s0 * (1 - cover) + bright * over[0] * cover
                light = light * (1 - cover) + bright * (over[1] + 1j * over[2]) * cover
        return finish(s0, light)

    @staticmethod
    def cut(s, y, x, m, n):
        how = Image.BOX if m >= n else Image.BICUBIC
        part = [Image.fromarray(c[y:y + m, x:x + m].astype(np.float32)).resize((n, n), how) for c in s]
        s0, s1, s2 = (np.asarray(c, float) for c in part)
        return finish(s0, s1 + 1j * s2)
