"""Contacts as rows, see tiverlet/contact/rows.py."""

import contextlib

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import BEYOND, BLOCK, GROUP, LEAST, MET, SLOP
from tiverlet.device.thread_team import launching

from .launches import launches

G, R = 9.81, 0.1


def column(n, nx=1):
    """Return places of nx columns of n discs that touch, 1 m above a floor."""
    return np.array([(2.1 + 2 * R * i, 1.0 + R + 2 * R * j) for j in range(n) for i in range(nx)])


def angles(world, substeps, dim, friction):
    """Return the angle and the gap of a disc that slides, or rolls, off a fixed one, after half a second."""
    x = np.zeros((2, dim))
    x[1, :2] = np.sin(0.2), np.cos(0.2)
    start = tv.Particles(x, mass=[np.inf, 1.0], radius=0.5, spin=0)
    w = world(start, [tv.Gravity(G), tv.Contact(friction=friction)], substeps=substeps, precision="f64")
    assert w._runner.step.contacts[0].dev.rows
    w.run(0.5)
    r = w.position[1] - w.position[0]
    return np.arctan2(r[0], r[1]), np.linalg.norm(r) - 1.0


@pytest.mark.parametrize("friction", [1e-9, 1.0])
def test_what_slides_and_rolls_is_second_order(world, friction):
    ends = [angles(world, k, 2, friction) for k in (10, 20, 40, 320)]
    errors = np.abs([a - ends[-1][0] for a, _ in ends[:-1]])
    np.testing.assert_allclose(errors[:-1] / errors[1:], 4, rtol=0.03)
    assert errors[0] < 1e-6 and all(abs(gap) < 1e-9 for _, gap in ends)


@pytest.mark.parametrize("substeps", [2, 8, 60])
def test_a_bounce_keeps_e_squared(world, substeps):
    # The height over the floor that the energy along the normal would reach, after each bounce e^2 of the one before.
    e = 0.8
    features = [tv.Gravity(G), tv.Contact(restitution=e), tv.HalfSpace((0, 1), restitution=e)]
    w = world(tv.Particles([(0, 1 + R), (5, 1)], radius=R), features, substeps=substeps, precision="f64")
    heights = [1.0]
    for _ in range(200):
        w.step(1 / 60)
        height = w.position[0, 1] - R + w.velocity[0, 1] ** 2 / (2 * G)
        if abs(height - heights[-1]) > 1e-9:
            heights.append(height)
    np.testing.assert_allclose(heights[1:6], e ** (2 * np.arange(1, 6)), rtol=1e-12)


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_what_meets_at_the_end_of_a_substep_bounces(world, precision):
    # 400 pairs that close at 1.5 to 4.8 m/s and meet after 1 to 40 substeps, to rounding: some of them a little later.
    k, h, y = np.arange(400), 1 / 600, 0.5 * np.arange(400)
    left, right = 1 + k // 40 * 0.37, np.full(400, -0.5)
    gap = (left - right) * h * (k % 40 + 1)
    x = np.stack([np.r_[-0.1 - gap / 2, 0.1 + gap / 2], np.r_[y, y]], axis=1)
    start = tv.Particles(x, velocity=np.stack([np.r_[left, right], 0 * x[:, 0]], axis=1), radius=0.1)
    w = world(start, [tv.Contact(restitution=0.5)], substeps=10, precision=precision)
    w.run(0.1)
    v = w.velocity[:, 0]
    np.testing.assert_allclose((v[400:] - v[:400]) / (left - right), 0.5, atol=1e-4)  # 13 and 15 stuck if those came to rest


@pytest.mark.parametrize(
    "n, nx, e",
    [*((n, nx, e) for n, nx in ((3, 1), (7, 1), (10, 1), (6, 6)) for e in (0.0, 0.5)), (20, 1, 0.0), (40, 1, 0.5), (16, 16, 0.5)],
)
def test_what_touches_bounces_as_a_whole(world, n, nx, e):
    # The center of mass falls by 1 m and comes back to e^2 of it: Newton's law for impacts at the same time.
    x = column(n, nx)
    features = [tv.Gravity(G), tv.Contact(restitution=e), tv.Box((0, 0), (10, 50), restitution=e)]
    w = world(tv.Particles(x, radius=R), features, substeps=8)
    heights = [w.position[:, 1].mean() for _ in range(60 + int(54 * e)) if w.step(1 / 60)]
    assert max(heights[29:]) - x[:, 1].mean() + 1.0 == pytest.approx(e * e, abs=2e-3)


def cradle(world, speeds, e):
    """Return the velocities of five balls that touch, after the first ones came with these speeds."""
    x, v = np.zeros((5, 2)), np.zeros((5, 2))
    x[:, 0] = 2 * R * np.arange(5)
    x[: len(speeds), 0] -= 0.1
    v[: len(speeds), 0] = speeds
    w = world(tv.Particles(x, velocity=v, radius=R), [tv.Contact(restitution=e)], substeps=4, precision="f64")
    w.run(0.3)
    return w.velocity[:, 0]


def test_newtons_cradle_of_balls_that_touch(world):
    # As many leave as came, with the whole speed; with e < 1 the last one takes most, and energy is lost.
    np.testing.assert_allclose(cradle(world, [1.0], 1.0), [0, 0, 0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(cradle(world, [1.0, 1.0], 1.0), [0, 0, 0, 1, 1], atol=1e-12)
    for e in (0.98, 0.999):
        v = cradle(world, [1.0], e)
        assert v.sum() == pytest.approx(1.0, rel=1e-12) and (v**2).sum() < 1.0
        assert v[4] > ((1 + e) / 2) ** 4 and v[:4].max() < 1 - v[4]


@pytest.mark.parametrize("substeps", [2, 8])
def test_a_cradle_on_strings(world, substeps):
    # Five balls on rigid strings: the first comes from 30 degrees, the last one swings as high, and those between hang still.
    n, start = 5, np.radians(30)
    at = np.stack([2 * R * np.arange(n), np.zeros(n)], axis=1)
    x = np.concatenate([at, at - [0, 1]])
    x[n] = -np.sin(start), -np.cos(start)
    particles = tv.Particles(x, mass=[np.inf] * n + [1] * n, radius=[0] * n + [R] * n)
    strings = tv.Distance([(k, n + k) for k in range(n)])
    w = world(particles, [tv.Gravity(G), tv.Contact(restitution=1.0), strings], substeps=substeps, precision="f64")
    high, moved = 0.0, 0.0
    for _ in range(65):  # until the last one comes back
        w.step(1 / 60)
        high, moved = (
            max(high, w.position[-1, 0] - 2 * R * (n - 1)),
            max(moved, np.abs(w.position[n + 1 : -1] - x[n + 1 : -1]).max()),
        )
    # At most half a frame from the turning point: 1 - cos(omega dt / 2).
    assert high == pytest.approx(np.sin(start), rel=G * (1 / 120) ** 2 / 2 + 1e-3 / substeps**2) and moved < 1e-4


def rack(gap):
    """Return a ball and a triangle of 15, at these gaps, in its way."""
    a = 2 * R + gap
    return np.array([(-1.0, 0.0), *((a * np.sqrt(0.75) * i, a * (j - i / 2)) for i in range(5) for j in range(i + 1))])


def test_a_break_keeps_momentum_energy_and_symmetry(world):
    # Balls that touch bounce at the same time, so that both halves of the triangle move alike.
    x = rack(0.0)
    v = np.zeros_like(x)
    v[0, 0] = 2.0
    w = world(tv.Particles(x, velocity=v, radius=R), [tv.Contact(restitution=1.0)], substeps=4, precision="f64")
    w.run(1.0)
    v = w.velocity
    np.testing.assert_allclose(v.sum(axis=0), (2, 0), atol=1e-12)
    assert (v**2).sum() == pytest.approx(4.0, rel=1e-11) and (v**2).sum(axis=1).max() < 3.0
    mirrored = 1 + np.concatenate([np.arange(i * (i + 1) // 2, (i + 1) * (i + 2) // 2)[::-1] for i in range(5)])
    np.testing.assert_allclose(v[1:], v[mirrored] * [1, -1], atol=1e-12)


def test_impacts_in_turn_do_not_depend_on_the_substep(world):
    # A ball breaks a triangle with gaps: each impact has its own time, place and normal, whatever the substep.
    x, ends = rack(0.01), []
    x[0, 1] = 0.03
    v = np.zeros_like(x)
    v[0, 0] = 8.0
    w = world(tv.Particles(x, velocity=v, radius=R), [tv.Contact(restitution=1.0)], precision="f64")
    for w.substeps in (6, 50):
        w.position, w.velocity = x, v
        w.run(0.2)
        ends.append(w.velocity)
    np.testing.assert_allclose(*ends, atol=1e-9)


@pytest.mark.parametrize("dim, precision, g, limit", [(2, "f64", 0.0, 1e-12), (2, "f64", G, 1e-12), (3, "f32", 0.0, 1e-5)])
def test_an_elastic_gas_keeps_its_energy(world, dim, precision, g, limit):
    # To rounding, also under gravity, as long as nothing is thrown farther in a substep than THROWN of a radius.
    k = np.arange(150)
    x = np.stack([k % 15 * 0.3 + 0.2, k // 15 * 0.3 + 0.2, 0 * k + 1.0], axis=1)[:, :dim]
    v = np.random.default_rng(0).normal(size=(150, dim))
    box = tv.Box((0,) * dim, (4.7,) * dim, restitution=1.0)
    features = [tv.Gravity(g), tv.Contact(restitution=1.0), box]
    w = world(tv.Particles(x, velocity=v, radius=R), features, substeps=4, precision=precision)

    def energy():
        return 0.5 * (w.velocity**2).sum() + g * w.position[:, 1].sum()

    before = energy()
    w.run(10.0)
    assert energy() == pytest.approx(before, rel=limit)


def test_rolling_resistance_is_a_constant_moment(world):
    # A rolling disc of mass m and I = m r^2 / 2 is braked by a = c g / (1 + 1 / 2).
    c, v = 0.02, 2.0
    start = tv.Particles([(0.0, 0.5)], velocity=[(v, 0)], radius=0.5, spin=-v / 0.5)
    floor = tv.HalfSpace((0, 1), friction=(0.5, 0.5, c, 0.0))
    w = world(start, [tv.Gravity(G), tv.Contact(friction=0.5), floor], substeps=8, precision="f64")
    w.run(1.0)
    a = c * G / 1.5
    np.testing.assert_allclose(w.velocity[0], (v - a, 0), atol=1e-7)
    assert w.position[0, 0] == pytest.approx(v - a / 2, abs=1e-6) and w.spin[0] == pytest.approx(-(v - a) / 0.5, abs=1e-6)


@pytest.mark.parametrize("substeps", [1, 2, 8, 60])
def test_a_column_bears_its_weight_whatever_the_substep(world, substeps):
    # The k-th contact from the top bears k m g, at each substep that the column is changed to; energy never grows by it.
    n = 10
    x = np.stack([np.full(n, 0.5), 0.5 + np.arange(n) * 1.0], axis=1)
    w = world(
        tv.Particles(x, radius=0.5), [tv.Gravity(G), tv.Contact(), tv.Box((0, 0), (1, 99))], substeps=substeps, precision="f64"
    )
    start = w.run(5.0).energy
    for changed in (substeps, 3, 20):
        w.substeps = changed
        w.run(1.0)
        np.testing.assert_allclose(w.contacts.impulse * 60 * changed, np.arange(n - 1, 0, -1) * G, rtol=2 * MET)
        assert w.contacts.overlap.max() < SLOP * BEYOND * 0.5 and w.last.energy <= start * (1 + 1e-4)


def test_overlap_stores_no_energy(world):
    # Discs placed in each other part by moves alone, at push_out, whatever the substep.
    speed = 0.25
    w = world(tv.Particles([[0.0, 0], [0.05, 0]], radius=0.1), [tv.Contact(push_out=speed)], substeps=10, precision="f64")
    for k, x in ((10, [[0.0, 0], [0.05, 0]]), (80, [[0.0, 0], [0.0, 0.05]])):
        w.position, w.velocity, w.substeps = x, np.zeros((2, 2)), k
        w.run(0.2)
        assert 0.8 * speed < (np.linalg.norm(w.position[1] - w.position[0]) - 0.05) / 0.2 < 1.3 * speed
        w.run(1.0)
        assert 0.2 - SLOP * BEYOND * 0.1 <= np.linalg.norm(w.position[1] - w.position[0]) <= 0.2 + 1e-12
        np.testing.assert_array_equal(w.velocity, 0)


def pile(world, path, n=160, friction=0.3, e=0.0, ratio=1, columns=12, **settings):
    """Return a world of discs of sizes 1 : 2.8 that fall in a box, with densities of 1 : ratio."""
    k = np.arange(n)
    r = 0.03 * (1 + 1.8 * tv.golden(k))
    x = np.stack([k % columns * 0.18 + 0.1, k // columns * 0.18 + 0.1], axis=1) + 0.01 * tv.golden(k, dim=2)
    box = tv.Box((0, 0), (0.18 * columns + 0.04, np.inf), friction=friction, restitution=e)
    start = tv.Particles(x, radius=r, mass=r**2 * ratio ** tv.golden(k + n), spin=0)
    return world(start, [tv.Gravity(G), tv.Contact(friction=friction, restitution=e), box], path=path, **settings)


@pytest.mark.parametrize("e", [0.0, 0.5, 1.0])
def test_all_paths_have_the_same_bits(world, e):
    ends = [pile(world, path, e=e, substeps=2) for path in ("fused", "parallel")]
    with launching():
        launched = pile(world, "parallel", e=e, substeps=2)
        launched.run(1.5)
    for w in ends:
        w.run(1.5)
    assert ends[0].hash() == ends[1].hash() == launched.hash()
    with ends[0].clone() as twin:
        assert twin.step(1 / 60) == ends[0].step(1 / 60) and twin.hash() == ends[0].hash()


@pytest.mark.parametrize("e, substeps", [(0.0, 2), (0.0, 8), (0.5, 4)])
def test_a_pile_adds_no_energy_and_rests(world, e, substeps):
    # Frames are 0.5 to 2 times as long as 1/60 s. Impulses do no work; places lift what they part by a little.
    w, rng = pile(world, "fused", e=e, substeps=substeps), np.random.default_rng(0)
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
    w = pile(world, "fused", e=0.5, substeps=4, ratio=ratio)
    m, r, start = w.particles.mass, w.particles.radius, w.step(1 / 60).energy
    for _ in range(60):
        report = w.step(1 / 60)
        moving = (m * ((w.velocity**2).sum(axis=1) + (w.spin * r) ** 2 / 2)).sum() / 2
        assert abs(moving + (m * G * w.position[:, 1]).sum() - report.energy) < 1e-3 * start  # with half of impacts in: 3e-2


@pytest.mark.parametrize("substeps", [2, 8])
def test_what_lies_still_under_a_blow_is_told_to_lie_still(world, substeps):
    fastest = 0.0
    for drop in np.linspace(0.1, 0.2, 4):
        start = tv.Particles([(0.0, 0.5), (0.0, 1.5 + drop)], mass=[1.0, 1000.0], radius=0.5)
        w = world(start, [tv.Gravity(G), tv.Contact(), tv.HalfSpace((0, 1))], substeps=substeps, precision="f64")
        for _ in range(30):
            w.step(1 / 60)
            fastest = max(fastest, abs(w.velocity[0, 1]))
    assert fastest < G / 60 / substeps  # 467 and 17 m/s where the rows of the light disc take different parts for a load


@pytest.mark.parametrize("substeps, most", [(2, 2e-3), (8, 2e-4)])
def test_frames_of_any_length_move_no_heap(world, substeps, most):
    # A triangle of 21 discs that stands by friction, in frames of 0.3 to 3 times 1/60 s.
    x = np.array([(2 * R * i + R * j, R + np.sqrt(3) * R * j) for j in range(6) for i in range(6 - j)])
    features = [tv.Gravity(G), tv.Contact(friction=0.6), tv.HalfSpace((0, 1), friction=0.6)]
    w, rng = world(tv.Particles(x, radius=R), features, substeps=substeps), np.random.default_rng(0)
    for _ in range(300):
        w.step(rng.uniform(0.3, 3.0) / 60)
    assert np.abs(w.position - x).max() < most


def test_the_list_does_not_decide_what_are_rows(world):
    # Discs that fall together, and are stopped one after the other, with lists that are built often and rarely.
    ends = []
    for skin in (0.3, 0.002):
        w = pile(world, "fused", substeps=2)
        w.features[1].skin = skin
        w.run(1.0)
        ends.append(w.hash())
    assert ends[0] == ends[1]


@pytest.mark.parametrize("exponent", [-10, 13])
def test_units_are_free(world, exponent):
    # Lengths in another unit, times as before: the same bits but for their exponents.
    ends = []
    for unit in (1.0, 2.0**exponent):
        k = np.arange(60)
        x = np.stack([k % 6 * 0.21 + 0.12, k // 6 * 0.21 + 0.12], axis=1) + 0.01 * tv.golden(k, dim=2)
        box = tv.Box((0, 0), (1.4 * unit, np.inf), friction=0.3, restitution=0.2)
        features = [tv.Gravity((0, -G * unit)), tv.Contact(friction=0.3, restitution=0.2), box]
        w = world(tv.Particles(x * unit, radius=0.1 * unit, spin=0), features, substeps=3)
        w.run(1.0)
        ends.append(w.position / unit)
    np.testing.assert_array_equal(*ends)


@pytest.mark.parametrize("substeps", [1, 2, 8])
def test_what_lands_ends_frames_outside_of_walls(world, substeps):
    # By more than the overlap in which contacts rest, a disc is never in the floor, nor in a disc on it.
    features = [tv.Gravity(G), tv.Contact(), tv.Box((0, 0), (2, 9))]
    w = world(tv.Particles([(1.0, 3.0), (0.5, R), (0.6, 4.0)], radius=R), features, substeps=substeps)
    for _ in range(90):
        w.step(1 / 60)
        x = w.position
        assert x[:, 1].min() > R * (1 - SLOP * BEYOND - 1e-4)
        assert np.linalg.norm(x[1] - x[2]) > 2 * R - R * (SLOP * BEYOND + 1e-4)


def test_impulses_of_events_are_positive_after_positions_are_assigned(world):
    x = np.stack([np.full(5, 0.5), R + 2 * R * np.arange(5)], axis=1)
    w = world(tv.Particles(x, radius=R), [tv.Gravity(G), tv.Contact(events=True), tv.Box((0, 0), (1, 9))], substeps=4)
    w.run(1.0)
    for _ in range(5):
        w.position = w.position
        w.step(1 / 60)
        np.testing.assert_allclose(w.events().touches.impulse, np.arange(4, 0, -1) * G / 60, rtol=0.05)


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


@pytest.mark.parametrize("of_wall", [False, True])
def test_restitution_changes_in_a_running_world(world, of_wall):
    # Above 0.97 impacts pass on in turn. A clone, which is built anew, goes on as what runs.
    contact, floor = tv.Contact(restitution=0.5), tv.HalfSpace((0, 1), restitution=0.5)
    w = world(tv.Particles([[0, 1.0], [0.02, 2.0], [0, 3.5]], radius=0.4), [tv.Gravity(G), contact, floor], substeps=8)
    for e in (0.5, 1.0, 0.5):
        (floor if of_wall else contact).restitution = e
        w.run(0.3)
        again = w.clone()
        for one in (w, again):
            one.run(0.1)
        assert w.hash() == again.hash()


def test_grains_need_fewer_substeps(world):
    # Where nothing but contacts acts between free falls, 4 are the default. A constraint, or a force that changes, takes 20.
    x, link = [[0.0, 0.0], [1.0, 0.0]], tv.Distance([[0, 1]])
    w = tv.World(tv.Particles(x, radius=0.1), [tv.Gravity(G), tv.Contact(), tv.Drag(0.1)])
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
        assert tv.World(tv.Particles(x, radius=0.1), features).substeps == 20


def test_sums_over_several_groups_have_the_same_bits_on_all_paths(world):
    n, ends = BLOCK * GROUP + 200, []
    for path in ("fused", "parallel", "launched"):
        with launching() if path == "launched" else contextlib.nullcontext():
            w = pile(world, "parallel" if path == "launched" else path, n=n, columns=n // 2, substeps=2)
            w.run(0.25)
            ends.append(w.position)
    assert (w.contacts.pairs > BLOCK * GROUP).any()
    np.testing.assert_array_equal(ends[1], ends[0])
    np.testing.assert_array_equal(ends[2], ends[0])


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_what_rests_takes_few_launches(world, friction):
    # The least number of passes in each substep, and one look at places.
    with launching():
        w = pile(world, "parallel", n=4, friction=friction, substeps=3)
    w.run(3.0)
    with launches() as count:
        w.step(1 / 60)
    assert count["relax_impulses"] == LEAST[friction > 0] * 3 and count["relax_places"] == 3
