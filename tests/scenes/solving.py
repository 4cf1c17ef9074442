"""Structures of links, ropes and clusters: what elimination, conjugate gradients and passes solve, alone and among contacts."""

import numpy as np

import tiverlet as tv

from .scene import c, scene

G = 9.81
LINK = 0.1  # kg, the mass of each point that bears no load


class Structure:
    """Points, and links between them: ropes and bars."""

    def __init__(self):
        self.x, self.mass, self.pinned, self.links = [], [], [], []

    def point(self, *x, mass=LINK, pinned=False):
        """Add a point. Returns its number."""
        self.x.append(np.array(x, dtype=float))
        self.mass.append(mass)
        if pinned:
            self.pinned.append(len(self.x) - 1)
        return len(self.x) - 1

    def chain(self, i, j, n):
        """Add a chain of n links from i to j."""
        between = [self.point(*(self.x[i] + (self.x[j] - self.x[i]) * k / n)) for k in range(1, n)]
        self.links += zip([i, *between], [*between, j], strict=True)


def ladder(s, load):
    left, right = [s.point(0, 0, pinned=True)], [s.point(0.5, 0, pinned=True)]
    for k in range(1, 11):
        left.append(s.point(0, -0.3 * k, mass=load if k == 7 else LINK))
        right.append(s.point(0.5, -0.3 * k))
        s.links += [tuple(left[-2:]), tuple(right[-2:]), (left[-1], right[-1])]


def bridge(s, load):
    """Two ropes of the same shape, with rungs: one link more than bears loads to first order."""
    t = np.linspace(-1, 1, 17)
    rows = [[s.point(u, lift - 0.3 * (1 - u * u), pinned=abs(u) == 1) for u in t] for lift in (0.1, 0.0)]
    s.links += [pair for row in rows for pair in zip(row[:-1], row[1:], strict=True)]
    s.links += list(zip(*(row[1:-1] for row in rows), strict=True))
    s.mass[rows[1][8]] = load


def wheel(s, load):
    hook, hub, n = s.point(0, 3, pinned=True), s.point(0, 0, mass=load), 12
    rim = [s.point(np.cos(a), np.sin(a)) for a in 2 * np.pi * (np.arange(n) + n / 4) / n]
    s.links += [(hub, r) for r in rim] + [(rim[k - 1], rim[k]) for k in range(n)]
    s.chain(hook, rim[0], 8)


def drawbridge(s, load):
    hinge, tower = s.point(0, 0, pinned=True), s.point(0, 2, pinned=True)
    deck = [hinge, *(s.point(0.5 * k, 0, mass=load if k == 4 else LINK) for k in range(1, 5))]
    top = [s.point(0.5 * k - 0.25, 0.3) for k in range(1, 5)]
    s.links += list(zip(deck[:-1], deck[1:], strict=True)) + list(zip(top[:-1], top[1:], strict=True))
    s.links += list(zip(top, deck[:-1], strict=True)) + list(zip(top, deck[1:], strict=True))
    s.chain(tower, deck[4], 8)
    s.chain(tower, deck[2], 8)


def punchbag(s, load):
    bag = s.point(0, -1, 0, mass=load)
    for a in (0.0, 2.1, 4.2):
        s.chain(s.point(0.4 * np.cos(a), 0, 0.4 * np.sin(a), pinned=True), bag, 6)


def crossed(s, load):
    knot = s.point(0, -0.6, 0, mass=load)
    for a in np.pi / 2 * np.arange(4):
        s.chain(s.point(np.cos(a), 0, np.sin(a), pinned=True), knot, 8)


def tent(s, load):
    around = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    pegs, ring = [s.point(a, 0, b, pinned=True) for a, b in around], [s.point(0.3 * a, -0.7, 0.3 * b) for a, b in around]
    knot = s.point(0, -1, 0, mass=load)
    for k in range(4):
        s.chain(pegs[k], ring[k], 5)
        s.links += [(ring[k - 1], ring[k]), (ring[k], knot)]


STRUCTURES = {2: (ladder, bridge, wheel, drawbridge), 3: (punchbag, crossed, tent)}


def hung(link, *builds, load=3.0):
    """Return these structures side by side with a load [kg] each: calls, and `link` of their links."""
    x, mass, pinned, pairs = [], [], [], []
    for k, build in enumerate(builds):
        s = Structure()
        build(s, load)
        first = len(x)
        x += list(np.array(s.x) + 6.0 * k * np.eye(len(s.x[0]))[0])
        mass, pinned = mass + s.mass, pinned + [first + p for p in s.pinned]
        pairs += [(first + i, first + j) for i, j in s.links]
    v = np.where(np.isin(np.arange(len(x)), pinned)[:, None], 0.0, 0.5 * np.eye(len(x[0]))[0])
    return c.Particles(np.array(x), mass=mass, velocity=v, pinned=pinned), [c.Gravity(G), link(pairs)]


@scene()
def a_tent_and_a_bag_hang_by_ropes():
    return hung(c.Rope, tent, punchbag)


@scene()
def a_wheel_and_a_drawbridge_hang_by_bars():
    return *hung(c.Distance, wheel, drawbridge), {"precision": "f64"}


@scene()
def discs_on_links_from_soft_to_rigid_collide_in_free_space():
    rng, n = np.random.default_rng(4), 12
    x = np.stack([0.5 * (np.arange(n) % 4), 0.5 * (np.arange(n) // 4)], axis=1) + rng.uniform(-0.04, 0.04, (n, 2))
    pairs = np.array([(i, j) for i in range(n) for j in range(i) if rng.random() < 0.3])
    alpha = np.where(rng.random(len(pairs)) < 0.3, 0.0, 10.0 ** rng.uniform(-7, -1, len(pairs)))
    held = c.Distance(pairs, compliance=alpha, damping=np.arange(len(pairs)) % 3)
    start = c.Particles(x, velocity=rng.normal(size=(n, 2)), mass=100.0 ** (rng.permutation(n) / 11), radius=0.15)
    return start, [held, c.Contact(friction=0.3)], {"precision": "f64", "substeps": 8}


@scene()
def elastic_clusters_that_share_corners_with_links_collide():
    q, axes = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), axis=-1).reshape(-1, 3), np.eye(3)
    one = np.concatenate([q, [1.4 * axes[1] + 0.5 * axes[0], 1.3 * axes[0], 1.3 * axes[0] + 0.3 * q[0]]])
    x, v = np.concatenate([one - axes[0], 1.2 * axes[0] - one]), np.repeat([axes[0], -axes[0]], 11, axis=0)
    clusters = [[k + i for i in body] for k in (0, 11) for body in ([*range(8)], [0, 1, 9, 10])]
    start = c.Particles(x, velocity=v, mass=1 + np.arange(22.0) % 3, radius=np.tile([*[0.12] * 8, 0.1, 0.05, 0.05], 2))
    return start, [c.ShapeMatch(clusters), c.Distance([(8, 0), (19, 11)]), c.Contact(restitution=1.0)], {"substeps": 8}


@scene()
def a_tree_and_a_ring_of_ropes_fall_on_a_floor():
    rng = np.random.default_rng(0)
    pairs = np.array([*((rng.integers(i), i) for i in range(1, 12)), *((12 + k, 12 + (k + 1) % 12) for k in range(12))])
    around = 2 * np.pi * np.arange(12) / 12
    ring = np.stack([np.cos(around), 0.3 * np.sin(3 * around), np.sin(around)], axis=1)
    x = np.concatenate([rng.uniform(-1, 1, (12, 3)), ring])
    held = c.Rope(pairs, compliance=1e-6 * (np.arange(len(pairs)) % 2))
    settings = {"precision": "f32-compensated", "solver": c.Direct(), "iterations": 2}
    return c.Particles(x, radius=0.1, pinned=[0]), [c.Gravity(G), held, c.HalfSpace((0, 1, 0), -1.5)], settings


@scene(flags={"softened"})
def weights_bounce_on_a_taut_rope():
    n, k = 21, 3
    x = np.concatenate(
        [np.stack([0.2 * np.arange(n), np.full(n, 2.0)], axis=1), np.stack([1.0 + np.arange(k), np.full(k, 2.6)], axis=1)]
    )
    start = c.Particles(x, mass=np.repeat([0.05, 20.0], [n, k]), radius=np.repeat([0.08, 0.3], [n, k]), pinned=[0, n - 1])
    links = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    return start, [c.Gravity(G), c.Distance(links), c.Contact(), c.Box((-0.1, -5), (6.1, 10))]


@scene(flags={"unconverged"})
def a_cloth_falls_into_its_pins_by_semi_iteration():
    sheet = tv.shapes.cloth((0, 0, 0), (1, 0, 0), (0, 0, 1), (7, 7), bend=False)
    features = [c.Gravity(G), c.Distance(sheet.links), c.Rope([[0, 8], [48, 40]])]
    return c.Particles(sheet.position, mass=1e-3, pinned=[0, 42]), features, {"solver": c.Chebyshev(), "iterations": 4}


@scene(flags={"softened"})
def braced_ladders_of_uneven_masses_fall_on_an_edge():
    rng, field = np.random.default_rng(0), np.array([[0, 1], [2, 3], [0, 2], [1, 3], [0, 3], [1, 2]])
    links = np.unique(np.concatenate([field + 2 * k for k in range(5)]), axis=0)
    one = 0.25 * np.stack([np.arange(12) % 2, np.arange(12) // 2 + 1.2, np.zeros(12)], axis=1)
    x, v = np.concatenate([one, one + [0, 0, 3.0]]), np.repeat(rng.normal(size=(2, 3)), 12, axis=0)
    start = c.Particles(x, velocity=v, mass=10 ** rng.uniform(-1.5, 0.5, 24), radius=0.05)
    rough = {"friction": 0.4, "restitution": 0.5}
    return start, [c.Gravity(G), c.Distance([*links, *(links + 12)]), c.HalfSpace((0, 1, 0), **rough), c.Contact(**rough)]


@scene(flags={"moved", "tunnelling-risk"})
def a_chain_that_is_far_too_long_is_drawn_together_among_drops():
    rng = np.random.default_rng(2)
    x = np.vstack([0.3 * np.stack([np.arange(10), np.zeros(10)], axis=1), rng.uniform((0, 0.2), (2.5, 1.2), (14, 2))])
    links = np.stack([np.arange(9), np.arange(1, 10)], axis=1)
    features = [c.Gravity(G), c.Contact(friction=0.4, events=True), c.Box((-1, -0.5), (4, 3)), c.Distance(links, 0.1)]
    return c.Particles(x, radius=0.045, pinned=[0]), [*features, c.Drag(0.2)]


@scene()
def links_and_a_cluster_break_under_a_falling_weight():
    x = np.array([*((0.0, -0.2 * k) for k in range(6)), (0.3, -1.0), (0.3, -0.8), (1.0, 1.0), (1.5, 1.0)])
    links = c.Distance([(k, k + 1) for k in range(5)], break_at=[60.0, 1e3, 200.0, 1e3, 1e3])
    spring = c.Distance([(8, 9)], compliance=1e-3, break_at=5.0)
    cluster = c.ShapeMatch([[4, 5, 6, 7]], break_at=400.0)
    return c.Particles(x, mass=[*[0.1] * 5, 5.0, 0.1, 0.1, 1.0, 1.0], pinned=[0, 8]), [c.Gravity(G), links, spring, cluster]


@scene(smooth=True)
def heavy_bodies_hang_on_light_chains_in_space():
    # From a block that turns about a pinned corner. The chain bears 32 times the mass of a link, and that another block by a link
    # from corner to corner.
    rope = tv.shapes.rope((0.3, 1.9, 0), (1, 1.6, 0.2), points=5)
    block = np.stack(np.meshgrid([0.0, 0.3], [0.0, 0.2], [0.0, 0.25], indexing="ij"), axis=-1).reshape(-1, 3)
    x = np.concatenate([rope.position, [-0.1, 1.85, 0.0] + block, [1.2, 1.5, 0.2] + block, [1.7, 1.4, 0.1] + block])
    start = c.Particles(x, mass=np.repeat([0.05, 0.2, 0.2, 0.1], [5, 8, 8, 8]), pinned=[7])
    blocks = c.ShapeMatch([range(5, 13), range(13, 21), range(21, 29)])
    return start, [c.Gravity(G), c.Distance([*rope.links, (10, 0), (4, 13), (17, 21)]), blocks], {"precision": "f64"}


@scene()
def a_bridge_of_planks_bears_balls():
    plank, n = tv.shapes.box((0, 0), (0.4, 0.06), radius=0.01), 6
    across = np.linspace(0.35, 2.65, n)
    planks, _ = tv.shapes.join(*(plank.moved((a, 2 - 0.3 * np.sin(np.pi * a / 3))) for a in across))
    links = [(4 * k + 3, 4 * k + 5) for k in range(n - 1)] + [(4 * n, 1), (4 * n - 1, 4 * n + 1)]
    x, radius = [*planks.position, (0, 2), (3, 2), (1.1, 2.2), (1.8, 2.3)], [*planks.radius, 0, 0, 0.12, 0.15]
    start = c.Particles(x, mass=np.repeat([0.5, 1.0, 10.0], [4 * n, 2, 2]), radius=radius, pinned=[4 * n, 4 * n + 1])
    bodies = [c.ShapeMatch(planks.loops), c.Polygons(planks.loops, friction=0.5)]
    return start, [c.Gravity(G), c.Distance(links), *bodies]
