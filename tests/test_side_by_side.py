"""Many worlds in one recording: each view shows what a recording of that world alone shows."""

import numpy as np
import pytest

import tiverlet as tv

from .test_recorder import read

pytestmark = pytest.mark.usefixtures("read_here")


def scene(k: int) -> tv.World:
    """Return a world with discs that fall past a moving wall, and a chain that breaks if k is 2."""
    n = 12
    discs, chain = tv.golden(np.arange(n), dim=2) * (1, 2) + (0, 0.3), tv.shapes.rope((1.2, 1.8), (2.0, 1.8), points=6)
    x, radius = np.concatenate([discs, chain.position]), np.concatenate([np.full(n, 0.08), np.full(6, 0.02)])
    links = tv.Distance(n + chain.links, break_at=5.0 if k == 2 else 500.0)
    features = [tv.Gravity(9.81 + k), tv.Contact(), tv.HalfSpace((0, 1)), tv.Ball((0.5, 0.2), 0.1), links]
    return tv.World(tv.Particles(x, radius=radius, pinned=[n]), features, substeps=6, solver=tv.Jacobi())  # compiles fastest


@pytest.mark.slow
def test_each_view_is_the_picture_of_that_world(taichi, tmp_path):
    overlays = {"forces": True, "velocities": True}
    alone = [scene(k) for k in range(4)]
    chosen, places = [2, 0, 3], [(0.51 + 0.01 * i, 0.2) for i in range(20)]
    with tv.Worlds([scene(k) for k in range(4)]) as many:
        with tv.WorldsRecorder(tmp_path / "many.rrd", many, chosen, **overlays) as recorder:
            for place in places:
                many.features[3].center = place
                many.step(1 / 60)
                recorder.log()
        assert recorder.frames == 21
    # Only parts that are not drawn to the size of the scene are compared.
    parts = ["particles", "contacts", "breaks", "velocities", "walls/3"]
    columns = ["Points2D:positions", "Points2D:colors", "LineStrips2D:strips", "LineStrips2D:colors", "Arrows2D:vectors"]
    found = set()
    for k in chosen:
        with tv.Recorder(tmp_path / f"{k}.rrd", alone[k], **overlays) as recorder:
            for place in places:
                alone[k].features[3].center = place
                alone[k].step(1 / 60)
                recorder.log()
        for part in parts:
            for column in columns:
                wanted = read(tmp_path / f"{k}.rrd", f"/world/scene/{part}", column)
                got = read(tmp_path / "many.rrd", f"/worlds/{k}/world/scene/{part}", column)
                assert got == wanted, (k, part, column)
                found |= {part} if wanted else set()
    assert found == {*parts}
    for w in alone:
        w.close()


@pytest.mark.slow
def test_time_goes_on_where_worlds_are_reset(taichi, tmp_path):
    with tv.Worlds(scene(0), 3) as many:
        with tv.WorldsRecorder(tmp_path / "a.rrd", many, every=2) as recorder:
            for frame in range(8):
                if frame == 4:
                    many.reset()
                many.step(0.1)
                recorder.log()
        assert (recorder.chosen, recorder.frames) == ([0, 1, 2], 5)
        recorder.close()
        with pytest.raises(RuntimeError, match="closed"):
            recorder.log()
    times = read(tmp_path / "a.rrd", "/worlds/1/world/scene/particles", "time")
    assert sorted(times) == [0, 2, 4, 6, 8]
    np.testing.assert_allclose([times[k].total_seconds() for k in sorted(times)], [0, 0.2, 0.4, 0.6, 0.8])


def test_what_is_refused(taichi, tmp_path):
    world = scene(0)
    with tv.Worlds(world, 3) as many:
        with pytest.raises(TypeError, match="one World is for tv.Recorder"):
            tv.WorldsRecorder(tmp_path / "a.rrd", world)  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="tv.WorldsRecorder"):
            tv.Recorder(tmp_path / "a.rrd", many)  # type: ignore[arg-type]
        for chosen in ([], [1, 1], [2, 2, 2]):
            with pytest.raises(ValueError, match="1 to 64 numbers, each once"):
                tv.WorldsRecorder(tmp_path / "a.rrd", many, chosen)
        with pytest.raises(ValueError, match=r"chosen\[1\] = 3, but there are 3 worlds"):
            tv.WorldsRecorder(tmp_path / "a.rrd", many, [0, 3])
        with pytest.raises(ValueError, match="does not exist"):
            tv.WorldsRecorder(tmp_path / "no" / "a.rrd", many)
        assert not (tmp_path / "a.rrd").exists()
        tv.WorldsRecorder(tmp_path / "a.rrd", many, [2, 0]).close()
        with pytest.raises(FileExistsError):
            tv.WorldsRecorder(tmp_path / "a.rrd", many)
        tv.WorldsRecorder(tmp_path / "a.rrd", many, [2, 0], overwrite=True).close()
    with pytest.raises(ValueError, match="shows worlds 0, 2 side by side, and holds no state"):
        tv.replay(tmp_path / "a.rrd")
