"""Export to a table with a row for each particle in each frame."""

from typing import TYPE_CHECKING

from .stretch import stretches

if TYPE_CHECKING:
    from ..replay import Replay


def write(recording: "Replay", path: str) -> list[str]:
    """Write positions to a .csv file."""
    with open(path, "w", encoding="ascii") as out:
        for first, stretch in enumerate(stretches(recording)):
            dim = stretch.entry.arrays["position"].shape[1]
            if not first:
                out.write(f"frame,time,particle,{','.join('xyz'[:dim])}\n")
            rows = "".join(f"\0,{i}{',%.9g' * dim}\n" for i in range(len(stretch.column("mass"))))
            for frame, time, x in stretch:
                out.write((rows % tuple(x.ravel().tolist())).replace("\0", f"{frame},{time!r}"))
    return [path]
