"""What particles are: what the user gives, what a world keeps of them on the device, and how they spin."""

from .particles import LARGEST, TURNING, Particles, at_rest, in_range, spin_of
from .per_particle import Radii
from .state import State

__all__ = ["LARGEST", "TURNING", "Particles", "Radii", "State", "at_rest", "in_range", "spin_of"]
