"""Many worlds in one launch: each has the bits that it has alone, whatever is in it, and knows nothing of the others."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .rows import OTHERS, ROWS

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)


@ti.func
def spring(x):
    return -0.1 * x


def every_constraint(dim, k):
    """All constraints of this dimension, far from each other, each at corners that meet it, more or less."""
    made = {name: (row.points, row.make) for name, row in ROWS.items()} | {
        name: (p, make) for name, (p, make, _) in OTHERS.items()
    }
    x, features = [], []
    for name, (points, make) in made.items():
        m, d = points.shape
        if d == dim and name != "Path":
            corners = np.arange(m).reshape(1, m) + sum(map(len, x))
            x.append(points + 4.0 * len(x) * np.eye(dim)[0] * ("Path" not in name))
            features.append(make(corners, np.full(1, 0.5)) if name in ROWS else make(corners))
    x = np.concatenate(x)
    mass = 1.0 + 0.5 * k + np.arange(len(x)) % 3
    return tv.World(tv.Particles(x, mass=mass), [tv.Gravity(2.0 + k), *features], substeps=5)


def every_force(dim, k):
    """All forces and walls, with friction and restitution, between particles that touch."""
    along, far = np.eye(dim)[0], np.full(dim, 9.0)
    forces = [tv.Gravity(9.81), tv.Drag(0.1), tv.Wind(along, 0.1 + k), tv.Attractor(far, 1.0), tv.Hand(far, 1), tv.Force(spring)]
    pairs = [tv.PairForce(spring, 2.5)]
    walls = [tv.Box(0 * far, far, friction=0.2), tv.HalfSpace(along, 0.1), tv.Ball(far / 2, 1.0, restitution=0.5)]
    walls += [tv.Capsule(0.2 * far, 0.2 * far + along, 0.3)]
    n = np.arange(40)
    x = np.stack([n % 5 + 0.6, n // 5 + 0.6, 0.5 + 0 * n], axis=1)[:, :dim] + 0.02 * tv.golden(n, dim=dim) + 0.01 * k
    touch = tv.Contact(friction=0.3, restitution=0.4)
    return tv.World(tv.Particles(x, radius=0.45, mass=1 + n % 3 + k), [*forces, *pairs, *walls, touch], substeps=6, iterations=2)


def cloth(solver, k, precision="f32", order=2, substeps=5, links=None):
    """A net, pinned at two corners, that falls; or a part of it."""
    n = np.arange(36).reshape(6, 6)
    pairs = np.vstack([np.stack([n[:, :-1].ravel(), n[:, 1:].ravel()], 1), np.stack([n[:-1].ravel(), n[1:].ravel()], 1)])
    pairs = pairs if links is None else pairs[:links]
    x = np.stack([n.ravel() // 6, 0 * n.ravel(), n.ravel() % 6], axis=1) * (0.1 + 0.01 * k)
    features = [tv.Gravity(9.81), tv.Distance(pairs)]
    start = tv.Particles(x, pinned=[0, 30], mass=1.0 + k)
    return tv.World(start, features, solver=solver, precision=precision, order=order, substeps=substeps, iterations=2)


def bricks(k):
    """Polygons that fall on each other."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    x = np.concatenate([square + [0.3 * j * (1 + 0.1 * k), 1.05 * j + 0.05] for j in range(4)])
    bodies = np.arange(16).reshape(4, 4)
    sides = np.concatenate([np.stack([b, np.roll(b, 1)], 1) for b in bodies] + [b[[[0, 2], [1, 3]]] for b in bodies])
    features = [
        tv.Gravity(9.81),
        tv.Distance(sides),
        tv.Polygons([*bodies], friction=0.4),
        tv.HalfSpace((0, 1), 0.0, friction=0.4),
    ]
    return tv.World(tv.Particles(x), features, substeps=8)


SCENES = {
    "every constraint, 2D": lambda k: every_constraint(2, k),
    "every constraint, 3D": lambda k: every_constraint(3, k),
    "every force and wall, 2D": lambda k: every_force(2, k),
    "every force and wall, 3D": lambda k: every_force(3, k),
    "polygons": bricks,
    "Jacobi": lambda k: cloth(tv.Jacobi(), k),
    "Chebyshev": lambda k: cloth(tv.Chebyshev(), k),
    "ConjugateGradient": lambda k: cloth(tv.ConjugateGradient(4), k),
    "Direct, compensated": lambda k: cloth(tv.Direct(), k, "f32-compensated"),
    "order 4": lambda k: cloth(None, k, "f64", 4, 2, 30),
    "order 6": lambda k: cloth(None, k, "f64", 6, 1, 30),
    "order 8": lambda k: cloth(None, k, "f64", 8, 1, 30),
}


@pytest.mark.filterwarnings("ignore")  # of corners that are off
@pytest.mark.parametrize("name", SCENES)
def test_each_has_the_bits_that_it_has_alone(taichi, name):
    # Three worlds with other masses, places and knobs: frames one by one and in one launch, with fewer substeps, from velocities
    # that are assigned, and once more from the start. Their velocities and reports are those of the worlds alone, too.
    alone = [SCENES[name](k) for k in range(3)]
    with tv.Worlds([SCENES[name](k) for k in range(3)]) as many:
        assert [many.hash(k) for k in range(3)] == [w.hash() for w in alone]

        def both():
            reports = [w.step(1 / 60) for w in alone]
            together = many.step(1 / 60)
            for k, one in enumerate(reports):
                assert one == many.last.of(k).__class__(**(vars(together.of(k)) | {"notes": one.notes, "tries": 1}))
                assert many.hash(k) == alone[k].hash()

        both()
        starts = [w.run(0.1) for w in alone]
        track = many.rollout(0.1)
        assert track.position.shape == (3, 6, *alone[0].position.shape)
        np.testing.assert_array_equal(track.position[:, -1], [w.position for w in alone])
        np.testing.assert_allclose(track.time[:, -1], [w.time for w in alone], rtol=1e-15)
        assert [many.hash(k) for k in range(3)] == [w.hash() for w in alone]
        assert [many.last.of(k).residual for k in range(3)] == [r.residual for r in starts]
        np.testing.assert_array_equal(many.velocity, [w.velocity for w in alone])
        for w in (many, *alone):
            w.substeps = 3 if name[:5] != "order" else 1
            w.velocity = 0.9 * w.velocity
        both()
        assert many[1].hash() == alone[1].hash()
        first = [many.hash(k) for k in range(3)]
        many.reset([0, 2])
        assert many.hash(1) == first[1]
        fresh = [SCENES[name](k) for k in (0, 2)]
        for w in (many, *fresh):
            w.substeps = alone[0].substeps
            w.step(1 / 60)
        assert [many.hash(0), many.hash(2)] == [w.hash() for w in fresh]
    for w in (*alone, *fresh):
        w.close()
