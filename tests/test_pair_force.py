"""Forces between particles: closed forms, momentum, brute force, bits, and lists that grow."""

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


def pairs_by_hand(x, function):
    """Return the forces on all particles by function(r, i, j) with i < j, (n, dim)."""
    out = np.zeros_like(x)
    for i in range(len(x)):
        for j in range(i + 1, len(x)):
            f = function(x[i] - x[j], i, j)
            out[i] += f
            out[j] -= f
    return out


def crowd(n=60, dim=2, precision="f64", seed=0, features=(), **kwargs):
    """Return a world with random particles of different masses in a unit square or cube, with the short force."""
    rng = np.random.default_rng(seed)
    x, v = rng.uniform(0, 1, (n, dim)), rng.normal(0, 0.2, (n, dim))
    force = tv.PairForce(short, R, potential=short_energy)
    return tv.World(tv.Particles(x, velocity=v, mass=rng.uniform(0.5, 2, n)), [force, *features], precision=precision, **kwargs)


def orbit(substeps, order=2, radius=None):
    """Return the errors of position [m] and velocity [m/s] after one turn of two bodies of mass 1 around each other.

    They are 1 m apart: F = 1, so omega^2 / 2 = 1.
    """
    omega = 2**0.5
    start = np.array([[0.5, 0.0], [-0.5, 0.0]])
    particles = tv.Particles(start, velocity=[[0, 0.5 * omega], [0, -0.5 * omega]])
    force = tv.PairForce(newton, radius, potential=newton_energy)
    world = tv.World(particles, [force], substeps=substeps, precision="f64", order=order)
    for _ in range(20):
        report = world.step(2 * np.pi / omega / 20)
    assert not report.flags
    assert report.energy == pytest.approx(0.5 * omega**2 / 2 - 1, abs=1e-4)  # kinetic 2 (omega / 2)^2 / 2, potential -1
    return np.abs(world.position - start).max(), np.abs(world.velocity - particles.velocity).max()


@pytest.mark.parametrize("radius", [None, 3.0])
def test_two_bodies_come_round_with_an_error_of_second_order(radius):
    errors = np.array([orbit(substeps, radius=radius) for substeps in (10, 20)])
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.02)
    assert errors[1].max() < 4e-4  # phase error: (omega h)^2 / 24 of a turn


def test_orders_above_two_hold():
    coarse, fine = (orbit(substeps, order=4)[0] for substeps in (4, 8))
    assert coarse / fine == pytest.approx(16, rel=0.2)


@pytest.mark.parametrize("dim, precision", [(2, "f64"), (3, "f32")])
def test_accelerations_are_those_of_all_pairs(dim, precision):
    """One substep from rest: x = x0 + h^2 a / 2, with a by brute force."""
    world = crowd(dim=dim, precision=precision, substeps=1)
    world.velocity = np.zeros_like(world.velocity)
    x, m, h = world.position, world.particles.mass, 1e-2

    def by_hand(r, i, j):
        s = np.linalg.norm(r)
        return 40.0 * (1 - s / R) ** 2 * r / s if s < R else 0 * r

    a = pairs_by_hand(x, by_hand) / m[:, None]
    world.step(h)
    assert np.abs(world.position - x - h * h / 2 * a).max() < (1e-14 if precision == "f64" else 3e-7)


@pytest.mark.parametrize("radius", [None, 0.4])
def test_momentum_is_kept_whatever_the_function(radius):
    """Forces on a pair are computed once for both particles: opposite to the last bit, so sum m v is constant to rounding."""
    rng = np.random.default_rng(1)
    p = tv.Particles(rng.uniform(0, 1, (40, 2)), velocity=rng.normal(0, 1, (40, 2)), mass=rng.uniform(0.5, 2, 40))
    world = tv.World(p, [tv.PairForce(lopsided, radius)], substeps=4, precision="f64")
    before = p.mass @ p.velocity
    world.run(0.5)
    assert np.abs(p.mass @ world.velocity - before).max() < 1e-12
    assert np.abs(world.velocity - p.velocity).max() > 0.1


def test_energy_stays_and_lists_grow():
    """Energy is constant to order h^2; and all pairs are found after a contraction to many times as many, by a thread team."""
    world = crowd(n=400, substeps=20, path="parallel")
    start = world.step(0.0 + 1e-4).energy
    for _ in range(60):
        report = world.step(1 / 60)
    assert not report.flags
    assert abs(report.energy - start) < 2e-3 * abs(start)
    world.position = 0.2 * world.position  # 25 times as dense
    world.velocity = np.zeros_like(world.velocity)
    x, h = world.position, 1e-5
    world.substeps = 1
    world.step(h)
    r = x[:, None] - x[None]
    s = np.linalg.norm(r, axis=2) + np.eye(len(x)) * R
    a = np.einsum("ij,ijk->ik", 40 * np.maximum(1 - s / R, 0) ** 2 / s, r) / world.particles.mass[:, None]
    assert np.abs(world.position - x - h * h / 2 * a).max() < 1e-13


@pytest.mark.slow
def test_bits_are_the_same_after_a_replay(world, tmp_path):
    """Contacts have their own list beside it; recorded, replayed, cloned. For paths see test_determinism.py."""
    rng = np.random.default_rng(2)
    p = tv.Particles(rng.uniform(0, 2.3, (900, 2)), radius=0.02, velocity=rng.normal(0, 1, (900, 2)))
    features = [tv.PairForce(short, 0.1), tv.Contact(), tv.Box((0, 0), (2.3, 2.3)), tv.Gravity()]
    w = world(p, features, substeps=4)
    with tv.Recorder(tmp_path / "pairs.rrd", w) as recorder:
        w.run(0.2, recorder=recorder)
    twin = w.clone()
    assert twin.hash() == w.hash()
    w.run(0.1)
    twin.run(0.1)
    assert (twin.position == w.position).all()
    assert tv.replay(tmp_path / "pairs.rrd", given=[short]).verify()


@pytest.mark.slow
def test_hashes_know_nothing_of_who_is_listed(world, tmp_path):
    # A listed pair that is too far apart to act must leave 0, as an unlisted pair does, not -0. With -0, worlds that continue
    # from a frame in the middle of a recording have other hashes and are refused.
    rng = np.random.default_rng(0)
    p = tv.Particles(rng.uniform(0, 3, (8, 2)), velocity=rng.normal(0, 1.5, (8, 2)), radius=0.03)
    w = world(p, [tv.Periodic((0, 0), (3, 3)), tv.Contact(restitution=1.0), tv.PairForce(short, 0.3)], substeps=4)
    with tv.Recorder(tmp_path / "far.rrd", w) as recorder:
        w.run(2.5, recorder=recorder)
    recording = tv.replay(tmp_path / "far.rrd", given=[short])
    for frame in range(1, 150, 48):
        recording.world(frame).close()


def test_particles_come_and_go():
    """Frames are undone and repeated with more substeps; two added particles are pulled from where they are."""
    world = crowd(substeps="auto")
    world.run(0.1)
    velocity = world.velocity
    more = world.add(tv.Particles([[0.5, 0.5], [0.55, 0.5]], velocity=[[0.0, 1.0], [0.0, -1.0]]))
    assert np.abs(world.velocity[:-2] - velocity).max() < 1e-12
    assert np.abs(world.velocity[more.indices] - [[0, 1], [0, -1]]).max() < 1e-12
    momentum = world.particles.mass @ world.velocity
    world.run(0.05)
    assert np.abs(world.particles.mass @ world.velocity - momentum).max() < 1e-12
    world.remove(more)
    assert len(world.particles) == 60 and not world.step(1 / 60).flags


def test_what_is_too_stiff_for_the_substep_is_named():
    """Two particles of 1 kg on a spring of k = 4e4 N/m: omega = sqrt(2 k) = 283 / s, so h = 1 / 120 s is too long."""

    @ti.func
    def spring(r):
        return -4e4 * (r - 0.5 * r / r.norm())

    p = tv.Particles([[0.0, 0.0], [0.51, 0.0]])
    for substeps, flags in ((2, {"stiff-force"}), (10, set())):
        world = tv.World(p, [tv.PairForce(spring)], substeps=substeps, precision="f64")
        assert world.run(0.1).flags == flags, substeps


def test_wrong_arguments_are_refused():
    particles = tv.Particles([[0.0, 0.0], [1.0, 0.0]])

    @ti.func
    def number(r):
        return r.norm()

    @ti.func
    def two(r, i):
        return r

    @ti.func
    def vector(r):
        return r

    for make, kind, text in (
        (lambda: tv.PairForce(lambda r: r), TypeError, "PairForce: function = .* is not a Taichi function"),
        (lambda: tv.PairForce(two), TypeError, "it must take 1 or 3 of \\(r, i, j\\)"),
        (lambda: tv.PairForce(newton, -1.0), ValueError, "PairForce: radius"),
        (lambda: tv.PairForce(newton, potential=3), TypeError, "PairForce: potential"),
        (lambda: tv.World(particles, [tv.PairForce(number)]).step(0.1), TypeError, "number returns a number, but in 2D"),
        (
            lambda: tv.World(particles, [tv.PairForce(vector, potential=vector)]).step(0.1),
            TypeError,
            "vector returns 2 components, but it must return one number",
        ),
    ):
        with pytest.raises(kind, match=text):
            make()


def test_particles_in_one_place_and_held_ones_do_nothing_to_each_other():
    p = tv.Particles([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], pinned=[2, 3])
    world = tv.World(p, [tv.PairForce(newton, potential=newton_energy)], substeps=8, precision="f64")
    world.step(0.01)
    assert np.isfinite(world.position).all()
    assert (world.position[0] == world.position[1]).all()
    assert world.position[0, 0] == pytest.approx((1 + 1 / 4) * 0.01**2 / 2, rel=1e-3)
