"""The door to Taichi: starting it, memory, threads. All other modules import Taichi from here."""

from .runtime import ti

__all__ = ["ti"]
