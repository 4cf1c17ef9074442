"""Many worlds at once."""

from .gradient import Gradient, gradient
from .worlds import Rollout, Worlds

__all__ = ["Gradient", "Rollout", "Worlds", "gradient"]
