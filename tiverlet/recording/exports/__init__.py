"""Recordings for other programs: a file for each format. Here the ending of a path selects the format.

A new format is one file with write(recording, path, *, ...), which returns the names of the files that it wrote, and one line
here. The arguments after * are those of Replay.export() that the format takes.
"""

import inspect
import os
from typing import TYPE_CHECKING, Any

from ...shapes import Shape
from . import arrays, film, gltf, obj, table, usd, vtk, xyz

if TYPE_CHECKING:
    from ..replay import Replay

FORMATS = {
    ".csv": table.write, ".gif": film.write, ".glb": gltf.write, ".gltf": gltf.write, ".mp4": film.write, ".npz": arrays.write,
    ".obj": obj.write, ".pvd": vtk.write, ".usd": usd.write, ".usda": usd.write, ".usdc": usd.write, ".webp": film.write,
    ".xyz": xyz.write,
}  # fmt: skip
ENDINGS = sorted(FORMATS)


def export(recording: "Replay", path: str, **given: Any) -> list[str]:
    """Write a recording in the format of the ending of `path`; see Replay.export(). given: None where not given."""
    kind = os.path.splitext(path)[1].lower()
    if kind not in ENDINGS:
        raise ValueError(f"replay: {path} ends in {kind!r}, but {', '.join(ENDINGS[:-1])} or {ENDINGS[-1]} can be written.")
    if not isinstance(shape := given["shape"], Shape | None):
        raise TypeError(f"replay: shape = {shape!r} is a {type(shape).__name__}, but a tv.shapes.Shape is needed.")
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in takes(kind):
            raise ValueError(f"replay: {path} takes no {name}; {', '.join(end for end in ENDINGS if name in takes(end))} do.")
    folder = os.path.dirname(os.path.abspath(path))
    if not os.path.isdir(folder):
        raise FileNotFoundError(f"The folder of {path} does not exist.")
    return FORMATS[kind](recording, path, **given)


def takes(kind: str) -> list[str]:
    """Return the names of the arguments of Replay.export() that a format takes, by its ending."""
    return [name for name, p in inspect.signature(FORMATS[kind]).parameters.items() if p.kind is p.KEYWORD_ONLY]
