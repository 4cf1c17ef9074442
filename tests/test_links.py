"""Links from soft to rigid, against the NumPy prototype, and twice. Extremes are rows of tiverlet stress."""

import numpy as np
import pytest

import tiverlet as tv

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


def test_links_that_are_given_twice_with_different_lengths_contradict_each_other():
    for kind, words in ((tv.Distance, "rigid ones contradict each other"), (tv.Rope, "the tightest holds")):
        with pytest.warns(UserWarning, match=f"Their rest values differ: {words}"):
            kind([(0, 1), (1, 0)], [1.0, 2.0])
        with pytest.warns(UserWarning, match="the same result where rigid"):
            kind([(0, 1), (1, 0)], 1.0)


def test_residuals_of_links_without_length_do_not_depend_on_rounding(world):
    # 0.1 + 0.2 and 0.3: the violation of a link of length 0 is relative to the size of the scene, not to 5e-17 m.
    told = []
    for at in (0.3, 0.1 + 0.2):
        start = tv.Particles([[0, 0], [0.3, 0], [at, 0], [0.6, 0]], pinned=[0])
        joint = tv.Distance([[1, 2]], rest=0.0)
        w = world(start, [tv.Gravity(9.81), tv.Distance([[0, 1], [2, 3]]), joint], substeps=20, precision="f64")
        told.append(w.run(0.5).residual)
    assert told[0] == pytest.approx(told[1], rel=1e-3) and told[1] < 1e-3
