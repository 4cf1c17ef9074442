"""What recordings, pages and notebooks show: the world as it is, what is asked for beside it, in the colours that were chosen."""

import base64
import io
import json
import queue
import struct
import subprocess
import urllib.request
import warnings
from importlib.util import find_spec
from itertools import pairwise
from types import SimpleNamespace

import meshio
import numpy as np
import pytest
import rerun as rr
from PIL import Image

import tiverlet as tv
from tests.outlines import outside
from tests.test_exports import parsed, values
from tiverlet.__main__ import main
from tiverlet.live.scene import scene
from tiverlet.live.session import Session
from tiverlet.recording import messages, viewer
from tiverlet.recording.bodies import rims
from tiverlet.recording.drawing import view_up
from tiverlet.recording.exports.geometry import geometry, linear
from tiverlet.recording.exports.sketch import FINE, Look, Sketch, View
from tiverlet.recording.fill import Fill, outlines
from tiverlet.recording.hues import PALETTE, Coloring, by_body, ramp
from tiverlet.recording.layout import SCENE_VIEW, scene_view, unit
from tiverlet.recording.lines import trails
from tiverlet.recording.markup import SIZE
from tiverlet.recording.quantities import QUANTITIES
from tiverlet.recording.scene import describe, parts
from tiverlet.recording.strain import SCALE, levels

pytestmark = pytest.mark.usefixtures("read_here")
FRAME = 1 / 60


def read(path, entity: str, name: str):
    """Return all rows of a component of an entity, by frame (None for static data)."""
    out = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rerun expects a footer, which would take 90 kB
        reader = rr.chunk.RrdReader(str(path))
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == f"/{entity}" and name in batch.schema.names:
            rows = batch.column(name)
            frames = [None] * len(rows) if chunk.is_static else batch.column("frame").to_numpy(zero_copy_only=False)
            out |= dict(zip(frames, rows.to_pylist(), strict=True))
    return out


def column(path, entity: str, name: str) -> list:
    """Return the values of a component in the order of frames."""
    found = read(path, entity, name)
    return [found[k] for k in sorted(found, key=lambda k: -1 if k is None else k) if found[k] is not None]


def unpacked(words) -> np.ndarray:
    """Return red, green and blue of RGBA as u32, (n, 3)."""
    words = np.array(words, dtype=np.uint32)
    return np.stack([words >> 24, words >> 16 & 255, words >> 8 & 255], axis=1).astype(int)


def stack():
    """Return a world with a column of four touching discs of 1 kg and 10 cm radius."""
    x = np.stack([np.zeros(4), 0.1 + 0.2 * np.arange(4)], axis=1)
    features = [tv.Gravity(9.81), tv.Contact(), tv.Box((-0.1, 0.0), (0.1, 2.0))]
    return tv.World(tv.Particles(x, mass=1.0, radius=0.1), features, substeps=20)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_every_frame_shows_the_world_as_it_was(world, tmp_path, dim):
    # A rope, and links between any of its particles, of which some break: each that holds is in one strip.
    rope = np.stack([np.arange(29), np.arange(1, 30)], axis=1)
    some = np.random.default_rng(0).integers(0, 30, (40, 2))
    links = np.unique(np.sort(np.concatenate([rope, some[some[:, 0] != some[:, 1]]])), axis=0)
    start = tv.Particles(tv.golden(np.arange(30), dim=dim) * 0.9 + 0.05, radius=np.r_[0.0, np.full(29, 0.02)], pinned=[0])
    weak = np.where(np.arange(len(links)) % 3 == 2, 0.1, np.inf)
    features = [tv.Gravity(9.81), tv.Distance(links, compliance=0.1, break_at=weak), tv.Box([0] * dim, [1] * dim)]
    w = world(start, features, solver=tv.Jacobi())
    path, kind, seen, reports = tmp_path / "a.rrd", f"{dim}D", [(w.position, np.full(len(links), True))], []
    with tv.Recorder(path, w) as recorder:
        for _ in range(12):
            held = ~w.features[1].broken  # a link is drawn for the last time in the frame in which it breaks
            reports.append(w.step(FRAME))
            recorder.log()
            seen.append((w.position, held))

    def of(name):
        return read(path, "world/scene/particles", name)

    frames, strips, hues = of(f"Points{kind}:positions"), of(f"LineStrips{kind}:strips"), of(f"LineStrips{kind}:colors")
    assert sorted(frames) == list(range(13))
    for k, (position, holds) in enumerate(seen):
        x = position.astype(np.float32)
        np.testing.assert_array_equal(np.array(frames[k], dtype=np.float32), x)
        strain = np.linalg.norm(np.diff(position[links], axis=1)[:, 0], axis=1) / w.features[1].rest - 1
        wanted = zip(x[links][holds].tolist(), SCALE[levels(strain)][holds].tolist(), strict=True)
        shown = [(pair, hue) for strip, hue in zip(strips[k], hues[k], strict=True) for pair in pairwise(strip)]
        assert sorted((sorted(pair), hue) for pair, hue in shown) == sorted((sorted(pair), hue) for pair, hue in wanted)
    assert len(strips[12]) < holds.sum() < len(links) and len(set(hues[12])) > 1  # linked links of one colour are one strip
    radii = of(f"Points{kind}:radii")
    assert list(radii) == [None] and radii[None][0] < 0 and radii[None][1] == np.float32(0.02)
    hues = unpacked(of(f"Points{kind}:colors")[None])
    assert (hues[1:] == PALETTE[0]).all() and hues[0].tolist() == [
        140,
        140,
        150,
    ]  # linked particles are one body, held at its end
    for end, names in {"energy": ["energy"], "violation": ["residual", "overlap"], "substeps": ["substeps"]}.items():
        curve = read(path, f"figures/{end}", "Scalars:scalars")
        assert [curve[k + 1] for k in range(12)] == [[getattr(report, name) for name in names] for report in reports]
    curve = read(path, "figures/milliseconds", "Scalars:scalars")  # the first frame compiles
    assert [curve[k + 1][0] for k in range(1, 12)] == pytest.approx([report.seconds * 1e3 for report in reports[1:]], rel=5e-3)
    # y is up. The 2D views of rerun have y down, so a mirror above the data turns it; in 3D the view coordinates name it.
    up, is_up = ("Transform3D:scale", [[1, -1, 1]]) if dim == 2 else ("ViewCoordinates:xyz", [[3, 1, 6]])  # right, up, back
    assert read(path, "world/scene", up)[None] == is_up
    about = read(path, "about", "TextDocument:text")[None][0]
    assert "13 frames, 0.2 s simulated" in about and "constraint violation" in about
    assert set(read(path, "world/scene/walls/2", f"LineStrips{kind}:strips")) == {0}  # a wall that does not move is written once


def test_a_rope_is_one_strip():
    particles, link = trails(tv.shapes.rope((0, 0), (1, 0), 40).links)
    assert particles.tolist() == list(range(40)) and link.tolist() == [*range(39), -1]


def in_lab(rgb) -> np.ndarray:
    """Return colours, (n, 3) of sRGB in 0 ... 255, in CIELAB (D65), where distances are as seen: 2 is just noticeable."""
    c = np.atleast_2d(np.asarray(rgb, dtype=np.float64)) / 255
    c = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = c @ to_xyz.T / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


def test_neighbouring_bodies_differ_in_colour_and_from_strain_and_keep_theirs():
    # Six ropes side by side, and bodies in rows of any length: each differs from all eight around it.
    for points in (5, 8, 21):
        both, slices = tv.shapes.join(*(tv.shapes.rope((k, 2), (k, 1), points=points) for k in range(6)))
        hues = in_lab(by_body(tv.World(tv.Particles(both.position), [tv.Distance(both.links)]))[[s.start for s in slices]])
        assert np.linalg.norm(np.diff(hues, axis=0), axis=1).min() > 24
        at = np.stack(np.meshgrid(np.arange(points), np.arange(9)), axis=-1).reshape(-1, 2)
        a = in_lab(by_body(tv.World(tv.Particles(at)))).reshape(9, points, 3)
        for one, two in ((a[1:], a[:-1]), (a[:, 1:], a[:, :-1]), (a[1:, 1:], a[:-1, :-1]), (a[1:, :-1], a[:-1, 1:])):
            assert np.linalg.norm(one - two, axis=2).min() > 24
    assert np.linalg.norm(in_lab(PALETTE)[:, None] - in_lab(unpacked(SCALE)), axis=2).min() > 24
    world = tv.World(tv.Particles(tv.golden(np.arange(40), dim=2)))
    before = by_body(world)
    world.add(tv.Particles([[0.5, 0.5]]))
    np.testing.assert_array_equal(by_body(world)[:40], before)


@pytest.mark.slow
def test_lines_are_as_wide_as_the_loads_they_show(tmp_path):
    # At rest the k-th contact from the top bears k m g, and lines are as wide as the loads.
    path, w = tmp_path / "a.rrd", stack()
    with tv.Recorder(path, w, forces=True, velocities=True) as recorder:
        w.run(4.0, recorder=recorder)
    assert tv.replay(path).verify()
    widths = np.sort(column(path, "world/scene/contacts", "LineStrips2D:radii")[-1])
    np.testing.assert_allclose(widths / widths[0], [1, 2, 3], rtol=5e-3)
    strips = np.array(column(path, "world/scene/contacts", "LineStrips2D:strips")[-1])
    assert strips.shape == (3, 3, 2) and np.abs(strips[:, 2, 1] - strips[:, 0, 1]).max() == pytest.approx(0.2, rel=1e-2)
    ways = np.array(column(path, "world/scene/velocities", "Arrows2D:vectors"))
    assert ways.shape == (241, 4, 2) and np.abs(ways[-1]).max() < 1e-4
    np.testing.assert_allclose(QUANTITIES["load"](w), 9.81 * np.array([3, 3 + 2, 2 + 1, 1]), rtol=1e-3)


@pytest.mark.slow
def test_quantities_of_ones_own_are_kept_and_shown_by_any_printable_name(tmp_path):
    # rerun escapes most characters in a path. "violation" is how the path of the built-in residuals ends.
    names = ["height [m]", "arm/angle", "50 %: x*y", "α² → 😀", "é", "नमस्ते", "violation", "a.b-c"]
    path, w = tmp_path / "a.rrd", rising()
    with tv.Recorder(path, w, every=2, color=("up [m]", 0.0, 0.2), velocities=True) as recorder:
        for k in range(1, 7):
            w.step(FRAME)
            recorder.log(**{name: k + i for i, name in enumerate(names)}, **{"up [m]": w.position[:, 1]})
    recording = tv.replay(path)
    assert recording.verify().kind == "intact" and len(recording.curves["residual"][1]) == 3
    for i, name in enumerate(names):
        frames, values = recording.curves[name]
        assert frames.tolist() == [2, 4, 6] and (values - i).tolist() == [2, 4, 6]
    frames, up = recording.quantities["up [m]"]
    np.testing.assert_allclose(up, [recording.position(k)[:, 1] for k in frames], rtol=1e-6)
    drawn = unpacked(column(path, "world/scene/particles", "Points2D:colors")[-1])
    assert (drawn == ramp(up[-1], (0.0, 0.2))).all()
    ways = column(path, "world/scene/velocities", "Arrows2D:vectors")[-1]  # of a twentieth of a second
    np.testing.assert_allclose(ways, 0.05 * np.stack([0 * SPEED, SPEED], axis=1), rtol=1e-6)
    recording.export(tmp_path / "a.NPZ")
    with np.load(tmp_path / "a.NPZ") as arrays:
        assert {f"{name} value" for name in (*names, "up [m]")} <= {*arrays.files}
    wrong = [("is no name of a quantity", {name: 1.0}) for name in ("", "/x", "x/", "a//b", "../x", "a\\b", "a\nb")]
    wrong += [("energy is the name of a curve", {"energy": 1.0}), ("heat has the shape", {"heat": "hot"})]
    with tv.Recorder(tmp_path / "b.rrd", w) as recorder:
        for words, given in [*wrong, (r"heat has the shape \(2,\)", {"heat": [1.0, 2.0]})]:
            with pytest.raises(ValueError, match=words):
                recorder.log(**given)
        recorder.log()


@pytest.mark.filterwarnings("ignore:Distance. pairs.3. = .3, 0. is off by 0.16:UserWarning")
def test_links_and_bodies_show_their_worst_strain_unless_it_is_left_out(tmp_path):
    # One rod of a square is a tenth too long: the body is red. As it is one body, its diagonal is not drawn as a line. A soft
    # link of twice its length is red, or neutral without strain.
    x = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [5, 0], [7, 0]])
    rods = tv.Distance([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2]], [1, 1, 1, 1 / 1.2, 2**0.5])
    features = [rods, tv.Polygons([[0, 1, 2, 3]]), tv.Distance([[4, 5]], 1.0, compliance=1.0)]
    with tv.World(tv.Particles(x, pinned=np.arange(5)), features) as w:
        for strain, hue in ((True, [255, 92, 48]), (False, [170, 172, 182])):
            path = tmp_path / f"{strain}.rrd"
            tv.Recorder(path, w, strain=strain).close()
            assert tv.replay(path).verify()
            assert unpacked(column(path, "world/scene/particles", "LineStrips2D:colors")[-1]).tolist() == [hue]
            assert len(column(path, "world/scene/particles", "LineStrips2D:strips")[-1]) == 1
            assert bool(column(path, "legend/strain/scale", "LineStrips2D:strips")) == strain
            body, *rest = unpacked(column(path, "world/scene/fill", "LineStrips2D:colors")[-1]).tolist()
            assert (body == [255, 92, 48]) == strain and len(rest) == 2


@pytest.mark.filterwarnings("ignore:.*no constraint holds loops")
def test_bodies_are_filled_and_rounded_by_their_radius_in_recordings_films_notebooks_and_on_the_page():
    # A box of corners with a radius of 0.1 m that stands on a floor: the floor shows nowhere below it, and nothing is farther
    # than 0.1 m from the outline of its corners.
    x = np.array([[0.0, 0.1], [2, 0.1], [2, 1.1], [0, 1.1]])
    w = tv.World(tv.Particles(x, radius=0.1), [tv.Polygons([np.arange(4)])])
    spread = np.random.default_rng(0).uniform((-0.3, -0.2), (2.3, 1.4), (4000, 2))
    away, found = outside(spread, x), parts(*describe(w))
    fill = Fill(outlines(w), x, np.zeros(0, dtype=np.int64), rims(w))
    points, ends = fill.strips(x)
    strips = [points[a:b] for a, b in pairwise(ends)]
    drawn = np.min([outside(spread, x, closed=False) - r for x, r in zip(strips, fill.radii, strict=True)], axis=0) <= 0
    assert drawn[(away < 0.0999) & (np.abs(away) < 0.3)].all() and not drawn[away > 0.1001].any()
    shape = geometry(found)
    view = View(np.array([-0.3, -0.2]), np.array([2.3, 1.4]), np.array([0.0, 1]), Look())
    film = np.asarray(Sketch(found, shape, view, (spread.min(axis=0), spread.max(axis=0))).frame(x, shape))
    column, row = np.floor(view.place(spread)[0].T / FINE).astype(int)
    lit = (film[row, column] == shape.hues[0]).all(axis=1)
    pixel = FINE / view.scale  # [m]
    assert lit[away < 0.1 - 2 * pixel].all() and not lit[away > 0.1 + 2 * pixel].any()
    message = json.loads(scene(w, "", (x[0], x[2])))
    assert message["edges"] == [[0, 1], [1, 2], [2, 3], [3, 0]] and message["edge_radius"] == pytest.approx([0.1] * 4)


def test_a_view_frames_the_whole_run(tmp_path):
    # A ball is thrown: only its path determines the view.
    w = tv.World(tv.Particles([[0.0, 0.0]], velocity=(3.0, 4.0), radius=0.1), [tv.Gravity(9.81)], precision="f64")
    w.run(1.0, recorder=tmp_path / "a.rrd")
    assert tv.replay(tmp_path / "a.rrd").verify()
    chunks = [messages.rows_of(m) for kind, m in messages.split((tmp_path / "a.rrd").read_bytes()) if kind == messages.CHUNK]
    name = f"/view/{SCENE_VIEW}/VisualBounds2D".encode()
    (bounds,) = (rows for rows in chunks if rows.schema.metadata[b"rerun:entity_path"] == name)
    ((value,),) = bounds.column("VisualBounds2D:range").to_pylist()
    edge = 0.05 * 3.2  # 5 % of the longer side: 3 m and two radii
    np.testing.assert_allclose(value["x_range"], [-0.1 - edge, 3.1 + edge], rtol=1e-6)
    top, bottom = 4.0**2 / 2 / 9.81, 4.0 - 9.81 / 2
    np.testing.assert_allclose(value["y_range"], [-top - 0.1 - edge, -bottom + 0.1 + edge], atol=2e-3)


@pytest.mark.parametrize("size, times", [(2e-2, 1), (3e-6, 1e6), (5e6, 1e-6)])
def test_small_and_large_scenes_are_shown_at_another_size(tmp_path, size, times):
    assert unit(np.zeros(2), np.array([size, size / 2])) == pytest.approx(times)
    tv.World(tv.Particles([[0.0, 0, 0], [size, 0, 0]]), []).run(FRAME, recorder=tmp_path / "a.rrd")
    scales = column(tmp_path / "a.rrd", "world/scene", "Transform3D:scale")
    assert scales == ([] if times == 1 else [[pytest.approx([times] * 3)]])
    recording = tv.replay(tmp_path / "a.rrd")
    assert recording.verify() and (recording.position(1)[1] == np.float32([size, 0, 0])).all()


@pytest.mark.slow
def test_y_points_down_where_the_view_is_asked_for_it(tmp_path):
    # A disc below another one in coordinates of pixels: lower in the picture where y points down. The physics is the same.
    hashes, path = [], tmp_path / "run.rrd"
    for down in (False, True):
        w = tv.World(tv.Particles([[100.0, 50], [100, 250]], radius=20), [tv.Gravity((0, 981)), tv.Box((0, 0), (200, 300))])
        with tv.Recorder(path, w, overwrite=True, y_down=down) as recorder:
            w.run(0.1, recorder=recorder)
        recording = tv.replay(path)
        assert recording.verify() and read(path, "world/scene", "Transform3D:scale")[None] == [[1, 1 if down else -1, 1]]
        hashes.append(w.hash())
        with Image.open(recording.export(tmp_path / "run.gif")[0]) as image:
            pixels = np.asarray(image.convert("RGB")).astype(int)
        rows = [np.argwhere((np.abs(pixels - hue) < 12).all(axis=2))[:, 0].mean() for hue in PALETTE[:2].astype(int)]
        assert (rows[0] < rows[1]) == down
        view = scene_view(np.zeros(2), np.array([200.0, 300]), view_up(w, down))
        ends = view.properties["VisualBounds2D"].range.as_arrow_array().to_pylist()[0]
        assert ends["y_range"] == ([-15, 315] if down else [-315, 15])
        assert json.loads(scene(w, "", (np.zeros(2), np.ones(2)), down))["up"] == [0, -1 if down else 1]
    assert hashes[0] == hashes[1]
    with pytest.raises(ValueError, match="y_down is for worlds in 2D"):
        tv.Recorder(tmp_path / "high.rrd", tv.World(tv.Particles([[0.0, 0, 0]])), y_down=True)


@pytest.mark.slow
def test_a_recording_is_watched_while_it_is_made_and_goes_on_without_its_viewer(tmp_path, monkeypatch, capsys):
    opened, w = [], rising()
    monkeypatch.setattr(viewer.webbrowser, "open", opened.append)
    with tv.Recorder(tmp_path / "a.rrd", w, live="web") as recorder:
        w.run(0.2, recorder=recorder)
        recorder.flush()
        (url,) = opened
        assert url in capsys.readouterr().out and url.startswith("http://127.0.0.1:")
        assert b"rerun" in urllib.request.urlopen(url, timeout=20).read().lower()
    assert tv.replay(tmp_path / "a.rrd").verify()
    port = viewer.free_port()
    with viewer.scratch() as folder:
        words = ("--serve-web", "--port", str(port), "--web-viewer-port", str(viewer.free_port()))
        process = viewer.launch(folder, *words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        viewer._wait_for_port(process, port)
        with tv.Recorder(tmp_path / "b.rrd", w, live=f"rerun+http://127.0.0.1:{port}/proxy") as recorder:
            for k in range(3):
                w.run(0.1, recorder=recorder)
                recorder.flush()
                if k == 0:
                    viewer.stop(process)
    recording = tv.replay(tmp_path / "b.rrd")
    assert recording.verify() and recording.frames[-1] == 18
    monkeypatch.setattr(viewer, "launch", lambda *words, **options: subprocess.Popen(["false"], start_new_session=True))
    with pytest.raises(RuntimeError, match='without them use live="web"'):
        viewer.address(True)


def drawn(html) -> np.ndarray:
    """Return the pixels of the picture of a world in a notebook."""
    data = base64.b64decode(html.partition("base64,")[2].partition("'")[0])
    return np.asarray(Image.open(io.BytesIO(data)))


@pytest.mark.slow
def test_notebooks_show_worlds_reports_features_and_recordings(tmp_path):
    w = stack()
    report = w.run(0.1, recorder=tmp_path / "a.rrd")
    html = w._repr_html_()
    pixels = drawn(html)
    view = View(np.array([-0.1, 0.0]), np.array([0.1, 2.0]), np.array([0.0, 1]), Look((SIZE, None)))
    column, row = np.floor(view.place(w.position)[0].T / FINE).astype(int)
    assert pixels.shape[:2] == view.size[::-1] and (pixels[row, column] == by_body(w)).all()
    assert "explain()" in html and "neighbour list" in html
    assert "residual" in report._repr_html_() and "(-0.1, 0.0)" in w.features[2]._repr_html_()
    assert "7" in tv.replay(tmp_path / "a.rrd")._repr_html_()
    w.close()
    assert w._repr_html_() == f"<code>{w!r}</code>"
    solid = tv.World(tv.Particles([[0.0, 0, 0], [1, 0, 0]], radius=0.1), [tv.HalfSpace((0, 1, 0)), tv.Gravity()])
    assert {*map(tuple, by_body(solid).tolist())} <= {*map(tuple, drawn(solid._repr_html_()).reshape(-1, 3).tolist())}


X = np.array([[0.0, 0], [1, 0], [2, 0], [3, 0], [3.5, 0]])
SPEED = np.array([0.0, 1.0, 2.0, 1.0, 1.0])
GIVEN = np.array([[10, 20, 30], [250, 128, 0], [0, 0, 255], [255, 255, 255], [155, 55, 5]])
LOW, MIDDLE, HIGH = [68, 1, 84], [33, 145, 140], [253, 231, 37]  # viridis
BY_SPEED = np.array([LOW, MIDDLE, HIGH, MIDDLE, MIDDLE])


def upwards(world: tv.World) -> np.ndarray:
    """A quantity of the user's: speeds upwards."""
    return world.velocity[:, 1]


def rising() -> tv.World:
    """Return a world in which particles rise at constant speeds; the last two are linked."""
    particles = tv.Particles(X, velocity=np.stack([0 * SPEED, SPEED], axis=1), radius=0.1)
    return tv.World(particles, [tv.Distance([[3, 4]])], precision="f64", substeps=1)


CHOICES = {
    "integers": (GIVEN, GIVEN),
    "floats": (GIVEN / 255, GIVEN),
    "a quantity and its range": (("speed", 0, 2), BY_SPEED),
    "a quantity": ("speed", BY_SPEED),
    "a function": (upwards, BY_SPEED),
    "a function and its range": ([upwards, 0, 2.0], BY_SPEED),
}


def recorded(path, color) -> tv.recording.Replay:
    with rising() as w, tv.Recorder(path, w, color=color) as recorder:
        w.run(2 * FRAME, recorder=recorder)
    return tv.replay(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["floats", "a function and its range"])
def test_recordings_exports_pages_and_many_worlds_have_the_colours_that_were_chosen(name, tmp_path):
    color, wanted = CHOICES[name]
    recording, fixed = recorded(tmp_path / "a.rrd", color), isinstance(color, np.ndarray)
    drawn = column(tmp_path / "a.rrd", "world/scene/particles", "Points2D:colors")
    assert [unpacked(row).tolist() for row in drawn] == [wanted.tolist()] * (1 if fixed else 3)  # static, or in each frame
    (line,) = {tuple(row) for row in column(tmp_path / "a.rrd", "world/scene/particles", "LineStrips2D:colors")}
    assert unpacked(line).tolist() == [np.rint(wanted[3:].mean(axis=0)).tolist()]
    assert recording.verify()
    if not fixed:
        frames, speed = recording.quantities["upwards()"]
        assert frames.tolist() == [0, 1, 2] and speed == pytest.approx(np.tile(SPEED, (3, 1)))
    assert_exports(recording, tmp_path, {}, wanted)
    # Exports may have others than the recording; a quantity that is not in it is computed again.
    assert_exports(recorded(tmp_path / "b.rrd", None), tmp_path, {"color": color}, wanted)
    said: list = []
    page = SimpleNamespace(waiting=0, known={}, send=said.append)
    with rising() as w:
        live = Session(w, SimpleNamespace(viewers=[page], received=queue.Queue()), color=color)  # type: ignore[arg-type]
        for _ in range(2):
            live.advance()
        live.close()
    first, *_ = (message for message in map(json.loads, (m for m in said if isinstance(m, str))) if message["kind"] == "scene")
    assert np.reshape(first["color"], (-1, 3)).tolist() == wanted.tolist()
    for frame in (m for m in said if isinstance(m, bytes)):
        (length,) = struct.unpack("<I", frame[:4])
        rest = frame[4 + length + 4 * 2 * 5 :]
        assert np.frombuffer(rest, np.uint8).tolist() == ([] if fixed else wanted.ravel().tolist())
    with tv.Worlds(rising(), 2) as many, tv.WorldsRecorder(tmp_path / "many.rrd", many, color=color) as recorder:
        many.step(FRAME)
        recorder.log()
    for k in range(2):
        drawn = read(tmp_path / "many.rrd", f"worlds/{k}/world/scene/particles", "Points2D:colors")
        assert {tuple(map(tuple, unpacked(row).tolist())) for row in drawn.values() if row} == {(*map(tuple, wanted.tolist()),)}


def assert_exports(recording, folder, choice, wanted):
    """Check the colours of discs in a film, and of particles in .glb, .vtu and .usda files."""
    recording.export(folder / "a.gif", size=(960, 480), **choice)
    with Image.open(folder / "a.gif") as film:
        pixels = np.asarray(film.convert("RGB")).astype(int)
    found = [np.abs(pixels - hue).max(axis=2) <= 3 for hue in wanted]
    across = [float(np.nonzero(some)[1].mean()) for some in found]
    if len({*map(tuple, wanted.tolist())}) == 5:  # each disc is where it belongs, and has its colour
        np.testing.assert_allclose(np.polyval(np.polyfit(X[:, 0], across, 1), X[:, 0]), across, atol=4)
    assert all(some.sum() > 500 for some in found)
    recording.export(folder / "a.glb", **choice)
    text, blob = parsed(folder / "a.glb")
    nodes = {node["name"]: text["meshes"][node["mesh"]]["primitives"][0] for node in text["nodes"] if "mesh" in node}
    for i, hue in enumerate(wanted):
        factor = text["materials"][nodes[f"particle {i}"]["material"]]["pbrMetallicRoughness"]["baseColorFactor"]
        np.testing.assert_allclose(factor, [*linear(hue), 1.0], rtol=1e-6)
    ends = values(text, blob, nodes["links"]["attributes"]["COLOR_0"])[:, :3]
    assert ends.tolist() == np.rint(255 * linear(wanted[3:])).tolist()
    recording.export(folder / "a.pvd", **choice)
    for k in range(3):
        assert meshio.read(folder / f"a_{k:04d}.vtu").point_data["color"].tolist() == wanted.tolist()
    if find_spec("pxr"):
        from pxr import Usd, UsdGeom

        recording.export(folder / "a.usda", **choice)
        stage = Usd.Stage.Open(str(folder / "a.usda"))
        for name, of in (("particles", wanted), ("links", wanted[3:])):
            shown = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(f"/scene/part_0/{name}")).GetPrimvar("displayColor")
            for code in (0, 1, 2):
                np.testing.assert_allclose(np.array(shown.Get(code)), linear(of), atol=1e-6)


def test_colours_of_quantities():
    with rising() as w:
        for color, wanted in CHOICES.values():
            assert Coloring.checked("", color, 5).colors(w).tolist() == wanted.tolist()
        # Without a range each frame has its own, and what is not finite is grey.
        shown = Coloring.checked("", lambda w: np.array([3.0, 4, 5, np.nan, np.inf]), 5).colors(w)
        assert shown.tolist() == [LOW, MIDDLE, HIGH, [128] * 3, [128] * 3]
        assert Coloring.checked("", lambda w: np.full(5, 7), 5).colors(w).tolist() == [LOW] * 5
        assert Coloring.checked("", None, 5).colors(w).tolist() == by_body(w).tolist()
    assert ramp(np.array([-1.0, 0, 1, 2]), (0, 1)).tolist() == [LOW, LOW, HIGH, HIGH]
    np.testing.assert_allclose(ramp(np.array([0.625]), (0, 1)), [[64, 173, 119]], atol=1)  # between the third and the fourth
    particles = tv.Particles(
        [[0.0, 0.0], [9.0, 0.0]], mass=[2, 3], radius=0.1, spin=[0, -4.0], group=[1, 2], velocity=[(0, 0), (3, 4)]
    )
    with tv.World(particles) as w:
        found = {name: Coloring.checked("", name, 2).values(w).tolist() for name in QUANTITIES}
    radius = found.pop("radius")
    assert radius == pytest.approx([0.1] * 2)
    assert found == {"speed": [0, 5], "spin": [0, 4], "load": [0, 0], "mass": [2, 3], "group": [1, 2]}


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
    with rising() as w, pytest.raises(kind, match=text):
        Coloring.checked("play", color, 5).colors(w)


def test_a_recorder_needs_the_quantity_that_it_shows(tmp_path):
    with rising() as w:
        with pytest.warns(UserWarning, match="'speeed' has to be given to each log.*; did you mean 'speed'"):
            tv.Recorder(tmp_path / "c.rrd", w, color="speeed")._closing()
        with tv.Recorder(tmp_path / "a.rrd", w, color=("heat", 0, 1)) as recorder:
            with pytest.raises(ValueError, match=r"'heat' is neither one of speed, .* Write recorder.log\(\*\*{'heat': ...}"):
                recorder.log(heat=3.0)
            recorder.log(heat=[0.0, 0.5, 1, 0.5, 0.5])
        for color, name in (("speed", "speed"), (upwards, "upwards()")):
            with tv.Recorder(tmp_path / "b.rrd", w, color=color, overwrite=True) as recorder:
                with pytest.raises(ValueError, match="is computed for the colours of the picture; choose another name"):
                    recorder.log(**{name: SPEED})
                recorder.log()
    recording = tv.replay(tmp_path / "a.rrd")
    assert recording.verify()
    for choice in ({}, {"color": ("heat", 0, 1)}):  # grey before it was logged
        recording.export(tmp_path / "h.pvd", **choice)
        shown = [meshio.read(tmp_path / f"h_{k:04d}.vtu").point_data["color"].tolist() for k in range(2)]
        assert shown == [[[128] * 3] * 5, BY_SPEED.tolist()]
    with pytest.raises(ValueError, match="color = 'cold' is no quantity here; there are speed, .*, heat"):
        recording.export(tmp_path / "h.pvd", color="cold")
    with pytest.raises(ValueError, match="a.csv takes no color; .gif, .glb"):
        recording.export(tmp_path / "a.csv", color="speed")


def test_given_colours_end_where_particles_are_exchanged_and_quantities_follow(tmp_path):
    paths = tmp_path / "a.rrd", tmp_path / "b.rrd"
    with (
        rising() as w,
        tv.Recorder(paths[0], w, color=GIVEN) as given,
        tv.Recorder(paths[1], w, color=("speed", 0, 2)) as follows,
    ):
        w.add(features=[tv.Gravity(0.0)])  # the particles are the same
        given.log()
        follows.log()
        w.add(tv.Particles([[4.0, 0.0]], velocity=(0.0, 2.0), radius=0.1))
        w.remove([0])
        with pytest.raises(
            ValueError, match="5 particles, and since then particles were added or removed.*function of the world"
        ):
            given.log()
        follows.log()
    assert all(tv.replay(path).verify() for path in paths)
    last = column(paths[1], "world/scene/scene3/particles", "Points2D:colors")[-1]
    assert unpacked(last).tolist() == [*BY_SPEED[1:].tolist(), HIGH]


def test_commands_take_colours(tmp_path, capsys):
    recording, out = recorded(tmp_path / "a.rrd", None), str(tmp_path / "a.pvd")
    assert main(["replay", recording.path, "--export", out, "--color", "speed,0,2"]) == 0
    assert b'Name="color"' in (tmp_path / "a_0000.vtu").read_bytes()
    assert main(["replay", recording.path, "--export", out, "--color", "heat"]) == 2
    assert "there are speed, spin" in capsys.readouterr().err
    (tmp_path / "rise.py").write_text("from tests.test_pictures import rising\nrising().run(2 / 60)\n")
    assert main(["run", str(tmp_path / "rise.py"), "--out", str(tmp_path / "b.rrd"), "--color", "speed"]) == 0
    drawn = column(tmp_path / "b.rrd", "world/scene/particles", "Points2D:colors")
    assert unpacked(drawn[-1]).tolist() == BY_SPEED.tolist()


def falling(k: int) -> tv.World:
    """Return a world with discs that fall on a moving wall, and with a chain that breaks if k is 2."""
    rope, discs = tv.shapes.rope((5.2, 1.8), (6.0, 1.8), points=6), tv.golden(np.arange(12), dim=2) * (1, 2) + (0, 0.3)
    link = tv.Distance(rope.links, break_at=5.0 if k == 2 else 500.0)
    features = [tv.Gravity(9.81 + k), link, tv.Contact(), tv.Ball((0.5, 0.2), 0.1)]
    start = tv.Particles(np.concatenate([rope.position, discs]), radius=0.08, pinned=[0, 6])
    return tv.World(start, features, substeps=6, solver=tv.Jacobi())


@pytest.mark.slow
def test_each_view_of_many_worlds_is_the_picture_of_that_world(tmp_path):
    overlays, chosen, path = {"forces": True, "velocities": True}, [2, 0, 3], tmp_path / "many.rrd"
    alone = [falling(k) for k in range(4)]

    def record(w, recorder):
        for i in range(20):
            w.features[3].center = (0.51 + 0.01 * i, 0.2)
            w.step(FRAME)
            recorder.log()

    with tv.Worlds([falling(k) for k in range(4)]) as many, tv.WorldsRecorder(path, many, chosen, **overlays) as recorder:
        record(many, recorder)
        assert recorder.frames == 21
    # Only parts that are not drawn to the size of the scene are compared.
    parts, found = ["particles", "breaks", "contacts", "velocities", "walls/3"], set()
    names = ["Points2D:positions", "Points2D:colors", "LineStrips2D:strips", "LineStrips2D:colors", "Arrows2D:vectors"]
    for k in chosen:
        with tv.Recorder(tmp_path / f"{k}.rrd", alone[k], **overlays) as recorder:
            record(alone[k], recorder)
        for part in parts:
            for name in names:
                wanted = read(tmp_path / f"{k}.rrd", f"world/scene/{part}", name)
                assert read(path, f"worlds/{k}/world/scene/{part}", name) == wanted, (k, part, name)
                found |= {part} if wanted else set()
    assert found == {*parts}


def test_recordings_of_many_worlds_go_on_after_a_reset_and_refuse_what_they_cannot_show(tmp_path):
    path, w = tmp_path / "a.rrd", rising()
    with tv.Worlds(w, 3) as many:
        for chosen, words in (([], "1 to 64 numbers, each once"), ([1, 1], "each once"), ([0, 3], r"\[1\] = 3, but .* 3 worlds")):
            with pytest.raises(ValueError, match=words):
                tv.WorldsRecorder(path, many, chosen)
        for make, words in (
            (lambda: tv.WorldsRecorder(path, w), "one World is for tv.Recorder"),  # type: ignore[arg-type]
            (lambda: tv.Recorder(path, many), "tv.WorldsRecorder"),  # type: ignore[arg-type]
        ):
            with pytest.raises(TypeError, match=words):
                make()
        with pytest.raises(ValueError, match="does not exist"):
            tv.WorldsRecorder(tmp_path / "no" / "a.rrd", many)
        assert not path.exists()
        tv.WorldsRecorder(path, many, [2, 0]).close()
        with pytest.raises(FileExistsError):
            tv.WorldsRecorder(path, many)
        with pytest.raises(ValueError, match="shows worlds 0, 2 side by side, and holds no state"):
            tv.replay(path)
        with tv.WorldsRecorder(path, many, every=2, overwrite=True) as recorder:
            for frame in range(8):
                if frame == 4:
                    many.reset()
                many.step(0.1)
                recorder.log()
        assert (recorder.chosen, recorder.frames) == ([0, 1, 2], 5)
        recorder.close()
        with pytest.raises(RuntimeError, match="closed"):
            recorder.log()
    times = read(path, "worlds/1/world/scene/particles", "time")
    assert sorted(times) == [0, 2, 4, 6, 8]
    np.testing.assert_allclose([times[k].total_seconds() for k in sorted(times)], [0, 0.2, 0.4, 0.6, 0.8])
