"""Figures with joints."""

import numpy as np

from .. import checks
from .shape import Shape, point

# Coordinates (x, y, z) of each point for a height of 1: facing +x, y up, z away from the middle plane.
_POINTS = {
    "head": (0.0, 0.93, 0.0), "neck": (0.0, 0.82, 0.0), "chest": (0.0, 0.70, 0.0), "hip": (0.0, 0.53, 0.0),
    "shoulder": (0.0, 0.80, 0.11), "elbow": (0.0, 0.62, 0.13), "hand": (0.0, 0.44, 0.14),
    "joint": (0.0, 0.52, 0.06), "knee": (0.0, 0.28, 0.07), "foot": (0.0, 0.04, 0.07),
}  # fmt: skip
# From the side, in 2D: how far left parts are behind the middle and right ones before it, so that nothing overlaps.
_APART = {"shoulder": 0.03, "elbow": 0.07, "hand": 0.11, "joint": 0.03, "knee": 0.03, "foot": 0.03}
NAMES = ("head", "neck", "chest", "hip") + tuple(
    f"{side} {part}" for side in ("left", "right") for part in ("shoulder", "elbow", "hand", "joint", "knee", "foot")
)
# Joints: lower and upper limit of the signed turn at the second of three points [rad]; in 3D from 0 to the larger of both.
_TURNS = [
    ("head", "neck", "chest", -0.6, 0.6), ("neck", "chest", "hip", -0.5, 0.5),
    ("{} shoulder", "{} elbow", "{} hand", 0.0, 2.4), ("{} joint", "{} knee", "{} foot", -2.4, 0.0),
    ("chest", "{} joint", "{} knee", -0.4, 2.0), ("neck", "{} shoulder", "{} elbow", -2.8, 2.8),
]  # fmt: skip


@checks.answer_arguments
def ragdoll(feet, height: float = 1.8) -> Shape:
    """Make a figure of 16 points that stands upright at `feet` [m]: in 2D from the side, facing +x, or in 3D.

    links: the bones. braces: additional links in the trunk. limits, lower and upper: neck, back, elbows, knees, hips and
    shoulders. radius: of head, trunk and limbs. Points are named in order by tv.shapes.people.NAMES.
    """
    base = point("ragdoll", "feet", feet)
    height = checks.number("ragdoll", "height", height, above=0.0)
    position = []
    for name in NAMES:
        side, _, part = name.rpartition(" ")
        x, y, z = _POINTS[part] if len(base) == 3 else (_APART.get(part, 0.0), _POINTS[part][1], 0.0)
        sign = -1 if side == "left" else 1
        position.append([x * sign, y, z * sign])
    x = np.array(position)[:, : len(base)] * height
    number = {name: k for k, name in enumerate(NAMES)}

    def pairs(*names):
        """Return pairs of indices of points, by their names."""
        return [(number[a], number[b]) for a, b in names]

    links = pairs(("head", "neck"), ("neck", "chest"), ("chest", "hip"))
    braces = []
    for s in ("left", "right"):
        arm, elbow, hand, leg, knee, foot = (f"{s} {p}" for p in ("shoulder", "elbow", "hand", "joint", "knee", "foot"))
        links += pairs(("neck", arm), (arm, elbow), (elbow, hand), ("hip", leg), (leg, knee), (knee, foot))
        braces += pairs(("chest", arm), ("head", arm), ("chest", leg))
    braces += pairs(("left shoulder", "right shoulder"), ("left joint", "right joint"))
    limits, lower, upper = [], [], []
    for a, b, c, low, high in _TURNS:
        for s in ("left", "right") if "{}" in a + b + c else ("",):
            limits.append([number[n.format(s)] for n in (a, b, c)])
            if len(base) == 3:
                low, high = 0.0, max(abs(low), abs(high))
            lower.append(low)
            upper.append(high)
    size = {"head": 0.065, "neck": 0.04, "chest": 0.07, "hip": 0.07}
    radius = np.array([size.get(n, 0.03) for n in NAMES]) * height
    return Shape(
        base + x, np.array(links), np.array(braces), limits=np.array(limits), lower=np.array(lower), upper=np.array(upper),
        radius=radius,
    )  # fmt: skip
