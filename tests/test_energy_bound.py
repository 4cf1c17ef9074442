"""A scene that nothing works on and that has more energy than it had says so; others do not.

E(t) <= E(0) + O(h^2) where forces have a potential, constraints stand still, and walls and pins do not move
"""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

FLAG = "energy-gain"


@ti.func
def push(r):
    """Two particles push each other apart, whatever their distance."""
    return 3.0 * r.normalized()


@ti.func
def of_push(r):
    """Its potential, -F |r| for |r| = 0 ... 10."""
    return 3.0 * (10.0 - r.norm())


@ti.func
def forgotten(r):
    """A potential that does not belong to it."""
    return 0.0 * r[0]


@ti.func
def wind(x, v, t):
    """A force that does work."""
    return ti.Vector([3.0, 0.0])


STIFF = 1800.0  # [N/m]


@ti.func
def spring(r):
    """Of a metre."""
    return -1800.0 * (r.norm() - 1.0) * r.normalized()


@ti.func
def of_spring(r):
    """Its potential."""
    return 900.0 * (r.norm() - 1.0) ** 2


def pair(*features, **settings):
    """Two particles, one metre from each other."""
    return tv.Particles([[0.0, 0.0], [1.0, 0.0]], radius=0.1, **settings), list(features)


def test_what_no_figure_tells_is_told_by_energy(world):
    # A rope of six links, level, that falls and cracks: two substeps do not resolve its cracks, and each constraint is met, so
    # nothing else tells of it. It gains a fifth of what it falls by, and is told from a tenth on. With twenty it gains nothing.
    n = 6
    x = np.stack([0.1 * np.arange(n + 1), np.zeros(n + 1)], axis=1)
    links = np.stack([np.arange(n), np.arange(1, n + 1)], axis=1)
    fallen = 9.81 * x[:, 0].sum()
    for substeps in (2, 20):
        w = world(tv.Particles(x, pinned=[0]), [tv.Gravity(9.81), tv.Distance(links)], substeps=substeps, iterations=2)
        reports = [w.step(1 / 60) for _ in range(400)]
        rise = np.array([r.energy for r in reports]) - reports[0].energy
        told = np.array([FLAG in r.flags for r in reports])
        if substeps == 2:
            assert rise.max() > 0.15 * fallen and set().union(*[r.flags for r in reports]) == {FLAG}
            assert told[rise > 0.15 * fallen].all() and not told[rise < 0.09 * fallen].any()
            note = next(r for r in reports if FLAG in r.flags).notes[-1]
            assert "Nothing works on the scene" in note and "at first 4" in note
        else:
            assert rise.max() < 0.01 * fallen and not told.any()


def test_what_a_first_frame_brings_in_is_told(world):
    # Two that are one by a link of length 0 fly apart by more than half a periodic box in one substep, and are drawn together in
    # the next image. They are met there, and nothing else tells. With as many substeps as keep them near, sum p^2 / 2M is left.
    for substeps, wrong in ((1, True), (50, False)):
        start = tv.Particles([[0.1, 0.1], [0.1, 0.1]], velocity=[[12.6, -13.2], [64.0, 10.5]])
        w = world(start, [tv.Distance([[0, 1]], rest=0.0), tv.Periodic((0, 0), (1.2, 1.2))], substeps=substeps)
        report = w.step(1 / 60)
        assert (FLAG in report.flags) is wrong
        assert wrong or report.energy == pytest.approx((76.6**2 + 2.7**2) / 4, rel=0.05)


@pytest.mark.parametrize("place", ["alone", "one of many"])
def test_a_potential_that_is_wrong_is_found(world, place):
    # E = K - F (|r| - 1) stays; of a potential that is 0, E = K = F (|r| - 1) comes from nowhere, at once.
    for potential, wrong in ((of_push, False), (forgotten, True), (None, False)):
        w = world(*pair(tv.PairForce(push, potential=potential)))
        if place == "alone":
            told = [FLAG in w.step(1 / 60).flags for _ in range(30)]
            assert all(told) if wrong else not any(told)
            assert (FLAG in w.clone().step(1 / 60).flags) is wrong
        else:
            with tv.Worlds(w, 3) as many:
                flags = many.step(1 / 60).flags
                assert flags[FLAG].all() if wrong else not flags
                many.velocity = np.array([[[0.0, 0], [v, 0]] for v in (0.0, 0.0, 100.0)])  # a new start; fast, it is hardly more
                assert many.step(1 / 60).flags.keys() == set()
                flags = many.run(0.2).flags
                assert flags[FLAG].tolist() == [True, True, False] if wrong else not flags


def test_what_works_is_no_fault(world):
    # A particle is lifted, thrown, turned or blown; gravity is turned up; a wall and a pin move; some come with a velocity.
    gravity, pin = tv.Gravity(9.81), tv.Pin([0])
    wall = tv.Capsule((-5.0, -1.0), (5.0, -1.0), 0.2)
    lift = tv.Polygon([[-2, -0.4], [2, -0.4], [2, -0.2], [-2, -0.2]])
    link = tv.Distance([[0, 1]], compliance=1e-3)
    scenes = {
        "force": world(*pair(tv.Force(wind))),
        "wind": world(*pair(tv.Wind((20.0, 0.0), 1.0))),
        "winch": world(*pair(gravity, tv.Winch([[0, 1]], speed=-1.0), pinned=[0])),
        "gravity": world(*pair(g := tv.Gravity(1.0), wall.copy())),
        "pin": world(*pair(pin, tv.Distance([[0, 1]]))),
        "wall": world(*pair(tv.Gravity(9.81), lift)),
        "rest": world(*pair(link)),
        "edited": world(*pair(tv.Gravity(9.81), tv.Contact())),
        "thrown": world(*pair(tv.Gravity(9.81))),
    }
    for k in range(30):
        g.g = 1.0 + k
        pin.target = (0.1 * k, 0.0)
        lift.position = (0.0, 0.05 * k)
        link.rest = 1.0 + 0.05 * k
        if k == 10:
            scenes["edited"].add(tv.Particles([[0.0, 50.0]], radius=0.1, velocity=(0.0, 30.0)))
            scenes["thrown"].velocity = [[10.0, 0.0], [0.0, 30.0]]
        for name, w in scenes.items():
            before = w.last.energy if w.last else None
            report = w.step(1 / 60)
            assert FLAG not in report.flags, (name, k, before, report)
    gained = {name: w.last.energy for name, w in scenes.items()}
    assert all(gained[name] > 0.1 for name in ("force", "wind", "winch", "pin", "wall", "rest", "edited", "thrown")), gained


@pytest.mark.parametrize("place", ["alone", "one of many"])
def test_what_works_from_the_first_frame_on_is_no_fault(world, place):
    # A wall that lifts, and one that turns, before anything was stepped.
    for knob, value in (("position", (0.0, 0.3)), ("rotation", 0.3)):
        lift = tv.Polygon([[-2, -0.4], [2, -0.4], [2, -0.1], [-2, -0.1]])
        w = world(*pair(tv.Gravity(9.81), lift), substeps=8)
        many = tv.Worlds(w, 2) if place == "one of many" else None
        if many:
            many.set(lift, **{knob: [value, getattr(lift, knob)]})
        else:
            setattr(lift, knob, value)
        for _ in range(5):
            assert FLAG not in (many or w).step(1 / 60).flags
        if many:
            assert many.position[0, 1, 1] > many.position[1, 1, 1] + 0.1
            many.close()


def test_what_overlaps_parts_without_a_word(world):
    # Placed into each other, or into a wall, they are pushed out: that is energy, which the overlap had; also where velocities
    # are assigned, or something goes, on the way, and where a wall comes back.
    rng = np.random.default_rng(1)
    x = rng.uniform(0, 1, (40, 2))
    wall = tv.HalfSpace((0, 1), active=False)
    heap = world(tv.Particles(x, radius=0.1), [tv.Gravity(9.81), tv.Contact(), wall])
    alone = world(tv.Particles([[0.0, -0.5]], radius=0.1), [tv.Gravity(9.81), tv.HalfSpace((0, 1))])
    for k in range(90):
        if k == 3:
            heap.velocity = 0 * heap.velocity
            heap.remove([0])
        wall.active = k > 20
        assert not {FLAG} & (heap.step(1 / 60).flags | alone.step(1 / 60).flags), k
    assert alone.last.energy > 0 > alone.last.energy - 9.81 * 0.6


def test_what_forces_err_by_is_no_gain(world):
    # A spring of omega h = 1.5, as a force: Verlet keeps E + O((omega h)^2) of it, up to (omega h)^2 / 8 more.
    w = world(*pair(tv.PairForce(spring, potential=of_spring), velocity=[[-1.5, 0.0], [1.5, 0.0]]), substeps=1)
    h = 1.5 / np.sqrt(2 * STIFF)
    energies = [(report := w.step(h)).energy for _ in range(300)]
    assert max(energies) > 1.1 * energies[0] and FLAG not in report.flags
    assert all(FLAG not in w.step(h).flags for _ in range(300))


def test_less_of_a_force_is_less_to_lose(world):
    # Gravity is turned down: what energy was by the old one is no bound for the new.
    for turned in (False, True):
        gravity = tv.Gravity(2.0 if turned else 1.0)
        w = world(*pair(gravity, tv.PairForce(push, potential=forgotten)))
        w.position = w.position + [0.0, 100.0]
        w.step(1 / 60)
        gravity.g = 1.0
        assert FLAG in w.run(1.0).flags
