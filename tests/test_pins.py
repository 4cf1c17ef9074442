"""Particles that are held at targets, rigidly or by springs."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device.patches import patched
from tiverlet.device.patches.compiler import CachedLaunch

from .conftest import ARCH, compiled, order, rerun, rms


def test_driven_pins_follow_their_targets(world):
    hand = tv.Pin([0], (0.0, 0.0))
    w = world(
        tv.Particles([[0.0, 0], [0, -1]]),
        [tv.Gravity(9.81), tv.Distance([[0, 1]]), hand],
        substeps=40,
        iterations=10,
        precision="f64",
    )
    for k in range(60):
        hand.target = [[0.01 * (k + 1), 0.0]]
        w.step(1 / 60)
        np.testing.assert_allclose(w.position[0], [0.01 * (k + 1), 0.0], atol=1e-15)
    # Row 69: ten metres in one frame. Motion stays bounded, the link recovers, and the work done is reported.
    hand.target = (10.0, 0.0)
    report = w.step(1 / 60)
    assert report.energy_change > 1e3 and np.isfinite(w.position).all()
    w.run(1.0)
    assert w.last.residual < 1e-3 and np.abs(w.position - [10.0, 0]).max() <= 1.1


@pytest.mark.parametrize("substeps", [1, 4])
def test_what_a_pin_drags_bears_the_impulse_of_a_frame_in_its_first_substep(world, substeps):
    # x = -a t^2 / 2 at the ends of frames, about: the speed grows by a dt where frames meet, and F h = 3 m a dt for three links.
    # In frames of one substep, F = 3 m a.
    a, dt, x = 2.0, 1 / 60, np.stack([np.arange(4.0), np.zeros(4)], axis=1)
    for share in (0.999, 1.001):
        pin = tv.Pin([0])
        links = tv.Distance([[0, 1], [1, 2], [2, 3]], break_at=share * 3 * a * substeps)
        w = world(tv.Particles(x, velocity=(-a * dt / 2, 0.0)), [pin, links], substeps=substeps, precision="f64")
        for k in range(1, 6):
            pin.target = [[-a * (k * dt) * ((k + 1) * dt) / 2, 0.0]]
            w.step(dt)
            if share > 1:
                want = a * np.array([3.0, 2.0, 1.0]) if substeps == 1 else 0.0
                assert k == 1 or links.load == pytest.approx(want, abs=1e-9)
        assert links.broken.tolist() == [share < 1, False, False]


def test_soft_pins_are_springs(world):
    # m x'' = -k (x - target): an oscillator along both axes; and under gravity the particle rests at the static distance.
    k = 100.0
    w = world(
        tv.Particles([[0.5, 0.25]]),
        [tv.Pin([0], (0.0, 0.0), compliance=1 / k)],
        iterations=3,
        precision="f64",
    )
    want = np.array([0.5, 0.25]) * np.cos(20.0)
    errors = [rms(rerun(w, 2.0, substeps=n).position[0], want) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1
    hand = tv.Pin([0], (0.0, 0.0), compliance=1 / k, damping=20.0)
    w = world(tv.Particles([[0.0, 0.0]]), [tv.Gravity(9.81), hand], iterations=4, precision="f64")
    w.run(3.0)
    np.testing.assert_allclose(w.position[0], [0, -9.81 / k], atol=1e-7)
    np.testing.assert_allclose(w.velocity[0], 0.0, atol=1e-9)  # otherwise half of what gravity adds in a substep
    assert "Pin" in w.explain()


def hung(world, pin, gate):
    """Return a world with six discs in a row, linked by springs, above a gate.

    What a spring adds to a velocity depends on which of its ends are held. Between two pins there is a moment at which none is.
    So particles of a driving pin have no springs where positions are compared.
    """
    x = np.stack([np.arange(6) * 0.3, np.zeros(6)], axis=1)
    links = tv.Distance([[4, 5]] if pin.is_kinematic else [[0, 1], [1, 2], [2, 3], [3, 4], [4, 5]], compliance=1e-4)
    features, solver = [tv.Gravity(9.81), links, tv.Contact(), gate, pin], tv.Jacobi(0.5)
    return world(tv.Particles(x, radius=0.1), features, precision="f64", substeps=5, solver=solver)


@pytest.mark.slow
@pytest.mark.skipif(not patched or ARCH != "cpu", reason="every world has kernels of its own there")
def test_a_pin_that_takes_other_particles_is_as_a_new_one(world):
    # Bit for bit, and nothing is compiled. Particles that the pin no longer holds move freely. For springs and f32 see
    # test_edit_in_place.py.
    def scene():
        pin = tv.Pin([1, 3], [(0.0, 1.0), (1.0, 1.0)])
        w = hung(world, pin, tv.HalfSpace((0, 1), -99.0, active=True))
        w.run(0.3)
        return w, pin

    w, pin = scene()
    other, old = scene()
    assert w.hash() == other.hash()
    for indices in ([2, 3], [2, 0], [1, 3]):
        mine = np.array(indices, dtype=np.int32)
        pin.indices, pin.target = mine, [(0.2, 0.9), (1.2, 0.8)]
        mine[:] = 5  # the pin has a copy
        new = tv.Pin(indices, [(0.2, 0.9), (1.2, 0.8)])
        other.remove(features=[old])
        other.add(features=[new])
        old = new
        with compiled() as names:
            w.run(0.2)
        other.run(0.2)
        assert names == []
        np.testing.assert_array_equal(w.position, other.position)
        np.testing.assert_array_equal(w.velocity, other.velocity)
        assert pin.indices[:, 0].tolist() == indices
    w.remove([0])
    assert pin.indices[:, 0].tolist() == [0, 2]
    pin.target = w.position[pin.indices]
    np.testing.assert_array_equal(pin.target, w.position[[0, 2]])
    for value, words in (
        ([0], "has 1 particles, but this Pin holds 2"),
        ([0, 9], "there are 5 particles"),
        ([1, 1], "named twice"),
    ):
        with pytest.raises(ValueError, match=words):
            pin.indices = value


@pytest.mark.slow
@pytest.mark.skipif(not patched, reason="takes minutes to compile there")
def test_a_recording_knows_which_particles_were_held(world, tmp_path):
    pin, gate = tv.Pin([0], (0.0, 1.0)), tv.HalfSpace((0, 1), -0.2, active=True)
    w = hung(world, pin, gate)
    with tv.Recorder(tmp_path / "a.rrd", w) as recorder:
        for k in range(24):
            if k == 8:
                pin.indices, pin.target = [3], [(0.5, 1.0)]
            if k == 16:
                pin.indices, gate.active = [5], False
            w.step(1 / 60)
            recorder.log()
    recording = tv.replay(tmp_path / "a.rrd")
    verdict = recording.verify()
    assert verdict.kind == "intact", verdict
    again = recording.world(20)
    assert again.features[4].indices.tolist() == [[5]] and not again.features[3].active


@pytest.mark.slow
@pytest.mark.skipif(not patched or ARCH != "cpu", reason="every edit builds the world anew there")
def test_a_pin_takes_another_disc_in_one_launch_and_the_energy_counts_what_it_lets_go(world, monkeypatch):
    # The first time compiles nothing, and each takes one launch beside that of the frame. The energy before a frame is as if all
    # of it were summed up anew: without what the pin takes, with what it let go.
    i, pin = np.arange(30), tv.Pin([8])
    fields = [tv.Gravity(9.81), tv.Drag(0.2), tv.Attractor((0.5, 2.0), 3.0), tv.Hand((0.3, 1.0), particle=9)]
    start = tv.Particles(0.19 * np.stack([i % 6, i // 6], axis=1) + 0.1, radius=0.1)
    w = world(start, [*fields, tv.Box((0, 0), (1.2, 3)), tv.Contact(), pin], substeps=8)
    w.run(0.2)
    launched, launch = [], CachedLaunch.launch
    monkeypatch.setattr(CachedLaunch, "launch", lambda self: (launched.append(self.name), launch(self))[1])
    with compiled() as names:
        for k in (9, 3, 14):
            pin.indices, pin.target = [k], w.position[k]
            w.step(1 / 60)
    assert names == [] and launched == ["release", "fused"] * 3
    for k in (9, 3, 14):
        before = w.last.energy
        pin.indices, pin.target = [k], w.position[k] + 0.01
        w._upload_parameters()
        w._runner.diagnose_state(bare=True)
        energy = w._runner.sheet.item(0)
        assert w._clock.energy == pytest.approx(energy, rel=1e-7) and abs(energy - before) > 1e-3
        report = w.step(1 / 60)
        assert report.energy_change == pytest.approx(report.energy - energy, rel=1e-6, abs=1e-7 * energy)
