"""Which features are lines between two particles: what pictures draw, and rays meet."""

from typing import Any

from .feature import Batch


def links(world: Any) -> list[tuple[int, Batch]]:
    """Those of a world, or of what is like one, with their numbers."""
    return [(k, f) for k, f in enumerate(world.features) if isinstance(f, Batch) and f.arity == 2 and f.count]
