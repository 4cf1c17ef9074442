"""Impacts of discs that touch: what falls stays where it lands, as the inelastic impact of rigid discs has it, or comes back to
e^2 of its fall, as Newton's law for impacts at the same time has it."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import LEFT

G, R = 10.0, 0.1


def lattice(*counts):
    """Return places of touching discs or spheres on a floor at y = 0: so many along each axis.

    They are a millionth apart: none overlap by rounding, which would compile other kernels.
    """
    place = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, len(counts))
    return R * (1 + 2 * (1 + 1e-6) * place)


def dropped(world, x, height, friction=0.0, spin=None, pair=0.0, wall=0.0, skin: float | str = "auto", **settings):
    """Return a world of discs that will fall by `height` to the places x. pair, wall: restitution."""
    up = np.eye(x.shape[1])[1]
    start = tv.Particles(x + height * up, radius=R, spin=spin)
    contact = tv.Contact(friction=friction, restitution=pair, skin=skin)
    return world(start, [tv.Gravity(G), contact, tv.HalfSpace(up, friction=friction, restitution=wall)], **settings)


@pytest.mark.parametrize(
    "counts, more",
    [
        ((1, 1), {}), ((1, 3), {}), ((1, 3), {"friction": 0.5, "spin": 0.0}), ((1, 5), {}), ((5, 5), {}),
        ((5, 5), {"friction": 0.5, "precision": "f64"}), ((3, 3, 3), {}),
    ],
)  # fmt: skip
def test_what_falls_stays_where_it_lands(world, counts, more):
    # Inelastic impacts leave no velocity. Blocks that springs throw back rise by up to half of their fall.
    fall = 1.0
    for substeps in (4, 8, 30):
        w = dropped(world, lattice(*counts), fall, substeps=substeps, **more)
        w.run(np.sqrt(2 * fall / G) + 2 / 60)
        height = np.array([w.position[:, 1].mean() for _ in range(60) if w.step(1 / 60)])
        landed = R * counts[1]
        assert height.max() < landed + 2e-3 * fall, substeps
        assert height[:6].min() > 0.9 * landed, substeps  # it is not pressed into the floor


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("spins", [False, True])
def test_what_strikes_at_an_angle_rubs_by_coulombs_law(world, dim, spins):
    # A disc with v along n and u across strikes a fixed one. The impulse P = min(mu v, u / (1 + k)) per mass across n takes it to
    # u' = u - P and r omega = k P, where k = 1 / inertia if it spins, else 0: it slides, or its surface stands still. It is
    # stopped in the substep in which it meets the other one, and in the next. By then it is up to 2 u h / 2 R = 2 phi further
    # round, which changes P by 8 phi^2 v or less.
    u, v, k = 2.0, 3.0, spins * (2.0 if dim == 2 else 2.5)
    for mu in (0.1, 0.9):
        for substeps in (4, 8, 30):
            x, velocity = np.zeros((2, dim)), np.zeros((2, dim))
            x[1, :2], velocity[1, :2] = (-u * 0.1, 2 * R + v * 0.1), (u, -v)
            start = tv.Particles(x, velocity=velocity, radius=R, pinned=[0], spin=0.0 if spins else None)
            w = world(start, [tv.Contact(friction=mu)], substeps=substeps, precision="f64")
            w.run(9 / 60)
            push, off = min(mu * v, u / (1 + k)), 8 * v * (u / (60 * substeps) / (2 * R)) ** 2 + 1e-9
            assert w.velocity[1, 0] == pytest.approx(u - push, abs=off)
            if spins:
                assert R * np.ravel(w.spin[1])[-1] == pytest.approx(-k * push, abs=k * off)


@pytest.mark.parametrize("substeps", [4, 8, 30])
def test_a_floor_rubs_all_that_stands_on_it(world, substeps):
    # A column that falls at an angle slides on. The floor stops m v of each disc, and rubs the lowest one with mu n m v in all,
    # which pairs pass on: the center of mass is slower by mu v, and then by mu g t. Without friction of the floor in the
    # projection it was slower by half of that. Overlaps hold a part of the impulse, LEFT of it, until they are pushed out.
    u, v, mu, n = 2.0, np.sqrt(2 * G), 0.1, 3
    start = tv.Particles(lattice(1, n) + (0.0, 1.0), radius=R, velocity=(u, 0.0))
    features = [tv.Gravity(G), tv.Contact(friction=mu), tv.HalfSpace((0, 1), friction=mu)]
    w = world(start, features, substeps=substeps, precision="f64")
    w.run(v / G + 2 / 60)
    slower = mu * (v + G * (w.time - v / G))
    assert w.velocity[:, 0].mean() == pytest.approx(u - slower, abs=0.01 * slower)


@pytest.mark.parametrize("struck", [1, 2])
def test_a_row_that_is_hit_goes_on_as_one(world, struck):
    # Momentum is conserved, m v = (n + 1) m u, and all n + 1 discs have the same velocity u, up to what passes may lack: the
    # share LEFT of its mean square. In a Newton's cradle with e = 0, the last disc does not fly off.
    n, v = struck + 1, 3.0
    x = np.zeros((n + 1, 2))
    x[1:, 0] = 2 * R * np.arange(n)
    x[0, 0] = -0.5
    start = tv.Particles(x, velocity=[(v, 0.0)] + [(0.0, 0.0)] * n, radius=R)
    w = world(start, [tv.Contact()], substeps=8, precision="f64")
    w.run(0.5)
    assert np.allclose(w.velocity.sum(axis=0), (v, 0.0), atol=1e-12)
    assert np.allclose(w.velocity[:, 0], v / (n + 1), atol=np.sqrt(LEFT) * (n + 1) * v)


def test_discs_that_fly_together_keep_their_momentum_and_gain_no_energy(world):
    rng = np.random.default_rng(1)
    x = lattice(8, 8) * 1.3 + 0.02 * rng.normal(size=(64, 2))
    v = 2 * (x.mean(axis=0) - x) + 0.5 * rng.normal(size=x.shape)
    w = world(tv.Particles(x, velocity=v, radius=R, mass=rng.uniform(0.5, 2, 64)), [tv.Contact()], substeps=8, precision="f64")
    p, energy = tv.measure.momentum(w), [0.5 * (w.particles.mass * (v**2).sum(axis=1)).sum()]
    for _ in range(60):
        energy.append(w.step(1 / 60).energy)
    assert np.allclose(tv.measure.momentum(w), p, atol=1e-12 * np.abs(w.particles.mass[:, None] * v).sum())
    assert energy[-1] < 0.3 * energy[0] and np.diff(energy).max() < 1e-3 * energy[0]


@pytest.mark.parametrize(
    "counts, pair, wall, more",
    [
        ((1, 3), 0.3, 0.3, {}), ((1, 6), 0.1, 0.1, {}), ((1, 10), 0.5, 0.5, {"precision": "f64"}), ((6, 6), 0.8, 0.8, {}),
        ((6, 6), 0.5, 0.5, {"friction": 0.5, "spin": 0.0}), ((1, 6), 0.0, 0.5, {}), ((1, 6), 0.5, 0.0, {}),
        pytest.param((4, 4, 4), 0.3, 0.3, {}, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_what_touches_bounces_as_a_whole(world, counts, pair, wall, more):
    # All contacts are struck at the same time, and each is left with -e times its velocity: the floor with e v, and pairs, which
    # did not approach, with 0. So the center of mass comes back to e^2 of its fall. It is off by the overlap (1 + e) v h that the
    # lowest pair has by the end of the substep, and by what the passes leave, less than 1 %. With one impact after the other
    # and pushes between what they leave, columns came back by 0.2 to 0.7 of their fall, whatever e was.
    fall, v = 1.0, np.sqrt(2 * G)
    for substeps in (4, 8, 30):
        w = dropped(world, lattice(*counts), fall, pair=pair, wall=wall, substeps=substeps, **more)
        w.run(v / G + 1 / 60)
        y = np.array([w.position[:, 1] for _ in range(90) if w.step(1 / 60)])
        off = (1 + wall) * v / (60 * substeps) + 0.01 * fall
        assert y.mean(axis=1).max() - R * counts[1] == pytest.approx(wall**2 * fall, abs=off), substeps
        assert y.max() - R * (2 * counts[1] - 1) < 1.2 * wall**2 * fall + off, substeps
        assert y.min() > R - off  # as deep as the overlap that is taken back


def test_what_does_not_touch_bounces_one_after_the_other(world):
    # A light disc a little above a heavy one: the floor throws the heavy one back with e v, and this one the light one with
    # u = (1 + e)^2 v M / (M + m) - v, several times as fast as both came.
    e, heavy, v, gap = 0.9, 10.0, np.sqrt(2 * G), 0.004
    start = tv.Particles([(0, R + 1), (0, 3 * R + gap + 1)], radius=R, mass=[heavy, 1.0])
    w = world(
        start, [tv.Gravity(G), tv.Contact(restitution=e), tv.HalfSpace((0, 1), restitution=e)], substeps=200, precision="f64"
    )
    w.run(v / G + 0.02)
    u = (1 + e) ** 2 * v * heavy / (heavy + 1) - v
    assert w.velocity[1, 1] + 0.02 * G == pytest.approx(u, rel=0.01)


def test_the_impulses_of_what_bounces_sum_up_to_its_momentum(world):
    # The floor gives a column m (1 + e) v, and what it weighs meanwhile; the lowest pair gives that to all discs but one.
    n, e, v = 6, 0.5, np.sqrt(2 * G)
    start = tv.Particles(lattice(1, n) + (0.0, 1.0), radius=R)
    contact, floor = tv.Contact(restitution=e, events=True), tv.HalfSpace((0, 1), restitution=e, events=True)
    w = world(start, [tv.Gravity(G), contact, floor], substeps=8, precision="f64")
    w.run(v / G - 0.05)
    before, by_floor, by_pair = w.velocity[:, 1], 0.0, 0.0
    for _ in range(6):
        w.step(1 / 60)
        floors, pairs = w.wall_events().touches, w.events().touches
        by_floor += floors.impulse.sum()
        by_pair += pairs.impulse[(pairs.pairs == (0, 1)).all(axis=1)].sum()
    gained = w.velocity[:, 1] - before + 0.1 * G
    assert by_floor == pytest.approx(gained.sum(), rel=0.03)
    assert by_pair == pytest.approx(gained[1:].sum(), rel=0.03)
