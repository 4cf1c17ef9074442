"""Statics of bodies: stacks and heaps of Polygons neither drift nor sink nor give way, and bear what statics says."""

from typing import Any

import numpy as np
import pytest

import tiverlet as tv

G = 10.0


def block(width, height, center):
    """Return the corners of a block, counterclockwise from below on the left."""
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * np.array([width, height]) / 2 + center


def column(n, shrink=0.04):
    """Return blocks 1 m high on each other, each narrower by `shrink` than the one below [m]."""
    return [block(1.0 - shrink * k, 1.0, (0.0, k + 0.5)) for k in range(n)]


def tossed(columns, rows):
    """Return boxes of several sizes in the air, at random angles."""
    rng, out = np.random.default_rng(0), []
    for k, row in np.ndindex(columns, rows):
        a = rng.uniform(0, 6.28) + np.pi / 2 * np.arange(4)
        out.append(rng.uniform(0.5, 0.7) * np.stack([np.cos(a), np.sin(a)], axis=1) + (1.5 * k + 1, 1.5 * row + 1))
    return out


def standing(
    world, shapes, mass: Any = 1.0, friction: object = 0.5, pinned=(), discs=(), low=(-99, 0), high=(99, 99),
    velocity=0.0, links=False, **settings
):  # fmt: skip
    """Return a world of rigid bodies of these masses on a floor, and the particles of each.

    Friction is set after the build, and all have a pinned particle out of the way, which differs from the others: worlds of one
    precision and kind of ties share kernels.
    """
    loops = [4 * k + np.arange(4) for k in range(len(shapes))]
    x = np.concatenate([*shapes, np.reshape(discs, (-1, 2)), [(90.0, 90.0)]])
    each = np.r_[np.repeat(np.broadcast_to(mass, len(shapes)) / 4, 4), np.full(len(discs), 0.5), 1.5]
    radius = np.r_[np.zeros(4 * len(shapes)), np.full(len(discs), 0.3), 0.1]
    held = [*(i for k in pinned for i in loops[k]), len(x) - 1]
    corners = np.array(loops)
    sides = np.concatenate([corners[:, [k, m]] for k, m in ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2))])
    ties: Any = tv.Distance(sides) if links else tv.ShapeMatch(loops)
    polygons, box = tv.Polygons(loops, friction=0.5), tv.Box(low, high, friction=0.5)
    start = tv.Particles(x, mass=each, radius=radius, pinned=held, velocity=velocity)
    w = world(start, [tv.Gravity(G), polygons, ties, box], **({"substeps": 8, "precision": "f64"} | settings))
    polygons.friction = box.friction = friction  # type: ignore[assignment]
    return w, loops


def turned(points, angle):
    """Turn points about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]])


def arch(stones):
    """Return half a ring of stones between the radii 2 and 2.6 m."""
    at = np.linspace(np.pi, 0, stones + 1)
    inner, outer = (r * np.stack([np.cos(at), np.sin(at)], axis=1) for r in (2.0, 2.6))
    return [np.array([inner[k], inner[k + 1], outer[k + 1], outer[k]]) for k in range(stones)]


def cards():
    """Return a house of cards: two tents with a card across, and a tent on it. Cards are 1 m by 4 cm, at 75 degrees."""
    length, thick, angle = 1.0, 0.04, np.radians(75)

    def tent(x, y):
        out = []
        for turn, side in ((angle, np.max), (np.pi - angle, np.min)):
            card = turned(block(length, thick, 0), turn)
            out.append(card - (side(card[:, 0]), card[:, 1].min()) + (x, y))
        return out

    width, height = length * np.cos(angle) + thick * np.sin(angle), np.max(tent(0, 0)[0][:, 1])
    roof = block(2 * width + 0.6, thick, (width, height + thick / 2))
    return [*tent(0, 0), *tent(2 * width, 0), roof, *tent(width, height + thick)]


def bent(w, loops):
    """Return the largest change of a distance between corners of one body [m]."""
    lengths = [
        np.array([np.linalg.norm(x[loop][:, None] - x[loop], axis=2) for loop in loops])
        for x in (w.position, w.features[1].start.position)
    ]
    return np.abs(lengths[0] - lengths[1]).max()


def contact_forces(w):
    """Return the force of contacts on each particle, (n, 2) [N], along the normals."""
    found, out = w.contacts, np.zeros_like(w.position)
    force = found.impulse[:, None] * found.normal * 60 * w.substeps
    shares = ((found.pairs[:, 0], 1 + 0 * found.place), (found.pairs[:, 1], found.place - 1), (found.ends, -found.place))
    for who, share in shares:
        np.add.at(out, who, share[:, None] * force)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("links", [False, True])
def test_a_column_bears_what_is_above(world, links):
    # By body, the pushes of contacts add up to its weight, and nothing gives way.
    mass = 2.0 + np.arange(6) % 2
    w, loops = standing(world, column(6), mass, substeps=4, links=links)
    start = G * (mass * (np.arange(6) + 0.5)).sum()
    lack = 5e-4 * G / 240**2  # what passes may leave of each row in a substep [m]
    assert max(w.step(1 / 60).energy for _ in range(2400)) <= start + 2 * G * mass.sum() * lack
    total = contact_forces(w)[:24, 1].reshape(6, 4).sum(axis=1)
    np.testing.assert_allclose(total[1:], G * mass[1:], rtol=1e-5)
    assert total[0] == pytest.approx(-G * mass[1:].sum(), rel=1e-5)
    most = 2e-5 if links else 1e-8  # links bend more while boxes come to rest, and friction on the floor keeps some of it
    assert bent(w, loops) < most and np.abs(w.velocity).max() < most
    # They sink by less than gravity moves them in a substep, while passes find the loads.
    np.testing.assert_allclose(w.position[:24], np.concatenate(column(6)), atol=G / 240**2)


def test_a_beam_on_two_supports(world):
    # A beam of 2 kg and 6 m lies on posts at -2 and 2 m. A block of 3 kg stands on it at 1 m.
    shapes = [block(0.5, 1.0, (-2.0, 0.5)), block(0.5, 1.0, (2.0, 0.5)), block(6.0, 0.2, (0.0, 1.1)), block(0.4, 0.4, (1.0, 1.4))]
    w, loops = standing(world, shapes, [1, 1, 2, 3], pinned=(0, 1), substeps=2)
    w.run(60.0)
    force = contact_forces(w)
    posts = -np.array([force[loop].sum(axis=0) for loop in loops[:2]])
    right = force[:8]  # its point of action: the moment of the posts about the left one
    moment = -(w.position[:8, 0] * right[:, 1]).sum()
    np.testing.assert_allclose(posts.sum(axis=0), [0, 5 * G], atol=5 * G * 1e-6)
    assert moment == pytest.approx(3 * G * 1.0, rel=1e-5)
    assert bent(w, loops) < 1e-6 and w.contacts.overlap.max() < 0.01 * G / 120**2


def test_each_box_of_a_pyramid_bears_what_is_on_it(world):
    # 15 boxes of 1 to 2 kg in rows of 5 to 1, with gaps in a row. All stand upright, so friction has no part in the weight.
    rows = 5
    shapes = [block(1.0, 1.0, (1.1 * (i + r / 2), r + 0.5)) for r in range(rows) for i in range(rows - r)]
    mass = np.random.default_rng(0).uniform(1, 2, len(shapes))
    w, loops = standing(world, shapes, mass, substeps=4)
    w.run(60.0)
    force = contact_forces(w)[:60, 1].reshape(15, 4).sum(axis=1)
    np.testing.assert_allclose(force[rows:], G * mass[rows:], atol=1e-5 * G * mass.sum())
    assert bent(w, loops) < 5e-5 and w.contacts.overlap.max(initial=0) < 5e-5
    np.testing.assert_allclose(w.position[:60], np.concatenate(shapes), atol=1e-2)


def test_friction_bears_its_load_on_a_slope(world):
    # A box sticks to a slope of 20 degrees: friction holds m g sin, and the box is not bent by it. It does not creep.
    a = np.radians(20.0)
    t, n = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
    turned = np.stack([t, n])
    shapes = [block(6.0, 1.0, (0.0, -0.5)) @ turned + [0, 5], block(1.0, 1.0, (0.0, 0.5)) @ turned + [0, 5]]
    w, loops = standing(world, shapes, pinned=(0,), substeps=4)
    w.run(30.0)
    before = w.position
    w.run(30.0)
    np.testing.assert_allclose(w.position, before, atol=1e-9)
    assert w.contacts.impulse.sum() * 240 == pytest.approx(G * np.cos(a), rel=1e-6)
    assert bent(w, loops) < 1e-8


def test_loads_are_gone_with_what_bore_them(world):
    # The floor goes: boxes fall as one, but for the loads of at most one more substep.
    w, loops = standing(world, column(5), substeps=8)
    w.run(15.0)
    assert bent(w, loops) < 1e-6
    w.features[3].lower = (-99.0, -99.0)  # type: ignore[attr-defined]
    v = [w.velocity[:-1] for _ in range(30) if w.step(1 / 60)]
    assert np.abs(v[-1][:, 1] - v[5][:, 1] + G * 24 / 60).max() < 1e-6
    assert np.ptp(v[-1][:, 1]) < 2 * 5 * G / 480
    # The lowest box goes: what was on it falls. Loads of k G between the others act for one more substep, or two where contacts
    # need a second one to see it: each adds (k G h)^2 / m at most.
    w, loops = standing(world, column(5), substeps=2)
    w.run(40.0)
    before = G * (np.arange(1, 5) + 0.5).sum()
    w.remove(loops[0])
    assert max(w.step(1 / 60).energy for _ in range(600)) <= before + 2 * G**2 * (1 + 4 + 9) / 120**2
    w.run(40.0)
    assert np.abs(w.velocity).max() < 1e-3 and w.position[:-1, 1].max() == pytest.approx(4.0, abs=1e-3)
    # A box that is put elsewhere falls as it would alone, but for half of the displacement by gravity in a substep: its load is
    # gone in the first one.
    x = w.position.copy()
    x[12:16] += [5.0, 3.0]
    w.position = x
    w.step(1 / 60)
    np.testing.assert_allclose(w.position[12:16] - x[12:16], [[0.0, -G / 60**2 / 2]] * 4, atol=1.01 * G / 120**2)


def test_a_lift_carries_a_stack(world):
    # The floor speeds up from frame to frame, and then moves at a constant speed, where contacts bear m g.
    w, loops = standing(world, column(3), substeps=8)
    w.run(10.0)
    box, y, v = w.features[3], 0.0, 0.0
    for a, frames in ((0.3, 240), (0.0, 480)):
        for _ in range(frames):
            v += a / 60
            y += v / 60
            box.lower = (-99.0, y)  # type: ignore[attr-defined]
            w.step(1 / 60)
        if a == 0:
            np.testing.assert_allclose(contact_forces(w)[4:12, 1].reshape(2, 4).sum(axis=1), G, rtol=1e-3)
        np.testing.assert_allclose(w.velocity[:-1], [[0.0, v]] * 12, atol=0.02)
    assert bent(w, loops) < 1e-3 and w.position[:-1, 1].min() == pytest.approx(y, abs=1e-9)


def test_a_heap_with_discs_hardly_overlaps(world):
    # 24 boxes and 12 discs between rough walls. Energy never rises above the start.
    discs = np.stack([0.8 + 0.9 * (np.arange(12) % 6), 9.0 + 0.9 * (np.arange(12) // 6)], axis=1)
    w, loops = standing(world, tossed(4, 6), discs=discs, low=(0, 0), high=(6.5, 99))
    start = w.step(1 / 60).energy
    assert max(w.step(1 / 60).energy for _ in range(2400)) <= start * (1 + 1e-9)
    assert np.abs(w.velocity).max() < 1e-3
    # What overlaps by less than 0.009 of half an edge of 1 m at most, or of a disc, stays; clusters are rigid.
    assert w.contacts.overlap.max() < 0.009 * 0.5 and bent(w, loops) < 1e-4


PYRAMID = [block(1.0, 1.0, (1.05 * (k - (10 - r) / 2), 0.5 + r)) for r in range(10) for k in range(10 - r)]
STRUCTURES = {
    "tower": (column(20, 0.0), 1.0, False, 4), "tower on links": (column(20, 0.0), 1.0, True, 4),
    "pyramid under 100 kg": (PYRAMID, [*np.ones(54), 100.0], False, 8), "arch": (arch(9), 1.0, False, 4),
    "house of cards": (cards(), 1.0, False, 8),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", STRUCTURES)
def test_what_stands_stays(world, name):
    # No body moves: in f32 within a few digits of the coordinates, 20 m * 2^-24 = 1e-6 m, and for links ten times as far.
    shapes, mass, links, substeps = STRUCTURES[name]
    how = {"links": links, "precision": "f64" if links else "f32", "substeps": substeps}
    w, _ = standing(world, shapes, mass, 0.8, **how)
    w.run(3.0)
    start = w.position.copy()
    for _ in range(600):
        w.step(1 / 60)
        assert not w.last.flags
    assert np.abs(w.position - start).max() < (4e-5 if links else 4e-6)
    assert np.abs(start[:-1] - np.concatenate(shapes)).max() < 2e-3


@pytest.mark.slow
def test_towers_far_out_stand_for_a_minute(world):
    # Towers of 20 boxes, up to 60 m from the origin in f32: the top may move by 1e-3 of a box for each box below it. Loads are
    # forces: what was borne at 40 substeps a frame is borne at 4.
    shapes = [box + (15 * k, 0) for k in range(5) for box in column(20, 0.0)]
    w, loops = standing(world, shapes, friction=0.8, precision="f32", substeps=40)
    w.run(1.0)
    w.substeps = 4
    w.run(60.0)
    assert np.abs(w.position[:-1, 0] - np.concatenate(shapes)[:, 0]).max() < 20e-3 and bent(w, loops) < 1e-4


@pytest.mark.parametrize("depth", [1e-5, 1e-3])
def test_overlap_of_corners_gives_no_momentum(world, depth):
    # Overlap is no reason for an impulse, wherever corners meet: boxes in each other lie still under their weight. Where one box
    # begins beside the other one, and leans over it, their corners cross. Overlap is below 3 slops, which places leave. In a
    # substep passes leave 5e-4 of g h for each row.
    leans, square = [(0, 0), (1.5, 0), (0, 1.5), (-1.5, 0), (0, -1.5), (4, 4), (-4, -4)], block(1.0, 1.0, 0)
    places = [(sign * shift, *lean) for shift in (0, 1e-14, 1e-13) for sign in (1, -1) for lean in leans]
    shapes = []
    for k, (shift, below, above) in enumerate(places):
        lower, upper = turned(square + (0.5, -0.5), below * shift / depth), turned(square + 0.5, above * shift / depth)
        shapes += [lower + (1.5 * k - 0.5, 1), upper + (1.5 * k - 0.5 + shift, 1 - depth)]
    w, _ = standing(world, shapes, friction=0.8)
    start = w.position.copy()
    for _ in range(10):
        w.step(1 / 60)
        assert np.abs(w.velocity).max() < 0.02 * G / 480
    assert np.abs(w.position - start).max() < 1e-6


@pytest.mark.parametrize("substeps", [20, 200])
@pytest.mark.parametrize("what", ["point", "box"])
def test_friction_holds_far_from_the_origin(world, what, substeps):
    # The slope is 0.3 < friction 0.6. In f32 at 50 m a digit is 4e-6 m, 60 times g h^2 at 200 substeps.
    tilted = G * np.array([-0.3, -1.0]) / np.hypot(1.0, 0.3)
    if what == "point":
        floor = tv.HalfSpace((0, 1), friction=0.6)
        w = world(tv.Particles([[50.0, 0.0]], radius=0.0), [tv.Gravity(tilted), floor], substeps=substeps)
    else:
        w, _ = standing(world, [block(1.0, 1.0, (50.0, 0.5))], friction=0.6, precision="f32", substeps=substeps)
        w.features[0].g = tilted  # type: ignore[attr-defined]
    w.run(1.0)
    start = w.position.copy()
    w.run(5.0)
    assert np.abs(w.position - start).max() < 1e-8


def test_bodies_that_fly_turn_to_second_order(world):
    # Free flight is exact but for turns, by phi with sin phi = omega h: (omega h)^2 / 6 of an angle is too much.
    omega, v, t, square = 5.0, np.array([1.0, 4.0]), 1.0, block(1.0, 1.0, 0)
    speed = np.r_[np.tile(v + omega * np.stack([-square[:, 1], square[:, 0]], axis=1), (2, 1)), [(0, 0)]]
    w, _ = standing(world, [square + (0, 20), square + (2, 20)], velocity=speed)
    w.run(t)
    end = turned(square, omega * t) + v * t + (0, 20 - G * t**2 / 2)
    off = w.position[:-1] - np.concatenate([end, end + (2, 0)])
    assert np.hypot(*off.T).max() == pytest.approx(0.5**0.5 * omega * t * (omega / 480) ** 2 / 6, rel=0.01)


def test_scenes_take_as_many_substeps_as_they_need(world):
    # 4 where particles and rigid bodies fall freely between contacts. Links, and clusters that share particles or give way, take
    # 20.
    squares, loops = np.concatenate([block(1, 1, 0), block(1, 1, (2, 0))]), [[0, 1, 2, 3], [4, 5, 6, 7]]
    for few, *features in (
        (True,), (True, tv.ShapeMatch(loops)), (True, tv.ShapeMatch(loops[:1]), tv.ShapeMatch(loops[1:])),
        (False, tv.ShapeMatch(loops), tv.ShapeMatch([[0, 4]])), (False, tv.ShapeMatch(loops, compliance=1e-4)),
        (False, tv.ShapeMatch(loops), tv.Distance([(0, 4)])), (False, tv.ShapeMatch(loops), tv.Attractor((0, 0), 1.0)),
    ):  # fmt: skip
        w = world(tv.Particles(squares, radius=0.1), [tv.Gravity(), tv.Contact(), *features])
        assert w.substeps == (4 if few else 20), features


@pytest.mark.slow
def test_loads_are_of_the_state(world):
    # Clones and teams of threads have the same bits.
    hashes = []
    for path in ("fused", "parallel"):
        w, _ = standing(world, tossed(3, 3), low=(0, 0), high=(5, 99), precision="f32", path=path)
        w.run(6.0)
        with w.clone() as other:
            for each in (w, other):
                each.run(0.3)
            assert other.hash() == w.hash()
        hashes.append(w.hash())
    assert hashes[0] == hashes[1]
