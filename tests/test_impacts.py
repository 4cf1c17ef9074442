"""Restitution and friction against closed forms, between particles and on walls, in 2D and 3D, for any step."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import case


def discs(
    world, x, v, mass=1.0, e=(1.0, 0.0), group=0, radius=0.5, g=0.0, friction=(), lower=-1e9, upper=1e9, bouncy=1.0, most=1.0,
    **settings,
):  # fmt: skip
    """Build a world of discs or spheres with friction and restitution for up to five groups, gravity, and near or far walls.

    One fixed particle of each group lies far away, masses differ at least by rounding, and coefficients are assigned: worlds of
    one dimension and precision share kernels. most: the largest restitution, which is of the structure. Impacts are in turn above
    0.97, and with most=0 nothing bounces.
    """
    n, dim = x.shape
    far = 1e3 + 10.0 * np.arange(5)[:, None] * np.ones(dim)
    start = tv.Particles(
        np.concatenate([x, far]), velocity=np.concatenate([v, 0 * far]), radius=radius,
        mass=np.r_[mass * np.where(np.arange(n) == n - 1, 1 + 2e-16, 1.0), np.full(5, np.inf)],
        group=np.r_[np.broadcast_to(group, n), np.arange(5)],
    )  # fmt: skip
    every = [(k, k) for k in range(5)]
    contact = tv.Contact(friction=dict.fromkeys(every, 0.5), restitution=dict.fromkeys(every, most) if most else 0.0, events=True)
    walls = tv.Box(np.broadcast_to(lower, dim), np.broadcast_to(upper, dim), friction=0.5, restitution=most, events=True)
    w = world(start, [tv.Gravity(g), contact, walls], **({"precision": "f64"} | settings))
    contact.friction = dict.fromkeys(every, 0.0) | dict(zip(every, friction, strict=False))
    walls.friction = 0.0
    if most:
        contact.restitution = dict.fromkeys(every, 0.0) | {(4, 4): most} | dict(zip(every, e, strict=False))
        walls.restitution = min(bouncy, most)
    return w


@pytest.mark.slow
def test_reported_impulses_are_changes_of_momentum(world):
    # The impulses of all substeps add up to (1 + e) u / (w1 + w2), and each equals the change of the disc's momentum. The same
    # holds for a fixed disc, and for a disc that throws the next one onto a third in the same substep.
    e, mass = np.repeat([0.0, 0.5, 1.0], 3), np.tile([[1.0, 1.0], [1.0, 1000.0], [np.inf, 2.0]], (3, 1))
    x = np.stack([np.c_[-0.6 + 0 * e, 3.0 * np.arange(9)], np.c_[0.55 + 0 * e, 3.0 * np.arange(9)]], axis=1)
    v, group = np.zeros((9, 2, 2)), np.repeat(np.arange(3), 6)
    v[:, 1, 0] = -20.0
    x = np.concatenate([x.reshape(-1, 2), [[5.0, 0.0], [6.001, 0.0], [7.002, 0.0]]])
    v = np.concatenate([v.reshape(-1, 2), [[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]])
    mass, group = np.r_[mass.ravel(), np.ones(3)], np.r_[group, 2, 2, 2]
    w = discs(world, x, v, mass, (0.0, 0.5, 1.0), group, substeps=1)
    total = np.zeros(26)
    for _ in range(20):
        before = w.velocity[:-5]
        w.step(1 / 240)
        found = w.contacts
        total += np.bincount(found.pairs[:, 0], weights=found.impulse, minlength=26)
        each = np.zeros((26, 2))
        for k, sign in ((0, 1), (1, -1)):
            np.add.at(each, found.pairs[:, k], sign * found.impulse[:, None] * found.normal)
        live = np.flatnonzero(np.isfinite(mass))
        np.testing.assert_allclose(each[live], mass[live, None] * (w.velocity[:-5] - before)[live], atol=1e-9)
    np.testing.assert_allclose(total[:18:2], (1 + e) * 20.0 / (1 / mass[:18]).reshape(9, 2).sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(total[18:20], 1.0, rtol=1e-9)


@pytest.mark.slow
def test_what_rests_does_not_bounce_where_the_substep_gets_shorter(world):
    # Displacements of what rests stand for -g h / 2 without what it leans on, which bounced where e h_old > h: up to g h_old / 2.
    # A disc lies on a fixed disc, or on a wall in a world without contacts.
    x, wall = np.array([[0.0, 0.1], [0.0, -0.1]]), tv.HalfSpace((0, 1), restitution=1.0)
    on_disc = discs(world, x, 0 * x, np.array([1.0, np.inf]), [1.0], radius=0.1, g=9.81)
    on_wall = world(tv.Particles(x[:1], radius=0.1), [tv.Gravity(9.81), wall], precision="f64")
    for w, surface, e in ((on_disc, None, 1.0), (on_wall, wall, 0.5), (on_wall, wall, 1.0)):
        if surface:
            surface.restitution = e
        w.position, w.velocity = w.particles.position, w.particles.velocity
        for w.substeps in (1, 1, 100, 3, 20, 2, 200, 1, 4000, 7, "auto", "auto", "auto"):
            report = w.step(1 / 60)
            assert report.clean and np.abs(w.velocity).max() < 1e-6 * 9.81 / 60, (e, w.substeps)
            np.testing.assert_allclose(w.position, w.particles.position, rtol=0, atol=1e-9)


@pytest.mark.parametrize("dim, precision, limit", [(2, "f64", 1e-12), pytest.param(3, "f32", 1e-4, marks=pytest.mark.slow)])
def test_what_bounces_on_pinned_particles_keeps_its_energy(world, dim, precision, limit):
    # Under gravity, E = v^2 / 2 + g y is kept for any substep where e = 1: for a particle that falls on a pinned one, flies to
    # and fro below another, or hops between two. Above the contact it is E e^(2 k) after k bounces, at
    # t0 (1 + 2 (e + ... + e^(k - 1))). Two particles that fall together and collide have the relative velocity -e u, and their
    # middle stays in free fall.
    g, e = 9.81, 0.8
    at = [  # group, x, y, speed upwards, whether it is pinned
        (0, 0, 0, 0, 1), (0, 0, 1.2, 0, 0), (1, 0, 0, 0, 1), (1, 0, 2.3, 0, 1), (1, 0, 1.1, 5, 0), (2, 0, 0, 0, 1),
        (2, 0, 1.2, 0, 0), (3, -0.7, 0, 0, 1), (3, 0.7, 0, 0, 1), (3, 0.02, 1.5, 0, 0), (4, 0, 0, 3, 0), (4, 0, 1.3, 0, 0),
    ]  # fmt: skip
    group, across, y, upwards, pinned = np.array(at, dtype=float).T
    x, v = np.zeros((12, dim)), np.zeros((12, dim))
    x[:, 0], x[:, 1], v[:, 1], mass = across + 10 * group, y, upwards, np.where(pinned, np.inf, 1.0)
    w = discs(world, x, v, mass, [1.0, 1.0, e, 1.0, e], group.astype(int), 0.5, g, precision=precision)
    start = w.particles
    t0 = np.sqrt(2 * 0.2 / g)
    met = t0 * (1 + 2 * np.cumsum(np.r_[0, e ** np.arange(1, 8)]))
    for substeps in (2, 7, 20):
        w.position, w.velocity, w.substeps, begin = start.position, start.velocity, substeps, w.time
        energy = (start.velocity**2).sum(axis=1) / 2 + g * start.position[:, 1]
        for _ in range(75):
            w.step(1 / 60)
            now, t = (w.velocity**2).sum(axis=1) / 2 + g * w.position[:, 1], w.time - begin
            kept = [1, 4, 9]
            np.testing.assert_allclose(now[kept], energy[kept], rtol=limit)
            if np.abs(t - met).min() > 1e-3 and t < met[-1]:
                np.testing.assert_allclose(now[6] - g, g * 0.2 * e ** (2 * (met < t).sum()), rtol=10 * limit)
        low, high = 10, 11
        t = w.time - begin
        assert w.velocity[low, 1] - w.velocity[high, 1] == pytest.approx(-3 * e, rel=10 * limit)
        assert w.position[[low, high], 1].mean() == pytest.approx(0.65 + 1.5 * t - g * t * t / 2, rel=10 * limit)


def test_newtons_cradle_lets_go_as_many_as_came(world):
    # R17: pair by pair, with a gap and touching. As many balls leave as came, with the whole speed; with e < 1 the last one takes
    # most, and energy is lost. A row of five for each gap, number of balls that come, and e.
    p, want = case("R17_newton_cradle")["params"], case("R17_newton_cradle")["values"]
    n, es = p["n"], (1.0, 0.9, 0.98, 0.999)
    rows = ((0.001, 1, 0), (0.001, 1, 1), (0.0, 1, 0), (0.0, 2, 0), (0.0, 1, 2), (0.0, 1, 3))
    x, v = np.zeros((len(rows), n, 2)), np.zeros((len(rows), n, 2))
    for k, (gap, some, _) in enumerate(rows):
        x[k, :, 0], x[k, :, 1] = np.arange(n) * (2 * p["r"] * (1 + 1e-14) + gap), k  # no overlap by rounding
        x[k, :some, 0] -= 0.1
        v[k, :some, 0] = 1.0
    w = discs(world, x.reshape(-1, 2), v.reshape(-1, 2), 1.0, es, np.repeat([e for *_, e in rows], n), p["r"])
    w.run(0.13)
    for (_gap, some, e), got in zip(rows, w.velocity[:-5, 0].reshape(len(rows), n), strict=True):
        assert got.sum() == pytest.approx(some, rel=1e-12)
        if e > 1:
            assert (got**2).sum() < 1.0 and got[4] > ((1 + es[e]) / 2) ** 4 and got[:4].max() < 1 - got[4]
        else:
            right = [0, 0, 0, 1, 1] if some == 2 else want["e0p9_v_final" if e else "v_final"]
            np.testing.assert_allclose(got, right, atol=1e-9)


@pytest.mark.parametrize(
    "dim, precision, g, limit", [(2, "f64", 10.0, 1e-12), pytest.param(3, "f32", 0.0, 1e-5, marks=pytest.mark.slow)]
)
def test_an_elastic_gas_keeps_its_energy(world, dim, precision, g, limit):
    # To rounding, also under gravity, as long as nothing is thrown farther in a substep than THROWN of a radius.
    k = np.arange(150)
    x = np.stack([k % 15 * 0.3 + 0.2, k // 15 * 0.3 + 0.2, 0 * k + 1.0], axis=1)[:, :dim]
    v = np.random.default_rng(0).normal(size=(150, dim))
    w = discs(world, x, v, 1.0, [1.0], 0, 0.1, g, lower=0.0, upper=4.7, substeps=4, precision=precision)

    def energy():
        return 0.5 * (w.velocity**2).sum() + g * w.position[:-5, 1].sum()

    before = energy()
    w.run(10.0)
    assert energy() == pytest.approx(before, rel=limit)


def by_events(x, v, mass, seconds):
    """Return where a few elastic balls of diameter 1 go, from impact to impact: |r + s u| = 1, s = c / (sqrt(b^2 - a c) - b)."""
    x, v = x.copy(), v.copy()
    while seconds > 0:
        following, pair = seconds, None
        for i, j in ((0, 1), (0, 2), (1, 2)):
            r, u = x[i] - x[j], v[i] - v[j]
            a, b, c = u @ u, r @ u, r @ r - 1
            if b < 0 and b * b > a * c and c / (np.sqrt(b * b - a * c) - b) < following:
                following, pair = c / (np.sqrt(b * b - a * c) - b), (i, j)
        x, seconds = x + following * v, seconds - following
        if pair:
            i, j = pair
            blow = 2 / (1 / mass[i] + 1 / mass[j]) * (v[i] - v[j]) @ (x[i] - x[j]) * (x[i] - x[j])
            v[i], v[j] = v[i] - blow / mass[i], v[j] + blow / mass[j]
    return x, v


def test_what_is_struck_by_two_in_one_substep_goes_from_impact_to_impact(world):
    # Two discs hit a third, which is thrown from one to the other, up to four impacts in one substep of 1/240 s. Each impact is
    # between two discs at its own time and place, so the result is exact.
    rng = np.random.default_rng(5)
    sides = rng.normal(size=(100, 2, 2))
    sides[:, 1] -= 1.2 * sides[:, 0]
    sides /= np.linalg.norm(sides, axis=2, keepdims=True)
    x, v, mass = np.zeros((100, 3, 2)), rng.normal(size=(100, 3, 2)), rng.uniform(0.5, 1.5, size=(100, 3))
    x[:, 0, 1] = 4.0 * np.arange(100)
    x[:, 1:] = x[:, :1] + sides * rng.uniform(1.0, 1.04, size=(100, 2, 1))
    v[:, 1:] -= sides * rng.uniform(10, 20, size=(100, 2, 1))
    # Only where both would be inside the third at the end: an impact that another one causes is found in the next substep.
    there = x + v / 240
    struck = (np.linalg.norm(there[:, 1:] - there[:, :1], axis=2) < 1).all(axis=1)
    keep = struck & (np.linalg.norm(x[:, 1] - x[:, 2], axis=1) > 1.5)
    x, v, mass = x[keep], v[keep], mass[keep]
    assert len(x) > 50
    w = discs(world, x.reshape(-1, 2), v.reshape(-1, 2), mass.ravel(), substeps=1)
    w.step(1 / 240)
    ends = [by_events(*three, 1 / 240) for three in zip(x, v, mass, strict=True)]
    np.testing.assert_allclose(w.position[:-5], np.concatenate([x for x, _ in ends]), atol=1e-12)
    np.testing.assert_allclose(w.velocity[:-5], np.concatenate([v for _, v in ends]), atol=1e-10)


def test_a_disc_on_a_fixed_disc_slips_above_its_coefficient(world):
    # Row 59: a disc on a fixed disc, on the slope of its tangent. Below the threshold it stays; mu = 0 slides, mu = 1e6 sticks.
    a = np.radians(20.0)
    top = np.array([np.sin(a), np.cos(a)])
    rows = ((0.0, False), (np.tan(a) * 0.95, False), (np.tan(a) * 1.05, True), (1e6, True))
    x = np.array([[[10.0 * k, 0.0], top + [10.0 * k, 0]] for k in range(4)]).reshape(-1, 2)
    group, frictions = np.repeat(np.arange(4), 2), [mu for mu, _ in rows]
    w = discs(world, x, 0 * x, np.tile([np.inf, 1.0], 4), np.zeros(4), group, g=9.81, friction=frictions)
    w.run(0.5)
    for k, (mu, stays) in enumerate(rows):
        assert (np.hypot(*(w.position[:-5] - x)[2 * k + 1]) < 1e-9) == stays, mu
    # A disc that stays presses on the fixed one with m g cos, though it does not overlap it by then.
    held = w.contacts.impulse[np.isin(w.contacts.pairs[:, 0], [4, 6])]
    np.testing.assert_allclose(held * 60 * w.substeps, 9.81 * np.cos(a), rtol=1e-9)


@pytest.mark.slow
def test_what_is_driven_strikes_as_an_infinite_mass(world):
    # A racket at V hits a ball at rest, which leaves at (1 + e) V: the racket acts like an infinite mass.
    e, V, pin, beads = 0.5, 2.0, tv.Pin([0]), tv.Path([2], [[0.0, 5], [5, 5]], smooth=False, speed=2.0)
    x = [[0.0, 0], [0.7, 0], [0.0, 5], [0.7, 5]]
    start = tv.Particles(x, radius=0.3, mass=[1, 2, 1, 3])
    w = world(start, [pin, beads, tv.Contact(restitution=e)], precision="f64", substeps=4)
    for k in range(12):
        pin.target = [[V * (k + 1) / 60, 0.0]]
        w.step(1 / 60)
    np.testing.assert_allclose(w.velocity[[1, 3], 0], (1 + e) * V, rtol=1e-12)
