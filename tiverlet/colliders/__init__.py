"""Walls that particles stay outside of, or inside: static or moved by the user."""

from .ball import Ball
from .box import Box
from .capsule import Capsule
from .half_space import HalfSpace
from .mesh import Mesh
from .polygon import Polygon
from .sdf import Sdf

__all__ = ["Ball", "Box", "Capsule", "HalfSpace", "Mesh", "Polygon", "Sdf"]
