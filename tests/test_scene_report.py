"""Reports on one world: its error against its run time, what breaks it, and what went wrong first."""

import json

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.report.stress import robustness
from tiverlet.step import checkpoint

from .conftest import rms


def rope(world, **settings):
    shape = tv.shapes.rope((0, 2), (1, 2), points=5)
    return world(tv.Particles(shape.position, pinned=[0]), [tv.Gravity(9.81), tv.Distance(shape.links)], **settings)


@pytest.mark.slow
def test_a_world_reports_on_itself(world):
    w = rope(world, solver=tv.Direct())
    w.run(0.1)
    before = w.hash()
    found = w.report(0.3, tolerance=1e-3, substeps=(5, 10, 20, 40))
    assert w.hash() == before and found.converges and found.order == pytest.approx(2, abs=0.1)
    best = found.recommended
    assert best and best.error + found.reference_error <= 1e-3
    assert found.paste == f"world = tv.World(particles, features, {best.paste})" and "substeps=" in best.paste
    # Errors in the report are true: against a reference that is a hundred times finer.
    clone = w.clone(precision="f64", solver=tv.Direct(), substeps=1000)
    start = checkpoint.keep(clone)
    clone.run(0.3)
    fine = clone.position
    for s in found.settings:
        if (s.solver, s.precision) == ("Direct()", "f64"):
            checkpoint.put_back(clone, start)
            clone.substeps = s.substeps
            clone.run(0.3)
            assert rms(clone.position, fine) == pytest.approx(s.error, abs=found.reference_error + 1e-2 * s.error)
    clone.close()
    single = [s for s in found.settings if s.precision == "f32"]
    assert all(s.rounding > 0 and 0 <= s.share <= 1 for s in single)
    data = json.loads(found.json())
    assert len(data["settings"]) == len(found.settings) == 16 and "| Direct() |" in found.markdown() and "Pareto" in str(found)
    nothing = w.report(0.3, tolerance=1e-12, substeps=(5, 10))
    assert nothing.recommended is None and "No setting tried is within 1e-12 m" in nothing.paste
    with pytest.raises(ValueError, match="from 2 on"):
        w.report(0.3, substeps=[5])


@pytest.mark.slow
def test_reports_keep_the_order_of_a_world(world):
    # Order 4 needs f64 and links that are solved. The report finds the order and recommends it, and perturbed copies keep it.
    links = [(0, 1), (1, 2)]
    w = world(
        tv.Particles([(0, 0), (1, 0), (2, 0)], pinned=[0]),
        [tv.Gravity(9.81), tv.Distance(links)],
        precision="f64",
        order=4,
        substeps=5,
    )
    w.run(0.1)
    found = w.report(0.2, substeps=(2, 5, 10))
    assert found.order == pytest.approx(4, abs=0.1) and {s.precision for s in found.settings} == {"f64"}
    assert found.paste.endswith('precision="f64", order=4)')
    with robustness.heavier(w, slice(None)) as copy:
        assert copy.order == 4


def test_a_world_says_what_breaks_it(world):
    found = tv.report.stress(rope(world), seconds=0.3)
    seen = {o.parameter: o for o in found.outcomes}
    assert seen["as it is"].verdict == "stands it" and seen["NaN in one input"].verdict == "refused by name"
    assert seen["all masses x 1e6"].verdict == "stands it" and seen["stiffnesses x 1e9"].verdict == "not tried"
    # A pendulum in f32, a thousand kilometres from the origin, where an ulp is 6 cm.
    assert "f32-compensated" in found.breaks["shifted by 1e+06 m"] and seen["shifted by 1e+06 m"].particle is not None
    # Links of 1 kg that carry 1e6 kg vibrate sideways too fast for the substep: the report says so, and how many would do.
    assert "tension" in found.breaks["mass of one particle x 1e6"] and "substeps" in found.breaks["mass of one particle x 1e6"]
    assert not found.passed and "BREAKS" in str(found) and json.loads(found.json())["passed"] is False


@ti.func
def spoilt(x, v, t, i):
    """Return a force that is NaN for particle 3 after 0.14 s."""
    f = 0.0 * x
    if t > 0.139 and i == 3:
        f[0] = ti.sqrt(-1.0 - x[0] * x[0])
    return f


@pytest.mark.slow
def test_an_autopsy_names_what_went_wrong_first(world, tmp_path):
    # Frames of 0.05 s with 5 substeps: t = 0.14 is at the end of substep 3 of frame 2; the force acts in the next one.
    chain = tv.Distance([[0, 1], [1, 2], [2, 3], [3, 4]])
    start = tv.Particles(np.arange(10.0).reshape(5, 2), pinned=[0])
    w = world(start, [tv.Gravity(), chain, tv.Force(spoilt)], substeps=5, precision="f64", solver=tv.Jacobi())
    before = w.hash()
    found = tv.report.autopsy(w, 1.0, dt=0.05)
    assert w.hash() == before and found.found and "non-finite" in found.report.flags and found.particle == 3
    assert (found.frame, found.substep) == (2, 4) and found.times[-1] == pytest.approx(0.15)
    assert {s.members for s in found.suspects} == {(2, 3), (3, 4)} and "Particle 3 shows it" in str(found)
    assert np.isfinite(found.positions[:-1]).all() and np.isnan(found.positions[-1, 3]).any()
    # The states are those of the run itself, bit for bit.
    w.run(0.1, dt=0.05)
    np.testing.assert_array_equal(found.positions[0], w.position)
    found.record(tmp_path / "wrong.rrd")
    assert (tmp_path / "wrong.rrd").stat().st_size > 1000
    good = tv.report.autopsy(w, 0.02, dt=0.02)
    assert not good.found and str(good) == "Nothing went wrong."
    with pytest.raises(RuntimeError, match="nothing went wrong"):
        good.record(tmp_path / "nothing.rrd")
