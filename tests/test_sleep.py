"""Sleep: bodies at rest are skipped, keep their state bit for bit, and go on when something reaches them."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .launches import launches
from .test_events import equal, rows

R = 0.5


def heap(columns, rows, apart=2.05, x0=0.0):
    """Return discs on top of each other, slightly off columns, so that columns lean on each other or stand, (n, 2) [m]."""
    rng = np.random.default_rng(3)
    x = np.stack(np.meshgrid(np.arange(columns) * apart * R, np.arange(rows) * 2.02 * R), -1).reshape(-1, 2) + R
    return x + rng.uniform(0, 0.02 * R, x.shape) + [x0, 0.0]


WIDE = (8 * 2.05 * R + 0.02, 999)  # [m] walls around a heap
NEVER = 1e9  # [s] of slow motion before sleep: never asleep, with the kernels of worlds that sleep
ROUGH: dict = dict(friction=(0.5, 0.4, 0.05), restitution=0.2, events=True)


def rough(world, x, time=0.5, wide=WIDE, substeps=10, v=0.0, g=9.81, speed=0.01, pinned=()):
    """Return a world with discs that spin, rub, bounce and have events, between walls: one structure for all heaps.

    The last disc is a pinned sensor, far away if it has no other place.
    """
    last = len(x) - 1
    group = (np.arange(len(x)) == last).astype(int)
    start = tv.Particles(x, velocity=v, radius=R, spin=0.0, orientation=0, group=group, pinned=[*pinned, last])
    features = [tv.Gravity(g), tv.Box((0, 0), wide, **ROUGH), tv.Contact(sensors=[(0, 1)], **ROUGH), tv.Sleep(speed, time)]
    return world(start, features, substeps=substeps)


AWAY = (4.0, 900.0)


def until(w, asleep, seconds=12.0):
    """Step until `asleep` particles are asleep."""
    for _ in range(round(60 * seconds)):
        if w.step(1 / 60).asleep == asleep:
            return
    raise AssertionError(f"{w.last.asleep} of {asleep} asleep after {seconds} s")


@pytest.mark.slow
def test_a_row_that_was_never_disturbed_is_hit_to_the_bit(world):
    # Without gravity, discs at rest have no displacement to skip: a row that sleeps has the bits of one that is awake.
    x, v = np.array([(10 + k * 1.05, 9.0) for k in range(1, 6)] + [(7.0, 9.0), (10.0, 20.0)]), np.zeros((7, 2))
    v[5] = 10.0, 0.5
    worlds, asleep = [rough(world, x, time, (99, 99), substeps=8, v=v, g=0.0) for time in (NEVER, 0.1)], []
    for _ in range(40):
        asleep.append([w.step(1 / 60).asleep for w in worlds][1])
        assert (worlds[1].position == worlds[0].position).all() and (worlds[1].velocity == worlds[0].velocity).all()
    assert max(asleep) == 5 > asleep[-1] and worlds[1].velocity[4, 0] > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("slope", [True, False])
def test_what_is_about_to_turn_round_is_not_at_rest(world, slope):
    # Slow is not at rest: up a slope of 0.2 degrees; drifting at 8 mm/s, beside a spring of 8 s that is released. The way is
    # v t - g sin t^2 / 2, and 0.2 cos(2 pi t / 8) from the spring's end; at rest for `time` any of them would stop for ever.
    a = np.radians(0.2)
    n, along = np.array([-np.sin(a), np.cos(a)]), np.array([np.cos(a), np.sin(a)])
    if slope:
        x, v, features = np.array([R * n]), [0.05 * along], [tv.Gravity(9.81), tv.HalfSpace(n, 0.0)]
    else:
        x, v = np.array([0.2 * along, (9.0, 9.0)]), [(0, 0), 0.008 * along]
        features = [tv.Pin([0], [(0.0, 0.0)], compliance=(8 / (2 * np.pi)) ** 2)]
    w = world(tv.Particles(x, velocity=v, radius=R), [tv.Sleep(), *features], precision="f64")
    for _ in range(600):
        assert w.step(1 / 60).asleep == 0
        t = w.time
        way = [0.05 * t - 9.81 * np.sin(a) * t**2 / 2] if slope else [0.2 * np.cos(2 * np.pi * t / 8) - 0.2, 0.008 * t]
        np.testing.assert_allclose((w.position - x) @ along, way, atol=2e-4)


def test_what_goes_nowhere_sleeps(world):
    # The border is a way of speed * time / 16 in `time`: 1.1 of it is a drift, 0.9 of it is rest.
    speed = 0.01 / 16
    w = world(tv.Particles([(0.0, 0.0), (5.0, 0.0)], velocity=[(0.9 * speed, 0.0), (1.1 * speed, 0.0)]), [tv.Sleep()])
    until(w, 1, seconds=2.0)
    w.run(1.0)
    assert w.last.asleep == 1 and w.velocity[1, 0] == pytest.approx(1.1 * speed, rel=1e-5)


def both(w):
    """Return the events of particles and of walls."""
    return w.events(), w.wall_events()


def follow(w, touching):
    """Step, and check that events continue `touching`, (touching | begun) - ended, for particles and walls."""
    w.step(1 / 60)
    for k, events in enumerate(both(w)):
        begun, ended = rows(events.begun.pairs), rows(events.ended.pairs)
        assert not begun & touching[k] and ended <= touching[k] | begun and touching[k] <= rows(events.touches.pairs)
        touching[k] = (touching[k] | begun) - ended


@pytest.mark.slow
def test_what_sleeps_goes_on_touching_and_gains_no_energy_as_it_wakes(world):
    # No contact of a heap ends when its particles fall asleep, sleep or wake, as a disc falls on them. It lasts, without impulses
    # and in place, in frames that are computed for moving particles.
    w, touching = rough(world, np.vstack([heap(8, 4), [4.0, 10.0], AWAY])), [set(), set()]
    while w.last is None or w.last.asleep < 32:
        follow(w, touching)
    follow(w, touching)
    for events, held in zip(both(w), touching, strict=True):
        assert rows(events.lasting.pairs) == held and not events.touches.speed.any()
    before, frames = both(w), 0
    assert min(map(len, before)) >= 8 and np.linalg.norm(before[1].touches.normal, axis=1).min() > 0.99
    while w.last.asleep == 32:
        for events, held in zip(both(w), before, strict=True):
            assert equal(events, held) == len(events.lasting) and not events.touches.impulse.any()
        follow(w, touching)
        frames += 1
    assert frames > 10 and len(w.events().begun)
    for _ in range(60):
        follow(w, touching)
    # Woken again and again by its knobs, it gains no more than creep.
    w = rough(world, np.vstack([heap(8, 4), AWAY]))
    until(w, 32)
    energy = w.last.energy
    for _ in range(5):
        w.features[2].friction = 0.3
        w.run(0.9)
        assert w.last.energy <= energy * (1 + 1e-5)


@ti.func
def later(x, v, t):
    """Return a force that begins to pull after 6 s, right of 9 m."""
    return ti.Vector([ti.select(t > 6.0 and x[0] > 9, 30.0, 0.0), 0.0])


@pytest.mark.slow
def test_what_is_changed_or_carried_wakes_and_nothing_else(world):
    # Every change by the user and every driven particle wakes. A force that depends on time wakes only what it begins to pull.
    x = np.vstack([heap(2, 2), [(0.5, -0.5), (1.5, -0.5)], [(10.0, -0.5)]])
    features = [
        tv.Gravity(), tv.HalfSpace((0, 1), friction=0.5), tv.Box((-99, -9), (99, 99), active=True), tv.Contact(friction=0.5),
        tv.Pin([4, 5], x[4:6]), tv.Force(later), tv.Sleep(0.05, 0.2),
    ]  # fmt: skip
    w = world(tv.Particles(x, radius=R), features, substeps=8)
    features[1].offset = -1.0
    until(w, 5)
    asleep = w.last.asleep
    assert w.time < 5.5

    def again(change):
        """Return whether particle 0 moves by more than rounding and creep in a clone that is changed."""
        with w.clone() as new:
            new.step(1 / 60)
            assert new.last.asleep == asleep
            change(new)
            before = new.position[0]
            new.run(20 / 60)
            return np.linalg.norm(new.position[0] - before) > 0.02

    def turned(k, name, value):
        return lambda new: setattr(new.features[k], name, value)

    assert not again(lambda new: None)
    assert again(lambda new: setattr(new, "position", 1.1 * w.position + [0.0, 1.0]))
    assert again(lambda new: setattr(new, "velocity", np.full(w.position.shape, 1.0)))
    assert again(turned(0, "g", (5.0, 9.0)))
    assert again(turned(4, "target", x[4:6] - [0.0, 0.4]))  # their support moves away from under them
    assert again(turned(4, "target", x[4:6] + [0.0, 0.4]))
    assert again(lambda new: new.remove([4, 5]))
    assert not again(turned(2, "active", False))  # a gate far away
    rest, pulled = w.position[0], w.position[6, 0]
    while w.time < 6.4:
        assert w.time > 6.0 or w.last.asleep == asleep
        w.step(1 / 60)
    assert w.last.asleep == asleep - 1 and (w.position[0] == rest).all() and w.position[6, 0] > pulled + 0.3


@pytest.mark.slow
def test_what_lies_on_a_roller_wakes_as_it_begins_to_turn(world):
    # A disc between two pinned rollers takes the speed of their surfaces, -omega R / r.
    w = rough(world, np.array([(3.4, 5.0), (4.6, 5.0), (4.0, 5.8), AWAY]), 0.2, substeps=40, speed=0.01, pinned=[0, 1])
    w.features[2].friction = (0.5, 0.5, 0.0)
    until(w, 1)
    w.spin = [5.0, 5.0, 0.0, 0.0]
    w.run(1.0)
    assert w.spin[2] == pytest.approx(-5.0, rel=1e-3)


def resting(w):
    """Return what must not change while a rope sleeps."""
    return w.position[:16], w.velocity[:16], w.features[3].residual, w.features[3].load


@pytest.mark.slow
def test_a_rope_sleeps_with_its_loads_costs_nothing_and_wakes_as_a_whole(world):
    # Only the clock changes while all sleep. A ball of 1 kg lies on the rope from the start, or arrives after
    # sqrt(2 * 12 / g) = 1.56 s. There is a pinned disc, too.
    rope = tv.shapes.rope((0, 0), (3.0, 0), 16)
    for height, asleep in ((0.1501, 17), (12.0, 16)):
        x = np.vstack([rope.position, [(rope.position[8, 0] + 0.01, height), (9.0, 9.0)]]) + [0, -4.95]
        start = tv.Particles(x, radius=np.r_[np.full(17, 0.05), 0.1], mass=np.r_[np.full(17, 0.1), 1.0], pinned=[17])
        floor, contact = tv.HalfSpace((0, 1), -5.0, friction=0.5), tv.Contact(friction=0.5)
        features = [tv.Gravity(), floor, contact, tv.Distance(rope.links), tv.Sleep(0.05)]
        w = world(start, features, precision="f64", substeps=12)
        until(w, asleep)
        w.step(1 / 60)

        before, told, impulses = resting(w), w.last, w.contacts.impulse
        if asleep == 17:
            with launches() as count:
                w.run(2.0)
            assert not count and np.array_equal(w.contacts.impulse, impulses) and len(impulses) == 1 and impulses[0] > 0
            assert w.last.asleep == 17 and w.last.energy_change == 0 and w.last.clean and w.last.contacts == told.contacts == 1
            assert w.last.energy == told.energy and w.last.time == w.time == pytest.approx(told.time + 2.0)
        while w.last.asleep and w.time < 3.0:
            assert all(map(np.array_equal, before, resting(w)))
            w.step(1 / 60)
    assert w.last.asleep == 0 and 1.5 < w.time < 1.65


def test_what_cannot_sleep_is_refused():
    @ti.func
    def apart(r):
        return 0.1 * r

    p = tv.Particles([(0, 0), (1, 1), (0, 1)], radius=0.1)
    for features, word in (
        ([tv.Sleep(), tv.Sleep()], "more than one Sleep"),
        ([tv.Periodic((0, 0), (9, 9), shear=0.1), tv.Sleep()], "sheared"),
        ([tv.PairForce(apart, 0.5), tv.Sleep()], "PairForce"),
    ):
        with pytest.raises(ValueError, match=word):
            tv.World(p, features)
    with pytest.raises(ValueError, match="order"):
        tv.World(p, [tv.Sleep()], order=4, precision="f64")
    for bad in (dict(speed=0.0), dict(time=-1.0)):
        with pytest.raises(ValueError, match="Sleep"):
            tv.Sleep(**bad)
    w = tv.World(p, [tv.Contact(), tv.Sleep()])
    with w, pytest.raises(ValueError, match="Worlds"):
        tv.Worlds(w, 3)
