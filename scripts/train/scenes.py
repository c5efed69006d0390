"""Polarized scenes for training: procedural ones, and views of measured ones where a folder of them is at hand.

A scene is S0, S1, S2 as [3, N, N]; S0 reaches about 1, and S1² + S2² ≤ S0².
"""
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

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


def unrelated(rng, n=250):
    """Cloth, print and grain whose polarization knows nothing of the pattern: L follows brightness with any power, 0 and less among
    them, or has a texture of its own."""
    yy, xx = (np.mgrid[:n, :n] + 0.5) / n * 2 - 1
    pattern = np.zeros((n, n))
    for _ in range(rng.integers(1, 4)):
        if rng.random() < 0.3:
            one = field(rng, n, rng.uniform(0.4, 1.8))
        else:  # threads and lines, bent a little
            turn, period = rng.uniform(0, np.pi), np.exp(rng.uniform(np.log(2.5), np.log(30)))
            along = (xx * np.cos(turn) + yy * np.sin(turn)) * n / 2 + rng.uniform(0, 4) * field(rng, n, 2.2)
            one = np.cos(2 * np.pi * along / period + rng.uniform(0, 6))
            one = np.tanh(rng.uniform(0.5, 4) * one) if rng.random() < 0.5 else one
        if rng.random() < 0.4:  # in some places only
            one = one * (field(rng, n, 2.2) > rng.normal(0, 0.7))
        pattern = pattern + rng.uniform(0.1, 0.5) * one
    slow = np.exp(rng.uniform(0.1, 0.6) * field(rng, n, 2.2))
    s0 = rng.uniform(0.1, 0.6) * slow * np.exp(pattern - pattern.mean())
    own = np.exp(rng.choice([0, 0, 0.1, 0.4]) * field(rng, n, rng.uniform(0.8, 2)))
    angle = rng.uniform(0, np.pi) + rng.uniform(0, 0.6) * field(rng, n, rng.uniform(1.8, 2.6))
    degree = np.exp(rng.uniform(np.log(0.02), np.log(0.6))) * np.exp(0.3 * field(rng, n, 2.2)) * own
    power = rng.choice([0, 0, rng.uniform(-0.7, 1.5)])
    return finish(s0, slow * s0.mean() * (s0 / slow / s0.mean()) ** power * degree * np.exp(2j * angle))


def surroundings(rng):
    """What shines on a scene, as maps of directions, [32, 64] of height and azimuth: as four surfaces, a mirror first, reflect it,
    and all that falls on a surface turned there."""
    light = np.exp(rng.uniform(0.2, 1) * field(rng, 64, 2.0))[:32] * rng.uniform(0.05, 0.6)
    for _ in range(rng.integers(1, 6)):  # lamps and windows
        y, x, h, w = rng.integers(0, 26), rng.integers(0, 64), rng.integers(1, 7), rng.integers(1, 12)
        light[y:y + h, (x + np.arange(w)) % 64] += np.exp(rng.uniform(0, 3))
    height, azimuth = np.meshgrid((np.arange(32) + 0.5) / 32 * np.pi, (np.arange(64) + 0.5) / 32 * np.pi, indexing="ij")
    d = np.stack([np.sin(height) * np.cos(azimuth), np.sin(height) * np.sin(azimuth), np.cos(height)], -1).reshape(-1, 3)
    near, area = d @ d.T, np.sin(height).ravel()
    lobes = [np.exp(sharp * (near - 1)) * area for sharp in (200, 30, 6)] + [np.clip(near, 0, None) * area]
    return [light] + [(w @ light.ravel() / w.sum(1)).reshape(32, 64) for w in lobes]


def looked_up(directions, d):
    """A map of `surroundings` at unit vectors d [3, ...]."""
    y = np.arccos(np.clip(d[2], -1, 1)) / np.pi * 32 - 0.5
    x = np.arctan2(d[1], d[0]) / np.pi * 32 - 0.5
    return map_coordinates(directions, [np.clip(y, 0, 31), x % 64], order=1, mode="grid-wrap")


def turned(rng):
    """A random rotation, [3, 3]."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.diag(r))


def solid(rng, xx, yy, r):
    """A random ellipsoid or box of radius r seen from far above: where it is hit, how high, its normals and its own coordinates."""
    centre, frame, size = rng.uniform(-1.1, 1.1, 2), turned(rng), r * np.exp(rng.uniform(np.log(0.3), 0, 3))
    # in a frame in which its size is 1
    start = np.tensordot(frame, np.stack([xx - centre[0], yy - centre[1], 0 * xx]), 1) / size[:, None, None]
    ray = (frame[:, 2] / size)[:, None, None]
    if rng.random() < 0.5:
        a, b, c = (ray**2).sum(), (ray * start).sum(0), (start**2).sum(0) - 1
        inside = b * b - a * c
        hit, t = inside > 0, (np.sqrt(np.clip(inside, 0, None)) - b) / a
        at = normal = start + t * ray
    else:
        ends = (np.array([-1, 1])[:, None, None, None] - start) / ray
        entered, left = ends.min(0), ends.max(0)
        t = left.min(0)
        hit, at = t > entered.max(0), start + t * ray
        normal = np.sign(at) * (left == t)
    normal = np.tensordot(frame.T, normal / size[:, None, None], 1)
    return hit, t + rng.uniform(-1, 0.5), normal / (np.linalg.norm(normal, axis=0) + 1e-9), at * size[:, None, None]


def shaded(rng, n=250):
    """Solids of dielectrics and metals in real surroundings: what their bodies scatter comes out polarized along the plane of incidence,
    what their surfaces mirror across it, both as Fresnel's equations say. So dark surfaces and highlights polarize more, and
    brightness, degree and angle follow the same shapes and the same unevenness."""
    yy, xx = (np.mgrid[:n, :n] + 0.5) / n * 2 - 1
    view = np.stack([-0.3 * xx, -0.3 * yy, np.ones((n, n))])
    view /= np.linalg.norm(view, axis=0)
    mirrors = surroundings(rng)
    falls = mirrors.pop()
    grains = [field(rng, 256, slope) for slope in (0.8, 1.2, 1.7, 2.2, 2.2)]
    tilt, to = rng.uniform(0, 1.2), rng.uniform(0, 2 * np.pi)
    floor = np.array([np.sin(to) * np.sin(tilt), np.cos(to) * np.sin(tilt), np.cos(tilt)])
    normal, height = np.tile(floor[:, None, None], (1, n, n)), -(floor[0] * xx + floor[1] * yy) / floor[2] - 1
    place, thing = np.stack([xx, yy, height]), np.zeros((n, n), int)
    count, radii = rng.integers(3, 60), np.log([rng.uniform(0.03, 0.12), rng.uniform(0.2, 0.9)])
    for k in range(1, count):
        hit, its, *shape = solid(rng, xx, yy, np.exp(rng.uniform(*radii)))
        hit &= its > height
        height, thing = np.where(hit, its, height), np.where(hit, k, thing)
        normal, place = (np.where(hit, new, old) for new, old in zip(shape, (normal, place)))
    shadow = np.prod([np.exp(-rng.uniform(0, 1.5) * np.clip(gaussian_filter(height, s) - height, 0, 0.5)) for s in (3, 10)], 0)

    zoom = np.exp(rng.uniform(np.log(60), np.log(250)))
    texture = lambda grain, scale=1.0: map_coordinates(
        grain, np.tensordot(turned(rng)[:2], place, 1) * scale * zoom % 256, order=1, mode="grid-wrap")
    any_grain = lambda first=0, last=3: grains[rng.integers(first, last)]
    each = lambda draw: np.array([draw() for _ in range(count)])[thing]  # one number for every thing
    uneven = each(lambda: rng.choice([0.02, 0.1, 0.2, 0.4])) * texture(any_grain())
    printed = each(lambda: rng.choice([0, 0, 0.5, 1.5])) * (texture(grains[3]) > each(rng.normal))
    albedo = np.clip(each(lambda: np.exp(rng.uniform(np.log(0.03), 0))) * np.exp(uneven + printed), 0.01, 0.95)
    gy, gx = np.gradient(texture(any_grain(1, 5), rng.uniform(0.5, 1)))
    whole = (thing == np.roll(thing, 1, 0)) & (thing == np.roll(thing, 1, 1))
    bumps = each(lambda: np.exp(rng.uniform(np.log(0.03), np.log(2)))) * whole
    normal = normal + np.stack([gx * bumps, gy * bumps, 0 * bumps])
    normal /= np.linalg.norm(normal, axis=0)

    cos = np.clip((normal * view).sum(0), 0.03, 1)
    incidence = np.exp(2j * np.arctan2(normal[1] - cos * view[1], normal[0] - cos * view[0]))
    index, metal = each(lambda: rng.uniform(1.33, 1.7)), each(lambda: rng.random() < 0.12)
    inner = np.sqrt(1 - (1 - cos**2) / index**2)
    across, along = ((cos - index * inner) / (cos + index * inner)) ** 2, ((index * cos - inner) / (index * cos + inner)) ** 2
    rough = each(lambda: rng.integers(4))
    gloss = each(lambda: rng.choice([0.1, 0.5, 1, 1])) * np.exp(each(lambda: rng.choice([0, 0.1, 0.3])) * texture(any_grain()))
    seen = np.choose(rough, [looked_up(m, 2 * cos * normal - view) for m in mirrors]) * gloss * np.sqrt(shadow)
    mirrored = seen * np.where(metal, 0.4 + 0.4 * albedo, (across + along) / 2)
    degree = np.where(metal, 0.15 * (1 - cos**2), fresnel(cos, True, index) * np.array([1, 0.95, 0.85, 0.6])[rough])
    body = np.where(metal, 0, albedo * looked_up(falls, normal) * shadow * (1 - (across + along) / 2))
    light = incidence * (body * fresnel(cos, False, index) - mirrored * degree)
    blurred = lambda v, lens=rng.uniform(0.3, 0.8): gaussian_filter(v, lens)
    return finish(blurred(body + mirrored), blurred(light.real) + 1j * blurred(light.imag))


def made(rng, n=250):
    """A procedural scene of any sort."""
    sort = rng.random()
    if sort < 0.15:
        return reflecting(rng, n)
    if sort < 0.35:
        return unrelated(rng, n)
    if sort < 0.6:
        return shaded(rng, n)
    return procedural(rng, n, texture=rng.choice([0, 0.1, 0.4]) if sort < 0.7 else 1.0)


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
