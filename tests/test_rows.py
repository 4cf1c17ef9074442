"""Contacts as rows, see tiverlet/contact/rows.py: what rests, lands, and bounces as a whole."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.impulses import LEFT, MET
from tiverlet.contact.limits import BEYOND, SLOP

from .test_impacts import discs

G, R = 10.0, 0.1


def lattice(*counts):
    """Return places of touching discs on a floor at y = 0: so many along each axis, a millionth apart."""
    return R * (1 + 2 * (1 + 1e-6) * np.array(list(np.ndindex(*counts))))


def dropped(world, x, v=0.0, e=(), friction=0.0, **settings):
    """Return a world of discs above a floor at y = 0: of two structures, with restitution up to 0.97, and without.

    e: restitution of pairs and of the floor.
    """
    rough = {"friction": [friction], "lower": (-99.0, 0.0), "most": 0.9 if e else 0.0, "bouncy": e[1] if e else 0.0}
    w = discs(world, x, np.zeros_like(x) + v, e=e[:1], **({"radius": R, "g": G, "substeps": 8} | rough | settings))
    w.features[2].friction = friction
    return w


def high(w):
    """Return the heights of the discs [m]."""
    return w.position[:-5, 1]


@pytest.mark.slow
@pytest.mark.parametrize("e", [0.0, 0.5])
def test_what_meets_at_the_end_of_a_substep_bounces(world, e):
    # 400 pairs that close at 1.5 to 4.8 m/s and meet after 1 to 40 substeps, to rounding: some of them a little later.
    k, h, y = np.arange(400), 1 / 600, 1 + 0.5 * np.arange(400)
    left, right = 1 + k // 40 * 0.37, np.full(400, -0.5)
    gap = (left - right) * h * (k % 40 + 1)
    x, v = np.stack([np.r_[-0.1 - gap / 2, 0.1 + gap / 2], np.r_[y, y]], axis=1), np.r_[left, right]
    w = dropped(world, x, v[:, None] * (1, 0), (e, 0.0), g=0.0, substeps=10)
    w.run(0.1)
    v = w.velocity[:-5, 0]
    np.testing.assert_allclose((v[400:] - v[:400]) / (left - right), e, atol=1e-4)  # 13 and 15 stuck if those came to rest


@pytest.mark.parametrize(
    "pair, wall, friction",
    [(0.5, 0.5, 0.0), (0.8, 0.8, 0.0), (0.5, 0.5, 0.5), (0.0, 0.5, 0.0), (0.5, 0, 0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.5)],
)
def test_what_touches_bounces_as_a_whole_and_stays_where_it_lands(world, pair, wall, friction):
    # All contacts are struck at the same time, and each is left with -e times its velocity: the floor with e v, and pairs, which
    # did not approach, with 0. So the center of mass comes back to e^2 of its fall. It is off by the overlap (1 + e) v h that the
    # lowest pair has by the end of the substep, and by what the passes leave, less than 1 %; without restitution by less than
    # 2e-3. Side by side: a disc, columns and a block.
    fall, v, counts = 1.0, np.sqrt(2 * G), ((1, 1), (1, 6), (1, 40), (6, 6))
    blocks = [lattice(*some) + (5.0 * k, fall) for k, some in enumerate(counts)]
    ends = np.cumsum([len(x) for x in blocks])
    w = dropped(world, np.concatenate(blocks), 0.0, (pair, wall) if pair or wall else (), friction)
    for substeps in (4, 30):
        w.position, w.velocity, w.substeps = w.particles.position, w.particles.velocity, substeps
        w.run(v / G + 1 / 60)
        heights = np.array([high(w) for _ in range(10 + int(60 * wall * v / G)) if w.step(1 / 60)])
        off = (1 + wall) * v / (60 * substeps) + 0.01 * fall
        for (_, rows), end, x in zip(counts, ends, blocks, strict=True):
            y = heights[:, end - len(x) : end]
            assert y.mean(axis=1).max() - R * rows == pytest.approx(wall**2 * fall, abs=off), (rows, substeps)
            assert y.max() - R * (2 * rows - 1) < 1.2 * wall**2 * fall + off, (rows, substeps)
            assert y.min() > R - off  # as deep as the overlap that is taken back
            if not pair and not wall and rows < 40:
                assert y.mean(axis=1).max() < R * rows + 2e-3 * fall, (rows, substeps)
                assert y.mean(axis=1).min() > 0.9 * R * rows, (rows, substeps)  # it is not pressed into the floor


def test_what_does_not_touch_bounces_one_after_the_other(world):
    # A light disc a little above a heavy one: the floor throws the heavy one back with e v, and this one the light one with
    # u = (1 + e)^2 v M / (M + m) - v, several times as fast as both came.
    e, heavy, v, gap = 0.9, 10.0, np.sqrt(2 * G), 0.004
    w = dropped(world, np.array([(0, R + 1), (0, 3 * R + gap + 1)]), e=(e, e), mass=np.array([heavy, 1.0]), substeps=200)
    w.run(v / G + 0.02)
    u = (1 + e) ** 2 * v * heavy / (heavy + 1) - v
    assert w.velocity[1, 1] + 0.02 * G == pytest.approx(u, rel=0.01)


def test_what_falls_on_something_lighter_stays_there(world):
    # Without restitution nothing is thrown back, whatever lies between a disc and the floor: by less than a fifth of the height.
    # Masses from the floor up; the last disc of a column falls by 0.35 to 0.65 m.
    columns: list[list[float]] = 3 * [[1.0, 2.5], [1.0, 10.0], [1.0, 100.0], [1.0] * 10 + [10.0], [1.0] * 3 + [30.0]]
    falls, x = np.repeat(np.linspace(0.35, 0.65, 3), 5), []
    for k, (mass, fall) in enumerate(zip(columns, falls, strict=True)):
        x.append(lattice(1, len(mass)) + (5.0 * k, 0.0))
        x[-1][-1, 1] += fall
    w, last = dropped(world, np.concatenate(x), mass=np.concatenate(columns)), np.cumsum([len(mass) for mass in columns]) - 1
    rest = w.particles.position[last, 1] - falls
    tops = np.array([high(w)[last] - rest for _ in range(75) if w.step(1 / 60)])
    for top, fall, mass in zip(tops.T, falls, columns, strict=True):
        assert top[top.argmin() :].max() <= 0.2 * fall, (mass, fall)
    # What is sent off is not held back: it rises by v^2 / 2 g.
    v = w.velocity.copy()
    v[last, 1] = 2.0
    w.velocity, low = v, high(w)[last]
    tops = np.max([high(w)[last] for _ in range(30) if w.step(1 / 60)], axis=0)
    np.testing.assert_allclose(tops - low, 2.0**2 / (2 * G), rtol=0.02)


@pytest.mark.parametrize("substeps", [4, 30])
def test_a_floor_rubs_all_that_stands_on_it(world, substeps):
    # A column that falls at an angle slides on. The floor stops m v of each disc, and rubs the lowest one with mu n m v in all,
    # which pairs pass on: the center of mass is slower by mu v, and then by mu g t. Overlaps hold a part of the impulse, LEFT of
    # it, until they are pushed out.
    u, v, mu, n = 2.0, np.sqrt(2 * G), 0.1, 3
    w = dropped(world, lattice(1, n) + (0.0, 1.0), (u, 0.0), friction=mu, substeps=substeps)
    w.run(v / G + 2 / 60)
    slower = mu * (v + G * (w.time - v / G))
    assert w.velocity[:n, 0].mean() == pytest.approx(u - slower, abs=0.01 * slower)


def test_a_row_that_is_hit_goes_on_as_one(world):
    # Momentum is conserved, m v = (n + 1) m u, and all n + 1 discs have the same velocity u, up to what passes may lack: the
    # share LEFT of its mean square. In a Newton's cradle with e = 0, the last disc does not fly off.
    for n in (2, 3):
        v = 3.0
        x = np.stack([np.r_[-0.5, 2 * R * np.arange(n)], np.ones(n + 1)], axis=1)
        w = dropped(world, x, np.r_[v, np.zeros(n)][:, None] * (1, 0), g=0.0)
        w.run(0.5)
        assert np.allclose(w.velocity.sum(axis=0), (v, 0.0), atol=1e-12)
        assert np.allclose(w.velocity[:-5, 0], v / (n + 1), atol=np.sqrt(LEFT) * (n + 1) * v)


@pytest.mark.parametrize("substeps", [2, 8])
def test_what_lies_still_under_a_blow_is_told_to_lie_still(world, substeps):
    fastest = 0.0
    for drop in np.linspace(0.1, 0.2, 4):
        x, mass = np.array([(0.0, 0.5), (0.0, 1.5 + drop)]), np.array([1.0, 1000.0])
        w = dropped(world, x, mass=mass, radius=0.5, substeps=substeps)
        for _ in range(30):
            w.step(1 / 60)
            fastest = max(fastest, abs(w.velocity[0, 1]))
    assert fastest < G / 60 / substeps  # 467 and 17 m/s where the rows of the light disc take different parts for a load


@pytest.mark.parametrize("substeps", [1, 2, 60])
def test_a_column_bears_its_weight_whatever_the_substep(world, substeps):
    # A contact bears the weight of all discs above it, and the floor bears all, at each substep that the column is changed to;
    # energy never grows by it. The same is told of events, also after positions are assigned.
    n, mass = 10, 2.0 + np.arange(10) % 2
    x = np.stack([np.full(n, 0.5), 0.5 + np.arange(n) * 1.0], axis=1)
    w = dropped(world, x, mass=mass, radius=0.5, substeps=substeps)
    start, load = w.run(5.0).energy, G * np.cumsum(mass[:0:-1])[::-1]
    for changed in (substeps, 3, 20):
        w.substeps = changed
        w.run(1.0)
        np.testing.assert_allclose(w.contacts.impulse * 60 * changed, load, rtol=2 * MET)
        np.testing.assert_allclose(w.wall_events().touches.impulse * 60, G * mass.sum(), rtol=2 * MET)
        assert w.contacts.overlap.max() < SLOP * BEYOND * 0.5 and w.last.energy <= start * (1 + 1e-4)
    for _ in range(5):
        w.position = w.position
        w.step(1 / 60)
        np.testing.assert_allclose(w.events().touches.impulse * 60, load, rtol=0.05)


@pytest.mark.parametrize("substeps, most", [(2, 2e-3), (8, 2e-4)])
def test_frames_of_any_length_move_no_heap(world, substeps, most):
    # A triangle of 21 discs that stands by friction, in frames of 0.3 to 3 times 1/60 s.
    x = np.array([(2 * R * i + R * j, R + np.sqrt(3) * R * j) for j in range(6) for i in range(6 - j)])
    w, rng = dropped(world, x, friction=0.6, substeps=substeps), np.random.default_rng(0)
    for _ in range(300):
        w.step(rng.uniform(0.3, 3.0) / 60)
    assert np.abs(w.position[:-5] - x).max() < most


@pytest.mark.slow
def test_what_a_pin_takes_and_lets_go_keeps_what_pairs_bear(world):
    # The middle disc of a column is held and let go. What the pairs bear stays: the disc above it does not move by a landing.
    x = np.stack([np.full(5, 0.5), R + 2 * R * np.arange(5)], axis=1)
    pin = tv.Pin([2])
    w = world(tv.Particles([*x, (3.0, 1.0)], radius=R), [tv.Gravity(G), tv.Contact(), tv.HalfSpace((0, 1)), pin], substeps=4)
    w.run(1.0)
    for taken in (3, 1, 5, 2):
        pin.indices, pin.target = [taken], w.position[taken]
        w.step(1 / 60)
        assert np.abs(w.velocity[:5]).max() < 0.05 * G / 240
    assert np.abs(w.position[:5] - x).max() < SLOP * BEYOND * R


def pile(world, n=160, e=0.0, ratio=1, columns=12, **settings):
    """Return a world of discs of sizes 1 : 2.8 that fall in a box, with densities of 1 : ratio, in f32."""
    k = np.arange(n)
    r = 0.03 * (1 + 1.8 * tv.golden(k))
    x = np.stack([k % columns * 0.18 + 0.1, k // columns * 0.18 + 0.1], axis=1) + 0.01 * tv.golden(k, dim=2)
    box = tv.Box((0, 0), (0.18 * columns + 0.04, np.inf), friction=0.3, restitution=0.5)
    start = tv.Particles(x, radius=r, mass=r**2 * ratio ** tv.golden(k + n), spin=0)
    w = world(start, [tv.Gravity(G), tv.Contact(friction=0.3, restitution=0.5), box], **settings)
    w.features[1].restitution = box.restitution = e
    return w


@pytest.mark.slow
@pytest.mark.parametrize("e, substeps", [(0.0, 2), (0.0, 8), (0.5, 4)])
def test_a_pile_adds_no_energy_and_rests(world, e, substeps):
    # Frames are 0.5 to 2 times as long as 1/60 s. Impulses do no work; places lift what they part by a little.
    w, rng = pile(world, e=e, substeps=substeps), np.random.default_rng(0)
    lowest = start = w.step(1 / 60).energy
    for _ in range(300):
        report = w.step(rng.uniform(0.5, 2.0) / 60)
        assert report.energy <= lowest + 2e-3 * start
        lowest = min(lowest, report.energy)
    w.run(5.0)
    assert w.last.overlap < 1.5 * SLOP * BEYOND and tv.measure.kinetic_energy(w) < 1e-5 * start


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1, 600])
def test_velocities_hold_no_half_of_an_impact(world, ratio):
    # The energy by the velocities that users read is that by displacements, up to what h g adds to them, while a pile lands.
    w = pile(world, e=0.5, substeps=4, ratio=ratio)
    m, r, start = w.particles.mass, w.particles.radius, w.step(1 / 60).energy
    for _ in range(60):
        report = w.step(1 / 60)
        moving = (m * ((w.velocity**2).sum(axis=1) + (w.spin * r) ** 2 / 2)).sum() / 2
        assert abs(moving + (m * G * w.position[:, 1]).sum() - report.energy) < 1e-3 * start  # with half of impacts in: 3e-2
