"""What keeps particles where they should be: links, pins, walls and contacts."""

from .ball import Ball
from .box import Box
from .capsule import Capsule
from .contact import Contact
from .distance import Distance
from .half_space import HalfSpace
from .mesh import Mesh
from .pin import Pin
from .polygon import Polygon
from .rope import Rope
from .sdf import Sdf
from .spacer import Spacer

__all__ = ["Ball", "Box", "Capsule", "Contact", "Distance", "HalfSpace", "Mesh", "Pin", "Polygon", "Rope", "Sdf", "Spacer"]
