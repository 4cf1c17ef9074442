"""Scenes of walls of all kinds, and of periodic boxes."""

import numpy as np

import tiverlet as tv

from ..fuzz.functions import pillar, repel
from .scene import c, scene

G = 9.81
TENT = np.array([[-0.3, 0.0, -0.3], [0.3, 0.0, -0.3], [0.0, 0.0, 0.3], [0.0, 0.3, 0.0]])
TENT_FACES = [(0, 1, 2), (0, 1, 3), (1, 2, 3), (0, 2, 3)]


@scene()
def points_are_thrown_among_walls_of_all_kinds():
    rng, bend = np.random.default_rng(0), np.array([[-0.3, -0.2], [0.4, -0.2], [0.0, 0.3]])
    x = np.stack([rng.uniform(-2.9, 2.9, 40), rng.uniform(1.2, 1.9, 40)], axis=1)
    options = {"friction": 0.3, "restitution": 0.5}
    walls = [
        c.Box((-3, -0.9), (3, 2), restitution=0.8), c.Sdf(pillar, friction=0.2), c.Polygon(bend, position=(-2.0, 0.2), **options),
        c.Polygon(bend[[0, 2, 1]] * 2 + (0, 0.1), **options), c.Capsule((-1.2, 0.6), (-0.6, 0.8), 0.1, **options),
        c.Capsule((1.0, 0.9), (1.3, 0.4), 0.1, **options), c.Ball((-1.5, -0.5), 0.2, **options),
    ]  # fmt: skip
    return c.Particles(x, velocity=rng.normal(0, 3, (40, 2)), radius=0.03), [c.Gravity(G), *walls]


@scene()
def a_net_and_points_fall_on_walls_in_space():
    rng = np.random.default_rng(1)
    net = tv.shapes.net((-0.3, 0.6, -0.3), (0.6, 0, 0), (0, 0, 0.6), points=(4, 4))
    x = np.concatenate([net.position, rng.uniform(-0.8, 0.8, (20, 3)) + (0, 2, 0)])
    walls = [
        c.Mesh(TENT, TENT_FACES, friction=0.3), c.Mesh(2 * TENT, TENT_FACES, position=(0.0, -1.0, 0.0), friction=0.1),
        c.Capsule((-1, -0.2, 0), (-0.5, 0, 0), 0.1), c.Ball((0.7, -0.2, 0), 0.2, restitution=0.9), c.Box([-1] * 3, [1, 4, 1]),
    ]  # fmt: skip
    start = c.Particles(x, mass=0.1, velocity=np.where(np.arange(36)[:, None] < 16, 0.0, (0.5, -3.0, 0.2)))
    return start, [c.Gravity(G), c.Distance(net.links), *walls], {"precision": "f64"}


@scene()
def ropes_pass_a_one_way_sheet_and_land_on_it():
    corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], dtype=float)
    rope = tv.shapes.rope((-0.4, 0.3, 0.0), (0.4, 0.3, 0.1), points=6)
    x = np.concatenate([rope.position, rope.position - [0, 0.6, 0.3]])
    sheet = c.Mesh(corners, [(0, 2, 1), (0, 3, 2)], closed=False, one_way=(0, 1, 0))
    start = c.Particles(x, velocity=np.repeat([[0.0, 0, 0], [0, 4.0, 0]], 6, axis=0), radius=0.02)
    return start, [c.Gravity(G), c.Distance(np.concatenate([rope.links, rope.links + 6])), sheet]


@scene()
def discs_fall_on_platforms_rods_and_blocks():
    k, line = np.arange(30), np.linspace(-1, 1, 9)
    x = np.stack([0.2 * (k % 10) - 0.9 + 0.02 * np.sin(k), 0.4 + 0.25 * (k // 10)], axis=1)
    block = np.array([[-0.4, -0.2], [0.4, -0.2], [0.4, 0.2], [-0.4, 0.2]])
    walls = [
        c.Polygon(np.stack([line, 0.1 * line**2], axis=1), closed=False, radius=0.02, one_way=(0, 1), friction=0.3),
        c.Polygon(block, position=(-1.0, -0.6), friction=0.4), c.Polygon(block[:3], position=(1.1, -0.5), rotation=0.3),
        c.Capsule((-2.0, -1.2), (2.0, -1.5), 0.1, friction=0.3), c.Capsule((-2.0, -1.5), (-2.2, 0.0), 0.1),
    ]  # fmt: skip
    return c.Particles(x, radius=0.06 + 0.03 * tv.golden(k)), [c.Gravity(G), c.Contact(friction=0.3), *walls]


@scene(smooth=True)
def a_disc_slides_in_a_bowl_beside_contacts():
    start = c.Particles([(0.6, -0.65), (0.0, 0.0)], radius=0.1, pinned=[1])
    return start, [c.Gravity(G), c.Ball((0, 0), 1.0, True), c.Contact()], {"precision": "f64"}


@scene()
def boxes_on_rods_meet_as_cars_of_trains():
    box = np.array([[0.0, 0.0], [0.4, 0.0], [0.4, 0.4], [0.0, 0.4]])
    places = np.array([[0.0, 0.0], [0.6, 0.0], [1.9, 0.15], [2.5, 0.15]])
    loops, rods = [list(range(4 * k, 4 * k + 4)) for k in range(4)], [(1, 4), (2, 7), (9, 12), (10, 15)]
    v = np.repeat([(2.0, 0.0), (-1.0, 0.0)], 8, axis=0)
    bodies = [c.ShapeMatch(loops), c.Distance(rods), c.Polygons(loops, 0.5)]
    return c.Particles((places[:, None] + box).reshape(-1, 2), velocity=v), bodies, {"substeps": 32}


@scene()
def a_gas_in_a_periodic_cube():
    x = (np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) * 1.2
    start = c.Particles(x, velocity=np.random.default_rng(3).normal(size=x.shape), radius=0.28)
    return start, [c.Periodic([0.0] * 3, [3.6] * 3), c.Contact(restitution=1.0)], {"precision": "f64", "substeps": 10}


@scene()
def beads_that_repel_rub_and_are_sheared():
    rng = np.random.default_rng(2)
    x = rng.uniform(0, 1, (20, 2)) * (4.0, 3.0)
    links = [[0, 1], [1, 2], [5, 6]]
    features = [c.Periodic((0, 0), (4, 3), shear=0.5), c.Distance(links, 0.8, compliance=1e-3, damping=1.0)]
    features += [c.PairForce(repel, 1.0), c.Contact(friction=0.3, restitution=0.5)]
    return c.Particles(x, velocity=rng.normal(size=(20, 2)) + 0.5 * x[:, 1:] * (1, 0), radius=0.1), features


@scene(smooth=True)
def a_chain_with_bends_around_a_periodic_box_swings():
    n = 12
    k = np.arange(n)
    x = np.stack([k * 0.25, 0.5 + 0.05 * np.sin(2 * np.pi * k / n)], axis=1)
    bends = c.Bend(np.stack([k, (k + 1) % n, (k + 2) % n], axis=1), 0.0, compliance=1e-1)
    ring = c.Distance(np.stack([k, (k + 1) % n], axis=1), 0.25, compliance=1e-2)
    return c.Particles(x, velocity=(1.3, 0.4)), [c.Periodic((0, 0), (3, 2)), ring, bends], {"precision": "f64"}
