"""The user's own constraint: against built-in ones and closed forms, far from the origin, and its error messages."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import case, order, rerun, rms

SWUNG = [case("R06b_pendulum_state")["values"]["90deg_t5"][axis] for axis in "xy"]


def length(a, b):
    """Return the distance of two points, as Distance does."""
    return (a - b).norm()


def radius(x):
    """Return the distance from the origin."""
    return x.norm()


def height(x, c):
    """Return the height of x above the parabola of constraint c."""
    return x[1] - 0.5 * x[0] * x[0] * (c + 1)


def perimeter(a, b, c, d):
    """Return the length around four corners."""
    return (a - b).norm() + (b - c).norm() + (c - d).norm() + (d - a).norm()


def off_circle(a):
    """Return the distance from a circle of radius 2 around the origin."""
    return a.norm() - 2.0


def test_beads_stay_on_their_wires_and_swing_as_pendulums(world):
    # On a circle the bead is the pendulum R06b. From rest on y = (c + 1) x^2 / 2 beads keep their energy and stay on the wire.
    parabola = tv.Constraint(height, [1, 2])
    features = [tv.Gravity(9.81), tv.Constraint(radius, [0], 1.0), parabola]
    w = world(tv.Particles([[1.0, 0.0], [-1.0, 0.5], [1.0, 1.0]]), features, iterations=4, precision="f64")
    errors = [rms(rerun(w, 5.0, substeps=n).position[0], SWUNG) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1
    y = w.position[1:]
    np.testing.assert_allclose(y[:, 1], 0.5 * y[:, 0] ** 2 * [1, 2], atol=1e-8)
    assert w.last.energy == pytest.approx(9.81 * 1.5, rel=1e-4)
    assert parabola.load.shape == (2,) and np.abs(parabola.residual).max() < 1e-7


def test_a_bead_beside_contacts_swings_as_alone_and_bears_what_it_carries(world):
    # A constraint of one corner is a row of contacts. Below the center of its wire it carries a disc of the same mass.
    bead, ring = (0.0, -1.0), tv.Constraint(radius, [0, 1], [2.0, 1.0])
    start = tv.Particles([(2.0, 0.0), bead, (0.0, -0.8)], radius=0.1)
    w = world(start, [tv.Gravity(9.81), ring, tv.Contact()], precision="f64", substeps=40)
    w.run(0.5)
    alone = world(tv.Particles([(2.0, 0.0)]), [tv.Gravity(9.81), tv.Constraint(radius, [0], 2.0)], precision="f64", substeps=40)
    alone.run(0.5)
    assert w.position[0] == pytest.approx(alone.position[0], abs=1e-9) and w.position[1] == pytest.approx(bead, abs=1e-9)
    assert ring.load[1] == pytest.approx(2 * 9.81, rel=1e-3)


def test_far_from_the_origin_the_origin_moves_along(world):
    # At 1e5 m an ulp of f32 is 8 mm. Relative to an origin near the scene, a compensated world resolves micrometres.
    far = np.array([1e5 + 0.3, -1e5 - 0.7])
    ring = tv.Constraint(radius, [0], 1.0, origin=far)
    w = world(tv.Particles([far + [1.0, 0.0]]), [tv.Gravity(9.81), ring], substeps=40, precision="f32-compensated")
    w.run(5.0)
    assert rms(w.position[0] - far, SWUNG) <= 2e-4


@pytest.mark.slow
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
    assert flags <= {"moved"} and (w.last.substeps == substeps or w.last.substeps <= 20)
    middle = x[:4].mean(axis=0) + v[:4].mean(axis=0)
    np.testing.assert_allclose(w.position[:4], np.tile(middle, (4, 1)), atol=1e-6)


def flipped(a, b):
    """Return the gradient of length(), with one wrong sign."""
    n = (a - b) / (a - b).norm()
    return n, ti.Vector([-n[0], n[1]])


def shapeless(a, b):
    """Return what is not finite where the scene starts."""
    return ti.log((a - b).norm() - 1.0)


def starting(*args, **options):
    """Return a world of three particles and a constraint of the user."""
    return tv.World(tv.Particles([[0.0, 0.0], [0.6, 0.8], [1.0, 3.0]]), [tv.Constraint(*args, **options)])


@pytest.mark.parametrize(
    "make, error, message",
    [
        (
            lambda: starting(length, [[0, 1], [1, 2]], None, gradient=flipped), ValueError,
            r"Constraint\(length\): gradient is wrong for corner 1 along y: .* differences of func",
        ),
        (lambda: starting(shapeless, [[0, 1]]), ValueError, r"Constraint\(shapeless\): the function is -inf for indices\[0\]"),
        (lambda: starting(length, [[0, 3]]), ValueError, r"indices\[0\] = \(0, 3\)"),
        (lambda: tv.Constraint(length, [[0, 1, 2]]), TypeError, r"takes \['a', 'b'\], but each constraint has 3 corners"),
        (lambda: tv.Constraint(lambda a, b: (a - b).norm(), [[0, 1]]), TypeError, "lambda"),
        (lambda: tv.Constraint(7, [[0, 1]]), TypeError, "is not a function"),
        (lambda: tv.Constraint(length, [[0, 1]], side=2), ValueError, "side = 2"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(make, error, message):
    with pytest.raises(error, match=message):
        make()
