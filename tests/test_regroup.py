"""Adding to a world and removing from it: the rest continues bit for bit, and new particles start as in their own world."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.features.feature import Batch
from tiverlet.step import checkpoint
from tiverlet.step.runner import Runner

pytestmark = pytest.mark.usefixtures("read_here")


def half(x: float):
    """Return the positions of one of everything, around (x, 0)."""
    rope = np.stack([np.linspace(0, 1.5, 6), np.full(6, 2.0)], axis=1)
    ring = 0.4 * np.stack([np.cos(np.arange(7) * 0.9), np.sin(np.arange(7) * 0.9)], axis=1) + [0.5, 0.9]
    block = np.array([[2.0, 1], [2.4, 1], [2.4, 1.4], [2.0, 1.4]])
    heap = np.stack(np.meshgrid([0.3, 0.501], [0.1, 0.301]), axis=-1).reshape(-1, 2) + [2.4, 0]
    rails = np.array([[3.0, 2], [3.5, 2.5], [3.2, 1]])
    return np.concatenate([rope, ring, block, heap, rails]) + [x, 0]


def everything():
    """Return two halves 20 m apart, with rows of both in every batch: particles and features."""
    x = np.concatenate([half(0.0), half(20.0)])
    n = len(x) // 2

    def both(rows):
        rows = np.asarray(rows)
        return np.concatenate([rows, rows + n])

    k = np.arange(6)
    ring = 6 + np.arange(7)
    strong = np.tile([1e9, 1e9, 1e9, 1e9, 0.5], 2)
    rope = tv.Distance(both(np.stack([k[:-1], k[1:]], axis=1)), compliance=1e-4, damping=0.1, break_at=strong)
    rim = tv.Distance(both(np.stack([ring, np.roll(ring, -1)], axis=1)))
    cells = tv.Area([ring, ring + n], pressure=1.05)
    blocks = tv.ShapeMatch(both([13 + np.arange(4)]), compliance=1e-3, creep=3.0)
    hand = tv.Pin(both([0]))
    cart = tv.Path(both([21]), [[0.0, 4], [9.0, 5]], speed=0.3)
    tidy = tv.Snap(both([23]), 0.3, compliance=1e-2)
    features = [
        tv.Gravity(9.81), rope, rim, cells, blocks, hand, cart, tidy, tv.Contact(), tv.Box((-9, 0), (99, 9)),
    ]  # fmt: skip
    return tv.Particles(x, radius=np.tile(np.where(np.arange(n) < 17, 0.01, 0.1), 2), mass=0.3), features


@pytest.mark.slow
def test_what_stays_goes_on_to_the_bit(world):
    start, features = everything()
    n = len(start) // 2
    _, rope, rim, cells, _, hand, _, tidy, _, _ = features
    w = world(start, features, solver=tv.Jacobi(), substeps=6)

    batches = [rope, rim, cells, tidy]
    counts = [f.count // 2 for f in batches]

    def lead():
        rope.break_at = rope.break_at * 0.99  # knobs wait to be uploaded, and a target is moving
        hand.target = hand.target + [0.0, 0.05]

    def look():
        return [w.position[:n], w.velocity[:n], *(f.load[:k] for f, k in zip(batches, counts, strict=True))]

    w.run(0.4)
    lead()
    w.step(1 / 60)
    lead()
    kept, knobs = checkpoint.keep(w), (rope.break_at, hand.target, hand.moving)
    before = w.run(0.3)
    without = look()
    checkpoint.put_back(w, kept)
    rope.break_at, hand.target = 2 * knobs[0], knobs[1] + 1.0  # so that the same values wait to be uploaded once more
    rope.break_at, hand.target, hand.moving = knobs
    x, v = w.position, w.velocity
    # Twice as heavy: from three times on, contacts have other kernels, see the last test.
    new = w.add(tv.Particles([[50.0, 5.0], [50.3, 5.0]], velocity=(0.0, 1.0), radius=0.1, mass=0.6))
    np.testing.assert_array_equal(w.position[: 2 * n], x)
    np.testing.assert_array_equal(w.velocity[: 2 * n], v)
    np.testing.assert_allclose(w.velocity[new], [[0, 1], [0, 1]], atol=1e-6)
    assert w.features == tuple(features) and len(new) == 2 and w.time == pytest.approx(0.4 + 1 / 60)
    w.run(0.2)
    right = w.handle(np.arange(n, 2 * n))
    x, v = w.position, w.velocity
    # Remove one particle of each constraint in the right half, with its constraints, and a disc; the rest of that half flies on.
    gone = n + np.array([0, 2, 4, 6, 7, 9, 11, 13, 17, 21, 22, 23])
    w.remove(np.concatenate([gone, new.indices]))
    some = np.setdiff1d(np.arange(2 * n), gone)
    np.testing.assert_array_equal(w.position, x[some])
    np.testing.assert_array_equal(w.velocity, v[some])
    assert len(new) == 0 and len(w.position) == 2 * n - len(gone)
    np.testing.assert_array_equal(right.indices, np.arange(n, len(some)))
    np.testing.assert_array_equal(w.position[right], x[some[n:]])
    assert [f.count for f in features if isinstance(f, Batch)] == [5, 7, 1, 1, 1, 1, 1] and w.features == tuple(features)
    # Until 0.36 s on, the rope lies on the rim: passes over contacts are extrapolated anew for all of them together, so what the
    # other half no longer does changes the last digits.
    after = w.run(0.1)
    for a, b in zip(look(), without, strict=True):
        np.testing.assert_array_equal(a, b)
    assert rope.broken.tolist() == [False] * 4 + [True] and after.flags <= before.flags
    assert len(rope.residual) == 5 and w.contacts.pairs.max() < len(some)
    twin = w.clone()
    assert twin.hash() == w.hash()
    twin.close()


@ti.func
def magnet(x, v):
    """Return a force across the velocity plus a spring."""
    return 3.0 * ti.Vector([v[1], -v[0]]) - x


@pytest.mark.parametrize("last", [tv.Drag(0.4), tv.Force(magnet)], ids=repr)
def test_what_comes_starts_as_in_a_world_of_its_own(world, last):
    # Thrown into a running world between two substeps: the same motion as from a start there, to rounding. With drag and forces
    # that read velocities, this takes more than d = h v - h^2 g / 2.
    def features():
        return [tv.Gravity(9.81), last.copy()]

    x, v = np.array([[0.5, 1.0]]), np.array([[2.0, -1.0]])
    alone = world(tv.Particles(x, velocity=v), features(), precision="f64")
    w = world(tv.Particles([[9.0, 9.0]], velocity=(1, 1)), features(), precision="f64")
    w.run(0.2)
    first = w.last.energy
    new = w.add(tv.Particles(np.concatenate([x, x]), velocity=np.concatenate([v, v]), pinned=[1]))
    np.testing.assert_allclose(w.velocity[new], [v[0], [0, 0]], atol=1e-12)
    report = w.step(1 / 60)
    alone.step(1 / 60)
    # The energy account continues: it counts the frame, not the added particles.
    change = 0.5 * (v**2).sum() + 9.81 * x[0, 1]
    assert abs(report.energy_change) < 0.1 * change and report.energy > first + 0.5 * change
    w.run(0.4)
    alone.run(0.4)
    np.testing.assert_allclose(w.position[new], [alone.position[0], x[0]], atol=1e-12)
    np.testing.assert_allclose(w.velocity[new][0], alone.velocity[0], atol=1e-11)


@pytest.mark.slow
def test_forces_and_constraints_come_and_go(world):
    # A straight line, then a parabola, then a straight line again: exact, because forces change between a velocity and the next
    # substep. Besides, links take their rest lengths from the present positions; and a disc that is put into another parts from
    # it slowly.
    x, v = np.array([[0.0, 0], [5, 0], [6, 0], [7, 0]]), np.array([1.0, 2.0])
    w = world(tv.Particles(x, velocity=v, radius=[0.0, 0.4, 0.4, 0.4]), [], precision="f64")
    w.run(0.2)
    gravity, link = tv.Gravity(9.81), tv.Distance([[1, 2], [2, 3]])
    w.add(features=[gravity, link])
    gravity.g = 3.0
    w.run(0.3)
    g = np.array([0.0, -3.0])
    np.testing.assert_allclose(w.position, x + 0.5 * v + 0.5 * 0.3**2 * g, atol=1e-12)
    assert link.rest == pytest.approx([1.0, 1.0], abs=1e-12) and "Direct" in w.explain()
    w.remove(features=[gravity])
    assert gravity.scene is None and w.features == (link,)
    w.velocity = w.velocity * [1, 0]
    disc = w.add(tv.Particles(w.position[1:2] + [-0.5, 0.0], velocity=(1, 0), radius=0.4), [tv.Contact(push_out=0.1)])
    start, moving = w.position, w.velocity
    report = w.run(0.3)
    assert report.overlap < 1.0 and np.abs(w.velocity - moving).max() <= 0.2
    gap = np.linalg.norm(w.position[disc][0] - w.position[1])
    assert gap == pytest.approx(0.5 + 0.1 * 0.3, abs=0.01)
    np.testing.assert_allclose(w.position.sum(axis=0) - start.sum(axis=0), 0.3 * moving.sum(axis=0), atol=1e-12)
    w.remove([2])
    assert link.count == 0 and len(link.load) == len(link.residual) == len(link.broken) == 0
    assert not any(name.startswith(("Distance", "slots")) for name in w.fields)
    w.remove(w.handle([True] * 4))
    assert w.step(0.1).clean and w.position.shape == (0, 2)


def test_bodies_go_whole_and_numbers_follow():
    # Without a world: a tetrahedral surface, a body of Polygons, limits, and their arrays, when particles 2 and 5 of 12 are
    # removed.
    number = np.array([0, 1, -1, 2, 3, -1, 4, 5, 6, 7, 8, 9])
    four = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
    volume = tv.Volume(np.concatenate([four, four + 8]), pressure=[1.0, 2.0])
    limit = tv.AngleLimit([[0, 1, 2], [3, 4, 6]], [0.1, 0.2], [0.3, 0.4], compliance=[1.0, 2.0])
    polygons = tv.Polygons([[0, 1, 2], [8, 9, 10]])
    shape = tv.ShapeMatch([[0, 3, 2], [4, 6, 7]], rest=np.arange(24.0).reshape(12, 2), compliance=[1.0, 2.0])
    for f in (volume, limit, polygons, shape):
        f.remap_indices(number, 11)
    assert volume.count == 1 and volume.pressure.tolist() == [2.0] and volume.indices.tolist() == [6, 7, 8, 9]
    np.testing.assert_array_equal(np.sort(volume.quantity.faces, axis=1), np.sort(four + 6, axis=1))
    assert volume.quantity.surface.tolist() == [0, 0, 0, 0]
    assert limit.indices.tolist() == [[2, 3, 4]] and (limit.lower, limit.upper, limit.compliance) == ([0.2], [0.4], [2.0])
    assert [loop.tolist() for loop in polygons.loops] == [[6, 7, 8]]
    assert shape.indices.tolist() == [3, 4, 5] and shape.compliance.tolist() == [2.0] and shape._rest.shape == (11, 2)
    assert shape._rest[[3, 4, 5]].tolist() == [[8.0, 9.0], [12.0, 13.0], [14.0, 15.0]]


def fails(*given):
    """Fail after most of the edit is done."""
    raise KeyError("late")


def test_after_an_error_the_world_is_as_before(world, monkeypatch):
    x = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    link, pin, used = tv.Distance([[0, 1], [1, 2]], compliance=1e-3), tv.Pin([0]), tv.Gravity(1.0)
    w = world(tv.Particles(x), [tv.Gravity(), link, pin], solver=tv.Jacobi())
    world(tv.Particles(x), [used])
    w.run(0.1)
    before, rest = w.hash(), link.rest
    more = tv.Particles([[3.0, 0, 0]])
    with pytest.raises(TypeError, match=r"World.add: particles = \[\[0"):
        w.add([[0.0, 0, 0]])
    with pytest.raises(ValueError, match="World.add: particles are in 2D, but the world is in 3D"):
        w.add(tv.Particles([[0.0, 0]]))
    with pytest.raises(TypeError, match=r"World.add: features = Drag.*write a list"):
        w.add(features=tv.Drag(1.0))
    with pytest.raises(ValueError, match="already acts in another world"):
        w.add(features=[used])
    with pytest.raises(ValueError, match="already acts"):
        w.add(features=[link])
    with pytest.raises(ValueError, match=r"Rope: pairs\[0\] = \(3, 4\), but there are 4 particles"):
        w.add(more, [tv.Gravity(1.0), tv.Rope([[3, 4]])])
    with pytest.raises(ValueError, match=r"order = 4, but Contact is one-sided"):
        world(tv.Particles(x, radius=0.1), precision="f64", order=4).add(features=[tv.Contact()])
    with pytest.raises(ValueError, match="too large for f32"):  # found late, when the force has already requested a start
        w.add(more, [tv.Gravity(1.0), tv.Volume([[0, 1, 2, 3]], rest=1e30)])
    with pytest.raises(ValueError, match=r"World.remove: features\[0\] = Gravity does not act in this world"):
        w.remove(features=[used])
    with pytest.raises(ValueError, match=r"World.remove: particles\[1\] = 3, but there are 3"):
        w.remove([0, 3])
    with pytest.raises(ValueError, match=r"mask of shape \(3,\)"):
        w.handle([True])
    with monkeypatch.context() as patch, pytest.raises(KeyError, match="late"):  # when the world already has its new parts
        patch.setattr(Runner, "pass_on", fails)
        w.add(more, [tv.Gravity(1.0)])
    assert w.hash() == before and w.features[1] is link and (link.rest == rest).all() and len(w.particles) == 3
    w.run(0.1)
    assert w.add() is not None and w.time == pytest.approx(0.2)


@pytest.mark.slow
def test_a_recording_begins_after_what_came_and_went(world, tmp_path):
    # A rebuilt world is recorded as it is now, with features that were added when particles had left their first positions.
    x = np.array([[0.0, 0], [1, 0], [2, 0], [3, 0], [4, 0], [5, 0]])
    links = tv.Rope([[0, 1], [1, 2], [3, 4], [4, 5]], [1.0, 1.01, 1.02, 1.03])
    w = world(tv.Particles(x, pinned=[0, 3]), [tv.Gravity(), links, tv.Pin([5], compliance=[1e-2])], precision="f64")
    w.run(0.3)
    w.remove([1])
    w.add(tv.Particles([[9.0, 0.0]]), [tv.Distance([[4, 5]], compliance=1e-3), tv.Area([[1, 3, 5]])])
    assert links.indices.tolist() == [[2, 3], [3, 4]] and links.rest.tolist() == [1.02, 1.03]
    w.run(0.1)
    with tv.Recorder(tmp_path / "later.rrd", w) as recorder:
        for _ in range(3):
            w.step(1 / 60)
            recorder.log()
    assert tv.replay(tmp_path / "later.rrd").verify()


@pytest.mark.slow
def test_a_clone_parts_what_came_into_others_as_the_world_does(world):
    # Not stepped since: overlap depends on where particles are, not on where they were when the world began.
    x = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0)), axis=-1).reshape(-1, 2) * 1.05 + [0.6, 3.0]
    contact = tv.Contact(friction=0.4, push_out=1.0)
    w = world(tv.Particles(x, radius=0.5), [tv.Gravity(9.81), contact, tv.Box((0, 0), (4.5, 9))], substeps=4)
    w.run(1.5)
    w.add(tv.Particles(w.position[5:6] + 0.3, radius=0.5))
    twin = w.clone()
    for _ in range(3):
        assert w.step(1 / 60).overlap > 0.1
        twin.step(1 / 60)
        np.testing.assert_array_equal(twin.position, w.position)
    # Beside a much heavier disc, which takes other kernels, the rest goes on to the bit.
    twin.add(tv.Particles([[2.2, 8.4]], radius=0.5, mass=4.0))
    w.run(0.1)
    twin.run(0.1)
    np.testing.assert_array_equal(twin.position[:-1], w.position)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["wall", "floor", "last"])
def test_loads_stay_with_their_walls_where_walls_come_and_go(world, which):
    # habitat-sim#801, reactphysics3d#235: what lay on a floor that is removed hangs in the air. Here it fell on with the load of
    # another wall, or, if there was none, the process ended. A disc lies in a corner of two walls of one kind.
    floor, wall, far = tv.HalfSpace((0, 1)), tv.HalfSpace((1, 0)), tv.HalfSpace((-1, 0), -9.0)
    walls = {"wall": [wall, floor], "floor": [floor, wall], "last": [floor]}[which]
    disc = tv.Particles([[0.1, 0.1]], radius=0.1, mass=2.0)
    w = world(disc, [tv.Gravity((-30.0 if which != "last" else 0.0, -10.0)), tv.Contact(), *walls], substeps=20, precision="f64")
    w.run(0.5)
    assert np.abs(w.position - 0.1).max() < 1e-12
    if which != "last":
        w.add(features=[far])  # its code is that of the others, so faces get other numbers
    w.remove(features=[walls[0]])
    w.run(0.5)
    fall = np.array([-30.0 if which == "wall" else 0.0, 0.0 if which == "wall" else -10.0]) / 8
    np.testing.assert_allclose(w.position[0] - 0.1, fall, atol=10 * 0.5 / 1200)
