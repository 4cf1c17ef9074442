"""The scenes that are timed."""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Any

import numpy as np

import tiverlet as tv


@dataclass(frozen=True)
class SpeedScene:
    """A scene of any size: build(n) -> (particles, features), of about n particles if a scene cannot have any number.

    sizes, quick: numbers of particles in a full and in a quick run. settles: untimed frames before the timed ones. in_c: substeps
    of pile.c, which is the same scene without friction; 0: not run.
    """

    title: str
    build: Callable[[int], tuple[Any, list[Any]]]
    substeps: int
    sizes: tuple[int, ...]
    quick: tuple[int, ...]
    settles: int = 0
    in_c: int = 0


def scattered(k: np.ndarray) -> np.ndarray:
    """Return pseudorandom numbers in [0, 1), from integers: the last steps of MurmurHash3, as in pile.c.

    An evenly spread (golden) sequence would favour branch prediction: a falling lattice ran twice as fast with it.
    """
    k = np.asarray(k, dtype=np.uint32)
    k = (k ^ k >> np.uint32(16)) * np.uint32(0x85EBCA6B)
    k = (k ^ k >> np.uint32(13)) * np.uint32(0xC2B2AE35)
    return (k ^ k >> np.uint32(16)) / 2**32


def pile(n: int, dim: int = 2):
    """Build discs or spheres that fall from a loose lattice into a wider and higher box, as in pile.c."""
    side = ceil(round(n ** (1 / dim), 9))
    i = np.arange(n)
    at = [i % side, i // side] if dim == 2 else [i % side, i // side**2, i // side % side]
    jitter = np.stack([scattered(dim * i + k + 1) for k in range(dim)], axis=1)
    box = tv.Box([0] * dim, [2.0 * side if k == 1 else 1.3 * side for k in range(dim)])
    x = np.stack(at, axis=1) * 1.1 + 0.5 + 0.05 * jitter
    return tv.Particles(x, radius=0.5), [tv.Gravity(9.81), box, tv.Contact()]


def rough(n: int):
    """Build the pile with friction."""
    particles, (gravity, box, _) = pile(n)
    return particles, [gravity, tv.Box(box.lower, box.upper, friction=0.5), tv.Contact(friction=0.5)]


def cloth(n: int):
    """Build a square cloth, rigid along its threads, soft diagonally, pinned at every 16th particle of every 16th thread."""
    side = max(3, round(n**0.5))
    wide = 0.03 * (side - 1)
    sheet = tv.shapes.cloth((0, 0, 0), (wide, 0, 0), (0, 0, wide), (side, side))
    features = [tv.Gravity(9.81), tv.Distance(sheet.links), tv.Distance(sheet.braces, compliance=1e-2, damping=0.005)]
    k = np.arange(0, side, 16)
    return tv.Particles(sheet.position, mass=3e-4, pinned=(k[:, None] * side + k).ravel()), features


def ropes(n: int):
    """Build ropes of 1 m and 41 particles that swing from one end: a hundred for n = 4100."""
    count, points = max(1, n // LINE), min(n, LINE)
    one = tv.shapes.rope((0, 0), (1, 0), points=points)
    k = np.arange(count)
    wide = ceil(count**0.5)  # in rows, so that coordinates stay small enough for f32
    position = (one.position + 2.0 * np.stack([k % wide, k // wide], axis=1)[:, None]).reshape(-1, 2)
    links = (one.links + points * k[:, None, None]).reshape(-1, 2)
    return tv.Particles(position, mass=0.01, pinned=points * k), [tv.Gravity(9.81), tv.Distance(links)]


def rope(n: int):
    """Build one rope of 1 m that swings from one end."""
    one = tv.shapes.rope((0, 0), (1, 0), points=n)
    return tv.Particles(one.position, mass=0.01, pinned=[0]), [tv.Gravity(9.81), tv.Distance(one.links)]


def mixed(n: int):
    """Build discs, ropes of 20 particles and soft balls of 61, which fall on each other in a box, with friction."""
    ball = tv.shapes.ball((5.5, 5.5), 4.6, rings=4)
    balls, ropes = max(1, n // 4 // len(ball)), max(1, n // 80)
    discs = max(1, n - balls * len(ball) - 20 * ropes)
    across = max(1, ceil(n**0.5 / 20))  # ropes side by side
    wide = 20 * across
    i = np.arange(discs)
    x = np.stack([i % wide, i // wide], axis=1) * 1.1
    x += 0.05 * np.stack([scattered(2 * i + 1), scattered(2 * i + 2)], axis=1)
    rope, k = tv.shapes.rope((0, 0), (19 * 1.1, 0), points=20), np.arange(ropes)
    high = 1.1 * (1 + (discs - 1) // wide)
    y = (rope.position + np.stack([k % across * 22.0, high + 1.1 * (k // across)], axis=1)[:, None]).reshape(-1, 2)
    high += 1.1 * (1 + (ropes - 1) // across)
    k, each = np.arange(balls), max(1, int(1.1 * wide / 10.5))
    z = (ball.position + np.stack([k % each * 10.5, high + 10.5 * (k // each)], axis=1)[:, None]).reshape(-1, 2)
    high += 10.5 * (1 + (balls - 1) // each)
    at = discs + 20 * np.arange(ropes)[:, None, None], discs + 20 * ropes + len(ball) * k[:, None, None]
    loops = [loop + int(start) for start in at[1].ravel() for loop in ball.loops]
    features = [
        tv.Gravity(9.81),
        tv.Distance((rope.links + at[0]).reshape(-1, 2)),
        tv.Distance((ball.links + at[1]).reshape(-1, 2), compliance=3e-3, damping=0.02),
        tv.Area(loops),
        tv.Contact(friction=0.3),
        tv.Box((-1, -1), (1.1 * wide, high + 1), friction=0.3),
    ]
    return tv.Particles(np.concatenate([x, y, z]), mass=0.02, radius=0.5), features


DT = 1 / 60  # [s] of a frame
LINE = 41  # particles of one of many ropes
TEN = tuple(10**k for k in range(1, 7))
SCENES = {
    "pile": SpeedScene("discs that fall into a box", pile, 8, TEN, (100, 1000), in_c=8),
    "settled": SpeedScene("the same discs at rest, after 400 frames", pile, 8, TEN[1:5], (100,), settles=400, in_c=8),
    "rough": SpeedScene(
        "the same with friction, after 1500 frames; C has none, and takes 8", rough, 2, TEN[1:4], (100,), settles=1500, in_c=8
    ),
    "spheres": SpeedScene("spheres that fall into a box", lambda n: pile(n, 3), 8, TEN, (100, 1000)),
    "cloth": SpeedScene("a cloth that is held here and there", cloth, 20, TEN[1:5], (100, 400)),
    "ropes": SpeedScene("ropes of 40 links", ropes, 20, (10 * LINE, 100 * LINE, 1000 * LINE, 10_000 * LINE), (LINE, 10 * LINE)),
    "rope": SpeedScene("one rope", rope, 20, (11, LINE, 101, 401), (11, LINE)),
    "mixed": SpeedScene("discs, ropes and soft balls with friction", mixed, 8, TEN[1:5], (100, 400)),
}
