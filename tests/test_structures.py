"""Structures of ropes and bars with the default solver: they keep their lengths. Bodies with more links than hold them."""

from itertools import combinations, product

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.solvers.redundancy import implied_links

from .scenes.solving import STRUCTURES, hung


@pytest.mark.parametrize("dim, link", [(2, tv.Distance), (3, tv.Rope)], ids=["bars", "ropes"])
def test_structures_keep_their_lengths_by_default(world, dim, link):
    # An elimination leaves a violation of second order in the move u = v h of a substep, |u|^2 / 2 l: with v = 3 m/s and links of
    # 0.125 m 2e-4 of l, and of fourth order after a second Newton step, which a system takes where that is above 5e-6. Jacobi
    # leaves 6e-3 (ladder, 3 kg) to 3e-1 (100 kg). Energy is lost where ropes jerk, never gained. Where the substep gets shorter,
    # two-sided rigid links keep their lengths; ropes have none, and run at any substep.
    particles, features = hung(link, *STRUCTURES[dim])
    w = world(particles.make(), [features[0].make(), features[1]])
    pairs, energy, size = features[1].indices, [], 9.81 * w.particles.mass.sum() * 3.0
    lengths = tv.measure.strain(w, pairs, 1.0) + 1
    for substeps, most in ((20, 3e-5), *[("auto", 1e-2)] * (link is tv.Rope)):
        w.position, w.velocity, w.substeps = w.particles.position, w.particles.velocity, substeps
        for _ in range(120 if substeps == 20 else 60):
            report = w.step(1 / 60)
            assert report.clean, report.flags
            energy.append(report.energy)
            strain = tv.measure.strain(w, pairs, lengths)
            assert np.abs(strain if link is tv.Distance else np.maximum(strain, 0)).max() < most
        assert substeps == "auto" or max(energy) - energy[0] < 1e-5 * size
    assert "Solved by Direct" in w.explain()


def all_pairs(n):
    """Return the links between all of n particles."""
    return np.array([*combinations(range(n), 2)])


def truss(cells):
    """Return a truss of squares, each with both diagonals."""
    a, b = np.arange(cells), np.arange(cells) + 1
    rows = [(2 * a, 2 * b), (2 * a + 1, 2 * b + 1), (2 * a, 2 * b + 1), (2 * a + 1, 2 * b), (2 * a, 2 * a + 1)]
    links = np.concatenate([*(np.stack(row, axis=1) for row in rows), [[2 * cells, 2 * cells + 1]]])
    return np.array([*product(range(cells + 1), (0, 1))], dtype=float), links


def unit(x, links):
    """Return the directions of links."""
    u = x[links[:, 0]] - x[links[:, 1]]
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def left_out(world, x, *features, **start):
    """Return which links the others imply."""
    with world(tv.Particles(x, **start), features, solver=tv.Jacobi()) as w:
        return implied_links(w._runner.batches, w._runner.scene)


SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
WHEEL = np.array([[np.cos(a), np.sin(a)] for a in np.arange(6) * np.pi / 3] + [[0.0, 0.0]])
SPOKES = np.array([*((k, (k + 1) % 6) for k in range(6)), *((k, 6) for k in range(6))])
CUBE = np.array([*product((0.0, 1.0), repeat=3)])
BODIES = {"square": (SQUARE, all_pairs(4)), "wheel": (WHEEL, SPOKES), "truss": truss(4), "cube": (CUBE, all_pairs(8))}


@pytest.mark.parametrize("name", BODIES)
def test_what_is_left_out_others_imply(world, name):
    # The links that remain have the rank of all links, as many as they are, so that J w J^T has an inverse. They number
    # dim n minus the rigid motions of a free body: 3 in 2D, 6 in 3D. For motion see "braced ladders ..." of tests/scenes.
    x, links = BODIES[name]
    for pins in ([], [0], [0, 1]):
        implied, free = left_out(world, x, tv.Distance(links), pinned=pins), np.setdiff1d(np.arange(len(x)), pins)
        J, k = np.zeros((len(links), *x.shape)), np.arange(len(links))
        J[k, links[:, 0]], J[k, links[:, 1]] = unit(x, links), -unit(x, links)
        J = J[:, free].reshape(len(links), -1)
        stay = J.any(axis=1) & ~implied
        assert np.linalg.matrix_rank(J) == np.linalg.matrix_rank(J[stay]) == stay.sum()
        assert pins or stay.sum() == x.size - (3 if x.shape[1] == 2 else 6)
        assert np.linalg.svd(J[stay], compute_uv=False).min() > 0.02


def test_links_imply_none_that_bend_soften_break_or_contradict(world):
    # Three links along a line: the long one is as long as the others together, but only as long as these do not bend. Springs,
    # links that break, ropes, and a diagonal that is too long are implied by none. Nor is the flat net in 3D a rigid body, with
    # all of its rim held, too; where some links are there twice, one of each pair stays.
    line, four = np.array([[0.0, 0], [1, 0], [2, 0]]), all_pairs(4)
    lengths = np.where(np.ptp(four % 2, axis=1) == 0, 2**0.5, 1.0)
    for x, feature in (
        (line, tv.Distance(all_pairs(3))), (SQUARE, tv.Distance(four, compliance=1e-6)), (SQUARE, tv.Rope(four)),
        (SQUARE, tv.Distance(four, break_at=1e3)), (SQUARE, tv.Distance(four, lengths * [1, 1.01, 1, 1, 1, 1])),
    ):  # fmt: skip
        assert not left_out(world, x, feature).any(), feature
    net = tv.shapes.net((0, 0, 0), (1, 0, 0), (0, 0, 1), (5, 5))
    rim = np.flatnonzero(((net.position == 0) | (net.position == 1))[:, [0, 2]].any(axis=1))
    with pytest.warns(UserWarning, match="duplicates"):
        twice = tv.Distance(np.concatenate([net.links, net.links[::3]]))
    for pins in ([], [0, 24], rim):
        assert not left_out(world, net.position, tv.Distance(net.links), pinned=pins).any()
        stays = twice.indices[~left_out(world, net.position, twice, pinned=pins)]
        assert {*map(tuple, stays.tolist())} == {*map(tuple, net.links.tolist())}


def test_braced_bridges_carry_what_weighs_more_than_they(world):
    # A truss of eight cells with a weight of 300 times that of a joint is rigid, so it stays where it is. By Jacobi it fell in a
    # heap at 4 substeps. Its loads: links pull and push at each joint as much as the weight does, sum over links of F u = m g.
    x, links = truss(8)
    mass, rods = np.where(np.arange(len(x)) == 9, 300.0, 1.0), tv.Distance(links)
    for pins in ([0, 1], [0, 1, 16, 17]):
        w = world(tv.Particles(x, mass=mass, pinned=pins), [tv.Gravity(9.81), rods.copy()], substeps=4)
        report = w.run(1.0)
        np.testing.assert_allclose(w.position, x, atol=1e-5)
        assert report.clean and np.abs(w.velocity).max() < 1e-4
        held, pull = np.zeros_like(x), w.features[1].load[:, None] * unit(x, links)
        np.add.at(held, links[:, 0], -pull)
        np.add.at(held, links[:, 1], pull)
        free = np.setdiff1d(np.arange(len(x)), pins)
        np.testing.assert_allclose(held[free], np.outer(mass, [0, 9.81])[free], atol=1e-3 * 300 * 9.81)
