"""Export to extended XYZ, which OVITO and ASE read."""

from typing import TYPE_CHECKING

from .stretch import stretches

if TYPE_CHECKING:
    from ..replay import Replay


def write(recording: "Replay", path: str) -> list[str]:
    """Write positions, and radii if no particles are added or removed. A 2D scene lies at z = 0."""
    found = stretches(recording)
    same = len(found) == 1
    columns = "species:S:1:pos:R:3" + (":radius:R:1" if same else "")
    with open(path, "w", encoding="ascii") as out:
        for stretch in found:
            radii = stretch.column("radius").tolist()
            rows = "".join(f"X %.9g %.9g %.9g{f' {r:.9g}' if same else ''}\n" for r in radii)
            for frame, time, x in stretch:
                out.write(f'{len(x)}\nProperties={columns} Time={time!r} Frame={frame} pbc="F F F"\n')
                out.write(rows % tuple(stretch.flat(x).ravel().tolist()))
    return [path]
