"""Links from soft to rigid: against the NumPy prototype, in physical units, and at the extremes of compliance."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import case, order, rerun, rms, unprojected
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


@pytest.mark.parametrize("dim, iterations", [(2, 4), (3, 1)])
def test_kernels_agree_with_the_prototype(world, dim, iterations):
    x, v, mass, pairs, rest, alpha, damping = net(dim)
    g = np.array([0.5, -9.81, 1.0][:dim])
    w = np.where(np.arange(len(x)) < 2, 0.0, 1 / mass)
    v[:2] = 0
    plain = Prototype(x, v, w, pairs, rest, alpha, damping, g)
    links = tv.Distance(pairs, rest, compliance=alpha, damping=damping)
    made = world(
        tv.Particles(x, velocity=v, mass=mass, pinned=[0, 1]), [links, tv.Gravity(g)], substeps=10, iterations=iterations,
        precision="f64",
    )  # fmt: skip
    for _ in range(12):
        made.step(1 / 60)
        for _ in range(10):
            plain.substep(1 / 600, iterations)
        np.testing.assert_allclose(made.position, plain.x, atol=1e-10)
    np.testing.assert_array_equal(made.position[:2], x[:2])


def test_static_elongation_is_alpha_times_load(world):
    # Link k from the bottom carries k m g, so it stretches by alpha k m g, for any substeps and iterations that converge.
    c = case("R11_elastic_rope_N10_alpha1e-3")
    p, n = c["params"], c["params"]["links"]
    k = np.arange(n)
    loads = p["m"] * p["g"] * (n - k)
    depth = np.concatenate([[0.0], np.cumsum(p["rest"] + p["alpha"] * loads * (1 + 1e-3))])
    link = tv.Distance(np.stack([k, k + 1], axis=1), p["rest"], compliance=p["alpha"])
    start = tv.Particles(np.stack([np.zeros(n + 1), -depth], axis=1), mass=p["m"], pinned=[0])
    w = world(start, [tv.Gravity(p["g"]), link, tv.Drag(10.0)], precision="f64")
    for substeps, iterations in ((20, 4), (20, 16), (50, 4)):
        rerun(w, 4.0, substeps=substeps, iterations=iterations)
        total = -w.position[-1, 1] - n * p["rest"]
        assert total == pytest.approx(c["values"]["total_elongation"], rel=1e-8)
        np.testing.assert_allclose(link.load, loads, rtol=1e-8)


def test_compliance_from_1e_minus_12_to_1e12(world):
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
        w = world(start, [tv.Gravity(g), link.copy(), tv.Drag(c)], substeps=20, iterations=4, precision=precision)
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
                np.testing.assert_allclose(w.features[1].load, g, rtol=1e-9)


def test_every_compliance_is_stable(world):
    # Kinetic energy never exceeds the work of gravity, with one Jacobi pass, from rigid to soft. One chain per compliance.
    n, alphas = 21, (0.0, 1e-12, 1e-9, 1e-6, 1e-5, 1e-4, 1e-3, 1e-1, 1e12)
    x = np.concatenate([np.stack([np.arange(n) * 0.05, np.full(n, 10.0 * c)], axis=1) for c in range(len(alphas))])
    k = np.concatenate([np.arange(n - 1) + n * c for c in range(len(alphas))])
    link = tv.Distance(np.stack([k, k + 1], axis=1), compliance=np.repeat(alphas, n - 1))
    start = tv.Particles(x, mass=0.1, pinned=np.arange(len(alphas)) * n)
    w = world(start, [tv.Gravity(9.81), link], substeps=4, solver=tv.Jacobi())
    for _ in range(240):
        w.step(1 / 60)
        supplied = 0.1 * 9.81 * (x - w.position)[:, 1].reshape(-1, n).sum(axis=1)
        speed = w._runner.memory.state()["displacement"].astype(np.float64) * 240
        kinetic = 0.05 * (speed**2).sum(axis=1).reshape(-1, n).sum(axis=1)
        assert (kinetic <= supplied * 1.001 + 1e-4).all()


def test_dashpot(world):
    # x'' = -(k x + c x') / m: x = x0 e^(-z w t) (cos + z w / wd sin), second order.
    p, want = case("R05_damped_oscillator")["params"], case("R05_damped_oscillator")["values"]
    link = tv.Distance([[0, 1]], rest=5.0, compliance=1 / p["k"], damping=p["c"])
    start = tv.Particles([[0.0, 0], [5 + p["x0"], 0]], mass=[1, p["m"]], pinned=[0])
    w = world(start, [link], iterations=3, precision="f64")
    errors = [abs(rerun(w, p["T"], substeps=n).position[1, 0] - 5 - want["x_T"]) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1 and errors[1] <= 1e-4


def test_compliance_does_not_damp(world):
    # R04b: backward Euler (XPBD) would keep 0.7 % of the amplitude in these 1000 steps.
    link = tv.Distance([[0, 1]], rest=2.0, compliance=0.01)
    w = world(tv.Particles([[0.0, 0], [2.5, 0]], pinned=[0]), [link], substeps=10, iterations=3, precision="f64")
    largest = 0.0
    for k in range(100):
        w.step(0.1)
        if k >= 90:
            largest = max(largest, abs(w.position[1, 0] - 2))
    assert w.last.energy == pytest.approx(0.5 * 100 * 0.5**2, rel=5e-3) and largest <= 0.5 * (1 + 1e-2)


def test_ropes_pull_and_spacers_push(world):
    # The end of a rope falls freely until the rope is taut, then stops. From then on it swings like the end of a rigid link.
    rope = tv.Rope([[0, 1]], length=1.0)
    w = world(tv.Particles([[0, 0], [0.0, -0.5]], pinned=[0]), [tv.Gravity(9.81), rope], substeps=100, precision="f64")
    w.run(0.3, dt=0.01)
    assert w.position[1, 1] == pytest.approx(-0.5 - 9.81 * 0.3**2 / 2, rel=1e-12)
    w.run(1.0, dt=0.01)
    assert w.position[1, 1] == pytest.approx(-1.0, abs=1e-6) and rope.load[0] == pytest.approx(9.81, rel=1e-3)
    swings = [
        world(tv.Particles([[0, 0], [1.0, 0]], pinned=[0]), [tv.Gravity(9.81), f], substeps=20, precision="f64")
        for f in (tv.Rope([[0, 1]]), tv.Distance([[0, 1]]))
    ]
    for s in swings:
        s.run(1.0)
    np.testing.assert_allclose(swings[0].position, swings[1].position, atol=1e-9)
    spacer = tv.Spacer([[0, 1]], 1.0)
    w = world(tv.Particles([[0, 0], [0.0, 2.0]], pinned=[0]), [tv.Gravity(9.81), spacer], substeps=50, precision="f64")
    w.run(2.0)
    assert w.position[1, 1] == pytest.approx(1.0, abs=1e-5) and spacer.load[0] == pytest.approx(-9.81, rel=1e-3)
    # A soft rope is a bungee: released at its length, the end falls to twice the static stretch and comes back.
    w = world(
        tv.Particles([[0, 0], [0.0, -1.0]], pinned=[0]), [tv.Gravity(9.81), tv.Rope([[0, 1]], 1.0, compliance=0.01)], substeps=40,
        iterations=4, precision="f64",
    )  # fmt: skip
    low = min(float(w.step(1 / 60) and w.position[1, 1]) for _ in range(120))
    assert low == pytest.approx(-1 - 2 * 9.81 * 0.01, rel=2e-3)
    assert w.last.energy == pytest.approx(-9.81, rel=1e-3)


def test_rest_lengths_are_live(world):
    link = tv.Distance([[0, 1]])
    w = world(tv.Particles([[0, 0], [0, -1.0]], pinned=[0]), [tv.Gravity(9.81), link, tv.Drag(20.0)], precision="f64")
    w.run(0.5)
    link.rest = 0.5
    w.run(2.0)
    assert w.position[1, 1] == pytest.approx(-0.5, abs=1e-4)
    with pytest.raises(ValueError, match=r"Distance: rest\[0\] = -1"):
        link.rest = -1


def test_redundant_links(world):
    # Row 22: a rope of ten links, and one that has each link twice, both relaxed. They move alike, since mass splitting counts
    # both copies. At rest both are the catenary R10b, and each copy bears half of the tension.
    n, v = 10, case("R10b_discrete_catenary_N10")["values"]
    t, k = np.linspace(0, 1, n + 1), np.arange(n)
    rope = np.stack([6 * t, -4 * (1 - np.abs(2 * t - 1))], axis=1)
    pairs = np.stack([k, k + 1], axis=1)
    with pytest.warns(UserWarning, match="duplicates") as said:
        links = tv.Distance(np.concatenate([pairs, pairs + n + 1, pairs + n + 1]), 10 / n)
    assert said[0].filename == __file__  # the warning names the caller's line
    start = tv.Particles(np.concatenate([rope, rope]), mass=0.1, pinned=[0, n, n + 1, 2 * n + 1])
    w = world(start, [tv.Gravity(9.81), links, tv.Drag(4.0)], iterations=16, precision="f64", solver=tv.Jacobi())
    for seconds in (0.5, 7.5):
        w.run(seconds)
        np.testing.assert_allclose(w.position[: n + 1], w.position[n + 1 :], atol=1e-10)
        single, first, second = links.load.reshape(3, n)
        np.testing.assert_allclose(first, single / 2, rtol=1e-6)
        np.testing.assert_array_equal(first, second)
    assert -w.position[:, 1].min() == pytest.approx(v["sag"], rel=1e-5)
    assert single[0] == pytest.approx(v["end_link_tension_over_mg"] * 0.1 * 9.81, rel=1e-5)


def test_contradictory_links(world):
    # Row 21: a triangle 1, 1, 3 cannot close. Relaxed, it settles on the compromise, and its oscillation decays.
    links = tv.Distance([[0, 1], [1, 2], [0, 2]], [1.0, 1.0, 3.0])
    w = unprojected(world(tv.Particles([[0.0, 0], [1, 0.1], [2.2, 0]]), [links], substeps=50, precision="f64"))
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


def test_over_constrained_bodies(world):
    # Row 23: the racket S05 held by all 15 distances of its six masses, and ten particles held by all 45. The discrete angular
    # momentum sum m x_(n-1) x x_n is constant to rounding for any number of passes; the racket tumbles with order 2.
    c = case("S05_tennis_racket")
    racket = np.repeat(np.diag(c["params"]["half_axes"]), 2, axis=0) * np.array([1, -1] * 3)[:, None]
    ten = np.random.default_rng(3).normal(size=(10, 3))
    ten -= ten.mean(axis=0)
    bodies = (slice(0, 6), slice(6, 16))
    i, j = (np.concatenate([np.triu_indices(6, 1)[k], np.triu_indices(10, 1)[k] + 6]) for k in range(2))
    v = np.concatenate([np.cross(c["params"]["omega0_body"], racket), np.cross([0.0, 0.0, 1.0], ten)])
    start = tv.Particles(np.concatenate([racket, ten]), velocity=v)
    w = world(start, [tv.Distance(np.stack([i, j], axis=1))], precision="f64", solver=tv.Jacobi())
    want = [c["values"]["t2.0"][f"particle{k}_xyz"] for k in (1, 3)]
    for iterations in (1, 20):
        errors = [rms(rerun(w, 2.0, substeps=n, iterations=iterations).position[[0, 2]], want) for n in (10, 20, 40)]
        assert 1.9 <= order(errors) <= 2.1 and errors[1] <= (1e-4 if iterations > 1 else 3e-4)
        rerun(w, 1 / 60, substeps=20)
        spins = []
        for _ in range(120):
            report = w.step(1 / 60)
            s = w._runner.memory.state()
            turn = np.cross(s["position"], s["displacement"]) * 1200
            spins.append([turn[body].sum(axis=0) for body in bodies])
        assert np.ptp(spins, axis=0).max() <= 1e-13 * np.linalg.norm(spins[0])
        assert report.clean and report.residual <= (1e-7 if iterations > 1 else 1e-4)


def test_a_thousand_links_on_one_particle(world):
    # Row 24: the hub of a star, with relaxed links.
    a = 2 * np.pi * tv.golden(np.arange(1000))
    star = np.concatenate([[[0.0, 0.0]], np.stack([np.cos(a), np.sin(a)], axis=1)])
    spokes = np.stack([np.zeros(1000, dtype=int), np.arange(1, 1001)], axis=1)
    v = np.random.default_rng(3).normal(size=(1001, 2))
    w = world(tv.Particles(star, velocity=v), [tv.Distance(spokes)], precision="f64", solver=tv.Jacobi())
    report = w.run(5.0)
    assert np.isfinite(w.position).all() and report.energy <= 0.5 * (v**2).sum() * 1.01 and w.last.residual < 0.1


def test_the_energy_of_springs_is_a_number_where_what_is_left_underflows(world):
    # A rigid link keeps a spring at its length. At h = 1e-6 s the spring's violation times h^2 is so small that it is 0 in f32.
    x = np.array([[0.0, 0.0, 0.0], [0.3612324426117109, 0.29591168792099837, 0.24240272111714103]])
    v = np.array([[0.1257302210933933, -0.1321048632913019, 0.6404226504432821],
                  [0.10490011715303971, -0.535669373161111, 0.36159505490948474]])  # fmt: skip
    at_least = np.linalg.norm(x[1])
    features = [tv.Spacer([[0, 1]], [at_least]), tv.Spacer([[0, 1]], [at_least], compliance=1e-6)]
    w = world(tv.Particles(x, velocity=v, mass=[np.inf, 10.0]), features, substeps=1)
    energy = [w.step(1e-6).energy for _ in range(2)]
    np.testing.assert_allclose(energy, 5.0 * np.sum(np.square(v[1])), rtol=0.1)


def test_what_is_broken_turns_nothing(world):
    # All links of a rope are broken and its beads slide about: the directions of broken links must not count as turned.
    n, rng = 12, np.random.default_rng(0)
    links = tv.Distance(np.stack([np.arange(n - 1), np.arange(1, n)], axis=1), break_at=1e-3)
    start = tv.Particles([[0.1 * k, 1.0] for k in range(n)], radius=0.03, velocity=rng.normal(0, 0.3, (n, 2)))
    w = world(start, [tv.Gravity((3.0, -9.81)), links, tv.Box((-0.2, 0), (1.4, 2), friction=0.1)], solver=tv.Direct())
    w.run(0.5)
    assert links.broken.all()
    assert all(w.step(1 / 60).turn == 0 for _ in range(60))


def test_ends_that_are_in_one_place_but_for_rounding(world):
    # 0.1 + 0.2 and 0.3: the violation of a link of length 0 is relative to the size of the scene, not to 5e-17 m.
    told = []
    for at in (0.3, 0.1 + 0.2):
        start = tv.Particles([[0, 0], [0.3, 0], [at, 0], [0.6, 0]], pinned=[0])
        joint = tv.Distance([[1, 2]], rest=0.0)
        w = world(start, [tv.Gravity(9.81), tv.Distance([[0, 1], [2, 3]]), joint], substeps=20, precision="f64")
        told.append(w.run(0.5).residual)
    assert told[0] == pytest.approx(told[1], rel=1e-3) and told[1] < 1e-3
