"""Constraints on particles: links, angles, areas, volumes, clusters, pins and rails."""

from .angle_limit import AngleLimit
from .area import Area
from .bend import Bend
from .constraint import Constraint
from .dihedral import Dihedral
from .distance import Distance
from .motor import Motor
from .path import Path
from .pin import Pin
from .rope import Rope
from .shape_match import ShapeMatch
from .snap import Snap
from .spacer import Spacer
from .volume import Volume
from .winch import Winch

__all__ = [
    "AngleLimit", "Area", "Bend", "Constraint", "Dihedral", "Distance", "Motor", "Path", "Pin", "Rope", "ShapeMatch", "Snap",
    "Spacer", "Volume", "Winch",
]  # fmt: skip
