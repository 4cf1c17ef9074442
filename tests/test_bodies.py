"""Areas and volumes: closed forms, bodies without extent, and meshes and loops that are refused."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import case, order, rerun

CUBE = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
                 [1, 5, 7], [1, 7, 3]])  # fmt: skip
CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])


def ring(n, radius=1.0):
    """Return a regular polygon."""
    a = 2 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(a), np.sin(a)], axis=1)


def around(n, first=0):
    """Return the links of a closed loop."""
    k = np.arange(n)
    return np.stack([first + k, first + (k + 1) % n], axis=1)


@pytest.mark.slow
def test_areas_of_polygons(world):
    # R25: the area n/2 sin(2 pi / n) is kept by soft rims that fall on the ground; every second loop is given clockwise.
    sizes = (3, 6, 12, 64)
    first = np.cumsum([0, *sizes])
    x = np.concatenate([ring(n) + [3 * k, 0] for k, n in enumerate(sizes)])
    area = tv.Area([np.arange(a, b)[:: 1 - 2 * (k % 2)] for k, (a, b) in enumerate(zip(first, first[1:], strict=False))])
    rims = tv.Distance(np.concatenate([around(n, a) for n, a in zip(sizes, first, strict=False)]), compliance=1e-3)
    w = world(tv.Particles(x), [tv.Gravity(9.81), rims, area, tv.HalfSpace((0, 1), -1.1)])
    want = [case("R25_polygon_area")["values"][f"n{n}"]["area"] for n in sizes]
    np.testing.assert_allclose(area.rest, want, rtol=1e-14)
    for iterations, target in ((1, 1e-3), (40, 1e-6)):
        rerun(w, 1.0, iterations=iterations)
        assert np.abs(area.rest_of(w.position) / want - 1).max() <= target
    area.pressure = [1.2, 1.0, 0.8, 1.1]
    rerun(w, 1.0)
    np.testing.assert_allclose(area.rest_of(w.position), area.pressure * want, rtol=1e-5)


def test_straight_outlines_enclose_nothing():
    # The area of a straight outline is 0 up to rounding and may be negative in either orientation. The rest area that the
    # constraint computes can be assigned to it, and prepare() keeps the orientation however often it runs.
    random = np.random.default_rng(1)
    for _ in range(200):
        along, at, m = random.normal(size=2), random.normal(size=2), int(random.integers(4, 14))
        particles, area = tv.Particles(at + random.random((m, 1)) * along), tv.Area([np.arange(m)])
        area.prepare(particles, particles.inv_mass.copy())
        area.rest = area.rest
        assert 0 <= area.rest[0] < 1e-15
        order = area.indices.copy()
        area.prepare(particles, particles.inv_mass.copy())  # as for a clone, which keeps the orientation
        assert (area.indices == order).all()


@pytest.mark.slow
def test_volumes_of_solids(world):
    # R25b: a tetrahedron, a cube with faces in mixed orientations, an icosahedron; squeezed on the ground, and inflated.
    g = (1 + 5**0.5) / 2
    ico = np.array([[s * a, t * b, 0] for s in (-1, 1) for t in (-1, 1) for a, b in ((1, g),)])
    ico = np.concatenate([ico, ico[:, [2, 0, 1]], ico[:, [1, 2, 0]]]) / 2
    tet = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / 8**0.5
    far = np.linalg.norm(ico[:, None] - ico[None], axis=2)
    faces = [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if far[i, j] + far[j, k] + far[i, k] < 3.01]
    x = np.concatenate([CORNERS, ico + [3, 0, 0], tet + [6, 0, 0]])
    cube = np.where(np.arange(12)[:, None] % 3 > 0, CUBE, CUBE[:, ::-1])
    shells = tv.Volume(np.concatenate([cube, np.array(faces) + 8]))
    solid = tv.Volume([[20, 21, 23, 22]])
    pairs = np.array([(i, j) for i in range(24) for j in range(i) if np.linalg.norm(x[i] - x[j]) < 1.5])
    springs = tv.Distance(pairs, compliance=1e-3)
    features = [tv.Gravity(9.81), springs, shells, solid, tv.HalfSpace((0, 1, 0), -1.5)]
    w = world(tv.Particles(x), features, precision="f64")
    values = case("R25b_volume")["values"]
    np.testing.assert_allclose(shells.rest, [values["cube_edge1"], values["icosahedron_edge1"]], rtol=1e-14)
    np.testing.assert_allclose(solid.rest, values["regular_tet_edge1"], rtol=1e-14)
    rerun(w, 1.0, iterations=40)
    for f in (shells, solid):
        assert np.abs(f.rest_of(w.position) / f.rest - 1).max() <= 1e-6
    # Inflated from the start. test_areas_of_polygons changes the pressure later, which is ramped.
    features = [f.copy() for f in features]
    features[2] = tv.Volume(np.concatenate([cube, np.array(faces) + 8]), pressure=1.3)
    w = world(tv.Particles(x), features, precision="f64", iterations=40)
    w.run(1.5)
    np.testing.assert_allclose(features[2].rest_of(w.position), 1.3 * shells.rest, rtol=1e-5)


def test_a_soft_ring_breathes(world):
    # n masses m on a ring: E = (A - A0)^2 / (2 alpha), A = c R^2, c = n/2 sin(2 pi / n): n m R'' = -2 c R (c R^2 - A0) / alpha.
    n, m, alpha, start, t = 8, 0.5, 0.02, 1.1, 1.0
    c = n / 2 * np.sin(2 * np.pi / n)

    def slope(y):
        return np.array([y[1], -2 * c * y[0] * (c * y[0] ** 2 - c) / (alpha * n * m)])

    y, k = np.array([start, 0.0]), 4000
    for _ in range(k):
        a = slope(y)
        b = slope(y + t / k / 2 * a)
        e = slope(y + t / k / 2 * b)
        y = y + t / k / 6 * (a + 2 * b + 2 * e + slope(y + t / k * e))
    area = tv.Area([np.arange(n)], rest=c, compliance=alpha)
    w = world(tv.Particles(ring(n, start), mass=m), [area], precision="f64", iterations=3)
    errors = [np.abs(np.linalg.norm(rerun(w, t, substeps=s).position, axis=1) - y[0]).max() for s in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1 and errors[-1] < 1e-4
    assert w.last.energy == pytest.approx((c * start**2 - c) ** 2 / (2 * alpha), rel=1e-4)


def test_pressure_against_tension(world):
    # In balance, the pressure p = (pressure A0 - A) / alpha of a soft area holds a rim of springs: p R cos(pi / n) = T.
    n, k, alpha, pressure = 12, 500.0, 0.01, 1.5
    edge, unit = 2 * np.sin(np.pi / n), n / 2 * np.sin(2 * np.pi / n)
    low, high = 1.0, 2.0
    for _ in range(60):
        r = (low + high) / 2
        out = (pressure * unit - unit * r * r) / alpha * r * np.cos(np.pi / n) - k * edge * (r - 1)
        low, high = (r, high) if out > 0 else (low, r)
    area = tv.Area([np.arange(n)], pressure=pressure, compliance=alpha)
    rim = tv.Distance(around(n), compliance=1 / k)
    w = world(tv.Particles(ring(n)), [area, rim, tv.Drag(10.0)], precision="f64", iterations=4)
    w.run(5.0)
    np.testing.assert_allclose(np.linalg.norm(w.position, axis=1), r, rtol=1e-6)
    assert -area.load[0] == pytest.approx((pressure * unit - unit * r * r) / alpha, rel=1e-5)
    assert rim.load[0] == pytest.approx(k * edge * (r - 1), rel=1e-5)


@pytest.mark.slow
def test_elements_without_extent(world):
    # Row 54: an element without extent has no gradient; it yields no NaN and a residual of at least 1. Row 55: an inverted
    # element returns to the positive side.
    flat = np.array(
        [[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 0, 0], [5, 0, 0], [5, 0, 0], [7, 0, 0], [7, 0, 0], [7, 0, 0], [7, 0, 0]]
    )
    x = np.concatenate([flat.astype(float), CORNERS[[0, 4, 2, 1]] + [10, 0, 0], CORNERS + [15, 0, 0]])
    edges = np.array([(i, j) for i in range(22) for j in range(max(i, 10)) if i > 9 and 0 < np.linalg.norm(x[i] - x[j]) < 1.5])
    features = [
        tv.Area([[0, 1, 2], [3, 4, 5]], rest=1.0),
        tv.Volume([[6, 7, 8, 9], [10, 11, 12, 13]], rest=[0.1, 1 / 6]),
        tv.Volume(CUBE + 14),
        tv.Distance(edges[edges[:, 1] > 9], compliance=1e-2),
        tv.Drag(20.0),
    ]
    w = world(tv.Particles(x), features, iterations=4)
    assert w.step(1 / 60).residual >= 1
    y = x.copy()
    y[11, 0], y[18:, 0] = 9.5, 14.8
    w.position = y
    w.run(0.5)
    assert np.isfinite(w.position).all()
    for f in features[1:3]:
        assert f.rest_of(w.position)[-1] == pytest.approx(f.rest[-1], rel=1e-4)


def test_meshes_and_loops_that_are_refused():
    bad = CUBE.copy()
    strip = [[k, (k + 1) % 5, (k + 2) % 5] for k in range(5)]  # the Moebius strip of five triangles, open at its edge
    with pytest.raises(ValueError, match=r"edge \(0, 1\) of cells\[4\] belongs to 1 face.*open"):
        tv.Volume(bad[1:])
    with pytest.raises(ValueError, match="belongs to 3 face"):
        tv.Volume(np.concatenate([bad, [[0, 1, 4], [1, 4, 6]]]))
    with pytest.raises(ValueError, match="open"):
        tv.Volume(strip)
    plane = [[0, 1, 3], [1, 2, 4], [2, 0, 5], [0, 3, 5], [1, 4, 3], [2, 5, 4]]  # half of the 6-vertex projective plane, open
    projective = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [0, 5, 1], [1, 2, 4], [2, 3, 5], [3, 4, 1], [4, 5, 2], [5, 1, 3]]
    with pytest.raises(ValueError, match="only one side"):
        tv.Volume(projective)
    with pytest.raises(ValueError, match="open"):
        tv.Volume(plane)
    with pytest.raises(ValueError, match=r"loops\[1\] names particle 4 twice"):
        tv.Area([[0, 1, 2, 3], [4, 5, 6, 4]])
    with pytest.raises(ValueError, match=r"loops\[0\] has 2 particles"):
        tv.Area([[0, 1]])
    flat = tv.Particles(np.zeros((4, 2)))
    with pytest.raises(ValueError, match=r"loops\[0\].*4 particles"):
        tv.World(flat, [tv.Area([[1, 2, 3, 9]])])
    with pytest.raises(ValueError, match="2D world; use Area"):
        tv.World(flat, [tv.Volume([[0, 1, 2, 3]])])
    with pytest.raises(ValueError, match="in 3D"):
        tv.World(tv.Particles(np.zeros((4, 3))), [tv.Area([[0, 1, 2, 3]])])
    with pytest.raises(ValueError, match=r"pressure\[0\] = -1"):
        tv.Area([[0, 1, 2]], pressure=-1)
    with pytest.raises(ValueError, match=r"clusters\[0\] names particle 1 twice"):
        tv.ShapeMatch([[1, 1]])
    with pytest.raises(ValueError, match=r"creep\[0\] = 1, but a rigid"):
        tv.ShapeMatch([[0, 1]], creep=1.0)


@pytest.mark.slow
def test_bodies_have_the_same_bits_on_both_paths(world):
    # Clones also continue bit for bit, with the history of soft constraints and of shapes that creep.
    rng = np.random.default_rng(1)
    x = np.concatenate([CORNERS, CORNERS + [2, 0, 0], rng.normal(size=(70, 3)) + [9, 0, 0]])
    shape = tv.ShapeMatch([np.arange(4, 12), np.arange(16, 86)], compliance=[0.0, 1e-3], damping=0.1, creep=[0.0, 1.0])
    volume = tv.Volume(np.concatenate([CUBE, CUBE + 8]), compliance=[1e-3, 0.0], pressure=1.1)
    pair = [
        world(tv.Particles(x), [tv.Gravity(9.81), volume.copy(), shape.copy(), tv.Pin([0])], path=path)
        for path in ("fused", "parallel")
    ]
    for w in pair:
        w.run(0.4)
    assert pair[0].hash() == pair[1].hash()
    w = pair[0]
    twin = w.clone()
    assert twin.hash() == w.hash()
    twin.run(0.2)
    assert twin.hash() != w.hash()
    w.run(0.2)
    assert twin.hash() == w.hash()
    twin.close()
