"""Export to a table with a row for each particle in each frame."""

from typing import TYPE_CHECKING

import numpy as np

from .stretch import stretches

if TYPE_CHECKING:
    from ..replay import Replay

NAMES = {  # columns by quantity and dimension
    "velocity": {2: "vx,vy", 3: "vx,vy,vz"}, "spin": {2: "spin", 3: "spin_x,spin_y,spin_z"},
    "orientation": {2: "angle", 3: "qx,qy,qz,qw"},
}  # fmt: skip


def write(recording: "Replay", path: str, *, motion: bool = False) -> list[str]:
    """Write positions, radii and motion to a .csv file. Cells stay empty before the first particle that spins is added."""
    found = stretches(recording, motion)
    names = [n for n in NAMES if motion and (n == "velocity" or any(n in s.entry.arrays for s in found))]
    with open(path, "w", encoding="ascii") as out:
        for first, stretch in enumerate(found):
            radii, dim = stretch.column("radius").tolist(), stretch.column("position").shape[1]
            if not first:
                columns = ["frame,time,particle", "x,y,z"[: 2 * dim - 1], "radius", *(NAMES[n][dim] for n in names)]
                out.write(f"{','.join(columns)}\n")
            there = "".join((",%.9g" if n in stretch.entry.arrays else ",") * len(NAMES[n][dim].split(",")) for n in names)
            rows = "".join(f"\0,{i}{',%.9g' * dim},{r:.9g}{there}\n" for i, r in enumerate(radii))
            for (frame, time, x), moved in zip(stretch, stretch.motion, strict=False):
                table = np.column_stack([x, *moved.values()])
                out.write((rows % tuple(table.ravel().tolist())).replace("\0", f"{frame},{time!r}"))
    return [path]
