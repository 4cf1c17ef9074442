"""Recordings: the file holds what the world was."""

import gc
import os
import warnings
from itertools import pairwise

import numpy as np
import pytest
import rerun as rr

import tiverlet as tv
from tiverlet.recording import messages
from tiverlet.recording.hues import PALETTE, by_body
from tiverlet.recording.lines import Lines, cells, trails
from tiverlet.recording.strain import LEVELS, LONGER, SCALE, SHORTER, levels
from tiverlet.recording.surfaces import DARKEST, Surface, triangles

pytestmark = pytest.mark.usefixtures("read_here")


def read(path, entity: str, column: str):
    """Return all rows of a column of an entity, by frame (None for static data)."""
    out = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rerun expects a footer, which would take 90 kB
        reader = rr.chunk.RrdReader(str(path))
    for chunk in reader.stream():
        if chunk.entity_path != entity:
            continue
        batch = chunk.to_record_batch()
        if column not in batch.schema.names:
            continue
        values = batch.column(column)
        frames = [None] * len(values) if chunk.is_static else batch.column("frame").to_numpy(zero_copy_only=False)
        for frame, row in zip(frames, values.to_pylist(), strict=True):
            out[frame] = row
    return out


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_every_frame_reads_back(world, tmp_path, dim):
    x = tv.golden(np.arange(30), dim=dim) * 0.9 + 0.05
    links = np.stack([np.arange(29), np.arange(1, 30)], axis=1)
    box = tv.Box([0] * dim, [1] * dim)
    start = tv.Particles(x, radius=np.r_[0.0, np.full(29, 0.02)], pinned=[0])
    w = world(start, [tv.Gravity(9.81), tv.Distance(links), box], solver=tv.Jacobi())
    path = tmp_path / "a.rrd"
    seen = [w.position]
    reports = []
    with tv.Recorder(path, w) as recorder:
        for _ in range(12):
            reports.append(w.step(1 / 60))
            recorder.log()
            seen.append(w.position)
    kind = f"{dim}D"
    frames = read(path, "/world/scene/particles", f"Points{kind}:positions")
    assert sorted(frames) == list(range(13))
    for k, position in enumerate(seen):
        np.testing.assert_array_equal(np.array(frames[k], dtype=np.float32), position.astype(np.float32))
    strips = read(path, "/world/scene/particles", f"LineStrips{kind}:strips")
    hues = read(path, "/world/scene/particles", f"LineStrips{kind}:colors")
    for k, position in enumerate(seen):
        x = position.astype(np.float32)
        drawn = [(a, b, hue) for strip, hue in zip(strips[k], hues[k], strict=True) for a, b in pairwise(strip)]
        np.testing.assert_array_equal(np.array([d[:2] for d in drawn], np.float32), x[links])  # in order, as a rope
        strain = np.linalg.norm(np.diff(position[links], axis=1)[:, 0], axis=1) / w.features[1].rest - 1
        assert [d[2] for d in drawn] == SCALE[levels(strain)].tolist()
    radii = read(path, "/world/scene/particles", f"Points{kind}:radii")
    assert list(radii) == [None] and radii[None][0] < 0 and radii[None][1] == np.float32(0.02)
    assert len(strips[12]) < 29 or len(set(hues[12])) > 1  # neighbouring links of one colour are one strip
    hues = np.array(read(path, "/world/scene/particles", f"Points{kind}:colors")[None], dtype=np.uint32) >> 8  # RGBA
    red, green, blue = PALETTE[0].tolist()  # a rope is one body
    assert (hues[1:] == red << 16 | green << 8 | blue).all() and hues[0] == 140 << 16 | 140 << 8 | 150
    for end, names in {"energy": ["energy"], "violation": ["residual", "overlap"], "substeps": ["substeps"]}.items():
        curve = read(path, f"/figures/{end}", "Scalars:scalars")
        assert [curve[k + 1] for k in range(12)] == [[getattr(report, name) for name in names] for report in reports]
    curve = read(path, "/figures/milliseconds", "Scalars:scalars")  # the first frame compiles
    assert [curve[k + 1][0] for k in range(1, 12)] == pytest.approx([report.seconds * 1e3 for report in reports[1:]], rel=5e-3)
    # y is up. The 2D views of rerun have y down, so a mirror above the data turns it; in 3D the view coordinates name it.
    if dim == 2:
        assert read(path, "/world/scene", "Transform3D:scale")[None] == [[1, -1, 1]]
    else:
        assert read(path, "/world/scene", "ViewCoordinates:xyz")[None] == [[3, 1, 6]]  # right, up, back
    with pytest.warns(rr.error_utils.RerunWarning, match="no footer"):
        assert len(rr.chunk.RrdReader(str(path)).blueprints()) == 1
    about = read(path, "/about", "TextDocument:text")[None][0]
    assert "13 frames, 0.2 s simulated" in about and "constraint violation" in about
    assert set(read(path, "/world/scene/walls/2", f"LineStrips{kind}:strips")) == {0}  # a wall that does not move is written once


def test_every_and_misuse(world, tmp_path):
    w = world(tv.Particles([[0.0, 0.0]]), [tv.Gravity(1.0)])
    with tv.Recorder(tmp_path / "b.rrd", w, every=3) as recorder:
        w.run(10 / 60, recorder=recorder)
    assert sorted(read(tmp_path / "b.rrd", "/world/scene/particles", "Points2D:positions")) == [0, 3, 6, 9]
    with pytest.raises(RuntimeError, match="closed"):
        recorder.log()
    recorder.close()
    with pytest.raises(ValueError, match="does not exist"):
        tv.Recorder(tmp_path / "no" / "c.rrd", w)
    with pytest.raises(ValueError, match="every = 0"):
        tv.Recorder(tmp_path / "c.rrd", w, every=0)


def test_a_path_is_recorded_to_and_a_recorder_that_logs_nothing_says_so(world, tmp_path):
    w = world(tv.Particles([[0.0, 0]]), [tv.Gravity()])
    with pytest.warns(UserWarning, match=r"log\(\) was never called"), tv.Recorder(tmp_path / "a.rrd", w):
        w.run(0.1)
    w.run(0.1, recorder=tmp_path / "b.rrd")
    assert len(tv.replay(tmp_path / "b.rrd").frames) == 7 and tv.replay(tmp_path / "b.rrd").world(6).hash() == w.hash()


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted on Linux")
def test_threads_of_a_closed_recorder_end(world, tmp_path):
    # rerun keeps two threads for each stream, of which a file has three. Those of a recorder end when the next one closes.
    w, before = world(tv.Particles([(0.0, 0.0)]), [tv.Gravity()]), 0
    for k in range(4):
        with tv.Recorder(tmp_path / f"{k}.rrd", w) as recorder:
            w.step(1 / 60)
            recorder.log()
        del recorder
        gc.collect()
        before = before or len(os.listdir("/proc/self/task"))
    assert len(os.listdir("/proc/self/task")) <= before


@pytest.mark.parametrize("count, links", [(2, 1), (7, 12), (40, 200)])
def test_each_link_is_in_one_strip(count, links):
    rng = np.random.default_rng(count)
    pairs = np.stack([rng.integers(0, count, links), rng.integers(0, count, links)], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]  # some pairs occur twice
    particles, link = trails(pairs)
    assert sorted(link[link >= 0].tolist()) == list(range(len(pairs))) and link[-1] == -1
    for k in np.flatnonzero(link >= 0):
        assert sorted(particles[k : k + 2]) == sorted(pairs[link[k]])
    shades = np.append(SCALE.astype(np.int64)[:3], -1)[rng.integers(-1, 3, len(pairs))]
    at, ends, hues = Lines(pairs).strips(shades)
    drawn = [(*sorted(p), h) for a, b, h in zip(ends, ends[1:], hues, strict=False) for p in pairwise(at[a:b].tolist())]
    assert sorted(drawn) == sorted((*sorted(p), v) for p, v in zip(pairs.tolist(), shades, strict=True) if v >= 0)


def test_a_rope_is_one_strip_and_a_sheet_is_one_mesh(world):
    rope = tv.shapes.rope((0, 0), (1, 0), 40)
    particles, link = trails(rope.links)
    assert particles.tolist() == list(range(40)) and link.tolist() == [*range(39), -1]

    sheet = tv.shapes.cloth((0, 0, 0), (1, 0, 0), (0, 0, 1), (6, 5))
    pairs = np.concatenate([sheet.links, sheet.braces])
    assert cells(pairs, sheet.position)[0].all()  # threads, diagonals, and braces over two threads
    w = world(tv.Particles(sheet.position), [tv.Distance(pairs)])
    faces = triangles(w)
    corners = sheet.position[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert len(area) == 2 * 5 * 4 and area.sum() == pytest.approx(1.0)  # no cell is missing or doubled
    # The colour of the body, in light by |n . l|; where links are strained, red or blue by the worst of them.
    up, body = np.array([0.0, 1.0, 0.0]), np.array([200.0, 100.0, 40.0])
    mesh, level = Surface(faces, np.tile(body, (30, 1)), pairs, up), np.full(len(pairs), LEVELS)
    level[0], level[1] = 2 * LEVELS, 0

    def rgb(x):
        words = mesh.colors(x, level)
        assert (words & 255 == 255).all()
        return np.stack([words >> 24, words >> 16 & 255, words >> 8 & 255], axis=1).astype(float)

    light = np.array([0.45, 1.35, 0.82])
    for x, n in ((sheet.position, up), (sheet.position[:, [1, 0, 2]], up[[1, 0, 2]])):
        shade = DARKEST + (1 - DARKEST) * abs(n @ light) / np.linalg.norm(light)
        seen = rgb(x)
        np.testing.assert_allclose(seen[-1], body * shade, atol=0.5 + 200 / 30)  # one of 15 shades
        np.testing.assert_allclose(seen[pairs[0]], np.tile(LONGER * shade, (2, 1)), atol=0.5 + 255 / 30)
        assert pairs[1][0] in pairs[0] or np.allclose(seen[pairs[1][0]], SHORTER * shade, atol=0.5 + 255 / 30)

    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=float)
    used, four = cells(np.stack(np.triu_indices(4, 1), axis=1), tetrahedron)
    assert not len(four) and not used.any()  # six links, but not flat


@pytest.mark.slow
def test_bytes_of_positions_take_most_of_the_file(world, tmp_path):
    # Positions take n * dim * 4 bytes of a frame; lines, meshes and colours 0.4 of that; a message of rows 1.5 kB, a row 100.
    rng = np.random.default_rng(1)
    sheet = tv.shapes.cloth((0, 1, 0), (1, 0, 0), (0, 0, 1), (16, 16))
    cloth = tv.Particles(sheet.position, velocity=rng.normal(0, 0.1, (256, 3)))
    features = [tv.Gravity(1.0), tv.Distance(sheet.links), tv.Distance(sheet.braces, compliance=1e-2)]
    w, path = world(cloth, features, substeps=2, solver=tv.Jacobi()), tmp_path / "a.rrd"
    with tv.Recorder(path, w) as recorder:
        w.run(2.0, recorder=recorder)
    of = [message for kind, message in messages.split(path.read_bytes()) if kind == messages.CHUNK]
    of = [m for m in of if messages.Chunk(m).rows().schema.metadata[b"rerun:entity_path"] == b"/world/scene/particles"]
    raw = 121 * 256 * 3 * 4
    assert raw < sum(map(len, of)) < 1.4 * raw + 1500 * len(of) + 100 * 121


@pytest.mark.slow
def test_a_small_recording_takes_little_beside_its_positions(world, tmp_path):
    # 40 points in 2D: 320 bytes of f32 in a frame. Everything else (layout, curves, hashes) takes at most 1.5 times as much.
    rope = tv.shapes.rope((0, 2), (1, 2), points=40)
    links = [tv.Gravity(9.81), tv.Distance(rope.links), tv.Box((-2, 0), (2, 3))]
    w = world(tv.Particles(rope.position, mass=0.01, radius=0.01, pinned=[0]), links, substeps=32)
    with tv.Recorder(tmp_path / "rope.rrd", w) as recording:
        w.run(5.0, recorder=recording)
    assert (tmp_path / "rope.rrd").stat().st_size <= 2.5 * 300 * 320
    assert tv.replay(tmp_path / "rope.rrd").verify().frames == 301


def test_what_is_too_far_away_for_a_picture_is_recorded(world, tmp_path, read_here):
    # 1e40 m exceeds f32, in which pictures are stored: NumPy issues no warning, and frames are replayed as they were.
    w = world(tv.Particles([(0.0, 0.0), (1.0, 0.0)], velocity=[(1e42, 0.0), (0.0, 0.0)]), precision="f64")
    with tv.Recorder(str(tmp_path / "far.rrd"), w) as recorder:
        assert "out-of-range" in w.step(1 / 60).flags
        recorder.log()
    assert tv.replay(str(tmp_path / "far.rrd")).verify()


def in_lab(rgb) -> np.ndarray:
    """Return colours, (n, 3) of sRGB in 0 ... 255, in CIELAB (D65), where distances are as seen: 2 is just noticeable."""
    c = np.atleast_2d(np.asarray(rgb, dtype=np.float64)) / 255
    c = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    xyz = c @ to_xyz.T / [0.9505, 1.0, 1.089]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)


@pytest.mark.parametrize("points", [5, 8, 21])
def test_neighbouring_bodies_differ_in_colour_wherever_their_particles_begin(points):
    # Six ropes side by side, and bodies in rows of any length: each differs from all eight around it.
    ropes = [tv.shapes.rope((k, 2), (k, 1), points=points) for k in range(6)]
    both, slices = tv.shapes.join(*ropes)
    hues = in_lab(by_body(tv.World(tv.Particles(both.position), [tv.Distance(both.links)]))[[s.start for s in slices]])
    assert np.linalg.norm(np.diff(hues, axis=0), axis=1).min() > 24
    at = np.stack(np.meshgrid(np.arange(points), np.arange(9)), axis=-1).reshape(-1, 2)
    lab = in_lab(by_body(tv.World(tv.Particles(at)))).reshape(9, points, 3)
    for one, two in ((lab[1:], lab[:-1]), (lab[:, 1:], lab[:, :-1]), (lab[1:, 1:], lab[:-1, :-1]), (lab[1:, :-1], lab[:-1, 1:])):
        assert np.linalg.norm(one - two, axis=2).min() > 24


def test_bodies_have_no_colour_of_strain_and_keep_theirs_when_others_are_added():
    strain = in_lab(np.stack([SCALE >> 24, SCALE >> 16 & 255, SCALE >> 8 & 255], axis=1))
    assert np.linalg.norm(in_lab(PALETTE)[:, None] - strain, axis=2).min() > 24
    world = tv.World(tv.Particles(tv.golden(np.arange(40), dim=2)))
    before = by_body(world)
    world.add(tv.Particles([[0.5, 0.5]]))
    np.testing.assert_array_equal(by_body(world)[:40], before)
