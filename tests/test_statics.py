"""Statics of bodies: stacks of Polygons neither drift nor sink nor give way, and bear what statics says."""

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


def standing(world, shapes, mass=1.0, *, friction=0.5, pinned=(), **settings):
    """Return a world of rigid bodies of these masses on a floor, and the particles of each.

    There is a pinned particle out of the way, which differs from the others: worlds of one precision share kernels.
    """
    loops = [4 * k + np.arange(4) for k in range(len(shapes))]
    each = np.r_[np.repeat(np.broadcast_to(mass, len(shapes)) / 4, 4), 1.5]
    radius, held = np.where(np.arange(len(each)) < 4 * len(shapes), 0.0, 0.1), [i for k in pinned for i in loops[k]]
    start = tv.Particles([*np.concatenate(shapes), (90.0, 90.0)], mass=each, radius=radius, pinned=[*held, len(each) - 1])
    surfaces = [tv.Polygons(loops, friction=0.5), tv.Box((-99, 0), (99, 99), friction=0.5)]
    features = [tv.Gravity(G), *surfaces, tv.ShapeMatch(loops)]
    w = world(start, features, **({"substeps": 8, "precision": "f64", "path": "fused"} | settings))
    for surface in surfaces:
        surface.friction = friction
    return w, loops


def turned(points, angle):
    """Turn points about the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]])


def bent(w, loops):
    """Return the largest change of a distance between corners of one body [m]."""
    first, now = (
        np.array([np.linalg.norm(x[loop][:, None] - x[loop], axis=2) for loop in loops])
        for x in (w.particles.position, w.position)
    )
    return np.abs(now - first).max()


def contact_forces(w):
    """Return the force of contacts on each particle, (n, 2) [N], along the normals."""
    found, out = w.contacts, np.zeros_like(w.position)
    force = found.impulse[:, None] * found.normal * 60 * w.substeps
    shares = ((found.pairs[:, 0], 1 + 0 * found.place), (found.pairs[:, 1], found.place - 1), (found.ends, -found.place))
    for who, share in shares:
        np.add.at(out, who, share[:, None] * force)
    return out


@pytest.mark.slow
def test_bodies_bear_what_statics_says(world):
    # A beam of 2 kg and 6 m lies on posts at -2 and 2 m; a block of 3 kg stands on it at 1 m. 15 boxes of 1 to 2 kg in rows of 5
    # to 1, with gaps in a row, all upright, so friction has no part in their weight. A box of 1 kg on a slope of 20 degrees.
    a, rows = np.radians(20.0), 5
    beam = [block(0.5, 1.0, (-2.0, 0.5)), block(0.5, 1.0, (2.0, 0.5)), block(6.0, 0.2, (0.0, 1.1)), block(0.4, 0.4, (1.0, 1.4))]
    slope = [turned(block(6.0, 1.0, (0.0, -0.5)), a) + (-20, 5), turned(block(1.0, 1.0, (0.0, 0.5)), a) + (-20, 5)]
    pyramid = [block(1.0, 1.0, (1.1 * (i + r / 2) + 20, r + 0.5)) for r in range(rows) for i in range(rows - r)]
    mass = np.r_[1, 1, 2, 3, 1, 1, np.random.default_rng(0).uniform(1, 2, len(pyramid))]
    w, loops = standing(world, beam + slope + pyramid, mass, pinned=(0, 1, 4), substeps=4)
    w.run(60.0)
    force, x = contact_forces(w), w.position
    posts, whole = -force[:8], np.array([force[loop].sum(axis=0) for loop in loops])
    np.testing.assert_allclose(posts.sum(axis=0), [0, 5 * G], atol=5 * G * 1e-6)
    assert (x[:8, 0] * posts[:, 1]).sum() == pytest.approx(3 * G * 1.0, rel=1e-5)
    np.testing.assert_allclose(whole[6 + rows :, 1], G * mass[6 + rows :], atol=1e-5 * G * mass[6:].sum())
    assert np.linalg.norm(whole[5]) == pytest.approx(G * np.cos(a), rel=1e-6)  # contact_forces() are those along normals
    np.testing.assert_allclose(x[24:-1], np.concatenate(pyramid), atol=1e-2)
    assert bent(w, loops[:4]) < 1e-6 and bent(w, loops[4:6]) < 1e-8 and bent(w, loops) < 5e-5
    assert w.contacts.overlap.max() < 5e-5
    w.run(30.0)
    np.testing.assert_allclose(w.position[16:24], x[16:24], atol=1e-9)  # friction does not creep


@pytest.mark.slow
def test_loads_are_gone_with_what_bore_them(world):
    # The floor goes: boxes fall as one, but for the loads of at most one more substep.
    w, loops = standing(world, column(5))
    w.run(15.0)
    assert bent(w, loops) < 1e-6
    w.features[2].lower = (-99.0, -99.0)
    v = [w.velocity[:-1] for _ in range(30) if w.step(1 / 60)]
    assert np.abs(v[-1][:, 1] - v[5][:, 1] + G * 24 / 60).max() < 1e-6 and np.ptp(v[-1][:, 1]) < 2 * 5 * G / 480
    # A box that is put elsewhere falls as it would alone, but for half of the displacement by gravity in a substep: its load is
    # gone in the first one.
    w, loops = standing(world, column(5), substeps=2)
    w.run(40.0)
    x = w.position.copy()
    x[16:20] += [5.0, 3.0]
    w.position = x
    w.step(1 / 60)
    np.testing.assert_allclose(w.position[16:20] - x[16:20], [[0.0, -G / 60**2 / 2]] * 4, atol=1.01 * G / 120**2)


PYRAMID = [block(1.0, 1.0, (1.05 * (k - (10 - r) / 2), 0.5 + r)) for r in range(10) for k in range(10 - r)]
RING = np.stack([np.cos(np.pi * np.arange(10) / 9), np.sin(np.pi * np.arange(10) / 9)], axis=1)[::-1]
ARCH = [np.array([2.0 * RING[k], 2.0 * RING[k + 1], 2.6 * RING[k + 1], 2.6 * RING[k]]) for k in range(9)]  # half a ring
STRUCTURES = {
    "tower": (column(20, 0.0), 1.0, 4), "pyramid under 100 kg": (PYRAMID, [*np.ones(54), 100.0], 8), "arch": (ARCH, 1.0, 4),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", STRUCTURES)
def test_what_stands_stays(world, name):
    # No body moves: in f32 within a few digits of the coordinates, 20 m * 2^-24 = 1e-6 m.
    shapes, mass, substeps = STRUCTURES[name]
    w, _ = standing(world, shapes, mass, friction=0.8, precision="f32", substeps=substeps)
    w.run(3.0)
    start = w.position.copy()
    for _ in range(600):
        w.step(1 / 60)
        assert not w.last.flags
    assert np.abs(w.position - start).max() < 4e-6 and np.abs(start[:-1] - np.concatenate(shapes)).max() < 2e-3


@pytest.mark.slow
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


@pytest.mark.parametrize("what", ["point", pytest.param("box", marks=pytest.mark.slow)])
def test_friction_holds_far_from_the_origin(world, what):
    # The slope is 0.3 < friction 0.6. In f32 at 50 m a digit is 4e-6 m, 60 times g h^2 at 200 substeps.
    tilted = G * np.array([-0.3, -1.0]) / np.hypot(1.0, 0.3)
    for substeps in (20, 200):
        if what == "point":
            floor = tv.HalfSpace((0, 1), friction=0.6)
            w = world(tv.Particles([[50.0, 0.0]], radius=0.0), [tv.Gravity(tilted), floor], substeps=substeps)
        else:
            w, _ = standing(world, [block(1.0, 1.0, (50.0, 0.5))], friction=0.6, precision="f32", substeps=substeps)
            w.features[0].g = tilted
        w.run(1.0)
        start = w.position.copy()
        w.run(5.0)
        assert np.abs(w.position - start).max() < 1e-8


def test_scenes_take_as_many_substeps_as_they_need(world):
    # 4 where particles and rigid bodies fall freely between contacts. Links, clusters that share particles or give way, and
    # forces that change take 20, and so does what has no contacts. A hand changes nothing.
    squares, loops = np.concatenate([block(1, 1, 0), block(1, 1, (2, 0))]), [[0, 1, 2, 3], [4, 5, 6, 7]]
    for few, *features in (
        (True,), (True, tv.Drag(0.1)), (True, tv.Hand((0, 0))), (False, tv.Attractor((0, 0), 1.0)), (True, tv.ShapeMatch(loops)),
        (True, tv.ShapeMatch(loops[:1]), tv.ShapeMatch(loops[1:])),
        (False, tv.ShapeMatch(loops), tv.ShapeMatch([[0, 4]])), (False, tv.ShapeMatch(loops, compliance=1e-4)),
        (False, tv.ShapeMatch(loops), tv.Distance([(0, 4)])), (False, tv.ShapeMatch(loops), tv.Attractor((0, 0), 1.0)),
    ):  # fmt: skip
        w = world(tv.Particles(squares, radius=0.1), [tv.Gravity(), tv.Contact(), *features])
        assert w.substeps == (4 if few else 20), features
        assert f"(by default, for {'contacts' if few else 'constraints'}" in w.explain()
    assert world(tv.Particles(squares), [tv.Gravity()]).substeps == 20
    link, w = tv.Distance([[0, 4]]), world(tv.Particles(squares, radius=0.1), [tv.Gravity(), tv.Contact()])
    w.add(features=[link])
    assert w.substeps == 20
    w.substeps = 7
    assert "by default" not in w.explain()
    w.remove(features=[link])
    assert w.substeps == 7
    w.substeps = None
    assert w.substeps == 4
