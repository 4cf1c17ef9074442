"""Exports: other programs read what was recorded."""

import json
import pathlib
import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ET

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


@pytest.fixture(scope="module")
def whole(roof) -> S.Shape:
    """Return the roof (0 to 4), a rope (5 to 7), and two single particles, one with a radius."""
    alone = S.Shape(np.array([[3.0, 0.0, 2.0], [4.0, 0.0, 2.0]]), radius=np.array([0.25, 0.0]))
    return S.join(roof, S.rope((2, 0, 0), (2, 1, 0), points=3), alone)[0]


@pytest.fixture(scope="module")
def recording(whole, tmp_path_factory) -> Replay:
    """Return a recording in which the whole shape falls along z, in four frames of 1/60 s."""
    path = tmp_path_factory.mktemp("recording") / "a.rrd"
    particles = tv.Particles(whole.position, mass=1 + np.arange(10) / 8, radius=whole.radius, velocity=(0.5, 0, 0), pinned=[5])
    features = [tv.Gravity((0, 0, -9.81)), tv.Force(breeze), tv.Distance(whole.links), tv.Dihedral(whole.quads)]
    with tv.World(particles, features, substeps=2) as world, tv.Recorder(path, world) as recorder:
        world.run(4 / 60, recorder=recorder)
    return tv.replay(path)


def positions(recording: Replay) -> list[np.ndarray]:
    return [recording.position(int(k)) for k in recording.frames]


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

    def places(self, name: str) -> list[np.ndarray]:
        """Return the vertices in each frame, or once if they do not move."""
        part = self.part(name)
        first = self.values(part["attributes"]["POSITION"])
        return [first, *(first + self.values(target["POSITION"]) for target in part.get("targets") or [])]


def test_gltf_holds_every_frame(recording, tmp_path):
    assert recording.export(tmp_path / "a.glb") == [str(tmp_path / "a.glb")]  # without the function of the user's
    made, x = Gltf(tmp_path / "a.glb"), np.array(positions(recording))
    for sampler in made.animation["samplers"]:
        assert (made.values(sampler["input"]).ravel() == recording.times.astype(np.float32)).all()
    assert set(made.nodes) == {"scene", "surfaces", "links", "points", "particle 8"}
    for name, mode, at in (("surfaces", 4, np.arange(5)), ("links", 1, np.arange(5, 8)), ("points", 0, np.array([9]))):
        assert (made.values(made.channels[name, "weights"]["output"]).reshape(5, 4) == np.eye(5)[:, 1:]).all()
        assert made.part(name)["mode"] == mode
        np.testing.assert_allclose(made.places(name), x[:, at], atol=3e-7)
    assert made.values(made.part("links")["indices"]).ravel().tolist() == [0, 1, 1, 2]
    part = made.part("surfaces")
    corners = made.values(part["indices"]).reshape(-1, 3)
    assert sorted(map(sorted, corners.tolist())) == [[0, 1, 2], [0, 2, 3], [2, 3, 4]]
    # Normals belong to the recorded positions and point up, which is z; a node rotates z to y.
    last = x[-1, :5].astype(np.float64)
    normal = made.values(part["attributes"]["NORMAL"]) + made.values(part["targets"][3]["NORMAL"])
    across = np.cross(last[3] - last[2], last[4] - last[2])
    np.testing.assert_allclose(normal[4], np.sign(across[2]) * across / np.linalg.norm(across), atol=1e-5)
    *axis, w = made.nodes["scene"]["rotation"]
    up = np.array([0.0, 0, 1])
    np.testing.assert_allclose(up + 2 * np.cross(axis, np.cross(axis, up) + w * up), [0, 1, 0], atol=1e-15)
    assert made.nodes["particle 8"]["scale"] == [0.25] * 3
    np.testing.assert_array_equal(made.values(made.channels["particle 8", "translation"]["output"]), x[:, 8])


@pytest.mark.parametrize("name", ["a.glb", "100 % #1.gltf"])
def test_trimesh_reads_gltf(recording, whole, name, tmp_path):
    import trimesh  # takes a third of a second in every worker that imports this file

    names = recording.export(tmp_path / name, shape=whole)
    assert names == [str(tmp_path / n) for n in ([name] if name == "a.glb" else [name, "100 % #1.bin"])]
    if name != "a.glb":
        assert json.loads((tmp_path / name).read_text())["buffers"][0]["uri"] == "100 %25 %231.bin"
        names = recording.export(tmp_path / "a.gltf", shape=whole)
    meshes = [g for g in trimesh.load_scene(names[0]).geometry.values() if isinstance(g, trimesh.Trimesh)]
    mesh = next(m for m in meshes if len(m.faces) == 3)
    x, uv = recording.position(0), np.concatenate(whole.uv)
    around = np.concatenate(whole.polygons)
    pairs = sorted({(*x[i].tolist(), *place) for i, place in zip(around, uv.tolist(), strict=True)})
    np.testing.assert_allclose(sorted(np.column_stack([mesh.vertices, mesh.visual.uv]).tolist()), pairs, atol=1e-7)
    assert len(pairs) == 6  # particle 3 is there twice
    np.testing.assert_allclose(mesh.area, 1 + np.sqrt(1.25) / 2, rtol=1e-6)


def test_obj_files_keep_faces_and_texture_coordinates(recording, roof, whole, tmp_path):
    import trimesh

    names = recording.export(tmp_path / "f_%03d.obj", shape=whole)
    assert names == [str(tmp_path / f"f_{k:03d}.obj") for k in range(5)]
    for name, x in zip(names, positions(recording), strict=True):
        back = S.load(name)
        np.testing.assert_array_equal(back.position.astype(np.float32), x)
        assert [p.tolist() for p in back.polygons] == [[0, 1, 2, 3], [3, 2, 4]]
        assert [uv.tolist() for uv in back.uv] == [uv.tolist() for uv in roof.uv]
        assert back.links.tolist() == [[5, 6], [6, 7]]
    assert "p 9\np 10\n" in pathlib.Path(names[0]).read_text()
    mesh = trimesh.load_mesh(names[-1], process=False, maintain_order=True)
    assert len(mesh.faces) == 3 and len(mesh.visual.uv) == len(mesh.vertices)


def test_meshio_and_ase_read_vtk_and_xyz(recording, whole, tmp_path):
    path = tmp_path / "a & b.pvd"
    names = recording.export(path, shape=whole)
    sets = ET.parse(path).getroot().findall("Collection/DataSet")
    assert [float(s.attrib["timestep"]) for s in sets] == recording.times.tolist()
    assert [str(tmp_path / s.attrib["file"]) for s in sets] == names[1:] and names[0] == str(path)
    for name, x in zip(names[1:], positions(recording), strict=True):
        mesh = meshio.read(name)
        np.testing.assert_array_equal(mesh.points, x)
        assert {block.type: block.data.tolist() for block in mesh.cells} == {
            "quad": [[0, 1, 2, 3]], "triangle": [[3, 2, 4]], "line": [[5, 6], [6, 7]], "vertex": [[8], [9]],
        }  # fmt: skip
        np.testing.assert_array_equal(mesh.point_data["radius"], whole.radius)
        np.testing.assert_array_equal(mesh.point_data["mass"], 1 + np.arange(10) / 8)
    ase = pytest.importorskip("ase.io")
    recording.export(tmp_path / "a.xyz")
    frames = ase.read(tmp_path / "a.xyz", index=":")
    np.testing.assert_array_equal(np.array([f.positions for f in frames], dtype=np.float32), positions(recording))
    assert [f.info["Time"] for f in frames] == recording.times.tolist()
    assert frames[0].arrays["radius"].tolist() == [0.0] * 8 + [0.25, 0.0]


def test_a_plane_is_at_zero_and_particles_may_come(tmp_path, world, read_here):
    w = world(tv.Particles([[0.0, 0.0], [1.0, 0.0]]), [tv.Distance([(0, 1)])])
    with tv.Recorder(tmp_path / "c.rrd", w) as recorder:  # no frame is computed
        w.add(tv.Particles([[2.0, 1.0]], radius=0.5))
        recorder.log()
    changing = tv.replay(tmp_path / "c.rrd")
    changing.export(tmp_path / "a.pvd")
    assert meshio.read(tmp_path / "a_0000.vtu").points.tolist() == [[0, 0, 0], [1, 0, 0]]
    assert meshio.read(tmp_path / "a_0001.vtu").points.tolist() == [[0, 0, 0], [1, 0, 0], [2, 1, 0]]
    changing.export(tmp_path / "a.obj")
    assert [len(S.load(tmp_path / f"a_000{k}.obj")) for k in (0, 1)] == [2, 3]
    changing.export(tmp_path / "a.csv")
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    rows = [[0, 0, 0, 0, 0], [0, 0, 1, 1, 0], [1, 0, 0, 0, 0], [1, 0, 1, 1, 0], [1, 0, 2, 2, 1]]
    assert table[:, :5].tolist() == rows and table[:, 5].tolist() == [0, 0, 0, 0, 0.5]
    changing.export(tmp_path / "a.xyz")
    lines = (tmp_path / "a.xyz").read_text().splitlines()
    head = 'Properties=species:S:1:pos:R:3:radius:R:1 Time=0.0 Frame=1 pbc="F F F"'
    assert lines[4:] == ["3", head, "X 0 0 0 0", "X 1 0 0 0", "X 2 1 0 0.5"]
    for kind, others in (("npz", ".csv"), ("glb", ".csv, .obj, .pvd, .usd or .xyz")):
        with pytest.raises(ValueError, match=f"not the same in all frames, so .* export to {others}"):
            changing.export(tmp_path / f"a.{kind}")
        assert not (tmp_path / f"a.{kind}").exists()


@pytest.fixture(scope="module", params=[2, 3], ids=["in the plane", "in space"])
def rolled(request, tmp_path_factory):
    """Return the dimension, recordings of grains that roll, with and without one that is poured, and their motion by frame."""
    dim, out = request.param, []
    x, v, up = np.array([[0.0, 0.1], [1.0, 0.1]]) @ np.eye(2, dim), 2.0 * np.eye(dim)[0], np.eye(dim)[1]
    for poured in (True, False):
        grains, truth = tv.Particles(x, velocity=[v, -v], radius=0.1, spin=True, orientation=0.0), []
        path = tmp_path_factory.mktemp("rolled") / "a.rrd"
        with tv.World(grains, [tv.Gravity(), tv.HalfSpace(up, friction=0.5)], substeps=4) as w, tv.Recorder(path, w) as recorder:
            truth.append((w.velocity, w.spin, w.orientation))
            for frame in range(4):
                if poured and frame == 2:
                    w.add(tv.Particles([x[1] + 2 * v], radius=0.25, velocity=v, spin=True, orientation=0.0))
                w.step(1 / 30)
                recorder.log()
                truth.append((w.velocity, w.spin, w.orientation))
        out += [tv.replay(path), [tuple(np.array(one) for one in row) for row in truth]]
    return dim, *out


def test_exports_hold_radii_and_motion_of_grains_that_are_poured(rolled, tmp_path):
    # In space, the velocity of a plane has a third component of 0, spin is about z, and an angle a is (0, 0, sin a/2, cos a/2).
    dim, recording, truth, *_ = rolled
    radii = [np.array([0.1, 0.1, 0.25])[: len(v)] for v, _, _ in truth]
    space = [np.hstack(row) for row in truth] if dim == 3 else [
        np.column_stack([v, 0 * w, 0 * w, 0 * w, w, 0 * a, 0 * a, np.sin(a / 2), np.cos(a / 2)]) for v, w, a in truth
    ]  # fmt: skip
    assert recording.verify() and [len(r) for r in radii] == [2, 2, 2, 3, 3] and abs(space[-1][0, 5]) > 1
    recording.export(tmp_path / "a.csv", motion=True)
    names = "vx,vy,spin,angle" if dim == 2 else "vx,vy,vz,spin_x,spin_y,spin_z,qx,qy,qz,qw"
    assert (tmp_path / "a.csv").read_text().split("\n")[0] == f"frame,time,particle,{'x,y,z'[: 2 * dim - 1]},radius,{names}"
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    plain = np.concatenate([np.column_stack([r, *row]) for r, row in zip(radii, truth, strict=True)])
    np.testing.assert_allclose(table[:, 3 + dim :], plain, rtol=1e-8, atol=1e-9)
    recording.export(tmp_path / "a.xyz", motion=True)
    lines = (tmp_path / "a.xyz").read_text().splitlines()
    assert "radius:R:1:velo:R:3:angular_velocity:R:3:orientation:R:4 Time=" in lines[1]
    found = np.array([line.split()[4:] for line in lines if line.startswith("X ")], dtype=float)
    wanted = np.column_stack([np.concatenate(radii), np.concatenate(space)])
    np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-9)
    for name, r, row in zip(recording.export(tmp_path / "a.pvd", motion=True)[1:], radii, space, strict=True):
        data = meshio.read(name).point_data
        np.testing.assert_array_equal(data["radius"], r)
        np.testing.assert_allclose(np.hstack([data[n] for n in ("velocity", "spin", "orientation")]), row, atol=1e-15)


def test_what_rolls_turns_in_arrays_and_meshes(rolled, tmp_path):
    dim, *_, recording, truth = rolled
    recording.export(tmp_path / "a.npz", motion=True)
    with np.load(tmp_path / "a.npz") as arrays:
        for k, name in enumerate(("velocity", "spin", "orientation")):
            np.testing.assert_array_equal(arrays[name], [row[k] for row in truth])
        np.testing.assert_array_equal(arrays["position"], positions(recording))
    recording.export(tmp_path / "a.glb", motion=True)
    made = Gltf(tmp_path / "a.glb")
    angle = [a[0] if dim == 2 else 2 * np.arctan2(a[0, 2], a[0, 3]) for _, _, a in truth]
    wanted = np.stack([np.zeros(5), np.zeros(5), np.sin(np.array(angle) / 2), np.cos(np.array(angle) / 2)], axis=1)
    np.testing.assert_allclose(made.values(made.channels["particle 0", "rotation"]["output"]), wanted, atol=1e-6)
    recording.export(tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as arrays:
        assert not {"velocity", "spin", "orientation"} & {*arrays}
    with pytest.raises(ValueError, match="a.obj takes no motion; .csv, .glb, .gltf, .npz, .pvd, .usd, .usda, .usdc, .xyz do"):
        recording.export(tmp_path / "a.obj", motion=True)


def test_usd_holds_grains_that_are_poured(rolled, tmp_path):
    usd, geom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    dim, recording, truth, *_ = rolled
    assert recording.export(tmp_path / "a.usdc", motion=True) == [str(tmp_path / "a.usdc")]
    stage = usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (60, 60 * recording.times[-1])
    assert geom.GetStageUpAxis(stage) == "Y" and geom.GetStageMetersPerUnit(stage) == 1
    parts = [stage.GetPrimAtPath(f"/scene/part_{j}") for j in (0, 1)]
    for k, (frame, time) in enumerate(zip(recording.frames, recording.times, strict=True)):
        seen = [geom.Imageable(part).ComputeVisibility(60 * time) for part in parts]
        assert seen == (["inherited", "invisible"] if k < 3 else ["invisible", "inherited"])
        points, n = geom.Points(stage.GetPrimAtPath(f"{parts[k >= 3].GetPath()}/particles")), len(truth[k][0])
        x, (v, spins, turns) = recording.position(int(frame)), truth[k]
        np.testing.assert_array_equal(np.array(points.GetPointsAttr().Get(60 * time))[:, :dim], x)
        np.testing.assert_allclose(np.array(points.GetVelocitiesAttr().Get(60 * time))[:, :dim], v, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(points.GetWidthsAttr().Get(), [0.2, 0.2, 0.5][:n], rtol=1e-6)
        spin, turned = (np.array(geom.PrimvarsAPI(points).GetPrimvar(p).Get(60 * time)) for p in ("spin", "orientation"))
        angle = turns if dim == 2 else 2 * np.arctan2(turns[:, 2], turns[:, 3])
        np.testing.assert_allclose(spin[:, 2], spins if dim == 2 else spins[:, 2], rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(turned[:, 2:], np.stack([np.sin(angle / 2), np.cos(angle / 2)], axis=1), atol=1e-6)


def test_usd_holds_surfaces_links_and_up(recording, whole, tmp_path):
    usd, geom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    recording.export(tmp_path / "a.usda", shape=whole)
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    turn = np.array(geom.Xformable(stage.GetPrimAtPath("/scene")).ComputeLocalToWorldTransform(0))
    np.testing.assert_allclose([0, 0, 1, 0] @ turn, [0, 1, 0, 0], atol=1e-7)  # z, which is up, becomes y
    mesh, lines, grains = (geom.Imageable(stage.GetPrimAtPath(f"/scene/part_0/{n}")) for n in ("surfaces", "links", "particles"))
    mesh, lines, grains = geom.Mesh(mesh), geom.BasisCurves(lines), geom.Points(grains)
    indices, counts = mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get()
    assert [*counts] == [4, 3] and mesh.ValidateTopology(indices, counts, 5)
    uv = np.array(geom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    np.testing.assert_allclose(uv, np.concatenate([one for one in whole.uv if len(one)]))
    for time, x in zip(recording.times, positions(recording), strict=True):
        np.testing.assert_array_equal(mesh.GetPointsAttr().Get(60 * time), x[:5])
        np.testing.assert_array_equal(lines.GetPointsAttr().Get(60 * time), x[[5, 6, 6, 7]])
        np.testing.assert_array_equal(grains.GetPointsAttr().Get(60 * time), x[8:])
    assert [*lines.GetCurveVertexCountsAttr().Get(0)] == [2, 2] and grains.GetWidthsAttr().Get()[0] == 0.5


def test_meshes_have_walls_where_they_are_in_each_frame(tmp_path, world, read_here):
    # A floor that stands still has no targets; a lid moves down, a gate opens in frame 2, and a wire is a line.
    lid, gate = tv.HalfSpace((0, -1, 0), -2.0), tv.Ball((1, 1, 0), 0.5, active=True)
    walls = [tv.HalfSpace((0, 1, 0)), lid, gate, tv.Path([1], [(0, 0, 0), (0, 0, 1)])]
    w = world(tv.Particles([[0.0, 1.0, 0.0], [0.0, 0.0, 0.5]], radius=0.1), [tv.Gravity(), *walls])
    with tv.Recorder(tmp_path / "a.rrd", w) as recorder:
        for frame in range(1, 4):
            lid.offset = -2.0 + 0.1 * frame
            gate.active = frame < 2
            w.step(1 / 60)
            recorder.log()
    tv.replay(tmp_path / "a.rrd").export(tmp_path / "a.glb")
    made, names = Gltf(tmp_path / "a.glb"), ("HalfSpace 1", "HalfSpace 2", "Ball 3", "Path 4")
    for name in names:
        part = made.part(name)
        hue = made.values(part["attributes"]["COLOR_0"])
        assert part["mode"] == (1 if name == "Path 4" else 4) and (hue == hue[0]).all() and (hue[0, :3] < 128).all()
    floor, lid, ball, wire = map(made.places, names)
    np.testing.assert_allclose([p[:, 1] for p in lid], np.repeat([[2.0], [1.9], [1.8], [1.7]], 6, 1), atol=1e-6)
    assert len(floor) == len(wire) == 1 and (floor[0][:, 1] == 0).all()
    np.testing.assert_allclose([np.ptp(p, axis=0).max() for p in ball], [1, 1, 0, 0], atol=0.01)
    np.testing.assert_allclose(wire[0][[0, -1], 2], [0, 1], atol=1e-6)


@pytest.mark.slow
@pytest.mark.slow
@pytest.mark.parametrize("comes", [False, True])
def test_links_that_broke_are_not_shown(comes, tmp_path, world, read_here):
    # Three weights of 1 kg hang on links that bear 5, 15 and 25 N; gravity grows from 1 to 10 and 20 m/s^2, so that the first
    # link breaks in frame 3, and the second in frame 5. A particle comes after frame 6, except where it must not (.glb).
    gravity, links = tv.Gravity(1.0), tv.Distance([(0, 3), (1, 4), (2, 5)], break_at=[5.0, 15.0, 25.0])
    x = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [0.0, -1.0], [1.0, -1.0], [2.0, -1.0]]
    w = world(tv.Particles(x, pinned=[0, 1, 2]), [gravity, links])
    with tv.Recorder(tmp_path / "a.rrd", w) as recorder:
        for frame in range(1, 8 if comes else 9):
            gravity.g = 1.0 if frame < 3 else 10.0 if frame < 5 else 20.0
            if frame == 7 and comes:
                w.add(tv.Particles([[3.0, 0.0]]))
                recorder.log()
            w.step(1 / 60)
            recorder.log()
    recording = tv.replay(tmp_path / "a.rrd")
    assert recording.verify() and len(recording.frames) == 9
    unbroken = [recording.world(int(k)).features[1].rods()[0].tolist() for k in recording.frames]
    assert [len(pairs) for pairs in unbroken] == [3, 3, 3, 2, 2, 1, 1, 1, 1]
    if comes:
        names = recording.export(tmp_path / "a.obj")
        assert [S.load(name).links.tolist() for name in names] == unbroken
        assert "p 4\n" in pathlib.Path(names[-1]).read_text()  # what hung on the first link is a point from then on
        names = recording.export(tmp_path / "a.pvd")
        cells = [{block.type: block.data.tolist() for block in meshio.read(name).cells} for name in names[1:]]
        assert [cell["line"] for cell in cells] == unbroken and cells[-1]["vertex"] == [[0], [1], [3], [4], [6]]
        with Image.open(recording.export(tmp_path / "a.gif")[0]) as film:
            pictures = [np.asarray(one.convert("RGB")).max(axis=2) > 60 for one in ImageSequence.Iterator(film)]
        drawn = [p[p.shape[0] // 2].sum() for p in pictures]  # pixels of links half way down
        assert drawn[0] > 2 * drawn[-1] > 0
        return
    made = Gltf(pathlib.Path(recording.export(tmp_path / "a.glb")[0]))
    ends = made.values(made.part("links")["indices"]).reshape(-1, 2)
    for at, pairs, place in zip(made.places("links"), unbroken, positions(recording), strict=True):
        a, b = (at[ends[:, k], :2] for k in (0, 1))
        shown = (a != b).any(axis=1)
        np.testing.assert_allclose(np.stack([a, b], axis=1)[shown], place[np.array(pairs)], atol=1e-6)


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


@pytest.mark.parametrize("name", ["a.gif", "a.webp", "10:00.mp4", "-y.mp4"])
def test_films_show_what_moves(name, passing, tmp_path, monkeypatch):
    # A picture every 40 ms, of the nearest frame. Names may be what ffmpeg would take for something else.
    monkeypatch.chdir(tmp_path)
    assert passing.export(name) == [name]
    if name.endswith("mp4"):
        words = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / name), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
        done = subprocess.run(words, capture_output=True, check=True)
        found = re.search(rb"Video: h264.* (\d+)x(\d+).* 25 fps", done.stderr)
        assert found
        width, height = map(int, found.groups())
        pictures = list(np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3))
    else:
        with Image.open(name) as film:
            pictures = []
            for k in range(getattr(film, "n_frames", 0)):
                film.seek(k)
                pictures.append(np.asarray(film.convert("RGB")))
                assert film.info["duration"] == 40
    moments = np.arange(len(pictures)) / 25
    assert len(pictures) == 13
    wide = pictures[0].shape[1]
    lit = [p.astype(int).max(axis=2) - p.astype(int).min(axis=2) > 80 for p in pictures]  # walls are grey
    across = [np.nonzero(some)[1].mean() / wide for some in lit]
    shown = passing.frames[[np.argmin(np.abs(passing.times - t)) for t in moments]]
    truth = [passing.position(int(k))[0, 0] for k in shown]
    slope, start = np.polyfit(truth, across, 1)
    np.testing.assert_allclose(np.polyval([slope, start], truth), across, atol=0.004)
    assert 0.4 < slope < 0.5 and 0.03 < start < 0.06
    ends = [np.nonzero(p[5:-5].max(axis=(0, 2)) > 80)[0].max() / wide for p in (pictures[0], pictures[-1])]
    np.testing.assert_allclose(ends, np.polyval([slope, start], [2.0, 1.8]), atol=0.005)


def test_films_have_the_size_the_theme_and_the_camera_that_are_asked_for(recording, tmp_path):
    # The single grain is at x = 3, y = 0, z = 2, up is z; from the left or above it is elsewhere in the picture.
    def film(name, **look):
        recording.export(tmp_path / name, **look)
        with Image.open(tmp_path / name) as made:
            return np.asarray(made.convert("RGB"))

    plain, light = film("a.gif"), film("b.gif", theme="light")
    assert plain.shape[1] == 640 and light.shape == plain.shape
    assert plain[0, 0].max() < 30 and light[0, 0].min() > 240
    assert film("c.webp", size=320).shape[1] == 320 and film("d.gif", size=(402, 300)).shape == (300, 402, 3)
    lit = [(p.max(axis=2) > 40).mean() for p in (plain, film("e.gif", size=1280))]
    assert lit[0] == pytest.approx(lit[1], rel=0.1)  # lines and dots grow with the picture
    front, top = film("f.gif", size=(400, 400), camera=(0, 0)), film("g.gif", size=(400, 400), camera=(0, np.pi / 2))
    spans = [np.ptp(np.nonzero(p.max(axis=2) > 40), axis=1) for p in (front, top)]
    wide, deep, tall = np.ptp(np.concatenate(positions(recording)), axis=0)
    assert spans[0][0] / spans[0][1] == pytest.approx(tall / wide, abs=0.15)  # rows by columns
    assert spans[1][0] / spans[1][1] == pytest.approx(deep / wide, abs=0.15)


@pytest.mark.parametrize(
    "name, given, kind, text",
    [
        (
            "a.stl",
            {},
            ValueError,
            "a.stl ends in '.stl', but .csv, .gif, .glb, .gltf, .mp4, .npz, .obj, .pvd, .usd, .usda, ",
        ),
        ("none/a.glb", {}, FileNotFoundError, "folder of .*a.glb does not exist"),
        ("a.obj", {"shape": S.rope((0, 0, 0), (1, 0, 0), 5)}, ValueError, "shape has 5 points, but the recording has 10 parti"),
        ("a.csv", {"shape": S.rope((0, 0, 0), (1, 0, 0), 10)}, ValueError, "a.csv takes no shape; .gif, .glb"),
        ("a.obj", {"shape": "roof.obj"}, TypeError, "shape = 'roof.obj' is a str"),
        ("a.gif", {"size": (401, 300)}, ValueError, r"size = \(401, 300\), but films have even numbers of pixels; write 402"),
        ("a.gif", {"theme": "blue"}, ValueError, "theme = 'blue', but it must be one of 'dark', 'light'"),
        ("a.gif", {"camera": (0, 3)}, ValueError, r"camera\[1\] = 3, but it must be at most 1.57"),
        ("a.csv", {"size": 640}, ValueError, "a.csv takes no size; .gif, .mp4, .webp do"),
        ("a.glb", {"theme": "light"}, ValueError, "a.glb takes no theme; .gif, .mp4, .webp do"),
        ("a.glb", "pygltflib", ImportError, r"a.glb needs pygltflib, .* pip install 'tiverlet\[export\]'"),
        ("a.mp4", "imageio_ffmpeg", ImportError, r"a.mp4 needs imageio_ffmpeg, .* pip install 'tiverlet\[export\]'"),
        ("a.usd", "pxr.Usd", ImportError, r"a.usd needs pxr.Usd, .* pip install 'tiverlet\[usd\]'"),
    ],
)
def test_errors_say_what_can_be_done(recording, tmp_path, monkeypatch, name, given, kind, text):
    if isinstance(given, str):  # a module that is missing
        monkeypatch.setenv("PATH", "")  # hides any other ffmpeg
        monkeypatch.setitem(sys.modules, given, None)
        given = {}
    with pytest.raises(kind, match=text):
        recording.export(tmp_path / name, **given)
    assert not list(tmp_path.iterdir())


def test_the_command_exports(recording, whole, tmp_path, capsys):
    S.save(tmp_path / "whole.obj", whole)
    export = ["replay", recording.path, "--export"]
    assert main([*export, str(tmp_path / "b_%d.obj"), "--shape", str(tmp_path / "whole.obj")]) == 0
    assert "b_0.obj and 4 more: " in capsys.readouterr().out
    assert [len(p) for p in S.load(tmp_path / "b_4.obj").polygons] == [4, 3]
    assert main([*export, "stl"]) == 2 and "can be written" in capsys.readouterr().err
    look = ["--size", "96x64", "--camera=-0.5,0.2", "--theme", "light"]
    assert main([*export, str(tmp_path / "a.gif"), *look]) == 0
    with Image.open(tmp_path / "a.gif") as made:
        assert made.size == (96, 64) and made.convert("RGB").getpixel((0, 0)) == (250, 250, 250)
    assert main([*export, str(tmp_path / "a.obj"), "--motion"]) == 2
    assert "a.obj takes no motion" in capsys.readouterr().err


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
