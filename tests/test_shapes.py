"""Ready-made bodies: counts, lengths, orientation, closedness; files written and read; and arguments that are refused."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.shapes.people import NAMES
from tiverlet.shapes.shape import INDICES

from .conftest import case

S = tv.shapes
STAR = [[np.cos(t) * r, np.sin(t) * r] for t, r in zip(np.arange(10) * np.pi / 5, [1.0, 0.5] * 5, strict=True)]
# A long straight side with a notch beside it on one side and a spike on the other.
MOUTH = [[0, 0], [1.9, 0], [2, 0.9], [2.1, 0], [4, 0], [4, 1], [0.5, 1], [0.5, 2], [1.9, 2], [2, 1.1], [2.1, 2], [4, 2], [4, 3],
         [0, 3]]  # fmt: skip
BODIES = {
    "rope": S.rope((0, 2), (1, 2), 11),
    "chain": S.chain((0, 0, 0), (1, 0.5, 1), 3.0, 21),
    "bridge": S.bridge((0, 0), (6, 0), 6, 1.0),
    "tree 2D": S.tree((0, 0), 2.0, levels=4, branches=3),
    "tree 3D": S.tree((0, 0, 0), 2.0),
    "cloth 2D": S.cloth((0, 0), (0, 1), (2, 0), (4, 6)),
    "cloth 3D": S.cloth((0, 1, 0), (1, 0, 0), (0, 0, 1), (5, 5)),
    "net": S.net((0, 0, 0), (1, 0, 0), (0, 1, 0), (3, 3)),
    "ball 2D": S.ball((1, 2), 0.5, 4),
    "ball 3D": S.ball((1, 2, 3), 0.5, 3),
    "balloon": S.balloon((0, 0, 0), 2.0, 2),
    "blob": S.blob(STAR, 0.15),
    "polygon": S.polygon((0, 0), 1.0, 12),
    "box 2D": S.box((0, 0), (4, 1), 0.1),
    "box 3D": S.box((0, 0, 0), (3, 2, 1), 0.3),
    "truss 2D": S.truss((0, 0), (4, 1), (4, 1)),
    "truss 3D": S.truss((0, 0, 0), (3, 2, 1), (3, 2, 1)),
    "ragdoll 2D": S.ragdoll((0, 0)),
    "ragdoll 3D": S.ragdoll((0, 0, 0)),
    "pile": S.pile((0, 0), (1, 1), (0.02, 0.05)),
}


def test_bodies_in_order_are_the_same_bodies():
    for name, body in BODIES.items():
        rng = np.random.default_rng(len(body))
        one = body.in_order()
        np.testing.assert_array_equal(np.sort(one.position, axis=0), np.sort(body.position, axis=0), err_msg=name)
        # Tuples of corners are the same by the places of their corners; a random number for each place tells places apart.
        places = np.unique(np.concatenate([body.position, one.position]), axis=0, return_inverse=True)[1].ravel()
        mark = rng.permutation(len(body) * 2)[places]
        for what in INDICES:
            old, new = mark[: len(body)][getattr(body, what)], mark[len(body) :][getattr(one, what)]
            assert sorted(map(tuple, old.tolist())) == sorted(map(tuple, new.tolist())), (name, what)
        assert [mark[: len(body)][k].tolist() for k in body.loops] == [mark[len(body) :][k].tolist() for k in one.loops], name
        limits = [
            sorted(zip(map(tuple, m[s.limits].tolist()), s.lower, s.upper, strict=True))
            for m, s in ((mark[: len(body)], body), (mark[len(body) :], one))
        ]
        assert limits[0] == limits[1], name
        assert np.allclose(one.radius.sum(), body.radius.sum())


def volumes(shape):
    """Return the areas of the faces in 2D, the volumes of the tetrahedra in 3D."""
    cells = shape.faces if shape.position.shape[1] == 2 else shape.tetrahedra
    edges = shape.position[cells[:, 1:]] - shape.position[cells[:, :1]]
    return np.linalg.det(edges) / (2 if cells.shape[1] == 3 else 6)


@pytest.mark.parametrize("name", BODIES)
def test_every_body_is_sound(name):
    body = BODIES[name]
    n, dim = body.position.shape
    assert np.isfinite(body.position).all() and body.radius.shape == (n,)
    assert len(np.unique(body.position.round(9), axis=0)) == n
    for field in INDICES:
        tuples = getattr(body, field)
        assert tuples.dtype.kind == "i" and ((tuples >= 0) & (tuples < n)).all()
        ordered = np.sort(tuples, axis=1)
        assert (ordered[:, 1:] > ordered[:, :-1]).all()  # no member twice
        same = np.unique(ordered, axis=0)
        assert len(same) == len(ordered)
    both = np.sort(np.concatenate([body.links, body.braces]), axis=1)
    assert len(np.unique(both, axis=0)) == len(both)
    assert (volumes(body) > 0).all()
    for loop in body.loops:
        x, y = body.position[loop].T
        assert np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) > 0 and len(np.unique(loop)) == len(loop)
    if dim == 3 and (len(body.tetrahedra) or name == "balloon"):
        shell = tv.Volume(body.faces)  # refuses open surfaces
        shell.prepare(tv.Particles(body.position), np.ones(n))
        assert shell.count == 1 and np.array_equal(shell.faces, body.faces)  # already oriented outwards
        if len(body.tetrahedra):
            assert shell.rest[0] == pytest.approx(volumes(body).sum())
    if len(body.tetrahedra) or len(body.loops):
        # Euler: vertices, edges, faces and cells count as in a ball or a disc.
        edges, faces, cells = len(np.unique(both, axis=0)), len(body.faces), len(body.tetrahedra)
        if dim == 2 and faces:
            assert n - edges + faces == 1
        if dim == 3:
            assert n - edges + (4 * cells + faces) // 2 - cells == 1
    turned = body.moved(np.arange(dim)).turned(0.7)
    a, b = body.position[body.links], turned.position[turned.links]
    np.testing.assert_allclose(np.linalg.norm(a[:, 0] - a[:, 1], axis=1), np.linalg.norm(b[:, 0] - b[:, 1], axis=1), atol=1e-12)


def test_counts_and_sizes():
    b = BODIES
    assert len(b["ball 2D"]) == 1 + 3 * 4 * 5 and len(b["ball 3D"]) == 7**3
    for name, rim in (("ball 2D", np.concatenate(b["ball 2D"].loops)), ("ball 3D", np.unique(b["ball 3D"].faces))):
        center = np.arange(1, 4)[: b[name].position.shape[1]]
        np.testing.assert_allclose(np.linalg.norm(b[name].position[rim] - center, axis=1), 0.5)
    assert volumes(b["ball 2D"]).sum() == pytest.approx(0.25 * 12 * np.sin(np.pi / 12))  # 24 sides, R = 1/2
    assert 0.8 < volumes(b["ball 3D"]).sum() / (np.pi / 6) < 1
    closed = np.concatenate([STAR, STAR[-1:], STAR[:1]])  # a corner twice in a row
    assert (S.blob(closed, 0.15).position == b["blob"].position).all()
    assert volumes(b["truss 3D"]).sum() == pytest.approx(6) and len(b["truss 3D"].tetrahedra) == 36
    assert len(b["balloon"]) == 10 * 16 + 2 and len(b["balloon"].faces) == 320
    assert len(b["cloth 3D"].links) == 40 and len(b["cloth 3D"].braces) == 32 + 30
    assert len(b["cloth 3D"].quads) == 40 - 16 + 16 and len(b["net"].braces) == 0
    assert len(b["bridge"]) == 13 and len(b["bridge"].links) == 6 + 5 + 12
    assert len(b["tree 2D"]) == 1 + 4 * (1 + 3 + 9 + 27) and len(b["tree 2D"].links) == len(b["tree 2D"]) - 1
    assert len(b["ragdoll 3D"]) == len(NAMES) == 16
    for pile in (b["pile"], S.pile((0, 0, 0), (1, 1, 1), 0.1)):
        assert len(pile) > 50 and len(tv.measure.overlapping(pile.position, pile.radius)[0]) == 0
    assert b["pile"].radius.min() < 0.021 and b["pile"].radius.max() > 0.049
    for dim in (2, 3):  # dolls stand within their limits, 1.8 m tall
        doll = b[f"ragdoll {dim}D"]
        turn = tv.AngleLimit(doll.limits, doll.lower, doll.upper).quantity.values(doll.position[doll.limits])
        assert ((turn >= doll.lower - 1e-9) & (turn <= doll.upper + 1e-9)).all()
        assert doll.position[:, 1].max() == pytest.approx(0.93 * 1.8, abs=0.02)
        w = tv.World(tv.Particles(doll.position), [tv.AngleLimit(doll.limits, doll.lower, doll.upper)])
        through = (doll.lower == 0) & (dim == 3)  # in 3D a joint turns on through straight, so 0 is no limit
        half = np.where(through, doll.upper, (doll.upper - doll.lower) / 2)
        np.testing.assert_allclose(w.features[0].rest, half, atol=1e-12)
        w.close()
    body, parts = S.join(b["ball 3D"], b["balloon"].moved((5, 0, 0)))
    assert [p.stop - p.start for p in parts] == [343, 162] and tv.Volume(body.faces).count == 2
    body, parts = S.join(b["polygon"], b["blob"])
    assert body.loops[1].min() == 12 and len(body.loops) == 2 and body.faces.min() == 12


def test_a_chain_hangs_on_its_catenary():
    # R10: the sag; and for any ends, the length, and that the chain is a catenary.
    p, values = case("R10_catenary")["params"], case("R10_catenary")["values"]
    assert -S.chain((0, 0), (p["span"], 0), p["length"], 1001).position[:, 1].min() == pytest.approx(values["sag"], rel=1e-12)
    for start, end, length in (((0, 0), (1, 0), 1.2), ((0, 0), (1, 0.7), 1.25), ((0, 0, 0), (2, -1, 3), 9), ((0, 0), (0, 1), 2)):
        c = S.chain(start, end, length, 2001)
        steps = np.linalg.norm(np.diff(c.position, axis=0), axis=1)
        assert steps.sum() == pytest.approx(length, rel=1e-5)
        np.testing.assert_allclose(c.position[[0, -1]], [start, end], atol=1e-9)
        if start[0] != end[0]:  # the slope grows evenly with the length: sinh
            flat = np.linalg.norm(np.delete(np.diff(c.position, axis=0), 1, axis=1), axis=1)
            slope = np.diff(c.position[:, 1]) / flat
            np.testing.assert_allclose(np.diff(slope, 2), 0, atol=1e-6)
    tight = S.chain((0, 0), (1, 0), 1 + 1e-9, 5)
    np.testing.assert_allclose(tight.position[:, 1], 0, atol=1e-4)


@pytest.mark.parametrize("name", ["ball 3D", "blob", "rope"])
@pytest.mark.parametrize("ending, binary", [("obj", False), ("ply", False), ("ply", True)])
def test_files_there_and_back(tmp_path, name, ending, binary):
    body, path = BODIES[name], tmp_path / f"body.{ending}"
    S.save(path, body, binary=binary)
    back = S.load(path, dim=body.position.shape[1])
    np.testing.assert_array_equal(back.position, body.position)
    np.testing.assert_array_equal(back.links, body.links)
    np.testing.assert_array_equal(back.faces, body.faces)
    if ending == "ply":
        np.testing.assert_array_equal(back.tetrahedra, body.tetrahedra)


def test_files_of_others(tmp_path):
    # Quads as fans, indices from the end, textures and comments; big-endian PLY with colours, short lists and another name.
    path = tmp_path / "a.OBJ"
    path.write_text("# cube side\nvn 0 0 1\nv 0 0 0 1.0\nv 1 0 0\nv 1 1 0\nv 0 1 0\ng side\nf 1/1/1 2//1 3 -1 # quad\ns off\n")
    side = S.load(path)
    np.testing.assert_array_equal(side.faces, [[0, 1, 2], [0, 2, 3]])
    assert len(side.links) == 5 and len(side.quads) == 1
    path = tmp_path / "b.ply"
    head = (
        "ply\nformat binary_big_endian 1.0\ncomment by hand\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nelement face 1\nproperty list uchar short vertex_index\nelement tet 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    kind = np.dtype([("p", ">f4", 3), ("red", "u1")])
    points = np.array([((0, 0, 0), 7), ((1, 0, 0), 8), ((0, 1, 0), 9), ((0, 0, 1), 9)], dtype=kind)
    face = b"\x04" + np.array([0, 1, 2, 3], dtype=">i2").tobytes()
    path.write_bytes(head.encode() + points.tobytes() + face + b"\x04" + np.array([0, 1, 2, 3], dtype=">i4").tobytes())
    body = S.load(path)
    np.testing.assert_array_equal(body.position, points["p"])
    np.testing.assert_array_equal(body.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(body.tetrahedra, [[0, 1, 2, 3]])


XYZ = "".join(f"property float {c}\n" for c in "xyz")


@pytest.mark.parametrize(
    "name, text, message",
    [
        ("a.obj", "v 1 2\n", r"line 1: 'v 1 2' cannot"),
        ("a.obj", "v 1 2 3\nf 1 2 3\n", r"face 0 is \(0, 1, 2\), but there are 1 vertices"),
        ("a.obj", "v 1 2 3\nf 0 1 1\n", r"face 0 is \(-1, 0, 0\)"),
        ("a.obj", "v 1 2 nan\n", r"vertices of .*\[0, 2\] = nan"),
        ("a.ply", "obj", "no header"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex two\nend_header\n", "'element vertex two' in the header"),
        ("a.ply", "ply\nformat zip 1.0\nend_header\n", "format 'zip'"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 2\n" + XYZ + "end_header\n1 2 3\n4",
         "vertex 1 of 2 is incomplete"),
        ("a.ply", "ply\nformat ascii 1.0\nelement face 1\nproperty list char int vertex_indices\nend_header\n-1 0\n",
         "face 0 of 1 is incomplete"),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "no vertices with x, y and z"),
        ("a.stl", "", "ends with '.stl'"),
    ],
)  # fmt: skip
def test_files_that_are_refused(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        S.load(tmp_path / name)


@pytest.mark.parametrize("size", [(0.4, 0.2), (0.5, 0.3, 0.4)])
def test_boxes_have_their_size_and_even_sides(size):
    # Each side has as much at its very edge as the opposite one, and spheres are at most two radii apart along each axis.
    box = S.box(np.zeros(len(size)), size, radius=0.05)
    x, r = box.position, box.radius[:, None]
    np.testing.assert_allclose((x + r).max(axis=0), np.array(size) / 2)
    np.testing.assert_allclose((x - r).min(axis=0), -np.array(size) / 2)
    low, high = ((side - extreme(side, axis=0) == 0).sum(axis=0) for side, extreme in ((x, np.min), (x, np.max)))
    assert (low == high).all() and low.min() >= 2 ** (len(size) - 1)
    for k in range(3 if len(size) == 3 else 0):
        assert np.diff(np.unique(x[:, k])).max() <= 2 * 0.05 + 1e-12


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: S.rope((0, 0), (0, 0), 3), "same point"),
        (lambda: S.rope((0, 0), (1, 0), 1), "points = 1"),
        (lambda: S.chain((0, 0), (1, 0), 0.9, 3), "length = 0.9, but it must be above 1"),
        (lambda: S.cloth((0, 0), (1, 0), (2, 0), (3, 3)), "span no area"),
        (lambda: S.cloth((0, 0), (1, 0), (0, 1), (3, 1)), r"points\[1\] = 1"),
        (lambda: S.ball((0, 0), -1.0), "radius = -1"),
        (lambda: S.ball((0, 0), 1.0, 0), "rings = 0"),
        (lambda: S.blob([[0, 0], [1, 0], [2, 0]], 0.1), "no area"),
        (lambda: S.blob(MOUTH, 5.0), "make it smaller"),
        (lambda: S.box((0, 0), (1, 0.2), 0.1), r"box: size\[1\] = 0.2, but it must be above 0.2"),
        (lambda: S.truss((0, 0), (1, -1), 2), r"upper\[1\] = -1"),
        (lambda: S.truss((0, 0), (1, 1), (1, 2, 3)), r"cells = \(1, 2, 3\), but one number"),
        (lambda: S.pile((0, 0), (1, 1), (1, 2, 3)), r"radius has shape \(3,\), but a number"),
        (lambda: S.pile((0, 0), (1, 1), 2.0), "no particle of radius 2 fits"),
        (lambda: S.pile((0, 0), (1, 1), (0.2, 0.1)), "smallest comes first"),
        (lambda: S.tree((0, 0), 1.0, levels=0), "levels = 0"),
        (lambda: S.ragdoll((0, 0), 0.0), "height = 0"),
        (lambda: S.polygon((0, 0), 1.0, 2), "sides = 2"),
        (lambda: S.polygon((0, 0), 1.0, 3).turned(np.nan), "angle = nan"),
        (lambda: S.join(BODIES["rope"], BODIES["net"]), "some shapes are in 2D"),
        (lambda: S.join(), "nothing to join"),
    ],
)
def test_bodies_that_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("spacing", [0.3, 0.2, 0.08])
@pytest.mark.parametrize("outline", ["square", "L", "circle"])
def test_a_blob_fills_outlines_whose_points_lie_on_lines_and_circles(outline, spacing):
    """The areas of the triangles add up to that inside of the outline, and n - edges + faces = 1 (Euler), at any spacing."""
    turn = np.arange(20) * np.pi / 10
    corners, area = {
        "square": ([(0, 0.5), (1, 0.5), (1, 1.5), (0, 1.5)], 1.0),
        "L": ([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 3.0),
        "circle": (np.stack([np.cos(turn), np.sin(turn)], axis=1), 10 * np.sin(np.pi / 10)),
    }[outline]
    s = tv.shapes.blob(corners, spacing)
    u, v = (s.position[s.faces[:, k]] - s.position[s.faces[:, 0]] for k in (1, 2))
    assert (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum() / 2 == pytest.approx(area, rel=1e-12)
    assert len(s) - len(s.links) + len(s.faces) == 1
