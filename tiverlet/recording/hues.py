"""Colours of particles: one for each body."""

from typing import TYPE_CHECKING

import numpy as np

from .surfaces import bodies

if TYPE_CHECKING:
    from ..world import World
    from .scene import Parts

# Far from each other, and from all colours of strain (red, blue, grey), by at least 24 in CIELAB (1976).
PALETTE = np.array(
    [[85, 227, 242], [237, 242, 85], [242, 85, 137], [90, 242, 85], [118, 88, 226], [173, 140, 61], [242, 85, 242],
     [87, 173, 107], [214, 157, 242]], dtype=np.uint8,
)  # fmt: skip
FIXED = (140, 140, 150)  # of particles that cannot move
MANY = 600  # most bodies that are compared with all before them, which takes 10 ms; more are small, and take turns


def colors(world: "World | Parts") -> np.ndarray:
    """Return hues, (n, 3): one for each body and each loose particle; grey for fixed particles."""
    first, body = np.unique(bodies(world), return_inverse=True)
    x = np.asarray(world.particles.position)
    middle = np.stack([np.bincount(body, column, len(first)) for column in x.T], axis=1) / np.bincount(body)[:, None]
    hues = PALETTE[apart(middle)][body]
    hues[world.particles.inv_mass == 0] = FIXED
    return hues


def apart(middle: np.ndarray) -> np.ndarray:
    """Return a number in PALETTE for each body, (n,), from their centers, (n, dim) [m]: near bodies have different ones.

    In order, each body takes the colour of which the nearest body is farthest. So bodies that are added change no colour.
    """
    out = np.arange(len(middle)) % len(PALETTE)
    for k in range(len(PALETTE), min(len(middle), MANY)):
        away = ((middle[:k] - middle[k]) ** 2).sum(axis=1)
        nearest = np.full(len(PALETTE), np.inf)
        np.minimum.at(nearest, out[:k], away)
        out[k] = np.argmax(nearest)
    return out
