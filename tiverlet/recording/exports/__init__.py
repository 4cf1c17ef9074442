"""Recordings for other programs: a file for each format. Here the ending of a path selects the format.

A new format is one file with write(recording, path), which returns the names of the files that it wrote, and one line here.
"""

import os
from typing import TYPE_CHECKING

from ...shapes import Shape
from . import arrays, film, gltf, obj, table, vtk, xyz

if TYPE_CHECKING:
    from ..replay import Replay

NUMBERS = {".npz": arrays.write, ".csv": table.write, ".xyz": xyz.write}
SHAPED = {  # formats that accept a shape
    ".glb": gltf.write, ".gltf": gltf.write, ".obj": obj.write, ".pvd": vtk.write,
    ".gif": film.write, ".mp4": film.write, ".webp": film.write,
}  # fmt: skip
ENDINGS = sorted([*NUMBERS, *SHAPED])


def export(recording: "Replay", path: str, shape: Shape | None = None) -> list[str]:
    """Write a recording in the format of the ending of `path`; see Replay.export()."""
    kind = os.path.splitext(path)[1].lower()
    if kind not in ENDINGS:
        raise ValueError(f"replay: {path} ends in {kind!r}, but {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]} can be written.")
    if not isinstance(shape, Shape | None):
        raise TypeError(f"replay: shape = {shape!r} is a {type(shape).__name__}, but a tv.shapes.Shape is needed.")
    if shape is not None and kind not in SHAPED:
        raise ValueError(f"replay: {path} has no faces, so it takes no shape; {', '.join(sorted(SHAPED))} do.")
    folder = os.path.dirname(os.path.abspath(path))
    if not os.path.isdir(folder):
        raise FileNotFoundError(f"The folder of {path} does not exist.")
    return SHAPED[kind](recording, path, shape) if kind in SHAPED else NUMBERS[kind](recording, path)
