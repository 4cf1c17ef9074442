"""Export to glTF 2.0: an animated mesh for Blender, three.js and other programs.

Each frame but the first is a morph target, the displacement from the first frame, and weights interpolate between successive
frames. Positions are stored as recorded; a node above them rotates the scene so that up is y.
"""

import json
import os
import re
import struct
from dataclasses import replace
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from ...colliders.round_mesh import rounded
from ...shapes import Shape
from ..surfaces import normals
from .geometry import Geometry, flat, linear, turn
from .sketch import extent
from .stretch import Stretch, in_space, only
from .walls import Wall, drawn_walls

if TYPE_CHECKING:
    from ..replay import Replay

SPHERES = 2000  # most particles drawn as spheres, each a moving node; with more, loose particles become points
MOST = 2**32 - 1  # most bytes of a .glb file
POINTS, LINES, TRIANGLES = 0, 1, 4  # glTF's numbers for kinds of primitives
FLOAT, UINT, BYTE = 5126, 5125, 5121  # for types of numbers
VERTICES, INDICES = 34962, 34963  # for uses of buffers


def write(recording: "Replay", path: str, *, shape: Shape | None = None, motion: bool = False, color: Any = None) -> list[str]:
    """Write surfaces with normals, colours and texture coordinates, other links as lines, particles, and walls that may move.

    Particles that no surface hides are spheres of their radii, or points. motion: spheres turn as their orientations do. A vertex
    has one colour in a file: that of a quantity is of the last frame.
    """
    stretch = only(recording, path, "mesh", ".csv, .obj, .pvd, .usd or .xyz", motion, color)
    geometries = [*stretch.geometries(shape)]
    geometry = replace(geometries[0], hues=geometries[-1].hues)
    both = [(flat(x), in_space(moved)) for (_, _, x), moved in zip(stretch, stretch.motion, strict=False)]
    x = np.array([x for x, _ in both], dtype=np.float32)
    if not (x.size and np.isfinite(x).all()):
        why = "has positions that are not finite" if x.size else "has no particles"
        raise ValueError(f"replay: {recording.path} {why}, which glTF cannot say; export to .csv, .obj, .pvd, .usd or .xyz.")
    times = stretch.times.astype(np.float32)
    later = np.append(np.diff(times) > 0, True)  # of several frames at the same time, keep the last
    ends = extent(stretch.parts, x[:, :, : stretch.parts.particles.dim])
    walls = [wall.at(later) for wall in drawn_walls(stretch, *ends)]
    hues = np.concatenate([geometry.hues, *(np.repeat(wall.hue, wall.corners.shape[1], axis=0) for wall in walls)])
    turned = [moved["orientation"] for _, moved in both if "orientation" in moved]
    scene = _Scene(np.concatenate([x[later], *(wall.corners for wall in walls)], axis=1), times[later])
    single = geometry.bare if len(geometry.bare) <= SPHERES else geometry.bare[:0]
    unbroken = [g.links for g, kept in zip(geometries, later.tolist(), strict=True) if kept]
    nodes = _meshes(scene, geometry, unbroken, np.setdiff1d(geometry.loose, single))
    nodes += _spheres(scene, stretch, geometry, single, np.array(turned)[later] if turned else None)
    begin = x.shape[1]
    for wall in walls:
        nodes.append(_wall(scene, wall, begin, hues))
        begin += wall.corners.shape[1]
    return scene.save(path, turn(geometry.up), nodes)


def _meshes(scene: "_Scene", geometry: Geometry, unbroken: list[np.ndarray], points: np.ndarray) -> list[int]:
    """Return one node for all surfaces, one for links and one for points, as far as there are any.

    They are separate, since programs mix up several kinds of primitives in one animated mesh (VTK 9.7). unbroken: the links of
    each frame, (m, 2). points: particles.
    """
    at, uv, triangles = _vertices(geometry)
    nodes = []
    if len(at):
        normals = np.array([_normals(x, at, triangles) for x in scene.x], dtype=np.float32)
        nodes.append(scene.moving("surfaces", scene.primitive(TRIANGLES, at, geometry.hues, triangles, normals, uv)))
    if len(geometry.links):
        ends, pairs = _ends(unbroken)
        nodes.append(scene.moving("links", scene.primitive(LINES, ends, geometry.hues, pairs)))
    if len(points):
        nodes.append(scene.moving("points", scene.primitive(POINTS, points, geometry.hues)))
    return nodes


def _ends(unbroken: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the particle of each vertex of links, (v,) or in each frame (frames, v), and the vertices of each link, (m, 2).

    unbroken: the links of each frame, (m, 2). A mesh has the same links in all frames, so where some break, each link has two
    vertices of its own, and the second moves to the first when it breaks.
    """
    links = unbroken[0]
    if len(unbroken[-1]) == len(links):
        return np.unique(links, return_inverse=True)
    size = links.max() + 1
    whole = np.array([np.isin(links @ [size, 1], now @ [size, 1]) for now in unbroken])
    ends = np.stack([np.broadcast_to(links[:, 0], whole.shape), np.where(whole, links[:, 1], links[:, 0])], axis=-1)
    return ends.reshape(len(ends), -1), np.arange(links.size).reshape(-1, 2)


def _vertices(geometry: Geometry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the particle of each vertex, its texture coordinates ((0, 2) without any), and triangles of vertices.

    A particle with several texture coordinates becomes as many vertices.
    """
    around, uv = geometry.around, geometry.texture
    if not len(uv):
        at, vertex = np.unique(around, return_inverse=True)
        return at, uv, vertex.ravel()[geometry.corners]
    rows, vertex = np.unique(np.column_stack([around, uv]), axis=0, return_inverse=True)
    return rows[:, 0].astype(np.int64), rows[:, 1:], vertex.ravel()[geometry.corners]


def _normals(x: np.ndarray, at: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return unit normals at vertices, (v, 3): area-weighted means over the triangles at a particle.

    at: the particle of each vertex.
    """
    normal = normals(x, at[triangles])[at]
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(size > 0, normal / np.where(size > 0, size, 1), [0.0, 1.0, 0.0])


def _wall(scene: "_Scene", wall: Wall, begin: int, hues: np.ndarray) -> int:
    """Return the node of a wall, whose corners are the points from `begin` on."""
    at = begin + np.arange(wall.corners.shape[1])
    if not wall.solid:
        return scene.moving(wall.name, scene.primitive(LINES, at, hues, wall.parts))
    normals = np.array([_normals(x, at, wall.parts) for x in scene.x], dtype=np.float32)
    return scene.moving(wall.name, scene.primitive(TRIANGLES, at, hues, wall.parts, normals))


def _continuous(turned: np.ndarray) -> np.ndarray:
    """Return quaternions (frames, 4), each with the sign that is nearer to the one before: interpolation takes the short way."""
    flips = np.cumprod(np.where((turned[1:] * turned[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    return (turned * np.append(1.0, flips)[:, None]).astype(np.float32)


def _spheres(scene: "_Scene", stretch: Stretch, geometry: Geometry, single: np.ndarray, turned: np.ndarray | None) -> list[int]:
    """Return a node for each particle, which moves with it. turned: orientations, (frames, n, 4), if spheres turn."""
    if not len(single):
        return []
    vertices, faces = rounded(np.zeros(3), np.zeros(3), 1.0)
    position = scene.add(vertices.astype(np.float32), "VEC3", VERTICES, ends=True)
    normal = scene.add(vertices.astype(np.float32), "VEC3", VERTICES)
    corners = scene.add(faces.astype(np.uint32).ravel(), "SCALAR", INDICES)
    meshes: dict[tuple, int] = {}
    radius, nodes = stretch.column("radius"), []
    for i in single.tolist():
        hue = tuple(linear(geometry.hues[i]).tolist())
        if hue not in meshes:
            attributes = {"POSITION": position, "NORMAL": normal}
            part = {"mode": TRIANGLES, "attributes": attributes, "indices": corners, "material": scene.material(hue)}
            meshes[hue] = scene.mesh("particle", part)
        place = scene.x[:, i]
        at, size = place[0].tolist(), [float(radius[i])] * 3
        node = scene.put("nodes", name=f"particle {i}", mesh=meshes[hue], translation=at, scale=size)
        if (place != place[0]).any():
            scene.animate(node, "translation", scene.sampler(place, "VEC3"))
        if turned is not None and len(turned) > 1:
            scene.animate(node, "rotation", scene.sampler(_continuous(turned[:, i]), "VEC4"))
        nodes.append(node)
    return nodes


class _Scene:
    """A glTF file under construction. x: (frames, n, 3) [m]. times: (frames,) [s]."""

    def __init__(self, x: np.ndarray, times: np.ndarray):
        self.x = x
        lists = ("scenes", "nodes", "meshes", "materials", "accessors", "bufferViews")
        self._file: dict[str, Any] = {"asset": {"version": "2.0", "generator": "tiverlet"}, "scene": 0, **{n: [] for n in lists}}
        self._blocks: list[bytes] = []
        self._size = 0
        self._plain = self.material((1.0, 1.0, 1.0))
        self._channels: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        self._weights: int | None = None  # the sampler of morph weights, for all meshes
        self._times = self.add(times, "SCALAR", ends=True) if len(x) > 1 else None

    def put(self, kind: str, **what: Any) -> int:
        """Add an object to the list of its kind; return its number. What is None is left out."""
        self._file[kind].append({name: value for name, value in what.items() if value is not None})
        return len(self._file[kind]) - 1

    def add(self, array: np.ndarray, kind: str, use: int | None = None, *, ends: bool = False) -> int:
        """Add an array; return the number of its accessor.

        use: VERTICES or INDICES. ends: also store the least and largest values. Bytes count as shares of 255.
        """
        data = np.ascontiguousarray(array).tobytes()
        number = {"f4": FLOAT, "u4": UINT, "u1": BYTE}[array.dtype.str[1:]]
        rows = array.reshape(-1, 1) if kind == "SCALAR" else array.reshape(len(array), -1)
        limits = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()} if ends else {}
        view = self.put("bufferViews", buffer=0, byteOffset=self._size, byteLength=len(data), target=use)
        self._blocks.append(data)
        self._size += len(data)  # a multiple of 4 for all arrays here
        what = {"componentType": number, "normalized": number == BYTE, "count": len(rows), "type": kind}
        return self.put("accessors", bufferView=view, **what, **limits)

    def material(self, hue: tuple) -> int:
        """Add a matte two-sided material; return its number."""
        look = {"baseColorFactor": [*hue, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
        return self.put("materials", pbrMetallicRoughness=look, doubleSided=True)

    def primitive(self, mode: int, at: np.ndarray, hues: np.ndarray, indices=None, normals=None, uv=()) -> dict[str, Any]:
        """Return a primitive whose vertices move with the particles `at`, (vertices,) or in each frame (frames, vertices).

        normals: (frames, vertices, 3).
        """
        at = np.broadcast_to(at, (len(self.x), at.shape[-1]))
        hue = np.column_stack([np.rint(255 * linear(hues[at[0]])), np.full(at.shape[1], 255)]).astype(np.uint8)
        first = {"POSITION": self.add(self.x[0, at[0]], "VEC3", VERTICES, ends=True), "COLOR_0": self.add(hue, "VEC4", VERTICES)}
        if normals is not None:
            first["NORMAL"] = self.add(normals[0], "VEC3", VERTICES)
        if len(uv):  # glTF's v axis points down
            first["TEXCOORD_0"] = self.add(np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1).astype(np.float32), "VEC2", VERTICES)
        targets = []
        stands = all((self.x[k, at[k]] == self.x[0, at[0]]).all() for k in range(1, len(self.x)))
        for k in range(1, 1 if stands else len(self.x)):
            targets.append({"POSITION": self.add(self.x[k, at[k]] - self.x[0, at[0]], "VEC3", VERTICES, ends=True)})
            if normals is not None:
                targets[-1]["NORMAL"] = self.add(normals[k] - normals[0], "VEC3", VERTICES)
        corners = None if indices is None else self.add(indices.astype(np.uint32).ravel(), "SCALAR", INDICES)
        part = {"mode": mode, "attributes": first, "indices": corners, "targets": targets, "material": self._plain}
        return {name: value for name, value in part.items() if value is not None and value != []}

    def mesh(self, name: str, part: dict[str, Any]) -> int:
        """Add a mesh; return its number."""
        weights = [0.0] * len(part.get("targets", ()))
        return self.put("meshes", name=name, primitives=[part], weights=weights or None)

    def moving(self, name: str, part: dict[str, Any]) -> int:
        """Add a node with a mesh that follows the frames; return its number."""
        node = self.put("nodes", name=name, mesh=self.mesh(name, part))
        if "targets" in part:
            if self._weights is None:
                self._weights = self.sampler(np.eye(len(self.x), dtype=np.float32)[:, 1:].ravel(), "SCALAR")
            self.animate(node, "weights", self._weights)
        return node

    def sampler(self, values: np.ndarray, kind: str) -> int:
        """Add values at the times of all frames, linear in between; return the number of the sampler."""
        self._samplers.append({"input": self._times, "output": self.add(values, kind), "interpolation": "LINEAR"})
        return len(self._samplers) - 1

    def animate(self, node: int, what: str, sampler: int) -> None:
        """Animate a property of a node by a sampler."""
        self._channels.append({"sampler": sampler, "target": {"node": node, "path": what}})

    def save(self, path: str, rotation: list[float], nodes: list[int]) -> list[str]:
        """Put nodes below a root with this rotation, and write the file, or two files for .gltf; return their names."""
        self.put("scenes", nodes=[self.put("nodes", name="scene", rotation=rotation, children=nodes or None)])
        file = self._file
        if self._channels:
            file["animations"] = [{"name": "recording", "channels": self._channels, "samplers": self._samplers}]
        file["buffers"] = [{"byteLength": self._size}]
        file = {name: value for name, value in file.items() if value != []}  # glTF has no empty lists
        if path.lower().endswith(".glb"):
            text = json.dumps(file, separators=(",", ":")).encode()
            text += b" " * (-len(text) % 4)
            size = 28 + len(text) + self._size
            if size > MOST:
                raise ValueError(f"replay: {path} would have more than 4 GiB, the most of a .glb file; export to .gltf or .obj.")
            with open(path, "wb") as out:
                out.write(struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON"))
                out.write(text)
                out.write(struct.pack("<I4s", self._size, b"BIN\0"))
                out.writelines(self._blocks)
            return [path]
        beside = f"{os.path.splitext(path)[0]}.bin"
        with open(beside, "wb") as out:
            out.writelines(self._blocks)
        name = os.path.basename(beside)
        file["buffers"][0]["uri"] = re.sub("[%#?]", lambda found: quote(found[0]), name)  # these end a path in a URI
        with open(path, "w", encoding="utf-8") as out:
            json.dump(file, out)
        return [path, beside]
