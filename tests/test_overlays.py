"""What a Recorder draws on request, which quantities of users it stores, how it frames a run; and what notebooks show."""

import json
import re
import subprocess
import urllib.request
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from PIL import Image, ImageDraw

import tiverlet as tv
from tests.test_recorder import read
from tiverlet.live.scene import scene
from tiverlet.recording import messages, viewer, watch
from tiverlet.recording.drawing import view_up
from tiverlet.recording.exports.geometry import geometry
from tiverlet.recording.exports.sketch import FINE, Look, Sketch, View
from tiverlet.recording.fill import Fill, outlines
from tiverlet.recording.hues import PALETTE, ramp
from tiverlet.recording.layout import SCENE_VIEW, scene_view, unit
from tiverlet.recording.rims import rims
from tiverlet.recording.scene import describe, parts

pytestmark = pytest.mark.usefixtures("read_here")


def stack(n=4):
    """Return a world with a column of touching discs of 1 kg and 10 cm radius."""
    x = np.stack([np.zeros(n), 0.1 + 0.2 * np.arange(n)], axis=1)
    features = [tv.Gravity(9.81), tv.Contact(), tv.Box((-0.1, 0.0), (0.1, 2.0))]
    return tv.World(tv.Particles(x, mass=1.0, radius=0.1), features, substeps=20)


def column(path, entity, name):
    """Return the values of a component in all rows of an entity, in the order of frames."""
    found = read(path, f"/{entity}", name)
    return [found[k] for k in sorted(found, key=lambda k: -1 if k is None else k) if found[k] is not None]


@pytest.mark.slow
def test_lines_are_as_wide_as_the_loads_they_show(tmp_path):
    # At rest the k-th contact from the top bears k m g, and lines are as wide as the loads.
    path = tmp_path / "a.rrd"
    world = stack()
    with tv.Recorder(path, world, forces=True, velocities=True) as recorder:
        world.run(4.0, recorder=recorder)
    assert tv.replay(path).verify()
    widths = np.sort(column(path, "world/scene/contacts", "LineStrips2D:radii")[-1])
    np.testing.assert_allclose(widths / widths[0], [1, 2, 3], rtol=5e-3)
    strips = np.array(column(path, "world/scene/contacts", "LineStrips2D:strips")[-1])
    assert strips.shape == (3, 3, 2) and np.abs(strips[:, 2, 1] - strips[:, 0, 1]).max() == pytest.approx(0.2, rel=1e-2)
    ways = np.array(column(path, "world/scene/velocities", "Arrows2D:vectors"))
    assert ways.shape == (241, 4, 2) and np.abs(ways[-1]).max() < 1e-4


def test_arrows_show_the_way_of_a_twentieth_of_a_second(tmp_path):
    world = tv.World(tv.Particles([[0.0, 0, 0]], velocity=(1, 2, 3)), [], substeps=1)
    with tv.Recorder(tmp_path / "a.rrd", world, velocities=True) as recorder:
        world.run(0.1, recorder=recorder)
    np.testing.assert_allclose(column(tmp_path / "a.rrd", "world/scene/velocities", "Arrows3D:vectors")[-1], [[0.05, 0.1, 0.15]])


def test_quantities_of_ones_own_are_kept_and_shown(tmp_path):
    path, world = tmp_path / "a.rrd", stack()
    with tv.Recorder(path, world, every=2, color=("height", 0.0, 0.8)) as recorder:
        for k in range(1, 7):
            world.step(1 / 60)
            recorder.log(top=k, height=world.position[:, 1])
    recording = tv.replay(path)
    assert recording.verify()
    frames, top = recording.curves["top"]
    assert frames.tolist() == [2, 4, 6] and top.tolist() == [2, 4, 6]
    frames, height = recording.quantities["height"]
    np.testing.assert_allclose(height, [recording.position(k)[:, 1] for k in frames], rtol=1e-6)
    packed = np.array(column(path, "world/scene/particles", "Points2D:colors")[-1], dtype=np.uint32)
    drawn = np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], axis=1)
    assert (drawn == ramp(height[-1], (0.0, 0.8))).all()


def test_quantities_may_have_any_printable_name(tmp_path):
    # rerun escapes most characters in a path. "violation" is how the path of the built-in residuals ends.
    names = ["height [m]", "arm/angle", "50 %: x*y", "α² → 😀", "é", "नमस्ते", "violation", "a.b-c"]
    path, world = tmp_path / "a.rrd", stack()
    with tv.Recorder(path, world) as recorder:
        for k in range(1, 3):
            world.step(1 / 60)
            recorder.log(**{name: k + i for i, name in enumerate(names)}, **{"force [N]": world.position[:, 1]})
    recording = tv.replay(path)
    assert recording.verify().kind == "intact"
    for i, name in enumerate(names):
        assert recording.curves[name][1].tolist() == [1 + i, 2 + i]
    assert len(recording.curves["residual"][1]) == 2 and "force [N]" in recording.quantities
    recording.export(tmp_path / "a.NPZ")
    with np.load(tmp_path / "a.NPZ") as arrays:
        assert {f"{name} value" for name in (*names, "force [N]")} <= {*arrays.files}
    with tv.Recorder(tmp_path / "b.rrd", world) as recorder:
        for wrong in ("", "/x", "x/", "a//b", "../x", "a\\b", "a\nb"):
            with pytest.raises(ValueError, match="is no name of a quantity"):
                recorder.log(**{wrong: 1.0})
        recorder.log()


def test_the_scale_of_colours_goes_from_end_to_end():
    assert ramp(np.array([-1.0, 0, 1, 2, np.nan]), (0, 1)).tolist() == [
        [68, 1, 84], [68, 1, 84], [253, 231, 37], [253, 231, 37], [128, 128, 128]
    ]  # fmt: skip
    np.testing.assert_allclose(ramp(np.array([0.625]), (0, 1)), [[64, 173, 119]], atol=1)  # between the third and the fourth


@pytest.mark.parametrize(
    "call, kind, text",
    [
        (lambda w, p: tv.Recorder(p, w, forces="yes"), TypeError, "forces = 'yes'"),
        (lambda w, p: tv.Recorder(p, w).log(energy=1.0), ValueError, "energy is the name of a curve"),
        (lambda w, p: tv.Recorder(p, w).log(heat=[1.0, 2.0]), ValueError, r"heat has the shape \(2,\)"),
        (lambda w, p: tv.Recorder(p, w).log(heat="hot"), ValueError, "heat has the shape"),
        (lambda w, p: tv.Recorder(None, w), ValueError, "path = None is for live recordings"),
        (lambda w, p: tv.Recorder(p, w, live="window"), ValueError, "live = 'window'"),
        (lambda w, p: tv.Recorder(p, w, live="notebook"), ValueError, "shows without a file"),
    ],
)
def test_wrong_requests_are_refused(tmp_path, call, kind, text):
    with pytest.raises(kind, match=text):
        call(stack(), tmp_path / "a.rrd")


def test_strain_can_be_left_out(tmp_path):
    # A load stretches a soft link to twice its length: red on the scale of strain, or neutral without one.
    shades = []
    for strain in (True, False):
        soft = tv.Distance([[0, 1]], 1.0, compliance=1.0)
        world = tv.World(tv.Particles([[0.0, 0], [2, 0]], pinned=[0]), [soft], substeps=1)
        with tv.Recorder(tmp_path / f"{strain}.rrd", world, strain=strain) as recorder:
            world.run(1 / 60, recorder=recorder)
        assert tv.replay(tmp_path / f"{strain}.rrd").verify()
        (packed,) = column(tmp_path / f"{strain}.rrd", "world/scene/particles", "LineStrips2D:colors")[-1]
        shades.append([packed >> 24, packed >> 16 & 255, packed >> 8 & 255])
        assert bool(column(tmp_path / f"{strain}.rrd", "legend/strain/scale", "LineStrips2D:strips")) == strain
    assert shades == [[255, 92, 48], [170, 172, 182]]


@pytest.mark.filterwarnings("ignore:.*no constraint holds loops")
@pytest.mark.parametrize("turn", [0.7])
@pytest.mark.parametrize("rounding", [0.0, 0.1])
@pytest.mark.parametrize("shape", ["brick", "hexagon", "triangle"])
def test_lines_fill_bodies_in_the_plane(shape, turn, rounding):
    # Points inside the body are on a line, except in sharp corners and at the very middle; and no line leaves the body, which
    # reaches as far as its rounding: what rests on a floor is drawn on it.
    x = {
        "brick": np.array([[0.0, 0], [2, 0], [2, 1], [0, 1]]),
        "hexagon": np.stack([np.cos(np.arange(6) * np.pi / 3), np.sin(np.arange(6) * np.pi / 3)], axis=1),
        "triangle": np.array([[0.0, 0], [1, 0], [0.5, 0.9]]),
    }[shape]
    world = tv.World(tv.Particles(x, radius=rounding), [tv.Polygons([np.arange(len(x))[::-1]])])
    fill = Fill(outlines(world), x, np.zeros((len(x), 3)), np.zeros(0, dtype=np.int64), rims(world))
    c, s = np.cos(turn), np.sin(turn)
    there = x @ np.array([[c, s], [-s, c]]) + 5.0  # the body has moved since
    points, ends = fill.strips(there)
    spread = np.random.default_rng(0).uniform(there.min(axis=0) - 0.3, there.max(axis=0) + 0.3, (4000, 2))
    gap = np.full(len(spread), np.inf)
    for k, radius in enumerate(fill.radii):
        strip = points[ends[k] : ends[k + 1]]
        assert (strip[0] == strip[-1]).all() or radius == np.float32(rounding)  # closed, or a rounded edge
        gap = np.minimum(gap, distance_to(strip, spread) - radius)
    closed = np.concatenate([there, there[:1]])
    inside, edge = winding(there, spread), distance_to(closed, spread)
    assert (gap[inside] < 1e-6).mean() > 0.96
    assert gap[~inside & (edge > rounding + 1e-6)].min() > -1e-6
    assert rounding == 0 or gap[edge < rounding].max() < 1e-6


@pytest.mark.filterwarnings("ignore:.*no constraint holds loops")
def test_bodies_are_drawn_rounded_by_their_radius():
    # A box of corners with a radius of 0.1 m that stands on a floor, in a film, a recording, a notebook and the page: the floor
    # shows nowhere below it, and nothing is farther than 0.1 m from the outline of its corners.
    x = np.array([[0.0, 0.1], [2, 0.1], [2, 1.1], [0, 1.1]])
    world = tv.World(tv.Particles(x, radius=0.1), [tv.Polygons([np.arange(4)])])
    spread = np.random.default_rng(0).uniform((-0.3, -0.2), (2.3, 1.4), (4000, 2))
    away = np.where(winding(x, spread), -1, 1) * distance_to(np.concatenate([x, x[:1]]), spread)
    lines = Fill(outlines(world), x, np.zeros((4, 3)), np.zeros(0, dtype=np.int64), rims(world))
    points, ends = lines.strips(x)
    gaps = [distance_to(points[ends[k] : ends[k + 1]], spread) - radius for k, radius in enumerate(lines.radii)]
    assert len(ends) == len(lines.radii) + 1 == len(lines.colors(np.zeros(0))) + 1 == 3 + 4 + 1
    drawn = np.min(gaps, axis=0) <= 0
    assert drawn[(away < 0.0999) & (np.abs(away) < 0.3)].all() and not drawn[away > 0.1001].any()

    found = parts(*describe(world))
    shape = geometry(found)
    view = View(np.array([-0.3, -0.2]), np.array([2.3, 1.4]), np.array([0.0, 1]), Look())
    film = np.asarray(Sketch(Image, ImageDraw, found, shape, view, (spread.min(axis=0), spread.max(axis=0))).frame(x, shape))
    column, row = np.floor(view.place(spread)[0].T / FINE).astype(int)
    lit = (film[row, column] == shape.hues[0]).all(axis=1)
    pixel = FINE / view.scale  # [m]
    assert lit[away < 0.1 - 2 * pixel].all() and not lit[away > 0.1 + 2 * pixel].any()

    (scale,) = {float(r) / 0.1 for r in re.findall(r"r='([0-9.]+)'", world._repr_html_())}  # pixels per meter
    widths = [float(w) for w in re.findall(r"stroke-width='([0-9.]+)'", world._repr_html_())]
    assert widths == pytest.approx([0.2 * scale] * 4, abs=0.2)  # they have one decimal
    message = json.loads(scene(world, "", (x[0], x[2])))
    assert message["edges"] == [[0, 1], [1, 2], [2, 3], [3, 0]] and message["edge_radius"] == pytest.approx([0.1] * 4)


def distance_to(strip, points):
    """Return the distance of each point to a line strip."""
    a, b = strip[:-1], strip[1:]
    t = np.einsum("pij,ij->pi", points[:, None] - a, b - a) / np.maximum(np.einsum("ij,ij->i", b - a, b - a), 1e-30)
    near = a + np.clip(t, 0, 1)[..., None] * (b - a)
    return np.linalg.norm(points[:, None] - near, axis=2).min(axis=1)


def winding(x, points):
    """Return which points are inside of a convex loop."""
    a, b = x, np.roll(x, -1, axis=0)
    side = (b - a)[:, 0] * (points[:, None] - a)[..., 1] - (b - a)[:, 1] * (points[:, None] - a)[..., 0]
    return (side > 0).all(axis=1)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Distance. pairs.3. = .3, 0. is off by 0.16:UserWarning")
def test_a_body_shows_the_worst_strain_of_its_links(tmp_path):
    # One rod of a square is a tenth too long: the body is red. As it is one body, its diagonal is not drawn as a line.
    x = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    rods = tv.Distance([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2]], [1, 1, 1, 1 / 1.2, 2**0.5])
    world = tv.World(tv.Particles(x, pinned=[0, 1, 2, 3]), [rods, tv.Polygons([[0, 1, 2, 3]])])
    with tv.Recorder(tmp_path / "a.rrd", world) as recorder:
        world.run(1 / 60, recorder=recorder)
    assert tv.replay(tmp_path / "a.rrd").verify()
    packed = column(tmp_path / "a.rrd", "world/scene/fill", "LineStrips2D:colors")[-1]
    assert [packed[0] >> 24, packed[0] >> 16 & 255, packed[0] >> 8 & 255] == [255, 92, 48] and len(packed) == 3
    assert not column(tmp_path / "a.rrd", "world/scene/particles", "LineStrips2D:strips")


def test_a_view_frames_the_whole_run(tmp_path):
    # A ball is thrown: only its path determines the view.
    world = tv.World(tv.Particles([[0.0, 0.0]], velocity=(3.0, 4.0), radius=0.1), [tv.Gravity(9.81)], precision="f64")
    with tv.Recorder(tmp_path / "a.rrd", world) as recorder:
        world.run(1.0, recorder=recorder)
    assert tv.replay(tmp_path / "a.rrd").verify()
    chunks = [messages.Chunk(m).rows() for kind, m in messages.split((tmp_path / "a.rrd").read_bytes()) if kind == messages.CHUNK]
    name = f"/view/{SCENE_VIEW}/VisualBounds2D".encode()
    (bounds,) = (rows for rows in chunks if rows.schema.metadata[b"rerun:entity_path"] == name)
    ((value,),) = bounds.column("VisualBounds2D:range").to_pylist()
    x, y = value["x_range"], value["y_range"]
    edge = 0.05 * 3.2  # 5 % of the longer side: 3 m and two radii
    np.testing.assert_allclose(x, [-0.1 - edge, 3.1 + edge], rtol=1e-6)
    np.testing.assert_allclose(y, [-(4.0**2 / 2 / 9.81) - 0.1 - edge, 9.81 / 2 - 4.0 + 0.1 + edge], atol=2e-3)


@pytest.mark.parametrize("size, times", [(2e-2, 1), (3e-6, 1e6), (5e6, 1e-6)])
def test_small_and_large_scenes_are_shown_at_another_size(tmp_path, size, times):
    assert unit(np.zeros(2), np.array([size, size / 2])) == pytest.approx(times)
    world = tv.World(tv.Particles([[0.0, 0, 0], [size, 0, 0]]), [])
    with tv.Recorder(tmp_path / "a.rrd", world) as recorder:
        world.run(1 / 60, recorder=recorder)
    assert tv.replay(tmp_path / "a.rrd").verify()
    scales = column(tmp_path / "a.rrd", "world/scene", "Transform3D:scale")
    assert scales == ([] if times == 1 else [[pytest.approx([times] * 3)]])
    np.testing.assert_array_equal(tv.replay(tmp_path / "a.rrd").position(1)[1], np.float32([size, 0, 0]))


def test_a_recording_is_served_while_it_is_made(tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(watch.webbrowser, "open", opened.append)
    world = stack()
    with tv.Recorder(tmp_path / "a.rrd", world, live="web") as recorder:
        world.run(0.2, recorder=recorder)
        recorder.flush()
        (url,) = opened
        assert url in capsys.readouterr().out and url.startswith("http://127.0.0.1:")
        assert b"rerun" in urllib.request.urlopen(url, timeout=20).read().lower()
    assert tv.replay(tmp_path / "a.rrd").verify()


def test_a_viewer_that_is_closed_ends_no_recording(tmp_path):
    port, world = viewer.free_port(), stack()
    with viewer.scratch() as folder:
        words = ("--serve-web", "--port", str(port), "--web-viewer-port", str(viewer.free_port()))
        process = viewer.launch(folder, *words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        watch._wait_for_port(process, port)
        with tv.Recorder(tmp_path / "a.rrd", world, live=f"rerun+http://127.0.0.1:{port}/proxy") as recorder:
            world.run(0.1, recorder=recorder)
            recorder.flush()
            viewer.stop(process)
            world.run(0.1, recorder=recorder)
            recorder.flush()
            world.run(0.1, recorder=recorder)
    recording = tv.replay(tmp_path / "a.rrd")
    assert recording.verify() and recording.frames[-1] == 18


def test_where_no_viewer_starts_it_says_what_to_do(monkeypatch):
    monkeypatch.setattr(viewer, "launch", lambda *words, **options: subprocess.Popen(["false"], start_new_session=True))
    with pytest.raises(RuntimeError, match='without them use live="web"'):
        watch.address(True)


def test_notebooks_show_worlds_reports_features_and_recordings(tmp_path):
    world = stack()
    with tv.Recorder(tmp_path / "a.rrd", world) as recorder:
        report = world.run(0.1, recorder=recorder)
    html = world._repr_html_()
    image = ET.fromstring(re.search(r"<svg.*</svg>", html, re.S)[0])  # type: ignore[index]
    circles = [e for e in image if e.tag.endswith("circle")]
    x, y = (np.array([float(c.get(k)) for c in circles]) for k in ("cx", "cy"))
    scale = (280 - 0) / 2.0  # the box is 2 m high
    np.testing.assert_allclose(x, 2 + 0.1 * scale, atol=0.1)
    np.testing.assert_allclose(y, 2 + (2.0 - world.position[:, 1]) * scale, atol=0.1)
    assert "explain()" in html and "neighbour list" in html
    assert "residual" in report._repr_html_() and "(-0.1, 0.0)" in world.features[2]._repr_html_()
    assert "7" in tv.replay(tmp_path / "a.rrd")._repr_html_()
    world.close()
    assert world._repr_html_() == f"<code>{world!r}</code>"
    solid = tv.World(tv.Particles([[0.0, 0, 0], [1, 0, 0]], radius=0.1), [tv.HalfSpace((0, 1, 0)), tv.Gravity()])
    assert solid._repr_html_().count("<circle") == 2


@pytest.mark.slow
def test_y_points_down_where_the_view_is_asked_for_it(tmp_path):
    # A disc below another one in coordinates of pixels: lower in the picture where y points down. The physics is the same.
    hashes = []
    for down in (False, True):
        world = tv.World(tv.Particles([[100.0, 50], [100, 250]], radius=20), [tv.Gravity((0, 981)), tv.Box((0, 0), (200, 300))])
        with tv.Recorder(tmp_path / "run.rrd", world, overwrite=True, y_down=down) as recorder:
            world.run(0.1, recorder=recorder)
        recording = tv.replay(tmp_path / "run.rrd")
        assert recording.verify()
        hashes.append(world.hash())
        assert read(tmp_path / "run.rrd", "/world/scene", "Transform3D:scale")[None] == [[1, 1 if down else -1, 1]]
        film = recording.export(tmp_path / "run.gif")[0]
        with Image.open(film) as image:
            pixels = np.asarray(image.convert("RGB")).astype(int)
        rows = [np.argwhere((np.abs(pixels - hue) < 12).all(axis=2))[:, 0].mean() for hue in PALETTE[:2].astype(int)]
        assert (rows[0] < rows[1]) == down
        view = scene_view(np.zeros(2), np.array([200.0, 300]), view_up(world, down))
        ends = view.properties["VisualBounds2D"].range.as_arrow_array().to_pylist()[0]
        assert (ends["y_range"] == [-15, 315]) == down and (ends["y_range"] == [-315, 15]) != down
        assert json.loads(scene(world, "", (np.zeros(2), np.ones(2)), down))["up"] == [0, -1 if down else 1]
    assert hashes[0] == hashes[1]
    high = tv.World(tv.Particles([[0.0, 0, 0]]))
    with pytest.raises(ValueError, match="y_down is for worlds in 2D"):
        tv.Recorder(tmp_path / "high.rrd", high, y_down=True)
