"""What keeps particles where they should be: links, pins, walls and contacts."""

from .angle_limit import AngleLimit
from .area import Area
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
from .path import Path
from .pin import Pin
from .polygon import Polygon
from .polygons import Polygons
from .rope import Rope
from .sdf import Sdf
from .shape_match import ShapeMatch
from .snap import Snap
from .spacer import Spacer
from .volume import Volume

__all__ = [
    "AngleLimit", "Area", "Ball", "Bend", "Box", "Capsule", "Constraint", "Contact", "Dihedral", "Distance", "HalfSpace",
    "Mesh", "Path", "Pin", "Polygon", "Polygons", "Rope", "Sdf", "ShapeMatch", "Snap", "Spacer", "Volume",
]  # fmt: skip
