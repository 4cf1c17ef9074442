"""Particles that spin: rolling, sliding into rolling, impacts, and conserved quantities."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import order

G, EPS = 9.81, {"f32": 2.0**-23, "f64": 2.0**-52}
BODIES = [(2, "disc", 2.0), (2, "ring", 1.0), (3, "sphere", 2.5), (3, "shell", 1.5)]  # k = m r^2 / I


def turning(omega: float, dim: int):
    """Return an angular velocity about the axis out of the plane."""
    return omega if dim == 2 else (0.0, 0.0, omega)


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


def free(world, start, friction=(0.5, 0.5), restitution=(0.0, 0.0), g=0.0, **settings):
    """Return a world with contacts; all kinds of friction and restitution are compiled even where they are 0: one structure."""
    features = [tv.Gravity(g), tv.Contact(friction=(1.0, 1.0), restitution=(0.5, 0.5))]
    w = world(start, features, precision="f64", **settings)
    features[1].friction, features[1].restitution = friction, restitution
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
    # Rolling resistance stops the body: v' = -rolling g / (1 + 1 / k), so it comes to a stand, and stays there bit for bit.
    # Resistance sets in half a substep before the frame begins.
    w.features[1].friction = (mu, mu, 0.05)
    w.step(1 / 60)
    v, x = w.velocity[0, 0], w.position[0, 0]
    w.run(0.5)
    a = 0.05 * G / (1 + 1 / k)
    assert w.velocity[0, 0] == pytest.approx(v - a * 0.5, rel=1e-12)
    # The velocity counts no more of the wall than the weight, so it lacks up to h / 2 a rolling^2 / 2.
    assert w.position[0, 0] - x == pytest.approx(v * 0.5 - a * 0.5**2 / 2, abs=a * 0.05**2 / 4 * 0.5 / 2400)
    w.run(v / a)
    place = w.position
    w.run(0.2)
    assert (w.position == place).all() and abs(rate(w)) <= 1e-12


def law(x, v, omega, m, r, k, e, mu, beta):
    """Return time, velocities and spins after two spheres collide (Walton 1993; Foerster et al. 1994), and whether they stick."""
    dim, axes = x.shape[1], omega.shape[1]
    X, V, W = np.zeros((3, 2, 3))
    X[:, :dim], V[:, :dim], W[:, 3 - axes :] = x, v, omega
    d, u, reach = X[0] - X[1], V[0] - V[1], r.sum()
    a, b, c = u @ u, d @ u, d @ d - reach**2
    t = (-b - np.sqrt(b * b - a * c)) / a
    n = (d + t * u) / reach
    normal = -(1 + e) * (u @ n) / (1 / m).sum()
    slip = u - (u @ n) * n - np.cross(r[0] * W[0] + r[1] * W[1], n)
    tangent = -(1 + beta) * slip / ((1 + k) / m).sum()
    size = np.linalg.norm(tangent)
    tangent *= min(1, mu * normal / size)
    for i, sign in ((0, 1), (1, -1)):
        V[i] += sign * (normal * n + tangent) / m[i]
        W[i] += np.cross(-sign * r[i] * n, sign * tangent) * k / (m[i] * r[i] ** 2)
    return t, V[:, :dim], W[:, 3 - axes :], size <= mu * normal


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_two_that_collide_obey_the_law_of_impacts_to_rounding(world, dim):
    # Momentum, angular momentum about any point and, for a super ball, energy are constant to rounding.
    m, r, k = np.array([1.0, 2.5]), np.array([0.1, 0.15]), 1 / 0.4 if dim == 3 else 2.0
    x = np.array([[0.0, 0, 0], [0.5, 0.12, 0.05]])[:, :dim]
    v = np.array([[2.0, 0.3, -0.2], [-1.0, 0.5, 0.1]])[:, :dim]
    omega = np.random.default_rng(1).normal(size=(2, 2 * dim - 3)) * 20
    # A pinned one far away, and in 3D wide, has the kernels of the tests below serve here.
    far, still = np.vstack([x, np.full(dim, 50.0)]), np.vstack([v, np.zeros(dim)])
    turns = np.vstack([omega, 0 * omega[:1]])[:, slice(None) if dim == 3 else 0]
    start = tv.Particles(far, velocity=still, mass=[*m, 1.0], radius=[*r, 0.75 if dim == 3 else 0.1], spin=turns, pinned=[2])
    w, about, held = free(world, start), np.arange(3.0, 3.0 + dim), []
    for mu, e, beta, substeps in (
        (0.1, 0.8, 0.5, 3),
        (0.1, 0.8, 0.5, 40),
        (2.0, 0.8, 0.0, 5),
        (9.0, 0.7, 0.6, 5),
        (1e3, 1, 1, 5),
    ):
        w.features[1].friction, w.features[1].restitution = (mu, mu), (e, beta)
        w.velocity, w.position, w.spin, w.substeps = still, far, start.spin, substeps
        before = tv.measure.momentum(w), tv.measure.angular_momentum(w, about), tv.measure.kinetic_energy(w)
        w.run(0.5)
        t, velocity, spin, sticks = law(x, v, omega, m, r, k, e, mu, beta)
        held.append(sticks)
        np.testing.assert_allclose(w.velocity[:2], velocity, atol=1e-12)
        np.testing.assert_allclose(w.spin[:2].reshape(2, -1), spin, atol=1e-11)
        np.testing.assert_allclose(w.position[:2], x + t * v + (0.5 - t) * velocity, atol=1e-12)
        np.testing.assert_allclose(tv.measure.momentum(w), before[0], atol=1e-13)
        np.testing.assert_allclose(tv.measure.angular_momentum(w, about), before[1], atol=1e-12)
    assert {*held} == {True, False}
    assert tv.measure.kinetic_energy(w) == pytest.approx(before[2], rel=1e-13)


def test_a_super_ball_comes_back(world):
    # Between a floor and a ceiling that grip (e = 1, beta = 1), d - s x n changes its sign with each bounce. So with k = 5/2,
    # v' = (v (1 - k) + 2 u) / (1 + k), u' = (2 k v - (1 - k) u) / (1 + k) for u = r omega (Garwin 1969); twice is no change.
    k, r = 2.5, 0.02
    v, u = 2.0, 0.0
    start = tv.Particles([(0, 0.5, 0)], velocity=(v, -1, 0), radius=r, spin=0)
    floor = tv.Box((-np.inf, 0, -np.inf), (np.inf, 1, np.inf), friction=1e3, restitution=(1.0, 1.0))
    w, seen, x = world(start, [floor], precision="f64", substeps=7), [], 0.0
    energy = tv.measure.kinetic_energy(w)
    for _ in range(4):
        before, speed = w.position[0, 0], w.velocity[0, 0]
        w.run(0.98, dt=0.98 / 40)
        # The middle moves in a box of height 0.96 at 1 m/s: it meets the first plate after 0.48 s, and each further one 0.96 s
        # later.
        since = w.time - 0.48 - 0.96 * len(seen)
        x = before + speed * (0.98 - since) + w.velocity[0, 0] * since
        assert w.position[0, 0] == pytest.approx(x, abs=1e-12)
        seen.append([w.velocity[0, 0], r * w.spin[0, 2]])
    want, side = [], -1  # the floor is below: the point of contact moves at v + u
    for _ in range(4):
        slip = v - side * u
        v, u = v - 2 * slip / (1 + k), u + side * 2 * k * slip / (1 + k)
        want.append([v, u])
        side = -side
    np.testing.assert_allclose(seen, want, atol=1e-11)
    assert tv.measure.kinetic_energy(w) == pytest.approx(energy, rel=1e-12)


@pytest.mark.slow
def test_what_rolls_off_another_does_so_to_second_order(world):
    # (1 + 1 / k) (R + r) theta'' = g sin theta for a body that rolls on a pinned one; the reference is by Runge and Kutta.
    k, R, r, theta, T = 2.5, 1.0, 0.2, 0.3, 0.5
    place = np.zeros((2, 3))
    place[1, :2] = (R + r) * np.sin(theta), (R + r) * np.cos(theta)
    w = free(world, tv.Particles(place, radius=[R, r], mass=[2.0, 1.0], pinned=[0], spin=0), 5.0, g=G)

    def fall(y):
        return np.array([y[1], G * np.sin(y[0]) / ((R + r) * (1 + 1 / k))])

    y, h = np.array([theta, 0.0]), T / 2000
    for _ in range(2000):
        a = fall(y)
        b = fall(y + h / 2 * a)
        c = fall(y + h / 2 * b)
        y = y + h / 6 * (a + 2 * b + 2 * c + fall(y + h * c))
    errors = []
    for substeps in (10, 20, 40):
        w.velocity, w.position, w.spin, w.substeps = 0 * place, place, w.particles.spin, substeps
        w.run(T, dt=0.05)
        x, y_ = w.position[1, :2]
        errors.append([np.arctan2(x, y_) - y[0], rate(w, 1) + y[1] * (R + r) / r])
    for column in np.abs(errors).T:
        assert 1.9 <= order(column) <= 2.1
    assert np.abs(errors[-1]).max() <= 1e-4


@pytest.mark.slow
def test_a_swarm_keeps_angular_momentum_and_loses_energy(world):
    # Pairs that bounce keep momentum and angular momentum to rounding. Where two strike a particle in the same substep, angular
    # momentum is off by the cross product of what both do in a part of it, O(h); this is rarer with more substeps. Energy only
    # falls.
    rng = np.random.default_rng(3)
    x, size = tv.golden(np.arange(60), dim=3) * 0.7, np.linspace(0.045, 0.055, 60)
    start = tv.Particles(x, velocity=-2 * (x - x.mean(axis=0)), radius=size, mass=size, spin=rng.normal(size=x.shape) * 30)
    w = free(world, start, (0.6, 0.4), (0.5, 0.0), substeps=20)
    momentum, angular = tv.measure.momentum(w), tv.measure.angular_momentum(w, (1, 2, 3))
    energy, off = tv.measure.kinetic_energy(w), []
    for substeps in (20, 200):
        w.velocity, w.position, w.spin, w.substeps = start.velocity, x, start.spin, substeps
        lost = [w.step(1 / 60).energy_change for _ in range(60)]
        assert max(lost) <= 1e-13 * energy and sum(lost) < -0.5 * energy
        np.testing.assert_allclose(tv.measure.momentum(w), momentum, atol=1e-12)
        off.append(np.abs(tv.measure.angular_momentum(w, (1, 2, 3)) - angular).max() / np.abs(angular).max())
    assert off[0] < 1e-3 and off[1] < 1e-5


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
        begin = (
            w.time - 1 / 60 / w.last.substeps / 2
        )  # friction of the last substep counts as acting up to the middle of the next substep
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
    # In a turning drum, a disc that resists rolling turns as the drum does, at 0.6 rad/s, as if glued to it. A disc between two
    # pinned, spinning ones takes the speed of their surfaces, -5 rad/s times R / r.
    drum = tv.Polygon([(1, 0), (0, 1), (-1, 0), (0, -1)], inside=True, friction=(1.0, 1.0, 10.0))
    w = world(tv.Particles([(0.0, -0.85)], radius=0.1, spin=0), [tv.Gravity(G), drum], precision="f64", substeps=40)
    for k in range(30):
        drum.rotation = 0.01 * (k + 1)
        w.step(1 / 60)
    assert w.spin[0] == pytest.approx(0.6, rel=1e-3)
    x = [(-0.13, 0), (0.13, 0), (0, 0.17)]
    rollers = tv.Particles(x, radius=[0.11, 0.11, 0.1], mass=[2.0, 2.0, 1.0], pinned=[0, 1], spin=[5.0, 5.0, 0.0])
    w = free(world, rollers, 0.5, g=G, substeps=40)
    w.run(1.0)
    assert (w.spin[:2] == 5.0).all() and w.spin[2] == pytest.approx(-5.0 * 0.11 / 0.1, rel=1e-3)


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


def scene(dim: int):
    """Return spinning discs or spheres in a box, and all features that act on spins."""
    rng = np.random.default_rng(0)
    x = tv.golden(np.arange(30), dim=dim) + 0.05
    spin = rng.normal(size=30 if dim == 2 else (30, 3)) * 10
    start = tv.Particles(x, radius=0.05 + 0.03 * rng.random(30), mass=1 + rng.random(30), spin=spin, orientation=0)
    features = [
        tv.Gravity(G), tv.Contact(friction=(0.5, 0.4, 0.1, 0.05), restitution=(0.4, 0.3)),
        tv.Box(np.zeros(dim), np.full(dim, 1.2), friction=(0.5, 0.4, 0.1), restitution=(0.5, 0.2)),
    ]  # fmt: skip
    return start, features


@pytest.mark.slow
def test_spins_are_the_same_on_all_ways(world, tmp_path, read_here):
    # Clones, copies, recordings, and particles that are added and removed. In space, which has everything that the plane has. For
    # all paths see test_sleep.py, for the plane and many worlds the recordings below.
    dim, (start, features) = 3, scene(3)
    w = world(start, features, path="fused", substeps=6)
    with tv.Recorder(tmp_path / "spin.rrd", w) as recorder:
        for frame in range(12):
            w.step(1 / 60)
            recorder.log()
            if frame == 5:
                w.spin = 0.5 * w.spin
            if frame == 8:
                w.add(tv.Particles(np.full((1, dim), 1.0), radius=0.05, spin=turning(5.0, dim)))
        hashes = w.hash()
    replay = tv.replay(tmp_path / "spin.rrd")
    assert replay.verify()
    again = replay.world(len(replay.frames) - 1)
    assert again.hash() == hashes and (again.spin == w.spin).all() and (again.orientation == w.orientation).all()
    again.close()
    twin = w.clone()
    for one in (w, twin):
        one.step(1 / 60)
    assert twin.hash() == w.hash()
    w.remove([3, 30])
    spin = np.delete(twin.spin, [3, 30], axis=0)
    np.testing.assert_allclose(w.spin, spin, atol=1e-3 * np.abs(spin).max())
    double = w.clone(precision="f64")
    np.testing.assert_allclose(double.spin, w.spin, rtol=1e-5, atol=1e-5)
    for one in (twin, double):
        one.close()


def test_what_does_not_spin_pays_nothing(world):
    start = tv.Particles([(0, 0), (1, 0)], radius=0.1)
    w = world(start, [tv.Gravity(), tv.Contact(friction=0.5), tv.Box((-1, -1), (2, 2), friction=0.3)])
    assert not [name for name in w.fields if "spin" in name or "turn" in name or name == "Contact.torque"]
    assert (w.spin == 0).all() and not tv.measure.torque(w).any()


BAD = {
    "spin of one number in 3D": lambda: tv.Particles([(0, 0, 0)], radius=1, spin=3.0),
    "spin of a point": lambda: tv.Particles([(0, 0)], spin=3.0),
    "spin not finite": lambda: tv.Particles([(0, 0)], radius=1, spin=np.nan),
    "spins of too many": lambda: tv.Particles([(0, 0)], radius=1, spin=[1.0, 2.0]),
    "inertia of no known body": lambda: tv.Particles([(0, 0)], radius=1, inertia="cube"),
    "inertia of 0": lambda: tv.Particles([(0, 0)], radius=1, inertia=0.0),
    "orientation that is no unit quaternion": lambda: tv.Particles([(0, 0, 0)], radius=1, orientation=(0, 0, 0, 2)),
    "rolling of what does not spin": lambda: tv.World(tv.Particles([(0, 0)], radius=1), [tv.Contact(friction=(1, 1, 0.1))]),
    "rolling on a wall of what does not spin": lambda: tv.World(
        tv.Particles([(0, 0)], radius=1), [tv.HalfSpace((0, 1), friction=(1, 1, 0.1))]
    ),
    "tangential restitution above 1": lambda: tv.Contact(restitution=(0.5, 1.5)),
    "five coefficients": lambda: tv.Contact(friction=(1, 1, 1, 1, 1)),
    "order 4": lambda: tv.World(tv.Particles([(0, 0)], radius=1, spin=1.0), precision="f64", order=4),
    "polygons": lambda: tv.World(tv.Particles([(0, 0), (1, 0), (0, 1)], radius=1, spin=1.0), [tv.Polygons([[0, 1, 2]])]),
    "spin set where there is none": lambda: setattr(tv.World(tv.Particles([(0, 0)], radius=1)), "spin", 1.0),
}


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_spin_is_refused(what):
    with pytest.raises(ValueError, match=r"(Particles|World|Contact|HalfSpace|Polygons).*:"):
        BAD[what]()


@pytest.mark.parametrize("dim", [2, 3])
def test_particles_turn_where_it_is_asked_for(world, dim):
    # Down a slope a grain slides with g sin a - mu g cos a, or rolls with g sin a / (1 + I / m r^2). explain() says who slides.
    angle, mu, t = 0.3, 0.2, 0.5
    normal, down = slope(angle, dim)
    gentle = np.zeros(dim)
    gentle[1] = 1.0
    pull, share = G * np.sin(angle), {2: 0.5, 3: 0.4}[dim]
    for spin, a, said in ((True, pull / (1 + share), False), (False, pull - mu * G * np.cos(angle), True)):
        p = tv.Particles([0.1 * normal], radius=0.1, spin=spin)
        w = world(p, [tv.Gravity(G), tv.HalfSpace(normal, friction=mu), tv.HalfSpace(gentle, -9.0, friction=mu)], substeps=8)
        assert p.spins == spin and ("particles slide down a slope; with tv.Particles(spin=True)" in w.explain()) == said
        w.run(t)
        assert (w.position[0] - 0.1 * normal) @ down == pytest.approx(a * t**2 / 2, rel=2e-3)
    flat = world(tv.Particles(np.zeros((1, dim)), radius=0.1), [tv.Gravity(G), tv.HalfSpace(gentle, -9.0, friction=mu)])
    assert "slope" not in flat.explain()


def test_none_and_some_that_spin(world):
    # A world without particles has spins, too; and a world without spins gets them with added particles.
    none = world(tv.Particles(np.zeros((0, 2)), spin=0, orientation=0), [tv.Gravity(), tv.Contact(friction=0.5)])
    none.step(1 / 60)
    assert none.spin.shape == (0,) and none.orientation.shape == (0,) and tv.measure.kinetic_energy(none) == 0
    w = world(tv.Particles([(0, 0.5)], radius=0.1), [tv.Gravity(), tv.HalfSpace((0, 1), friction=0.3)])
    w.step(1 / 60)
    w.add(tv.Particles([(1, 0.5)], radius=0.1, spin=3.0))
    w.step(1 / 60)
    np.testing.assert_allclose(w.spin, [0, 3], atol=1e-6)
    w.remove([0])
    np.testing.assert_allclose(w.spin, [3], atol=1e-6)


@pytest.mark.slow
def test_recordings_show_angular_momentum(world, tmp_path, read_here):
    # Two spinning particles collide: the curve is that of measure, but for half a substep, and constant to rounding in f64.
    x, v = [(0.0, 0.0), (0.5, 0.07)], [(1.0, 0.0), (-1.0, 0.0)]
    start = tv.Particles(x, velocity=v, radius=[0.1, 0.09], mass=[1.0, 1.2], spin=3.0)
    w = free(world, start, (0.5, 0.5), (0.7, 0.3))
    about = tv.measure.angular_momentum(w)
    with tv.Recorder(tmp_path / "spin.rrd", w) as recorder:
        for _ in range(30):
            w.step(1 / 60)
            recorder.log()
    recording = tv.replay(tmp_path / "spin.rrd")
    assert recording.verify()
    np.testing.assert_allclose(recording.curves["angular momentum/z"][1], about[0], atol=1e-14)
    with tv.Worlds(w, 2) as many:
        w.position, many.position = start.position, start.position
        w.velocity, many.velocity = start.velocity, start.velocity
        for one in (w, many):
            one.run(0.5)
        assert many.hash(1) == w.hash() and (many[0].spin == w.spin).all() and (w.spin != start.spin).all()
