"""Bodies placed off their rigid constraints are moved to where these are met, without a gain of energy."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .test_references import line

N, M, G = 20, 0.05, 9.81


def row(n: int = N) -> np.ndarray:
    """Return n + 1 particles, 1 / n apart."""
    return np.stack([np.arange(n + 1) / n, np.zeros(n + 1)], axis=1)


@pytest.mark.parametrize("solver", [tv.Jacobi(), tv.Direct()], ids=str)
def test_links_of_other_lengths_bring_no_energy(world, solver):
    # Rest lengths 17 % too short, 0.05 % too short and 10 % too long. A pass would turn such a violation into C^2 / (2 W h^2), up
    # to 1 800 J at 200 substeps. From one pin the row whips with the energy error of SHAKE, of order h^2: 8e-4 J at 20 substeps.
    # Between two pins, a tenth too long, it has no direction to give way in, and bulges first.
    for pins, factors in (([0], (0.83, 0.9995, 1.1)), ([0, N], (1.1,))):
        links = tv.Distance(line(N), 1 / N)
        w = world(tv.Particles(row(), mass=M, pinned=pins), [tv.Gravity(G), links], solver=solver, precision="f64")
        for factor in factors:
            links.rest = factor / N
            for substeps in (20, 200):
                w.substeps, w.velocity, w.position = substeps, np.zeros((N + 1, 2)), row()
                first = w.step(1 / 60)
                reports = [w.step(1 / 60) for _ in range(20)]
                assert not any("moved" in r.flags for r in reports) and ("moved" in first.flags) == (abs(factor - 1) > 2e-3)
                gain = max(r.energy for r in [first, *reports]) - (first.energy - first.energy_change)
                assert gain < 1e-3 * (20 / substeps) ** 2 + 1e-7 and max(r.residual for r in reports) < 0.1


def test_small_violations_go_without_a_word(world):
    # 5e-4 of the length: no flag, and no velocity of 5e-4 * 1 m / h = 6 m/s at 12 000 substeps/s.
    links = tv.Distance(line(N), (1 - 5e-4) / N)
    w = world(tv.Particles(row(), mass=M, pinned=[0]), [links], substeps=200, precision="f64")
    report = w.step(1 / 60)
    assert report.clean and np.abs(links.violation(w.position)).max() < 1e-6 / N and np.abs(w.velocity).max() < 1e-4
    assert np.abs(w.position[:, 1]).max() == 0 and w.position[-1, 0] == pytest.approx(1 - 5e-4, abs=1e-6)


def test_loads_that_passes_bear_stay(world):
    # One pass of Jacobi holds a hanging chain by violations D F h^2. Assigning the same positions again must not remove them.
    x = row(8)[:, ::-1] * [1, -1]
    w = world(
        tv.Particles(x, mass=M, pinned=[0]), [tv.Gravity(G), tv.Drag(20.0), tv.Distance(line(8))], solver=tv.Jacobi(),
        precision="f64", substeps=4,
    )  # fmt: skip
    w.run(4.0)
    hung, sag = w.position, x[-1, 1] - w.position[-1, 1]
    w.position = hung
    report = w.step(1 / 60)
    assert sag > 5e-3 and np.abs(w.position - hung).max() < 0.05 * sag and "moved" not in report.flags


@pytest.mark.slow
def test_links_that_come_later_bring_no_energy(world):
    # A tie that is a fifth too short is added to a hanging rope: the rope bulges there and is lifted, and nothing flies off. In a
    # frame it falls to 0.16 m/s. A pass would move particles by up to 0.05 m in a substep, 600 m/s at 200 substeps, and leave
    # 84 J.
    x = row()[:, ::-1] * [1, -1]
    w = world(tv.Particles(x, mass=M, pinned=[0]), [tv.Gravity(G), tv.Distance(line(N))], solver=tv.Direct(), precision="f64")
    for substeps in (20, 200):
        w.substeps, w.velocity, w.position = substeps, np.zeros_like(x), x
        w.run(0.1)
        tie = tv.Distance([[5, 10]], rest=0.2)
        w.add(features=[tie])
        reports = [w.step(1 / 60)]
        assert "moved" in reports[0].flags and np.abs(w.velocity).max() < 1.0
        reports += [w.step(1 / 60) for _ in range(20)]
        assert not any("moved" in r.flags for r in reports[1:]) and max(r.residual for r in reports) < 0.1
        assert max(r.energy for r in reports) < reports[0].energy + 1e-3
        w.remove(features=[tie])


def test_who_pushes_through_the_middle_gains_nothing(world):
    # Springs that are longer than the distance of their particles, which pass each other: the push turns by half a turn within a
    # substep. Along the direction at the end of the substep it would work twice. Along the direction at the start, as in Verlet's
    # kick, the energy is kept on average: here over 300 pairs that pass at all distances, in all phases of the substep.
    rng, n = np.random.default_rng(0), 300
    x, v = np.zeros((n, 2, 2)), np.zeros((n, 2, 2))
    x[:, 0, 0], x[:, 1, 0] = -0.1, 0.1
    x[:, :, 1] = 10.0 * np.arange(n)[:, None]
    x[:, 1, 1] += rng.uniform(-2e-3, 2e-3, n)
    v[:, 0, 0] = rng.uniform(8, 10, n)
    v[:, 1] = -v[:, 0]
    start = tv.Particles(x.reshape(-1, 2), velocity=v.reshape(-1, 2), mass=0.05)
    springs = tv.Distance(np.arange(2 * n).reshape(n, 2), 0.3, compliance=0.02)
    w = world(start, [springs], substeps=20, precision="f64")
    reports = [w.step(1 / 60) for _ in range(30)]
    assert any("turned" in r.flags for r in reports)
    assert max(r.energy for r in reports) < 1.01 * (reports[0].energy - reports[0].energy_change)


SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * 0.5


def softly_held(world, **settings):
    """At rest on springs: a weight on a link; one at the end of an arm; a square of a soft cluster on a floor; one that hangs on
    two links, 0.5 m long."""
    x = np.concatenate([[(-3, 5), (-3, 4), (-6, 5), (-5, 5), (-4, 5)], SQUARE, SQUARE + (2, 4), [(2, 5), (2.5, 5)]])
    held = [0, 2, 3, 13, 14]
    features = [
        tv.Distance([[0, 1], [3, 4], [12, 13], [11, 14]], compliance=[0.01, 0, 0, 0]),
        tv.Bend([[2, 3, 4]], compliance=0.02),
        tv.ShapeMatch([[5, 6, 7, 8], [9, 10, 11, 12]], compliance=0.01),
    ]
    others = [tv.Gravity(G), tv.HalfSpace((0, 1), friction=0.5), tv.Drag(8.0)]
    return world(tv.Particles(x, pinned=held), [*features, *others], **({"precision": "f64"} | settings))


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [2, 200])
def test_springs_that_become_rigid_bring_no_energy(world, substeps):
    # What a spring of 0.01 m/N has given way by under 9.81 N is 0.1 m, which a pass would take out in one substep: up to 4e6 J,
    # of a square that its floor sent off, without a flag. They go to where they are met, as if they were placed, and stay there,
    # but for what passes leave of a cluster under its own weight, about 2 g h^2, and of a link that bears it, with 4 g h^2.
    w = softly_held(world, substeps=20)
    w.run(6.0)
    links, bend, shapes = w.features[:3]
    assert w.position[1, 1] == pytest.approx(4 - 0.01 * G, abs=1e-6) and w.position[7, 1] < 0.45
    w.substeps, h = substeps, 1 / 60 / substeps
    for f in (links, bend, shapes):
        f.compliance = 0.0
    with w.clone() as twin:
        reports = [w.step(1 / 60) for _ in range(10)]
        twin.run(10 / 60)
        assert twin.hash() == w.hash()
    assert ["moved" in r.flags for r in reports] == [True] + [False] * 9 and reports[0].flags == {"moved"}
    end = w.position
    np.testing.assert_allclose(end[[1, 4]], [(-3, 4), (-4, 5)], atol=1e-4)
    for square, low in ((end[5:9], 0.0), (end[9:13], 4.0)):
        np.testing.assert_allclose(np.linalg.norm(square - np.roll(square, 1, axis=0), axis=1), 0.5, atol=1e-4 + 3 * G * h * h)
        assert square[:, 1].min() == pytest.approx(low, abs=1e-4 + 8 * G * h * h)
    assert np.abs(w.velocity).max() < 0.01 + G * h / 8


@pytest.mark.slow
def test_each_of_many_worlds_meets_what_becomes_rigid_in_it(world):
    w = softly_held(world, substeps=20)
    w.run(0.5)
    many = tv.Worlds(w, 2)
    with many:
        for k in (0, 2):
            soft = w.features[k].compliance
            w.features[k].compliance = 0.0
            many.set(many.features[k], compliance=[soft, 0 * soft])
        w.run(0.1)
        many.run(0.1)
        assert many.hash(1) == w.hash() != many.hash(0)


def test_rigid_clusters_are_in_shape_where_they_are_placed(world):
    # On a floor, and drawn to a pin by a link: a corner that is put elsewhere takes the others along, and sends nothing off.
    x = np.concatenate([SQUARE, SQUARE + (2, 1), [(2, 2)]])
    shapes = tv.ShapeMatch([[0, 1, 2, 3], [4, 5, 6, 7]])
    w = world(
        tv.Particles(x, pinned=[8]), [tv.Gravity(G), shapes, tv.Distance([[7, 8]]), tv.HalfSpace((0, 1))], substeps=100,
        precision="f64",
    )  # fmt: skip
    w.step(1 / 60)
    bent = w.position.copy()
    bent[[2, 6]] += (0.3, 0.2)
    w.position = bent
    report = w.step(1 / 60)
    assert report.flags == {"moved"} and report.energy < G * bent[:8, 1].sum() and np.abs(w.velocity).max() < 2 * G / 60
    for square in (w.position[:4], w.position[4:8]):
        np.testing.assert_allclose(np.linalg.norm(square - np.roll(square, 1, axis=0), axis=1), 0.5, atol=6 * G / 6000**2)


def lattice(dim, size, step):
    """Return a block of points, (n, dim), and the clusters of all cubes of 2^dim neighbours, or of every other one (step 2)."""
    g = np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1).reshape(-1, dim)
    corners = [np.flatnonzero(((g >= low) & (g <= low + 1)).all(axis=1)) for low in g[(g + 1 < size).all(axis=1)]]
    return 0.2 * g, [c.tolist() for c in corners if step == 1 or g[c[0]].sum() % 2 == 0]


@pytest.mark.parametrize("dim, step, substeps", [(2, 1, 2), pytest.param(3, 1, 200, marks=pytest.mark.slow)])
def test_lattices_that_become_rigid_gain_no_energy(world, dim, step, substeps):
    # All clusters of a lattice together are one rigid body, or, if they share corners only, bodies on hinges. Soft ones that hang
    # from a corner and turn about it go to their rigid shape with the velocities that they have: their energy is m g y there, and
    # the kinetic energy before, at most. Passes would make up to 4e5 J of 87. Clusters keep the shape of their cube: its sides
    # and diagonals.
    x, clusters = lattice(dim, (5, 3, 3)[:dim], step)
    shapes, corner = tv.ShapeMatch(clusters, compliance=2e-4, damping=0.2), len(x) - 1
    w = world(tv.Particles(x, pinned=[corner]), [tv.Gravity(9.81), shapes], substeps=substeps)
    w.run(15 / 60)
    kinetic, arm, q = tv.measure.kinetic_energy(w), w.position - x[corner], x - x[corner]
    shapes.compliance = 0.0
    reports = [w.step(1 / 60) for _ in range(8)]
    before = reports[0].energy - reports[0].energy_change
    if dim == 2 and step == 1:  # the rotation that fits best about the corner
        turn = np.angle(((arm[:, 0] + 1j * arm[:, 1]) * (q[:, 0] - 1j * q[:, 1])).sum())
        height = x[corner, 1] + np.sin(turn) * q[:, 0] + np.cos(turn) * q[:, 1]
        assert before == pytest.approx(kinetic + 9.81 * np.delete(height, corner).sum(), rel=0.01)
    assert [bool({"moved"} & r.flags) for r in reports] == [True] + [False] * 7
    assert max(r.energy for r in reports) < before + 0.01 * abs(before)
    if substeps == 200:  # passes leave little of the load
        for c in clusters:
            far = [np.linalg.norm(p[c][:, None] - p[c][None], axis=2) for p in (x, w.position)]
            np.testing.assert_allclose(far[0], far[1], atol=2e-4)


def test_clusters_that_contradict_each_other_say_so_and_stay_passive(world):
    # Two sets of clusters want one block, and one 1.2 times as large. Passes would end at the least sum of m / n times squares,
    # which is a block in between, since all weights are equal: no force moves it from there, and the report gives what is left.
    x, clusters = lattice(2, (4, 3), 1)
    shapes = [tv.ShapeMatch(clusters, rest=k * x) for k in (1.0, 1.2)]
    w = world(tv.Particles(x), [tv.Gravity(0.0), *shapes], substeps=20, precision="f64")
    reports = [w.step(1 / 60) for _ in range(20)]
    assert "moved" in reports[0].flags and all("unconverged" in r.flags for r in reports) and shapes[0].residual.min() > 0.08
    assert max(r.energy for r in reports) < 1e-4
    np.testing.assert_allclose(np.ptp(w.position, axis=0), 1.1 * np.ptp(x, axis=0), rtol=0.01)


def direction(x):
    """Return the angle of a place, whose gradient 1 / |x| falls so fast that one Newton step from afar goes past the goal."""
    return ti.atan2(x.x, 1.0)


@pytest.mark.slow
def test_bodies_without_extent_are_moved_without_velocity(world):
    # A bead of a user's constraint at x = 20: a step of -atan(20) (1 + 20^2) went to -590 m, and the next ones to 1e14 m.
    bead = world(tv.Particles([[20.0, 0.4]]), [tv.Constraint(direction, [0], rest=0.0)])
    # Three particles in one place, with two links and a straight angle, left it at 6 m/s; now at a digit of f32 in a substep.
    chain = world(tv.Particles([[0.0, 1.0]] * 3), [tv.Distance([[0, 1], [1, 2]], rest=1.0), tv.Bend([[0, 1, 2]], rest=0.0)])
    for w, place in ((bead, [[0.0, 0.4]]), (chain, [[1.0, 1.0], [0.0, 1.0], [-1.0, 1.0]])):
        assert w.step(1 / 60).flags == {"moved"}
        np.testing.assert_allclose(w.position, place, atol=1e-6)
        assert np.abs(w.velocity).max() < 2.0**-23 * 60 * w.substeps


def scene():
    """Return particles and features with all that can be shifted: walls, pins that drive and draw, forces, contacts."""
    rope = tv.shapes.rope((1.0, 3.0), (2.0, 3.0), 6)
    x = np.vstack([rope.position, [(0.3, 0.1), (0.52, 0.1), (0.4, 0.29), (3.5, 0.6), (2.2, 2.5)]])
    features = [
        tv.Gravity(9.81), tv.Drag(0.1), tv.Distance(rope.links), tv.Pin([0], [(1.0, 3.0)]),
        tv.Pin([5], [(2.1, 3.0)], compliance=1e-3), tv.Capsule((2, 1), (2.5, 1.2), 0.1),
        tv.HalfSpace((0.0, 1.0), 0.0, friction=0.4), tv.Box((0, -1), (4, 9)), tv.Ball((3.4, 0.2), 0.3),
        tv.Polygon([(0, 0), (0.5, 0), (0, 0.5)], position=(1.2, 0.0)), tv.Attractor((2.0, 8.0), 0.5), tv.Contact(friction=0.3),
    ]  # fmt: skip
    return tv.Particles(x, radius=0.1), features


@pytest.mark.slow
def test_a_shifted_scene_goes_on_as_it_was(world, tmp_path):
    # Everything but the origin stays: floating origin. In f64, 1000 m away, positions agree to the digits that are left there.
    by = np.array([-1024.0, -256.0])
    start, features = scene()
    w = world(start, features, precision="f64", substeps=8)
    w.run(0.3)
    features[8].center = (3.42, 0.2)  # walls that move on
    w.step(1 / 60)
    twin = w.clone()
    with tv.Recorder(tmp_path / "shift.rrd", twin) as recorder:
        twin.shift(by)
        np.testing.assert_array_equal(twin.position, w.position + by)
        for _ in range(20):
            features[8].center = features[8].center + [0.001, 0.0]
            twin.features[8].center = twin.features[8].center + [0.001, 0.0]
            a, b = w.step(1 / 60), twin.step(1 / 60)
            recorder.log()
            assert a.flags == b.flags == frozenset()
    np.testing.assert_allclose(twin.position - by, w.position, atol=1e-9)
    np.testing.assert_allclose(twin.velocity, w.velocity, atol=1e-8)
    assert tv.replay(tmp_path / "shift.rrd").verify()


def test_what_is_fixed_in_space_is_named(world):
    w = world(tv.Particles([(0.5, 0.5)]), [tv.Periodic((0, 0), (1, 1))])
    with pytest.raises(ValueError, match="Periodic.* is fixed in space. Remove it"):
        w.shift((1.0, 0.0))


def test_what_is_placed_has_no_speed(world):
    # A floor that is raised during a frame throws a disc up at 6 m/s; one that is there at once does not.
    for place in (False, True):
        floor, hand = tv.HalfSpace((0, 1), 0.0), tv.Pin([1], [(3.0, 3.0)])
        w = world(tv.Particles([(0.0, 0.3), (3.0, 3.0)], radius=0.1), [tv.Gravity(0.0), floor, hand], precision="f64")
        w.step(1 / 60)
        if place:
            w.place(floor, offset=0.1)
            w.place(hand, target=[(5.0, 3.0)])
            np.testing.assert_allclose(w.position[1], (5.0, 3.0))
        else:
            floor.offset, hand.target = 0.3, [(5.0, 3.0)]
        w.step(1 / 60)
        speed = np.abs(w.velocity).max(axis=1)
        assert (speed < 1e-9).all() if place else (speed > [5.0, 100.0]).all()
    with pytest.raises(TypeError, match="has no knob height; it has .*offset"):
        w.place(floor, height=1.0)
    with pytest.raises(ValueError, match="no wall, Pin or Path"):
        w.place(w.features[0], g=1.0)


def pile_beside_a_chain(world):
    """Return a world with a heap of discs, events, and a chain that hangs beside it."""
    n, links = 20, np.stack([np.arange(20, 27), np.arange(21, 28)], axis=1)
    heap = np.stack([0.11 * (np.arange(n) % 5), 0.06 + 0.11 * (np.arange(n) // 5)], axis=1)
    chain = np.stack([np.full(8, 3.0), 1.0 - 0.1 * np.arange(8)], axis=1)
    contact = tv.Contact(friction=0.4, events=True)
    features = [tv.Gravity(G), contact, tv.Box((-0.05, 0), (5, 5)), tv.Distance(links, 0.1), tv.Drag(0.2)]
    return world(tv.Particles(np.vstack([heap, chain]), radius=0.05, pinned=[20]), features, substeps=4)


@pytest.mark.slow
def test_what_settles_changes_no_bit_elsewhere(world):
    # A chain is pulled out of shape beside a heap. It settles; positions, velocities, contacts and events of the heap are those
    # of a world in which the same positions were assigned.
    a, b = (pile_beside_a_chain(world) for _ in range(2))
    for w in (a, b):
        w.run(0.5)
    x = a.position.copy()
    x[22:] += np.stack([np.linspace(0.05, 0.4, 6), np.zeros(6)], axis=1)
    a.position, b.position = x, b.position
    for _ in range(3):
        a.step(1 / 60)
        b.step(1 / 60)
        assert np.array_equal(a.position[:20], b.position[:20]) and np.array_equal(a.velocity[:20], b.velocity[:20])
        assert len(a.contacts) == len(b.contacts) and np.array_equal(a.contacts.impulse, b.contacts.impulse)
        events = [[getattr(w.events(), k).pairs.tolist() for k in ("begun", "lasting", "ended")] for w in (a, b)]
        assert events[0] == events[1] and len(events[0][1])
    assert np.abs(a.features[3].violation(a.position)).max() < 1e-4 and np.abs(a.velocity[20:]).max() < 3 * G / 60


@pytest.mark.slow
def test_what_settles_stays_on_its_side_of_walls(world):
    # A square of links and diagonals that are 1.3 times as long stands on a floor beside a wall, and hangs by a rope that is too
    # short: it grows away from both, and nothing is inside of a wall at any time.
    x = np.vstack([SQUARE + (0.0, 0.0), [(0.25, 2.0)]])
    pairs = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)]
    links = tv.Distance(pairs, [0.65] * 4 + [0.65 * np.sqrt(2)] * 2)
    features = [tv.Gravity(G), links, tv.Rope([[2, 4], [3, 4]], 1.45), tv.Box((0, 0), (9, 9)), tv.Contact()]
    w = world(tv.Particles(x, radius=0.01, pinned=[4]), features, precision="f64")
    report = w.step(1 / 60)
    assert "moved" in report.flags and w.position.min() > -1e-6 and np.abs(w.velocity).max() < 2 * G / 60
    assert np.abs(links.violation(w.position)).max() < 1e-3 * 0.65


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Box")
def test_what_settles_among_contacts_has_the_same_bits_on_all_paths(world):
    # A chain of discs three times as long as its links: drawn together it passes drops, and the neighbour list is built anew many
    # times in between. Later it is pulled apart again.
    x = np.vstack([0.3 * np.stack([np.arange(40), np.zeros(40)], axis=1), (0, 0.3) + tv.golden(np.arange(60), dim=2) * (4, 1.2)])
    links, found = np.stack([np.arange(39), np.arange(1, 40)], axis=1), []
    for path in ("fused", "launched"):
        contact = tv.Contact(friction=0.4, events=True)  # the structure of pile_beside_a_chain()
        features = [tv.Gravity(G), contact, tv.Box((-5, -0.5), (9, 9)), tv.Distance(links, 0.1), tv.Drag(0.2)]
        w = world(tv.Particles(x, radius=0.045, pinned=[0]), features, substeps=4, path=path)
        w.step(1 / 60)
        first = w.hash()
        pulled = w.position.copy()
        pulled[1:40, 0] += np.linspace(0, 6, 39)
        w.position = pulled
        report = w.step(1 / 60)
        assert "moved" in report.flags and np.abs(features[3].violation(w.position)).max() < 2e-4  # 2e-3 of a link
        found.append((first, w.hash()))
    assert found[0] == found[1]
