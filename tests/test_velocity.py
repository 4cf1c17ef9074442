"""Velocities that users read and write back. For all constraints that may be soft see test_properties.py."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import order


@ti.func
def nothing(r):
    """Between two particles."""
    return 0.0 * r


def swing(world, substeps):
    """Return a world with a pendulum in mid-swing, its pin and its link."""
    pin, link = tv.Pin([0]), tv.Distance([[0, 1]])
    start = tv.Particles([(0, 0), (np.sin(1), -np.cos(1))])
    w = world(start, [tv.Gravity(9.81), pin, link], substeps=substeps, precision="f64")
    w.run(0.3)
    return w, pin, link


@pytest.mark.slow
@pytest.mark.parametrize("what", ["link", "pin", "particle", "pin that takes another"])
def test_what_is_let_go_flies_on_to_second_order(world, what):
    # The particle has the velocity of that moment, and from then on x + v t + g t^2 / 2, or is a pendulum about another particle.
    # Without half of the last substep's reaction it would be off by h / 2 times that: first order, 5e-3 at 5 substeps.
    ends = []
    for substeps in (5, 10, 20, 320):
        w, pin, link = swing(world, substeps)
        before, seen = w.position, w.velocity
        if what == "link":
            w.remove(features=[link])
        elif what == "pin":
            w.remove(features=[pin])
        elif what == "particle":
            w.remove([0])
        else:
            pin.indices, pin.target = [1], before[[1]]
        if what in ("link", "particle"):
            np.testing.assert_array_equal(w.velocity[-1], seen[-1])
        w.run(0.3)
        ends.append(w.position[-1] if what != "pin that takes another" else w.position[0])
        if what in ("link", "particle"):
            np.testing.assert_allclose(ends[-1], before[1] + 0.3 * seen[1] - (0, 9.81 * 0.3**2 / 2), atol=1e-12)
    errors = np.linalg.norm(np.array(ends[:3]) - ends[3], axis=1)
    assert 1.9 <= order(errors) <= 2.1 and errors[0] <= 1e-4


def ways(world, substeps, mu=0.0):
    """Return a world with a disc on a floor, one on a pinned disc, and one on a taut rope: all three rest on something."""
    x = [(0, 0.1), (2, 0.1), (2, 0.3), (4, 3), (4, 2)]
    floor = tv.HalfSpace((0, 1), friction=0.5)
    features = [tv.Gravity(9.81), tv.Contact(friction=0.5), floor, tv.Rope([[3, 4]], 1.0)]
    w = world(tv.Particles(x, radius=0.1, pinned=[1, 3], spin=0), features, substeps=substeps, precision="f64")
    w.features[1].friction = floor.friction = mu
    w.run(0.5)
    return w


@pytest.mark.slow
def test_what_leans_and_is_sent_off_flies(world):
    # x + v t - g t^2 / 2, to rounding: half of the last reaction ends. A bare impulse would make the disc slower by g h / 2, and
    # so would 1000 impulses that are each too small to end the reaction.
    for substeps, parts in ((1, 1), (5, 1000), (20, 1)):
        w = ways(world, substeps)
        begin, some = w.position, [0, 2, 4] if parts == 1 else [0, 2]
        for k in range(parts):
            v = w.velocity.copy()
            v[some] = np.array([0.3, 3.0]) * (k + 1) / parts
            w.velocity = v
        w.run(0.2)
        flown = 0.2 * v[0] - (0, 9.81 * 0.2**2 / 2)
        np.testing.assert_allclose((w.position - begin)[some], [flown] * len(some), rtol=0, atol=1e-12)
        np.testing.assert_allclose(w.velocity[some], [v[0] - (0, 9.81 * 0.2)] * len(some), rtol=0, atol=1e-11)


@pytest.mark.slow
def test_friction_opposes_a_pushed_disc_and_drives_a_spun_one(world):
    # x + v t - mu g t^2 / 2 from rest; and a disc that is spun up in place moves off at mu g t. There was no friction before.
    mu, g, v = 0.5, 9.81, 3.0
    for spun in (False, True):
        w = ways(world, 5, mu)
        if spun:
            w.spin = [-400.0, *w.spin[1:]]
        else:
            w.velocity = [(v, 0.0), *w.velocity[1:]]
        w.run(0.1)
        want = mu * g * 0.1**2 / 2 if spun else v * 0.1 - mu * g * 0.1**2 / 2
        assert w.position[0] == pytest.approx([want, 0.1], abs=1e-11)
        assert w.spin[0] == pytest.approx((-400 if spun else 0) + (1 if spun else -1) * 2 * mu * g * 0.1 / 0.1, abs=1e-8)


@pytest.mark.slow
def test_what_keeps_its_velocity_goes_on_to_the_bit_beside_what_is_steered(world):
    # A heap of discs that stick and roll, and one far away that is steered by velocity and spin on a rough floor, where friction
    # reverses in every frame: an impulse acts on that disc alone. If all made a start for it, the heap would shake by 2e-4 J.
    # Writing back what was read changes nothing. The rope does not hang: one that bears a load takes a start of all.
    heap = [(0.06 + 0.102 * i + 0.05 * (j % 2), 0.05 + 0.09 * j) for j in range(3) for i in range(4)]
    fence = [(k, 0.05 + 0.1 * j) for k in (-0.05, 0.52) for j in range(3)]
    start = tv.Particles([*heap, *fence, (1.5, 0.05), (1.9, 0.05)], radius=0.05, pinned=range(12, 18), spin=0)
    features = [tv.Gravity(9.81), tv.Contact(friction=0.5), tv.HalfSpace((0, 1), friction=0.5), tv.Rope([[18, 19]], 9.0)]
    free, back, steered = (world(start, [f.copy() for f in features], substeps=8, precision="f64") for _ in range(3))
    for k in range(60):
        for w in (free, back, steered):
            w.step(1 / 60)
        back.velocity, back.spin = back.velocity, back.spin
        np.testing.assert_array_equal(steered.position[:18], free.position[:18])
        v, s = steered.velocity.copy(), steered.spin.copy()
        v[18, 0], s[18] = 0.3 * np.sin(k / 5), 3 * np.cos(k / 5)
        steered.velocity, steered.spin = v, s
        np.testing.assert_array_equal(steered.velocity, v)
        np.testing.assert_allclose(steered.spin, s, atol=1e-12)
    assert back.hash() == free.hash()


def chain(world, mass=1.0):
    """Return a world with a chain that swings down from level, and with a pair force of which nothing is felt."""
    k, x = np.arange(4), np.stack([0.3 * np.arange(5), -0.1 * np.arange(5)], axis=1)
    links = tv.Distance(np.stack([k, k + 1], axis=1))
    start, features = tv.Particles(x, mass=mass, pinned=[0]), [tv.Gravity(9.81), links, tv.PairForce(nothing)]
    return world(start, features, substeps=4, precision="f64"), links


@pytest.mark.slow
@pytest.mark.parametrize("what", ["spring", "particle"])
def test_forces_that_come_change_no_velocity_before_they_act(world, what):
    # A swinging chain, and a spring or a particle that comes, of which nothing is felt: what is read is of now. It lacked what
    # links give in half a substep, h g / 2 = 0.02 m/s here. So did what they let go of before the next step: it flies on from x,
    # v by v t - g t^2 / 2.
    (w, links), t = chain(world, 0.1), 0.3
    w.run(0.2)
    seen = w.velocity
    if what == "particle":
        w.add(tv.Particles([[50.0, 0.0]]))
    else:
        w.add(features=[tv.Distance([[0, 4]], compliance=1e9)])
    np.testing.assert_array_equal(w.velocity[:5], seen)
    np.testing.assert_array_equal(w.clone().velocity[:5], seen)
    begin = w.position[1:5]
    w.remove(features=[links])
    np.testing.assert_array_equal(w.velocity[:5], seen)
    w.run(t)
    np.testing.assert_allclose(w.position[1:5], begin + seen[1:] * t - [0, 9.81 * t**2 / 2], atol=1e-9)


@pytest.mark.slow
def test_braking_a_chain_feeds_nothing(world):
    # Half of a reaction given back to some particles of a chain would strike it: 0.3 J per frame, of 70.
    w, _ = chain(world)
    w.substeps = 12

    def energy():
        return (w.velocity[1:] ** 2).sum() / 2 + 9.81 * w.position[1:, 1].sum()

    for _ in range(150):
        before = energy()
        w.step(1 / 60)
        assert energy() <= before + 2e-3 and not w.last.flags
        w.velocity = 0.99 * w.velocity


def test_spins_and_throws_survive_what_comes_next(world):
    # A velocity is assigned before the substep changes, positions are assigned, or a pin takes another particle.
    pin = tv.Pin([0])
    w = world(tv.Particles([(0, 0), (3, 0), (6, 0)], spin=5.0, radius=0.1), [tv.Gravity(9.81), pin], precision="f64")
    w.run(0.1)
    v, fallen = w.velocity.copy(), 9.81 / 60
    for change in (lambda: setattr(w, "substeps", 7), lambda: setattr(w, "position", w.position)):
        v[2] = 1.0, 2.0
        w.velocity = v
        change()
        w.step(1 / 60)
        assert w.spin[1:] == pytest.approx([5, 5]) and w.velocity[2] == pytest.approx([1, 2 - fallen])
        v = w.velocity.copy()
    v[0] = 3.0, 4.0
    w.velocity = v
    pin.indices, pin.target = [1], w.position[[1]]
    w.step(1 / 60)
    assert w.velocity[0] == pytest.approx([3, 4 - fallen]) and w.velocity[1] == pytest.approx([0, 0])


@pytest.mark.slow
def test_what_breaks_flies_on_with_the_velocity_that_is_read(world):
    # x + v t - g t^2 / 2, to rounding, also from the substep in which it breaks: half a kick of what broke is not to come.
    # A rigid link, a spring, an area and a cluster, each held by pinned particles.
    x = np.array([(0, 0), (1, 0), (3, 0), (4, 0), (6, 0), (7, 0), (6.5, -1), (9, 0), (10, 0)])
    broke = tv.Distance([[0, 1], [2, 3]], compliance=[0, 0.02], break_at=np.inf)
    others = tv.Area([[4, 6, 5]], compliance=0.01, break_at=np.inf), tv.ShapeMatch([[7, 8]], compliance=0.02, break_at=np.inf)
    w = world(tv.Particles(x, pinned=[0, 2, 4, 5, 7]), [tv.Gravity(9.81), broke, *others], substeps=1, precision="f64")
    w.run(0.4)
    for f in (broke, *others):
        f.break_at = 1e-30
    w.step(1 / 60)
    begin, v, free = w.position, w.velocity, [1, 3, 6, 8]
    assert broke.broken.all() and all(f.broken.all() for f in others) and np.abs(v[free]).max(axis=1).min() > 0.1
    w.run(0.2)
    np.testing.assert_allclose(w.position[free], (begin + 0.2 * v - (0, 9.81 * 0.2**2 / 2))[free], rtol=0, atol=1e-12)


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_what_is_stopped_stands_still(world, precision):
    # However fast it was, and however strong the drag is; a particle that is pushed then moves by v / rate.
    for rate, fast in ((0.0, 146.0), (0.0, 1e9), (8.0 * 1200, 1.0), (20.0 * 1200, 1.0)):
        start = tv.Particles([(0, 0), (9, 0)], velocity=[(fast, 0.3 * fast), (0, 0)])
        w = world(start, [tv.Gravity(0.0), tv.Drag(rate)], substeps=20, precision=precision)
        w.step(1 / 60)
        x = w.position
        w.velocity = np.zeros((2, 2))
        w.step(1 / 60)
        assert (w.position[0] == x[0]).all() and np.abs(w.velocity[0]).max() <= 2.0**-44 * fast
        if rate:
            w.velocity = [(0.0, 0.0), (1.0, 0.0)]
            x = w.position
            w.step(1 / 60)
            assert w.position[1, 0] - x[1, 0] == pytest.approx(1 / rate, rel=1e-3 if precision == "f64" else 0.1)


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="velocities are read from the reactions of the last substep, some of which count as blows")
def test_what_is_squeezed_is_told_to_move_as_it_does(world):
    # A rigid disc of 40 cm is held in a gap of 30 cm.
    disc = tv.shapes.ball((0, 0.2), 0.18, rings=2)
    lid = tv.HalfSpace((0, -1), -0.43)
    features = [tv.Gravity(), tv.ShapeMatch([range(len(disc.position))]), lid, tv.HalfSpace((0, 1)), tv.Contact()]
    w = world(tv.Particles(disc.position, mass=0.1, radius=0.02), features)
    for _ in range(40):
        lid.offset = min(-0.3, lid.offset + 0.01)
        before = w.position
        w.step(1 / 60)
    assert np.abs(w.velocity).max() < 1 + 120 * np.abs(w.position - before).max()
