"""The argument `color`: one meaning, and the same colours, in every view."""

import json
import queue
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import tiverlet as tv
from tests.test_exports import parsed, values
from tests.test_overlays import column
from tests.test_recorder import read
from tiverlet.__main__ import main
from tiverlet.live.session import Session
from tiverlet.recording.exports.geometry import linear
from tiverlet.recording.hues import Coloring, by_body
from tiverlet.recording.quantities import QUANTITIES

pytestmark = pytest.mark.usefixtures("read_here")

X = np.array([[0.0, 0], [1, 0], [2, 0], [3, 0], [3.5, 0]])
SPEED = np.array([0.0, 1.0, 2.0, 1.0, 1.0])
GIVEN = np.array([[10, 20, 30], [250, 128, 0], [0, 0, 255], [255, 255, 255], [155, 55, 5]])
LOW, MIDDLE, HIGH = [68, 1, 84], [33, 145, 140], [253, 231, 37]  # viridis
BY_SPEED = np.array([LOW, MIDDLE, HIGH, MIDDLE, MIDDLE])


def upwards(world: tv.World) -> np.ndarray:
    """A quantity of the user's: speeds upwards."""
    return world.velocity[:, 1]


def scene(n: int = 5) -> tv.World:
    """Return a world in which particles rise at constant speeds; the last two are linked."""
    particles = tv.Particles(X[:n], velocity=np.stack([0 * SPEED, SPEED], axis=1)[:n], radius=0.1)
    return tv.World(particles, [tv.Distance([[n - 2, n - 1]])], precision="f64", substeps=1)


def unpacked(packed) -> np.ndarray:
    """Return red, green and blue of RGBA as u32, (n, 3)."""
    packed = np.array(packed, dtype=np.uint32)
    return np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=1).astype(int)


CHOICES = {
    "integers": (GIVEN, GIVEN),
    "floats": (GIVEN / 255, GIVEN),
    "a quantity and its range": (("speed", 0, 2), BY_SPEED),
    "a quantity": ("speed", BY_SPEED),
    "a function": (upwards, BY_SPEED),
    "a function and its range": ([upwards, 0, 2.0], BY_SPEED),
}
choices = pytest.mark.parametrize("color, wanted", CHOICES.values(), ids=CHOICES)
some = ["floats", "a function and its range"]
both = pytest.mark.parametrize("color, wanted", [CHOICES[name] for name in some], ids=some)


def recorded(path, color, frames: int = 2) -> tv.recording.Replay:
    with scene() as world, tv.Recorder(path, world, color=color) as recorder:
        world.run(frames / 60, recorder=recorder)
    return tv.replay(path)


@choices
def test_a_recording_and_what_is_exported_from_it_have_the_colours_that_were_chosen(color, wanted, tmp_path):
    recording = recorded(tmp_path / "a.rrd", color)
    drawn = column(tmp_path / "a.rrd", "world/scene/particles", "Points2D:colors")
    assert len(drawn) == (1 if isinstance(color, np.ndarray) else 3)  # static, or in each frame
    for row in drawn:
        assert unpacked(row).tolist() == wanted.tolist()
    (line,) = {tuple(row) for row in column(tmp_path / "a.rrd", "world/scene/particles", "LineStrips2D:colors")}
    assert unpacked(line).tolist() == [np.rint(wanted[3:].mean(axis=0)).tolist()]
    assert recording.verify()
    assert_exports(recording, tmp_path, {}, wanted)


@both
def test_exports_have_the_colours_that_they_are_asked_for(color, wanted, tmp_path):
    # The recording has others; a quantity that is not in it is computed again.
    assert_exports(recorded(tmp_path / "a.rrd", None), tmp_path, {"color": color}, wanted)


def assert_exports(recording, folder, choice, wanted):
    """Check the colours of discs in a film, and of particles in .glb and .vtu files."""
    recording.export(folder / "a.gif", size=(960, 480), **choice)
    with Image.open(folder / "a.gif") as film:
        pixels = np.asarray(film.convert("RGB")).astype(int)
    found = [np.abs(pixels - hue).max(axis=2) <= 3 for hue in wanted]
    across = [float(np.nonzero(some)[1].mean()) for some in found]
    if len({*map(tuple, wanted.tolist())}) == 5:  # each disc is where it belongs, and has its colour
        np.testing.assert_allclose(np.polyval(np.polyfit(X[:, 0], across, 1), X[:, 0]), across, atol=4)
    assert all(some.sum() > 500 for some in found)

    recording.export(folder / "a.glb", **choice)
    text, _ = parsed(folder / "a.glb")
    nodes = {node["name"]: node for node in text["nodes"]}
    for i, hue in enumerate(wanted):
        (part,) = text["meshes"][nodes[f"particle {i}"]["mesh"]]["primitives"]
        factor = text["materials"][part["material"]]["pbrMetallicRoughness"]["baseColorFactor"]
        np.testing.assert_allclose(factor, [*linear(hue), 1.0], rtol=1e-6)
    (part,) = text["meshes"][nodes["links"]["mesh"]]["primitives"]
    ends = values(*parsed(folder / "a.glb"), part["attributes"]["COLOR_0"])[:, :3]
    assert ends.tolist() == np.rint(255 * linear(wanted[3:])).tolist()

    recording.export(folder / "a.pvd", **choice)
    meshio = pytest.importorskip("meshio")
    for k in range(3):
        assert meshio.read(folder / f"a_{k:04d}.vtu").point_data["color"].tolist() == wanted.tolist()


@both
def test_usd_has_the_colours_of_each_frame(color, wanted, tmp_path):
    usd, geom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    recorded(tmp_path / "a.rrd", None).export(tmp_path / "a.usda", color=color)
    stage = usd.Stage.Open(str(tmp_path / "a.usda"))
    for name, of in (("particles", wanted), ("links", wanted[3:])):
        shown = geom.PrimvarsAPI(stage.GetPrimAtPath(f"/scene/part_0/{name}")).GetPrimvar("displayColor")
        for code in (0, 1, 2):
            np.testing.assert_allclose(np.array(shown.Get(code)), linear(of), atol=1e-6)


@both
def test_a_page_has_the_colours_that_were_chosen(color, wanted):
    said: list = []
    page = SimpleNamespace(waiting=0, known={}, send=said.append)
    with scene() as world:
        live = Session(world, SimpleNamespace(viewers=[page], received=queue.Queue()), color=color)  # type: ignore[arg-type]
        for _ in range(2):
            live.advance()
        live.close()
    first, *_ = (message for message in map(json.loads, (m for m in said if isinstance(m, str))) if message["kind"] == "scene")
    assert np.reshape(first["color"], (-1, 3)).tolist() == wanted.tolist()
    for frame in (m for m in said if isinstance(m, bytes)):
        (length,) = struct.unpack("<I", frame[:4])
        rest = frame[4 + length + 4 * 2 * 5 :]
        assert np.frombuffer(rest, np.uint8).tolist() == ([] if isinstance(color, np.ndarray) else wanted.ravel().tolist())


@pytest.mark.slow
@both
def test_worlds_side_by_side_have_the_colours_that_were_chosen(color, wanted, tmp_path):
    with tv.Worlds(scene(), 2) as many, tv.WorldsRecorder(tmp_path / "a.rrd", many, color=color) as recorder:
        many.step(1 / 60)
        recorder.log()
    for k in range(2):
        drawn = read(tmp_path / "a.rrd", f"/worlds/{k}/world/scene/particles", "Points2D:colors")
        assert {tuple(map(tuple, unpacked(row).tolist())) for row in drawn.values() if row} == {(*map(tuple, wanted.tolist()),)}


def test_without_a_range_each_frame_has_its_own_and_what_is_not_finite_is_grey():
    with scene() as world:
        shown = Coloring.checked("", lambda w: np.array([3.0, 4, 5, np.nan, np.inf]), 5).colors(world)
        assert shown.tolist() == [LOW, MIDDLE, HIGH, [128] * 3, [128] * 3]
        assert Coloring.checked("", lambda w: np.full(5, 7), 5).colors(world).tolist() == [LOW] * 5
        assert Coloring.checked("", None, 5).colors(world).tolist() == by_body(world).tolist()


@pytest.mark.slow
def test_every_named_quantity_is_what_it_says():
    # A disc of 2 kg rests on a pinned one; the load between them is its weight.
    particles = tv.Particles([[0.0, 0.0], [0.0, 0.2], [9.0, 0.0]], mass=[1, 2, 3], radius=0.1, pinned=[0], spin=[0, 0, -4.0],
                             group=[0, 1, 2], velocity=[(0, 0), (0, 0), (3, 4)])  # fmt: skip
    with tv.World(particles, [tv.Gravity((0, -9.81)), tv.Contact()], precision="f64", substeps=10) as world:
        assert QUANTITIES["load"](world).tolist() == [0, 0, 0]
        assert QUANTITIES["speed"](world).tolist() == [0, 0, 5] and QUANTITIES["spin"](world).tolist() == [0, 0, 4]
        world.run(1.0)
        np.testing.assert_allclose(QUANTITIES["load"](world), [2 * 9.81, 2 * 9.81, 0], rtol=1e-3)
        found = {name: Coloring.checked("", name, 3).values(world) for name in QUANTITIES}
    assert found["radius"] == pytest.approx([0.1] * 3) and found["group"].tolist() == [0, 1, 2]
    assert found["mass"][1:].tolist() == [2, 3]


@pytest.mark.parametrize(
    "color, kind, text",
    [
        (GIVEN[:4], ValueError, r"color has shape \(4, 3\), but \(5, 3\) is needed"),
        ([255, 0, 0], ValueError, r"color has shape \(3,\), but \(5, 3\) is needed"),
        (GIVEN + 1, ValueError, r"color\[2, 2\] = 256, but integers are in 0 ... 255; write floats"),
        (GIVEN * 1.0, ValueError, r"color\[0, 0\] = 10, but floats are in 0 ... 1; write integers"),
        (np.where(GIVEN == 128, np.nan, 0.5), ValueError, r"color\[1, 1\] = nan, but floats"),
        ([[1, 2, 3], [1, 2]], TypeError, r"colours \(n, 3\) are needed, or a quantity \(speed, spin, load, mass,"),
        (("speed", 0), TypeError, r'with the ends of its scale: \("speed", 0, 2\)'),
        (("speed", 1, 1), ValueError, "1 is not less than 1"),
        (("speed", 0, np.inf), ValueError, r"color\[2\] = inf, but it must be finite"),
        ("heat", ValueError, "color = 'heat' is no quantity here; there are speed, spin, load, mass, radius, group. Or"),
        (lambda w: w.velocity, ValueError, r"<lambda>\(\) returned an array of shape \(5, 2\) .* a number for each of 5"),
        (lambda w: ["a"] * 5, ValueError, r"<lambda>\(\) returned an array of shape \(5,\) and type <U1"),
    ],
)
def test_wrong_colours_are_refused(color, kind, text):
    with scene() as world, pytest.raises(kind, match=text):
        Coloring.checked("play", color, 5).colors(world)


def test_a_recorder_needs_the_quantity_that_it_shows(tmp_path):
    with scene() as world:
        with tv.Recorder(tmp_path / "a.rrd", world, color=("heat", 0, 1)) as recorder:
            with pytest.raises(
                ValueError, match=r"color = 'heat' is neither one of speed, .* Write recorder.log\(\*\*{'heat': ...}"
            ):
                recorder.log(heat=3.0)
            recorder.log(heat=[0.0, 0.5, 1, 0.5, 0.5])
        for color, name in (("speed", "speed"), (upwards, "upwards()")):
            with tv.Recorder(tmp_path / "b.rrd", world, color=color, overwrite=True) as recorder:
                with pytest.raises(ValueError, match="is computed for the colours of the picture; choose another name"):
                    recorder.log(**{name: SPEED})
                recorder.log()
    recording = tv.replay(tmp_path / "a.rrd")
    assert recording.verify()
    assert_exports_of_heat(recording, tmp_path)


def assert_exports_of_heat(recording, folder):
    """Check that exports show what was logged: grey before, then the quantity; of .glb the last frame."""
    meshio = pytest.importorskip("meshio")
    for choice in ({}, {"color": ("heat", 0, 1)}):
        recording.export(folder / "h.pvd", **choice)
        shown = [meshio.read(folder / f"h_{k:04d}.vtu").point_data["color"].tolist() for k in range(2)]
        assert shown == [[[128] * 3] * 5, BY_SPEED.tolist()]
    with pytest.raises(ValueError, match="color = 'cold' is no quantity here; there are speed, .*, heat"):
        recording.export(folder / "h.pvd", color="cold")
    with pytest.raises(ValueError, match="a.csv takes no color; .gif, .glb"):
        recording.export(folder / "a.csv", color="speed")


@pytest.mark.parametrize("swap", [False, True], ids=["added", "one for another"])
def test_given_colours_end_where_particles_come_or_go_and_quantities_follow(tmp_path, swap):
    with scene() as world:
        given = tv.Recorder(tmp_path / "a.rrd", world, color=GIVEN)
        follows = tv.Recorder(tmp_path / "b.rrd", world, color=("speed", 0, 2))
        world.add(features=[tv.Gravity(0.0)])  # the particles are the same
        given.log()
        follows.log()
        world.add(tv.Particles([[4.0, 0.0]], velocity=(0.0, 2.0), radius=0.1))
        if swap:
            world.remove([0])
        with pytest.raises(
            ValueError, match="5 particles, and since then particles were added or removed.*function of the world"
        ):
            given.log()
        follows.log()
        given.close()
        follows.close()
    assert tv.replay(tmp_path / "a.rrd").verify() and tv.replay(tmp_path / "b.rrd").verify()
    last = column(tmp_path / "b.rrd", f"world/scene/scene{2 + swap}/particles", "Points2D:colors")[-1]
    assert unpacked(last).tolist() == [*BY_SPEED[swap:].tolist(), HIGH]


def test_a_recording_holds_the_quantity_that_it_shows(tmp_path):
    recording = recorded(tmp_path / "a.rrd", "speed")
    frames, speed = recording.quantities["speed"]
    assert frames.tolist() == [0, 1, 2] and speed == pytest.approx(np.tile(SPEED, (3, 1)))


def test_commands_take_colours(tmp_path, capsys):
    recording = recorded(tmp_path / "a.rrd", None)
    out = str(tmp_path / "a.pvd")
    assert main(["replay", recording.path, "--export", out, "--color", "speed,0,2"]) == 0
    assert b'Name="color"' in (tmp_path / "a_0000.vtu").read_bytes()
    assert main(["replay", recording.path, "--export", out, "--color", "heat"]) == 2
    assert "there are speed, spin" in capsys.readouterr().err
    script = tmp_path / "rise.py"
    script.write_text("from tests.test_colors import scene\nscene().run(2 / 60)\n")
    assert main(["run", str(script), "--out", str(tmp_path / "b.rrd"), "--color", "speed"]) == 0
    drawn = column(tmp_path / "b.rrd", "world/scene/particles", "Points2D:colors")
    assert unpacked(drawn[-1]).tolist() == BY_SPEED.tolist()
