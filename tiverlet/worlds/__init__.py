"""Many worlds at once."""

from .worlds import Rollout, Worlds

__all__ = ["Rollout", "Worlds"]
