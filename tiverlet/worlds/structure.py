"""Which worlds can be stepped together: worlds with equal kernels."""

from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

from ..device.language import COMPILER
from ..features.feature import Batch

if TYPE_CHECKING:
    from ..world import World


def with_equal_kernels(worlds: "list[World]") -> "list[World]":
    """Return the worlds, with clones in place of those that were compiled differently.

    A world is cloned if it was compiled for a team of threads, or if its knobs need other kernels now.
    """
    return [
        world.clone(path="fused")
        if world.path != "fused" or any(f.changed and f.needs_other_kernels for f in world.features)
        else world
        for world in worlds
    ]


def check_structure(worlds: "Sequence[World]") -> None:
    """Raise ValueError for a world that does not fit the kernels of the first."""
    rule = (
        "They may differ in numbers only, not in how many particles and constraints there are, in what acts, on what, or in the "
        "vertices of a Polygon or a Mesh."
    )
    first = _structure(worlds[0])
    for k, world in enumerate(worlds[1:], 1):
        now = _structure(world)
        for what in ("settings", "features", "fields"):
            if now[what] != first[what]:
                ours, theirs = _difference(first[what], now[what])
                raise ValueError(f"Worlds: worlds[{k}] has {theirs}, where worlds[0] has {ours}. {rule}")
        if now["indices"] != first["indices"]:
            raise ValueError(f"Worlds: constraints of worlds[{k}] act on other particles than those of worlds[0]. {rule}")
        if now["kernels"] != first["kernels"]:
            raise ValueError(
                f"Worlds: kernels of worlds[{k}] have other constants than those of worlds[0], as Jacobi(relaxation='auto') "
                f"finds them for a scene, or functions of yours that know other values. {rule}"
            )


def _difference(ours: list[Any], theirs: list[Any]) -> tuple[str, str]:
    """Return the first items in which two lists differ, in words."""
    missing = object()
    for a, b in zip_longest(ours, theirs, fillvalue=missing):
        if a != b:
            return tuple("nothing" if v is missing else " ".join(map(str, v)) for v in (a, b))  # type: ignore[return-value]
    raise AssertionError("they are equal")


def _structure(world: "World") -> dict[str, Any]:
    """Return the data that must be equal in all worlds."""
    built = [(type(f).__name__, *(f._built_values or {}).items()) for f in world.features]
    out: dict[str, Any] = {
        "settings": [(name, "=", repr(value)) for name, value in world.settings.items()],
        "features": built,
        "fields": [("an array", e.name, "of shape", e.shape) for e in world._runner.memory.entries],
        "indices": [f.indices.tobytes() for f in world.features if isinstance(f, Batch)],
        "kernels": None,
    }
    if COMPILER == "taichi":  # the only compiler whose internals are known
        from ..device.patches.sharing import KernelInputs  # noqa: PLC0415

        fields = tuple(field for memory in world._runner.memories for field in memory.fields)
        out["kernels"] = KernelInputs(world._runner.step, known=fields).key  # with numbers in place of fields
    return out
