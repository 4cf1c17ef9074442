"""Ways to relax constraints."""

from .jacobi import Jacobi

__all__ = ["Jacobi"]
