"""Bodies of particle loops: friction, impulses, overlap, level tiles, and rest."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.loops import laid

from .outlines import outside

FREE = "ignore:.*no constraint holds loops"


def bodies(shapes):
    """Return positions and loops of bodies from lists of corners."""
    return np.concatenate(shapes), np.split(np.arange(sum(map(len, shapes))), np.cumsum([len(x) for x in shapes])[:-1])


def regular(sides: int, radius: float, center, turn: float = 0.0):
    """Return the corners of a regular polygon that stands on an edge where `turn` is 0."""
    a = np.arange(sides) * 2 * np.pi / sides - np.pi / 2 + np.pi / sides + turn
    return radius * np.stack([np.cos(a), np.sin(a)], axis=1) + center


def rigid(world, x, loops, g=10.0, e=0.0, mu=0.5, low=(-99, 0), high=(999, np.inf), held=None, more=None, **settings):
    """Return a world of rigid bodies on a floor, with friction and restitution, which may be 0: one structure.

    The last particle is pinned where nothing comes. held: what is rigid, if not the loops. more: of the particles.
    """
    n, given = len(x), {"velocity": (0.0, 0.0), "radius": 0.0, "mass": 0.25, "pinned": ()} | (more or {})
    particles = tv.Particles(
        np.vstack([x, [(low[0] + 0.5, low[1] + 19.0)]]), velocity=np.vstack([np.zeros_like(x) + given["velocity"], [(0, 0)]]),
        radius=np.append(np.zeros(n) + given["radius"], np.max(given["radius"])), pinned=[*given["pinned"], n],
        mass=np.append(np.zeros(n) + given["mass"], 1.5 * np.max(given["mass"])),
    )  # fmt: skip
    polygons = tv.Polygons(loops, friction=0.5, restitution=0.6, push_out=settings.pop("push_out", None))
    box = tv.Box(low, high, friction=0.5, restitution=0.6)
    features = [tv.Gravity(g), polygons, tv.ShapeMatch(loops if held is None else held), box]
    w = world(particles, features, precision="f64", **settings)
    polygons.restitution, polygons.friction, box.restitution, box.friction = e, mu, e, mu
    return w


def sat(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Return how deep two convex counterclockwise loops overlap (negative where apart), and the direction in which b leaves a."""
    best = (np.inf, np.zeros(2))
    for p, q, sign in ((a, b, 1.0), (b, a, -1.0)):
        u = np.roll(p, -1, axis=0) - p
        normal = np.stack([u[:, 1], -u[:, 0]], axis=1) / np.linalg.norm(u, axis=1)[:, None]
        depth = -((q[None] - p[:, None]) * normal[:, None]).sum(axis=2).min(axis=1)
        k = int(np.argmin(depth))
        best = min(best, (float(depth[k]), sign * normal[k]), key=lambda found: found[0])
    return best


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 1e-2])
def test_what_slides_over_level_tiles_keeps_its_speed(world, gap):
    # A box, a hexagon, a disc and a point slide at 1 m/s over 4 pinned squares of 1 m, with gaps between, without friction, each
    # over squares of its own. The foremost corner meets the side of the next square a slop below its top. The disc also touches
    # corners, whose normals lean: a blow between two of them takes (gap / radius)^2 / 2 of the speed, and a substep has its part.
    sides, lines = regular(4, np.sqrt(0.5), (0.0, -0.5)), []
    box, hexagon = regular(4, 0.56, (0.0, 0.56 / np.sqrt(2))), regular(6, 0.4, (0.0, 0.4 * np.sin(np.pi / 3)))
    for k, body in enumerate((box, hexagon, [(0.0, 0.3)], [(0.0, 0.0)])):
        lines.append([*(sides + (j * (1 + gap), -9.0 * k) for j in range(4)), np.array(body) + (0.0, -9.0 * k)])
    x, loops = bodies([shape for line in lines for shape in line])
    moves = np.concatenate([np.full(len(loop), k % 5 == 4) for k, loop in enumerate(loops)])
    loops = [loop for loop in loops if len(loop) > 1]
    radius = np.where(np.arange(len(x)) == len(x) - 18, 0.3, 0.0)
    more = dict(velocity=moves[:, None] * [1.0, 0.0], radius=radius, pinned=np.flatnonzero(~moves))
    w = rigid(world, x, loops, 9.81, 0.0, 0.0, (-99, -99), held=[loop for loop in loops if moves[loop[0]]], more=more)
    start, moves = w.particles, np.append(moves, False)
    most = np.where(start.radius[moves] > 0, 1.5e-3 + 3 * (gap / 0.3) ** 2 / 2, 1e-3)
    for substeps in (8, 60):
        w.position, w.velocity, w.substeps = start.position, start.velocity, substeps
        for _ in range(150):
            w.step(1 / 60)
            assert (np.abs(w.velocity[moves, 0] - 1.0) < most).all()
        assert np.abs(w.position - start.position)[moves, 1].max() < 0.005 * 0.5 and w.last.clean


@pytest.mark.slow
@pytest.mark.parametrize("long", [1.0, 20.0])
def test_what_falls_beside_long_pieces_does_not_stand_on_air(world, long):
    # A crate falls into a pit that is 2 mm or 6 cm wider than it is, between level pieces, however long: g t^2 / 2.
    for air in (1e-3, 3e-2):
        crate = tv.shapes.box((0, 0.21), (0.4, 0.4))
        piece = np.array([(0.2 + air, -2), (0.2 + air + long, -2), (0.2 + air + long, 0), (0.2 + air, 0)])
        x = np.concatenate([crate.position, piece, piece[::-1] * (-1, 1)])
        polygons = tv.Polygons([*crate.loops, range(4, 8), range(8, 12)])
        features = [tv.Gravity(9.81), polygons, tv.ShapeMatch([range(4)])]
        w = world(tv.Particles(x, mass=0.25, pinned=range(4, 12)), features, precision="f64")
        w.run(0.5)
        assert w.position[:4].mean(axis=0) == pytest.approx([0, 0.21 - 9.81 / 8], abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bodies", "discs"])
def test_what_falls_beside_the_corner_of_a_wall_is_not_thrown_aside(world, kind):
    # Corners of a crate, or discs that are linked, fall past the corner of a wall, 0.1 to 5 mm beside it, by centimetres in a
    # substep: the plane across the way to the corner is none that they could cross. g t^2 / 2, and nothing aside.
    radius = 0.02 if kind == "discs" else 0.0
    for air, substeps in ((1e-4, None), (1e-3, None), (5e-3, None), (1e-3, 20)):
        crate = tv.shapes.box((0.2 + air, 0.21), (0.4, 0.4))
        x = crate.position + (radius, radius)
        wall = tv.Polygon([(-1, -2), (0, -2), (0, 0), (-1, 0)])
        contact = tv.Polygons(crate.loops) if kind == "bodies" else tv.Contact()
        start = tv.Particles(x, mass=0.25, radius=radius)
        w = world(start, [tv.Gravity(9.81), wall, tv.ShapeMatch([range(4)]), contact], precision="f64", substeps=substeps)
        w.run(0.5)
        assert w.position.mean(axis=0) - x.mean(axis=0) == pytest.approx([0, -9.81 / 8], abs=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings(FREE)
def test_overlap_is_pushed_out_without_velocity_and_a_loose_loop_stays_finite(world):
    # Overlap at a start depends on where bodies are, not on their velocities: it is how far bodies have to move. A body thrown
    # deeper gets no deeper than it was, but for its motion in a substep. After overlap / push_out both overlap by no more than
    # places leave, 0.009 half edges. A loop that nothing holds is pressed flat, and stays finite.
    x, loops = bodies([regular(4, 0.5, (0.0, 0.0)), regular(4, 0.5, (0.6, 0.02)), regular(3, 0.3, (5.0, 1.0))])
    w = rigid(world, x, loops, 0.0, 0.0, 0.0, (-99, -0.6), held=loops[:2], more={"mass": 1.0}, push_out=0.3, substeps=20)
    start, found, v = w.particles.position, [], np.zeros((12, 2))
    begin, deep = x[:4, 0].max() - x[4:8, 0].min(), sat(x[:4], x[4:8])[0]
    for speed in ((0.0, 0.0), (0.0, -6.0), (-3.0, 7.0), (-6.0, 0.0)):
        v[4:8] = speed
        w.position, w.velocity = start, v
        found.append(w.contacts)
        for name in ("pairs", "ends", "place", "overlap", "normal"):
            np.testing.assert_array_equal(getattr(found[-1], name), getattr(found[0], name))
        for _ in range(24):  # 0.1 / 0.3 s and a little more
            w.step(1 / 60)
            assert w.position[:4, 0].max() - w.position[4:8, 0].min() < begin + 6 / 1200
            assert v.any() or np.abs(w.velocity).max() < 0.3 * 0.01  # what moves places gives no momentum
    np.testing.assert_allclose(found[0].overlap, deep, rtol=1e-9)
    inside = np.r_[outside(x[:4], x[4:8]), outside(x[4:8], x[:4])] < 0
    np.testing.assert_array_equal(found[0].pairs[:, 0], np.flatnonzero(inside))
    w.run(0.1)
    assert sat(w.position[:4], w.position[4:8])[0] < 0.009 * 0.5 / 2**0.5
    w.position = np.concatenate([w.position[:8], [[5.0, 0.0], [5.0, 0.0], [5.0, 0.0]], w.position[11:]])
    w.features[0].g = 9.81
    w.run(0.5)
    assert np.isfinite(w.position).all()


@pytest.mark.slow
def test_corners_that_cross_part_over_the_nearer_edge(world):
    # Two sharp corners have passed each other: no vertex is inside of the other body, but edges cross. Two wedges part soonest
    # over one of their edges (separating axes), and contacts have to find it.
    rng, shapes = np.random.default_rng(5), []
    while len(shapes) < 30:
        tips = []
        for side in (-1.0, 1.0):
            half, lean, length = rng.uniform(0.15, 0.6), rng.uniform(-0.5, 0.5), rng.uniform(0.5, 1.0)
            angle = side * np.pi / 2 + lean + np.array([-half, half])
            tips.append(np.concatenate([[[0.0, 0.0]], length * np.stack([np.cos(angle), np.sin(angle)], axis=1)]))
        a, b = tips[0], tips[1] + rng.uniform(-0.06, 0.06, 2)
        if min(outside(a, b).min(), outside(b, a).min()) >= 0 and sat(a, b)[0] > 1e-3:
            shapes += [a + [2.0 * len(shapes), 0.0], b + [2.0 * len(shapes), 0.0]]
    x, loops = bodies(shapes)
    w = rigid(world, x, loops, 0.0, low=(-99, -99), more={"mass": rng.uniform(0.5, 2.0, len(x))}, push_out=0.2, substeps=10)
    found, body = w.contacts, np.repeat(np.arange(len(shapes)), 3)
    want = [sat(shapes[k], shapes[k + 1]) for k in range(0, len(shapes), 2)]
    assert (body[found.pairs[:, 0]] // 2 == np.arange(len(want))).all()
    np.testing.assert_allclose(found.overlap, [depth for depth, _ in want], rtol=1e-9)
    sign = np.where(body[found.pairs[:, 0]] % 2 == 1, 1.0, -1.0)[:, None]  # where the vertex belongs to the second body
    np.testing.assert_allclose(sign * found.normal, [n for _, n in want], atol=1e-9)
    for _ in range(60):
        w.step(1 / 60)
        assert np.abs(w.velocity).max() < 0.2 * 0.01  # places give no momentum
    half = np.linalg.norm(x[1:] - x[:-1], axis=1).max() / 2
    assert max(sat(w.position[loops[k]], w.position[loops[k + 1]])[0] for k in range(0, len(shapes), 2)) < 0.009 * half


@pytest.mark.slow
def test_heaps_come_to_rest_and_hardly_overlap(world):
    # Boxes of 1 kg and 0.7 to 1 m, dropped at 4 substeps, so that corners are pressed into other boxes as they land. Corners
    # leave at push_out under any load. At a corner with at most 4 contacts and w = 4 / kg, which bears up to 8 boxes,
    # F h^2 (4 w + 4 w) is left. And the heap comes to rest, though some corners hardly touch their neighbours.
    rng, shapes = np.random.default_rng(0), []
    for k, row in np.ndindex(4, 8):
        shapes.append(regular(4, rng.uniform(0.7, 1.0) / np.sqrt(2), (1.5 * k + 1, 1.5 * row + 1), rng.uniform(0, 6.28)))
    w = rigid(world, *bodies(shapes), low=(0, 0), high=(6.5, np.inf), substeps=4)
    w.run(5.0)
    assert w.contacts.overlap.max() < 8 * 10.0 / 240**2 * 32 / 2
    w.substeps = 8
    w.run(4.0)
    assert np.abs(w.velocity).max() < 0.01
    # Boxes fall on each other, the upper one narrower, bounce and then lie still.
    x, loops = bodies([np.array([[-s, 0], [s, 0], [s, 2 * s], [-s, 2 * s]]) + [0, y] for s, y in ((0.5, 0.2), (0.45, 1.9))])
    w = rigid(world, x, loops, e=0.6, substeps=8)
    gaps = [w.position[4:8, 1].min() - w.position[:4, 1].max() for _ in range(60) if w.step(1 / 60)]
    assert max(gaps[int(np.argmax(np.array(gaps) < 0.01)) :]) > 0.03  # [m], after they have met
    w.run(4.0)
    assert np.abs(w.velocity).max() < 1e-4  # what passes leave of gravity in a frame, 5e-4 g / 60 Hz


def plank(thin: float, y: float, length: float = 1.0, pieces: int = 1, tilt: float = 0.0):
    """Return the corners of a plank about (0, y), with its long sides cut in pieces."""
    x = np.linspace(-length / 2, length / 2, pieces + 1)
    low = np.stack([x, np.full_like(x, -thin / 2)], axis=1)
    corners = np.concatenate([low, -low])
    return corners @ [[np.cos(tilt), np.sin(tilt)], [-np.sin(tilt), np.cos(tilt)]] + [0.0, y]


def settled(w, loops, seconds):
    """Return the heights of bodies after some seconds, and all flags on the way."""
    flags = w.run(seconds).flags
    return np.array([w.position[loop, 1].mean() for loop in loops]), flags


@pytest.mark.parametrize("thin", [1e-3, 1e-4])
@pytest.mark.parametrize("apart", [0.3, 0.02])
def test_thin_planks_rest_on_each_other(world, thin, apart):
    # They land by 1 cm in a substep. Heights are right to a twentieth of what is thin.
    x, loops = bodies([plank(thin, 0.1 + apart * k) for k in range(3)])
    y, flags = settled(rigid(world, x, loops, substeps=4), loops, 1.5)
    assert y / thin == pytest.approx([0.5, 1.5, 2.5], abs=0.05) and "tunnelling-risk" not in flags


def test_what_is_thin_between_near_corners_bears_what_it_lies_on(world):
    # Planks cut into pieces of 37 cm lie on a box, whose corners press on the pieces: slop is a part of 1 mm, and not of a piece.
    thin, box = 1e-3, np.array([(-0.5, 0.0), (0.5, 0.0), (0.5, 1.0), (-0.5, 1.0)])
    x, loops = bodies([box, plank(thin, 1.3, 1.5, 4), plank(thin, 1.6, 1.5, 4)])
    y, flags = settled(rigid(world, x, loops, substeps=2), loops, 1.5)
    assert (y - 1.0)[1:] / thin == pytest.approx([0.5, 1.5], abs=0.05) and "tunnelling-risk" not in flags


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [2, 40])
@pytest.mark.parametrize("thin", [1e-3, 1e-4])
@pytest.mark.parametrize("kind", ["tilted", "steep", "heavy", "cut", "spins"])
def test_thin_planks_rest_on_each_other_or_their_report_says_that_they_may_not(world, kind, thin, substeps):
    pieces, tilt = 4 if kind == "cut" else 1, {"tilted": 0.01, "steep": 0.5}.get(kind, 0.0)
    shapes = [plank(thin, 0.4 + 0.6 * k, 1.0, pieces, tilt * (-1) ** k) for k in range(3)]
    if kind == "heavy":
        shapes[2] = plank(0.2, 1.2, 0.2) + [0.1, 0.0]
    x, loops = bodies(shapes)
    mass, v = np.full(len(x), 0.25), np.zeros_like(x)
    if kind == "heavy":
        mass[loops[2]] = 250.0
    if kind == "spins":
        arm = x[loops[2]] - x[loops[2]].mean(axis=0)
        v[loops[2]] = 5.0 * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    y, flags = settled(rigid(world, x, loops, substeps=substeps, more={"mass": mass, "velocity": v}), loops, 2.5)
    right = [0.5 * thin, 1.5 * thin, 2 * thin + (0.1 if kind == "heavy" else 0.5 * thin)]
    assert "tunnelling-risk" in flags or y / thin == pytest.approx(np.array(right) / thin, abs=0.1)


@pytest.mark.parametrize("gap", [1e-3, 1e-4])
def test_a_peg_slides_into_a_hole_that_is_a_little_wider(world, gap):
    # g t^2 / 2, but for what it loses to the sides that it leans on: their edges are 2 m long, and the gap is far below 1/512 of
    # that.
    half, tilt = 0.1 + gap / 2, 0.6 * gap / 0.5  # a third of what the hole leaves room for
    left = np.array([(-half - 1, -2.0), (-half, -2.0), (-half, 0.0), (-half - 1, 0.0)])
    x, loops = bodies([plank(0.5, 0.27, 0.2, 1, tilt), left, left[::-1] * (-1, 1)])
    start = tv.Particles(x, mass=0.25, pinned=range(4, 12))
    w = world(start, [tv.Gravity(9.81), tv.Polygons(loops), tv.ShapeMatch([range(4)])], substeps=4)
    w.run(0.5)
    y = w.position[:4].mean(axis=0) - (0, 0.27)
    assert y[1] == pytest.approx(-9.81 / 8, rel=0.03) and abs(y[0]) < gap


@pytest.mark.parametrize(
    ("corners", "thin"),
    [
        ([(0, 0), (3, 0), (3, 1), (0, 1)], [1.0] * 4),
        ([(0, 0), (2, 0), (1, 3**0.5)], [3**0.5] * 3),  # its heights
        ([(0, 0), (1, 0), (2, 0), (3, 0), (3, 0.1), (2, 0.1), (1, 0.1), (0, 0.1)], [0.1] * 8),
        ([(0, 0), (3, 0), (3, 3), (2, 3), (2, 2), (1.8, 2), (1.8, 3), (0, 3)], [1.8, 1, 1, 1, 0.2, 0.2, 1, 1.8]),  # not a gap
    ],
)
def test_how_thin_a_body_is_counts_ways_through_it(corners, thin):
    x = np.array(corners, dtype=float)
    for loop in (np.arange(len(x)), np.arange(len(x))[::-1]):
        assert laid([loop], x)[3] == pytest.approx(thin)


def test_bad_loops_are_named():
    square, wheel = regular(4, 0.5, (0.0, 0.0)), np.vstack([[(0.0, 0.0)], regular(12, 0.3, (0.0, 0.0))])
    particles = tv.Particles(np.concatenate([square, [[0.0, 0.01], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]]]))
    spokes, ring = [pair for k in range(1, 13) for pair in ((0, k), (k, k % 12 + 1))], tv.Polygons([np.arange(1, 13)])
    boxed = tv.Particles(tv.shapes.box((0, 0), (1, 1)).position)
    for make, words in (
        (lambda: tv.Polygons([[0, 1]]), r"loops\[0\] has 2 particles"),
        (lambda: tv.Polygons([[0, 1, 2], [2, 3, 4]]), r"particle 2 is in loops\[0\] and again in loops\[1\]"),
        (lambda: tv.Polygons([[0, 1, 1]]), r"particle 1 is in loops\[0\] and again in loops\[0\]"),
        (lambda: tv.World(particles, [tv.Polygons([[0, 1, 9]])]), r"loops\[0\]\[2\] = 9, but there are 8"),
        (lambda: tv.World(particles, [tv.Polygons([[5, 6, 7]])]), r"loops\[0\] encloses 0 m"),
        (lambda: tv.World(boxed, [tv.Polygons([range(4)])]), r"not in order .*shape.loops\[0\] \+ n"),
        (lambda: tv.World(tv.Particles(wheel), [ring, tv.ShapeMatch(ring.loops)]), r"particle 0 starts 0.29 m inside of loops"),
        (lambda: tv.World(tv.Particles(np.zeros((3, 3))), [tv.Polygons([[0, 1, 2]])]), "for 2D worlds"),
        (lambda: tv.World(particles, [tv.Polygons([[0, 1, 2]]), tv.Contact()]), "more than one Contact"),
    ):
        with pytest.raises(ValueError, match=words):
            make()
    with pytest.warns(UserWarning, match=r"no constraint holds loops\[0\] \(1 such in all\)"):
        tv.World(tv.Particles(wheel[1:]), [tv.Polygons([np.arange(12)]), tv.Pin([3, 4], compliance=1.0)]).close()
    # A hub that is tied to all corners is no stray particle.
    tv.World(tv.Particles(wheel), [ring, tv.Distance(spokes)]).close()
