"""Ready-made bodies as plain arrays: positions to put into Particles, and index tuples to put into constraints."""

from typing import TYPE_CHECKING, Any

from ..features.unknown_names import no_name
from .box import box
from .files import load, save
from .lines import bridge, chain, rope, tree
from .people import ragdoll
from .shape import Shape, join
from .sheets import cloth, net
from .solids import ball, balloon, blob, pile, polygon, truss

__all__ = [
    "Shape", "ball", "balloon", "blob", "box", "bridge", "chain", "cloth", "join", "load", "net", "pile", "polygon", "ragdoll",
    "rope", "save", "tree", "truss",
]  # fmt: skip

if not TYPE_CHECKING:  # type checkers know which names there are

    def __getattr__(name: str) -> Any:
        """Raise an AttributeError that says which name is meant."""
        raise no_name(__name__, name, __all__)
