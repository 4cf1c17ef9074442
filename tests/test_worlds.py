"""Many worlds in one launch: each has the bits that it has alone, whatever is in it, independent of the others."""

import copy
from itertools import product

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device.language import COMPILER

from .conftest import PATCHED, compiled
from .rows import OTHERS, ROWS

pytestmark = pytest.mark.usefixtures("taichi")


def everything(k):
    """Return a world in 3D with forces, and constraints with fields of their own, nearly met; numbers depend on k."""
    along, far = np.eye(3)[0], np.full(3, 9.0 + k)
    forces: list = [
        tv.Gravity(2.0 + k if k else (0.0, -2.0, 0.0)),
        tv.Drag(0.1 + k),
        tv.Wind(along, 0.1 + k),
        tv.Attractor(far, 1.0 + k),
        tv.Hand(far, 1),
    ]
    x: list = [0.02 * tv.golden(np.arange(6), dim=3) + 0.01 * k]
    for name in ("AngleLimit 3D", "Pin, driven", "Snap", "Path, driven", "Winch"):
        points, make = (ROWS[name].points, ROWS[name].make) if name in ROWS else OTHERS[name][:2]
        corners = np.arange(len(points))[None] + sum(map(len, x))
        x.append(points + 4.0 * len(x) * along * ("Path" not in name))
        forces.append(make(corners, np.full(1, 0.5 + 0.1 * k)) if name in ROWS else make(corners))
    x = np.concatenate(x)
    return tv.World(tv.Particles(x, mass=1 + np.arange(len(x)) % 3 + k), forces, substeps=6)


def cloth(solver, k):
    """Return a world with a falling net that is pinned at two corners."""
    n = np.arange(36).reshape(6, 6)
    pairs = np.vstack([np.stack([n[:, :-1].ravel(), n[:, 1:].ravel()], 1), np.stack([n[:-1].ravel(), n[1:].ravel()], 1)])
    x = np.stack([n.ravel() // 6, 0 * n.ravel(), n.ravel() % 6], axis=1) * (0.1 + 0.01 * k)
    features = [tv.Gravity(9.81), tv.Distance(pairs)]
    return tv.World(tv.Particles(x, pinned=[0, 30], mass=1.0 + k), features, solver=solver, substeps=5)


def pendulum(length=1.0, mass=1.0, **settings):
    """Return a world with two horizontal rods; by default relaxed, which compiles faster than a system."""
    start = tv.Particles([[0, 0], [length, 0], [2 * length, 0]], mass=[1, 1, mass], pinned=[0])
    features = [tv.Gravity(9.81), tv.Distance([[0, 1], [1, 2]]), tv.Pin([2], (2.0, 0.0), compliance=10.0), tv.Drag(0.1)]
    return tv.World(start, features, precision="f64", **({"solver": tv.Jacobi()} | settings))


def sliding():
    """Return a world with two discs that slide on a floor, one into the other, and one that is driven."""
    start = tv.Particles([(0.0, 0.55), (1.3, 0.5), (9.0, 2.0)], radius=0.5, velocity=[(5.0, 0.0), (0.0, 0.0), (0.0, 0.0)])
    floor = tv.HalfSpace((0, 1), friction=0.4, restitution=0.3, active=True)
    return tv.World(start, [tv.Gravity(9.81), floor, tv.Contact(friction=0.5, restitution=0.2), tv.Pin([2])], precision="f64")


def heap(k, count=20):
    """Return a world with discs that are drawn to a point, so that some have many neighbours."""
    n = np.arange(count)
    x = np.stack([n % 10, n // 10], axis=1) * 1.5 + 0.2 * tv.golden(n + 7 * k, dim=2)
    return tv.World(tv.Particles(x, radius=0.5, mass=1.0 + k), [tv.Contact(), tv.Attractor((7, 1), 200.0)], substeps=8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # warnings of corners that are off
def test_each_has_the_bits_that_it_has_alone():
    # Three worlds with other masses, positions and knobs: frames one by one and in one launch, with fewer substeps, from assigned
    # velocities, after impulses, and once more from the start. Velocities and reports are those of the worlds alone, too.
    alone = [everything(k) for k in range(3)]
    with tv.Worlds([everything(k) for k in range(3)]) as many:

        def both():
            reports = [w.step(1 / 60) for w in alone]
            together = many.step(1 / 60)
            for k, one in enumerate(reports):
                assert vars(together.of(k)) | {"notes": one.notes, "seconds": one.seconds} == vars(one)
                assert many.hash(k) == alone[k].hash()

        assert [many.hash(k) for k in range(3)] == [w.hash() for w in alone]
        both()
        ends = [w.run(0.1) for w in alone]
        track = many.rollout(0.1)
        assert track.position.shape == (3, 6, *alone[0].position.shape)
        np.testing.assert_array_equal(track.position[:, -1], [w.position for w in alone])
        np.testing.assert_allclose(track.time[:, -1], [w.time for w in alone], rtol=1e-15)
        np.testing.assert_array_equal(many.velocity, [w.velocity for w in alone])
        assert [many.last.of(k).residual for k in range(3)] == [r.residual for r in ends]
        for w in (many, *alone):
            w.substeps = 3
            w.velocity = np.sin(np.arange(alone[0].position.size).reshape(alone[0].position.shape))
        both()
        for w in (many, *alone):  # between substeps of one length: impulses on some particles
            v = w.velocity.copy()
            v[..., ::2, :] *= 0.5
            w.velocity = v
            np.testing.assert_allclose(w.velocity, v, rtol=2.0**-23)
        both()
        assert many[1].hash() == alone[1].hash()
        many.reset([0, 2])
        alone[::2] = everything(0), everything(2)
        for w in (many, *alone):
            w.substeps = 4
            w.step(1 / 60)
        assert [many.hash(k) for k in range(3)] == [w.hash() for w in alone]
    for w in alone:
        w.close()


@pytest.mark.slow
def test_a_list_that_is_too_short_in_one_grows_in_all_and_what_is_wrong_in_one_is_flagged_for_it_alone():
    # There is room for fewer pairs than there will be: some frames stop in the middle while others continue, in one launch. Then
    # NaN and an explosion in two of four worlds; the others have the bits that they have alone.
    alone = [heap(k) for k in range(4)]
    with tv.Worlds([heap(k) for k in range(4)]) as many:
        near = many._runner.search.list
        near.store.destroy()
        near.store = None
        near.allocate(16)  # which is compiled into kernels of many worlds
        many._runner.renew()
        report = many.run(1.1)
        contacts = [w.run(1.1).contacts for w in alone]
        assert near.capacity > 16
        assert [many.hash(k) for k in range(4)] == [w.hash() for w in alone]
        assert report.contacts.tolist() == contacts and min(contacts) > 0
        assert many.each(lambda world: len(world.contacts)) == [len(w.contacts) for w in alone]

        field = many._runner.scene.state.d
        with many._copies.all():
            many._runner.memory.write_some(field, np.nan, np.array([3]))
            many._runner.memory.write_some(field, 1e30, np.array([1]))
        report, good = many.run(0.1), [w.run(0.1) for w in alone]
        bad = np.isin(np.arange(4), (1, 3))
        assert report.flags["non-finite"][3] and report.bad[3] == 0 and (report.bad[~bad] == -1).all()
        assert [many.hash(k) == w.hash() for k, w in enumerate(alone)] == [*~bad]
        for k in (0, 2):
            assert report.of(k).flags == good[k].flags and report.energy[k] == good[k].energy
        many.reset(bad)
        alone[1::2] = heap(1), heap(3)
        for w in (many, *alone):
            w.run(0.1)
        assert [many.hash(k) for k in range(4)] == [w.hash() for w in alone]


def driven():
    """A motor, a winch and a servo with limited loads, in a wind."""
    x = [(0, 0), (1, 0), (2, 0), (3, 0), (3, -1), (5, 0), (6, 0), (7, 0)]
    motor, servo = tv.Motor([(0, 1, 2)], 1.0, torque=2.0), tv.Motor([(5, 6, 7)], 2.0, angle=0.1, torque=5.0)
    links, winch = tv.Distance([(1, 2), (6, 7)]), tv.Winch([(3, 4)], 0.5, force=20.0)
    wind = tv.Wind((0.5, 0.0), rate=0.3)
    start = tv.Particles(x, pinned=[0, 1, 3, 5, 6])
    return tv.World(start, [tv.Gravity(), links, wind, motor, winch, servo], substeps=6)


# Number of a feature, its knobs with a value for each of some worlds, and which; for all three by default.
CHANGES = {
    pendulum: [
        (0, {"g": [3.0, 15.0, 7.0]}), (2, {"target": [[(0.3, -0.5)], [(-0.2, 0.8)]]}, [0, 2]), (3, {"rate": [0.5, 1.0, 2.0]}),
        (1, {"rest": [(1.05, 1.06), (1.0, 1.1), (0.95, 1.0)]}), (0, {"g": [7.0]}, [1]), (3, {"rate": [0.3]}, [1]),
    ],
    sliding: [
        (1, {"friction": [0.1, (0.3, 0.2), 0.5], "restitution": [0.2, 0.3, 0.4]}), (1, {"offset": [0.0, -0.1, 0.2]}),
        (2, {"friction": [0.1, (0.4, 0.3), 0.2]}), (2, {"restitution": [0.3, 0.2, 0.1]}),
        (3, {"target": [[(9.0, 2.5)], [(9.5, 2.0)], [(9.0, 1.5)]]}), (1, {"active": [False, True, True]}),
        (1, {"offset": [0.1, 0.0], "restitution": [0.5, 0.0]}, [0, 1]), (1, {"active": [False, False, False]}),
    ],
    driven: [
        (3, {"torque": [[0.5], [3.0], [1.0]], "speed": [1.0, -1.0, 2.0]}),
        (4, {"force": [2.0, 0.0], "longest": [1.5, 3.0]}, [2, 0]), (5, {"angle": [0.4, -0.3, 0.2]}),
        (2, {"velocity": [(1.0, 0.0), (0.0, 2.0), (-1.0, 0.5)]}), (3, {"torque": [4.0]}, [1]), (1, {"rest": [1.1, 0.9, 1.0]}),
        (0, {"g": [4.0, 5.0]}, [0, 1]),
    ],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("make", CHANGES, ids=lambda make: make.__name__)
def test_knobs_are_for_one_some_or_all(make):
    # Bit for bit as in single worlds with the same assignments: what is driven or moves arrives in the first of three frames.
    # One is taken out while knobs wait: its velocities are those under the force before, as those of a clone are.
    with make() as world, tv.Worlds(world, 3) as many:
        alone = [world.clone() for _ in range(3)]

        def both():
            for w in (many, *alone):
                w.run(0.05)
            assert [many.hash(k) for k in range(3)] == [w.hash() for w in alone]

        both()
        for of, knobs, *some in CHANGES[make]:
            some = some[0] if some else [0, 1, 2]
            many.set(many.features[of], some=some, **knobs)
            for k, name in product(range(len(some)), knobs):
                setattr(alone[some[k]].features[of], name, knobs[name][k])
            both()
        many.set(many.features[0], some=[1], g=[5.0])
        alone[1].features[0].g = 5.0
        np.testing.assert_array_equal(many.velocity, [w.velocity for w in alone])
        one, twin = many[1], alone[1].clone()
        both()
        for w in (one, twin):
            w.run(0.05)
        assert one.hash() == twin.hash() == alone[1].hash() and one.features[0].g == 5.0
        kept = [w.features[0].g for w in alone]
        many.reset()
        alone = [many[k] for k in range(3)]
        assert [w.features[0].g for w in alone] == kept and not many.time.any()
        for w in (many, *alone):
            w.features[0].g = 3.0
            w.substeps = 7
        both()
        assert world.time == 0 and world.features[0].g == 9.81
        for w in alone:
            w.close()


def test_what_differs_in_each_is_asked_of_each():
    with tv.Worlds(pendulum(), 2) as many:
        with pytest.raises(RuntimeError, match="many worlds"):
            _ = many.features[1].load
        alone = many[0]
        np.testing.assert_array_equal(many.each(lambda w: w.features[1].load), [alone.features[1].load] * 2)


def test_tracks_of_some_frames_go_on_from_launch_to_launch(monkeypatch):
    world = pendulum()
    with tv.Worlds(world, 3) as many, tv.Worlds(world, 3) as other:
        every = many.rollout(0.5)
        monkeypatch.setattr("tiverlet.worlds.worlds.WORK", 1)
        third = other.rollout(0.5, every=3)
        np.testing.assert_array_equal(third.position, every.position[:, 2::3])
        np.testing.assert_array_equal(third.time, every.time[:, 2::3])
        assert third.report.residual.tolist() == every.report.residual.tolist()


def test_a_reset_starts_from_places_that_are_given():
    # Reset worlds continue as a world that was built there: its constraints are met first, and its energy counts from there. One
    # that is refused changes nothing.
    world = pendulum()
    with tv.Worlds(world, 4) as many:
        many.run(0.3)
        before = many.hash(0)
        for wrong in ({"position": np.zeros((3, 3, 2))}, {"velocity": [[np.nan, 0.0]] * 3}, {"position": [[1e309, 0.0]] * 3}):
            with pytest.raises(ValueError):
                many.reset(**wrong)
            assert many.hash(0) == before
        x, v = np.array([[0.0, 0], [0, -1.1], [0.7, -1.2]]), np.array([[0.0, 0], [1, 0], [0, 1]])
        many.reset([False, True, False, True], position=x, velocity=v)
        assert many.hash(0) == before and many.time.tolist() == [many.time[0], 0, many.time[0], 0]
        report = many.step(1 / 60)
        fresh = world.clone()
        fresh.velocity, fresh.position = v, x
        alone = fresh.step(1 / 60)
        assert many.hash(1) == many.hash(3) == fresh.hash()
        assert report.energy_change[1] == alone.energy_change and report.of(1).flags == alone.flags


@pytest.mark.slow
@pytest.mark.skipif(not PATCHED, reason="every world has a tree and kernels of its own")
def test_worlds_of_the_same_structure_compile_nothing_and_take_no_more_memory():
    with tv.Worlds([pendulum() for _ in range(80)]) as many:
        many.run(0.1)
        many.reset([0])
        many.step(0.01)
    with compiled() as names, tv.Worlds([pendulum(2.0, 3.0) for _ in range(99)]) as many:
        many.run(0.1)
        many.reset(np.arange(99) % 2 == 0)
        many.step(0.01)
        # Bytes on the device: for each world at most those that it has alone, and what tells it what to do.
        told = sum(size for name, size in many.fields.items() if name.startswith("frames."))
        assert sum(many.fields.values()) - told <= 99 * sum(pendulum(path="fused").fields.values()) + 4 and told < 99 * 400
    assert [name for name in names if name != "to_velocity"] == []


class Tensor:
    """An array of another library, with DLPack only."""

    def __init__(self, array):
        self.array = array

    def __dlpack__(self, **options):
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()


def test_arrays_come_and_go_without_copies():
    x = np.random.default_rng(0).uniform(size=(4, 3, 2))
    with tv.Worlds(pendulum(), 4) as many:
        many.position = Tensor(x)
        many.velocity = Tensor(np.ones((3, 2)))
        seen = many.view()
        np.testing.assert_array_equal(seen, x)
        assert (many.view("displacement") == 1).all()
        taken = np.from_dlpack(seen)
        assert taken.ctypes.data == seen.ctypes.data and not seen.flags.writeable
        many.step(1 / 60)
        np.testing.assert_array_equal(taken, many.position)
        assert not np.array_equal(taken, x)
        with pytest.raises(ValueError, match="read-only"):
            seen[0] = 0
        with pytest.raises(ValueError, match="one of 'position', 'displacement'"):
            many.view("velocity")


@pytest.mark.skipif(COMPILER != "taichi", reason="what kernels are compiled from is known of Taichi alone")
def test_kernels_of_other_constants_are_refused():
    # The relaxation that Jacobi("auto") finds is compiled; masses and positions are not.
    with pytest.raises(ValueError, match="other constants"):
        tv.Worlds([cloth(tv.Jacobi("auto"), k) for k in range(2)])
    with tv.Worlds([cloth(tv.Jacobi(), k) for k in range(2)]) as many:
        assert len(many) == 2


def test_what_makes_no_worlds_is_refused():
    for worlds, count, what in (
        ([], None, "is empty"), (3, None, "is a int"), ([pendulum(), 3], None, r"worlds\[1\] = 3"),
        ([pendulum()], 2, "copies of one World"), (pendulum(), 0, "count"), (pendulum(substeps="auto"), 2, "auto"),
        ([pendulum(), pendulum(substeps=3)], None, "substeps = 3"), ([pendulum(), heap(0)], None, "worlds.1. has"),
        ([heap(0), heap(0, 21)], None, "position of shape"),
    ):  # fmt: skip
        with pytest.raises((ValueError, TypeError), match=what):
            tv.Worlds(worlds, count)
    with tv.Worlds(pendulum(), 3) as many:
        gravity = many.features[0]
        for kind, what, act in (
            (ValueError, "1 values, but there are 3", lambda: many.set(gravity, g=[1.0])),
            (ValueError, "one value", lambda: many.set(gravity, g=5.0)),
            (ValueError, "none of these", lambda: many.set(tv.Gravity(), g=[1.0] * 3)),
            (ValueError, "g", lambda: many.set(gravity, g=[1.0, np.nan, 2.0])),
            (ValueError, "twice", lambda: many.set(gravity, some=[1, 1], g=[1.0, 2.0])),
            (AttributeError, "did you mean 'g'", lambda: many.set(gravity, gg=[1.0] * 3)),
            (ValueError, "some", lambda: many.reset([4])),
            (ValueError, "mask of 3", lambda: many.reset([True])),
            (ValueError, r"\(worlds, n, dim\)", lambda: setattr(many, "position", np.zeros((2, 3, 2)))),
            (AttributeError, "did you mean 'position'", lambda: setattr(many, "postion", np.zeros((3, 2)))),
            (ValueError, "dt", lambda: many.step(0.0)),
            (ValueError, "seconds", lambda: many.run(-1.0)),
            (TypeError, "tv.Worlds", lambda: copy.copy(many)),
        ):
            with pytest.raises(kind, match=what):
                act()
        many.step(0.01)
    with pytest.raises(RuntimeError, match="closed"):
        many.step(0.01)


@pytest.mark.slow
def test_worlds_without_particles_go_on():
    empty = tv.World(tv.Particles(np.zeros((0, 2))), [tv.Gravity()])
    with tv.Worlds(empty, 3) as many:
        report = many.run(0.1)
        empty.run(0.1)
        assert many.position.shape == (3, 0, 2) and report.clean.all() and many.hash(2) == empty.hash()
