"""Scenes that users begin with."""

import numpy as np

import tiverlet as tv

from .scene import c, scene

G = 9.81


@scene(smooth=True)
def a_rope_swings_from_one_end():
    rope = tv.shapes.rope((0, 0), (1, 0), points=9)
    return c.Particles(rope.position, mass=0.1, pinned=[0]), [c.Gravity(G), c.Distance(rope.links)], {"precision": "f64"}


@scene()
def a_taut_net_between_four_pins():
    net = tv.shapes.net((0, 0, 0), (1, 0, 0), (0, 1, 0), points=(6, 6))
    corners = np.flatnonzero(np.isin(net.position, (0, 1))[:, :2].all(axis=1))
    features = [c.Gravity((0, 0, -G)), c.Distance(net.links)]
    return c.Particles(net.position, mass=0.02, pinned=corners), features, {"solver": c.Jacobi()}


@scene()
def grains_of_many_sizes_are_poured():
    rng, n = np.random.default_rng(1), 30
    x = np.stack([rng.uniform(-0.3, 0.3, n), 0.1 * np.arange(n) + 0.2], axis=1)
    walls = [c.HalfSpace((0, 1), 0.0, friction=0.5), c.HalfSpace((1, 0), -0.5), c.HalfSpace((-1, 0), -0.5)]
    particles = c.Particles(x, radius=rng.uniform(0.03, 0.09, n), mass=rng.uniform(1, 3, n), spin=True)
    return particles, [c.Gravity(G), c.Contact(friction=0.4, restitution=0.3), *walls]


@scene()
def spheres_fall_into_a_box():
    x = 0.25 * np.stack(np.meshgrid(*[np.arange(3)] * 3), axis=-1).reshape(-1, 3) + [0.2, 0.3, 0.2]
    x += 0.02 * np.sin(7.0 * np.arange(x.size)).reshape(x.shape)
    return c.Particles(x, radius=0.1), [c.Gravity(G), c.Contact(friction=0.3), c.Box((0, 0, 0), (0.9, 2, 0.9), friction=0.3)]


@scene()
def beads_collide_in_free_space():
    angle = 2 * np.pi * np.arange(8) / 8
    x = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.linspace(0.5, 0.9, 8)[:, None]
    start = c.Particles(x, velocity=-2 * x, mass=1.0 + np.arange(8) % 3, radius=0.1)
    return start, [c.Contact(restitution=0.7)], {"precision": "f64", "substeps": 8}


@scene()
def a_box_of_links_hangs_on_a_rope_over_discs():
    rope = tv.shapes.rope((0.15, 1.0), (0.15, 1.8), points=6)
    box = np.array([[0.0, 0.8], [0.3, 0.8], [0.3, 1.0], [0.0, 1.0]])
    discs = np.stack([0.19 * np.arange(5) - 0.3, 0.1 + 0.3 * (np.arange(5) % 2)], axis=1)
    x = np.concatenate([rope.position, box, discs])
    edges = np.array([[6, 7], [7, 8], [8, 9], [9, 6], [6, 8], [7, 9], [0, 8], [0, 9]])
    links = np.concatenate([rope.links, edges])
    return (
        c.Particles(x, radius=np.where(np.arange(15) < 6, 0.03, 0.09), mass=np.where(np.arange(15) < 6, 0.1, 1.0), pinned=[5]),
        [c.Gravity(G), c.Distance(links), c.Contact(friction=0.3), c.HalfSpace((0, 1), 0.0, friction=0.3)],
    )


@scene()
def a_soft_ball_and_a_rigid_square_fall():
    angle = 2 * np.pi * np.arange(10) / 10
    ring = 0.25 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + [0.0, 0.4]
    square = np.array([[0.5, 0.3], [0.7, 0.3], [0.7, 0.5], [0.5, 0.5]])
    around = np.stack([np.arange(10), (np.arange(10) + 1) % 10], axis=1)
    soft = [c.Distance(around, compliance=1e-4, damping=0.5), c.Area([list(range(10))], pressure=1.1, compliance=1e-4)]
    walls = [c.HalfSpace((0, 1), 0.0, friction=0.4)]
    start = c.Particles(np.concatenate([ring, square]), mass=0.1, radius=0.05, velocity=(0.5, 0.0))
    return start, [c.Gravity(G), *soft, c.ShapeMatch([list(range(10, 14))]), c.Contact(friction=0.3), *walls]
