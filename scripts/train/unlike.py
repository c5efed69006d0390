"""Scenes of kinds that networks never learn from: judges of what a model does where its expectations fail.

Each is S0, S1, S2 as [3, N, N], as those of scenes.py, and the same for one N.
"""
import numpy as np

from scenes import field, finish


def cells(rng, n, count):
    """A board of count × count fields, each with a number of its own."""
    side = -(-n // count)
    return np.kron(rng.random((count, count)), np.ones((side, side)))[:n, :n]


def cloth(rng, n, y, x):
    """Twill whose threads are bright and dark and polarize alike."""
    warp, weft = (x * 90 + y * 45) % 1 < 0.5, (x * 45 - y * 90) % 1 < 0.5
    return (0.3 + 0.5 * warp * weft + 0.1 * ~weft) * np.exp(0.2 * field(rng, n, 2)), 0.12 * np.exp(1j * (0.5 + 0.4 * field(rng, n, 2.4)))


def tiles(rng, n, y, x):
    """Boards of brightness, degree and angle with different numbers of fields."""
    bright, level = cells(rng, n, 20), cells(rng, n, 20)
    return 0.1 + 0.8 * bright, (0.1 + 0.8 * level) * 0.3 * cells(rng, n, 13) * np.exp(2j * np.pi * cells(rng, n, 13))


def film(rng, n, y, x):
    """Print behind a strained film."""
    s0 = 0.85 - 0.7 * (field(rng, n, 1.0) > 0.8)
    return s0, 0.6 * s0 * np.exp(1j * (24 * x * y + field(rng, n, 2.2)))


def haze(rng, n, y, x):
    """A textured ground that does not polarize, behind haze that does."""
    return 0.3 * np.exp(0.5 * field(rng, n, 1.1)) * (y > 0.4) + 0.5, 0.25 * np.exp(0.7j) * (1 - 0.5 * y)


def gratings(rng, n, y, x):
    """A grating of brightness across one of polarization."""
    return 0.5 + 0.35 * np.cos(2 * np.pi * (40 * x + 10 * x * x)), 0.2 * np.cos(2 * np.pi * (25 * y + 8 * y * y)) * np.exp(0.4j) + 0.1


def points(rng, n, y, x):
    """Bright points of any polarization on a dark ground."""
    s0, light = np.full((n, n), 0.03), np.zeros((n, n), complex)
    for _ in range(300):
        row, column = rng.integers(1, n - 2, 2)
        at, bright = np.s_[row:row + 2, column:column + 2], rng.uniform(0.1, 1)
        s0[at] += bright
        light[at] += bright * rng.uniform(0, 0.8) * np.exp(2j * np.pi * rng.random())
    return s0, light


def leaves(rng, n, y, x):
    """Overlapping ellipses with a sheen each."""
    s0, light = np.full((n, n), 0.2), np.zeros((n, n), complex)
    for _ in range(400):
        cy, cx, r, aspect, bright = *rng.random(2), rng.uniform(0.02, 0.09), rng.uniform(1, 2.5), rng.uniform(0.05, 0.7)
        inside = np.hypot(y - cy, (x - cx) * aspect) < r
        s0[inside] = bright * (1 + 0.2 * ((y - cy) / r)[inside])
        light[inside] = bright * rng.uniform(0, 0.5) * np.exp(1j * rng.uniform(0, 2 * np.pi))
    return s0, light


def weak(rng, n, y, x):
    """Weak polarization everywhere, unrelated to natural brightness."""
    return 0.3 * np.exp(0.6 * field(rng, n, 1.3)), 0.006 * np.exp(1j * field(rng, n, 2)) * np.exp(0.5 * field(rng, n, 1.3))


KINDS = (cloth, tiles, film, haze, gratings, points, leaves, weak)


def made(n):
    """Name and scene of every kind."""
    y, x = np.mgrid[:n, :n] / n
    return {kind.__name__: finish(*kind(np.random.default_rng(77), n, y, x)) for kind in KINDS}
