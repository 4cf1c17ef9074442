"""Particles that spin: rolling, sliding into rolling, impacts, and conserved quantities."""

import numpy as np
import pytest

import tiverlet as tv

G, EPS = 9.81, {"f32": 2.0**-23, "f64": 2.0**-52}
BODIES = [(2, "disc", 2.0), (2, "ring", 1.0), (3, "sphere", 2.5), (3, "shell", 1.5)]  # k = m r^2 / I


def rate(world, i: int = 0) -> float:
    """Return the angular velocity of particle i about the axis out of the plane."""
    return float(world.spin[i] if world.particles.dim == 2 else world.spin[i, 2])


def slope(angle: float, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal of an incline that falls to the right, and the direction down it."""
    normal, down = np.zeros((2, dim))
    normal[:2], down[:2] = (np.sin(angle), np.cos(angle)), (np.cos(angle), -np.sin(angle))
    return normal, down


def incline(world, start, normal, friction, precision="f64", **settings):
    """Return a world with a half space that has all kinds of friction, of which some may be 0: one structure for all inclines."""
    w = world(start, [tv.Gravity(G), tv.HalfSpace(normal, friction=(1.0, 1.0, 1.0, 1.0))], precision=precision, **settings)
    w.features[1].friction = friction
    return w


@pytest.mark.parametrize(("dim", "body", "k"), BODIES)
def test_what_rolls_down_an_incline_does_so_to_rounding(world, dim, body, k):
    # a = k / (1 + k) g sin a and omega = a t / r while tan a <= (1 + k) mu; beyond, a = g (sin a - mu cos a) and
    # omega = k mu g cos a t / r. Friction cannot change d + s / k, so each substep is exact, as in free fall.
    r = 0.1
    for mu, angle in ((0.3, np.arctan(0.3 * (1 + k)) - 0.01), (0.3, np.arctan(0.3 * (1 + k)) + 0.01)):
        normal, down = slope(angle, dim)
        w = incline(world, tv.Particles([r * normal], radius=r, mass=3.0, spin=0, inertia=body), normal, mu, substeps=3)
        w.run(0.5)
        a, alpha = k / (1 + k) * G * np.sin(angle), k / (1 + k) * G * np.sin(angle) / r
        if np.tan(angle) > (1 + k) * mu:
            a, alpha = G * (np.sin(angle) - mu * np.cos(angle)), k * mu * G * np.cos(angle) / r
        t = w.time
        assert w.position[0] @ down == pytest.approx(a * t**2 / 2, rel=1e-12)
        assert w.velocity[0] @ down == pytest.approx(a * t, rel=1e-12)
        assert rate(w) == pytest.approx(-alpha * t, rel=1e-12)
        # The moment of friction about the middle is I alpha; and the energy includes that of rolling.
        inertia = 3.0 * r**2 / k
        assert abs(np.ravel(tv.measure.torque(w))[-1]) == pytest.approx(inertia * alpha, rel=1e-9)
        assert tv.measure.kinetic_energy(w) == pytest.approx(1.5 * (a * t) ** 2 + inertia / 2 * (alpha * t) ** 2, rel=1e-12)
        if np.tan(angle) <= (1 + k) * mu:
            assert w.last.energy == pytest.approx(3.0 * G * normal[1] * r, rel=3e-4)  # at the middle of the substep: O(h^2)


@pytest.mark.parametrize(("dim", "body", "k"), [BODIES[0], BODIES[2]])
def test_what_slides_comes_to_roll(world, dim, body, k):
    # v = k / (1 + k) v0 from t = v0 / ((1 + k) mu g) on, because d + s / k is constant. The position is off by what friction
    # changes within a substep, of order h^2.
    mu, v0, r = 0.2, 3.0, 0.11
    start = tv.Particles(np.eye(dim)[1:2] * r, velocity=v0 * np.eye(dim)[0], radius=r, spin=0, inertia=body)
    w = incline(world, start, np.eye(dim)[1], mu)
    t1, errors = v0 / ((1 + k) * mu * G), []
    for substeps in (4, 40):
        w.velocity, w.position, w.spin, w.substeps = start.velocity, start.position, start.spin, substeps
        begin = w.time
        w.run(1.0)
        t = w.time - begin
        assert w.velocity[0, 0] == pytest.approx(k / (1 + k) * v0, rel=1e-12)
        assert rate(w) == pytest.approx(-k / (1 + k) * v0 / r, rel=1e-12)
        x = v0 * t1 - mu * G * t1**2 / 2 + k / (1 + k) * v0 * (t - t1)
        errors.append(abs(w.position[0, 0] - x))
        assert errors[-1] <= mu * G * (1 / 60 / substeps) ** 2


def law(x, v, omega, m, r, k, e, mu, beta):
    """Return time, velocities and spins after two spheres collide (Walton 1993; Foerster et al. 1994), and whether they stick."""
    v, omega, d, u, reach = v.copy(), omega.copy(), x[0] - x[1], v[0] - v[1], r.sum()
    a, b, c = u @ u, d @ u, d @ d - reach**2
    t = (-b - np.sqrt(b * b - a * c)) / a
    n = (d + t * u) / reach
    normal = -(1 + e) * (u @ n) / (1 / m).sum()
    slip = u - (u @ n) * n - np.cross(r[0] * omega[0] + r[1] * omega[1], n)
    tangent = -(1 + beta) * slip / ((1 + k) / m).sum()
    size = np.linalg.norm(tangent)
    tangent *= min(1, mu * normal / size)
    for i, sign in ((0, 1), (1, -1)):
        v[i] += sign * (normal * n + tangent) / m[i]
        omega[i] += np.cross(-sign * r[i] * n, sign * tangent) * k / (m[i] * r[i] ** 2)
    return t, v, omega, size <= mu * normal


@pytest.mark.slow
def test_two_that_collide_obey_the_law_of_impacts_to_rounding(world):
    # Momentum, angular momentum about any point and, for a super ball, energy are constant to rounding.
    m, r, k = np.array([1.0, 2.5]), np.array([0.1, 0.15]), 2.5
    x, v = np.array([[0.0, 0, 0], [0.5, 0.12, 0.05]]), np.array([[2.0, 0.3, -0.2], [-1.0, 0.5, 0.1]])
    omega, about, held = np.random.default_rng(1).normal(size=(2, 3)) * 20, np.arange(3.0, 6.0), []
    contact = tv.Contact(friction=(1.0, 1.0), restitution=(0.5, 0.5))
    w = world(tv.Particles(x, velocity=v, mass=m, radius=r, spin=omega), [contact], precision="f64")
    laws = (0.1, 0.8, 0.5, 3), (0.1, 0.8, 0.5, 40), (2.0, 0.8, 0.0, 5), (9.0, 0.7, 0.6, 5), (1e3, 1, 1, 5)
    for mu, e, beta, substeps in laws:
        contact.friction, contact.restitution = (mu, mu), (e, beta)
        w.velocity, w.position, w.spin, w.substeps = v, x, omega, substeps
        before = tv.measure.momentum(w), tv.measure.angular_momentum(w, about), tv.measure.kinetic_energy(w)
        w.run(0.5)
        t, velocity, spin, sticks = law(x, v, omega, m, r, k, e, mu, beta)
        held.append(sticks)
        np.testing.assert_allclose(w.velocity, velocity, atol=1e-12)
        np.testing.assert_allclose(w.spin, spin, atol=1e-11)
        np.testing.assert_allclose(w.position, x + t * v + (0.5 - t) * velocity, atol=1e-12)
        np.testing.assert_allclose(tv.measure.momentum(w), before[0], atol=1e-13)
        np.testing.assert_allclose(tv.measure.angular_momentum(w, about), before[1], atol=1e-12)
    assert {*held} == {True, False}
    assert tv.measure.kinetic_energy(w) == pytest.approx(before[2], rel=1e-13)


def test_rolling_resistance_holds_and_lets_go(world):
    # A disc on an incline stays, to a digit, while rolling >= tan a; beyond, it rolls with (sin a - rolling cos a) g k / (1 + k).
    r, k, angle = 0.1, 2.0, 0.2
    normal, down = slope(angle, 2)
    for precision in ("f64", "f32"):
        start = tv.Particles([r * normal], radius=r, spin=0)
        w = incline(world, start, normal, (1.0, 1.0, np.tan(angle) + 0.01), precision)
        w.run(0.3)
        place = w.position
        w.run(2.0)
        assert np.abs(w.position - place).max() <= 4 * EPS[precision] * r and np.abs(place - r * normal).max() <= 1e-7
        w.features[1].friction = (1.0, 1.0, 0.1)
        begin = w.time - 1 / 60 / w.last.substeps / 2  # friction of the last substep acts up to the middle of the next one
        w.run(0.5)
        a, t = G * (np.sin(angle) - 0.1 * np.cos(angle)) / (1 + 1 / k), w.time - begin
        assert w.velocity[0] @ down == pytest.approx(a * t, rel=1e-9 if precision == "f64" else 1e-4)


def test_twisting_resistance_stops_a_top(world):
    # I omega' = -twisting r m g: omega = omega0 - twisting g k t / r. Without twisting resistance a sphere spins about the normal
    # forever.
    r, k, omega = 0.1, 2.5, 40.0
    start = tv.Particles([(0, r, 0)], radius=r, spin=(0, omega, 0))
    w = incline(world, start, (0, 1, 0), (0.5, 0.5, 0.0, 0.1))
    w.run(0.5)
    assert w.spin[0, 1] == pytest.approx(omega - 0.1 * G * k * 0.5 / r, rel=1e-9)
    np.testing.assert_allclose(w.position, start.position, atol=1e-12)
    w.features[1].friction = 0.5
    w.step(1 / 60)
    now = w.spin[0, 1]
    w.run(0.3)
    assert w.spin[0, 1] == pytest.approx(now, rel=1e-12)


@pytest.mark.slow
def test_a_turning_wall_takes_a_ball_along(world):
    # In a turning drum, a disc that resists rolling turns as the drum does, at 0.6 rad/s, as if glued to it. test_sleep.py has
    # rollers.
    drum = tv.Polygon([(1, 0), (0, 1), (-1, 0), (0, -1)], inside=True, friction=(1.0, 1.0, 10.0))
    w = world(tv.Particles([(0.0, -0.85)], radius=0.1, spin=0), [tv.Gravity(G), drum], precision="f64", substeps=40)
    for k in range(30):
        drum.rotation = 0.01 * (k + 1)
        w.step(1 / 60)
    assert w.spin[0] == pytest.approx(0.6, rel=1e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_orientations_follow_spins(world, dim):
    # theta = omega t; in 3D the quaternion of the rotation vector omega t. Also at 1e4 rad/s, 8 rad per substep.
    omega = np.array([[3.0], [-1e4]]) * np.array([[1.0]] if dim == 2 else [[0.6, 0.0, 0.8]])
    x = np.zeros((2, dim))
    x[1, 0] = 1
    start = tv.Particles(x, radius=0.1, spin=omega[:, 0] if dim == 2 else omega, orientation=0)
    w = world(start, [], precision="f64")
    w.run(0.5)
    if dim == 2:
        np.testing.assert_allclose(w.orientation, 0.5 * omega[:, 0], rtol=1e-11)
    else:
        half = 0.25 * np.linalg.norm(omega, axis=1)[:, None]
        axis = np.sign([[1.0], [-1.0]]) * [0.6, 0.0, 0.8]
        want = np.concatenate([np.sin(half) * axis, np.cos(half)], axis=1)
        np.testing.assert_allclose(np.abs((w.orientation * want).sum(axis=1)), 1, atol=1e-9)


def test_what_cannot_spin_is_refused():
    one, three, plain = [(0, 0)], [(0, 0, 0)], tv.Particles([(0, 0)], radius=1)
    for make in (
        lambda: tv.Particles(three, radius=1, spin=3.0),  # one number in 3D
        lambda: tv.Particles(one, spin=3.0),  # of a point
        lambda: tv.Particles(one, radius=1, inertia=0.0),
        lambda: tv.Particles(three, radius=1, orientation=(0, 0, 0, 2)),
        lambda: tv.World(plain, [tv.Contact(friction=(1, 1, 0.1))]),  # rolling of what does not spin
        lambda: tv.World(plain, [tv.HalfSpace((0, 1), friction=(1, 1, 0.1))]),
        lambda: tv.Contact(restitution=(0.5, 1.5)),
        lambda: tv.Contact(friction=(1, 1, 1, 1, 1)),
        lambda: tv.World(tv.Particles(one, radius=1, spin=1.0), precision="f64", order=4),
        lambda: tv.World(tv.Particles([(0, 0), (1, 0), (0, 1)], radius=1, spin=1.0), [tv.Polygons([[0, 1, 2]])]),
        lambda: setattr(tv.World(plain), "spin", 1.0),
    ):
        with pytest.raises(ValueError, match=r"(Particles|World|Contact|HalfSpace|Polygons).*:"):
            make()


def test_particles_turn_where_it_is_asked_for_and_it_is_told_who_slides(world):
    normal, _ = slope(0.3, 2)
    for spin in (True, False):
        p = tv.Particles([0.1 * normal], radius=0.1, spin=spin)
        said = world(p, [tv.Gravity(G), tv.HalfSpace(normal, friction=0.2)]).explain()
        assert p.spins == spin and ("particles slide down a slope; with tv.Particles(spin=True)" in said) != spin
