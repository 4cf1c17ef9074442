"""Forces between particles: closed forms, momentum, brute force, and lists that grow."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

R = 0.3  # radius at which the short force ends [m]


@ti.func
def newton(r):
    return -r / r.norm() ** 3


@ti.func
def newton_energy(r):
    return -1.0 / r.norm()


@ti.func
def short(r):
    """Return a repulsion that ends smoothly at R: F = 40 (1 - |r| / R)^2 r / |r|."""
    s = r.norm()
    return 40.0 * (1.0 - s / R) ** 2 * r / s


@ti.func
def short_energy(r):
    return 40.0 * R / 3.0 * (1.0 - r.norm() / R) ** 3


@ti.func
def lopsided(r, i, j):
    """Return a force that is not odd in r and differs between pairs: the force on j must follow from the force on i."""
    return (i + 2 * j + 1) * (0.01 * r + 0.001 * r.dot(r))


def crowd(world, n, dim=2, **settings):
    """Return a world with random particles of different masses in a unit square or cube, with the short force."""
    rng = np.random.default_rng(0)
    x, v = rng.uniform(0, 1, (n, dim)), rng.normal(0, 0.2, (n, dim))
    start = tv.Particles(x, velocity=v, mass=rng.uniform(0.5, 2, n))
    return world(start, [tv.PairForce(short, R, potential=short_energy)], **settings)


def check_accelerations(w, h, atol):
    """Check one substep from rest: x = x0 + h^2 a / 2, with a of all pairs by brute force."""
    w.velocity, w.substeps, x = 0 * w.position, 1, w.position
    w.step(h)
    r = x[:, None] - x
    s = np.linalg.norm(r, axis=2) + np.eye(len(x)) * R
    a = np.einsum("ij,ijk->ik", 40 * np.maximum(1 - s / R, 0) ** 2 / s, r) / w.particles.mass[:, None]
    np.testing.assert_allclose(w.position, x + h * h / 2 * a, rtol=0, atol=atol)


@pytest.mark.parametrize("radius, order", [(None, 2), (3.0, 2), (None, 4)])
def test_two_bodies_come_round_with_the_error_of_their_order(world, radius, order):
    # Two bodies of mass 1, 1 m apart: F = 1, so omega^2 / 2 = 1. Phase error of order 2: (omega h)^2 / 24 of a turn. The energy
    # is kinetic, 2 (omega / 2)^2 / 2, and potential, -1.
    omega, start, errors = 2**0.5, np.array([[0.5, 0.0], [-0.5, 0.0]]), []
    for substeps in (10, 20) if order == 2 else (4, 8):
        particles = tv.Particles(start, velocity=[[0, 0.5 * omega], [0, -0.5 * omega]])
        force = tv.PairForce(newton, radius, potential=newton_energy)
        w = world(particles, [force], substeps=substeps, precision="f64", order=order)
        for _ in range(20):
            report = w.step(2 * np.pi / omega / 20)
        assert not report.flags and report.energy == pytest.approx(0.5 * omega**2 / 2 - 1, abs=1e-4)
        errors.append([np.abs(w.position - start).max(), np.abs(w.velocity - particles.velocity).max()])
    ratio = np.array(errors[0]) / errors[1]
    assert ratio == pytest.approx(4, rel=0.02) and max(errors[1]) < 4e-4 if order == 2 else ratio[0] == pytest.approx(16, rel=0.2)


def test_accelerations_in_space_are_those_of_all_pairs(world):
    check_accelerations(crowd(world, 60, 3), 1e-2, 3e-7)


@pytest.mark.parametrize("radius", [None, 0.4])
def test_momentum_is_kept_whatever_the_function(world, radius):
    # Forces on a pair are computed once for both particles: opposite to the last bit, so sum m v is constant to rounding.
    rng = np.random.default_rng(1)
    p = tv.Particles(rng.uniform(0, 1, (40, 2)), velocity=rng.normal(0, 1, (40, 2)), mass=rng.uniform(0.5, 2, 40))
    w = world(p, [tv.PairForce(lopsided, radius)], substeps=4, precision="f64")
    w.run(0.5)
    assert np.abs(p.mass @ w.velocity - p.mass @ p.velocity).max() < 1e-12
    assert np.abs(w.velocity - p.velocity).max() > 0.1


@pytest.mark.slow
def test_energy_stays_and_lists_grow(world):
    # Energy is constant to order h^2; and all pairs are found after a contraction to many times as many, by a thread team.
    w = crowd(world, 400, precision="f64", path="parallel")
    start = w.step(1e-4).energy
    for _ in range(60):
        report = w.step(1 / 60)
    assert not report.flags
    assert abs(report.energy - start) < 2e-3 * abs(start)
    w.position = 0.2 * w.position  # 25 times as dense
    check_accelerations(w, 1e-5, 1e-13)


def test_what_is_too_stiff_for_the_substep_is_named(world):
    # Two particles of 1 kg on a spring of k = 4e4 N/m: omega = sqrt(2 k) = 283 / s, so h = 1 / 120 s is too long.
    @ti.func
    def spring(r):
        return -4e4 * (r - 0.5 * r / r.norm())

    w = world(tv.Particles([[0.0, 0.0], [0.51, 0.0]]), [tv.PairForce(spring)], precision="f64")
    for w.substeps, flags in ((2, {"stiff-force"}), (10, set())):
        w.velocity, w.position = [[0.0, 0.0]] * 2, [[0.0, 0.0], [0.51, 0.0]]
        assert w.run(0.1).flags == flags, w.substeps


@ti.func
def to_center(x):
    """Return the force of a fixed center: that of newton() for a reduced mass of 1 / 2, at half the distance."""
    return -x / (4 * x.norm() ** 3)


@pytest.mark.parametrize("kind", ["pair", "center"])
def test_a_close_encounter_keeps_its_energy_or_is_named(world, kind):
    # Two bodies of 1 kg, 2 m apart, fall on each other to (2 v)^2 / 4, where a force 1 / r^2 is largest: the encounter takes a
    # small part of a frame, and its end does not show it. E = sum m v^2 / 2 - 1 / r; a tenth of the energy of motion is too much.
    falls = [(v, n) for v in (0.3, 0.1, 0.03, 0.01, 0.003, 0.0) for n in (20, 60, "auto")]
    for v, n in [*falls, (0.0284, 100), (0.0475, 47)]:  # these are just too rough, and just good enough
        x, features = [[-1.0, 0], [1, 0]], [tv.PairForce(newton)]
        if kind == "center":
            x, features = x[:1], [tv.Force(to_center)]
        w = world(tv.Particles(x, velocity=[[0, v], [0, -v]][: len(x)]), features, substeps=n, precision="f64")

        def energy(w=w):
            x, kinetic = w.position, (w.velocity**2).sum() / len(w.position)
            return kinetic - 1 / np.linalg.norm(x[0] - (x[1] if len(x) > 1 else -x[0])), kinetic

        before, flags, fastest = energy()[0], set(), 0.0
        for _ in range(180):
            flags |= w.step(1 / 60).flags
            fastest = max(fastest, energy()[1])
        off = abs(energy()[0] - before) / fastest
        assert off < 0.1 or flags & {"stiff-force", "stuck", "substeps-capped"}, (v, n, off)
        assert off > 0.01 or not flags, (v, n, off, flags)
        assert off < 0.01 or v < 0.1


def test_what_creeps_over_the_edge_of_a_force_is_no_encounter(world):
    # At the edge of a region with a wind the force changes by all of it, whatever the substep; a slow body hardly notices.
    @ti.func
    def region(x):
        a = 0 * x
        if x[0] > 0:
            a[0] = 3.0
        return a

    w = world(tv.Particles([[-1e-4, 0.0], [5.0, 5.0]], velocity=[[1e-3, 0.0], [0.0, 1.0]]), [tv.Force(region)], precision="f64")
    for w.substeps in (20, 200):
        w.position, w.velocity = w.particles.position, w.particles.velocity
        assert not w.run(0.2).flags


def test_particles_in_one_place_and_held_ones_do_nothing_to_each_other(world):
    p = tv.Particles([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], pinned=[2, 3])
    w = world(p, [tv.PairForce(newton, potential=newton_energy)], substeps=8, precision="f64")
    w.step(0.01)
    assert np.isfinite(w.position).all()
    assert (w.position[0] == w.position[1]).all()
    assert w.position[0, 0] == pytest.approx((1 + 1 / 4) * 0.01**2 / 2, rel=1e-3)


@ti.func
def number(r):
    return r.norm()


@ti.func
def two(r, i):
    return r


@ti.func
def vector(r):
    return r


def stepped(*features):
    tv.World(tv.Particles([[0.0, 0.0], [1.0, 0.0]]), list(features)).step(0.1)


@pytest.mark.parametrize("make, kind, text", [
    (lambda: tv.PairForce(lambda r: r), TypeError, "PairForce: function = .* is not a Taichi function"),
    (lambda: tv.PairForce(two), TypeError, "it must take 1 or 3 of \\(r, i, j\\)"),
    (lambda: tv.PairForce(newton, -1.0), ValueError, "PairForce: radius"),
    (lambda: tv.PairForce(newton, potential=3), TypeError, "PairForce: potential"),
    (lambda: stepped(tv.PairForce(number)), TypeError, "number returns a number, but in 2D"),
    (lambda: stepped(tv.PairForce(vector, potential=vector)), TypeError,
     "vector returns 2 components, but it must return one number"),
])  # fmt: skip
def test_wrong_arguments_are_refused(make, kind, text):
    with pytest.raises(kind, match=text):
        make()
