"""Statics of bodies: stacks and heaps of Polygons give way to nothing at rest, and bear what statics says."""

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
    restitution=0.0, velocity=0.0, links=False, **settings
):  # fmt: skip
    """Return a world of rigid bodies of these masses on a floor, and the particles of each.

    Friction is set after the build, and all have a pinned particle out of the way, so that worlds share compiled kernels.
    """
    loops = [4 * k + np.arange(4) for k in range(len(shapes))]
    x = np.concatenate([*shapes, np.reshape(discs, (-1, 2)), [(90.0, 90.0)]])
    each = np.r_[np.repeat(np.broadcast_to(mass, len(shapes)) / 4, 4), np.full(len(discs), 0.5), 1.5]
    radius = np.r_[np.zeros(4 * len(shapes)), np.full(len(discs), 0.3), 0.1]
    held = [*(i for k in pinned for i in loops[k]), len(x) - 1]
    corners = np.array(loops)
    sides = np.concatenate([corners[:, [k, m]] for k, m in ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2))])
    ties: Any = tv.Distance(sides) if links else tv.ShapeMatch(loops)
    polygons, box = tv.Polygons(loops, friction=0.5, restitution=restitution), tv.Box(low, high, friction=0.5)
    start = tv.Particles(x, mass=each, radius=radius, pinned=held, velocity=velocity)
    w = world(start, [tv.Gravity(G), polygons, ties, box], **({"substeps": 8, "precision": "f64"} | settings))
    polygons.friction = box.friction = friction  # type: ignore[assignment]
    return w, loops


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_column_stands_whatever_the_substep(world):
    # A load is a force: what was borne at 40 substeps a frame bears five boxes at 2 substeps.
    w, loops = standing(world, column(5), substeps=40, precision="f32")
    w.run(8.0)
    w.substeps = 2
    w.run(12.0)
    assert bent(w, loops) < 1e-4 and np.abs(w.velocity).max() < 1e-3
    assert np.abs(w.position[:20] - np.concatenate(column(5))).max() < 1e-3


@pytest.mark.slow
def test_a_heap_with_discs_hardly_overlaps(world):
    # 24 boxes and 12 discs between rough walls. Energy never rises above the start.
    discs = np.stack([0.8 + 0.9 * (np.arange(12) % 6), 9.0 + 0.9 * (np.arange(12) // 6)], axis=1)
    w, loops = standing(world, tossed(4, 6), discs=discs, low=(0, 0), high=(6.5, 99))
    start = w.step(1 / 60).energy
    assert max(w.step(1 / 60).energy for _ in range(2400)) <= start * (1 + 1e-9)
    assert np.abs(w.velocity).max() < 1e-3
    # What overlaps by less than 0.009 of half an edge of 1 m at most, or of a disc, stays; clusters are rigid.
    assert w.contacts.overlap.max() < 0.009 * 0.5 and bent(w, loops) < 1e-4


@pytest.mark.slow
def test_a_box_that_bounces_comes_to_rest_under_its_weight(world):
    # A box falls on a pinned one and leaves at e times its speed. Later it rests.
    shapes = [block(3.0, 1.0, (0.0, 0.5)), block(1.0, 1.0, (0.0, 2.0))]
    w, loops = standing(world, shapes, pinned=(0,), restitution=0.6)
    frames = [w.position for _ in range(60) if w.step(1 / 60)]
    w.run(20.0)
    assert w.contacts.impulse.sum() * 480 == pytest.approx(G, rel=1e-6) and bent(w, loops) < 1e-8
    assert max(x[4:8, 1].min() for x in frames[30:]) == pytest.approx(1.0 + 0.36 * 0.5, abs=0.02)


@pytest.mark.slow
def test_loads_are_of_the_state(world):
    # Both paths, clones and Worlds have the same bits.
    hashes = []
    for path in ("fused", "parallel"):
        w, _ = standing(world, tossed(3, 3), low=(0, 0), high=(5, 99), precision="f32", path=path)
        w.run(6.0)
        hashes.append(w.hash())
        with w.clone() as other, tv.Worlds(w, 2) as many:
            for each in (w, other, many):
                for _ in range(20):
                    each.step(1 / 60)
            assert other.hash() == w.hash()
            np.testing.assert_array_equal(many.position[1], w.position)
    assert hashes[0] == hashes[1]
    with pytest.raises(TypeError, match="loads"):
        tv.Polygons([[0, 1, 2]], loads="yes")  # type: ignore[arg-type]
