"""The door to Taichi: starting it, memory, threads. All other modules import Taichi from here."""

from .runtime import ti  # first: it sets what Taichi reads when it is imported  # isort: skip
from .patches.compiler import inline, record  # next: what comes after it is imported in half the time  # isort: skip
from .patches.syntax_cache import at

__all__ = ["at", "inline", "record", "ti"]
