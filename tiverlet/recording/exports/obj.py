"""Export to a sequence of Wavefront .obj files, one for each frame."""

from typing import TYPE_CHECKING

from ...shapes import Shape
from ...shapes.files import obj_faces
from ..viewer import numbered
from .geometry import flat
from .stretch import stretches

if TYPE_CHECKING:
    from ..replay import Replay


def write(recording: "Replay", path: str, *, shape: Shape | None = None) -> list[str]:
    """Write positions, faces, other links as lines, and loose particles as points.

    Faces and texture coordinates are those of `shape`; without it, faces are triangles.
    """
    out = []
    for stretch in stretches(recording):
        written, tail = None, ""
        rows = "v %.9g %.9g %.9g\n" * len(stretch.column("mass"))
        for (frame, time, x), geometry in zip(stretch, stretch.geometries(shape), strict=True):
            if geometry is not written:
                rest = [*obj_faces(geometry.faces, geometry.uv), *(f"l {i} {j}" for i, j in (geometry.links + 1).tolist())]
                rest += [f"p {i}" for i in (geometry.loose + 1).tolist()]
                written, tail = geometry, "".join(f"{line}\n" for line in rest)
            out.append(numbered(path, frame))
            with open(out[-1], "w", encoding="ascii") as file:
                file.write(f"# frame {frame}, {time!r} s\n")
                file.write(rows % tuple(flat(x).ravel().tolist()))
                file.write(tail)
    return out
