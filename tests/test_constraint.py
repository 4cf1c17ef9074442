"""The user's own constraint: against built-in ones and closed forms, far from the origin, and its error messages."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.constraints.core.length import REST_LENGTH, Length
from tiverlet.constraints.core.quantity import Quantity
from tiverlet.constraints.core.scalar import Scalar
from tiverlet.device import ti

from .conftest import case, order, rerun, rms


def length(a, b):
    """Return the distance of two points, as Distance does."""
    return (a - b).norm()


def directions(a, b):
    """Return the gradient of length()."""
    n = (a - b) / (a - b).norm()
    return n, -n


def radius(x):
    """Return the distance from the origin."""
    return x.norm()


def height(x, c):
    """Return the height of x above the parabola of constraint c."""
    return x[1] - 0.5 * x[0] * x[0] * (c + 1)


@pytest.mark.slow
def test_a_length_of_ones_own_is_a_distance(world):
    # The double pendulum D01: by Distance, by the user's function with a gradient, and by the function with finite differences.
    p = case("D01_double_pendulum")["params"]
    angle, size = np.radians(p["theta0_deg"]), np.array(p["lengths"])
    x = np.zeros((3, 2))
    x[1:] = np.cumsum(np.stack([np.sin(angle), -np.cos(angle)], axis=1) * size[:, None], axis=0)
    pairs, made = [[0, 1], [1, 2]], []
    for link in (tv.Distance(pairs), tv.Constraint(length, pairs, None, gradient=directions), tv.Constraint(length, pairs, size)):
        w = world(tv.Particles(x, pinned=[0]), [tv.Gravity(9.81), link], iterations=10, precision="f64", solver=tv.Jacobi())
        w.run(1.0)
        made.append((w.position, link.load))
    assert rms(made[0][0], x) > 0.1
    for position, load in made[1:]:
        np.testing.assert_allclose(position, made[0][0], atol=1e-8)
        np.testing.assert_allclose(load, made[0][1], atol=1e-5)


@pytest.mark.slow
def test_what_has_no_direction_says_how_far_it_is_off(world):
    # Central differences of |a - b| at a = b are 0: a rigid link of L m cannot open there, and its residual is all of L. A spring
    # has no force there, as F = -C grad C / alpha says, and no residual. Constraints between fixed particles have no residual.
    pairs = [[0, 1], [2, 3], [4, 5]]
    links = [tv.Constraint(length, pairs, rest, compliance=[0.0, 1e-3, 0.0]) for rest in (2.0, 1.0)]
    apart = tv.Constraint(length, [[0, 1]], 0.5, side=1)
    with pytest.warns(UserWarning, match="cannot move"):
        w = world(tv.Particles(np.zeros((6, 2)), pinned=[4, 5]), [*links, apart], precision="f64")
    assert w.step(1 / 60).residual == 1 and (w.position == 0).all()
    assert all(np.array_equal(link.residual, [1, 0, 0]) for link in links) and apart.residual[0] == 0


def test_a_bead_on_a_wire(world):
    # On a circle the bead is the pendulum R06b. From rest on y = (c + 1) x^2 / 2 it keeps its energy and never leaves the wire.
    v = case("R06b_pendulum_state")["values"]["90deg_t5"]
    w = world(tv.Particles([[1.0, 0.0]]), [tv.Gravity(9.81), tv.Constraint(radius, [0], 1.0)], iterations=4, precision="f64")
    errors = [rms(rerun(w, 5.0, substeps=n).position[0], [v["x"], v["y"]]) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1
    parabola = tv.Constraint(height, [0, 1])
    w = world(tv.Particles([[-1.0, 0.5], [1.0, 1.0]]), [tv.Gravity(9.81), parabola], substeps=40, iterations=4, precision="f64")
    w.run(5.0)
    y = w.position
    np.testing.assert_allclose(y[:, 1], 0.5 * y[:, 0] ** 2 * [1, 2], atol=1e-8)
    assert w.last.energy == pytest.approx(9.81 * 1.5, rel=1e-4)
    assert parabola.load.shape == (2,) and np.abs(parabola.residual).max() < 1e-7


def test_far_from_the_origin_the_origin_moves_along(world):
    # At 1e5 m an ulp of f32 is 8 mm. Relative to an origin near the scene, a compensated world resolves micrometres.
    v = case("R06b_pendulum_state")["values"]["90deg_t5"]
    far = np.array([1e5 + 0.3, -1e5 - 0.7])
    ring = tv.Constraint(radius, [0], 1.0, origin=far)
    w = world(tv.Particles([far + [1.0, 0.0]]), [tv.Gravity(9.81), ring], substeps=40, precision="f32-compensated")
    w.run(5.0)
    assert rms(w.position[0] - far, [v["x"], v["y"]]) <= 2e-4


def test_what_is_wrong_is_named(world):
    start = tv.Particles([[0.0, 0.0], [0.6, 0.8], [1.0, 3.0]])

    def flipped(a, b):
        n = (a - b) / (a - b).norm()
        return n, ti.Vector([-n[0], n[1]])

    def shapeless(a, b):
        return ti.log((a - b).norm() - 1.0)

    with pytest.raises(ValueError, match=r"Constraint\(length\): gradient is wrong for corner 1 along y: .* differences of func"):
        world(start, [tv.Constraint(length, [[0, 1], [1, 2]], None, gradient=flipped)])
    with pytest.raises(ValueError, match=r"Constraint\(shapeless\): the function is -inf for indices\[0\]"):
        world(start, [tv.Constraint(shapeless, [[0, 1]])])
    with pytest.raises(TypeError, match=r"takes \['a', 'b'\], but each constraint has 3 corners"):
        tv.Constraint(length, [[0, 1, 2]])
    with pytest.raises(TypeError, match="lambda"):
        tv.Constraint(lambda a, b: (a - b).norm(), [[0, 1]])
    with pytest.raises(TypeError, match="is not a function"):
        tv.Constraint(7, [[0, 1]])
    with pytest.raises(ValueError, match="side = 2"):
        tv.Constraint(length, [[0, 1]], side=2)
    with pytest.raises(ValueError, match=r"indices\[0\] = \(0, 3\)"):
        world(start, [tv.Constraint(length, [[0, 3]])])


class Half(Quantity):
    """A quantity without measure(), whose default is 0 with its corners as gradients."""

    arity = 2

    def values(self, x):
        return x[:, 0, 0]


def test_a_constraint_without_its_parts_is_refused():
    def made(quantity, **more):
        new = type("New", (Scalar,), {"measures": quantity, "__init__": lambda self, i: self.setup(i, None, 0.0, 0.0), **more})
        return lambda: new([[0, 1]])

    with pytest.raises(TypeError, match="New: the class has no knob `rest`"):
        made(Length)()
    with pytest.raises(TypeError, match=r"New: Half.measure\(\) is missing"):
        made(Half, rest=REST_LENGTH)()


def difference(a, b, c):
    """Return the difference of two sides of a triangle."""
    return (b - a).norm() - (c - b).norm()


@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_rest_values_that_are_rounding_are_no_size(world, size):
    # Two equal sides differ by 1e-16 of their length or not at all, and a flat tetrahedron has 1e-18 of its edge cubed.
    # Residuals are relative to the size of f, extent times |grad f|, so they are some digits of f32.
    y = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.3, 0.3]])
    flat = np.column_stack([y, 0.1 + 0.1 * y[:, 0] + 0.2 * y[:, 1]])
    even = np.array([[3.0, 0.0, 0.0], [4.0, 0.0, 0.0], [3.5, 0.75**0.5, 0.0]])
    x = size * np.concatenate([flat, even])
    v = 0.3 * size * np.random.default_rng(0).normal(size=x.shape)
    features = [tv.Volume([[0, 1, 2, 3]]), tv.Constraint(difference, [[4, 5, 6]])]
    w = world(tv.Particles(x, velocity=v), features, solver=tv.Jacobi(), substeps=20)
    assert 0 < abs(features[0].rest[0]) < 1e-15 * size**3 and abs(features[1].rest_of(x)[0]) < 1e-15 * size
    assert w.run(0.5).clean and max(f.residual.max() for f in features) < 64 * 2.0**-24


def perimeter(a, b, c, d):
    """Return the length around four corners."""
    return (a - b).norm() + (b - c).norm() + (c - d).norm() + (d - a).norm()


def off_circle(a):
    """Return the distance from a circle of radius 2 around the origin."""
    return a.norm() - 2.0


@pytest.mark.parametrize("substeps", [8, "auto"])
def test_a_rest_value_at_a_kink_pulls_together(world, substeps):
    # Four particles fall into one place, from rest, and go on with the momentum that they have. A function that crosses 0 has no
    # kink there, wherever the particle starts; it stays second order, solved with the others.
    x = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5], [2.0, 0.0], [0.0, 9.0]])
    v = 0.3 * np.random.default_rng(0).normal(size=x.shape)
    together, beads = tv.Constraint(perimeter, [[0, 1, 2, 3]]), [tv.Constraint(off_circle, [i]) for i in (4, 5)]
    w = world(tv.Particles(x, velocity=v), [together, *beads], substeps=substeps, precision="f64")
    assert together.cusp and not any(b.cusp for b in beads)
    flags = set().union(*[w.step(1 / 60).flags for _ in range(60)])
    assert flags <= {"moved"} and (w.last.substeps == substeps or w.last.substeps <= 8)
    middle = x[:4].mean(axis=0) + v[:4].mean(axis=0)
    np.testing.assert_allclose(w.position[:4], np.tile(middle, (4, 1)), atol=1e-6)
