"""Scenes in which particles come and go, that stop and start, and whose parts many worlds and threads share."""

import numpy as np

import tiverlet as tv

from ..fuzz import functions
from .scene import c, scene

G = 9.81


def heap(n: int) -> np.ndarray:
    """Return the positions of a loose heap of discs of radius 0.1."""
    x = 0.205 * np.stack(np.divmod(np.arange(n), int(np.ceil(n**0.5)))[::-1], axis=1) + 0.15
    return x + 0.003 * np.sin(np.arange(n * 2)).reshape(n, 2)


@scene()
def discs_of_groups_touch_sensors_while_a_hand_pulls():
    n = 16
    contact = c.Contact(friction={(0, 1): 0.5}, groups=[(0, 1), (1, 1), (0, 0)], sensors=[(0, 2)], events=True)
    features = [c.Gravity(G), c.Hand((1.0, 0.5), particle=7), contact, c.HalfSpace((0, 1), 0.0, events=True)]
    start = c.Particles(heap(n), radius=0.1, group=np.arange(n) % 3, spin=0.5)
    return start, [*features, c.Pin([2], compliance=1e-3)], {"substeps": 5}


@scene()
def grains_of_many_sizes_fall_through_a_periodic_box():
    size = 0.1 * (0.3 + 0.7 * np.abs(np.sin(np.arange(20))))
    features = [c.Gravity((0.5, -1.0)), c.Periodic((0, 0), (2, 4)), c.Contact(restitution=0.5)]
    return c.Particles(heap(20), radius=size, mass=size**2), features, {"substeps": 5, "precision": "f64"}


@scene()
def discs_that_repel_each_other_fall_to_a_ground_that_is_a_function():
    features = [c.Gravity(G), c.Sdf(functions.ground, friction=0.2), c.PairForce(functions.repel, 1.0), c.Drag(0.5)]
    return c.Particles(2.0 * heap(9), radius=0.05), features, {"substeps": 8}


@scene()
def discs_that_sleep_are_woken_by_one_that_falls():
    x = np.concatenate([np.stack([0.25 * np.arange(6), np.full(6, 0.1)], axis=1), [[0.6, 0.9]]])
    features = [c.Gravity(G), c.HalfSpace((0, 1), 0.0, friction=0.3), c.Contact(friction=0.3), c.Sleep(0.05, 0.05)]
    return c.Particles(x, radius=0.1), features, {"substeps": 5}


@scene()
def ropes_between_pins_bend_over_a_floor_until_one_breaks():
    along = np.stack([np.linspace(0.0, 0.6, 5), np.full(5, 0.5)], axis=1)
    x = np.concatenate([along + [0.8 * k, 0.0] for k in range(2)])
    pairs = np.array([(5 * k + i, 5 * k + i + 1) for k in range(2) for i in range(4)])
    soft = np.where(pairs[:, 0] < 5, 1e-5, 0.0)
    triples = np.array([(5 + i, 6 + i, 7 + i) for i in range(3)])
    strength = np.where(pairs[:, 0] < 5, 12.0, np.inf)
    links = [c.Distance(pairs, compliance=soft, damping=1.0, break_at=strength), c.Bend(triples, compliance=1e-2)]
    tethers = [c.Pin([0]), c.Pin([4, 5], compliance=1e-4), c.HalfSpace((0, 1), 0.1)]
    return c.Particles(x), [c.Gravity(G), *links, *tethers], {"solver": c.Direct(), "precision": "f64"}


@scene()
def a_net_that_is_solved_as_a_whole_hangs_from_a_corner():
    n = np.arange(25).reshape(5, 5)
    pairs = np.vstack([np.stack([n[:, :-1].ravel(), n[:, 1:].ravel()], 1), np.stack([n[:-1].ravel(), n[1:].ravel()], 1)])
    x = np.stack([n.ravel() // 5, 0 * n.ravel(), n.ravel() % 5], axis=1) * 0.1
    start = c.Particles(x, pinned=[0], mass=0.1 + 0.1 * (np.arange(25) % 3))
    settings = {"solver": c.ConjugateGradient(4), "precision": "f32-compensated", "iterations": 2}
    return start, [c.Gravity(G), c.Distance(pairs)], settings


@scene(flags={"moved", "stiff-force"})
def forces_of_all_kinds_drive_links_between_walls():
    n = 20
    x = 2.0 * heap(n)
    pairs = np.arange(8, n).reshape(-1, 2)
    soft = np.where(np.arange(len(pairs)) % 2, 1e-4, 0.0)
    forces = [c.Gravity(G), c.Force(functions.waves), c.Wind((1.0, 0.0), 0.3), c.Hand((1.0, 1.0), 7), c.Attractor((1, 1), 1.0)]
    links = [c.Distance(pairs, compliance=soft, damping=1.0), c.Rope(pairs[:3] - 8, 0.5), c.Pin([6], (1, 1), compliance=1e-3)]
    walls = [c.Box((0, 0), (4, 9)), c.HalfSpace((0.2, 1), 0.1)]
    start = c.Particles(x, radius=0.08, mass=1 + np.arange(n) % 5)
    return start, [*forces, *links, *walls], {"precision": "f32-compensated", "substeps": 7, "iterations": 2}


@scene(flags={"unconverged"})
def taut_ropes_that_few_steps_of_conjugate_gradients_solve():
    ropes = [tv.shapes.rope((0, y), (1, y), points=n) for y, n in ((0, 5), (1, 40))]
    links = np.concatenate([ropes[0].links, ropes[1].links + 5])
    start = c.Particles(np.concatenate([rope.position for rope in ropes]), mass=0.1, pinned=[0, 4, 5, 44])
    return start, [c.Gravity(G), c.Distance(links)], {"solver": c.ConjugateGradient(5)}
