"""Links that others imply: rigid bodies with more links than hold them are solved by elimination, as others are."""

import contextlib
from itertools import combinations, product

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.solvers.redundancy import implied_links

from .conftest import ARCH


def all_pairs(n):
    """Return the links between all of n particles."""
    return np.array([*combinations(range(n), 2)])


def crossed(cells):
    """Return a truss of squares, each with both diagonals."""
    a, b = np.arange(cells), np.arange(cells) + 1
    rows = [(2 * a, 2 * b), (2 * a + 1, 2 * b + 1), (2 * a, 2 * b + 1), (2 * a + 1, 2 * b), (2 * a, 2 * a + 1)]
    links = np.concatenate([*(np.stack(row, axis=1) for row in rows), [[2 * cells, 2 * cells + 1]]])
    return np.array([*product(range(cells + 1), (0, 1))], dtype=float), links


def hinged(boxes):
    """Return a row of squares with both diagonals, each hinged to the next one at a corner."""
    x, links = [(0.0, 0.0)], []
    for k in range(boxes):
        corners = [max(0, 3 * k - 2), 3 * k + 1, 3 * k + 2, 3 * k + 3]  # the first is the hinge
        x += [(k + 1.0, 0.0), (k + 0.2, -0.4), (k + 0.8, -0.4)]
        links += [(corners[i], corners[j]) for i, j in all_pairs(4)]
    return np.array(x), np.array(links)


SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
WHEEL = np.array([[np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3] + [[0.0, 0.0]])
SPOKES = np.array([*((k, (k + 1) % 6) for k in range(6)), *((k, 6) for k in range(6))])
CUBE = np.array([*product((0.0, 1.0), repeat=3)])
BODIES = {
    "square": (SQUARE, all_pairs(4)),
    "wheel": (WHEEL, SPOKES),
    "hexagon": (WHEEL[:6], all_pairs(6)),
    "truss": crossed(4),
    "cube": (CUBE, all_pairs(8)),
}


def rows(x, links):
    """Return J, the gradients of all links."""
    J = np.zeros((len(links), *x.shape))
    u = x[links[:, 0]] - x[links[:, 1]]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    k = np.arange(len(links))
    J[k, links[:, 0]], J[k, links[:, 1]] = u, -u
    return J


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("pins", [[], [0], [0, 1]], ids=["free", "pin", "two pins"])
def test_what_is_left_out_others_imply(world, name, pins):
    # The links that remain have the rank of all links, as many as they are, so that J w J^T has an inverse. They number
    # dim n minus the rigid motions of a free body: 3 in 2D, 6 in 3D.
    x, links = BODIES[name]
    w = world(tv.Particles(x, pinned=pins), [tv.Distance(links)], solver=tv.Jacobi())
    implied = implied_links(w._runner.batches, w._runner.scene)
    free = np.setdiff1d(np.arange(len(x)), pins)
    J = rows(x, links)[:, free].reshape(len(links), -1)
    acts = J.any(axis=1)
    rank = np.linalg.matrix_rank(J)
    assert np.linalg.matrix_rank(J[acts & ~implied]) == (acts & ~implied).sum() == rank
    assert pins or rank == x.size - (3 if x.shape[1] == 2 else 6)
    assert np.linalg.svd(J[acts & ~implied], compute_uv=False).min() > 0.02


def test_each_body_of_a_chain_leaves_out_its_own_links(world):
    # Bodies on hinges are no rigid body. Each square of four corners has one link too many, six of five. The chain swings from a
    # pin as one of rigid bodies does, and keeps its energy to second order. By Jacobi five boxes lost 0.12 of m g l for each
    # particle in 4 s.
    x, links = hinged(5)
    w = world(tv.Particles(x, pinned=[0]), [tv.Gravity(9.81), tv.Distance(links)], substeps=8)
    implied = implied_links(w._runner.batches, w._runner.scene)
    assert (np.bincount(np.arange(len(links))[implied] // 6, minlength=5) == 1).all()
    energy = np.array([w.step(1 / 60).energy for _ in range(240)])
    assert np.ptp(energy) < 1e-3 * 9.81 * len(x)


def test_links_imply_none_that_bend_soften_break_or_contradict(world):
    # Three links along a line: the long one is as long as the others together, but only as long as these do not bend. Springs,
    # links that break, ropes, and a diagonal that is too long are implied by none.
    line = np.array([[0.0, 0], [1, 0], [2, 0]])
    lengths = np.where(np.ptp(all_pairs(4) % 2, axis=1) == 0, 2**0.5, 1.0)
    for x, feature in (
        (line, tv.Distance(all_pairs(3))),
        (SQUARE, tv.Distance(all_pairs(4), compliance=1e-6)),
        (SQUARE, tv.Distance(all_pairs(4), break_at=1e3)),
        (SQUARE, tv.Rope(all_pairs(4))),
        (SQUARE, tv.Distance(all_pairs(4), lengths * [1, 1.01, 1, 1, 1, 1])),
    ):
        w = world(tv.Particles(x), [feature], solver=tv.Jacobi())
        assert not implied_links(w._runner.batches, w._runner.scene).any(), feature
    w = world(tv.Particles(SQUARE), [tv.Distance(all_pairs(4), lengths)], solver=tv.Jacobi())
    assert implied_links(w._runner.batches, w._runner.scene).sum() == 1


@pytest.mark.skipif(ARCH != "cpu", reason="bits differ between architectures")
@pytest.mark.parametrize("name", ["truss", "cube"])
def test_a_braced_body_stays_where_it_falls(world, name):
    # A rigid body without restitution loses energy to the floor, and no constraint gives any back: energy never grows by more
    # than 1e-3 of what fell. As springs of the stiffness 1 / h^2, which Jacobi makes of links, bodies gave back 3 to 30 %.
    x, links = BODIES[name]
    dim = x.shape[1]
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(dim, dim)))[0]
    up = np.eye(dim)[1]
    x = (x - x.mean(axis=0)) @ turn.T
    start = tv.Particles(x + (1.0 - x[:, 1].min()) * up)
    w = world(start, [tv.Gravity(9.81), tv.Distance(links), tv.HalfSpace(up)], substeps=8)
    reports = [w.step(1 / 60) for _ in range(90)]
    energy = np.array([r.energy for r in reports])
    assert "these imply" in w.explain()
    assert (energy - np.minimum.accumulate(energy)).max() < 1e-3 * (energy[0] - energy.min())
    assert max(r.residual for r in reports) < 1e-2 and reports[-1].residual < 1e-3
    assert energy[-1] < energy[0] - 0.5 * 9.81 * len(x)  # shows that it fell


@pytest.mark.parametrize("pins", [[0, 1], [0, 1, 16, 17]], ids=["cantilever", "clamped"])
def test_braced_bridges_carry_what_weighs_more_than_they(world, pins):
    # A truss of eight cells with a weight of 300 times that of a joint is rigid, so it stays where it is. By Jacobi it fell in a
    # heap at 4 substeps. Its loads: links pull and push at each joint as much as the weight does, sum over links of F u = m g.
    x, links = crossed(8)
    mass = np.where(np.arange(len(x)) == 9, 300.0, 1.0)
    rods = tv.Distance(links)
    w = world(tv.Particles(x, mass=mass, pinned=pins), [tv.Gravity(9.81), rods], substeps=4)
    report = w.run(1.0)
    np.testing.assert_allclose(w.position, x, atol=1e-5)
    assert report.clean and np.abs(w.velocity).max() < 1e-4
    u = x[links[:, 0]] - x[links[:, 1]]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    held = np.zeros_like(x)
    np.add.at(held, links[:, 0], -rods.load[:, None] * u)
    np.add.at(held, links[:, 1], rods.load[:, None] * u)
    free = np.setdiff1d(np.arange(len(x)), pins)
    np.testing.assert_allclose(held[free], np.outer(mass, [0, 9.81])[free], atol=1e-3 * 300 * 9.81)


@pytest.mark.skipif(ARCH != "cpu", reason="bits differ between architectures")
def test_a_body_gets_other_lengths_and_copies_of_it_the_same_bits(world):
    # A clone of a moving body leaves out the same links. Lengths that contradict each other, or links that become soft, are no
    # longer implied: then all links are solved again, and all lengths are met.
    links = all_pairs(4)
    rods = tv.Distance(links)
    start = tv.Particles(SQUARE, velocity=np.array([[0, -1], [1, 0], [0, 1], [-1, 0]]))
    w = world(start, [tv.Gravity(9.81), rods], substeps=8)
    w.run(0.5)
    other = w.clone()
    for each in (w, other):
        each.run(0.25)
    assert w.hash() == other.hash() and "these imply" in other.explain()
    rods.rest = 1.25 * rods.rest
    w.run(1.0)
    x = w.position
    np.testing.assert_allclose(np.linalg.norm(x[links[:, 0]] - x[links[:, 1]], axis=1), rods.rest, rtol=1e-3)
    assert "these imply" not in w.explain()


def test_links_of_nets_imply_none_but_the_same_links(world):
    # Links between two particles are no body of three. The net in 3D is flat, so it is not rigid, with all of its rim held, too.
    # Where some links are there twice, one of each pair stays. Particles that a rigid cluster holds, too, are left to relaxation.
    net = tv.shapes.net((0, 0, 0), (1, 0, 0), (0, 0, 1), (5, 5))
    rim = np.flatnonzero(((net.position == 0) | (net.position == 1))[:, [0, 2]].any(axis=1))
    for pins, links in product(([], [0, 24], rim), (net.links, np.concatenate([net.links, net.links[::3]]))):
        with contextlib.nullcontext() if links is net.links else pytest.warns(UserWarning, match="duplicates"):
            held = tv.Distance(links)
        w = world(tv.Particles(net.position, pinned=pins), [held], solver=tv.Jacobi())
        stays = links[~implied_links(w._runner.batches, w._runner.scene)]
        assert {*map(tuple, stays)} == {*map(tuple, net.links)}
    w = world(tv.Particles(SQUARE), [tv.Distance(all_pairs(4)), tv.ShapeMatch([np.arange(4)])])
    assert "Solved by Jacobi" in w.explain()
