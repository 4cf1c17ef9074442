"""Recordings: what is read back is what the world was."""

import warnings

import numpy as np
import pytest
import rerun as rr

import tiverlet as tv


def read(path, entity: str, column: str):
    """All rows of a column of an entity, by frame (None for static data)."""
    out = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rerun asks for a footer, which takes 90 kB
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


@pytest.mark.parametrize("dim", [2, 3])
def test_every_frame_reads_back(world, tmp_path, dim):
    x = tv.golden(np.arange(30), dim=dim) * 0.9 + 0.05
    links = np.stack([np.arange(29), np.arange(1, 30)], axis=1)
    box = tv.Box([0] * dim, [1] * dim)
    features = [tv.Gravity(9.81), tv.Distance(links), tv.Contact(), box, tv.HalfSpace([0, 1, 0][:dim], 0.01)]
    w = world(tv.Particles(x, radius=np.r_[0.0, np.full(29, 0.02)], pinned=[0]), features)
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
    strips = read(path, "/world/scene/links/1", f"LineStrips{kind}:strips")
    for k, position in enumerate(seen):
        np.testing.assert_array_equal(np.array(strips[k], np.float32), position.astype(np.float32)[links])
    radii = read(path, "/world/scene/particles", f"Points{kind}:radii")
    assert list(radii) == [None] and radii[None][0] < 0 and radii[None][1] == np.float32(0.02)
    hues = np.array(read(path, "/world/scene/particles", f"Points{kind}:colors")[None], dtype=np.uint32) >> 8  # RGBA
    red, green, blue = tv.golden_colors(30).astype(np.uint32).T
    np.testing.assert_array_equal(hues[1:], (red << 16 | green << 8 | blue)[1:])
    for name in ("energy", "residual", "overlap", "substeps"):
        curve = read(path, f"/figures/{name}", "Scalars:scalars")
        assert [curve[k + 1][0] for k in range(12)] == [getattr(report, name) for report in reports]
    curve = read(path, "/figures/milliseconds", "Scalars:scalars")  # of the first frame: compiling
    assert [curve[k + 1][0] for k in range(1, 12)] == [report.seconds * 1e3 for report in reports[1:]]
    # y is up: the views of rerun in 2D have it down, and a mirror above the data turns it; in 3D it is said.
    if dim == 2:
        assert read(path, "/world/scene", "Transform3D:scale")[None] == [[1, -1, 1]]
    else:
        assert read(path, "/world/scene", "ViewCoordinates:xyz")[None] == [[3, 1, 6]]  # right, up, back
    with pytest.warns(rr.error_utils.RerunWarning, match="no footer"):
        assert len(rr.chunk.RrdReader(str(path)).blueprints()) == 1
    about = read(path, "/about", "TextDocument:text")[None][0]
    assert "13 frames, 0.2 s simulated" in about and "constraint violation" in about
    assert set(read(path, "/world/scene/walls/3", f"LineStrips{kind}:strips")) == {0}  # a wall that stands is written once


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


def test_an_empty_world_can_be_recorded(world, tmp_path):
    w = world(tv.Particles(np.zeros((0, 2))), [tv.Gravity()])
    with tv.Recorder(tmp_path / "d.rrd", w) as recorder:
        w.run(0.1, recorder=recorder)
    assert len(read(tmp_path / "d.rrd", "/world/scene/particles", "Points2D:positions")) == 7


def test_a_path_is_recorded_to_and_a_recorder_that_logs_nothing_says_so(world, tmp_path):
    w = world(tv.Particles([[0.0, 0]]), [tv.Gravity()])
    with pytest.warns(UserWarning, match=r"log\(\) was never called"), tv.Recorder(tmp_path / "a.rrd", w):
        w.run(0.1)
    w.run(0.1, recorder=tmp_path / "b.rrd")
    assert len(tv.replay(tmp_path / "b.rrd").frames) == 7 and tv.replay(tmp_path / "b.rrd").world(6).hash() == w.hash()
