"""Export to extended XYZ, which OVITO and ASE read."""

from typing import TYPE_CHECKING

import numpy as np

from .geometry import flat
from .stretch import in_space, stretches

if TYPE_CHECKING:
    from ..replay import Replay

NAMES = {"velocity": "velo:R:3", "spin": "angular_velocity:R:3", "orientation": "orientation:R:4"}  # as OVITO names columns


def write(recording: "Replay", path: str, *, motion: bool = False) -> list[str]:
    """Write positions and radii of each frame, and its motion. A 2D scene lies at z = 0."""
    with open(path, "w", encoding="ascii") as out:
        for stretch in stretches(recording, motion):
            radii, rows = stretch.column("radius").tolist(), ""
            for (frame, time, x), moved in zip(stretch, stretch.motion, strict=False):
                turned = in_space(moved)
                table = np.column_stack([flat(x), *turned.values()])
                rows = rows or "".join(f"X %.9g %.9g %.9g {r:.9g}{' %.9g' * (table.shape[1] - 3)}\n" for r in radii)
                columns = ":".join(["species:S:1:pos:R:3:radius:R:1", *(NAMES[name] for name in turned)])
                out.write(f'{len(x)}\nProperties={columns} Time={time!r} Frame={frame} pbc="F F F"\n')
                out.write(rows % tuple(table.ravel().tolist()))
    return [path]
