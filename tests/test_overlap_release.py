"""Overlap that bears a load is no energy in a shorter substep."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet import shapes as S

G, R = 10.0, 0.5


def lattice(n, dim, height=1.05):
    """n^dim discs or spheres, hardly off a loose lattice."""
    rng = np.random.default_rng(0)
    x = np.stack(np.meshgrid(*[np.arange(n)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)[:, ::-1] * height + R
    return x + rng.uniform(0, 0.03, x.shape)


def test_a_column_is_lifted_to_the_overlap_of_the_shorter_substep(world):
    # The k-th contact from the top overlaps by 2 k g h^2; the top rises by what all of them lose, and nothing moves after it.
    n = 12
    column = np.stack([np.zeros(n), R + np.arange(n)], axis=1)
    w = world(tv.Particles(column, radius=R), [tv.Gravity(G), tv.Contact(), tv.HalfSpace((0, 1))], substeps=4, precision="f64")
    w.run(6.0)
    k = np.arange(n - 1, 0, -1)
    for substeps in (8, 12):
        before = w.position[:, 1]
        overlap = 2 * k * G / (60 * w.substeps) ** 2
        np.testing.assert_allclose(2 * R - np.diff(before), overlap, rtol=1e-3)
        rise = overlap * (1 - (w.substeps / substeps) ** 2)
        w.substeps = substeps
        w.step(1 / 60)
        # What is left is 1 % of the energy that overlaps would release, so a tenth of each of them in the mean: of its work on
        # the column, a tenth of its square root in velocities.
        left = 0.1 * n**0.5 * np.linalg.norm(rise)
        np.testing.assert_allclose(w.position[:, 1] - before, np.append(0, np.cumsum(rise)), atol=left)
        assert np.abs(w.velocity).max() < 0.2 * np.sqrt(G * rise.sum())
        w.run(2.0)


@pytest.mark.parametrize("dim, friction, restitution", [(2, 0.0, 0.0), (2, 0.5, 0.0), (3, 0.5, 0.0), (2, 0.3, 0.5)])
def test_a_pile_gains_no_energy_however_the_substep_changes(world, dim, friction, restitution):
    # Gravity and contacts only: kinetic and potential energy never exceed those of the start.
    x = lattice(5 if dim == 2 else 3, dim)
    low, high = np.zeros(dim), x.max(axis=0) + R
    high[1] = np.inf
    features = [tv.Gravity(G), tv.Contact(friction=friction, restitution=restitution), tv.Box(low, high, friction=friction)]
    w = world(tv.Particles(x, radius=R), features, substeps="auto")
    for turns in ("auto", (2, 8), (1, 4), (3, 4, 5, 6, 7)):
        if turns != "auto":
            w.position = x
            w.velocity = np.zeros_like(x)
        w.substeps = turns if turns == "auto" else turns[0]
        start, most = w.step(1 / 60).energy, -np.inf
        for frame in range(240):
            if turns != "auto":
                w.substeps = turns[frame // 9 % len(turns)]
            most = max(most, w.step(1 / 60).energy)
        assert most <= start * (1 + 1e-3), turns


def test_ropes_in_a_heap_gain_none_either(world):
    # Rigid links keep their lengths while discs part, so they have nothing to take back.
    ropes = S.join(*[S.rope((0, 0.1 + 0.11 * k), (1, 0.12 + 0.11 * k), 12) for k in range(6)])[0]
    features = [tv.Gravity(G), tv.Distance(ropes.links), tv.Contact(friction=0.3), tv.Box((-0.2, 0), (1.2, np.inf), friction=0.3)]
    w = world(tv.Particles(ropes.position, radius=0.045), features, substeps=2)
    start, most = w.step(1 / 60).energy, -np.inf
    for frame in range(200):
        w.substeps = (2, 8)[frame // 10 % 2]
        most = max(most, w.step(1 / 60).energy)
    assert most <= start * (1 + 1e-3)


def test_what_is_taken_out_does_not_depend_on_lists(world):
    # A clone lists its neighbours anew; the other path has lists of its own.
    x = lattice(5, 2)
    features = [tv.Gravity(G), tv.Contact(friction=0.3), tv.Box((0, 0), (5.3, np.inf), friction=0.3)]
    a, b = (world(tv.Particles(x, radius=R), [f.copy() for f in features], substeps=2, path=p) for p in ("fused", "launched"))
    for w in (a, b):
        w.run(1.5)
    with a.clone() as c:
        for w in (a, b, c):
            w.substeps = 9
            w.run(0.3)
        assert a.hash() == b.hash() == c.hash()
