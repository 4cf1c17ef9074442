"""Scenes for changes of the substep: what sags, hangs and swings where passes leave violations."""

import numpy as np

import tiverlet as tv

from .scene import c, scene

G = 9.81


def steps(first, n):
    """Return the pairs of a chain of n links."""
    k = first + np.arange(n)
    return np.stack([k, k + 1], axis=1)


def grid(i, j, size):
    """Return i x j places in the plane, the second index first."""
    return size * np.stack(np.divmod(np.arange(i * j), j), axis=1)


@scene(flags={"unconverged"})
def taut_ropes_and_a_chain_with_a_weight():
    ropes = [tv.shapes.rope((0, y), (1, y), points=n) for y, n in ((0, 5), (1, 14))]
    chain = np.stack([2 + 0.05 * np.arange(12), np.zeros(12)], axis=1)
    links = np.concatenate([ropes[0].links, ropes[1].links + 5, steps(19, 11)])
    x, mass = np.concatenate([ropes[0].position, ropes[1].position, chain]), [0.1] * 19 + [0.05] * 11 + [5.0]
    return c.Particles(x, mass=mass, pinned=[0, 4, 5, 18, 19]), [c.Gravity(G), c.Distance(links)], {"solver": c.Jacobi()}


@scene()
def jelly_of_clusters_and_a_ladder_of_masses_fall_on_a_floor_without_contacts():
    squares = [[4 * i + j + k for k in (0, 1, 4, 5)] for i in range(3) for j in range(3)]
    x = np.concatenate([grid(4, 4, 0.2) + [0, 0.4], [(2, 0), (2, 0.3), (2, 0.6)]])
    v = np.where(np.arange(19) < 16, 0.0, -5.0)[:, None] * [0, 1]
    features = [c.Gravity(G), c.ShapeMatch(squares), c.Distance(steps(16, 2)), c.HalfSpace((0, 1), 0.0)]
    return c.Particles(x, velocity=v, mass=0.1), features, {"solver": c.Jacobi()}


@scene()
def a_rope_of_springs_hangs_on_a_stiff_pin():
    rope = tv.shapes.rope((0, 0), (1, 0), points=11)
    springs = [c.Distance(rope.links, compliance=1e-5), c.Pin([0], compliance=1e-6)]
    return c.Particles(rope.position, mass=0.1), [c.Gravity(G), *springs], {"solver": c.Jacobi()}


@scene(flags={"unconverged"})
def cantilevers_of_areas_and_of_clusters():
    k, x = np.arange(16).reshape(8, 2), grid(8, 2, 0.1)
    loops = np.stack([k[:-1, 0], k[1:, 0], k[1:, 1], k[:-1, 1]], axis=1)
    pairs = np.concatenate([loops[:, [0, 1]], loops[:, [1, 2]], loops[:, [3, 2]]])
    features = [c.Gravity(G), c.Area(loops.tolist()), c.Distance(pairs), c.ShapeMatch(loops + 16)]
    start = c.Particles(np.concatenate([x, x + [2.0, 0]]), mass=0.01, pinned=[0, 1, 16, 17])
    return start, features, {"solver": c.Jacobi()}


@scene()
def rods_of_rigid_angles_in_space_vibrate_across():
    k, x, v = np.arange(8), np.zeros((16, 3)), np.zeros((16, 3))
    x[:, 0], x[8:, 2], v[10:, 2] = 0.1 * np.tile(k, 2), 1.0, 0.3 * np.sin(k[:6])
    triples = np.stack([k[:-2], k[1:-1], k[2:]], axis=1)
    bends, links = c.Bend(np.concatenate([triples, triples + 8])), c.Distance(np.concatenate([steps(0, 7), steps(8, 7)]))
    return c.Particles(x, velocity=v, mass=0.1, pinned=[0, 1, 8, 9]), [c.Gravity((0.0, -G, 0.0)), links, bends]


@scene()
def a_body_of_springs_turns_in_space():
    body = tv.shapes.truss((-0.3, -0.3, -0.3), (0.3, 0.3, 0.3), (2, 2, 2))
    links = c.Distance(np.concatenate([body.links, body.braces]), compliance=1e-3)
    start = c.Particles(body.position, velocity=np.cross([0.0, 3.0, 6.0], body.position), mass=1 / len(body.position))
    return start, [links], {"precision": "f64", "solver": c.Jacobi()}


@scene()
def a_cart_falls_on_a_truss():
    truss = tv.shapes.bridge((0, 0), (2, 0), panels=6, height=0.4)
    n = len(truss.position)
    x = np.concatenate([truss.position, [[0.6, 0.75], [1.0, 0.75], [0.8, 1.0]]])
    links = np.concatenate([truss.links, [[n, n + 1], [n + 1, n + 2], [n, n + 2]]])
    ends = np.flatnonzero(np.isin(x[:, 0], (0.0, 2.0)))
    start = c.Particles(x, mass=np.r_[np.full(n, 0.2), 1, 1, 0.5], radius=np.r_[np.full(n, 0.05), 0.2, 0.2, 0.05], pinned=ends)
    return start, [c.Gravity(G), c.Distance(links), c.Contact(friction=0.5)], {"solver": c.Jacobi()}


@scene()
def a_chain_swings_by_order_4():
    x = np.stack([0.3 * np.arange(5), 0.0 * np.arange(5)], axis=1)
    return c.Particles(x, pinned=[0]), [c.Gravity(G), c.Distance(steps(0, 4))], {"precision": "f64", "order": 4}
