"""Bodies made of lines: rope, chain, bridge, tree."""

import numpy as np

from .. import checks
from ..tools import golden
from .shape import Shape, ends, point


def _in_line(n: int) -> dict:
    i = np.arange(n)
    return {"links": np.stack([i[:-1], i[1:]], axis=1), "bends": np.stack([i[:-2], i[1:-1], i[2:]], axis=1)}


@checks.answer_arguments
def rope(start, end, points: int) -> Shape:
    """Make `points` particles in a straight line from `start` to `end` [m], both included, each linked to the next."""
    checks.integer("rope", "points", points, least=2)
    a, b = ends("rope", start, end)
    amount = np.linspace(0.0, 1.0, points)[:, None]
    return Shape(a * (1 - amount) + b * amount, **_in_line(points))


@checks.answer_arguments
def chain(start, end, length: float, points: int) -> Shape:
    """Make a chain of a given length that hangs from `start` to `end` along its catenary, gravity along -y.

    length: along the curve [m], more than the distance of its ends. Particles are evenly spaced along the curve.
    """
    checks.integer("chain", "points", points, least=2)
    a, b = ends("chain", start, end)
    length = checks.number("chain", "length", length, above=float(np.linalg.norm(b - a)))
    rise, flat = b[1] - a[1], np.delete(b - a, 1)
    width = float(np.linalg.norm(flat))
    s = np.linspace(0, length, points)
    position = np.tile(a, (points, 1))
    if width < 1e-9 * length:  # start and end lie above each other: straight down, and up again
        low = (length - rise) / 2
        position[:, 1] += np.abs(s - low) - low
        return Shape(position, **_in_line(points))
    # y = c cosh(x / c): sinh(k) / k = sqrt(length^2 - rise^2) / width, with k = width / (2 c); logarithms do not overflow.
    ratio, low, high = np.log(np.sqrt(length**2 - rise**2) / width), 1e-9, 1e6
    for _ in range(200):
        k = (low + high) / 2
        slack = k + np.log1p(-np.exp(-2 * k)) - np.log(2 * k) < ratio
        low, high = (k, high) if slack else (low, k)
    c = width / (2 * k)
    x0 = c * np.arctanh(rise / length) - width / 2  # x of the start, from the lowest point
    x = c * np.arcsinh(s / c + np.sinh(x0 / c))
    position[:, np.arange(len(a)) != 1] += (x - x0)[:, None] * flat / width
    position[:, 1] += c * (np.cosh(x / c) - np.cosh(x0 / c))
    return Shape(position, **_in_line(points))


@checks.answer_arguments
def bridge(start, end, panels: int, height: float) -> Shape:
    """Make a truss bridge: a deck of `panels` panels from `start` to `end` [m], and a chord above it, joined by a zigzag."""
    checks.integer("bridge", "panels", panels, least=1)
    height = checks.number("bridge", "height", height, above=0.0)
    a, b = ends("bridge", start, end)
    up = np.eye(len(a))[1] * height
    t = np.arange(panels + 1)[:, None] / panels
    deck = a * (1 - t) + b * t
    i, top = np.arange(panels), panels + 1 + np.arange(panels)
    links = [np.stack(pair, axis=1) for pair in ((i, i + 1), (top[:-1], top[1:]), (i, top), (top, i + 1))]
    return Shape(np.concatenate([deck, (deck[1:] + deck[:-1]) / 2 + up]), np.concatenate(links))


@checks.answer_arguments
def tree(root, height: float, levels: int = 4, branches: int = 2, segments: int = 4, spread: float = 0.6) -> Shape:
    """Make a plant: a stem of `segments` links that splits into `branches` shorter ones, and so on for `levels` levels.

    root: (dim,) [m]. height: of the whole plant, upright, roughly [m]. spread: angle between a branch and its stem [rad].
    Lengths, and in 3D directions around the stem, vary with the golden ratio. links and bends run through every fork. Pin
    particle 0 to plant it.
    """
    base = point("tree", "root", root)
    height = checks.number("tree", "height", height, above=0.0)
    spread = checks.number("tree", "spread", spread, least=0.0, most=np.pi)
    for name, value in (("levels", levels), ("branches", branches), ("segments", segments)):
        checks.integer("tree", name, value, least=1)
    shrink = 0.7
    first = height * (1 - shrink) / (1 - shrink**levels)
    position, links, bends, parent = [base], [], [], {0: -1}
    tips = [(0, np.eye(len(base))[1], first)]
    for level in range(levels):
        following = []
        for at, way, length in tips:
            for k in range(1 if level == 0 else branches):
                toward = way if level == 0 else _turned(way, spread, k, branches, len(position))
                here, size = at, length * (1 if level == 0 else 0.8 + 0.4 * golden(len(position)))
                for _ in range(segments):
                    position.append(position[here] + toward * size / segments)
                    new = len(position) - 1
                    links.append((here, new))
                    if parent[here] >= 0:
                        bends.append((parent[here], here, new))
                    parent[new], here = here, new
                following.append((here, toward, size * shrink))
        tips = following
    return Shape(np.array(position), np.array(links), bends=np.array(bends, dtype=np.int64).reshape(-1, 3))


def _turned(way: np.ndarray, spread: float, k: int, branches: int, seed: int) -> np.ndarray:
    if len(way) == 2:
        angle = spread * (2 * k / (branches - 1) - 1 if branches > 1 else 2 * (seed % 2) - 1)
        c, s = np.cos(angle), np.sin(angle)
        return np.array([c * way[0] - s * way[1], s * way[0] + c * way[1]])
    side = np.cross(way, np.eye(3)[int(np.argmin(np.abs(way)))])
    side /= np.linalg.norm(side)
    around = 2 * np.pi * (k / branches + golden(seed))
    return np.cos(spread) * way + np.sin(spread) * (np.cos(around) * side + np.sin(around) * np.cross(way, side))
