"""Adding to a world and removing from it: as if it had been built so, to the bit; in place, where nothing is compiled."""

from typing import Any

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.features.arguments import knobs_of
from tiverlet.features.feature import Batch
from tiverlet.step import edit_in_place
from tiverlet.step.runner import Runner

from .conftest import ARCH, PATCHED, compiled

pytestmark = pytest.mark.usefixtures("read_here")
in_place = pytest.mark.skipif(not PATCHED or ARCH != "cpu", reason="every edit builds the world anew there")
RADIUS = 0.1


def places(n: int) -> np.ndarray:
    """Return the positions of a loose heap. One pair overlaps, as in rebuilt worlds, so that both have the same kernels."""
    x = 0.205 * np.stack(np.divmod(np.arange(n), int(np.ceil(n**0.5)))[::-1], axis=1) + 0.15
    x += 0.003 * np.sin(np.arange(n * 2)).reshape(n, 2)
    x[9] = x[8] + (0.15, 0.0)
    return x


def drops(k: int, height: float, **more) -> tv.Particles:
    """Return particles that enter from above."""
    x = np.stack([0.3 + 0.25 * np.arange(k), np.full(k, height)], axis=1)
    return tv.Particles(x, **{"velocity": (0.3, -0.5), "radius": RADIUS, **more})


def hands():
    """Discs that a hand drives, or pulls by springs, or that are linked, on two threads, each with more than 32 neighbours.

    They are enough that a few strays cause no rebuild of the list. Hands take others, links have slots among theirs.
    """
    hand, drive = tv.Pin([10, 3], (0.5, 0.9), compliance=1e-3, damping=0.5), tv.Pin([15], (0.6, 0.6))
    link = tv.Distance([[20, 21], [21, 22], [5, 6]], compliance=1e-5)
    features = [tv.Gravity(20.0), tv.Box((0, 0), (8, 12)), tv.Contact(0.3, skin=0.5), hand, link, drive]
    particles = tv.Particles(places(200), radius=RADIUS, pinned=[0, 1])
    w = tv.World(particles, features, substeps=3, path="parallel", solver=tv.Jacobi())

    def take(a: int, b: int) -> None:
        hand.indices, hand.target, hand.damping = [a, b], [(0.6, 0.01 * a), (1.0, 1.0)], 0.1 * b
        drive.indices, drive.target = [b + 4], [(0.7, 0.8)]

    return w, [
        lambda: take(11, 3), lambda: w.add(drops(5, 4.0, velocity=(0.2, -20.0))), lambda: take(21, 12),
        lambda: w.remove(np.arange(174, 200, 7)), lambda: take(7, 6),
        lambda: (w.remove([172]), w.add(drops(2, 4.3)), w.remove([173])), lambda: setattr(w, "position", w.position),
    ]  # fmt: skip


def ropes():
    """Three ropes, the last of which breaks, over discs that pass through each other, with pins of both kinds and bends."""
    hung = [tv.shapes.rope((0.1 + 0.6 * k, 2.4), (0.5 + 0.6 * k, 2.4), points=5) for k in range(3)]
    position = np.concatenate([places(20), *(rope.position for rope in hung)])
    pairs = np.concatenate([rope.links + 20 + 5 * k for k, rope in enumerate(hung)])
    link = tv.Distance(pairs, compliance=np.where(pairs.min(axis=1) < 30, 1e-5, 0.0), break_at=20.0)
    bend = tv.Bend(np.stack([pairs[:-1, 0], pairs[:-1, 1], pairs[1:, 1]], axis=1)[[0, 1, 2, 4, 5, 6]], compliance=1e-2)
    features = [tv.Gravity(), link, tv.HalfSpace((0, 1), 0.0), tv.Pin([20]), tv.Pin([34, 29], compliance=1e-4), bend]
    w = tv.World(tv.Particles(position, radius=0.09), features, substeps=5, solver=tv.Direct(), precision="f64")

    def rope(k: int) -> None:
        new, first = tv.shapes.rope((0.2, 3.0), (1.4, 3.0), points=k), len(w.particles)
        both = {link: tv.Distance(new.links + first), bend: tv.Bend([[first, first + 1, first + 2]], compliance=1e-2)}
        w.add(tv.Particles(new.position, radius=0.09), extend=both)

    return w, [
        lambda: rope(6), lambda: w.remove([len(w.particles) - 1]),
        lambda: w.remove([27]), lambda: rope(4),
        lambda: w.add(extend={link: tv.Distance([[2, 3], [11, 30]], rest=[0.2, 1.0])}), lambda: w.remove([1]),
        lambda: w.remove(np.arange(21, 24)),
    ]  # fmt: skip


def bodies():
    """Soft balls with links and areas, and rigid clusters, some asleep; edits add and remove some of each."""
    ring = 0.3 * np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=1)
    square = np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.0, 0.2]])
    around = np.stack([np.arange(8), (np.arange(8) + 1) % 8], axis=1)
    position = np.concatenate([ring + (0.5, 0.5), ring + (1.3, 0.5), square + (2.0, 0.3), square + (2.5, 0.3)])
    links = tv.Distance(np.concatenate([around, around + 8]), compliance=1e-4, damping=1.0)
    area, clusters = tv.Area([np.arange(8), np.arange(8, 16)]), tv.ShapeMatch([np.arange(16, 20), np.arange(20, 24)])
    features = [tv.Gravity(), tv.HalfSpace((0, 1), 0.0), links, area, clusters, tv.Sleep(10.0, 0.05)]
    w = tv.World(tv.Particles(position, radius=0.08), features, substeps=5)

    def add(k: int) -> None:
        n = len(w.particles)
        more = {
            links: tv.Distance(around + n, compliance=1e-4), area: tv.Area([np.arange(n, n + 8)]),
            clusters: tv.ShapeMatch([np.arange(n + 8, n + 12)]),
        }  # fmt: skip
        w.add(tv.Particles(np.concatenate([ring + (0.6, 1.4 + k), square + (2.1, 1.2 + k)]), radius=0.08), extend=more)

    return w, [
        lambda: add(0), lambda: w.remove([3]), lambda: setattr(links, "compliance", 2e-4), lambda: add(1),
        lambda: w.remove([20]), lambda: w.remove(np.arange(30, 36)),
    ]  # fmt: skip


def batches(w: tv.World) -> list[Any]:
    """Return the features that are constraints."""
    return [f for f in w.features if isinstance(f, Batch)]


def frames(w: tv.World, log=lambda: None) -> list:
    """Run three frames and return all that can be observed of each."""
    out = []
    for _ in range(3):
        report = w.step(1 / 60)
        log()
        figures = report.energy, report.residual, report.overlap, report.contacts, sorted(report.flags)
        told = [(f.residual.tobytes(), f.broken.tobytes()) for f in batches(w)]
        told += [f.load.tobytes() for f in batches(w) if isinstance(f, tv.Pin) and f.compliance.any()]
        out.append((w.hash(), figures, w.velocity.tobytes(), w.contacts.impulse.tobytes(), told))
    return out


def edited(scene, path=None) -> list:
    """Edit a world, and return what was observed. path: of a recording, of edits in place; None: the world is built anew."""
    with pytest.MonkeyPatch.context() as patch:
        for name in () if path else ("planned", "grabbing"):
            patch.setattr(edit_in_place, name, lambda *_: None)
        w, edits = scene()
        w.run(0.1)
        seen, runner = frames(w), w._runner
        with tv.Recorder(path, w) if path else w.clone() as recorder:
            for edit in edits:
                kept = [f.residual for f in batches(w)]  # of the last substep, which edits do not change
                edit()
                more = [(a, f.residual) for a, f in zip(kept, batches(w), strict=True) if len(a) < f.count and edit is edits[0]]
                assert all((a == b[: len(a)]).all() for a, b in more)
                seen += [w.hash(), w.position.tobytes(), w.velocity.tobytes(), w.contacts.pairs.tobytes()]
                seen += [f.residual.tobytes() for f in batches(w)]
                seen += frames(w, *([recorder.log] if path else []))  # type: ignore[union-attr]
                seen.append({name: size for name, size in w.fields.items() if not name.startswith("grid")})
                assert (w._runner is runner) == bool(path)
        if path:
            assert tv.replay(path).verify()
        seen.append(w.explain().split("Compiled")[0].split("launch")[0])
        with w.clone() as twin:
            for f, other in zip(batches(w), batches(twin), strict=True):
                np.testing.assert_array_equal(f.residual, other.residual)
            w.remove([len(w.particles) - 2])
            twin.remove([len(w.particles) - 1])
            seen.append(frames(w))
            assert frames(twin) == seen[-1]
        w.close()
    return seen


@in_place
@pytest.mark.slow
@pytest.mark.parametrize("scene", [hands, ropes, bodies])
def test_in_place_is_to_the_bit_as_built_anew(scene, briefly, tmp_path):
    for k, (a, b) in enumerate(zip(edited(scene, tmp_path / "a.rrd"), edited(scene), strict=True)):
        assert a == b, k


@in_place
@pytest.mark.slow
def test_radii_masses_and_pins_are_values_and_memory_is_given_back():
    # A world of equal discs takes others, and ones that are held, without other kernels. What is free falls by g t^2 / 2.
    start = tv.Particles([(0.5, 0.5), (0.8, 0.5)], radius=0.05, mass=1.0)
    others = dict(radius=0.07), dict(mass=3.0), dict(pinned=[0])
    with tv.World(start, [tv.Gravity(9.81), tv.Contact(friction=0.3), tv.Box((0, 0), (9, 9))]) as w:
        w.run(0.1)
        w.velocity = w.velocity
        first = w.add(drops(1, 8.0, radius=0.05))
        with compiled() as names:
            for k, other in enumerate(others):
                w.add(tv.Particles([(0.3 + 0.3 * k, 1.5)], **{"radius": 0.05, "mass": 1.0, **other}))
                report = w.run(0.1)
            np.testing.assert_allclose(w.position[3:, 1], 1.5 - 9.81 * np.array([0.3, 0.2, 0.0]) ** 2 / 2, atol=1e-6)
            w.remove(first)
            w.step(1 / 60)
        assert names == [] and not report.flags and len(first) == 0
        # What went is shown until less than half is used; then its memory is given back.
        w.add(drops(30, 8.0, radius=0.05))
        most = sum(w.fields.values())
        w.remove(np.arange(25, 35))
        less = sum(w.fields.values())
        assert f"; {most - less} bytes more stay for what went" in w.explain() and 0 < most - less < less
        w.remove(np.arange(5, 22))
        assert sum(memory.spare_bytes for memory in w._runner.memories) <= sum(w.fields.values()) < less
        w.step(1 / 60)


ROPE = np.stack([0.3 * np.arange(6), np.full(6, 2.0)], axis=1)
RING = 0.4 * np.stack([np.cos(np.arange(7) * 0.9), np.sin(np.arange(7) * 0.9)], axis=1) + [0.5, 0.9]
FLAT = np.concatenate([ROPE, RING, [[2.0, 1], [2.4, 1], [2.4, 1.4], [2.0, 1.4], [3.0, 2], [3.5, 2.5], [3.2, 1]]])
LINKS = np.stack([np.arange(5), np.arange(1, 6)], axis=1)
OCTAHEDRON = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1.0]])
SIDES = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
SOLID = np.concatenate([[[0, 0, 0], [1, 0, 0], [1.5, 0.5, 0], [3, 1, 0], [3, 0, 0], [4.3, 0, 0]], OCTAHEDRON + [6, 0, 0]])


def flat(k: np.ndarray, all_of) -> list:
    """Return ropes, of which all but the first can break, limits, outlines and shapes, each softer than before, and tethers."""
    torn = np.repeat(np.where(k > 0, 1e3 * k, np.inf), 5) if k.any() else None
    return [
        tv.Distance(all_of(LINKS), compliance=np.repeat(1e-4 * (k + 1), 5), damping=0.1, break_at=torn),
        tv.Rope(all_of(LINKS[:3]), np.tile([0.4, 0.5, 0.31], len(k))),
        tv.AngleLimit(all_of([[1, 2, 3]]), -0.4, 0.1 * (k + 1)), tv.Area(all_of([6 + np.arange(7)]), pressure=1.05 + 0.1 * k),
        tv.ShapeMatch(all_of([13 + np.arange(4)]), compliance=1e-3, creep=2.0 + k),
        tv.Pin([5]), tv.Path([17], [[0.0, 4], [90.0, 5]], speed=0.3),
        tv.Gravity(), tv.HalfSpace((0, 1), 0.0),
    ]  # fmt: skip


def solid(k: np.ndarray, all_of) -> list:
    """Return a hinge that turns, a rope that is wound up, a grid and a closed surface."""
    return [
        tv.Motor(all_of([[0, 1, 2]]), 1.0 + k, torque=5.0), tv.Winch(all_of([[3, 4]]), -0.3 * (k + 1.0)),
        tv.Snap(all_of([5]), 1.0, compliance=0.01 * (k + 1)), tv.Volume(all_of(6 + SIDES), pressure=1.1 + k, compliance=1e-3),
    ]  # fmt: skip


def copies(kind, some: list[int], first: int = 0) -> tuple[tv.Particles, list]:
    """Return the particles of these copies, 20 m apart, and their features, after those of `first` others."""
    points, pinned = (FLAT, [0]) if kind is flat else (SOLID, [0, 1, 3])
    n, shift = len(points), 20.0 * np.eye(points.shape[1])[0]
    x = np.concatenate([points + k * shift for k in some])
    start = tv.Particles(x, radius=0.02, pinned=(n * np.arange(len(some))[:, None] + pinned).ravel())
    return start, kind(
        np.array(some), lambda rows: np.concatenate([np.asarray(rows) + n * (first + k) for k in range(len(some))])
    )


def of_copies(kind, some: list[int]) -> tv.World:
    """Return a world of these copies."""
    settings: dict = {"solver": tv.Jacobi(), "substeps": 6} if kind is flat else {"precision": "f64", "substeps": 2}
    return tv.World(*copies(kind, some), **settings)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Path")
@pytest.mark.parametrize("kind", [flat, solid])
def test_a_world_that_was_extended_is_the_one_that_has_all(kind, tmp_path):
    def extended(w, k):
        start, more = copies(kind, [k], k)
        w.add(start, extend={f: one for f, one in zip(w.features, more, strict=True) if getattr(one, "can_extend", False)})

    whole, w = of_copies(kind, [0, 1, 2]), of_copies(kind, [0])
    for k in (1, 2):
        extended(w, k)
    for _ in range(12):
        assert w.step(1 / 60).residual == whole.step(1 / 60).residual
    assert w.hash() == whole.hash()
    n, some = len(w.particles) // 3, of_copies(kind, [0, 2])
    with of_copies(kind, [0, 1, 2]) as less:  # bodies go whole, and numbers follow
        less.remove(np.arange(n, 2 * n, 2))
        less.remove(np.arange(n, len(less.particles) - n))
        less.run(0.1)
        some.run(0.1)
        assert less.hash() == some.hash() and [f.count for f in batches(less)] == [f.count for f in batches(some)]
    some.close()
    with tv.Recorder(tmp_path / "more.rrd", w) as recorder, compiled() as names:  # between two frames
        extended(w, 3)
        w.run(3 / 60, recorder=recorder)
    assert tv.replay(tmp_path / "more.rrd").verify()
    assert not PATCHED or ARCH != "cpu" or set(names) <= {"velocities", "to_velocity"}  # not requested before
    if kind is solid:
        for extend, text in (
            ({w.features[0]: tv.Motor([[0, 1, 2]], 1.0, angle=1.0)}, "one Motor turns to an angle"),
            ({w.features[2]: tv.Snap([0], 2.0, compliance=0.01)}, "Snap of spacing = 1.0 cannot take one of spacing = 2.0"),
        ):
            with pytest.raises(TypeError, match=text):
                w.add(extend=extend)
    w.close()
    whole.close()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Path")
def test_what_stays_goes_on_to_the_bit():
    # Two particles come, and of the second copy one particle of each constraint goes, while knobs wait and a target moves.
    n, w = len(FLAT), of_copies(flat, [0, 1])
    w.run(0.1)
    twin = w.clone()
    for one in (w, twin):
        rope, hand = one.features[0], one.features[5]
        one.step(1 / 60)
        rope.break_at, hand.target = rope.break_at * 0.99, hand.target + [0.0, 0.05]
    x, v = w.position, w.velocity
    new = w.add(tv.Particles([[50.0, 5.0], [50.3, 5.0]], velocity=(0.0, 1.0), radius=0.1))
    np.testing.assert_array_equal(w.position[: 2 * n], x)
    np.testing.assert_array_equal(w.velocity[: 2 * n], v)
    np.testing.assert_allclose(w.velocity[new], [[0, 1], [0, 1]], atol=1e-6)
    right = w.handle(np.arange(n, 2 * n))
    gone = n + np.array([0, 2, 4, 5, 6, 9, 13, 17, 19])
    w.remove(np.concatenate([gone, new.indices]))
    some = np.setdiff1d(np.arange(2 * n), gone)
    np.testing.assert_array_equal(w.position, x[some])
    np.testing.assert_array_equal(w.velocity, v[some])
    assert len(new) == 0 and right.indices.tolist() == list(range(n, len(some)))
    assert [f.count for f in batches(w)] == [5, 3, 1, 1, 1, 1, 1]
    w.run(0.1)
    twin.run(0.1)
    np.testing.assert_array_equal(w.position[:n], twin.position[:n])
    np.testing.assert_array_equal(w.velocity[:n], twin.velocity[:n])
    for f, other in zip(batches(w), batches(twin), strict=True):
        if not isinstance(f, (tv.Pin, tv.Path)):
            np.testing.assert_array_equal(f.load[: other.count // 2], other.load[: other.count // 2])
    w.close()
    twin.close()


@ti.func
def magnet(x, v):
    """Return a force across the velocity plus a spring."""
    return 3.0 * ti.Vector([v[1], -v[0]]) - x


@pytest.mark.slow
@pytest.mark.parametrize("last", [tv.Drag(0.4), tv.Force(magnet)], ids=repr)
def test_what_comes_starts_as_in_a_world_of_its_own(world, last):
    # Thrown into a running world between two substeps: the same motion as from a start there, to rounding. With drag and forces
    # that read velocities, this takes more than d = h v - h^2 g / 2.
    def built(x, v):
        return world(tv.Particles([x], velocity=v), [tv.Gravity(9.81), last.copy()], precision="f64")

    x, v = np.array([0.5, 1.0]), np.array([2.0, -1.0])
    alone, w = built(x, v), built([9.0, 9.0], (1, 1))
    w.run(0.2)
    first = w.last.energy
    new = w.add(tv.Particles([x, x], velocity=[v, v], pinned=[1]))
    np.testing.assert_allclose(w.velocity[new], [v, [0, 0]], atol=1e-12)
    report = w.step(1 / 60)
    # The energy account continues: it counts the frame, not the added particles.
    change = 0.5 * v @ v + 9.81 * x[1]
    assert abs(report.energy_change) < 0.1 * change and report.energy > first + 0.5 * change
    w.run(0.4)
    alone.run(1 / 60 + 0.4)
    np.testing.assert_allclose(w.position[new], [alone.position[0], x], atol=1e-12)
    np.testing.assert_allclose(w.velocity[new][0], alone.velocity[0], atol=1e-11)


@pytest.mark.slow
def test_forces_and_constraints_come_and_go(world):
    # A straight line, then a parabola, then a straight line again: exact, because forces change between a velocity and the next
    # substep. Besides, links take their rest lengths from the present positions.
    x, v = np.array([[0.0, 0], [5, 0], [6, 0], [7, 0]]), np.array([1.0, 2.0])
    w = world(tv.Particles(x, velocity=v), [], precision="f64")
    w.run(0.2)
    gravity, link = tv.Gravity(9.81), tv.Distance([[1, 2], [2, 3]])
    w.add(features=[gravity, link])
    gravity.g = 3.0
    w.run(0.3)
    np.testing.assert_allclose(w.position, x + 0.5 * v + 0.5 * 0.3**2 * np.array([0.0, -3.0]), atol=1e-12)
    assert link.rest == pytest.approx([1.0, 1.0], abs=1e-12) and "Direct" in w.explain()
    w.remove(features=[gravity])
    assert gravity.scene is None and w.features == (link,)
    w.remove([2])
    assert link.count == 0 and len(link.load) == len(link.residual) == len(link.broken) == 0
    assert not any(name.startswith(("Distance", "slots")) for name in w.fields)
    w.remove(w.handle([True] * 3))
    assert w.step(0.1).clean and w.position.shape == (0, 2)


def length(a, b):
    """Return the distance of a and b."""
    return (a - b).norm()


@pytest.mark.slow
def test_after_an_error_the_world_is_as_before(world, monkeypatch):
    x = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    link, user = tv.Distance([[0, 1], [1, 2]], compliance=1e-3), tv.Constraint(length, [[1, 2]], rest=1.0)
    used, more = tv.Distance([[0, 1]]), tv.Particles([[3.0, 0, 0]])
    w = world(tv.Particles(x), [tv.Gravity(), link, user, tv.Pin([0])], solver=tv.Jacobi())
    world(tv.Particles(x), [used])
    w.run(0.1)
    before, rest = w.hash(), link.rest

    def late(*given):
        raise KeyError("late")

    for kind, text, act in (
        (TypeError, r"World.add: particles = \[\[0", lambda: w.add([[0.0, 0, 0]])),
        (ValueError, "World.add: particles are in 2D, but the world is in 3D", lambda: w.add(tv.Particles([[0.0, 0]]))),
        (ValueError, "World.add: particles are in 2D", lambda: w.add(tv.shapes.rope((0, 0), (1, 0), 3))),
        (TypeError, r"World.add: features = Drag.*write a list", lambda: w.add(features=tv.Drag(1.0))),
        (ValueError, "already acts in another world", lambda: w.add(features=[used])),
        (ValueError, "already acts", lambda: w.add(features=[link])),
        (ValueError, r"Rope: pairs\[0\] = \(3, 4\), but there are 4", lambda: w.add(more, [tv.Gravity(1.0), tv.Rope([(3, 4)])])),
        (ValueError, "too large for f32", lambda: w.add(more, [tv.Gravity(1.0), tv.Volume([[0, 1, 2, 3]], rest=1e30)])),
        (ValueError, r"World.remove: features\[0\] = Distance does not act in", lambda: w.remove(features=[used])),
        (ValueError, r"World.remove: particles\[1\] = 3, but there are 3", lambda: w.remove([0, 3])),
        (ValueError, r"mask of shape \(3,\)", lambda: w.handle([True])),
        (TypeError, r"extend = \[Distance\] is a list; write", lambda: w.add(extend=[link])),
        (ValueError, "extend: Rope does not act in", lambda: w.add(extend={tv.Rope([[0, 1]]): tv.Rope([[0, 1]])})),
        (TypeError, "Distance cannot take Rope, which is of another", lambda: w.add(extend={link: tv.Rope([[0, 1]])})),
        (TypeError, r"extend\[Distance\] = \[\[0, 1\]\] is a list", lambda: w.add(extend={link: [[0, 1]]})),
        (TypeError, "cannot take more constraints", lambda: w.add(extend={user: tv.Constraint(length, [[0, 1]])})),
        (ValueError, "already acts in another world", lambda: w.add(extend={link: used})),
        (ValueError, "already acts", lambda: w.add(extend={link: link})),
        (ValueError, r"Distance: pairs\[0\] = \(0, 3\), but there are 3", lambda: w.add(extend={link: tv.Distance([[0, 3]])})),
        (KeyError, "late", lambda: w.add(more, [tv.Gravity(1.0)])),  # when the world already has its new parts
    ):
        if kind is KeyError:
            monkeypatch.setattr(Runner, "pass_on", late)
        with pytest.raises(kind, match=text):
            act()
        assert w.hash() == before and w.features[1] is link and (link.rest == rest).all() and len(w.particles) == 3, text
    monkeypatch.undo()
    with pytest.raises(ValueError, match=r"order = 4, but Contact is one-sided"):
        world(tv.Particles(x, radius=0.1), precision="f64", order=4).add(features=[tv.Contact()])
    w.run(0.1)
    assert w.add() is not None and w.time == pytest.approx(0.2)


def test_a_shape_is_added_as_it_is():
    # As if its particles, links, limits and loops were given one by one; what is rigid and of the same kind is extended. Nothing
    # warns of bodies that come with what holds them (warnings are errors here).
    rope, doll, brick = tv.shapes.rope((0, 2), (1, 2), 4), tv.shapes.ragdoll((3, 1)), tv.shapes.box((6, 0.5), (0.4, 0.2), 0.05)
    start = [tv.Distance([[0, 1]], compliance=1e-3), tv.Distance([[1, 2]]), tv.Polygons([[3, 4, 5]]), tv.ShapeMatch([[3, 4, 5]])]
    first = tv.Particles([[-3.0, 2], [-2, 2], [-1, 2], [-3, 0], [-2, 0], [-3, 1]])
    one, other = (tv.World(first, [f.copy() for f in start], substeps=4) for _ in range(2))
    handles = [one.add(shape) for shape in (rope, doll, brick)]
    assert [len(handle) for handle in handles] == [len(rope), len(doll), 4] and len(one.features) == 5
    n = 6
    for shape in (rope, doll, brick):
        extend = {other.features[1]: tv.Distance(np.concatenate([shape.links, shape.braces]) + n)}
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
    loops, one.position = [loop + n for loop in brick.loops], one.position * [1.0, 2.0]
    more = tv.Distance([[0, 5]]), tv.Polygons(loops), tv.ShapeMatch(loops)  # a link that is added has the length of now
    one.add(tv.Particles(brick.position + 9, radius=0.05), extend=dict(zip(one.features[1:4], more, strict=True)))
    assert len(one.features[2].loops) == 3 and one.features[3].count == 2
    assert one.features[1].rest[-1] == pytest.approx(np.linalg.norm(one.position[0] - one.position[5]), rel=1e-6)
    one.close()
    other.close()


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
