"""Export to VTK for ParaView and VisIt: a .pvd file with the times, and a .vtu file for each frame.

They are written without a library. The parts that do not change are formatted once for all frames.
"""

import base64
import os
import sys
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from ...shapes import Shape
from ..viewer import numbered
from .geometry import Geometry, flat
from .stretch import Stretch, in_space, stretches

if TYPE_CHECKING:
    from ..replay import Replay

VERTEX, LINE, TRIANGLE, POLYGON, QUAD = 1, 3, 5, 7, 9  # VTK's numbers for kinds of cells
KINDS = {"f4": "Float32", "f8": "Float64", "i4": "Int32", "u1": "UInt8"}
ORDER = "LittleEndian" if sys.byteorder == "little" else "BigEndian"


def write(recording: "Replay", path: str, *, shape: Shape | None = None, motion: bool = False, color: Any = None) -> list[str]:
    """Write points with radius [m], mass [kg], color and motion, and cells: faces, other links, loose particles."""
    base, out, sets = os.path.splitext(path)[0], [path], []
    for stretch in stretches(recording, motion, color):
        laid_out = None
        for (frame, time, x), geometry, moved in zip(stretch, stretch.geometries(shape), stretch.motion, strict=False):
            if geometry is not laid_out:
                laid_out, (before, after) = geometry, _laid_out(stretch, geometry)
            name = numbered(f"{base}.vtu", frame)
            with open(name, "wb") as file:
                more = [_array(name, values) for name, values in in_space(moved).items()]
                place = _array("position", flat(x).astype(np.float32))
                file.writelines([before, *more, b"</PointData>\n<Points>\n", place, after])
            out.append(name)
            sets.append(f'<DataSet timestep="{time!r}" file={quoteattr(os.path.basename(name))}/>\n')
    with open(path, "w", encoding="utf-8") as file:
        file.write(f'<VTKFile type="Collection" version="1.0" byte_order="{ORDER}">\n<Collection>\n')
        file.writelines(sets)
        file.write("</Collection>\n</VTKFile>\n")
    return out


def _laid_out(stretch: Stretch, geometry: Geometry) -> tuple[bytes, bytes]:
    """Return the text that stays until links break or colours change, before motion and positions, and after them."""
    rows = [*geometry.faces, *geometry.links, *geometry.loose[:, None]]
    kinds = [{3: TRIANGLE, 4: QUAD}.get(len(face), POLYGON) for face in geometry.faces]
    kinds += [LINE] * len(geometry.links) + [VERTEX] * len(geometry.loose)
    around = np.concatenate([[], *rows]).astype(np.int32)
    ends = np.cumsum([len(row) for row in rows]).astype(np.int32)
    before = (
        f'<VTKFile type="UnstructuredGrid" version="1.0" byte_order="{ORDER}" header_type="UInt64">\n<UnstructuredGrid>\n'
        f'<Piece NumberOfPoints="{len(stretch.column("mass"))}" NumberOfCells="{len(rows)}">\n<PointData>\n'
    ).encode()
    before += b"".join(_array(name, stretch.column(name)) for name in ("radius", "mass")) + _array("color", geometry.hues)
    cells = [_array("connectivity", around), _array("offsets", ends), _array("types", np.array(kinds, dtype=np.uint8))]
    after = [b"</Points>\n<Cells>\n", *cells, b"</Cells>\n</Piece>\n</UnstructuredGrid>\n</VTKFile>\n"]
    return before, b"".join(after)


def _array(name: str, array: np.ndarray) -> bytes:
    """Return an array in base 64, with its size before it."""
    wide = f' NumberOfComponents="{array.shape[1]}"' if array.ndim == 2 else ""
    data = base64.b64encode(np.uint64(array.nbytes).tobytes() + array.tobytes())
    head = f'<DataArray type="{KINDS[array.dtype.str[1:]]}" Name="{name}"{wide} format="binary">'
    return head.encode() + data + b"</DataArray>\n"
