"""What keeps particles where they should be: links, pins, walls and contacts."""

from .box import Box
from .contact import Contact
from .distance import Distance
from .half_space import HalfSpace
from .pin import Pin
from .rope import Rope
from .spacer import Spacer

__all__ = ["Box", "Contact", "Distance", "HalfSpace", "Pin", "Rope", "Spacer"]
