"""Particles: the user's arrays, the state that a world keeps on the device, and spin."""

from .particles import LARGEST, TURNING, Particles, at_rest, in_range, spin_of
from .radii import Radii
from .state import State

__all__ = ["LARGEST", "TURNING", "Particles", "Radii", "State", "at_rest", "in_range", "spin_of"]
