"""Impacts of bodies on walls and on each other, against the laws of Newton and Coulomb for rigid bodies."""

from typing import Any

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import SLOW

# Positions of the particles of these bodies [m].
BAR = np.array([[0.0, 0.0], [0.0, 0.5]])
TRIANGLE = np.array([[0.0, 0.0], [0.5, 0.0], [0.25, 0.4]])
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [0.5, 0.05, 0.1], [0.2, 0.12, 0.5], [0.2, 0.45, 0.2]])
SQUARE = np.array([[0.0, 0.0], [0.6, 0.0], [0.6, 0.6], [0.0, 0.6]])
BOX = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])  # of side 1
ROUNDING = 1e-9  # [m/s] of positions in clusters, ulp(x) / h in each of 1000 substeps of 1/6000 s
G = 10.0


def turned(x, angle: float) -> np.ndarray:
    """Turn positions about their center, in the plane of the first two axes."""
    turn = np.eye(x.shape[1])
    turn[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    return (x - x.mean(axis=0)) @ turn


def pushed(x, k: int, massless: int = 0) -> np.ndarray:
    """Return the velocities of all particles (dim, n, dim) that impulses of 1 along each axis on particle k give a rigid body of
    unit masses: n / M + (I^-1 (r_k x n)) x r. The last `massless` particles have no mass."""
    m, dim = len(x) - massless, x.shape[1]
    r = x - x[:m].mean(axis=0)
    # In any dimension a rotation rate is an antisymmetric matrix B, v_i = B r_i.
    turns = np.array([np.outer(a, b) - np.outer(b, a) for i, a in enumerate(np.eye(dim)) for b in np.eye(dim)[:i]]) @ r.T
    inertia = np.einsum("adk,bdk->ab", turns[:, :, :m], turns[:, :, :m])
    spins = np.linalg.solve(inertia, turns[:, :, k])
    return np.eye(dim)[:, None] / m + np.einsum("an,adk->nkd", spins, turns)


def collide(mine, yours, v, n, e: float, mu: float) -> np.ndarray:
    """Return the impulse J on a body that meets another one at velocity v, of normal n.

    Impulses give the point that is struck the velocity K J. (v + K J)_n = -e v_n; across, v + K J = 0 if |J_t| <= mu J_n, else
    |J_t| = mu J_n.
    """
    K = (mine + yours).T
    J = np.linalg.solve(K, -e * (v @ n) * n - v)
    across = J - J @ n * n
    if np.linalg.norm(across) > mu * (J @ n):
        J = n + mu * across / np.linalg.norm(across)
        J *= -(1 + e) * (v @ n) / (n @ K @ J)
    return J


def held(kind: str, bodies) -> tv.ShapeMatch | tv.Distance:
    """Return what makes bodies with these positions rigid: "links", between all or in the plane along sides and diagonals from
    one corner, or "clusters"."""
    loops = np.split(np.arange(sum(map(len, bodies))), np.cumsum([len(x) for x in bodies])[:-1])
    if kind == "clusters":
        return tv.ShapeMatch(loops)
    solid = bodies[0].shape[1] == 3
    return tv.Distance([(k[i], k[j]) for k in loops for i in range(len(k)) for j in range(i) if solid or j in (0, i - 1)])


def in_a_box(world, what, kind: str, bodies, v, e: float, mu=0.0, g=0.0, low=-99.0, mass=1.0, more=(), **settings) -> tv.World:
    """Return a world with bodies of discs or of polygons in a box. v, mass: of each body [kg per particle]. more: features.

    Masses differ at least by rounding, and coefficients are assigned: one structure for each kind, and for e > 0.97.
    """
    each, law = [len(x) for x in bodies], {"friction": 0.5, "restitution": max(e, 0.5)}
    n, dim, ends = sum(each), bodies[0].shape[1], np.cumsum(each)[:-1]
    mass = np.repeat(np.full(len(each), mass), each) * np.where(np.arange(n) == 0, 1 + 2e-16, 1.0)
    start = tv.Particles(np.concatenate(bodies), velocity=np.repeat(v, each, axis=0), mass=mass, radius=0.1 * (what == "discs"))
    touch: Any = tv.Contact(**law, events=True) if what == "discs" else tv.Polygons(np.split(np.arange(n), ends), **law)
    around = tv.Box(np.broadcast_to(low, dim), (999.0,) * dim, **law)
    w = world(start, [tv.Gravity(g), held(kind, bodies), touch, around, *more], precision="f64", **settings)
    for surface in (touch, around):
        surface.friction, surface.restitution = mu, e
    return w


def above_a_floor(world, x, v, e: float, mu: float = 0.0, kind="links", **settings) -> tv.World:
    """Return a world with a body above a floor, and one far away, so that bars are solved as all bodies are."""
    far, n = (TRIANGLE if x.shape[1] == 2 else TETRAHEDRON) + 50.0, np.eye(x.shape[1])[1]
    floor = tv.HalfSpace(n, friction=0.5, restitution=0.5, events=True)
    start = tv.Particles(np.concatenate([x, far]), velocity=np.concatenate([np.tile(v, (len(x), 1)), 0 * far]))
    w = world(start, [held(kind, [x, far]), floor], precision="f64", **settings)
    floor.friction, floor.restitution = mu, e
    return w


def struck(w, m: int, v) -> np.ndarray:
    """Step until the first m particles are no longer as fast as v, and return the velocities after that frame."""
    while np.abs(w.velocity[:m] - v).max() < 0.05:
        w.step(1 / 600)
        assert w.time < 1 / 3
    return w.velocity


@pytest.mark.parametrize(
    "shape, kind, e, mu",
    [
        (BAR, "links", 0.0, 0.0), (TRIANGLE, "links", 1.0, 0.0), (SQUARE, "clusters", 1.0, 0.0), (SQUARE, "clusters", 0.4, 0.2),
        pytest.param(TETRAHEDRON, "links", 0.4, 0.0, marks=pytest.mark.slow),
    ],
    ids=["bar", "triangle", "square, elastic", "square", "tetrahedron"],
)  # fmt: skip
def test_rigid_bodies_leave_walls_by_newtons_and_coulombs_laws(world, shape, kind, e, mu):
    # Without forces, velocities before and after the impact are constant. The only error is the turn during a substep, omega h.
    for angle in (0.1, 0.35, 0.9):
        x = turned(shape, angle)
        x[:, 1] += 0.3 - x[:, 1].min()
        m, k, n, v = len(x), int(np.argmin(x[:, 1])), np.eye(x.shape[1])[1], np.zeros(x.shape[1])
        v[:2] = 0.4, -2.0
        got = struck(above_a_floor(world, x, v, e, mu, kind, substeps=10), m, v)[:m]
        mine = pushed(x, k)
        each = v + np.tensordot(collide(mine[:, k], 0.0, v, n, e, mu), mine, 1)
        center = each.mean(axis=0)
        assert np.abs(got.mean(axis=0) - center).max() < 2e-3, (angle, got.mean(axis=0), center)
        # Since the impact, the body's turn has changed only the directions of the velocities.
        spins = np.linalg.norm(got - got.mean(axis=0), axis=1), np.linalg.norm(each - center, axis=1)
        assert np.abs(spins[0] - spins[1]).max() < 2e-2


@pytest.mark.slow
@pytest.mark.parametrize(
    "what, shape, kind, e, mu",
    [
        ("discs", BAR, "links", 0.4, 0.0), ("discs", TRIANGLE, "links", 0.5, 0.1), ("discs", BAR, "links", 1.0, 0.0),
        ("discs", SQUARE, "clusters", 0.4, 0.0), ("discs", SQUARE, "clusters", 0.5, 3.0),
        ("polygons", TRIANGLE, "clusters", 1.0, 0.0), ("polygons", TRIANGLE, "clusters", 0.0, 0.0),
        ("polygons", TRIANGLE, "clusters", 0.5, 0.1), ("polygons", TRIANGLE, "clusters", 0.3, 0.8),
    ],
)  # fmt: skip
def test_rigid_bodies_leave_each_other_by_newtons_and_coulombs_laws(world, what, shape, kind, e, mu):
    # Particles meet particles, where |r + t v| = 0.2, or a corner meets the side of a square. Other constraints, such as an area
    # and a rope far away, change nothing.
    dim, m = shape.shape[1], len(shape)
    x, far = turned(shape, 0.3), [TRIANGLE + 50.0] if what == "discs" and kind == "links" else []
    if what == "discs":
        v, y = np.array([3.0, -1.0 if mu else 0.2, 0.5])[:dim], turned(shape, -0.2) + 0.05
        x[:, 0] -= x[:, 0].max() + 0.2
        y[:, 0] += 0.2 - y[:, 0].min()
        r = x[:, None] - y
        b, c = r @ v, (r**2).sum(axis=2) - 0.2**2
        root = b**2 - (v @ v) * c
        time = np.where((root > 0) & (b < 0), (-b - np.sqrt(np.maximum(root, 0))) / (v @ v), np.inf)
        i, j = np.unravel_index(int(np.argmin(time)), time.shape)
        n, mine, yours = (r[i, j] + time[i, j] * v) / 0.2, pushed(x, i), pushed(y, j)
    else:
        v, y, i, j, n = np.array([2.0, -0.7]), SQUARE + (0.3, 0.0), int(np.argmax(x[:, 0])), 4, np.array([-1.0, 0.0])
        x = x + (0.2, 0.2) - x[i]
        mine, yours = pushed(x, i), pushed(np.vstack([y, x[i] + 0.1 / v[0] * v]), 4, massless=1)
    J = collide(mine[:, i], yours[:, j], v, n, e, mu)
    assert (np.linalg.norm(J - J @ n * n) < 0.999 * mu * (J @ n)) == (mu > 0.5)  # they stick, or slide on each other
    more = [tv.Area([[2 * m, 2 * m + 1, 2 * m + 2]]), tv.Rope([(2 * m, 2 * m + 2)])] if far else []
    w = in_a_box(world, what, kind, [x, y, *far], [v, *[0 * v] * (1 + len(far))], e, mu, substeps=10, more=more)
    got = struck(w, m, v)[: m + len(y)]
    off = got - np.concatenate([v + np.tensordot(J, mine, 1), -np.tensordot(J, yours[:, : len(y)], 1)])
    assert np.abs(off).max() < (3e-2 if what == "discs" else 2e-2)  # they turn on, by up to 6 rad/s / 600 at 2 m/s
    assert max(np.abs(off[:m].mean(axis=0)).max(), np.abs(off[m:].mean(axis=0)).max()) < 5e-3
    assert got.sum(axis=0) == pytest.approx(m * v, abs=ROUNDING)
    if what == "discs":
        touches = w.events().touches
        assert touches.impulse.sum() == pytest.approx(J @ n, rel=1e-2) and touches.speed.max() == pytest.approx(-v @ n, rel=1e-2)


@pytest.mark.parametrize("kind, e, mu", [("links", 0.0, 0.1), ("links", 0.5, 0.1), ("links", 1.0, 0.1), ("clusters", 0.5, 0.1)])
def test_a_body_that_lands_flat_is_stopped_and_rubbed_as_a_whole(world, kind, e, mu):
    # Both lower particles are stopped alike: the impulse is M (1 + e) |v_y|, and friction takes mu (1 + e) |v_y| of v_x.
    v, total = np.array([2.0, -1.5]), 0.0
    w = above_a_floor(world, np.array([[0.0, 0.3], [0.4, 0.3], [0.2, 0.5]]), v, e, mu, kind, substeps=100)
    for _ in range(18):
        w.step(1 / 60)
        total += w.wall_events().touches.impulse.sum()
    assert w.velocity[:3].mean(axis=0) == pytest.approx((v[0] + mu * (1 + e) * v[1], -e * v[1]), abs=0.02)
    assert total == pytest.approx(3 * 1.5 * (1 + e), rel=0.01)


def test_velocities_have_no_part_of_a_blow(world):
    # Frames of one substep: velocities have the energy of the report, even in the frame of the impact.
    w = above_a_floor(world, np.array([[0.0, 0.1], [0.15, 0.4]]), (0.0, -2.0), 1.0, substeps=1)
    for _ in range(80):
        report = w.step(1e-3)
        assert 0.5 * (w.velocity**2).sum() == pytest.approx(report.energy, rel=1e-4)
    assert w.velocity[0, 1] > 1  # it has hit the floor


@pytest.mark.parametrize("lean", [0.0, -5.0])
def test_what_leans_on_another_wall_bounces_all_the_same(world, lean):
    # An upright rod between a floor and a smooth wall at its side, which does not change the height of the bounce, e^2 y.
    walls = [tv.HalfSpace((0, 1), restitution=0.9), tv.HalfSpace((1, 0), restitution=0.9)]
    w = world(tv.Particles([[0, 0.5], [0, 0.8]]), [tv.Gravity((lean, -9.81)), tv.Distance([(0, 1)]), *walls], precision="f64")
    w.run(0.35)  # the rod lands after 0.319 s
    top = max(w.position[0, 1] for _ in range(40) if w.step(1 / 60))
    assert top == pytest.approx(0.81 * 0.5, abs=1e-3)


def boxes(*places) -> list[np.ndarray]:
    """Return boxes of side 1 at these places."""
    return [np.array(place) + BOX for place in places]


@pytest.mark.slow
def test_a_box_that_falls_on_a_box_or_on_a_column_stays_there(world):
    # What closes no faster than SLOW substeps of gravity is no impact: (SLOW g h)^2 / 2 g is left of the height, and what the
    # passes leave, a hundredth for a hundred times the mass.
    for below, ratio, substeps in ((1, 1, 2), (1, 1, 8), (1, 10, 20), (1, 100, 8), (5, 10, 8)):
        bodies, mass = boxes(*((0, 0.5 + k) for k in range(below)), (0, below + 1.5)), 0.25 * np.r_[np.ones(below), ratio]
        more: dict = dict(mu=0.5, g=G, mass=mass, substeps=substeps, low=(-99, 0))
        w = in_a_box(world, "polygons", "clusters", bodies, np.zeros((below + 1, 2)), 0.0, **more)
        w.run(np.sqrt(2 / G) + 1 / 60)
        height = [w.position[-4:, 1].mean() for _ in range(45) if w.step(1 / 60)]
        h, top = 1 / (60 * substeps), below + 0.5
        assert max(height) < top + SLOW**2 * G * h**2 / 2 + (1e-2 if below == 1 else 2e-2), (ratio, substeps)
        assert below > 1 or min(height) > top - 20 * (1 + ratio) * G * h**2, (ratio, substeps)


@pytest.mark.slow
def test_linked_boxes_that_meet_go_on_together_and_keep_momentum(world):
    # Two meet head on; eight meet from all sides.
    v, m = np.array([(2.0, 0.3), (0.0, 0.3)]), np.array([1.0, 3.0])
    w = in_a_box(world, "polygons", "links", boxes((-1.05, 0), (0, 0)), v, 0.0, mass=m / 4)
    w.run(0.25)
    assert np.abs(w.velocity - (m @ v) / m.sum()).max() < 1e-3
    a, m = np.linspace(0, 2 * np.pi, 9)[:-1], 1.0 + np.arange(8)
    place, v = 3 * np.stack([np.cos(a), np.sin(a)], axis=1), -3 * np.stack([np.cos(a + 0.1), np.sin(a + 0.1)], axis=1)
    w = in_a_box(world, "polygons", "links", boxes(*place), v, 0.0, mass=m / 4, substeps=8)
    corner, first = np.repeat(m, 4) / 4, np.repeat(v, 4, axis=0)
    w.run(2.0)
    before = w.position
    w.step(1 / 60)
    assert np.abs(corner @ (w.position - before) * 60 - corner @ first).max() < 1e-8
    assert (corner @ w.velocity**2).sum() < 0.6 * (corner @ first**2).sum()


@pytest.mark.slow
def test_an_eccentric_impact_is_that_of_rigid_bodies(world):
    # Faces that overlap by 0.7 touch at the ends of that part: two pushes, by which neither closes any further.
    m, v, high = np.array([1.0, 3.0]), 2.0, 0.3
    w = in_a_box(world, "polygons", "clusters", boxes((-1.05, 0), (0, high)), [(v, 0), (0, 0)], 0.0, mass=m / 4, substeps=8)
    w.run(1 / 30)  # they meet after 1 / 40 s
    at = np.array([high - 0.5, 0.5])
    arms = np.stack([at, at - high])  # of the pushes along x, about the center of each box
    moment = m / 2  # of four corners
    p = np.linalg.solve(sum(1 / m[k] + np.outer(arms[k], arms[k]) / moment[k] for k in range(2)), [v, v])
    assert (p > 0).all()
    velocity = np.array([v - p.sum() / m[0], p.sum() / m[1]])
    turn = np.array([(arms[0] @ p) / moment[0], -(arms[1] @ p) / moment[1]])
    got, x = w.velocity.reshape(2, 4, 2), w.position.reshape(2, 4, 2)
    r, u = x - x.mean(axis=1, keepdims=True), got - got.mean(axis=1, keepdims=True)
    assert np.abs(got.mean(axis=1)[:, 0] - velocity).max() < 1e-3 * v
    spin = (r[..., 0] * u[..., 1] - r[..., 1] * u[..., 0]).sum(axis=1) / (r**2).sum(axis=(1, 2))
    assert np.abs(spin - turn).max() < 3e-3 * v


@pytest.mark.slow
@pytest.mark.parametrize("mu, v", [(0.2, (1.8, -2.4)), (0.6, (0.0, -1.2))])
def test_friction_where_a_struck_body_slides_opposes_the_slip(world, mu, v):
    # A box falls at 3 m/s on a box that slides at 3 m/s the other way. The lower one loses friction times the impulse of 3 N s to
    # the upper one, and as much to the platform.
    bodies = [BOX + (0, -0.5), BOX + (0, 0.5), 0.6 * BOX + (0.45, 1.35)]
    start, mass = [(0.0, 0.0), (3.0, 0.0), (-3.0, -3.0)], np.array([1e9, 0.25, 0.25])
    w = in_a_box(world, "polygons", "clusters", bodies, start, 0.0, mu, mass=mass, substeps=40)
    w.run(1 / 30)
    assert np.abs(w.velocity.reshape(3, 4, 2).mean(axis=1)[1:, 0] - v).max() < 0.05


# Many impacts.
