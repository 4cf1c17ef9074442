"""VTK: a .pvd file, which says when, and a .vtu file for each frame. ParaView and VisIt read them.

They are written here: by meshio 250 frames of a cloth of 60 x 60 take a second more, since it lays out anew what stays.
"""

import os
import sys
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import numpy as np

from ...shapes import Shape
from .bodies import Bodies
from .names import numbered
from .stretch import Stretch, stretches

if TYPE_CHECKING:
    from ..replay import Replay

VERTEX, LINE, TRIANGLE, POLYGON, QUAD = 1, 3, 5, 7, 9  # VTK's numbers of kinds of cells
KINDS = {"f4": "Float32", "f8": "Float64", "i4": "Int32", "u1": "UInt8"}
ORDER = "LittleEndian" if sys.byteorder == "little" else "BigEndian"


def write(recording: "Replay", path: str, shape: Shape | None) -> list[str]:
    """Points with radius [m] and mass [kg], and cells: faces, links without a surface, loose particles."""
    base, out, sets = os.path.splitext(path)[0], [path], []
    for stretch in stretches(recording):
        head, before, after = _laid_out(stretch, stretch.bodies(shape))
        for frame, time, x in stretch:
            name = numbered(f"{base}.vtu", frame)
            with open(name, "wb") as file:
                file.writelines([head, before, _block(stretch.flat(x).astype(np.float32)), after])
            out.append(name)
            sets.append(f'<DataSet timestep="{time!r}" file={quoteattr(os.path.basename(name))}/>\n')
    with open(path, "w", encoding="utf-8") as file:
        file.write(f'<VTKFile type="Collection" version="1.0" byte_order="{ORDER}">\n<Collection>\n')
        file.writelines(sets)
        file.write("</Collection>\n</VTKFile>\n")
    return out


def _laid_out(stretch: Stretch, bodies: Bodies) -> tuple[bytes, bytes, bytes]:
    """What is the same in all files: the head, and what stands before and after the positions."""
    rows = [*bodies.faces, *bodies.links, *bodies.loose[:, None]]
    kinds = [{3: TRIANGLE, 4: QUAD}.get(len(face), POLYGON) for face in bodies.faces]
    kinds += [LINE] * len(bodies.links) + [VERTEX] * len(bodies.loose)
    count = len(stretch.column("mass"))
    arrays = {
        "radius": stretch.column("radius"), "mass": stretch.column("mass"), "points": np.zeros((count, 3), np.float32),
        "connectivity": np.concatenate([[], *rows]).astype(np.int32),
        "offsets": np.cumsum([len(row) for row in rows]).astype(np.int32), "types": np.array(kinds, dtype=np.uint8),
    }  # fmt: skip
    at, said, blocks = 0, {}, {}
    for name, array in arrays.items():
        wide = ' NumberOfComponents="3"' if name == "points" else ""
        said[name] = f'<DataArray type="{KINDS[array.dtype.str[1:]]}" Name="{name}"{wide} format="appended" offset="{at}"/>\n'
        blocks[name] = _block(array)
        at += len(blocks[name])
    text = (
        f'<VTKFile type="UnstructuredGrid" version="1.0" byte_order="{ORDER}" header_type="UInt64">\n'
        f'<UnstructuredGrid>\n<Piece NumberOfPoints="{count}" NumberOfCells="{len(rows)}">\n'
        f"<PointData>\n{said['radius']}{said['mass']}</PointData>\n<Points>\n{said['points']}</Points>\n"
        f"<Cells>\n{said['connectivity']}{said['offsets']}{said['types']}</Cells>\n"
        '</Piece>\n</UnstructuredGrid>\n<AppendedData encoding="raw">\n_'
    )
    names = list(arrays)
    middle = names.index("points")
    before = b"".join(blocks[name] for name in names[:middle])
    after = b"".join(blocks[name] for name in names[middle + 1 :])
    return text.encode(), before, after + b"\n</AppendedData>\n</VTKFile>\n"


def _block(array: np.ndarray) -> bytes:
    """An array with its size before it, as in appended data."""
    return np.uint64(array.nbytes).tobytes() + np.ascontiguousarray(array).tobytes()
