"""Exports: other programs read what was recorded."""

import functools
import json
import pathlib
import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable

import imageio_ffmpeg
import meshio
import numpy as np
import pytest
from PIL import Image, ImageSequence

import tiverlet as tv
from tiverlet.__main__ import main
from tiverlet.device import ti
from tiverlet.recording import Replay
from tiverlet.recording.exports.geometry import oriented

S = tv.shapes
TEXT = """# a roof: a square and a triangle
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0.5 2 0.5
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vt 0.25 0.875
vt 0.5 0.5
f 1/1 2/2 3/3 4/4
f 4/6 3/3 5/5
"""


@ti.func
def breeze(x):
    """A force of the user's."""
    return 0.1 * x


@pytest.fixture(scope="module")
def roof(tmp_path_factory) -> S.Shape:
    """Return a shape from a file, with a quad and texture coordinates; one particle has two of these."""
    path = tmp_path_factory.mktemp("roof") / "roof.obj"
    path.write_text(TEXT)
    return S.load(path)


class Recorded:
    """A recording in which much happens, and what was in each of its frames, in space.

    In space, a roof; then a rope of two links, of which the lower one breaks; a grain; and a bead on a wire. All turn. A grain
    may be poured. Walls move and are switched off.
    """

    def __init__(self, path: pathlib.Path, roof: S.Shape, dim: int, poured: bool):
        self.dim, self.poured, self.frames, self.path = dim, poured, [], path
        self.roof, up = 5 * (dim == 3), np.eye(dim)[-1]
        e = np.eye(dim)[0]
        alone = S.Shape(np.array([3 * e + 2 * up, 4 * e + 2 * up]), radius=np.array([0.25, 0.0]))
        parts = [S.rope(2 * e, 2 * e - up, points=3), alone]
        self.shape, slices = S.join(*([roof] if self.roof else []), *parts)
        n, (self.rope, self.grain) = len(self.shape), (s.start for s in slices[-2:])
        spin = np.random.default_rng(0).normal(size=(3, n) if dim == 3 else n) * (self.shape.radius > 0)
        motion = {"velocity": 0.5 * e * (np.arange(n) < self.roof)[:, None], "spin": spin.T, "orientation": 0.0}
        mass = 1 + np.arange(n) / 8
        start = tv.Particles(self.shape.position, mass=mass, radius=self.shape.radius, pinned=[self.rope], **motion)
        strength = [*[np.inf] * (len(self.shape.links) - 1), 5.0]
        gravity, self.link = tv.Gravity(-up), tv.Distance(self.shape.links, break_at=strength)
        floor, lid, gate = tv.HalfSpace(up, -1.5), tv.HalfSpace(-up, -2.5), tv.Ball(e, 0.5, active=True)
        wire = tv.Path([n - 1], [4 * e + 2 * up, 4 * e + up])
        features = [gravity, floor, lid, gate, wire, self.link, tv.Force(breeze)]
        features += [tv.Dihedral(self.shape.quads)] if self.roof else []
        with tv.World(start, features, substeps=2) as w, tv.Recorder(path, w) as recorder:
            self.keep(w)
            for frame in range(1, 7):
                gravity.g = -up * (1.0 if frame < 4 else 10.0)  # the lower link bears 5 N, and the weight has 1.5 or 1.9 kg
                lid.offset, gate.active = -2.5 + 0.1 * frame, frame < 3
                if frame == 2 and poured:
                    w.add(tv.Particles([3 * e], radius=0.5, spin=0.0, orientation=0.0))
                w.step(1 / 60)
                recorder.log()
                self.keep(w)
        self.replay, self.given = tv.replay(path), tv.replay(path, [breeze])  # to compute motion again needs the function

    def keep(self, w: tv.World) -> None:
        """Note what a frame holds."""
        links = [pair for pair in self.link.indices[~self.link.broken].tolist() if max(pair) >= self.roof]
        loose = np.setdiff1d(np.arange(self.roof, len(w.particles)), links).tolist()
        faces = [[0, 1, 2], [0, 2, 3], [2, 3, 4]] if self.roof else []
        more = {"velocity": w.velocity, "spin": w.spin, "orientation": w.orientation}
        found = {"time": w.time, "position": w.position.astype(np.float32), "radius": w.particles.radius, **more}
        self.frames.append(in_space(found | {"links": links, "loose": loose, "faces": faces}))


def in_space(row: dict) -> dict:
    """Return a frame in 3D: a plane is at z = 0, spins are about z, and an angle a is (0, 0, sin a/2, cos a/2)."""
    n, out = len(row["position"]), dict(row)
    for name in ("position", "velocity"):
        if name in row:
            out[name] = np.column_stack([row[name], np.zeros((n, 3 - row[name].shape[1]), row[name].dtype)])
    if np.ndim(row.get("spin", [[]])) == 1:
        a, none = row["orientation"] / 2, np.zeros((n, 2))
        out |= {"spin": np.column_stack([none, row["spin"]]), "orientation": np.column_stack([none, np.sin(a), np.cos(a)])}
    return out


SCENES = {"in space": (3, False), "poured": (3, True), "poured in the plane": (2, True)}


EACH = pytest.mark.parametrize("scene", ["in space", *(pytest.param(name, marks=pytest.mark.slow) for name in [*SCENES][1:])])


@pytest.fixture(scope="module")
def scenes(roof, tmp_path_factory) -> Callable[[str], Recorded]:
    return functools.cache(lambda name: Recorded(tmp_path_factory.mktemp("recorded") / "a.rrd", roof, *SCENES[name]))


@pytest.fixture
def steady(scenes) -> Recorded:
    """Return the recording to which no particles come."""
    return scenes("in space")


def read_csv(names: list[str]) -> list[dict]:
    table = np.genfromtxt(names[0], delimiter=",", names=True)
    known = table.dtype.names or ()

    def columns(rows, *some):
        found = np.stack([rows[name] for name in some if name in known], axis=1)
        return found[:, 0] if found.shape[1] == 1 else found

    out = []
    for frame in np.unique(table["frame"]):
        rows = table[table["frame"] == frame]
        assert (rows["particle"] == np.arange(len(rows))).all()
        out.append({"time": rows["time"][0], "position": columns(rows, "x", "y", "z"), "radius": rows["radius"]})
        if "vx" in known:
            spins, turns = ("spin", "spin_x", "spin_y", "spin_z"), ("angle", "qx", "qy", "qz", "qw")
            out[-1] |= {"velocity": columns(rows, "vx", "vy", "vz"), "spin": columns(rows, *spins)}
            out[-1]["orientation"] = columns(rows, *turns)
    return out


def read_xyz(names: list[str]) -> list[dict]:
    out, lines = [], iter(pathlib.Path(names[0]).read_text().splitlines())
    called = {"pos": "position", "velo": "velocity", "angular_velocity": "spin"}
    for count in lines:
        head = next(lines)
        columns = re.findall(r"(\w+):R:(\d)", head)
        table = np.array([next(lines).split()[1:] for _ in range(int(count))], dtype=float)
        parts = np.split(table, np.cumsum([int(wide) for _, wide in columns])[:-1], axis=1)
        out.append({called.get(name, name): part for (name, _), part in zip(columns, parts, strict=True)})
        out[-1] |= {"time": float(re.findall(r"Time=(\S+)", head)[0]), "radius": out[-1]["radius"][:, 0]}
    return out


def read_npz(names: list[str]) -> list[dict]:
    with np.load(names[0]) as arrays:
        moving = [name for name in ("time", "position", "velocity", "spin", "orientation") if name in arrays]
        assert arrays["frame"].tolist() == [*range(7)]
        return [{name: arrays[name][k] for name in moving} | {"radius": arrays["radius"]} for k in range(7)]


def read_obj(names: list[str]) -> list[dict]:
    out = []
    for name in names:
        shape, lines = S.load(name), pathlib.Path(name).read_text().splitlines()
        loose = [int(line[2:]) - 1 for line in lines if line.startswith("p ")]
        out.append({"position": shape.position, "links": shape.links.tolist(), "loose": loose, "faces": shape.faces})
    return out


def read_pvd(names: list[str]) -> list[dict]:
    folder, out = pathlib.Path(names[0]).parent, []
    sets = ET.parse(names[0]).getroot().findall("Collection/DataSet")
    assert [str(folder / one.attrib["file"]) for one in sets] == names[1:]
    for one, name in zip(sets, names[1:], strict=True):
        mesh = meshio.read(name)
        cells = {block.type: block.data.tolist() for block in mesh.cells}
        faces = cells.get("quad", []) + cells.get("triangle", [])
        links, loose = cells.get("line", []), [i for (i,) in cells.get("vertex", [])]
        found = {"time": float(one.attrib["timestep"]), "position": mesh.points, "links": links, "loose": loose, "faces": faces}
        out.append(found | {key: value for key, value in mesh.point_data.items() if key not in ("mass", "color")})
        assert (mesh.point_data["mass"][:5] == 1 + np.arange(5) / 8).all()
    return out


# How each format is read, and the digits that it keeps of motion. Only one scene of the same particles is an array.
READERS = {
    "csv": (read_csv, 1e-8), "xyz": (read_xyz, 1e-8), "npz": (read_npz, 0.0), "pvd": (read_pvd, 1e-15), "obj": (read_obj, 0.0),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", READERS)
@EACH
def test_every_frame_is_read_back_as_it_was(scenes, scene, kind, tmp_path):
    of, (read, digits) = scenes(scene), READERS[kind]
    if kind == "npz" and of.poured:
        for name, others in (("a.npz", ".csv"), ("a.glb", ".csv, .obj, .pvd, .usd or .xyz")):
            with pytest.raises(ValueError, match=f"not the same in all frames, so .* export to {others}"):
                of.replay.export(tmp_path / name)
        assert not list(tmp_path.iterdir())
        return
    for motion in (False, True) if kind != "obj" else (False,):
        # Names may need escapes.
        name = tmp_path / f"a & b.{kind}"
        found = read(of.given.export(name, motion=True) if motion else of.replay.export(name))
        assert ("velocity" in found[-1]) == motion
        for got, right in zip(map(in_space, found), of.frames, strict=True):
            for name, values in got.items():
                if name in ("links", "loose"):
                    assert values == right[name]
                elif name == "faces":
                    assert sorted(sorted(map(int, face)) for face in values) == right[name]
                elif name in ("position", "radius"):
                    np.testing.assert_array_equal(np.float32(values), np.float32(right[name]))
                else:
                    np.testing.assert_allclose(values, right[name], rtol=digits, atol=digits / 10, err_msg=name)


@pytest.mark.slow
def test_exported_faces_and_texture_coordinates_are_those_of_a_shape(steady, roof, tmp_path):
    import trimesh  # takes a third of a second in every worker that imports this file

    x, uv = steady.replay.position(0), np.concatenate(roof.uv)
    names = steady.replay.export(tmp_path / "f_%03d.obj", shape=steady.shape)
    assert names == [str(tmp_path / f"f_{k:03d}.obj") for k in range(7)]
    back, mesh = S.load(names[-1]), trimesh.load_mesh(names[-1], process=False, maintain_order=True)
    assert [p.tolist() for p in back.polygons] == [[0, 1, 2, 3], [3, 2, 4]]
    assert [one.tolist() for one in back.uv] == [one.tolist() for one in roof.uv]
    assert len(mesh.faces) == 3 and len(mesh.visual.uv) == len(mesh.vertices)
    steady.replay.export(tmp_path / "a.pvd", shape=steady.shape)
    assert [b.data.tolist() for b in meshio.read(tmp_path / "a_0000.vtu").cells[:2]] == [[[0, 1, 2, 3]], [[3, 2, 4]]]
    for name, others in (("a.glb", []), ("100 % #1.gltf", ["100 % #1.bin"]), ("a.gltf", ["a.bin"])):
        names = steady.replay.export(tmp_path / name, shape=steady.shape)
        assert names == [str(tmp_path / one) for one in (name, *others)]
        if "%" in name:
            assert json.loads((tmp_path / name).read_text())["buffers"][0]["uri"] == "100 %25 %231.bin"
            continue
        meshes = [g for g in trimesh.load_scene(names[0]).geometry.values() if isinstance(g, trimesh.Trimesh)]
        mesh = next(m for m in meshes if len(m.faces) == 3)
        around = np.concatenate(roof.polygons)
        pairs = sorted({(*x[i].tolist(), *place) for i, place in zip(around, uv.tolist(), strict=True)})
        np.testing.assert_allclose(sorted(np.column_stack([mesh.vertices, mesh.visual.uv]).tolist()), pairs, atol=1e-7)
        assert len(pairs) == 6  # particle 3 is there twice
        np.testing.assert_allclose(mesh.area, 1 + np.sqrt(1.25) / 2, rtol=1e-6)


def parsed(path: pathlib.Path) -> tuple[dict, bytes]:
    """Return the two chunks of a .glb file."""
    data = path.read_bytes()
    magic, version, size, first, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    return json.loads(data[20 : 20 + first]), data[28 + first :]


def values(text: dict, blob: bytes, number: int) -> np.ndarray:
    """Return the values of an accessor."""
    accessor = text["accessors"][number]
    view = text["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5125: "<u4", 5121: "u1"}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    out = np.frombuffer(blob, kind, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)
    assert "min" not in accessor or (np.float32(accessor["min"]) == out.min(axis=0)).all()
    return out


class Gltf:
    """A .glb file that was read: parts by the names of their nodes, and what is animated."""

    def __init__(self, path: pathlib.Path):
        self.text, self.blob = parsed(path)
        self.nodes = {node["name"]: node for node in self.text["nodes"]}
        (self.animation,) = self.text["animations"]
        names, samplers = [*self.nodes], self.animation["samplers"]
        self.channels = {
            (names[c["target"]["node"]], c["target"]["path"]): samplers[c["sampler"]] for c in self.animation["channels"]
        }

    def part(self, name: str) -> dict:
        (part,) = self.text["meshes"][self.nodes[name]["mesh"]]["primitives"]
        return part

    def values(self, number: int) -> np.ndarray:
        return values(self.text, self.blob, number)

    def animated(self, name: str, what: str) -> np.ndarray:
        return self.values(self.channels[name, what]["output"])

    def places(self, name: str) -> list[np.ndarray]:
        """Return the vertices in each frame, or once if they do not move."""
        part = self.part(name)
        first = self.values(part["attributes"]["POSITION"])
        return [first, *(first + self.values(target["POSITION"]) for target in part.get("targets") or [])]


def test_gltf_holds_every_frame(steady, tmp_path):
    recording = steady.given
    recording.export(tmp_path / "a.glb", motion=True)
    made, x = Gltf(tmp_path / "a.glb"), np.array([row["position"] for row in steady.frames])
    for sampler in made.animation["samplers"]:
        assert (made.values(sampler["input"]).ravel() == recording.times.astype(np.float32)).all()
    walls = {"HalfSpace 1": 4, "HalfSpace 2": 4, "Ball 3": 4, "Path 4": 1}  # by the kind of primitive
    assert set(made.nodes) == {"scene", "surfaces", "links", "points", "particle 8", *walls}
    for name, mode, at in (("surfaces", 4, np.arange(5)), ("points", 0, np.array([9]))):
        assert (made.animated(name, "weights").reshape(7, 6) == np.eye(7)[:, 1:]).all()
        assert made.part(name)["mode"] == mode
        np.testing.assert_allclose(made.places(name), np.broadcast_to(x[:, at], (7, len(at), 3)), atol=3e-7)
    part = made.part("surfaces")
    corners = made.values(part["indices"]).reshape(-1, 3)
    assert sorted(map(sorted, corners.tolist())) == steady.frames[0]["faces"]
    # The ends of a link that broke are in one place, to rounding of what they have moved.
    ends = made.values(made.part("links")["indices"]).reshape(-1, 2)
    for at, row in zip(made.places("links"), steady.frames, strict=True):
        shown = np.array([at[pair] for pair in ends if np.ptp(at[pair], axis=0).max() > 1e-6])
        np.testing.assert_allclose(shown, row["position"][np.array(row["links"])], atol=1e-6)
    # Normals belong to the recorded positions and point up, which is z; a node rotates z to y.
    last = x[-1, :5].astype(np.float64)
    normal = made.values(part["attributes"]["NORMAL"]) + made.values(part["targets"][5]["NORMAL"])
    across = np.cross(last[3] - last[2], last[4] - last[2])
    np.testing.assert_allclose(normal[4], np.sign(across[2]) * across / np.linalg.norm(across), atol=1e-5)
    *axis, w = made.nodes["scene"]["rotation"]
    up = np.array([0.0, 0, 1])
    np.testing.assert_allclose(up + 2 * np.cross(axis, np.cross(axis, up) + w * up), [0, 1, 0], atol=1e-15)
    # A grain is a sphere that moves and turns; a quaternion and its negative are one rotation.
    assert made.nodes["particle 8"]["scale"] == [0.25] * 3
    np.testing.assert_array_equal(made.animated("particle 8", "translation"), x[:, 8])
    turns = np.array([row["orientation"][8] for row in steady.frames])
    np.testing.assert_allclose(np.abs((made.animated("particle 8", "rotation") * turns).sum(axis=1)), 1, atol=1e-6)
    # A floor and a wire stand still and have no targets; a lid moves down, and a gate shrinks to a point where it is off.
    for name, mode in walls.items():
        hue = made.values(made.part(name)["attributes"]["COLOR_0"])
        assert made.part(name)["mode"] == mode and (hue == hue[0]).all() and (hue[0, :3] < 128).all()
    floor, lid, ball, wire = map(made.places, walls)
    np.testing.assert_allclose([p[:, 2] for p in lid], np.repeat([2.5 - 0.1 * np.arange(7)], 6, 0).T, atol=1e-6)
    assert len(floor) == len(wire) == 1 and (floor[0][:, 2] == -1.5).all()
    np.testing.assert_allclose([np.ptp(p, axis=0).max() for p in ball], [1, 1, 1, 0, 0, 0, 0], atol=0.01)
    np.testing.assert_allclose(wire[0][[0, -1], 2], [2, 1], atol=1e-6)


@EACH
def test_usd_holds_every_frame(scenes, scene, roof, tmp_path):
    usd, geom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    of = scenes(scene)
    recording, shape = of.given, None if of.poured else of.shape
    assert recording.export(tmp_path / "a.usda", motion=True, shape=shape) == [str(tmp_path / "a.usda")]
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (60, 60 * recording.times[-1])
    assert geom.GetStageUpAxis(stage) == "Y" and geom.GetStageMetersPerUnit(stage) == 1
    turn = np.array(geom.Xformable(stage.GetPrimAtPath("/scene")).ComputeLocalToWorldTransform(0))
    np.testing.assert_allclose([*np.eye(3)[of.dim - 1], 0] @ turn, [0, 1, 0, 0], atol=1e-7)  # what is up becomes y
    for k, row in enumerate(of.frames):
        time, x = 60 * row["time"], row["position"]
        names = [f"/scene/part_{j}" for j in range(1 + of.poured)]
        seen = [name for name in names if geom.Imageable(stage.GetPrimAtPath(name)).ComputeVisibility(time) == "inherited"]
        assert seen == [names[of.poured and k >= 2]]
        mesh, lines, grains = (stage.GetPrimAtPath(f"{seen[0]}/{name}") for name in ("surfaces", "links", "particles"))
        if of.roof:
            mesh = geom.Mesh(mesh)
            indices, counts = mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get()
            assert [*counts] == ([3, 3, 3] if of.poured else [4, 3]) and mesh.ValidateTopology(indices, counts, 5)
            np.testing.assert_array_equal(mesh.GetPointsAttr().Get(time), x[:5])
        if shape is not None:
            uv = np.array(geom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
            np.testing.assert_allclose(uv, np.concatenate(roof.uv))
        lines, grains, links = geom.BasisCurves(lines), geom.Points(grains), np.array(row["links"])
        np.testing.assert_array_equal(lines.GetPointsAttr().Get(time), x[links.ravel()])
        assert [*lines.GetCurveVertexCountsAttr().Get(time)] == [2] * len(links)
        at = np.array(grains.GetIdsAttr().Get(time))
        np.testing.assert_array_equal(grains.GetPointsAttr().Get(time), x[at])
        wide = np.array(grains.GetWidthsAttr().Get())
        np.testing.assert_array_equal(wide[row["radius"][at] > 0], 2 * row["radius"][at][row["radius"][at] > 0])
        assert {of.grain, len(of.shape) - 1} <= {*at.tolist()}
        of_ = geom.PrimvarsAPI(grains)
        more = {"velocity": grains.GetVelocitiesAttr()} | {name: of_.GetPrimvar(name) for name in ("spin", "orientation")}
        for name, values in more.items():
            np.testing.assert_allclose(values.Get(time), row[name][at], rtol=1e-6, atol=1e-6)


@pytest.fixture(scope="module")
def passing(tmp_path_factory) -> Replay:
    """Return a recording of a disc that moves to the right at 2 m/s between walls, of which one is moved at the end."""
    path, box = tmp_path_factory.mktemp("passing") / "a.rrd", tv.Box((0, 0), (2, 1))
    start = tv.Particles([[0.5, 0.5]], radius=0.1, velocity=(2, 0))
    with tv.World(start, [box]) as w, tv.Recorder(path, w) as recorder:
        w.run(0.4, recorder=recorder)
        box.upper = (1.8, 1.0)
        w.run(0.1, recorder=recorder)
    return tv.replay(path)


def pictures_of(film: str | pathlib.Path) -> np.ndarray:
    """Return the pictures of a film of 25 a second."""
    if not str(film).endswith("mp4"):
        with Image.open(film) as made:
            pictures = [(np.asarray(one.convert("RGB")), one.info["duration"]) for one in ImageSequence.Iterator(made)]
        assert {duration for _, duration in pictures} == {40}
        return np.array([picture for picture, _ in pictures])
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", f"./{film}", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(words, capture_output=True, check=True)
    (size,) = re.findall(rb"Video: h264.* (\d+)x(\d+).* 25 fps", done.stderr)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, int(size[1]), int(size[0]), 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.gif", "a.webp", "-10:00.mp4"])
def test_films_show_what_moves(name, passing, tmp_path, monkeypatch):
    # A picture every 40 ms, of the nearest frame. Names may be what ffmpeg would take for something else.
    monkeypatch.chdir(tmp_path)
    assert passing.export(name) == [name]
    pictures = pictures_of(name)
    assert len(pictures) == 13
    wide = pictures.shape[2]
    across = [np.nonzero(np.ptp(p, axis=2) > 80)[1].mean() / wide for p in pictures]  # walls are grey
    shown = passing.frames[[np.argmin(np.abs(passing.times - k / 25)) for k in range(13)]]
    truth = [passing.position(int(k))[0, 0] for k in shown]
    slope, start = np.polyfit(truth, across, 1)
    np.testing.assert_allclose(np.polyval([slope, start], truth), across, atol=0.004)
    assert 0.4 < slope < 0.5 and 0.03 < start < 0.06
    ends = [np.nonzero(p[5:-5].max(axis=(0, 2)) > 80)[0].max() / wide for p in (pictures[0], pictures[-1])]
    np.testing.assert_allclose(ends, np.polyval([slope, start], [2.0, 1.8]), atol=0.005)


@pytest.mark.slow
def test_films_leave_out_links_that_broke(scenes, tmp_path):
    # The rope is the longest column of coloured pixels. At the end the lower of its two links is gone.
    pictures = pictures_of(scenes("poured in the plane").replay.export(tmp_path / "a.gif")[0])
    lit = np.ptp(pictures, axis=3) > 60
    column = np.argmax(lit[0].sum(axis=0))
    first, last = lit[0][:, column].sum(), lit[-1][:, column].sum()
    assert 1.6 * last < first and last > 0


def test_films_have_the_size_the_theme_and_the_camera_that_are_asked_for(tmp_path):
    # Balls in a box of 4 x 2 x 3 m, of which z is up.
    x = np.array([4.0, 2, 3]) * tv.golden(np.arange(40), dim=3)
    with tv.World(tv.Particles(x, radius=0.1), [tv.Gravity((0, 0, -9.81))]) as w:
        tv.Recorder(tmp_path / "a.rrd", w).close()
    recording = tv.replay(tmp_path / "a.rrd")

    def film(**look):
        recording.export(tmp_path / "a.gif", **look)
        with Image.open(tmp_path / "a.gif") as made:
            return np.asarray(made.convert("RGB"))

    plain, light = film(), film(theme="light")
    assert plain.shape[1] == 640 and light.shape == plain.shape
    assert plain[0, 0].max() < 30 and light[0, 0].min() > 240
    assert film(size=320).shape[1] == 320 and film(size=(402, 300)).shape == (300, 402, 3)
    lit = [(p.max(axis=2) > 40).mean() for p in (plain, film(size=1280))]
    assert lit[0] == pytest.approx(lit[1], rel=0.1)  # lines and dots grow with the picture
    for camera, deep in (((0, 0), 2), ((0, np.pi / 2), 1)):
        rows, columns = np.ptp(np.nonzero(film(size=(400, 400), camera=camera).max(axis=2) > 40), axis=1)
        assert rows / columns == pytest.approx(np.ptp(x[:, deep]) / np.ptp(x[:, 0]), abs=0.15)


@pytest.mark.parametrize(
    "name, given, kind, text",
    [
        ("a.stl", {}, ValueError, "a.stl ends in '.stl', but .csv, .gif, .glb, .gltf, .mp4, .npz, .obj, .pvd, .usd, .usda, "),
        ("none/a.glb", {}, FileNotFoundError, "folder of .*a.glb does not exist"),
        ("a.obj", {"shape": S.rope((0, 0, 0), (1, 0, 0), 5)}, ValueError, "shape has 5 points, but the recording has 10 parti"),
        ("a.csv", {"shape": S.rope((0, 0, 0), (1, 0, 0), 10)}, ValueError, "a.csv takes no shape; .gif, .glb"),
        ("a.obj", {"shape": "roof.obj"}, TypeError, "shape = 'roof.obj' is a str"),
        ("a.obj", {"motion": True}, ValueError, "a.obj takes no motion; .csv, .glb, .gltf, .npz, .pvd, .usd, .usda, .usdc, .xyz"),
        ("a.gif", {"size": (401, 300)}, ValueError, r"size = \(401, 300\), but films have even numbers of pixels; write 402"),
        ("a.gif", {"theme": "blue"}, ValueError, "theme = 'blue', but it must be one of 'dark', 'light'"),
        ("a.gif", {"camera": (0, 3)}, ValueError, r"camera\[1\] = 3, but it must be at most 1.57"),
        ("a.csv", {"size": 640}, ValueError, "a.csv takes no size; .gif, .mp4, .webp do"),
        ("a.mp4", "imageio_ffmpeg", ImportError, r"a.mp4 needs imageio_ffmpeg, .* pip install 'tiverlet\[export\]'"),
        ("a.usd", "pxr.Usd", ImportError, r"a.usd needs pxr.Usd, .* pip install 'tiverlet\[usd\]'"),
    ],
)
def test_errors_say_what_can_be_done(steady, tmp_path, monkeypatch, name, given, kind, text):
    if isinstance(given, str):  # a module that is missing
        monkeypatch.setenv("PATH", "")  # hides any other ffmpeg
        monkeypatch.setitem(sys.modules, given, None)
        given = {}
    with pytest.raises(kind, match=text):
        steady.replay.export(tmp_path / name, **given)
    assert not list(tmp_path.iterdir())


def test_the_command_exports(steady, tmp_path, capsys):
    S.save(tmp_path / "whole.obj", steady.shape)
    export = ["replay", str(steady.path), "--export"]
    assert main([*export, str(tmp_path / "b_%d.obj"), "--shape", str(tmp_path / "whole.obj")]) == 0
    assert "b_0.obj and 6 more: " in capsys.readouterr().out
    assert [len(p) for p in S.load(tmp_path / "b_4.obj").polygons] == [4, 3]
    look = ["--size", "96x64", "--camera=-0.5,0.2", "--theme", "light"]
    assert main([*export, str(tmp_path / "a.gif"), *look]) == 0
    with Image.open(tmp_path / "a.gif") as made:
        assert made.size == (96, 64) and max(made.convert("RGB").getcolors())[1] == (250, 250, 250)
    for words, said in ((["stl"], "can be written"), ([str(tmp_path / "a.obj"), "--motion"], "a.obj takes no motion")):
        assert main([*export, *words]) == 2 and said in capsys.readouterr().err


def test_shapes_keep_polygons(roof, tmp_path):
    assert roof.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 4]]
    assert [uv.tolist() for uv in roof.uv] == [[[0, 0], [1, 0], [1, 1], [0, 1]], [[0.5, 0.5], [1, 1], [0.25, 0.875]]]
    cloth = S.cloth((0, 0, 0), (1, 0, 0), (0, 0, 1), (2, 2))
    both, (_, b) = S.join(cloth, roof)
    assert not cloth.polygons and [len(p) for p in both.polygons] == [3, 3, 4, 3]
    assert [len(uv) for uv in both.uv] == [0, 0, 4, 3] and (both.polygons[2] == roof.polygons[0] + b.start).all()
    order = roof.in_order()
    np.testing.assert_array_equal(order.position[order.polygons[1]], roof.position[roof.polygons[1]])
    S.save(tmp_path / "b.obj", roof.moved((1, 2, 3)))
    back = S.load(tmp_path / "b.obj")
    assert all(np.array_equal(a, b) for a, b in zip((*back.polygons, *back.uv), (*roof.polygons, *roof.uv), strict=True))
    assert (back.position == roof.position + [1, 2, 3]).all()
    for wrong in ("f 1/1 2/2 3/3", "vt x"):
        (tmp_path / "c.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n{wrong}\n")
        with pytest.raises(ValueError, match="line 5"):
            S.load(tmp_path / "c.obj")


def test_surfaces_have_one_sense():
    ball, rng = S.balloon((0, 0, 0), 1.0, level=1), np.random.default_rng(1)
    faces = ball.faces.copy()
    some = rng.random(len(faces)) < 0.5
    faces[some] = faces[some][:, ::-1]
    a, b, c = (ball.position[k] for k in oriented(faces, ball.position, np.array([0.0, 1.0, 0.0])).T)
    assert (np.einsum("ij,ij->i", a, np.cross(b, c)) > 0).all()  # all point outwards
    flat = oriented(np.array([[0, 2, 1]]), np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([0.0, 1]))
    assert flat.tolist() == [[1, 2, 0]]
