"""Neighbours: periodic boxes, the cell list, the search for near pairs, the neighbour list, queries."""

from .periodic import Periodic

__all__ = ["Periodic"]
