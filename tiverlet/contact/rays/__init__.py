"""Queries: what rays meet first, and which particles are inside of a shape."""

from .inside import inside
from .ray import Hits, ray

__all__ = ["Hits", "inside", "ray"]
