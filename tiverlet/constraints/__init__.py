"""What keeps particles where they should be: links, pins, walls and contacts."""

from .angle_limit import AngleLimit
from .ball import Ball
from .bend import Bend
from .box import Box
from .capsule import Capsule
from .constraint import Constraint
from .contact import Contact
from .dihedral import Dihedral
from .distance import Distance
from .half_space import HalfSpace
from .mesh import Mesh
from .pin import Pin
from .polygon import Polygon
from .rope import Rope
from .sdf import Sdf
from .spacer import Spacer

__all__ = [
    "AngleLimit", "Ball", "Bend", "Box", "Capsule", "Constraint", "Contact", "Dihedral", "Distance", "HalfSpace", "Mesh",
    "Pin", "Polygon", "Rope", "Sdf", "Spacer",
]  # fmt: skip
