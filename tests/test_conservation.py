"""Energy, angular momentum, and the symmetries of the equations of motion, with closed forms."""

import numpy as np
import pytest

import tiverlet as tv


def sliding(world, x, v=(0.0, 0.0), *, g=0.0, pull=0.0, **some):
    """Return discs without friction under gravity and an attractor at the origin."""
    features = [tv.Gravity(g), tv.Attractor((0, 0), pull, softening=0.2), tv.Contact()]
    return world(tv.Particles(x, velocity=v, **some), features, substeps=8, precision="f64")


@pytest.mark.slow
def test_discs_that_lie_on_each_other_do_not_turn_by_themselves(world):
    # Seven discs without friction, attracted to a point by central forces. Impulses p act along the line of centers at the start
    # of a substep, x_n x p = 0. So L = sum m x x v is kept, but for moves that part overlap along the lines of centers, by
    # dL = m dx v. The discs turn like a solid, which keeps its energy. Impulses along the line at the end would
    # double both in 10 s.
    angle = np.pi / 3 * np.arange(6)
    x = np.vstack([[0.0, 0.0], 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    w = sliding(world, x, np.stack([-x[:, 1], x[:, 0]], axis=1), pull=1.0, mass=1 + 0.1 * np.arange(7), radius=0.1)
    w.run(1.0)
    turns, energy = tv.measure.angular_momentum(w, (0, 0))[0], w.last.energy
    w.run(10.0)
    apart = np.linalg.norm(w.position[:, None] - w.position, axis=2)
    assert (apart[np.triu_indices(7, 1)] < 0.2 + 1e-3).sum() >= 10
    assert tv.measure.angular_momentum(w, (0, 0))[0] == pytest.approx(turns, rel=1e-5)
    assert w.last.energy == pytest.approx(energy, rel=1e-5)


def taken(angle, rate):
    """Return the time in which an angle grows from 0 at a rate that depends on it: the integral of 1 / rate."""
    node, share = np.polynomial.legendre.leggauss(60)
    return (share / rate(angle * (1 + node) / 2)).sum() * angle / 2


@pytest.mark.slow
def test_what_slides_over_a_disc_is_second_order(world):
    # An inverted pendulum, while the disc presses: theta'^2 = w^2 + 2 g / l (1 - cos theta), so the time to reach theta is the
    # integral of 1 / theta'. The disc would leave at cos theta = (2 + w^2 l / g) / 3, after 0.56 s.
    g, turning, until = 10.0, 1.0, 0.5
    late, gained = [], []
    for substeps in (10, 20, 40):
        w = sliding(world, [(0.0, 0.0), (0.0, 1.0)], [(0.0, 0.0), (turning, 0.0)], g=g, radius=0.5, pinned=[0])
        w.substeps = substeps
        w.run(until)
        x, v = w.position[1], w.velocity[1]
        late.append(taken(np.arctan2(*x), lambda a: np.sqrt(turning**2 + 2 * g * (1 - np.cos(a)))) - until)
        gained.append(v @ v / 2 + g * x[1] - turning**2 / 2 - g)
        assert abs(np.linalg.norm(x) - 1.0) < 1e-9
    np.testing.assert_allclose(np.array(late[:-1]) / late[1:], 4.0, rtol=0.02)
    assert abs(late[0]) < 1e-5 * until and np.abs(gained).max() < 1e-5 * g


@pytest.mark.slow
def test_motion_has_the_symmetries_of_its_equations(world):
    # A net of rigid and soft links falls: turned by 90 degrees it has the same bits up to sign, in f32 as well, since the dither
    # has the sign of the kick; turned by any angle, seen from a moving place, or with all masses, springs and dashpots 7 times
    # as large, the same motion.
    rng, pairs = np.random.default_rng(2), np.array([(i, j) for i in range(9) for j in range(i) if (i + j) % 3])
    x, v, mass = rng.normal(size=(9, 2)), rng.normal(size=(9, 2)), np.exp(rng.uniform(0, 4, 9))
    alpha = np.where(np.arange(len(pairs)) % 8, 10.0 ** rng.uniform(-9, -1, len(pairs)), 0.0)
    a = np.radians(37)
    quarter, turn = np.array([[0.0, -1.0], [1.0, 0.0]]), np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])

    def end(by, boost=(0.0, 0.0), factor=1.0, precision="f64"):
        links = tv.Distance(pairs, compliance=alpha / factor, damping=factor * (np.arange(len(pairs)) % 3))
        start = tv.Particles(x @ by.T, velocity=v @ by.T + boost, mass=mass * factor)
        w = world(start, [tv.Gravity(by @ (1.0, -9.81)), links], substeps=10, iterations=2, precision=precision)
        w.run(0.5)
        return w.position

    plain = end(np.eye(2))
    np.testing.assert_array_equal(end(quarter), plain @ quarter.T)
    np.testing.assert_array_equal(end(quarter, precision="f32"), end(np.eye(2), precision="f32") @ quarter.T)
    np.testing.assert_allclose(end(turn), plain @ turn.T, atol=1e-9)
    np.testing.assert_allclose(end(np.eye(2), boost=(3.0, -2.0)), plain + 0.5 * np.array([3.0, -2.0]), atol=1e-9)
    np.testing.assert_allclose(end(np.eye(2), factor=7.0), plain, atol=1e-9)


@pytest.mark.slow
def test_a_stiff_spring_that_turns_stores_what_its_load_does(world):
    # A mass m circles a point at a distance L: it has m v^2 / 2, and the spring alpha F^2 / 2 with F = m v^2 / L = 2.5 N, 3e-9 J.
    # In the middle of a substep the mass is nearer by L phi^2 / 8, phi = v h / L; 1 / (2 alpha) times its square would be up to
    # 23 J. The mass turns by asin phi per substep, and its speed is taken along the chord: (1 + phi^2 / 4) of the kinetic energy.
    # A cluster must give the same, and so must a mass on a stiff pin: m u^2 / 2 for a target with speed u.
    alpha, L, v, u, m = 1e-9, 0.5, 2.5, 1.2, 0.2
    x = np.array([[0, 0], [L, 0], [2, 0], [2 + L, 0], [2, L], [5, 0]])
    speed = np.array([[0, 0], [0, v], [0, 0], [0, 0], [0, 0], [0, 0]])
    center = x[2:5].mean(axis=0)
    speed[2:5] = (x[2:5] - center)[:, ::-1] * [-v / L, v / L]
    features = [
        tv.Distance([[0, 1]], compliance=alpha), tv.ShapeMatch([[2, 3, 4]], compliance=alpha), tv.Pin([5], compliance=alpha)
    ]  # fmt: skip
    w = world(tv.Particles(x, velocity=speed, mass=m, pinned=[0]), features, precision="f64", substeps=2)
    turning = m / 2 * (speed**2).sum()
    for k in range(4):
        features[2].target = [[5 + u * (k + 1) / 60, 0]]
        report = w.step(1 / 60)
        assert report.energy == pytest.approx(turning + m / 2 * u**2, rel=(v / L / 120) ** 2 / 3)


@pytest.mark.slow
def test_springs_in_f32_gain_nothing(world):
    # Springs that move particles by less than half a digit of x in a substep. Where such moves are lost in x and kept in d, the
    # force is late by h, and the energy grows by exp(omega^2 h t) = 1.44 in t = 1.8 s. Dithered, they are right on average, and
    # N = t / h of them err by e sqrt(N), at random, with e = ulp(x) / sqrt(3) of the two sums of a substep. With an amplitude A
    # per axis the energy errs by 2 e sqrt(N) / A = 0.023, tested to 4 times that. Springs that share particles, as those of the
    # chain, keep low words away, see build.py. The kinetic energy is averaged over the 12 frames of a period.
    soft, body = (2 * np.pi * 5) ** -2, np.array([[0.0, -0.1], [0.9, 0.1], [0.3, 0.8], [0.5, -0.6]])
    row = np.array([[-0.5, 0.0], [0.0, 0.0], [0.5, 0.0]])
    x, parts = 10.0 + np.concatenate([[[0, 0]], body, row]), [slice(0, 1), slice(1, 5), slice(5, 8)]
    v = np.concatenate([[[1, -1]], body - body.mean(axis=0), row])
    for part in parts:
        v[part] *= 0.2 * (len(v[part]) / (v[part] ** 2).sum()) ** 0.5
    held = [tv.Pin([0], x[:1], compliance=soft), tv.ShapeMatch([range(1, 5)], compliance=soft / 4)]
    held.append(tv.Distance([[5, 6], [6, 7]], compliance=soft))
    w = world(tv.Particles(x, velocity=v), held, solver=tv.Jacobi(), substeps=80)

    def kinetic():
        return sum(np.array([(w.velocity[i] ** 2).sum() / 24 for i in parts]) for _ in range(12) if w.step(1 / 60))

    first = kinetic()
    w.run(1.6)
    np.testing.assert_allclose(kinetic() / first, 1.0, atol=0.09)
    assert w.last.clean
