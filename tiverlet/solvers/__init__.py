"""Solvers of constraints: Jacobi, Chebyshev, ConjugateGradient, Direct."""

from .chebyshev import Chebyshev
from .conjugate import ConjugateGradient
from .direct import Direct
from .jacobi import Jacobi

__all__ = ["Chebyshev", "ConjugateGradient", "Direct", "Jacobi"]
