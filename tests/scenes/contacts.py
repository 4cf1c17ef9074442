"""Scenes of contacts: bodies that strike each other, grains that spin, sleep, and lie on lighter or heavier ones."""

import numpy as np

from .scene import c, scene

G = 9.81
TRIANGLE = np.array([[0.0, 0.0], [0.5, 0.0], [0.25, 0.4]])


def turned(x, angle):
    """Turn positions about their middle."""
    middle, (a, b) = np.mean(x, axis=0), (np.cos(angle), np.sin(angle))
    return (x - middle) @ np.array([[a, b], [-b, a]]) + middle


def strip(k, width):
    """Return an upright strip of triangles with k particles: positions and links that make it rigid."""
    i = np.arange(k)
    pairs = np.concatenate([np.stack([i[:-s], i[s:]], axis=1) for s in (1, 2)])
    return np.stack([width * (i % 2), i // 2 / (k // 2 - 1)], axis=1), pairs


@scene()
def planks_land_upright_on_a_rough_floor():
    x, pairs = [], []
    for k, (width, tilt, high) in enumerate(((0.03, 0.01, 0.1), (0.05, 0.05, 0.3), (0.15, 0.1, 0.6), (0.3, 0.16, 1.0))):
        some, links = strip((4, 6, 8)[k % 3], width)
        pairs.append(links + sum(map(len, x)))
        x.append(turned(some, tilt) + [4.0 * k, high])
    start = c.Particles(np.concatenate(x), radius=0.01, velocity=(0.3, 0.0))
    return start, [c.Gravity(G), c.Distance(np.concatenate(pairs)), c.HalfSpace((0, 1), friction=0.3)]


@scene()
def thin_bodies_are_thrown_at_each_other_and_slide_round_their_corners():
    rng, shapes, v = np.random.default_rng(0), [], []
    for k in range(12):
        count, thin = 3 + k % 4, (0.25, 1.0)[k % 2]
        a = (np.arange(count) + rng.uniform(-0.25, 0.25, count)) * 2 * np.pi / count
        r = turned(np.stack([np.cos(a), thin * np.sin(a)], axis=1) / 2, rng.uniform(0, 2 * np.pi))
        b = k % 3 * 2 * np.pi / 3 + rng.uniform(-0.2, 0.2)
        out = np.array([np.cos(b), np.sin(b)])
        shapes.append(r + 1.3 * out + (6 * (k // 3) - 9, 0))
        v.append(rng.normal(0, 0.4, 2) - 2 * out + rng.normal(0, 2) * r[:, ::-1] * (-1, 1))
    each = [len(x) for x in shapes]
    loops = [list(map(int, loop)) for loop in np.split(np.arange(sum(each)), np.cumsum(each)[:-1])]
    x, mass = np.vstack([*shapes, [(0.0, 30.0)]]), np.append(np.repeat(1 / np.array(each), each), 1.0)
    start = c.Particles(x, velocity=np.vstack([*v, [(0.0, 0.0)]]), mass=mass, pinned=[len(x) - 1])
    return start, [c.Polygons(loops, friction=0.5), c.ShapeMatch(loops)], {"precision": "f64", "substeps": 40}


@scene()
def clusters_linked_bodies_and_a_rod_strike_in_turn():
    bodies = [turned(TRIANGLE, 0.7 * k) + (0.25 + 0.55 * k, 0.3 + 0.5 * (k % 2)) for k in range(5)]
    rod, pairs = strip(6, 0.1)
    x = np.concatenate([*bodies, turned(0.5 * rod, 0.3) + (3.0, 0.3), [(0.25 + k, -0.3) for k in range(4)]])
    speeds = [(2.0, -3.0), (-2.0, 1.0), (1.0, -3.0), (0.0, -2.0), (-2.0, -1.0), (-1.0, -2.0), (-1.0, -2.0)]
    v = np.vstack([np.repeat(speeds, 3, axis=0), np.zeros((4, 2))])
    sides = np.array([(0, 1), (1, 2), (0, 2)])
    held = [c.ShapeMatch([[0, 1, 2], [3, 4, 5], [6, 7, 8]]), c.Distance(np.concatenate([sides + 9, sides + 12, pairs + 15]))]
    start = c.Particles(x, velocity=v, radius=[0.04] * 21 + [0.2] * 4, pinned=range(21, 25))
    return start, [c.Gravity(G), *held, c.Contact(0.2, 0.9)], {"substeps": 8}


@scene()
def bobs_of_two_discs_just_touch_side_by_side():
    top, k = np.array([[0.4 * b, 2.1] for b in range(5)]), 3 * np.arange(5)
    x = np.stack([top, top - (0, 2.0), top - (0, 2.1)], axis=1).reshape(-1, 2)
    start = c.Particles(x, mass=[np.inf, 0.5, 0.5] * 5, radius=[0, 0.2, 0.2] * 5)
    held = [c.Distance(np.stack([k, k + 1], axis=1)), c.ShapeMatch([[i + 1, i + 2] for i in map(int, k)])]
    return start, [c.Gravity(), c.Contact(friction=0.3, restitution=1e-9), *held], {"substeps": 2}


@scene()
def a_ball_breaks_a_rack_with_friction_and_without_loss():
    rack = np.array([(0.202 * np.sqrt(0.75) * i, 0.202 * (j - i / 2)) for i in range(5) for j in range(i + 1)])
    start = c.Particles(np.vstack([(-1.0, 0.03), rack]), velocity=[(8.0, 0.0), *[(0.0, 0.0)] * 15], radius=0.1)
    walls = c.Box((-1.5, -1.2), (4.4, 1.2), restitution=1.0)
    return start, [c.Contact(friction=0.5, restitution=1.0), walls], {"precision": "f64", "substeps": 8}


@scene()
def spheres_spin_roll_and_grip_in_a_box():
    rng, n = np.random.default_rng(0), 20
    x = 0.3 * np.stack(np.meshgrid(*[np.arange(3)] * 3), axis=-1).reshape(-1, 3)[:n] + 0.2 + 0.1 * rng.random((n, 3))
    start = c.Particles(
        x, velocity=rng.normal(size=(n, 3)), radius=0.05 + 0.03 * rng.random(n), mass=1 + rng.random(n),
        spin=rng.normal(size=(n, 3)) * 10, orientation=0,
    )  # fmt: skip
    contact = c.Contact(friction=(0.5, 0.4, 0.1, 0.05), restitution=(0.4, 0.3))
    walls = c.Box((0, 0, 0), (1.2, 1.2, 1.2), friction=(0.5, 0.4, 0.1), restitution=(0.5, 0.2))
    return start, [c.Gravity(G), contact, walls], {"substeps": 8}


@scene(smooth=True)
def a_sphere_rolls_off_another():
    x = [(0.0, 0.0, 0.0), (1.2 * np.sin(0.6), 1.2 * np.cos(0.6), 0.0)]
    start = c.Particles(x, radius=[1.0, 0.2], mass=[2.0, 1.0], pinned=[0], spin=0.0)
    return start, [c.Gravity(G), c.Contact(friction=5.0)], {"precision": "f64"}


@scene()
def a_row_of_discs_falls_asleep_and_is_hit():
    x = [(10 + 1.05 * k, 9.0) for k in range(1, 6)] + [(9.1, 9.1), (13.6, 11.0), (17.0, 9.2)]
    v = [(0.0, 0.0)] * 5 + [(6.0, 0.3), (0.0, -8.0), (0.0, 0.0)]
    start = c.Particles(x, velocity=v, radius=0.5, spin=0.0, pinned=[7])
    contact = c.Contact(friction=(0.5, 0.4, 0.05), restitution=0.2, events=True)
    return start, [contact, c.Sleep(1e-4, 0.05)], {"substeps": 8}


@scene()
def light_grains_are_poured_among_heavy_ones():
    rng, k = np.random.default_rng(1), np.arange(60)
    x = np.stack([k % 10 * 0.25 + k // 10 % 2 * 0.03 + 0.2, k // 10 * 0.25 + 0.15], axis=1)
    start = c.Particles(x, radius=np.where(k % 9 == 4, 0.12, 0.03), mass=rng.choice([1.0, 30.0], 60))
    return start, [c.Gravity(G), c.Contact(), c.Box((0, 0), (2.7, 50))], {"substeps": 8}
