"""Reading and writing meshes as OBJ and PLY files. Both formats are short enough to need no library."""

import os
import re
from collections.abc import Sequence

import numpy as np

from .. import checks
from .shape import Shape, edges_of, quads_of

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@checks.answer_arguments
def load(path, dim: int = 3) -> Shape:
    """Read a body from an .obj or .ply file (ascii or binary): vertices, edges, faces, and tetrahedra if there are any.

    Faces of more than three corners are cut into fans. links: the edges in the file, or else those of faces and tetrahedra.
    PLY: elements vertex (x, y, z), edge (vertex1, vertex2), face, and tetrahedron, tetra, tet or cell (lists of indices).
    OBJ: v, vt, l and f; all other lines are ignored. The faces of the file, with texture coordinates, are kept in polygons and
    uv. dim = 2 drops z. Unused vertices are kept.
    Raises ValueError, with the line or the element, for what it cannot parse.
    """
    name = os.fspath(path)
    kind = os.path.splitext(name)[1].lower()
    if kind not in (".obj", ".ply"):
        raise ValueError(f"load: {name} ends with {kind!r}, but .obj and .ply are what can be read.")
    if dim not in (2, 3):
        raise ValueError(f"load: dim = {dim!r}, but it must be 2 or 3.")
    with open(name, "rb") as file:
        data = file.read()
    position, edges, faces, cells, polygons, uv = (_obj if kind == ".obj" else _ply)(name, data)
    checks.finite("load", f"vertices of {name}", position)
    for what, tuples in (("edge", edges), ("face", faces), ("tetrahedron", cells)):
        wrong = ((tuples < 0) | (tuples >= len(position))).any(axis=1)
        if wrong.any():
            k = int(np.argmax(wrong))
            raise ValueError(f"load: {name}: {what} {k} is {tuple(tuples[k].tolist())}, but there are {len(position)} vertices.")
    if not len(edges):
        edges = edges_of(cells) if len(cells) else edges_of(faces)
    quads = quads_of(faces) if dim == 3 else np.zeros((0, 4), dtype=np.int64)
    return Shape(position[:, :dim], edges, faces=faces, quads=quads, tetrahedra=cells, polygons=polygons, uv=uv)


@checks.answer_arguments
def save(path, shape: Shape, binary: bool = True) -> None:
    """Write a body to an .obj or .ply file: position, links, faces and (PLY) tetrahedra.

    In 2D z is 0. OBJ keeps the polygons and texture coordinates that came from a file; PLY has triangles.
    """
    name = os.fspath(path)
    kind = os.path.splitext(name)[1].lower()
    x = np.zeros((len(shape), 3))
    x[:, : shape.position.shape[1]] = shape.position
    if kind == ".obj":
        lines = [f"v {a!r} {b!r} {c!r}" for a, b, c in x.tolist()]
        lines += [f"l {i} {j}" for i, j in (shape.links + 1).tolist()]
        lines += obj_faces(*shape.surface)
        text = "\n".join(lines) + "\n"
        with open(name, "w", encoding="ascii") as file:
            file.write(text)
    elif kind == ".ply":
        with open(name, "wb") as file:
            file.write(_to_ply(x, shape, binary))
    else:
        raise ValueError(f"save: {name} ends with {kind!r}, but .obj and .ply are what can be written.")


def obj_faces(faces: Sequence[np.ndarray], uv: Sequence[np.ndarray]) -> list[str]:
    """Return the lines vt and f of an .obj file. uv: for each face the texture coordinates of its corners, or (0, 2)."""
    number: dict[tuple[float, float], int] = {}
    lines = []
    for face, at in zip(faces, uv, strict=True):
        corners = (face + 1).tolist()
        if len(at):
            places = [number.setdefault((u, v), len(number) + 1) for u, v in at.tolist()]
            lines.append("f " + " ".join(f"{i}/{k}" for i, k in zip(corners, places, strict=True)))
        else:
            lines.append("f " + " ".join(map(str, corners)))
    return [f"vt {u!r} {v!r}" for u, v in number] + lines


def _fans(polygons: list[list[int]]) -> np.ndarray:
    out = [(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)]
    return np.array(out, dtype=np.int64).reshape(-1, 3)


def _obj(name: str, data: bytes):
    points, places, edges, polygons, textures = [], [], [], [], []

    def numbers(words: list[str], count: int) -> list[int]:
        """Convert vertex numbers of a file to indices from 0; -1 for the invalid number 0."""
        return [i - 1 if i > 0 else count + i if i < 0 else -1 for i in map(int, words)]

    text = re.sub(r"\\\r?\n", " ", data.decode("utf-8-sig", "replace"))  # some programs begin a file with a byte order mark
    for number, line in enumerate(text.splitlines(), 1):
        kind, *words = line.partition("#")[0].split() or [""]
        try:
            if kind == "v":
                x, y, z = words[:3]
                points.append([float(x), float(y), float(z)])
            elif kind == "vt":
                u, v = [*words[:2], "0"][:2]
                places.append([float(u), float(v)])
            elif kind in ("l", "f"):
                corners = [f"{w}/".split("/") for w in words]
                indices = numbers([c[0] for c in corners], len(points))
                at = numbers([c[1] for c in corners], len(places)) if kind == "f" and all(c[1] for c in corners) else []
                if len(indices) < (2 if kind == "l" else 3) or (at and not 0 <= min(at) <= max(at) < len(places)):
                    raise ValueError
                if kind == "l":
                    edges += zip(indices, indices[1:], strict=False)
                else:
                    polygons.append(indices)
                    textures.append(at)
        except ValueError:
            raise ValueError(f"load: {name}, line {number}: {line.strip()!r} cannot be understood.") from None
    none = np.zeros((0, 4), dtype=np.int64)
    at = np.array(places).reshape(-1, 2)
    checks.finite("load", f"texture coordinates of {name}", at)
    plain = all(len(p) == 3 for p in polygons) and not any(textures)
    faces = () if plain else tuple(np.array(p, dtype=np.int64) for p in polygons)
    uv = () if plain else tuple(at[np.array(t, dtype=np.int64)] for t in textures)
    edges = np.array(edges, dtype=np.int64).reshape(-1, 2)
    return np.array(points).reshape(-1, 3), edges, _fans(polygons), none, faces, uv


def _header(name: str, data: bytes):
    """Return the format, the elements [(name, count, [(property, type, list count type or None)])], and the start of the body."""
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\r|\n|$)", data)
    if not data.startswith(b"ply") or end is None:
        raise ValueError(f"load: {name} is not a PLY file; it has no header.")
    kind, elements = "", []
    for line in data[: end.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        try:
            if words[:1] == ["format"]:
                kind = words[1]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1][2].append((words[4], _TYPES[words[3]], _TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1][2].append((words[2], _TYPES[words[1]], None))
        except (IndexError, KeyError, ValueError):
            raise ValueError(f"load: {name}: {line.strip()!r} in the header cannot be understood.") from None
    if kind not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise ValueError(f"load: {name}: format {kind!r} is unknown.")
    return kind, elements, end.end()


def _ply(name: str, data: bytes):
    kind, elements, at = _header(name, data)
    words, order, here = data[at:].split() if kind == "ascii" else [], ">" if "big" in kind else "<", 0
    found: dict[str, dict[str, list]] = {}

    def take(form: str, count: int) -> list:
        """Read the next `count` numbers."""
        nonlocal here, at
        if count < 0:
            raise ValueError
        if kind == "ascii":
            here += count
            if here > len(words):
                raise IndexError
            return [float(w) if form[0] == "f" else int(w) for w in words[here - count : here]]
        values = np.frombuffer(data, order + form, count, at)
        at += values.nbytes
        return values.tolist()

    for element, count, properties in elements:
        columns: dict[str, list] = {p: [] for p, _, _ in properties}
        for k in range(count):
            try:
                for p, form, many in properties:
                    columns[p].append(take(form, int(take(many, 1)[0])) if many else take(form, 1)[0])
            except (IndexError, ValueError):
                raise ValueError(f"load: {name}: element {element} {k} of {count} is incomplete or no number.") from None
        found[element] = columns
    vertex = found.get("vertex", {})
    if not all(c in vertex for c in "xyz"):
        raise ValueError(f"load: {name} has no vertices with x, y and z.")
    edge, cells = found.get("edge", {}), []
    for element in ("tetrahedron", "tetrahedra", "tetra", "tet", "cell"):
        for k, cell in enumerate(_lists(found, element)):
            if len(cell) != 4:
                raise ValueError(f"load: {name}: element {element} {k} has {len(cell)} corners, but tetrahedra have 4.")
            cells.append(cell)
    position = np.column_stack([np.array(vertex[c], dtype=np.float64) for c in "xyz"])
    edges = np.array([edge.get("vertex1", []), edge.get("vertex2", [])], dtype=np.int64).T
    return position, edges, _fans(_lists(found, "face")), np.array(cells, dtype=np.int64).reshape(-1, 4), (), ()


def _lists(found: dict, element: str) -> list:
    columns = found.get(element, {})
    return next((columns[p] for p in ("vertex_indices", "vertex_index", "indices") if p in columns), [])


def _to_ply(x: np.ndarray, shape: Shape, binary: bool) -> bytes:
    head = ["ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0", f"element vertex {len(x)}"]
    head += [f"property double {c}" for c in "xyz"]
    parts: list[tuple[np.ndarray, str]] = [(x, "<f8")]
    head += [f"element edge {len(shape.links)}", "property int vertex1", "property int vertex2"]
    parts.append((shape.links, "<i4"))
    for name, tuples in (("face", shape.faces), ("tetrahedron", shape.tetrahedra)):
        head += [f"element {name} {len(tuples)}", "property list int int vertex_indices"]
        parts.append((np.column_stack([np.full(len(tuples), tuples.shape[1]), tuples]), "<i4"))
    out = ("\n".join([*head, "end_header"]) + "\n").encode("ascii")
    if binary:
        return out + b"".join(values.astype(form).tobytes() for values, form in parts)
    rows = [" ".join(map(repr, row)) for values, _ in parts for row in values.tolist()]
    return out + ("\n".join(rows) + "\n").encode("ascii")
