"""Constraints added to features of a world: as if they had been there from the start, and nothing is compiled."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device.patches import patched
from tiverlet.features.arguments import knobs_of
from tiverlet.step import checkpoint

from .conftest import ARCH, compiled

pytestmark = pytest.mark.usefixtures("read_here")
ROPE = np.stack([0.3 * np.arange(6), np.full(6, 2.0)], axis=1)
RING = 0.4 * np.stack([np.cos(np.arange(7) * 0.9), np.sin(np.arange(7) * 0.9)], axis=1) + [0.5, 0.9]
BLOCK = np.array([[2.0, 1], [2.4, 1], [2.4, 1.4], [2.0, 1.4]])
LINKS = np.stack([np.arange(5), np.arange(1, 6)], axis=1)


RIM = 6 + np.stack([np.arange(7), np.roll(np.arange(7), -1)], axis=1)


def ropes(some: list[int]) -> list:
    """Ropes, of which all but the first can break, slack ropes beside them, and corners with limited angles."""
    k, all_of = np.array(some), several(some, len(ROPE))
    torn = np.repeat(np.where(k > 0, 1e3 * k, np.inf), 5) if k.any() else None
    lengths = np.tile([0.4, 0.5, 0.31], len(k))
    return [
        tv.Distance(all_of(LINKS), break_at=torn), tv.Rope(all_of(LINKS[:3]), lengths),
        tv.AngleLimit(all_of([[1, 2, 3]]), -0.4, 0.1 * (k + 1)),
    ]  # fmt: skip


def bodies(some: list[int]) -> list:
    """Bodies of soft links, outlines and shapes, each softer than the one before."""
    k, all_of = np.array(some), several(some, len(ROPE) + len(RING) + len(BLOCK))
    soft = np.repeat(1e-4 * (k + 1), 5)
    return [
        tv.Distance(all_of(LINKS), compliance=soft, damping=0.1), tv.Distance(all_of(RIM)),
        tv.Area(all_of([6 + np.arange(7)]), pressure=1.05 + 0.1 * k),
        tv.ShapeMatch(all_of([13 + np.arange(4)]), compliance=1e-3, creep=2.0 + k), tv.Spacer(all_of([[0, 14]]), 0.2),
    ]  # fmt: skip


PLACES = {ropes: ROPE, bodies: np.concatenate([ROPE, RING, BLOCK])}


def several(some: list[int], n: int):
    """Return a function that repeats rows of constraints for copies of n particles each."""
    return lambda rows: np.concatenate([np.asarray(rows) + n * k for k in some])


def placed(kind, some: list[int]) -> tv.Particles:
    """Return the particles of these copies, 20 m apart."""
    n = len(PLACES[kind])
    x = np.concatenate([PLACES[kind] + [20.0 * k, 0] for k in some])
    return tv.Particles(x, radius=0.02, pinned=n * np.arange(len(some)))


def world_of(kind, number: int) -> tv.World:
    """Build a world of the first `number` copies, with gravity and a floor."""
    some = list(range(number))
    features = [*kind(some), tv.Gravity(), tv.HalfSpace((0, 1), 0.0)]
    return tv.World(placed(kind, some), features, substeps=5, solver=tv.Jacobi() if kind is bodies else None)


def extended(w: tv.World, kind, k: int) -> None:
    """Add copy k to a world."""
    w.add(placed(kind, [k]), extend=dict(zip(w.features, kind([k]), strict=False)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [ropes, bodies])
def test_a_world_that_was_extended_is_the_one_that_has_all(kind, tmp_path):
    whole, w = world_of(kind, 3), world_of(kind, 1)
    for k in (1, 2):
        extended(w, kind, k)
    for _ in range(30):
        assert w.step(1 / 60).residual == whole.step(1 / 60).residual
    assert w.hash() == whole.hash()
    with w.clone() as twin:
        assert twin.hash() == w.hash()
    whole.close()
    # Between two frames: particles that were there continue bit for bit, and the edit can be undone and replayed.
    n = len(w.particles)
    with w.clone() as without, tv.Recorder(tmp_path / "more.rrd", w) as recorder, compiled() as names:
        extended(w, kind, 3)
        kept = checkpoint.keep(w)
        for _ in range(10):
            w.step(1 / 60)
            recorder.log()
            without.step(1 / 60)
        if kind is ropes:  # springs added to bodies turn displacements into velocities
            np.testing.assert_array_equal(w.position[:n], without.position)
    after = w.hash()
    checkpoint.put_back(w, kept)
    w.run(10 / 60)
    assert w.hash() == after and tv.replay(tmp_path / "more.rrd").verify()
    assert not patched or ARCH != "cpu" or set(names) <= {"velocities", "to_velocity"}  # not requested before
    w.close()


OCTAHEDRON = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1.0]])
SIDES = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
MACHINE = np.concatenate([[[0, 0, 0], [1, 0, 0], [1.5, 0.5, 0], [3, 1, 0], [3, 0, 0], [4.3, 0, 0]], OCTAHEDRON + [6, 0, 0]])


def machines(some: list[int]) -> list:
    """A hinge that turns, a rope that is wound up, a grid and a closed surface."""
    k, all_of = np.array(some), several(some, len(MACHINE))
    return [
        tv.Motor(all_of([[0, 1, 2]]), 1.0 + k, torque=5.0), tv.Winch(all_of([[3, 4]]), -0.3 * (k + 1.0)),
        tv.Snap(all_of([5]), 1.0, compliance=0.01 * (k + 1)), tv.Volume(all_of(6 + SIDES), pressure=1.1 + k, compliance=1e-3),
    ]  # fmt: skip


@pytest.mark.slow
def test_drives_grids_and_surfaces_take_more_as_links_do(tmp_path):
    def made(some):
        x = np.concatenate([MACHINE + [20.0 * k, 0, 0] for k in some])
        return tv.Particles(x, pinned=(len(MACHINE) * np.arange(len(some))[:, None] + [0, 1, 3]).ravel())

    w, whole = (tv.World(made(some), machines(some), substeps=2, precision="f64") for some in ([0], [0, 1, 2]))
    for k in (1, 2):
        w.add(made([k]), extend=dict(zip(w.features, machines([k]), strict=True)))
    w.run(0.1)
    whole.run(0.1)
    assert w.hash() == whole.hash() and w.features[1].rest.tolist() == pytest.approx([0.97, 0.94, 0.91])
    with tv.Recorder(tmp_path / "more.rrd", w) as recorder:
        w.add(made([3]), extend=dict(zip(w.features, machines([3]), strict=True)))
        w.step(1 / 60)
        recorder.log()
    assert tv.replay(tmp_path / "more.rrd").verify() and w.features[3].count == 4
    with pytest.raises(TypeError, match="one Motor turns to an angle"):
        w.add(extend={w.features[0]: tv.Motor([[0, 1, 2]], 1.0, angle=1.0)})
    with pytest.raises(TypeError, match="Snap of spacing = 1.0 cannot take one of spacing = 2.0"):
        w.add(extend={w.features[2]: tv.Snap([0], 2.0, compliance=0.01)})
    w.close()
    whole.close()


@pytest.mark.slow
def test_what_comes_moves_as_under_a_feature_of_its_own():
    # One more link of a swinging rope, and a link to an existing particle, which starts at its current length.
    def scene():
        rope = tv.Distance(LINKS[:4])
        particles = tv.Particles(np.concatenate([ROPE[:5], [[5.0, 3.0]]]), pinned=[0])
        w = tv.World(particles, [tv.Gravity(), rope], precision="f64")
        w.run(0.2)
        return w, rope

    (w, rope), (other, _) = scene(), scene()
    place = w.position[[4]] + [0.2, 0.1]
    w.add(tv.Particles(place), extend={rope: tv.Distance([[4, 6], [3, 5]])})
    alone = tv.Distance([[4, 6], [3, 5]])
    other.add(tv.Particles(place), [alone])
    assert rope.count == 6 and rope.rest[-2:].tolist() == alone.rest.tolist()
    for _ in range(30):
        a, b = w.step(1 / 60), other.step(1 / 60)
        assert a.clean and abs(a.energy - b.energy) < 1e-9
    np.testing.assert_allclose(w.position, other.position, rtol=0, atol=1e-9)
    w.close()
    other.close()


def test_a_feature_takes_its_own_kind_and_nothing_else():
    def long(a, b):
        """Return the distance of a and b."""
        return (a - b).norm()

    link, user, elsewhere = tv.Distance([[0, 1]]), tv.Constraint(long, [[1, 2]], rest=1.0), tv.Distance([[0, 1]])
    w = tv.World(tv.Particles([[0.0, 0], [1, 0], [2, 0]]), [link, user], substeps=2)
    before, rest = w.hash(), link.rest
    used = tv.Distance([[0, 1]])
    other = tv.World(tv.Particles([[0.0, 0], [1, 0]]), [used], substeps=2)
    for extend, error, text in [
        ([link], TypeError, r"extend = \[Distance\] is a list; write"),
        ({elsewhere: tv.Distance([[0, 1]])}, ValueError, "extend: Distance does not act in this world"),
        ({link: tv.Rope([[0, 1]])}, TypeError, "Distance cannot take Rope, which is of another kind"),
        ({link: [[0, 1]]}, TypeError, r"extend\[Distance\] = \[\[0, 1\]\] is a list"),
        ({user: tv.Constraint(long, [[0, 1]])}, TypeError, r"Constraint\(long\) cannot take more constraints"),
        ({link: used}, ValueError, "already acts in another world"),
        ({link: link}, ValueError, "already acts"),
        ({link: tv.Distance([[0, 3]])}, ValueError, r"Distance: pairs\[0\] = \(0, 3\), but there are 3 particles"),
    ]:
        with pytest.raises(error, match=text):
            w.add(extend=extend)
    assert w.hash() == before and link.count == 1 and (link.rest == rest).all()
    w.close()
    other.close()


def test_a_shape_is_added_as_it_is():
    # As if its particles, links, limits and loops were given one by one; what is rigid and of the same kind is extended.
    rope, doll, brick = tv.shapes.rope((0, 2), (1, 2), 4), tv.shapes.ragdoll((3, 1)), tv.shapes.box((6, 0.5), (0.4, 0.2), 0.05)
    start = [tv.Distance([[0, 1]], compliance=1e-3), tv.Distance([[1, 2]]), tv.Polygons([[3, 4, 5]]), tv.ShapeMatch([[3, 4, 5]])]
    first = tv.Particles([[-3.0, 2], [-2, 2], [-1, 2], [-3, 0], [-2, 0], [-3, 1]])
    worlds = [tv.World(first, [f.copy() for f in start], substeps=4) for _ in range(2)]
    one, other = worlds
    handles = [one.add(shape) for shape in (rope, doll, brick)]
    assert [len(handle) for handle in handles] == [len(rope), len(doll), 4] and len(one.features) == 5
    n = 6
    for shape in (rope, doll, brick):
        links = np.concatenate([shape.links, shape.braces]) + n
        extend = {other.features[1]: tv.Distance(links)}
        late = [tv.AngleLimit(shape.limits + n, shape.lower, shape.upper)] if len(shape.limits) else []
        if shape is brick:
            extend[other.features[2]] = tv.Polygons([loop + n for loop in shape.loops])
        other.add(tv.Particles(shape.position, radius=shape.radius), late, extend=extend)
        n += len(shape)
    assert one.hash() == other.hash()
    for f, same in zip(one.features, other.features, strict=True):
        assert type(f) is type(same)
        for name in {"indices", "loops", *knobs_of(type(f))} & {*dir(f)}:
            np.testing.assert_equal(getattr(f, name), getattr(same, name))
    assert one.features[0].count == 1 and one.features[1].count == 1 + len(rope.links) + len(doll.links) + len(doll.braces) + 5
    with pytest.raises(ValueError, match="World.add: particles are in 3D, but the world is in 2D"):
        one.add(tv.shapes.rope((0, 0, 0), (1, 0, 0), 3))


def test_bodies_that_are_added_with_what_holds_them_bring_no_warning():
    # Warnings are errors here.
    brick = tv.shapes.box((0, 0.5), (0.4, 0.2), 0.05)
    particles, loops = tv.Particles(brick.position, radius=brick.radius), brick.loops
    world = tv.World(particles, [tv.ShapeMatch(loops), tv.Polygons(loops)])
    more = [loop + 4 for loop in loops]
    held, bodies = world.features
    world.add(tv.Particles(brick.position + 1, radius=0.05), extend={held: tv.ShapeMatch(more), bodies: tv.Polygons(more)})
    assert len(world.features[1].loops) == 2
