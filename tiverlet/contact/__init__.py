"""Contacts between particles, and between bodies made of them."""

from .contact import Contact
from .polygons import Polygons

__all__ = ["Contact", "Polygons"]
