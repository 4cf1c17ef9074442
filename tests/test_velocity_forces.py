"""Forces that read velocities: forces across v keep the energy, drag never overshoots, and both are second order."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import forget_pace, order, rerun

OMEGA = 4.0  # [rad/s] of the magnet; tests take longer steps instead of a stronger magnet, which would compile again


@ti.func
def magnet(x, v):
    """Return the force of m v' = -omega J v: a circle of radius |v| / omega."""
    return OMEGA * ti.Vector([v[1], -v[0]])


@ti.func
def brake(x, v):
    """Return -c v with c = 1 / s: dt determines how stiff it is."""
    return -v


def again(w, **settings):
    """Put a world back to its start, with other settings."""
    w.velocity, w.position = w.particles.velocity, w.particles.position
    forget_pace(w)
    for name, value in settings.items():
        setattr(w, name, value)


@pytest.mark.slow
@pytest.mark.parametrize("precision, limit", [("f64", 1e-12), ("f32", 2e-5)])
def test_a_magnet_keeps_the_speed_whatever_the_substep(world, precision, limit):
    # v_n = d_n / h + h a(v_n) / 2 means (1 + i omega h / 2) v_n = d_n / h and d_(n+1) / h = (1 - i omega h / 2) v_n. So v turns
    # by 2 arctan(omega h / 2), and x is on a circle of radius |v| / omega (1 + (omega h)^2 / 4).
    w = world(tv.Particles([[0.0, 0.0]], velocity=(3.0, 0.0)), [tv.Force(magnet)], substeps=20, precision=precision)
    for omega_h in (0.05, 0.33, 0.83, 1.67, 1.99):
        h = omega_h / OMEGA
        rerun(w, 600 * h, dt=20 * h)
        assert abs(np.linalg.norm(w.velocity) / 3 - 1) <= limit and not w.last.flags
        radius = 3 / OMEGA * (1 + omega_h**2 / 4)
        assert abs(np.linalg.norm(w.position - [0, -radius]) / radius - 1) <= 10 * limit
        if precision == "f64":
            want = 3 * np.exp(-2j * np.arctan(omega_h / 2) * 600)
            assert complex(*w.velocity[0]) == pytest.approx(want, rel=1e-9)
    if precision == "f32":
        return
    # A start from v_n, and the return to v_n, are the two halves of one substep: so it is where substeps change.
    rng, angle = np.random.default_rng(0), 0.0
    again(w)
    for _ in range(200):
        w.substeps, dt = int(rng.integers(1, 6)), float(rng.uniform(0.01, 0.4))
        forget_pace(w)
        w.step(dt)
        angle += 2 * w.substeps * np.arctan(OMEGA * dt / w.substeps / 2)
    assert complex(*w.velocity[0]) == pytest.approx(3 * np.exp(-1j * angle), rel=1e-11)


def test_a_spiral_in_space(world):
    # omega x v about any axis: gravity along the axis acts as without this force, and |v| across it is constant. Also with exact
    # drag.
    @ti.func
    def spiral(x, v):
        return ti.Vector([1.0, 2.0, 2.0]).cross(v)  # |omega| = 3

    axis, v = np.array([1.0, 2.0, 2.0]) / 3, np.array([1.0, -0.5, 2.0])
    w = world(tv.Particles([[0.0, 0, 0]], velocity=v), [tv.Force(spiral), tv.Gravity(2 * axis), tv.Drag(0.0)], precision="f64")
    w.substeps = 3
    w.run(10.0, dt=0.5)
    assert w.velocity[0] @ axis == pytest.approx(v @ axis + 20, rel=1e-12)
    assert np.linalg.norm(w.velocity[0] - w.velocity[0] @ axis * axis) == pytest.approx(
        np.linalg.norm(v - v @ axis * axis), rel=1e-12
    )
    w.features[2].rate = 0.1
    w.features[1].g = np.zeros(3)
    errors = []
    for substeps in (4, 8, 16):  # |v| = exp(-c t) |v0|
        rerun(w, 5.0, dt=0.5, substeps=substeps)
        errors.append(abs(np.linalg.norm(w.velocity) - np.exp(-0.5) * np.linalg.norm(v)))
    assert errors[-1] <= 5e-4 and 1.9 <= order(errors) <= 2.1


def test_drag_is_second_order_and_settles_however_stiff(world):
    # v' = -c v: exp(-c t). A substep multiplies d by 1 - z / (1 + q (1 + theta)), z = c h, q = z / 2, which is in (0, 1) for any
    # z.
    w = world(tv.Particles([[0.0, 0.0]], velocity=(0.6, -0.8)), [tv.Force(brake)], precision="f64")
    errors = []
    for substeps in (4, 8, 16, 32):
        rerun(w, 2.0, dt=0.5, substeps=substeps)
        errors.append(abs(np.linalg.norm(w.velocity) - np.exp(-2)))
    assert 1.9 <= order(errors) <= 2.3 and errors[-1] < 2e-5
    for z in (0.5, 1.0, 2.0, 5.0, 100.0):
        q = z / 2
        rerun(w, 3 * z, dt=z, substeps=1)
        first, late = 1 - q / (1 + q * q**2 / (1 + q**2)), 1 - z / (1 + q * (1 + q**2 / (1 + q**2)))
        want = first * late**2 * (1 - q / (1 + q * (1 + q**2 / (1 + q**2))))  # d_3 / h, and half of a kick to v_3
        assert w.velocity[0] == pytest.approx(want * np.array([0.6, -0.8]), rel=1e-9, abs=1e-15) and not w.last.flags


@pytest.mark.slow
def test_links_stay_second_order_beside_what_turns_and_brakes(world):
    # A pendulum under a force that depends on all of v, also along the rod, where v is right only with the rod's reaction.
    @ti.func
    def slanted(x, v):
        return ti.Vector([-0.8 * v[0] - 0.5 * v[1], 0.9 * v[0] - 0.1 * v[1]])

    def rate(y):  # theta'' from the force along the tangent
        out, along = np.array([np.cos(y[0]), np.sin(y[0])]), np.array([-np.sin(y[0]), np.cos(y[0])])
        v = y[1] * along
        return np.array([y[1], along @ (np.array([0, -9.81]) - [[0.8, 0.5], [-0.9, 0.1]] @ v) + 0 * out[0]])

    y, h = np.array([0.0, 0.5]), 1e-3
    for _ in range(1000):  # Runge and Kutta, 1e-11
        a = rate(y)
        b = rate(y + h / 2 * a)
        c = rate(y + h / 2 * b)
        y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c))
    start = tv.Particles([[0, 0], [1.0, 0]], velocity=[[0, 0], [0, 0.5]], pinned=[0])
    w = world(start, [tv.Gravity(9.81), tv.Force(slanted), tv.Distance([(0, 1)])], precision="f64")
    for turns in (1, 3):  # always as many substeps, or another number in each frame
        errors = []
        for substeps in (4, 8, 16, 32):
            again(w)
            for k in range(32):
                w.substeps = substeps * (1 + k % turns)
                w.step(1 / 32)
            errors.append(np.linalg.norm(w.position[1] - [np.cos(y[0]), np.sin(y[0])]))
        assert 1.9 <= order(errors) <= 2.1


def test_the_flag_comes_where_a_turn_is_not_resolved(world):
    # omega h > 2: a substep turns by at most half a turn, much more slowly than the force. "auto" takes shorter substeps.
    w = world(tv.Particles([[0.0, 0.0]], velocity=(3.0, 0.0)), [tv.Force(magnet)], substeps=1, precision="f64")
    for omega_h, flags in ((1.9, set()), (2.1, {"stiff-force"}), (9.0, {"stiff-force"})):
        rerun(w, 3 * omega_h / OMEGA, dt=omega_h / OMEGA)
        assert w.last.flags == flags
        assert np.linalg.norm(w.velocity) == pytest.approx(3, rel=1e-12)
    assert "omega h = 9" in w.last.notes[0] and "at least 6 substeps" in w.last.notes[0]
    again(w, substeps="auto")
    report = w.step(40.0 / OMEGA)
    assert report.substeps > 40 / 0.25 and not report.flags


def test_what_brakes_takes_energy_and_is_no_stiff_force(world):
    # Drag of the air, v = v0 / (1 + k v0 t) with k = 1 / m, and friction of 1 N, which reverses at once with v, but within 1e-6
    # m/s of rest: v falls to 1 % of what friction takes in a substep, without a flag.
    @ti.func
    def brakes(x, v, t, i):
        f = -v / ti.max(v.norm(), 1e-6)
        if i < 2:
            f = -v.norm() * v
        return f

    start = tv.Particles(np.zeros((4, 3)), velocity=[[3.0, 4.0, 12.0], [0.0, 0.0, -1.0]] * 2)
    w = world(start, [tv.Force(brakes)], substeps=1, precision="f64")
    for dt in (1e-3, 0.1, 1.0, 10.0):
        again(w)
        size = np.array([13.0, 1.0, 13.0, 1.0])
        for _ in range(8):
            w.step(dt)
            now = np.linalg.norm(w.velocity, axis=1)
            assert (now < np.maximum(size, 1e-2 * dt)).all() and not w.last.flags
            size = now
    rerun(w, 1.0, dt=0.1, substeps=200)
    np.testing.assert_allclose(np.linalg.norm(w.velocity, axis=1), [13 / 14, 1 / 2, 12, 0], atol=1e-3)


@pytest.mark.slow
def test_slight_blows_do_not_count_as_forces(world):
    # 20 balls graze each other in a magnet. If their blows counted as forces that go on, 0.95 J would become 41 J at 8 substeps.
    # What is left is the error of the substep of each blow: up to 2.0 times at 8 substeps, 1.2 at 16, 1.1 at 32.
    x, v = np.stack([np.linspace(0, 1, 20), np.zeros(20)], axis=1), np.zeros((20, 2))
    v[1:, 1] = 2 * np.sin(0.5 * np.arange(1, 20))
    start = tv.Particles(x, velocity=v, mass=0.05, radius=0.02)
    w = world(start, [tv.Force(magnet), tv.Contact(restitution=1.0)], substeps=16, precision="f64")
    energy = [w.step(1 / 60).energy for _ in range(600)]
    assert max(energy) < 1.5 * energy[0]


@ti.func
def feeds_or_undefined(x, v, t, i):
    """Return v, which feeds motion; for the second particle -v / |v|, which is NaN at rest."""
    f = 1.0 * v
    if i == 1:
        f = -v / v.norm()
    return f


def test_what_feeds_motion_is_flagged_and_what_is_not_defined_at_rest_is_left_out(world):
    # v' = v: v grows by e^h; a flag reports an h that is too long for that.
    start = tv.Particles([[0.0, 0.0], [0.0, 0.0]], velocity=[[1.0, 0.0], [1.0, 0.0]])
    w = world(start, [tv.Force(feeds_or_undefined)], substeps=1, precision="f64")
    rerun(w, 1.0, dt=0.1, substeps=10)
    assert w.velocity[0, 0] == pytest.approx(np.e, rel=1e-4) and not w.last.flags
    rerun(w, 9.0, dt=3.0, substeps=1)
    assert w.last.flags == {"stiff-force"} and np.isfinite(w.velocity).all()
    # -v / |v| brings v = 1 to rest in one substep of 1 s. The particle may then go back and forth, see the page of forces, but
    # within the 0.5 m in which it stops.
    again(w, velocity=[[0.0, 0.0], [1.0, 0.0]])
    places = np.array([w.step(1.0) and w.position[1] for _ in range(8)])
    assert (np.abs(places) <= [0.5 + 1e-12, 0.0]).all() and not w.last.flags


def test_a_hand_that_holds_still_is_not_stiff(world):
    hand = tv.Hand((0.0, 1.0), particle=0, rate=20.0)
    w = world(tv.Particles([[0.0, 0.0], [1.0, 0.0]]), [tv.Gravity(9.81), hand], substeps=1, precision="f64")
    for _ in range(120):
        assert not w.step(1 / 60).flags
    # The weight stretches the hand's spring by g / rate^2, and nothing moves.
    np.testing.assert_allclose(w.position[0], [0.0, 1 - 9.81 / 400], atol=1e-9)
    hand.rate = 110.0  # rate h = 1.8: the spring is resolved up to 2, and the damping does not interfere
    w.run(1.0)
    np.testing.assert_allclose(w.position[0], [0.0, 1 - 9.81 / 110**2], atol=1e-6)
