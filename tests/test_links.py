"""Links from soft to rigid: against the NumPy prototype, at the extremes of compliance, twice and in contradiction."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import unprojected
from .prototype import Prototype


def net(dim, seed=0):
    """Return a small random net: masses of 1 to 100, static corners, links from rigid to soft."""
    rng = np.random.default_rng(seed)
    n = 12
    x = rng.normal(size=(n, dim))
    pairs = np.array([(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < 0.35])
    mass = np.exp(rng.uniform(0, np.log(100), n))
    off = rng.uniform(0.98, 1.02, len(pairs))
    alpha = np.where(rng.random(len(pairs)) < 0.4, 0.0, 10.0 ** rng.uniform(-9, -1, len(pairs)))
    rest = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1) * np.where(alpha > 0, off, 1.0)
    damping = np.where(rng.random(len(pairs)) < 0.5, 0.0, rng.uniform(0, 3, len(pairs)))
    return x, rng.normal(size=(n, dim)), mass, pairs, rest, alpha, damping


def linked(world, start, links, g=0.0, drag=0.0, **settings):
    """Return a world of links with gravity and drag: few structures for all tests, as tests differ in numbers."""
    return world(start, [links, tv.Gravity(g), tv.Drag(drag)], precision="f64", solver=tv.Jacobi(), **settings)


@pytest.mark.parametrize("dim, iterations", [(2, 4), (3, 1)])
def test_kernels_agree_with_the_prototype(world, dim, iterations):
    x, v, mass, pairs, rest, alpha, damping = net(dim)
    g = np.array([0.5, -9.81, 1.0][:dim])
    w = np.where(np.arange(len(x)) < 2, 0.0, 1 / mass)
    v[:2] = 0
    plain = Prototype(x, v, w, pairs, rest, alpha, damping, g)
    links = tv.Distance(pairs, rest, compliance=alpha, damping=damping)
    made = linked(world, tv.Particles(x, velocity=v, mass=mass, pinned=[0, 1]), links, g, substeps=10, iterations=iterations)
    for _ in range(12):
        made.step(1 / 60)
        for _ in range(10):
            plain.substep(1 / 600, iterations)
        np.testing.assert_allclose(made.position, plain.x, atol=1e-10)
    np.testing.assert_array_equal(made.position[:2], x[:2])


def test_springs_stretch_by_their_compliance_from_1e_minus_12_to_1e12(world):
    # Rows 8 and 9: a link under a load of F = 9.81 N stretches by s = alpha F. Released at its rest length it gets there by
    # s'' = g - s / alpha - c s', and the softest links fall freely. One pendulum per compliance.
    alpha = np.array([0.0, *10.0 ** np.arange(-12, 13)])
    m, g, c, t = len(alpha), 9.81, 20.0, 2.0
    x = np.zeros((2 * m, 2))
    x[:, 0] = np.tile(np.arange(m), 2)
    x[m:, 1] = -1.0
    link = tv.Distance(np.stack([np.arange(m), m + np.arange(m)], axis=1), rest=1.0, compliance=alpha)
    start = tv.Particles(x, pinned=np.arange(m))
    soft = (alpha > 1e-2) & (alpha < 1e5)  # 1e-2 is damped critically; from 1e5 on the spring adds less than 5e-7
    root = np.sqrt(c * c / 4 - 1 / alpha[soft])
    fast, slow = -c / 2 - root, -c / 2 + root
    want = g * alpha
    want[soft] *= 1 + (fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (slow - fast)
    want[alpha >= 1e5] = g / c * (t + np.expm1(-c * t) / c)
    for precision in ("f64", "f32"):
        features = [link.copy(), tv.Gravity(g), tv.Drag(c)]
        w = world(start, features, substeps=20, iterations=4, precision=precision, solver=tv.Jacobi())
        w.run(t)
        stretch = -w.position[m:, 1] - 1.0
        assert np.isfinite(w.position).all() and not w.last.flags and (np.diff(stretch) >= -2e-7).all()
        # In f32 a position near 1 m stops following once d < ulp / 2 = 6e-8: speeds below 7e-5 m/s, drag below 1.4e-3 N.
        rtol, atol = (1e-6, 1e-12) if precision == "f64" else (1.5e-3 / g, 4e-7)
        np.testing.assert_allclose(stretch, want, rtol=rtol, atol=atol)
        if precision == "f64":  # equilibrium persists for any effort, to the last digit of a coordinate of 1 m
            hung = x.copy()
            hung[m:, 1] -= g * alpha
            for substeps, iterations in ((20, 4), (20, 1), (7, 1), (50, 2)):
                w.velocity, w.position = 0 * x, hung
                w.substeps, w.iterations = substeps, iterations
                w.run(t)
                np.testing.assert_allclose(-w.position[m:, 1] - 1.0, g * alpha, rtol=1e-6, atol=2.3e-16)
                np.testing.assert_allclose(w.features[0].load, g, rtol=1e-9)


def test_ropes_pull_and_spacers_push(world):
    # Side by side: the end of a rope falls freely until the rope is taut, then stops; one that starts taut swings like the end of
    # a rigid link; a spacer stops what falls on it. A soft rope is a bungee: released at its length, the end falls to twice the
    # static stretch and comes back.
    x = [[0, 0], [0.0, -0.5], [5, 0], [6.0, 0], [10, 0], [11.0, 0], [15, 0], [15.0, 2], [20, 0], [20.0, -1]]
    rope = tv.Rope([[0, 1], [2, 3], [8, 9]], 1.0, compliance=[0.0, 0.0, 0.01])
    spacer, link, g = tv.Spacer([[6, 7]], 1.0), tv.Distance([[4, 5]]), 9.81
    start = tv.Particles(x, pinned=[0, 2, 4, 6, 8])
    w = world(start, [tv.Gravity(g), rope, spacer, link], substeps=20, iterations=4, precision="f64", solver=tv.Jacobi())
    low = 0.0
    for frame in range(1, 201):
        w.step(0.01)
        y, v = w.position, w.velocity
        low = min(low, y[9, 1])
        if frame == 30:
            assert y[1, 1] == pytest.approx(-0.5 - g * 0.3**2 / 2, rel=1e-12) and rope.load[0] == 0
    assert y[1, 1] == pytest.approx(-1.0, abs=1e-6) and rope.load[0] == pytest.approx(g, rel=1e-3)
    np.testing.assert_allclose(y[3] - [5, 0], y[5] - [10, 0], atol=1e-9)
    assert y[7, 1] == pytest.approx(1.0, abs=1e-5) and spacer.load[0] == pytest.approx(-g, rel=1e-3)
    stretch = max(-1.0 - y[9, 1], 0.0)
    assert low == pytest.approx(-1 - 2 * g * 0.01, rel=2e-3)
    assert v[9, 1] ** 2 / 2 + g * y[9, 1] + stretch**2 / 0.02 == pytest.approx(-g, rel=1e-3)


def test_each_of_two_equal_links_bears_half_of_the_load(world):
    # Row 22: a rope of ten links, and one that has each link twice, both relaxed. They move alike, since mass splitting counts
    # both copies.
    n = 10
    x = np.stack([np.linspace(0, 6, n + 1), np.zeros(n + 1)], axis=1)
    pairs = np.stack([np.arange(n), np.arange(n) + 1], axis=1)
    with pytest.warns(UserWarning, match="duplicates") as said:
        links = tv.Distance(np.concatenate([pairs, pairs + n + 1, pairs + n + 1]), 1.0)
    assert said[0].filename == __file__  # the warning names the caller's line
    start = tv.Particles(np.concatenate([x, x]), mass=0.1, pinned=[0, n, n + 1, 2 * n + 1])
    w = linked(world, start, links, 9.81, 4.0, iterations=16)
    w.run(0.5)
    np.testing.assert_allclose(w.position[: n + 1], w.position[n + 1 :], atol=1e-10)
    single, first, second = links.load.reshape(3, n)
    np.testing.assert_allclose(first, single / 2, rtol=1e-6)
    np.testing.assert_array_equal(first, second)


def test_contradictory_links_meet_in_a_compromise(world):
    # Row 21: a triangle 1, 1, 3 cannot close. Relaxed, it settles on the compromise, and its oscillation decays.
    links = tv.Distance([[0, 1], [1, 2], [0, 2]], [1.0, 1.0, 3.0])
    w = unprojected(linked(world, tv.Particles([[0.0, 0], [1, 0.1], [2.2, 0]]), links, substeps=50))
    energies, size = [], 0.0
    for _ in range(2000):  # 1e5 substeps
        report = w.step(1 / 60)
        energies.append(report.energy)
        size = max(size, np.ptp(w.position))
    largest = np.reshape(energies, (10, 200)).max(axis=1)
    assert (np.diff(largest) < 0).all() and largest[-1] < 0.02 * largest[0] and size < 3.0
    # Least squares with equal weights: all three lie on a line with lengths 4/3, 4/3, 8/3; each link is off by 1/3.
    assert report.residual == pytest.approx(1 / 3, abs=1e-4)
    assert tv.measure.strain(w, links.indices, [1, 1, 3]) == pytest.approx([1 / 3, 1 / 3, -1 / 9], abs=1e-4)


def test_residuals_of_links_without_length_do_not_depend_on_rounding(world):
    # 0.1 + 0.2 and 0.3: the violation of a link of length 0 is relative to the size of the scene, not to 5e-17 m.
    told = []
    for at in (0.3, 0.1 + 0.2):
        start = tv.Particles([[0, 0], [0.3, 0], [at, 0], [0.6, 0]], pinned=[0])
        joint = tv.Distance([[1, 2]], rest=0.0)
        w = world(start, [tv.Gravity(9.81), tv.Distance([[0, 1], [2, 3]]), joint], substeps=20, precision="f64")
        told.append(w.run(0.5).residual)
    assert told[0] == pytest.approx(told[1], rel=1e-3) and told[1] < 1e-3
