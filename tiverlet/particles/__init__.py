"""What particles are: what the user gives, what a world keeps of them on the device, and how they spin."""

from .particles import LARGEST, TURNING, Particles, Radii, Shared, State, at_rest, in_range, spin_of

__all__ = ["LARGEST", "TURNING", "Particles", "Radii", "Shared", "State", "at_rest", "in_range", "spin_of"]
