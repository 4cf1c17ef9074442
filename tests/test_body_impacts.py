"""Impacts of bodies obey Newton's and Coulomb's laws for rigid bodies, on walls and on each other."""

from typing import Any

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import SLOW
from tiverlet.device import ti
from tiverlet.geometry import rotation

# Positions of the particles of these bodies [m].
DISC = np.zeros((1, 2))
BAR = np.array([[0.0, 0.0], [0.0, 0.5]])
TRIANGLE = np.array([[0.0, 0.0], [0.5, 0.0], [0.25, 0.4]])
SQUARE = np.array([[0.0, 0.0], [0.6, 0.0], [0.6, 0.6], [0.0, 0.6]])
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [0.5, 0.05, 0.1], [0.2, 0.12, 0.5], [0.2, 0.45, 0.2]])
BOX = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])  # of side 1
G, R, FRAME = 10.0, 0.1, 1 / 600  # R: of discs


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
    spins = np.linalg.solve(inertia, turns[:, :, k]) if m > 1 else 0 * turns[:, :, k]
    return np.eye(dim)[:, None] / m + np.einsum("an,adk->nkd", spins, turns)


def collide(K, v, n, e: float, mu: float) -> np.ndarray:
    """Return the impulse J on a point that is struck at the relative velocity v, along n, where J changes that by K J.

    (v + K J)_n = -e v_n; across, v + K J = 0 if |J_t| <= mu J_n, else |J_t| = mu J_n.
    """
    J = np.linalg.solve(K, -e * (v @ n) * n - v)
    across = J - J @ n * n
    if np.linalg.norm(across) > mu * (J @ n):
        J = n + mu * across / np.linalg.norm(across)
        J *= -(1 + e) * (v @ n) / (n @ K @ J)
    return J


class Hit:
    """A body that flies at v towards a wall below, or towards another body, of which the point j is struck by its point i."""

    def __init__(self, x, v, i: int, n, mine, other=None, yours=None, j: int = 0):
        self.m, self.i, self.j, self.n, self.mine, self.yours = len(x), i, j, n, mine, yours
        self.x = x if other is None else np.concatenate([x, other])
        self.v = np.zeros_like(self.x)
        self.v[: self.m] = v

    def after(self, e: float, mu: float, belt) -> np.ndarray:
        """Return the velocities of all particles after the impact; belt: the velocity of the surface of the wall."""
        K, v = self.mine[:, self.i].T, self.v[0] - (0 if self.yours is not None else belt)
        if self.yours is None:
            return self.v + np.tensordot(collide(K, v, self.n, e, mu), self.mine, 1)
        J = collide(K + self.yours[:, self.j].T, v, self.n, e, mu)
        return self.v + np.concatenate([np.tensordot(J, self.mine, 1), -np.tensordot(J, self.yours, 1)[: len(self.x) - self.m]])


def on_a_wall(shape, angle: float, radius: float) -> Hit:
    """Return a body that falls on a wall, the lowest point first."""
    x, v = turned(shape, angle), np.zeros(shape.shape[1])
    x[:, 1] += 0.301 + radius - x[:, 1].min()
    v[:2], i = (0.4, -2.0), int(np.argmin(x[:, 1]))
    return Hit(x, v, i, np.eye(len(v))[1], pushed(x, i))


def on_another(shape, v) -> Hit:
    """Return a body of discs that meets another one of the same shape: |r + t v| = 2 R."""
    x, y = turned(shape, 0.3), turned(shape, -0.2) + 0.05
    x[:, 0] -= x[:, 0].max() + 0.2
    y[:, 0] += 0.2 - y[:, 0].min()
    r = x[:, None] - y
    b, c = r @ v, (r**2).sum(axis=2) - (2 * R) ** 2
    root = b**2 - (v @ v) * c
    time = np.where((root > 0) & (b < 0), (-b - np.sqrt(np.maximum(root, 0))) / (v @ v), np.inf)
    i, j = (int(k) for k in np.unravel_index(int(np.argmin(time)), time.shape))
    n, x = (r[i, j] + time[i, j] * v) / (2 * R), x + (time[i, j] - (time[i, j] // FRAME + 0.5) * FRAME) * v  # amid a frame
    return Hit(x, v, i, n, pushed(x, i), y, pushed(y, j), j)


def on_a_side(shape, v) -> Hit:
    """Return a polygon of which a corner meets the side of a square."""
    x, y = turned(shape, 0.3), SQUARE + (0.3, 0.0)
    i = int(np.argmax(x[:, 0]))
    x = x + (0.199, 0.2) - x[i]
    return Hit(x, v, i, np.array([-1.0, 0.0]), pushed(x, i), y, pushed(np.vstack([y, x[i] + 0.101 / v[0] * v]), 4, massless=1), 4)


def scene(world, what: str, bodies, e: float, mu=0.0, g=0.0, low=0.0, mass=1.0, v=0.0, **settings) -> tv.World:
    """Return a world of bodies, (corners, "links" or "cluster" or ""), above a floor at y = low.

    what: "walls" for bodies of points that meet nothing else, "discs", or "polygons". mass, v: of each body [kg per particle].
    Bodies lie far away, masses differ at least by rounding, and coefficients are assigned: one structure for each `what`, on
    walls for each kind of bodies, for each dimension, and for e > 0.97.
    """
    (n, dim), count = (sum(len(x) for x, _ in bodies), bodies[0][0].shape[1]), [len(x) for x, _ in bodies]
    far = [(TRIANGLE if dim == 2 else TETRAHEDRON, kind) for kind in ("links", "cluster")]
    far = [body for body in far if what != "walls" or body[1] in {kind for _, kind in bodies}]
    bodies = [*bodies, *((x + 300.0 * (k + 1), kind) for k, (x, kind) in enumerate(far))]
    loops = np.split(np.arange(sum(len(x) for x, _ in bodies)), np.cumsum([len(x) for x, _ in bodies])[:-1])
    held_by = [kind for _, kind in bodies]
    pairs = [
        (k[i], k[j])
        for k, kind in zip(loops, held_by, strict=True)
        if kind == "links"
        for i in range(len(k))
        for j in range(i)
        if dim == 3 or j in (0, i - 1)
    ]
    law: dict[str, Any] = {"friction": 0.5, "restitution": max(e, 0.5)}
    floor = tv.HalfSpace(np.eye(dim)[1], low, surface_velocity=[0.0] * dim, events=True, **law)
    touch = [tv.Contact(**law, events=True)] if what == "discs" else [tv.Polygons(loops, **law)] if what == "polygons" else []
    x, more = np.concatenate([x for x, _ in bodies]), sum(len(x) for x, _ in far)
    mass = np.append(np.repeat(np.broadcast_to(mass, len(count)), count), np.ones(more)) * np.where(
        np.arange(n + more) == 0, 1 + 2e-16, 1.0
    )
    v = np.concatenate([np.repeat(np.broadcast_to(v, (len(count), dim)), count, axis=0), np.zeros((more, dim))])
    start = tv.Particles(x, velocity=v, mass=mass, radius=R * (what == "discs"))
    held: list[Any] = [tv.Distance(pairs)] if "links" in held_by else []
    if "cluster" in held_by:
        held.append(tv.ShapeMatch([k for k, kind in zip(loops, held_by, strict=True) if kind == "cluster"]))
    w = world(start, [tv.Gravity(g), floor, *held, *touch], precision="f64", **settings)
    obey(w, e, mu)
    return w


def obey(w, e: float, mu: float) -> None:
    """Assign restitution and friction of all surfaces."""
    for surface in w.features:
        if hasattr(surface, "restitution"):
            surface.restitution, surface.friction = e, mu


LAWS = [(0.0, 0.0), (0.4, 0.0), (0.5, 0.1), (0.3, 0.8), (0.5, 3.0)]  # e, mu


SLOWER = [(k, False) for k in ("cluster", "discs", "polygons", "space")] + [(k, True) for k in ("links", "discs", "polygons")]


@pytest.mark.parametrize("what, elastic", [("links", False), *(pytest.param(*one, marks=pytest.mark.slow) for one in SLOWER)])
def test_bodies_leave_walls_and_each_other_by_newtons_and_coulombs_laws(world, what, elastic):
    # Discs, linked bodies and clusters side by side, on a wall at three angles, and on each other. Without forces, velocities
    # are constant before and after the impact; in its frame bodies turn, by up to 6 rad/s / 600. Passes of links that walls rub
    # in worlds without contacts leave 1.5 % of the slip. In the last round the wall is a belt.
    kinds = [(TRIANGLE, "links"), (TRIANGLE, "cluster"), (SQUARE, "links"), (SQUARE, "cluster")]
    kinds = [(TETRAHEDRON, "links")] if what == "space" else [*kinds, (DISC, ""), (BAR, "links")]
    kinds = [(shape, kind) for shape, kind in kinds if what in ("discs", "space", kind) or what == "polygons" and len(shape) > 2]
    hits = [(on_a_wall(shape, angle, R * (what == "discs")), kind) for shape, kind in kinds for angle in (0.1, 0.35, 0.9)]
    if what == "discs":
        hits += [(on_another(shape, np.array([3.0, up])), kind) for shape, kind in kinds for up in (0.2, -0.8)]
    if what == "polygons":
        hits += [(on_a_side(shape, np.array([2.0, -0.7])), kind) for shape, kind in kinds if shape is TRIANGLE]
    bodies, speeds = [], []
    for k, (hit, kind) in enumerate(hits):
        place = np.array([20.0 * k, 0.0 if hit.yours is None else 50.0, 0.0])[: hit.x.shape[1]]
        some = [(x + place, kind) for x in (hit.x[: hit.m], hit.x[hit.m :]) if len(x)]
        bodies, speeds = bodies + some, speeds + [hit.v[0], hit.v[-1]][: len(some)]
    w = scene(world, what if what in ("discs", "polygons") else "walls", bodies, float(elastic), v=speeds, substeps=10)
    ends = np.cumsum([len(hit.x) for hit, _ in hits])
    for (e, mu), fast in [((1.0, 0.0), 0.0)] if elastic else [*((law, 0.0) for law in LAWS), ((0.5, 0.1), 10.0)]:
        belt = w.features[1].surface_velocity = fast * np.eye(w.particles.dim)[0]
        w.position, w.velocity, found = w.particles.position, w.particles.velocity, [None] * len(hits)
        obey(w, e, mu)
        for _ in range(120):
            w.step(FRAME)
            for k, now in enumerate(np.split(w.velocity, ends)[: len(hits)]):
                if found[k] is None and np.abs(now - hits[k][0].v).max() > 0.05:
                    found[k] = now
        for got, (hit, kind) in zip(found, hits, strict=True):
            says, want, wall = (e, mu, fast, kind, len(hit.x)), hit.after(e, mu, belt), hit.yours is None
            rubs = mu > 0 and kind == "links" and what in ("links", "space")
            fine = 0.015 * np.linalg.norm(hit.v[0] - belt) if rubs else 2e-3 if wall and what != "discs" else 5e-3
            off, m = got - want, hit.m
            assert max(np.abs(part.mean(axis=0)).max() for part in (off[:m], off[m:]) if len(part)) < fine, says
            assert np.abs(off).max() < (2 * fine if rubs else 4e-2 if wall else 3e-2 if what == "discs" else 2e-2), says
            spins = [np.linalg.norm(v[:m] - v[:m].mean(axis=0), axis=1) for v in (got, want)]
            assert rubs or np.abs(spins[0] - spins[1]).max() < 2e-2, says
            assert wall or got.sum(axis=0) == pytest.approx(m * hit.v[0], abs=1e-9), says


@pytest.mark.parametrize(
    "kind, laws", [("links", (0.0, 0.5, 1.0)), pytest.param("cluster", (0.0, 0.5), marks=pytest.mark.slow)], ids=str
)
def test_a_body_that_lands_flat_is_stopped_and_rubbed_as_a_whole(world, kind, laws):
    # Both lower particles are stopped alike: the impulse is M (1 + e) |v_y|, and friction takes mu (1 + e) |v_y| of v_x.
    flat, v, mu = np.array([[0.0, 0.3], [0.4, 0.3], [0.2, 0.5]]), np.array([2.0, -1.5]), 0.1
    w = scene(world, "walls", [(flat, kind)], 0.0, substeps=100, v=v)
    for e in laws:
        w.position, w.velocity, total = w.particles.position, w.particles.velocity, 0.0
        obey(w, e, mu)
        for _ in range(18):
            w.step(1 / 60)
            total += w.wall_events().touches.impulse.sum()
        assert w.velocity[:3].mean(axis=0) == pytest.approx((v[0] + mu * (1 + e) * v[1], -e * v[1]), abs=0.02)
        assert total == pytest.approx(3 * 1.5 * (1 + e), rel=0.01)


def test_velocities_have_no_part_of_a_blow(world):
    # Frames of one substep: velocities have the energy of the report, even in the frame of the impact.
    w = scene(world, "walls", [(np.array([[0.0, 0.1], [0.15, 0.4]]), "links")], 1.0, v=(0.0, -2.0), substeps=1)
    for _ in range(80):
        report = w.step(1e-3)
        assert 0.5 * (w.particles.mass @ w.velocity**2).sum() == pytest.approx(report.energy, rel=1e-4)
    assert w.velocity[0, 1] > 1  # it has hit the floor


@pytest.mark.slow
def test_what_leans_on_another_wall_bounces_all_the_same(world):
    # An upright rod between a floor and a smooth wall at its side, which does not change the height of the bounce, e^2 y.
    walls = [tv.HalfSpace((0, 1), restitution=0.9), tv.HalfSpace((1, 0), restitution=0.9)]
    for lean in (0.0, -5.0):
        w = world(
            tv.Particles([[0, 0.5], [0, 0.8]]),
            [tv.Gravity((lean, -9.81)), tv.Distance([(0, 1)]), *(wall.copy() for wall in walls)],
            precision="f64",
        )
        w.run(0.35)  # the rod lands after 0.319 s
        top = max(w.position[0, 1] for _ in range(40) if w.step(1 / 60))
        assert top == pytest.approx(0.81 * 0.5, abs=1e-3)


def boxes(*places) -> list[tuple[np.ndarray, str]]:
    """Return rigid boxes of side 1 at these places."""
    return [(np.array(place) + BOX, "cluster") for place in places]


@pytest.mark.slow
def test_a_box_that_falls_on_a_box_or_on_a_column_stays_there(world):
    # What closes no faster than SLOW substeps of gravity is no impact: (SLOW g h)^2 / 2 g is left of the height, and what the
    # passes leave, a hundredth for a hundred times the mass.
    for below, ratio, substeps in ((1, 1, 2), (1, 10, 20), (1, 100, 8), (5, 10, 8)):
        bodies, mass = boxes(*((0, 0.5 + k) for k in range(below)), (0, below + 1.5)), 0.25 * np.r_[np.ones(below), ratio]
        w, n = scene(world, "polygons", bodies, 0.0, 0.5, G, mass=mass, substeps=substeps), 4 * below
        w.run(np.sqrt(2 / G) + 1 / 60)
        height = [w.position[n : n + 4, 1].mean() for _ in range(45) if w.step(1 / 60)]
        h, top = 1 / (60 * substeps), below + 0.5
        assert max(height) < top + SLOW**2 * G * h**2 / 2 + (1e-2 if below == 1 else 2e-2), (ratio, substeps)
        assert below > 1 or min(height) > top - 20 * (1 + ratio) * G * h**2, (ratio, substeps)


@pytest.mark.slow
def test_an_eccentric_impact_is_that_of_rigid_bodies(world):
    # Faces that overlap by 0.7 touch at the ends of that part: two pushes, by which neither closes any further.
    m, v, high = np.array([1.0, 3.0]), 2.0, 0.3
    w = scene(world, "polygons", boxes((-1.05, 9), (0, 9 + high)), 0.0, v=[(v, 0), (0, 0)], mass=m / 4, substeps=8)
    w.run(1 / 30)  # they meet after 1 / 40 s
    at = np.array([high - 0.5, 0.5])
    arms = np.stack([at, at - high])  # of the pushes along x, about the center of each box
    moment = m / 2  # of four corners
    p = np.linalg.solve(sum(1 / m[k] + np.outer(arms[k], arms[k]) / moment[k] for k in range(2)), [v, v])
    assert (p > 0).all()
    velocity = np.array([v - p.sum() / m[0], p.sum() / m[1]])
    turn = np.array([(arms[0] @ p) / moment[0], -(arms[1] @ p) / moment[1]])
    got, x = w.velocity[:8].reshape(2, 4, 2), w.position[:8].reshape(2, 4, 2)
    r, u = x - x.mean(axis=1, keepdims=True), got - got.mean(axis=1, keepdims=True)
    assert np.abs(got.mean(axis=1)[:, 0] - velocity).max() < 1e-3 * v
    spin = (r[..., 0] * u[..., 1] - r[..., 1] * u[..., 0]).sum(axis=1) / (r**2).sum(axis=(1, 2))
    assert np.abs(spin - turn).max() < 3e-3 * v


@pytest.mark.slow
def test_friction_where_a_struck_body_slides_opposes_the_slip(world):
    # A box falls at 3 m/s on a box that slides at 3 m/s the other way. The lower one loses friction times the impulse of 3 N s to
    # the upper one, and as much to the platform.
    bodies = [(x + (0, 9), "cluster") for x in (BOX + (0, -0.5), BOX + (0, 0.5), 0.6 * BOX + (0.45, 1.35))]
    start, mass = [(0.0, 0.0), (3.0, 0.0), (-3.0, -3.0)], np.array([1e9, 0.25, 0.25])
    for mu, v in (0.2, (1.8, -2.4)), (0.6, (0.0, -1.2)):
        w = scene(world, "polygons", bodies, 0.0, mu, v=start, mass=mass, substeps=40)
        w.run(1 / 30)
        assert np.abs(w.velocity[:12].reshape(3, 4, 2).mean(axis=1)[1:, 0] - v).max() < 0.05


def thin():
    """Return shapes whose size along some axes is small or nothing, (k, dim) [m] each: points, rods, plates, wires, dust."""
    half = 0.16 * np.array([1.0, 0.6, 0.3])
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * half
    rod, wires, dust = np.linspace(-1, 1, 3)[:, None] * [0.16, 0, 0], [], []
    for part in (1e-2, 1e-3, 1e-4, 1e-6):
        wires.append(corners * [1, part, part])
        dust.append(corners * part)
    return [np.zeros((3, 3)), rod, rod[::2], corners[corners[:, 1] > 0], *wires, *dust]


@pytest.mark.parametrize("precision", ["f32", "f32-compensated", "f64"])
def test_bodies_without_thickness_land_and_gain_nothing(world, precision):
    # A blow beside the axis of a wire turns it by far more than 1 rad in a substep. Without bounce and friction, walls only take
    # energy, whatever the unit of length.
    shapes, trials = thin(), 4
    for unit in (2.0**-10, 1.0, 2.0**10):
        x, v, rows = [], [], []
        for k, shape in enumerate(shapes * trials):
            rng = np.random.default_rng(k)
            y = shape @ np.linalg.qr(rng.normal(size=(3, 3)))[0].T
            rows.append(np.arange(len(y)) + sum(map(len, x)))
            x.append(y + [2 * k, 0.6, 0])
            v.append(np.cross(5 * rng.normal(size=3), y) + rng.normal(size=3))
        start = tv.Particles(unit * np.concatenate(x), velocity=unit * np.concatenate(v), radius=0.02 * unit)
        w = world(start, [tv.Gravity(9.81 * unit), tv.HalfSpace((0, 1, 0)), tv.ShapeMatch(rows)], precision=precision)

        def energies(w=w, rows=rows, unit=unit):
            each = (w.velocity**2).sum(axis=1) / 2 + 9.81 * unit * w.position[:, 1]
            return np.array([each[row].mean() for row in rows]) / unit**2

        before = energies()
        for _ in range(45):
            w.step(1 / 60)
            assert (energies() <= before + 4e-6).all()  # rounding of 7 J/kg in f32
        assert (np.array([w.position[row, 1].min() for row in rows]) < 0.3 * unit).all()  # from 0.6


def test_a_line_does_not_turn_about_itself():
    # I^-1 L for bodies of two axes, and of one where the third moment of inertia is rounding.
    S, L, out = ti.Matrix.field(3, 3, ti.f64, 3), ti.Vector.field(3, ti.f64, 3), ti.Vector.field(3, ti.f64, 3)

    @ti.kernel
    def run():
        for k in S:
            out[k] = rotation.turn_rate(S[k], L[k])

    least, u = rotation.LINE, np.array([2.0, 3.0, 6.0]) / 7
    L.from_numpy(np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [1.0, -2.0, 5.0]]))
    S.from_numpy(np.array([np.diag([1, 0.75 * least, 0]), np.diag([1, 1.5 * least, 0]), np.outer(u, u)]))
    run()
    np.testing.assert_allclose(out.to_numpy()[0], [0, 2, 3], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(out.to_numpy()[1], [1 / (1.5 * least), 2, 3], rtol=1e-6)
    np.testing.assert_allclose(out.to_numpy()[2], np.array([1.0, -2.0, 5.0]) - u * (u @ [1.0, -2.0, 5.0]), atol=1e-12)
