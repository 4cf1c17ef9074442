"""Errors at the door: what is wrong, with index and value, before Taichi sees anything."""

import numpy as np
import pytest
import taichi as ti

import tiverlet as tv

NAN, INF = float("nan"), float("inf")


def particles(**kwargs):
    return lambda: tv.Particles(np.arange(8.0).reshape(4, 2), **kwargs)


def scene(*features, **kwargs):
    return lambda: tv.World(tv.Particles(np.arange(8.0).reshape(4, 2), radius=0.1), features, **kwargs)


@pytest.mark.parametrize(
    "make, error, words",
    [
        # rows 3, 5, 26, 49, 53: particles
        (particles(mass=0.0), ValueError, r"mass\[0\] = 0, but it must be above 0"),
        (particles(mass=[1, 2, -3, 4]), ValueError, r"mass\[2\] = -3, but it must be above 0"),
        (particles(mass=[1, NAN, 1, 1]), ValueError, r"mass\[1\] = nan"),
        (particles(mass=[1, 1]), ValueError, r"mass has shape \(2,\)"),
        (particles(radius=[1, 1, -1, 1]), ValueError, r"radius\[2\] = -1, but it must be at least 0"),
        (particles(radius=NAN), ValueError, r"radius\[0\] = nan"),
        (particles(radius=INF), ValueError, r"radius\[0\] = inf"),
        (particles(velocity=(1, INF)), ValueError, r"velocity\[1\] = inf"),
        (particles(velocity=3.0), ValueError, "no direction"),
        (particles(velocity=np.zeros((3, 2))), ValueError, r"velocity has shape \(3, 2\), but \(4, 2\)"),
        (particles(pinned=[4]), ValueError, r"pinned\[0\] = 4, but there are 4 particles \(0 ... 3\)"),
        (particles(pinned=[True, False]), ValueError, r"mask of shape \(4,\)"),
        (particles(group=0.5), TypeError, "integers"),
        (lambda: tv.Particles([[0, 0], [1, NAN]]), ValueError, r"position\[1, 1\] = nan"),
        (lambda: tv.Particles([[0, 0], [1]]), ValueError, "ragged"),
        (lambda: tv.Particles(np.zeros((3, 4))), ValueError, r"\(3, 4\), but \(n, 2\) or \(n, 3\)"),
        (lambda: tv.Particles([["a", "b"]]), TypeError, "real numbers"),
        (lambda: tv.Particles([[0, 1e19]]), ValueError, r"position\[0, 1\] = 1e\+19 m is out of range"),  # row 29
        # rows 10, 19, 20: links
        (scene(tv.Distance([[0, 1]], compliance=0.0), "gravity"), TypeError, r"features\[1\] = 'gravity'"),
        (scene(tv.Gravity), TypeError, r"write Gravity\(...\)"),
        (lambda: tv.Distance([[0, 1], [2, 2]]), ValueError, r"pairs\[1\] = \(2, 2\) names a particle twice"),
        (scene(tv.Distance([[0, 1], [3, 250]])), ValueError, r"Distance: pairs\[1\] = \(3, 250\), but there are 4 particles"),
        (lambda: tv.Distance([[0, -1]]), ValueError, r"pairs\[0\] = \(0, -1\)"),
        (lambda: tv.Distance([0, 1]), ValueError, r"shape \(2,\), but \(m, 2\)"),
        (lambda: tv.Distance([[0.5, 1]]), TypeError, "integers"),
        (lambda: tv.Distance([[0, 1]], compliance=-1e-3), ValueError, r"compliance\[0\] = -0.001"),
        (lambda: tv.Distance([[0, 1]], compliance=NAN), ValueError, r"compliance\[0\] = nan"),
        (lambda: tv.Distance([[0, 1]], damping=[-1.0]), ValueError, r"damping\[0\] = -1"),
        (scene(tv.Distance([[0, 1], [1, 2]], rest=[1, -2])), ValueError, r"rest\[1\] = -2"),
        (scene(tv.Distance([[0, 1]], rest=NAN)), ValueError, r"Distance: rest\[0\] = nan"),
        (scene(tv.Rope([[0, 1]], length=NAN)), ValueError, r"Rope: length\[0\] = nan"),
        (scene(tv.Spacer([[0, 1]], [1, 2])), ValueError, r"length has shape \(2,\)"),
        (lambda: tv.Pin([0, 0]), ValueError, "named twice"),
        (lambda: tv.Pin([0, 1], compliance=[0, 1]), ValueError, r"compliance\[0\] = 0 among positive"),
        (scene(tv.Pin([0], (0, 0, 0))), ValueError, r"target has shape \(1, 3\)"),
        (scene(tv.Pin([7])), ValueError, r"indices\[0\] = 7"),
        # walls, forces, contacts
        (lambda: tv.Box((0, 0), (1, -1)), ValueError, "along axis 1 it goes from 0 to -1"),
        (scene(tv.Box((0, 0), (9, 0.15))), ValueError, "does not hold a particle of radius 0.1"),  # row 26
        (scene(tv.Box((0, 0, 0), (1, 1, 1))), ValueError, "2 numbers are needed in a 2D world"),
        (lambda: tv.HalfSpace((0, 0)), ValueError, "no direction"),
        (lambda: tv.HalfSpace((0, 1), INF), ValueError, "offset = inf"),
        (lambda: tv.Gravity(NAN), ValueError, "g = nan"),
        (scene(tv.Gravity((0, 0, -9.81))), ValueError, r"g has shape \(3,\)"),
        (lambda: tv.Drag(-1), ValueError, "rate = -1, but it must be at least 0"),
        (lambda: tv.Wind((1, 0), NAN), ValueError, "rate = nan"),
        (lambda: tv.Attractor((0, 0), "strong"), TypeError, "strength = 'strong'"),
        (lambda: tv.Force(lambda x: x), TypeError, "@ti.func"),
        (lambda: tv.Contact(skin=0), ValueError, "skin = 0, but it must be above 0"),
        (scene(tv.Contact(), tv.Contact()), ValueError, "more than one Contact"),
        # rows 28, 63, 66: world
        (lambda: tv.World(tv.Particles([[0, 0], [1e6, 0]], radius=0.05), [tv.Contact()]), ValueError, r"position\[1, 0\] = 1e"),
        (scene(substeps=0), ValueError, "substeps = 0, but it must be at least 1"),
        (scene(substeps=2.5), TypeError, "substeps = 2.5 is a float"),
        (scene(substeps=True), TypeError, "substeps = True"),
        (scene(iterations=-1), ValueError, "iterations = -1"),
        (scene(iterations=0), ValueError, "iterations = 0, but it must be at least 1"),
        (scene(precision="f16"), ValueError, "precision = 'f16', but it must be one of 'f32'"),
        (scene(path="fast"), ValueError, "path = 'fast'"),
        (lambda: tv.World(np.zeros((3, 2))), TypeError, r"use tv.Particles\(position\)"),
        (scene(tv.Distance([[0, 1], [1, 2]]), solver=tv.Jacobi(1.5)), ValueError, r"4/3 / lambda_max = 1.3\d+"),  # row 63
        (scene(tv.Distance([[0, 1]], compliance=1.0), solver=tv.Jacobi(1.4)), ValueError, "stable only below 4/3 where"),
        (lambda: tv.Jacobi(relaxation=0), ValueError, "above 0"),
        (lambda: tv.init(arch="gpu"), ValueError, "arch = 'gpu', but it must be one of 'cpu'"),
        (lambda: tv.init(threads=0), ValueError, "threads = 0"),
        (lambda: tv.shapes.rope((0, 0), (1, 0), points=1), ValueError, "points = 1"),
    ],
)  # fmt: skip
def test_bad_input_is_named(make, error, words):
    with pytest.raises(error, match=words):
        make()


@pytest.mark.parametrize("dt", [0.0, -1.0, NAN, INF, "1", None, True])
def test_bad_frames_are_refused(world, dt):
    # Row 13. And nothing has moved.
    w = world(tv.Particles([[0.0, 1.0]]), [tv.Gravity()])
    before = w.hash()
    with pytest.raises((ValueError, TypeError), match="dt"):
        w.step(dt)
    assert w.hash() == before


def test_structure_is_fixed_and_says_so(world):
    p = tv.Particles([[0.0, 1.0]], mass=2.0)
    link = tv.Distance([[0, 1]])
    w = world(tv.Particles([[0.0, 1.0], [1, 1]]), [link])
    with pytest.raises(AttributeError, match="structure, fixed when a world is built"):
        p.mass = 3.0
    for array in (p.mass, p.radius, p.position, link.indices, link.compliance):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    with pytest.raises(AttributeError, match="World.time cannot be set"):
        w.time = 3.0
    with pytest.raises(AttributeError, match="World.gravity cannot be set"):
        w.gravity = 3.0
    with pytest.raises(ValueError, match="already acts in another world"):
        tv.World(tv.Particles([[0.0, 1.0], [1, 1]]), [link])
    with pytest.raises(ValueError, match="listed twice"):
        g = tv.Gravity()
        tv.World(p, [g, g])
    for value in ([[0.0, NAN], [0, 0]], [[0.0, INF], [0, 0]], [[0.0, 0.0]], np.zeros((2, 3))):  # rows 38, 53
        with pytest.raises(ValueError, match="World: position"):
            w.position = value
        with pytest.raises(ValueError, match="World: velocity"):
            w.velocity = value
    with pytest.raises(ValueError, match="substeps = 0"):
        w.substeps = 0
    with pytest.raises(TypeError, match="gravity cannot be changed"):
        w.clone(gravity=1)


def test_a_world_that_fails_to_build_leaves_its_features_free(world):
    link = tv.Distance([[0, 1]])
    with pytest.raises(ValueError):
        tv.World(tv.Particles([[0.0, 0]]), [link])
    w = world(tv.Particles([[0.0, 0], [1, 0]]), [link])
    w.close()
    world(tv.Particles([[0.0, 0], [1, 0]]), [link]).run(0.05)


def test_forces_take_as_many_arguments_as_they_name():
    @ti.func
    def five(a, b, c, d, e):
        return a

    with pytest.raises(TypeError, match="1 to 4"):
        tv.Force(five)
