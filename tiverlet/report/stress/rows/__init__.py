"""The stiff and extreme matrix: rows, each a scene that is run, measured, and passes or fails by its own criterion.

A new row is one function with the decorator @row in a file here.
"""

from . import (  # noqa: F401  (they register their rows)
    bodily,
    invalid_arguments,
    linked,
    motion,
    networks,
    rays,
    sheets,
    spinning,
    taut,
    touching,
)
from .row import ROWS, Finding, NotAvailable, Row

__all__ = ["ROWS", "Finding", "NotAvailable", "Row"]
