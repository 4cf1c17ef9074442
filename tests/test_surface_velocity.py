"""Walls whose surface moves along itself: conveyor belts."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

MU, V, R = 0.3, 1.0, 0.05
CORNERS = np.array([(-5.0, 0.0, -5.0), (5.0, 0.0, -5.0), (5.0, 0.0, 5.0), (-5.0, 0.0, 5.0)])


@ti.func
def below(p):
    return p.y


FLOORS = {
    "half space": lambda **more: tv.HalfSpace((0, 1), **more),
    "half space in 3D": lambda **more: tv.HalfSpace((0, 1, 0), **more),
    "box": lambda **more: tv.Box((-5, 0), (5, 5), **more),
    "ball": lambda **more: tv.Ball((0, -1e5), 1e5, **more),
    "capsule": lambda **more: tv.Capsule((-5, -0.1), (5, -0.1), 0.1, **more),
    "polygon": lambda **more: tv.Polygon([(-5, -1), (5, -1), (5, 0), (-5, 0)], **more),
    "mesh": lambda **more: tv.Mesh(CORNERS, [(0, 2, 1), (0, 3, 2)], closed=False, radius=0.1, position=(0, -0.1, 0), **more),
    "sdf": lambda **more: tv.Sdf(below, **more),
}


@pytest.mark.parametrize("floor", FLOORS)
def test_belts_carry_particles_along(world, floor):
    # Friction accelerates by mu g until the particle is as fast as the belt, at t = v / (mu g): x = v T - v^2 / (2 mu g). Between
    # the two the end of sliding is off by up to a substep, in which it is wrong by up to mu g h^2. The velocity along the normal,
    # 5 m/s, does nothing; on the ball, 1e5 m wide, it has a part along the surface of 5 m/s x / R.
    dim = 3 if floor in ("half space in 3D", "mesh") else 2
    velocity = np.array([V, 5.0, 0.0][:dim])
    w = world(
        tv.Particles(np.array([[0.0, R, 0.0][:dim]]), radius=R),
        [tv.Gravity(), FLOORS[floor](friction=MU, surface_velocity=velocity)], precision="f64",
    )  # fmt: skip
    w.run(1.0)
    h, tilt = 1 / 60 / w.substeps, 5.0 / 1e5 * (floor == "ball")
    assert w.position[0] == pytest.approx([V - V**2 / (2 * MU * 9.81), R, 0.0][:dim], abs=MU * 9.81 * h**2 + tilt)
    assert w.velocity[0] == pytest.approx([V, 0.0, 0.0][:dim], abs=1e-9 + tilt)
    assert not w.last.flags


def test_what_spins_rolls_on_a_belt(world):
    # An impulse J at the contact gives v = J / m and turns the disc, of inertia m r^2 / 2, so that the contact point gains
    # J / m (1 + 2). It sticks where that is the speed of the belt: v = V / 3, and omega = -2 v / r.
    w = world(
        tv.Particles([[0.0, R]], radius=R, spin=0.0), [tv.Gravity(), tv.HalfSpace((0, 1), friction=MU, surface_velocity=(V, 0))],
        precision="f64",
    )  # fmt: skip
    w.run(0.5)
    assert w.velocity[0] == pytest.approx([V / 3, 0], abs=1e-6) and w.spin[0] == pytest.approx(2 * V / 3 / R, rel=1e-6)


def test_bounces_on_a_belt(world):
    # The impulse along the normal is m (1 + e) v, and friction gives mu times that along the belt. The lower end of an upright
    # rod of two particles bears twice the impulse of one, all of the friction of it.
    e, fall, mu = 0.5, 2.0, 0.1
    w = world(
        tv.Particles([[0, 0.1], [1, 0.1], [1, 0.3]], velocity=(0.0, -fall)),
        [tv.Distance([(1, 2)]), tv.HalfSpace((0, 1), friction=mu, restitution=e, surface_velocity=(10.0, 0.0))],
        precision="f64",
    )  # fmt: skip
    w.run(4 / 60)
    assert w.velocity[0] == pytest.approx([mu * (1 + e) * fall, e * fall], abs=1e-9)
    momentum = w.velocity[1:].sum(axis=0)
    assert momentum == pytest.approx([2 * mu * (1 + e) * fall, 2 * e * fall], rel=1e-3)


def test_belts_start_and_stop(world):
    # At rest until the belt starts; then at its speed; then braked by mu g. Sleepers wake, and none sleeps on a slow belt.
    floor = tv.HalfSpace((0, 1), friction=MU, surface_velocity=(0.0, 0.0))
    w = world(tv.Particles([[0.0, R]], radius=R), [tv.Gravity(), floor, tv.Sleep(speed=0.01, time=0.2)], precision="f64")
    w.run(1.0)
    assert w.last.asleep == 1 and (w.position[0] == [0, R]).all()
    slow = 0.005
    floor.surface_velocity = (slow, 0.0)
    w.run(1.0)
    assert w.last.asleep == 0 and w.position[0, 0] == pytest.approx(slow, abs=1e-5)
    twin = w.clone()
    floor.surface_velocity = (-V, 0.0)
    w.run(1.0)
    assert w.velocity[0, 0] == pytest.approx(-V, abs=1e-9)
    floor.surface_velocity = (0.0, 0.0)
    w.run(1.0)
    assert w.last.asleep == 1 and w.velocity[0, 0] == 0
    twin.run(1.0)
    assert twin.position[0, 0] == pytest.approx(2 * slow, abs=1e-5)
    twin.close()


def test_a_belt_that_is_set_later_is_compiled_then(world):
    floor = tv.HalfSpace((0, 1), friction=MU)
    w = world(tv.Particles([[0.0, R]], radius=R), [tv.Gravity(), floor])
    w.step(1 / 60)
    floor.surface_velocity = (V, 0.0)
    w.run(0.5)
    assert w.velocity[0, 0] == pytest.approx(V)
    floor.surface_velocity = None
    w.run(0.5)
    assert w.velocity[0, 0] == 0


def test_wrong_belts_are_refused():
    particles = tv.Particles([[0.0, R]], radius=R)
    with pytest.raises(ValueError, match="surface_velocity moves nothing without friction"):
        tv.World(particles, [tv.HalfSpace((0, 1), surface_velocity=(1.0, 0.0))])
    with pytest.raises(ValueError, match=r"surface_velocity has shape \(3,\), but 2 numbers are needed"):
        tv.World(particles, [tv.HalfSpace((0, 1), friction=0.5, surface_velocity=(1.0, 0.0, 0.0))])
    with pytest.raises(ValueError, match=r"surface_velocity\[1\] = nan"):
        tv.HalfSpace((0, 1), friction=0.5, surface_velocity=(1.0, np.nan))
