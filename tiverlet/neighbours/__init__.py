"""Which particles are near: periodic boxes, cell list, search, neighbour list, queries."""

from .periodic import Periodic

__all__ = ["Periodic"]
