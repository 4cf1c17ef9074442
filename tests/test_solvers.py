"""Relaxation up to its limit of stability, solvers that converge faster, and which one is the default."""

import re

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.report.accuracy.cases.case import links
from tiverlet.solvers.solver import SemiIteration, Solver

from .conftest import unprojected


def cloth(n):
    """Return positions and links of a square cloth of n x n particles in the plane y = 0, side 1."""
    sheet = tv.shapes.cloth((0, 0, 0), (1, 0, 0), (0, 0, 1), (n, n))
    return sheet.position, sheet.links


def still(factor):
    """Return a solver with this factor on each correction."""
    return type("Still", (Solver,), {"relaxed_by": lambda *_: factor})()


WRONG = [  # solvers, and what the error says
    (lambda: tv.Direct(-1), "Direct: width = -1"),
    (lambda: tv.Chebyshev(1.0), "Chebyshev"),
    (lambda: tv.ConjugateGradient(0), "ConjugateGradient"),
    (lambda: tv.Jacobi("fast"), "Jacobi"),
    (lambda: tv.Direct, r"solver = <class .*Direct'> is not a solver.*write Direct\(\)"),
    *((lambda f=f: still(f), rf"relaxed_by\(\) = {f:g}.* must be above 0") for f in (0.0, -1.0)),
    *((lambda f=f: still(f), rf"relaxed_by\(\) = {f:g}.* must be finite") for f in (np.nan, np.inf)),
    (lambda: tv.Chebyshev(kappa=50), r"kappa = 50 with iterations = 1, .* kappa <= 1.29 iterations\^2 = 1.29. Use iterations=7"),
]


def test_solvers_that_solve_nothing_or_are_unstable_are_refused(world):
    start, link = tv.Particles(np.eye(2)), tv.Distance([[0, 1]])
    for make, says in WRONG:
        with pytest.raises((ValueError, TypeError), match=says):
            tv.World(start, [link.copy()], solver=make())
    w = world(start, [link], solver=tv.Chebyshev(kappa=50), iterations=7)
    with pytest.raises(ValueError, match="kappa = 50 with iterations = 6"):
        w.iterations = 6
    assert w.iterations == 7


@pytest.mark.slow
def test_conjugate_gradients_reach_the_direct_solution(world):
    # One Newton step with the same linear system, of rigid links and of springs with dashpots. Enough steps of conjugate
    # gradients give the direct solution but for what the floor lets sag, sigma W h^2 F in a link: with sigma = 1.2 lambda / 60^2
    # < 1.4e-3, 1.4e-3 * 2 / m * h^2 * 6 m g < 5e-7 m. Before that, each comes nearer.
    (x, pairs), made = cloth(6), []
    for solver in (tv.Direct(width=100), tv.ConjugateGradient(60), tv.ConjugateGradient(8)):
        link = tv.Distance(pairs, compliance=1e-3 * (np.arange(len(pairs)) % 2), damping=1.0)
        start, some = tv.Particles(x, mass=0.1, pinned=np.arange(6)), {"precision": "f64", "substeps": 10}
        w = world(start, [tv.Gravity(9.81), link, tv.Drag(5.0)], solver=solver, **some)
        w.run(0.3)
        made.append((w.position, link.load))
    np.testing.assert_allclose(made[0][0], made[1][0], atol=5e-7)
    np.testing.assert_allclose(made[0][1], made[1][1], atol=1e-5 * np.abs(made[0][1]).max())
    assert 1e-5 < np.abs(made[2][0] - made[0][0]).max() < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("solver", [tv.Jacobi(), tv.ConjugateGradient(3)])
def test_constraints_that_are_not_met_are_flagged_with_what_helps(world, solver):
    # The residual of a cloth that falls into its two pins falls with h or faster: both the note's substeps and its solver help.
    x, pairs = cloth(12)
    start = tv.Particles(x, mass=1e-3, pinned=[0, 11])

    def worst(solver, substeps):
        w = world(start, [tv.Gravity(9.81), tv.Distance(pairs)], solver=solver, substeps=substeps, path="fused")
        return max((w.step(1 / 60) for _ in range(45)), key=lambda r: r.residual)

    found = worst(solver, 8)
    assert found.residual > 0.1 and "unconverged" in found.flags
    (note,) = (n for n in found.notes if n.startswith("Constraints are not met:"))
    said = re.search(r"off by (\S+) %.* Use about (\d+) substeps.*, or solver=tv.(ConjugateGradient)", note)
    assert said and said[1] == f"{100 * found.residual:.3g}" and 8 < int(said[2]) < 60
    for better in (worst(solver, int(said[2])), worst(tv.ConjugateGradient(6), 8)):
        assert better.residual < 0.11 and ("unconverged" in better.flags) == (better.residual > 0.05), better


@pytest.mark.parametrize("contact", [False, True])
def test_a_semi_iteration_beside_contacts_gains_no_energy(world, contact):
    # Chebyshev's polynomial is bounded as a whole. Contacts that touch nothing leave what its steps leave.
    way = np.linspace(0, 1.3, 9)[:, None]
    x = way * (np.sin(0.9), -np.cos(0.9)) + (0, 2.4)
    start = tv.Particles(x, mass=[*[0.1] * 8, 10.0], radius=0.03, pinned=[0])
    features = [tv.Gravity(9.81), tv.Distance(np.c_[:8, 1:9]), *([tv.Contact()] if contact else [])]
    w = world(start, features, solver=tv.Chebyshev(), substeps=20, iterations=4)
    reports = [w.step(1 / 10 if k % 5 == 4 else 1 / 60) for k in range(60)]
    first = reports[0].energy - reports[0].energy_change
    assert max(r.energy for r in reports) < 1.001 * first and not set().union(*(r.flags for r in reports))


@pytest.mark.slow
def test_a_contradictory_rope_softens_no_other_links(world):
    # Conjugate gradients solve one system with a rope that is too short for its pins: the links of a net beside it are off by as
    # little as alone. With one floor for all rows they would be off by seventy times as much.
    net, rope = tv.shapes.net((3, 2), (1, 0), (0, -1), points=(8, 8)), tv.shapes.rope((0, 2), (1, 2), points=12)
    x = np.concatenate([net.position, rope.position])
    pairs = np.concatenate([net.links, rope.links + 64])
    rest = np.r_[np.linalg.norm(np.diff(net.position[net.links], axis=1)[:, 0], axis=1), np.full(11, 0.95 / 11)]
    start = tv.Particles(x, mass=0.05, pinned=[0, 7, 64, 75])
    w = world(start, [tv.Gravity(), tv.Distance(pairs, rest)], solver=tv.ConjugateGradient())
    assert "unconverged" in w.step(1 / 60).flags
    w.run(0.5)
    off, n = w.features[1].residual, len(net.links)
    assert off[:n].max() < 5e-4 and off[n:] @ rest[n:] > 0.999 * 0.05  # what the rope lacks
    w.remove(range(64))
    w.run(0.1)
    assert w.features[1].residual @ rest[n:] > 0.999 * 0.05 and np.abs(w.velocity).max() < 0.1  # as soft as before


@pytest.mark.slow
def test_what_few_steps_take_from_rotations_is_told(world):
    # A ring of links turns freely: links are internal forces along themselves, so angular momentum stays. Those that are left off
    # by more than LOST act along their directions at the end of the substep, which have a moment about those at its begin.
    n = 40
    k, angle = np.arange(n), 2 * np.pi * np.arange(n) / n
    x = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ring = tv.Distance(np.stack([k, (k + 1) % n], axis=1))
    v = 5 * x[:, ::-1] * [-1, 1] + 0.3 * np.stack([np.cos(3 * angle), 0 * angle], axis=1)
    w = world(tv.Particles(x, velocity=v), [ring], solver=tv.ConjugateGradient(2), precision="f64")
    for substeps, kept in ((4, False), (20, True)):
        w.position, w.velocity, w.substeps = x, v, substeps
        reports = [w.step(1 / 60) for _ in range(120)]
        (px, py), (vx, vy) = w.position.T, w.velocity.T
        moment = (px * vy - py * vx).sum() / (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum()
        told = any("angular momentum" in note for r in reports for note in r.notes)
        assert all(r.clean for r in reports) and told == (not kept)
        assert (abs(moment - 1) < 1e-3) == kept, moment


class HeavyBall(Solver):
    """Jacobi with momentum (Polyak 1964): d_j = a z_j + b d_(j-1), for eigenvalues from 1 / kappa to 1."""

    converges = True
    b = ((1 - 1 / 4) / (1 + 1 / 4)) ** 2  # kappa = 16
    a = 4 / (1 + 1 / 4) ** 2

    def semi_iteration(self, scene):
        return Ball()


class Ball(SemiIteration):
    @ti.func
    def step(self, last, correction):
        return HeavyBall.a * correction + HeavyBall.b * last


def recursive(solver, eigenvalue, k):
    """Return what k heavy balls leave of a mode: p_(j+1) = (1 + b - a lambda) p_j - b p_(j-1), p_0 = 1, p_1 = 1 - a lambda."""
    before, now = 1.0, 1 - solver.a * eigenvalue
    for _ in range(k - 1):
        before, now = now, (1 + solver.b - solver.a * eigenvalue) * now - solver.b * before
    return now


def chebyshev(solver, eigenvalue, k):
    """Return T_k((theta - lambda) / delta) / T_k(theta / delta) on 1 / kappa ... 1."""
    low, T = 1 / solver.condition(k), np.polynomial.chebyshev.Chebyshev.basis(k)
    return T((1 + low - 2 * eigenvalue) / (1 - low)) / T((1 + low) / (1 - low))


# Every solver that relaxes, and the polynomial of eigenvalue and k by which k passes multiply a mode. A new solver is a row.
POLYNOMIALS = [
    (tv.Jacobi(1.2), lambda solver, eigenvalue, k: (1 - solver.relaxation * eigenvalue) ** k),
    (tv.Chebyshev(), chebyshev),
    (HeavyBall(), recursive),
]


@pytest.mark.slow
@pytest.mark.parametrize("solver, polynomial", POLYNOMIALS, ids=lambda v: type(v).__name__)
def test_passes_leave_of_each_mode_what_their_polynomial_says(world, solver, polynomial):
    # A straight chain of m links between two pins, displaced along itself, where constraints are linear: k passes take C to
    # p_k(A D^-1) C. Masses split by two give D = 4 w, and 2 w at the pins. So A D^-1 has the eigenvalues
    # (1 - cos(pi j / (m - 1))) / 2 and the vectors cos(pi j i / (m - 1)) for links i, halved at the pins.
    m, i = 9, np.arange(9)
    start = tv.Particles(np.stack([np.arange(m + 1.0), np.zeros(m + 1)], axis=1), pinned=[0, m])
    w = world(start, [tv.Distance(links(m), 1.0)], solver=solver, precision="f64", substeps=1, iterations=4)
    for j, k in ((1, 4), (3, 4), (m - 1, 4), (2, 7), (5, 8)):
        mode = np.cos(np.pi * j * i / (m - 1)) * np.where((i == 0) | (i == m - 1), 0.5, 1.0) * 1e-3
        x = start.position.copy()
        x[1:, 0] += np.cumsum(mode)
        w.velocity, w.position, w.iterations = 0 * x, x, k
        unprojected(w).step(1 / 60)
        left, eigenvalue = np.diff(w.position[:, 0]) - 1, (1 - np.cos(np.pi * j / (m - 1))) / 2
        np.testing.assert_allclose(left, polynomial(solver, eigenvalue, k) * mode, rtol=0, atol=1e-14)


def choices():
    """Yield the solver that is chosen, particles, and features."""
    flat = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1], [2, 1]])
    x, four, chain, ring = flat[[0, 1, 2, 4]], flat[:4], tv.Distance(links(3)), [(0, 1), (1, 2), (2, 3), (3, 0)]
    braced, three = np.array([*ring, (0, 2), (1, 3)]), [(0, 1, 2)]
    sheet = tv.shapes.cloth((0, 0, 0), (1, 0, 0), (0, 0, 1), (11, 11))
    ribbon, truss = tv.shapes.net((0, 0, 0), (2, 0, 0), (0, 0, 0.1), (21, 2)), tv.shapes.truss((0, 0), (2, 0.2), (10, 1))
    cloth, both = tv.Distance(sheet.links), np.concatenate([sheet.position, [[5.0, 0, 0], [5.5, 0, 0], [6, 0, 0]]])
    rope, elbow = tv.Distance(links(2, 121), 0.6), [(121, 122, 123)]
    for solver, cases in {
        "Direct": [  # chains, trees, loops, beams, narrow nets, bodies with spare links, contradictions
            (x, chain), (x, tv.Rope(links(3)), tv.Contact(), tv.Gravity()), (flat, tv.Distance([(0, 1), (1, 2), (1, 3)])),
            (four, tv.Distance(braced)), (four, tv.Distance(braced, compliance=1e-9)), (ribbon.position, tv.Rope(ribbon.links)),
            (four, tv.Distance(ring), tv.Bend([(3, 0, 1), (0, 1, 2)], compliance=1.0)),
            (x, chain, tv.Motor(three, 0.0, torque=0.0)), (x, chain, tv.AngleLimit(three, -2.0, 2.0)),
            (four, tv.Distance(braced, [1.0, 1.5, 1.0, 1.0, 1.5, 1.0])),
            (truss.position, tv.Distance(np.concatenate([truss.links, truss.braces])), tv.Pin([0, 1, 20, 21])),
        ],
        "Jacobi": [  # single links, what clusters hold, soft cloth
            (x,), (flat, tv.Distance([(0, 1), (2, 3)])), (x, tv.Motor(three, 0.0)),
            (four, tv.Distance(braced), tv.ShapeMatch([range(4)])), (sheet.position, tv.Distance(sheet.links, compliance=1e-3)),
        ],
        "ConjugateGradient": [  # stiff cloth, whatever else there is, and angles unfit for elimination
            (x, chain, tv.Bend(three)), (np.c_[x, x[:, 1] * x[:, 0]], chain, tv.Bend(three, compliance=1.0)),
            (x, chain, tv.Motor(three, 0.0)),
            (sheet.position, cloth, tv.Dihedral(sheet.quads)), (both, cloth, rope, tv.AngleLimit(elbow, 0.0, 2.0)),
        ],
    }.items():  # fmt: skip
        yield from ((solver, tv.Particles(position), *features) for position, *features in cases)
    # In a net of 8 x 8 an elimination has 60 products a link, less than conjugate gradients cost; in one of 9 x 9 75, and it
    # takes nothing of 13 x 13. Beside ladders with more links than the net, elimination goes on, but not if it leaves 200 links.
    ladder = tv.shapes.net((5, 0, 0), (0.5, 0, 0), (0, -3, 0), (2, 11))
    for n, ladders, solver in ((8, 0, "Direct"), (9, 0, "ConjugateGradient"), (9, 6, "Direct"), (13, 20, "ConjugateGradient")):
        net = tv.shapes.net((0, 0, 0), (1.2, 0, 0), (0, 0, 1.2), (n, n))
        pairs = np.concatenate([net.links, *(ladder.links + n * n + 22 * k for k in range(ladders))])
        pinned = [0, n - 1, n * n - n, n * n - 1, *(n * n + 11 * k for k in range(2 * ladders))]
        x = np.concatenate([net.position, *[ladder.position] * ladders])
        yield solver, tv.Particles(x, pinned=pinned), tv.Gravity(), tv.Distance(pairs)


@pytest.mark.filterwarnings("ignore:Contact. all radii are 0")
def test_the_default_suits_the_structure(world):
    # explain() says what was chosen.
    for solver, particles, *features in choices():
        text = world(particles, [f.copy() for f in features]).explain()
        assert not features or f"Solved by {solver}" in text and "; chosen because links " in text, features
    text = world(tv.Particles(np.eye(3)), [tv.Distance(links(2))], solver=tv.Jacobi()).explain()
    assert "Solved by Jacobi" in text and "chosen" not in text


@pytest.mark.slow
def test_what_is_placed_with_other_lengths_has_its_own_from_then_on(world):
    # A chain that is longer than its pins are apart, placed straight, and a truss with one link and one brace too long. They
    # settle, and from then on no link is off by more than an elimination leaves at 20 substeps.
    x, truss = np.linspace((0, 2), (1, 2), 40), tv.shapes.truss((0, 2), (2, 2.2), (10, 1))
    frame = np.concatenate([truss.links, truss.braces])
    rest = np.linalg.norm(np.diff(truss.position[frame], axis=1)[:, 0], axis=1)
    rest[[5, len(truss.links) + 3]] *= 1.1
    for place, pinned, pairs, lengths in ((x, [0, 39], links(39), 1.1 / 39), (truss.position, [0, 1], frame, rest)):
        w = world(tv.Particles(place, mass=0.01, pinned=pinned), [tv.Gravity(9.81), tv.Distance(pairs, lengths)], substeps=20)
        reports = [w.step(1 / 60) for _ in range(180)]
        assert max(r.residual for r in reports[60:]) < 1e-4
        assert max(r.energy for r in reports) <= reports[0].energy - reports[0].energy_change + 1e-3 * 0.01 * 9.81 * len(place)


@pytest.mark.slow
@pytest.mark.parametrize("dim", (2, 3))
def test_a_chain_that_bends_no_further_swings_with_its_lengths_and_its_energy(world, dim):
    # Twelve points from level, each of whose joints stops at 0.3 rad, where a joint strikes its stop and loses energy: links and
    # limits are met to second order, and energy never rises.
    x, joints = np.linspace((0, 2, 0), (1, 2, 0), 12)[:, :dim], np.arange(10)[:, None] + [0, 1, 2]
    stops = tv.AngleLimit(joints, -0.3 if dim == 2 else 0.0, 0.3)
    w = world(tv.Particles(x, mass=0.01, pinned=[0]), [tv.Gravity(9.81), tv.Distance(links(11)), stops], substeps=20)
    reports = [w.step(1 / 60) for _ in range(180)]
    assert max(r.residual for r in reports) < 1e-3
    assert max(r.energy for r in reports) <= reports[0].energy - reports[0].energy_change + 1e-4 * 0.01 * 9.81 * 12
