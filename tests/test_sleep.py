"""Sleep: bodies at rest are skipped, keep their state bit for bit, and go on when something reaches them."""

import contextlib

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.features.feature import Acceleration

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


def rough(world, x, time: float | None = 0.5, wide=WIDE, substeps=10, v=0.0, knobs=ROUGH, g=9.81, path="fused"):
    """Return a world with discs that spin, rub, bounce and have events, between walls: one structure for all heaps.

    The last disc is a pinned sensor, far away if it has no other place. time: None for a world without Sleep.
    """
    k = np.arange(len(x))
    start = tv.Particles(x, velocity=v, radius=R, spin=0.0, orientation=0, group=k // (len(x) - 1), pinned=[len(x) - 1])
    features = [tv.Gravity(g), tv.Box((0, 0), wide, **ROUGH), tv.Contact(sensors=[(0, 1)], **ROUGH)]
    w = world(start, [*features, *([] if time is None else [tv.Sleep(time=time)])], substeps=substeps, path=path)
    for name, value in knobs.items():
        setattr(features[2], name, value)
    return w


AWAY = (4.0, 900.0)


def pile(world, height=10.0, time=0.5):
    """Return a world with a heap between walls, and a disc at `height` that falls on the sleeping heap; 0 for none."""
    x = heap(8, 4)
    return rough(world, np.vstack([x, *([[4.0, height]] if height else []), AWAY]), time)


def until(w, asleep, seconds=12.0):
    """Step until `asleep` particles are asleep."""
    for _ in range(round(60 * seconds)):
        if w.step(1 / 60).asleep == asleep:
            return
    raise AssertionError(f"{w.last.asleep} of {asleep} asleep after {seconds} s")


def falls(w, i=0, frames=20):
    """Whether particle i moves by more than rounding and creep: at rest it is less than speed times the time."""
    before = w.position[i]
    for _ in range(frames):
        w.step(1 / 60)
    return np.linalg.norm(w.position[i] - before) > 0.02


@pytest.mark.slow
def test_a_row_that_was_never_disturbed_is_hit_to_the_bit(world):
    """Without gravity, a world with sleep has the bits of one without: discs at rest have no displacement to skip.

    A cradle with e = 1: the speed of the first disc goes to the last one. Other paths have the same bits, see below.
    """
    x = np.array([(10 + k * 1.05, 9.0) for k in range(1, 6)] + [(7.0, 9.0), (10.0, 20.0)])
    v = np.zeros((7, 2))
    v[5] = 10.0, 0.0
    elastic = {"friction": 0.0, "restitution": 1.0}
    worlds = [rough(world, x, time, (99, 99), substeps=8, v=v, knobs=elastic, g=0.0) for time in (None, 0.1)]
    most = 0
    for _ in range(40):
        reports = [w.step(1 / 60) for w in worlds]
        most = max(most, reports[1].asleep)
        assert (worlds[1].position == worlds[0].position).all() and (worlds[1].velocity == worlds[0].velocity).all()
    assert most == 5 and worlds[1].last.asleep == 5  # the last one flies on, the others rest again
    assert worlds[1].velocity[4] == pytest.approx([10.0, 0.0], abs=2e-5)


@pytest.mark.parametrize("case", ["slope", "throw", "drift", "spring"])
def test_what_is_about_to_turn_round_is_not_at_rest(world, case):
    """Slow is not at rest: up a slope of 0.2 degrees, thrown up at 0.02 m/s^2, drifting at 8 mm/s, on a spring of 8 s released.

    x(t) = v t + a t^2 / 2, and 0.2 cos(2 pi t / 8) from the spring's end; at rest for `time` any of them would stop for ever.
    """
    slope = np.radians(0.2)
    down = {"slope": 9.81 * np.sin(slope), "throw": 0.02}.get(case, 0.0)
    n = np.array([-np.sin(slope), np.cos(slope)]) if case == "slope" else np.array([0.0, 1.0])
    along = np.array([n[1], -n[0]]) if case == "slope" else np.array([0.0, 1.0])
    v = {"slope": 0.05, "throw": 0.03, "drift": 0.008, "spring": 0.0}[case]
    features: list = [tv.Sleep()]
    x = 0.2 * along if case == "spring" else R * n
    if case == "slope":
        features += [tv.Gravity(9.81), tv.HalfSpace(n, 0.0)]
    elif case == "throw":
        features += [tv.Gravity((0.0, -down))]
    elif case == "spring":
        features += [tv.Pin([0], [(0.0, 0.0)], compliance=(8 / (2 * np.pi)) ** 2)]
    w = world(tv.Particles([x], velocity=[v * along], radius=R), features, precision="f64")
    for _ in range(600):
        w.step(1 / 60)
        t = w.time
        way = 0.2 * np.cos(2 * np.pi * t / 8) - 0.2 if case == "spring" else v * t - down * t**2 / 2
        assert w.last.asleep == 0
        np.testing.assert_allclose((w.position[0] - x) @ along, way, atol=2e-4)


def test_what_goes_nowhere_sleeps(world):
    """The border is a way of speed * time / 16 in `time`: 1.1 of it is a drift, 0.9 of it is rest."""
    speed = 0.01 / 16
    w = world(tv.Particles([(0.0, 0.0), (5.0, 0.0)], velocity=[(0.9 * speed, 0.0), (1.1 * speed, 0.0)]), [tv.Sleep()])
    until(w, 1, seconds=2.0)
    for _ in range(60):
        w.step(1 / 60)
    assert w.last.asleep == 1 and w.velocity[1, 0] == pytest.approx(1.1 * speed, rel=1e-5)


@pytest.mark.slow
def test_against_a_world_that_never_rested(world):
    """Until the disc arrives, a sleeping pile is off by less than speed * time from one that is awake.

    When it arrives, momentum enters the whole pile in the same substep: positions after the bounce agree to the bound.
    """
    a, b = (pile(world, time=time) for time in (0.5, NEVER))
    until(a, 32, seconds=3.0)
    while b.time < a.time - 1e-9:
        b.step(1 / 60)
    while a.last.asleep == 32 and a.time < 9.0:
        before = a.position
        a.step(1 / 60)
        reached = b.position
        b.step(1 / 60)
    assert np.linalg.norm(before - reached, axis=1).max() < 0.005 and a.last.asleep < 32
    # The disc that was struck stood still, and its island moves: in the frame of the impact both worlds are as near.
    assert np.linalg.norm(a.position - b.position, axis=1).max() < 0.01
    assert np.abs(a.velocity[:32]).max() > 0.1


@pytest.mark.slow
def test_bits_of_all_paths(world):
    """One thread, a team and the launched path agree on sleep, waking, spins and all events.

    For bodies without spins, friction and events see test_bodies_of_loops.
    """
    x = np.vstack([heap(8, 4), [4.0, 7.5], [4.0, 5.5]])  # a disc that falls on the heap passes a sensor
    worlds, seen, met = [rough(world, x, 0.25, path=path) for path in ("fused", "parallel", "launched")], [], 0
    for k in range(52):
        seen.append({w.step(1 / 60).asleep for w in worlds})
        for w in worlds[1:]:
            met += equal(worlds[0].events(), w.events()) + equal(worlds[0].wall_events(), w.wall_events())
        if k % 10 == 0 or seen[-1] != seen[k - 1]:
            assert len({w.hash() for w in worlds}) == 1
    assert all(len(s) == 1 for s in seen) and {32} in seen and seen[-1] != {32}  # the heap fell asleep, and was hit
    assert met > 500


def test_clones_and_replays_sleep_alike(world, tmp_path, read_here):
    """A clone made while some particles sleep continues bit for bit, and a recording verifies through sleep and waking."""
    w = pile(world)
    with tv.Recorder(tmp_path / "sleep.rrd", w) as recorder:
        until(w, 32)
        for _ in range(5):
            w.step(1 / 60)
            recorder.log()
        other = w.clone()
        for _ in range(40):
            w.step(1 / 60), other.step(1 / 60)
            recorder.log()
            assert w.last.asleep == other.last.asleep
        assert w.hash() == other.hash() and w.last.asleep != 32
        other.close()
    assert tv.replay(tmp_path / "sleep.rrd").verify()


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


def test_what_sleeps_goes_on_touching(world):
    """No contact of a heap ends when its particles fall asleep, sleep or wake; clones agree.

    It lasts, without impulses and in place, in frames that are computed for moving particles and in frames that are not.
    """
    w, touching = pile(world, height=10.0), [set(), set()]
    while w.last is None or w.last.asleep < 32:
        follow(w, touching)
    follow(w, touching)
    before, frames = both(w), 0
    assert min(map(len, before)) >= 8 and np.linalg.norm(before[1].touches.normal, axis=1).min() > 0.99
    while w.last.asleep == 32:
        for events, held in zip(both(w), before, strict=True):
            assert equal(events, held) == len(events.lasting) and not events.touches.impulse.any()
        copy = w.clone() if frames == 3 else None
        follow(w, touching)
        if copy:
            copy.step(1 / 60)
            for own, others in zip(both(copy), both(w), strict=True):
                equal(own, others)
            copy.close()
        frames += 1
    assert frames > 10 and len(w.events().begun)
    for _ in range(60):
        follow(w, touching)


def test_nothing_begins_where_all_sleep(world):
    """Frames that are not computed report touching pairs, and do not repeat events of the last computed frame."""
    w, touching = pile(world, height=0), [set(), set()]
    while w.last is None or w.last.asleep < 32:
        follow(w, touching)
    for _ in range(3):
        follow(w, touching)
        for events, held in zip(both(w), touching, strict=True):
            assert rows(events.lasting.pairs) == held and len(events) == len(events.lasting) >= 8
            assert not events.touches.impulse.any() and not events.touches.speed.any()


@pytest.mark.slow
def test_a_sensor_that_sleeps_and_a_stack_that_wakes(world):
    """Overlaps of a sleeping sensor begin and end as if it were awake.

    A pair that wakes in the middle of a frame has not met again: the speed at which it came together is 0.
    """
    x = [(0.0, R), (9.0, R), (9.0, 3 * R + 1e-3), (-9.0, 0.3 * R), (9.05, 6.0)]
    v = np.zeros((5, 2))
    v[3, 0] = 14.0
    start = tv.Particles(x, velocity=v, radius=[R, R, R, 0.3 * R, R], group=[1, 0, 0, 0, 0])
    floor, contact = tv.HalfSpace((0, 1), 0, events=True), tv.Contact(events=True, sensors=[(0, 1)])
    w, touching, seen, asleep = (
        world(start, [tv.Gravity(), floor, contact, tv.Sleep(0.05, 0.2)], substeps=8),
        [set(), set()],
        [],
        0,
    )
    while not seen or seen[-1][1:] != (2, 4):
        assert w.time < 1.5
        asleep = w.last.asleep if w.last else 0
        follow(w, touching)
        if asleep:
            seen += [(asleep, *pair) for pair in rows(w.events().begun.pairs)] + [pair for pair in rows(w.events().ended.pairs)]
    assert seen == [(3, 0, 3), (0, 3), (3, 2, 4)] and w.last.asleep == 1
    held = w.events().lasting, w.wall_events().lasting
    assert rows(held[0].pairs) == {(1, 2)} and rows(held[1].pairs) == {(0, 1), (1, 1), (3, 1)}
    assert not any(touches.speed.any() for touches in held) and held[0].impulse > 0


def test_islands(world):
    """Heaps that do not touch are islands of their own: one is hit, the other one sleeps on."""
    w = rough(world, np.vstack([heap(3, 3, x0=1.0), heap(3, 3, x0=20.0), [(21.0, 50.0)], AWAY]), wide=(99, 999), substeps=20)
    until(w, 18, 3.0)
    first = w.position[:9]
    while w.last.asleep == 18 and w.time < 9.0:
        w.step(1 / 60)
    assert 9 <= w.last.asleep < 18 and w.position[18, 1] < 5.0  # columns that lean on nothing are islands, too
    w.run(0.5)
    assert (w.position[:9] == first).all()


@ti.func
def later(x, v, t):
    """Return a force that begins to pull after 6 s, right of 9 m."""
    return ti.Vector([ti.select(t > 6.0 and x[0] > 9, 30.0, 0.0), 0.0])


DRIVEN = np.array([4, 5, 7])  # two discs that carry others, and one that another is linked to; the rest lies on a floor
YARD = slice(9, 9 + 8 + 9 + 16 + 1)  # a ring, a cluster that hangs from one of its corners, a body of discs, and a disc


def yard(world):
    """Return a world with many kinds of sleeping bodies and their supports, for several tests."""
    x = np.vstack([heap(2, 2), [(0.5, -0.5), (1.5, -0.5)], [(10.0, -0.5), (-5.0, -0.5), (-6.2, -0.5)]])
    angle = np.arange(8) * np.pi / 4
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * 0.5 + [-20, -0.4]
    body = 0.2 * heap(4, 4, x0=-150.0) - [0, 1]
    more = [ring, heap(3, 3, x0=-16.0) + [0, 1.0], body, [(-40.0, -0.9)]]
    ends = 9 + np.concatenate([np.stack([np.arange(8), np.roll(np.arange(8), -1)], axis=1), np.arange(8).reshape(2, 4).T])
    features = [
        tv.Gravity(),
        tv.HalfSpace((0, 1), friction=0.5),
        tv.Box((-99, -9), (99, 99), active=True),
        tv.Contact(friction=0.5),
        tv.Pin(DRIVEN, x[DRIVEN]),
        tv.Distance([(7, 8), *ends], compliance=1e-4, damping=3.0),
        tv.Area([range(9, 17)], compliance=1e-4, damping=1.0),
        tv.ShapeMatch([range(17, 26), range(26, 42)], compliance=[1e-4, 0.0], damping=3.0),
        tv.Drag(3.0),
        tv.Force(later),
        tv.Sleep(0.05, 0.2),
    ]
    w = world(tv.Particles(np.concatenate([x, *more]), radius=np.repeat([R, 0.1], [9, 34]), pinned=[24]), features, substeps=8)
    features[1].offset = -1.0
    until(w, 5 + 8 + 8 + 16 + 1)
    return w


@pytest.mark.slow
def test_what_wakes(world):
    """Every change by the user and every driven particle wakes. A force that depends on time wakes only what it begins to pull.

    A particle that is linked to a driven one never sleeps.
    """
    w = yard(world)
    x, asleep = w.particles.position[:9], w.last.asleep
    assert w.time < 5.5

    def again(change):
        new = w.clone()
        new.step(1 / 60)
        assert new.last.asleep == asleep
        change(new)
        moved = falls(new)
        new.close()
        return moved

    def assigned(name, value):
        return lambda new: setattr(new, name, value)

    def turned(k, name, value):
        return lambda new: setattr(new.features[k], name, value)

    assert not again(lambda new: None)
    assert again(assigned("position", 1.1 * w.position + [0.0, 1.0]))
    assert again(assigned("velocity", np.full(w.position.shape, 1.0)))
    assert again(turned(0, "g", (5.0, 9.0)))
    assert again(turned(4, "target", x[DRIVEN] - [0.0, 0.4]))  # their support moves away from under them
    assert again(turned(4, "target", x[DRIVEN] + [0.0, 0.4]))
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
    rollers = tv.Particles([(-0.13, 0), (0.13, 0), (0, 0.17)], radius=[0.11, 0.11, 0.1], pinned=[0, 1], spin=0)
    w = world(rollers, [tv.Gravity(), tv.Contact(friction=0.5), tv.Sleep(0.01, 0.2)], precision="f64", substeps=40)
    until(w, 1)
    w.spin = [5.0, 5.0, 0.0]
    w.run(1.0)
    assert w.spin[2] == pytest.approx(-5.0 * 0.11 / 0.1, rel=1e-3)


class Tilt(Acceleration):
    """A pull of 5 m/s^2 along x on all particles, from 2 s on."""

    uniform = common = True

    def prepare(self, particles, inv_mass):
        """Do nothing: there are no arguments."""

    def bind(self, scene):
        """Store the scene."""
        self.scene, self.changed = scene, False

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return the acceleration [m/s^2]."""
        return ti.Vector([ti.select(t > 2.0, 5.0, 0.0), 0.0])


def test_a_uniform_force_that_changes_with_the_time_wakes(world):
    # A disc on a floor of friction mu slides by (a - mu g) t^2 / 2 once a > mu g pulls. The pull on sleeping particles was
    # compared only if it could differ from place to place, so the disc slept on.
    mu, floor = 0.3, tv.HalfSpace((0, 1), friction=0.3)
    w = world(tv.Particles([(0.0, R)], radius=R), [tv.Gravity(9.81), Tilt(), floor, tv.Sleep(0.05, 0.2)], substeps=8)
    w.run(2.0)
    assert w.last.asleep == 1
    w.run(1.0)
    assert w.position[0, 0] == pytest.approx((5.0 - mu * 9.81) / 2, rel=0.05)


def tied(world, start, links, time=0.5, speed=0.05, g=9.81, **settings):
    """Return a world of linked particles above a floor: one structure for each solver."""
    floor, contact = tv.HalfSpace((0, 1), -5.0, friction=0.5), tv.Contact(friction=0.5)
    return world(start, [tv.Gravity(g), floor, contact, tv.Distance(links), tv.Sleep(speed, time)], precision="f64", **settings)


@pytest.mark.slow
def test_what_sleeps_is_as_it_was_and_frames_cost_nothing(world):
    """Only the clock changes while all sleep; loads stay, too."""
    rope = tv.shapes.rope((0, 0), (3.0, 0), 16)
    x = np.vstack([rope.position, [(6.0, 0.0), (6.0, 0.1001), (9.0, 9.0)]]) + [0, -4.95]
    start = tv.Particles(x, radius=np.r_[np.full(18, 0.05), 0.1], mass=np.r_[np.full(18, 0.1), 1.0], pinned=[18])
    w = tied(world, start, rope.links, substeps=12)
    until(w, 18)
    w.step(1 / 60)
    x, v, loads, state = w.position, w.velocity, w.contacts.impulse, w.last
    launched, w._runner._fused = w._runner._fused, None  # would compute a frame
    for _ in range(120):
        w.step(1 / 60)
    w._runner._fused = launched
    assert (w.position == x).all() and (w.velocity == v).all() and np.array_equal(w.contacts.impulse, loads)
    assert w.last.asleep == 18 and w.last.energy_change == 0 and w.last.clean and w.last.contacts == state.contacts
    assert len(loads) == w.last.contacts == 1 and loads[0] > 0
    assert w.last.energy == state.energy and w.last.time == w.time == pytest.approx(state.time + 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, tv.Jacobi(), tv.ConjugateGradient()], ids=["direct", "jacobi", "conjugate"])
def test_linked_particles(world, solver):
    """A rope at rest sleeps as a whole, with its loads, and wakes as a whole.

    While a ball falls on it, frames are computed, but not the corrections of the rope: values written by hand stay.
    """
    rope = tv.shapes.rope((0, 0), (3.0, 0), 16)
    x = np.vstack([rope.position, [(rope.position[8, 0] + 0.01, 12.0)], [(9.0, 9.0)]]) + [0, -4.95]
    start = tv.Particles(x, radius=np.r_[np.full(17, 0.05), 0.1], mass=np.r_[np.full(17, 0.1), 1.0], pinned=[17])
    w = tied(world, start, rope.links, substeps=12, solver=solver)
    until(w, len(rope.position), 2.0)
    strain, position = w.features[3].residual, w.position[:-2]
    memory, slots = w._runner.memory, w._runner.scene.slots
    fields = [slots.move, *([slots.system.step] if slots.system else [])]
    for field in fields:
        memory.write(field, np.full_like(memory.read(field), 7.0))
    w.step(1 / 60)
    wants = [7.0, 0.0 if slots.system and slots.system.steps else 7.0]  # conjugate gradients zero the steps of sleeping rows
    assert all((memory.read(field) == want).all() for field, want in zip(fields, wants, strict=False))
    while w.last.asleep and w.time < 3.0:
        assert (w.position[:-2] == position).all() and np.array_equal(w.features[3].residual, strain)
        w.step(1 / 60)
    assert w.last.asleep == 0 and 1.5 < w.time < 1.65  # when the ball arrives: sqrt(2 * 12 / g) = 1.56 s


@pytest.mark.slow
def test_what_is_grazed_wakes_before_its_links_are_solved(world):
    """A grazed disc wakes before its links are solved, so that these hold it in the same substep.

    A pendulum would fly past the hanging disc in a substep, but for its own link. The disc hung at rest to rounding, so it
    continues as in a world in which nothing sleeps.
    """
    angle = np.radians(80)
    x = [(0, 0), (-np.sin(angle), -np.cos(angle)), (0, 1), (0, 0.4), (0, -0.8 - 1e-5)]
    start = tv.Particles(x, radius=[0.01, 0.1, 0.01, 0.01, 0.1], mass=[1, 1, 1, 0.1, 5], pinned=[0, 2])
    ends = []
    for time in (0.1, NEVER):
        w = tied(world, start, [(0, 1), (2, 3), (3, 4)], time, 0.02, substeps=8)
        w.run(0.3)
        assert w.last.asleep == (0 if time == NEVER else 2)
        w.run(0.3)
        assert w.last.asleep == 0 and w.velocity[4, 0] > 1e-5
        ends.append(w.position)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


def square(side, center):
    """Return the corners of a square."""
    return np.asarray(center) + side / 2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


@pytest.mark.slow
def test_bodies_of_loops(world):
    """Two squares on each other and one beside them sleep, until a fourth falls on the two after sqrt(2 h / g).

    For a team; for one thread see test_polygons.py, and for launches of sleep and of polygons test_bits_of_all_paths and
    test_body_impacts.py: together they would take 5 s to compile.
    """
    x = np.concatenate([square(0.6, (0, 0.31)), square(0.5, (0.03, 0.87)), square(0.6, (0.65, 0.31)), square(0.4, (0.1, 4.0))])
    loops = np.arange(16).reshape(4, 4)
    features = [
        tv.Gravity(),
        tv.ShapeMatch(loops),
        tv.Polygons(loops, friction=0.5),
        tv.HalfSpace((0, 1), friction=0.5, events=True),
        tv.Sleep(0.02, 0.2),
    ]
    worlds = [world(tv.Particles(x), features, substeps=12, path="parallel")]
    until(worlds[0], 12, seconds=0.6)
    stand = rows(worlds[0].wall_events().lasting.pairs)
    w = worlds[0]
    before = w.position[:12], w.velocity[:12], w.contacts.impulse, w.features[1].residual[:3]
    worlds.append(worlds[0].clone())
    h = 4.0 - 0.2 - worlds[0].position[4:8, 1].max()
    while worlds[0].last.asleep == 12 and worlds[0].time < 3.0:
        for w in worlds:
            after = w.position[:12], w.velocity[:12], w.contacts.impulse, w.features[1].residual[:3]
            assert all(map(np.array_equal, before, after))
            w.step(1 / 60)
            if w.last.asleep == 12:  # the blow lets a corner hop
                assert rows(w.wall_events().touches.pairs) == rows(w.wall_events().lasting.pairs) == stand
    assert len({(w.hash(), w.last.asleep) for w in worlds}) == 1 and worlds[0].last.asleep == 4
    assert 0 <= worlds[0].time - (2 * h / 9.81) ** 0.5 < 1 / 60 + 1e-6
    assert np.abs(worlds[0].velocity[12:, 1]).max() < 0.1 * (2 * 9.81 * h) ** 0.5  # what it struck stops it in the same frame
    assert (worlds[0].position[8:12] == before[0][8:12]).all() and len(stand) > 3
    worlds[-1].close()


@pytest.mark.slow
def test_a_surface_and_a_cluster(world):
    """A loop with pressure and a soft cluster on a pinned corner, of any number of corners, sleep without a change.

    Their reports stay the same, in a clone too. A rigid body of discs sleeps, and a disc alone.
    """
    w = yard(world)
    w.step(1 / 60)
    state, residual, energy = w.position[YARD], w.last.residual, w.last.energy
    with w.clone() as other:
        for one in (w, other):
            one._runner.sleep.rests = False  # compute frames in which nothing moves
            one.step(1 / 60)
            assert (one.position[YARD] == state).all() and one.last.asleep == 38
            # The disc that stays awake is at rest to what rows may lack, g h^2 / 2000, over which its weight does 2e-7 J.
            assert one.last.residual == residual and one.last.energy == pytest.approx(energy, abs=2e-7)
        assert w.hash() == other.hash()


@pytest.mark.slow
def test_frames_that_a_loop_measures_wake_nothing(world):
    """A heap sleeps where it lies while frames get up to a tenth longer and shorter, and stays there when it wakes.

    Its weight is in what its contacts push in a substep, which is proportional to h^2. If a sleeping heap kept that of
    another h, it would jump or fall where it wakes.
    """
    x = np.vstack([heap(6, 3), [[3.0, 300.0]]])  # and a disc that falls all the time, so that frames are computed
    box, rng = (6 * 2.05 * R + 0.02, 999), np.random.default_rng(0)
    features = [tv.Gravity(9.81), tv.Box((0, 0), box, friction=0.5), tv.Contact(friction=0.5), tv.Sleep(0.05)]
    w = world(tv.Particles(x, radius=R), features, substeps=10, precision="f64")
    while w.time < 2.0:
        w.step(rng.uniform(0.9, 1.1) / 60)
    asleep, at, v = w.last.asleep, w.position[:18], w.velocity[:18]
    assert asleep == 18
    while w.time < 2.3:
        assert w.step(rng.uniform(0.9, 1.1) / 60).asleep == asleep
    assert (w.position[:18] == at).all()
    np.testing.assert_allclose(w.velocity[:18], v, rtol=0.25, atol=1e-6)  # d / h + a h / 2: d / h stays, h changes by a fifth
    energy = w.last.energy
    w.features[2].friction = 0.4  # wakes all
    for _ in range(30):
        report = w.step(rng.uniform(0.9, 1.1) / 60)
        assert report.clean and report.energy < energy * (1 + 1e-4)
    assert np.abs(w.velocity[:18]).max() < 0.2 and np.abs(w.position[:18] - at).max() < 0.02 * R


def test_energy_never_grows(world):
    """The energy of a pile that falls asleep, and is woken again and again by its knobs, grows by no more than creep."""
    w = pile(world, height=0)
    until(w, 32)
    energy = w.last.energy
    for _ in range(5):
        w.features[2].friction = 0.3
        w.run(0.9)
        assert w.last.energy <= energy * (1 + 1e-5)


def test_refusals(world):
    """Features that islands do not support are refused, with what to do."""

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
    with contextlib.closing(w), pytest.raises(ValueError, match="Worlds"):
        tv.Worlds(w, 3)


@pytest.mark.slow
def test_braced_bodies_bear_nothing_in_free_fall_and_are_not_solved_where_they_sleep(world):
    # Six links of a square do the work of five: the violation that is left is rounding, partly in the null space, where steps of
    # conjugate gradients could have any multiplier. Free fall needs none, and rows that sleep are not solved.
    square, turn = 0.4 * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]), np.array([[0.8, -0.6], [0.6, 0.8]])
    x = np.concatenate([square @ turn.T + [2.0 * k, 0.6 + 0.1 * k] for k in range(3)])
    links = np.concatenate([np.stack(np.triu_indices(4, 1), 1) + 4 * k for k in range(3)])
    features = [tv.Gravity(10.0), tv.Distance(links), tv.HalfSpace((0, 1), friction=0.5), tv.Sleep()]
    held = tv.Particles(
        np.vstack([x - [0, 5], [(0, 9)]]), radius=np.r_[np.full(12, 0.01), 0.1], mass=np.r_[np.ones(12), 2.0], pinned=[12]
    )
    solved: dict = dict(solver=tv.ConjugateGradient(), substeps=8)
    for w in (world(tv.Particles(x), features, **solved), tied(world, held, links, g=10.0, **solved)):  # in f32, and in f64
        for k in range(300):
            report = w.step(1 / 60)
            if k < 3:
                assert report.clean and report.tension < 1e-3
        assert report.asleep == 12 and report.tension == 0
