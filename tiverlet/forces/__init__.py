"""Forces that accelerate single particles, and forces between pairs."""

from .attractor import Attractor
from .drag import Drag
from .force import Force
from .gravity import Gravity
from .hand import Hand
from .pair_force import PairForce
from .wind import Wind

__all__ = ["Attractor", "Drag", "Force", "Gravity", "Hand", "PairForce", "Wind"]
