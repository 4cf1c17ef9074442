"""Contacts as rows, see tiverlet/contact/rows.py: what rests, lands, and bounces as a whole."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import BEYOND, BLOCK, GROUP, LEFT, MET, SLOP

from .test_impacts import discs

G, R = 10.0, 0.1


def lattice(*counts):
    """Return places of touching discs or spheres on a floor at y = 0: so many along each axis, a millionth apart."""
    place = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, len(counts))
    return R * (1 + 2 * (1 + 1e-6) * place)


def dropped(world, x, v=0.0, e=(), friction=0.0, wall=0.0, **settings):
    """Return a world of discs above a floor at y = 0: of two structures, with restitution up to 0.97, and without.

    e: restitution of pairs and of the floor.
    """
    low = np.where(np.arange(x.shape[1]) == 1, 0.0, -99.0)
    rough = {"friction": [friction], "lower": low, "most": 0.9 if e else 0.0, "bouncy": e[1] if e else 0.0}
    w = discs(world, x, np.zeros_like(x) + v, e=e[:1], **({"radius": R, "g": G, "substeps": 8} | rough | settings))
    w.features[2].friction = friction
    return w


def high(w):
    """Return the heights of the discs [m]."""
    return w.position[:-5, 1]


# What bounces.


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [2, 8, 60])
def test_a_bounce_keeps_e_squared(world, substeps):
    # The height over the floor that the energy along the normal would reach, after each bounce e^2 of the one before.
    e, heights = 0.8, [1.0]
    w = dropped(world, np.array([(0, 1 + R), (5, 1)]), e=(e, e), substeps=substeps)
    for _ in range(200):
        w.step(1 / 60)
        height = high(w)[0] - R + w.velocity[0, 1] ** 2 / (2 * G)
        if abs(height - heights[-1]) > 1e-9:
            heights.append(height)
    np.testing.assert_allclose(heights[1:6], e ** (2 * np.arange(1, 6)), rtol=1e-12)


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


@pytest.mark.slow
@pytest.mark.parametrize(
    "counts, pair, wall, friction",
    [
        ((1, 1), 0.5, 0.5, 0.0), ((1, 6), 0.1, 0.1, 0.0), ((1, 40), 0.5, 0.5, 0.0), ((6, 6), 0.8, 0.8, 0.0),
        ((6, 6), 0.5, 0.5, 0.5), ((1, 6), 0.0, 0.5, 0.0), ((1, 6), 0.5, 0.0, 0.0), ((16, 16), 0.5, 0.5, 0.0),
        ((4, 4, 4), 0.3, 0.3, 0.0),
    ],
)  # fmt: skip
def test_what_touches_bounces_as_a_whole(world, counts, pair, wall, friction):
    # All contacts are struck at the same time, and each is left with -e times its velocity: the floor with e v, and pairs, which
    # did not approach, with 0. So the center of mass comes back to e^2 of its fall. It is off by the overlap (1 + e) v h that the
    # lowest pair has by the end of the substep, and by what the passes leave, less than 1 %. With one impact after the other
    # and pushes between what they leave, columns came back by 0.2 to 0.7 of their fall, whatever e was.
    fall, v = 1.0, np.sqrt(2 * G)
    for substeps in (4, 30):
        w = dropped(world, lattice(*counts) + fall * np.eye(len(counts))[1], 0.0, (pair, wall), friction, substeps=substeps)
        w.run(v / G + 1 / 60)
        y = np.array([high(w) for _ in range(10 + int(60 * wall * v / G)) if w.step(1 / 60)])
        off = (1 + wall) * v / (60 * substeps) + 0.01 * fall
        assert y.mean(axis=1).max() - R * counts[1] == pytest.approx(wall**2 * fall, abs=off), substeps
        assert y.max() - R * (2 * counts[1] - 1) < 1.2 * wall**2 * fall + off, substeps
        assert y.min() > R - off  # as deep as the overlap that is taken back


def test_what_does_not_touch_bounces_one_after_the_other(world):
    # A light disc a little above a heavy one: the floor throws the heavy one back with e v, and this one the light one with
    # u = (1 + e)^2 v M / (M + m) - v, several times as fast as both came.
    e, heavy, v, gap = 0.9, 10.0, np.sqrt(2 * G), 0.004
    w = dropped(world, np.array([(0, R + 1), (0, 3 * R + gap + 1)]), e=(e, e), mass=np.array([heavy, 1.0]), substeps=200)
    w.run(v / G + 0.02)
    u = (1 + e) ** 2 * v * heavy / (heavy + 1) - v
    assert w.velocity[1, 1] + 0.02 * G == pytest.approx(u, rel=0.01)


def test_the_impulses_of_what_bounces_sum_up_to_its_momentum(world):
    # The floor gives a column m (1 + e) v, and what it weighs meanwhile; the lowest pair gives that to all discs but one.
    n, v = 6, np.sqrt(2 * G)
    w = dropped(world, lattice(1, n) + (0.0, 1.0), e=(0.5, 0.5))
    w.run(v / G - 0.05)
    before, by_floor, by_pair = w.velocity[:n, 1], 0.0, 0.0
    for _ in range(6):
        w.step(1 / 60)
        pairs = w.events().touches
        by_floor += w.wall_events().touches.impulse.sum()
        by_pair += pairs.impulse[(pairs.pairs == (0, 1)).all(axis=1)].sum()
    gained = w.velocity[:n, 1] - before + 0.1 * G
    assert by_floor == pytest.approx(gained.sum(), rel=0.03) and by_pair == pytest.approx(gained[1:].sum(), rel=0.03)


@pytest.mark.slow
def test_restitution_changes_in_a_running_world(world):
    # Above 0.97 impacts pass on in turn. A clone, which is built anew, goes on as what runs.
    w = dropped(world, np.array([[0, 1.0], [0.02, 2.0], [0, 3.5]]), e=(0.5, 0.5), radius=0.4)
    contact, floor = w.features[1:]
    for surface, e in ((contact, 0.5), (contact, 1.0), (contact, 0.5), (floor, 1.0)):
        surface.restitution = e if surface is floor else dict.fromkeys(contact.restitution, e)
        w.run(0.3)
        with w.clone() as again:
            for one in (w, again):
                one.run(0.1)
            assert w.hash() == again.hash()


# What lands without restitution.


@pytest.mark.slow
@pytest.mark.parametrize("counts, friction", [((1, 1), 0.0), ((1, 5), 0.0), ((5, 5), 0.0), ((5, 5), 0.5)])
def test_what_falls_stays_where_it_lands(world, counts, friction):
    # Inelastic impacts leave no velocity. Blocks that springs throw back rise by up to half of their fall.
    fall = 1.0
    for substeps in (4, 8, 30):
        w = dropped(world, lattice(*counts) + (0, fall), friction=friction, substeps=substeps)
        w.run(np.sqrt(2 * fall / G) + 2 / 60)
        height = np.array([high(w).mean() for _ in range(60) if w.step(1 / 60)])
        landed = R * counts[1]
        assert height.max() < landed + 2e-3 * fall, substeps
        assert height[:6].min() > 0.9 * landed, substeps  # it is not pressed into the floor


@pytest.mark.slow
@pytest.mark.parametrize("dim, k", [(2, 0.0), (3, 2.5)])
def test_what_strikes_at_an_angle_rubs_by_coulombs_law(world, dim, k):
    # A disc with v along n and u across strikes a fixed one. The impulse P = min(mu v, u / (1 + k)) per mass across n takes it to
    # u' = u - P and r omega = k P, where k = 1 / inertia if it spins, else 0: it slides, or its surface stands still. It is
    # stopped in the substep in which it meets the other one, and in the next. By then it is up to 2 u h / 2 R = 2 phi further
    # round, which changes P by 8 phi^2 v or less.
    u, v = 2.0, 3.0
    for mu, substeps in ((0.1, 4), (0.1, 30), (0.9, 8)):
        x, velocity = np.full((2, dim), 0.5), np.zeros((2, dim))
        x[1, :2], velocity[1, :2] = x[0, :2] + (-u * 0.1, 2 * R + v * 0.1), (u, -v)
        if k:
            start = tv.Particles(x, velocity=velocity, radius=R, pinned=[0], spin=0.0)
            w = world(start, [tv.Contact(friction=mu)], substeps=substeps, precision="f64")
        else:
            w = dropped(world, x, velocity, friction=mu, g=0.0, mass=np.array([np.inf, 1.0]), substeps=substeps)
        w.run(9 / 60)
        push, off = min(mu * v, u / (1 + k)), 8 * v * (u / (60 * substeps) / (2 * R)) ** 2 + 1e-9
        assert w.velocity[1, 0] == pytest.approx(u - push, abs=off)
        assert not k or R * np.ravel(w.spin[1])[-1] == pytest.approx(-k * push, abs=k * off)


@pytest.mark.parametrize("substeps", [4, 30])
def test_a_floor_rubs_all_that_stands_on_it(world, substeps):
    # A column that falls at an angle slides on. The floor stops m v of each disc, and rubs the lowest one with mu n m v in all,
    # which pairs pass on: the center of mass is slower by mu v, and then by mu g t. Without friction of the floor in the
    # projection it was slower by half of that. Overlaps hold a part of the impulse, LEFT of it, until they are pushed out.
    u, v, mu, n = 2.0, np.sqrt(2 * G), 0.1, 3
    w = dropped(world, lattice(1, n) + (0.0, 1.0), (u, 0.0), friction=mu, substeps=substeps)
    w.run(v / G + 2 / 60)
    slower = mu * (v + G * (w.time - v / G))
    assert w.velocity[:n, 0].mean() == pytest.approx(u - slower, abs=0.01 * slower)


@pytest.mark.parametrize("struck", [1, 2])
def test_a_row_that_is_hit_goes_on_as_one(world, struck):
    # Momentum is conserved, m v = (n + 1) m u, and all n + 1 discs have the same velocity u, up to what passes may lack: the
    # share LEFT of its mean square. In a Newton's cradle with e = 0, the last disc does not fly off.
    n, v = struck + 1, 3.0
    x = np.stack([np.r_[-0.5, 2 * R * np.arange(n)], np.ones(n + 1)], axis=1)
    w = dropped(world, x, np.r_[v, np.zeros(n)][:, None] * (1, 0), g=0.0)
    w.run(0.5)
    assert np.allclose(w.velocity.sum(axis=0), (v, 0.0), atol=1e-12)
    assert np.allclose(w.velocity[:-5, 0], v / (n + 1), atol=np.sqrt(LEFT) * (n + 1) * v)


def test_discs_that_fly_together_keep_their_momentum_and_gain_no_energy(world):
    rng = np.random.default_rng(1)
    x = lattice(8, 8) * 1.3 + 0.02 * rng.normal(size=(64, 2)) + (0, 9)
    v, mass = 2 * (x.mean(axis=0) - x) + 0.5 * rng.normal(size=x.shape), rng.uniform(0.5, 2, 64)
    w = dropped(world, x, v, mass=mass, g=0.0)
    p, energy = mass @ v, [0.5 * (mass * (v**2).sum(axis=1)).sum()]
    for _ in range(60):
        energy.append(w.step(1 / 60).energy)
    assert np.allclose(mass @ w.velocity[:-5], p, atol=1e-12 * np.abs(mass[:, None] * v).sum())
    assert energy[-1] < 0.3 * energy[0] and np.diff(energy).max() < 1e-3 * energy[0]


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


@pytest.mark.parametrize("substeps", [1, 8])
def test_what_lands_ends_frames_outside_of_walls(world, substeps):
    # By more than the overlap in which contacts rest, a disc is never in the floor, nor in a disc on it.
    w = dropped(world, np.array([(1.0, 3.0), (0.5, R), (0.6, 4.0)]), substeps=substeps)
    for _ in range(90):
        w.step(1 / 60)
        x = w.position
        assert x[:, 1].min() > R * (1 - SLOP * BEYOND - 1e-4)
        assert np.linalg.norm(x[1] - x[2]) > 2 * R - R * (SLOP * BEYOND + 1e-4)


# What rests.


@pytest.mark.parametrize("substeps", [1, 2, 8, 60])
def test_a_column_bears_its_weight_whatever_the_substep(world, substeps):
    # The k-th contact from the top bears k m g, at each substep that the column is changed to; energy never grows by it. The same
    # is told of events, also after positions are assigned.
    n = 10
    w = dropped(world, np.stack([np.full(n, 0.5), 0.5 + np.arange(n) * 1.0], axis=1), radius=0.5, substeps=substeps)
    start, load = w.run(5.0).energy, np.arange(n - 1, 0, -1) * G
    for changed in (substeps, 3, 20):
        w.substeps = changed
        w.run(1.0)
        np.testing.assert_allclose(w.contacts.impulse * 60 * changed, load, rtol=2 * MET)
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
def test_what_pins_take_and_let_go_keeps_what_pairs_bear(world):
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


# Piles of discs that spin, in f32.


def pile(world, path="fused", n=160, e=0.0, ratio=1, columns=12, unit=1.0, **settings):
    """Return a world of discs of sizes 1 : 2.8 that fall in a box, with densities of 1 : ratio. unit: of lengths [m]."""
    k = np.arange(n)
    r = 0.03 * (1 + 1.8 * tv.golden(k))
    x = np.stack([k % columns * 0.18 + 0.1, k // columns * 0.18 + 0.1], axis=1) + 0.01 * tv.golden(k, dim=2)
    box = tv.Box((0, 0), ((0.18 * columns + 0.04) * unit, np.inf), friction=0.3, restitution=e)
    start = tv.Particles(x * unit, radius=r * unit, mass=r**2 * ratio ** tv.golden(k + n), spin=0)
    return world(start, [tv.Gravity(G * unit), tv.Contact(friction=0.3, restitution=e), box], path=path, **settings)


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


@pytest.mark.parametrize("ratio", [1, 600])
def test_velocities_hold_no_half_of_an_impact(world, ratio):
    # The energy by the velocities that users read is that by displacements, up to what h g adds to them, while a pile lands.
    w = pile(world, e=0.5, substeps=4, ratio=ratio)
    m, r, start = w.particles.mass, w.particles.radius, w.step(1 / 60).energy
    for _ in range(60):
        report = w.step(1 / 60)
        moving = (m * ((w.velocity**2).sum(axis=1) + (w.spin * r) ** 2 / 2)).sum() / 2
        assert abs(moving + (m * G * w.position[:, 1]).sum() - report.energy) < 1e-3 * start  # with half of impacts in: 3e-2


@pytest.mark.parametrize("exponent", [-10, 13])
def test_units_are_free(world, exponent):
    # Lengths in another unit, times as before: the same bits but for their exponents.
    ends = []
    for unit in (1.0, 2.0**exponent):
        w = pile(world, n=60, e=0.5, columns=6, unit=unit, substeps=3)
        w.run(1.0)
        ends.append(w.position / unit)
    np.testing.assert_array_equal(*ends)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*near pairs per particle")
def test_sums_over_several_groups_have_the_same_bits_in_many_launches(world, briefly):
    n, hashes = BLOCK * GROUP + 200, set()
    for path in ("fused", "launched"):
        w = pile(world, path, n=n, e=0.5, columns=n // 6, substeps=2)
        w.run(0.25)
        hashes.add(w.hash())
    assert len(hashes) == 1 and (w.contacts.pairs > BLOCK * GROUP).any()


def test_grains_need_fewer_substeps(world):
    # Where nothing but contacts acts between free falls, 4 are the default. A constraint, or a force that changes, takes 20.
    x, link = [[0.0, 0.0], [1.0, 0.0]], tv.Distance([[0, 1]])
    w = world(tv.Particles(x, radius=0.1), [tv.Gravity(G), tv.Contact(), tv.Drag(0.1)])
    assert w.substeps == 4
    w.add(features=[link])
    assert w.substeps == 20
    w.remove(features=[link])
    assert w.substeps == 4
    w.substeps = 7
    w.add(features=[link])
    assert w.substeps == 7
    w.substeps = None
    assert w.substeps == 20
    for features in ([tv.Gravity(G)], [tv.Contact(), tv.Attractor((0, 0), 1.0)]):
        assert world(tv.Particles(x, radius=0.1), features).substeps == 20
