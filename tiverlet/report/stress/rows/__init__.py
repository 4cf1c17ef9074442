"""The stiff and extreme matrix. Each row runs scenes, measures them, and passes or fails by its own criterion.

To add a row, add one function with the decorator @row in a file of this folder.
"""

from . import (  # noqa: F401  (they register their rows)
    apart,
    bodily,
    driven,
    invalid_arguments,
    linked,
    motion,
    networks,
    pressed,
    rays,
    sheets,
    spinning,
    stops,
    taut,
    touching,
)
from .row import ROWS, Row

__all__ = ["ROWS", "Row"]
