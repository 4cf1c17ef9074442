"""Rows of the stiff and extreme matrix, by number, and aspects of them that the report does not check."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import thread_team
from tiverlet.report.stress.certificate import certify
from tiverlet.report.stress.rows.motion import check_nan_flag

from .chains import beyond
from .conftest import ARCH, CASES, case, figures, pendulums, rerun, rms

DOORS = (28, 38, 59, 60, 65)
MOTION = (4, 6, 7, 11, 18, 29, 37, 50, 52, 61, 62)


@pytest.mark.slow
@pytest.mark.parametrize("number", DOORS + MOTION)
def test_rows_pass(number, briefly):
    # All rows take minutes: python -m tiverlet stress. Other tests cover further rows by name: 2 test_chains.py, 10, 13, 19, 20,
    # 63 and 66 test_checks.py, 15 and 17 test_properties.py, 22 test_direct.py, 45, 48 and 82 test_contact.py, 55 test_bodies.py.
    result = certify(number)
    if ARCH not in tv.runtime.LLVM and any(ARCH in why for why in result.failing):  # the architecture does not support it
        pytest.skip(str(result.failing))
    assert result.verdict == "passed", result
    whip = "Jacobi(relaxation=1): turned, unconverged; Direct(): softened, unconverged"
    said = {18: whip, 62: ("5 substeps advised", "6 substeps advised")}
    assert result.figure.startswith(said.get(number, ""))


def test_7_idle_links_are_named():
    x = [[0.0, 0], [1, 0], [2, 0.5]]
    with pytest.warns(UserWarning, match=r"pairs\[1\] = \(1, 2\).* cannot move"):
        tv.World(tv.Particles(x, pinned=[0, 1, 2]), [tv.Distance([[0, 1], [1, 2]], [1.0, 3.0])]).close()


class Chains:
    """All D cases with g = 9.81 as chains of one world."""

    def __init__(self, world, **settings):
        self.names = [name for name in CASES if name.startswith("D0")]
        x, mass, pairs = zip(*(pendulums(name) for name in self.names), strict=True)
        begin = np.cumsum([0, *map(len, x)])
        self.parts = [slice(a, b) for a, b in zip(begin[:-1], begin[1:], strict=True)]
        self.mass = np.concatenate(mass)
        self.mass[begin[:-1]] = 0  # anchors do not count in sums
        self.links = tv.Distance(np.concatenate([p + k for p, k in zip(pairs, begin, strict=False)]))
        start = tv.Particles(np.vstack(x), mass=np.concatenate(mass), pinned=begin[:-1])
        self.world = world(start, [tv.Gravity(9.81), self.links], precision="f64", **settings)

    def energies(self, before=None, h=0.0):
        """Return the energy of each chain [J], and m g L, which gravity can supply in a swing.

        before: positions h [s] ago. The energy is then that of the motion since, at the middle of the interval.
        """
        w = self.world
        velocity = w.velocity if before is None else (w.position - before) / h
        height = w.position[:, 1] if before is None else (w.position + before)[:, 1] / 2
        each = self.mass * (0.5 * (velocity**2).sum(axis=1) + 9.81 * height)
        reach = np.linalg.norm(np.diff(w.particles.position, axis=0), axis=1)
        return [(each[p].sum(), 9.81 * self.mass[p].sum() * reach[p.start : p.stop - 1].sum()) for p in self.parts]


@pytest.mark.parametrize("solver", [None, tv.Jacobi()])
def test_12_one_substep_of_a_tenth_of_a_second(world, solver):
    # Bounded: finite, and no energy gained, measured by the motion in each substep. The velocity at the end of a substep
    # contains half of a kick along links that turn by more than 41 degrees here, as the flag says. One pass of 0.1 s holds a
    # heavy end about as well as a rubber band would, which the residual shows.
    chains = Chains(world, substeps=1, solver=solver)
    w, x = chains.world, chains.world.particles.position
    assert repr(w._solver) == ("Jacobi(relaxation=1)" if solver else "Direct(width=2)")
    start = [energy for energy, _ in chains.energies()]
    for iterations in (1, 20):
        w.velocity, w.position = np.zeros_like(x), x
        w.iterations = iterations
        for _ in range(100):
            before = w.position
            report = w.step(0.1)
            assert np.isfinite(w.position).all() and "non-finite" not in report.flags
            for (now, most), begin, name in zip(chains.energies(before, 0.1), start, chains.names, strict=True):
                assert now <= begin + 0.1 * most, (name, iterations)
    if solver:
        # Rows 1 and 2: one Jacobi pass cannot hold a heavy end. Its error equals that of the prototype to six digits, and the
        # residual is the strain that a ruler would measure.
        w.iterations = 1
        for iterations in (1, 50):
            rerun(w, 0.5, substeps=20, iterations=iterations)
            strain = tv.measure.strain(w, chains.links.indices, chains.links.rest)
            np.testing.assert_allclose(chains.links.residual, np.abs(strain), rtol=1e-9, atol=1e-14)
            assert w.last.residual == pytest.approx(np.abs(strain).max(), rel=1e-12)
            for name, part in zip(chains.names, chains.parts, strict=True):
                if iterations == 1 and case(name)["params"]["g"] == 9.81 and "t0.5" in case(name)["values"]:
                    at, want = beyond(name, 0.5)
                    known = figures(name, 0.5, 20)["SHAKE-Jac split"]
                    assert rms(w.position[part][at], want) == pytest.approx(known, rel=1e-6), name


@pytest.mark.slow
def test_36_nothing_and_almost_nothing(world):
    one = [[1.0, 2.0]]
    for x, path in ((np.zeros((0, 3)), "parallel"), (one, "fused")):
        dim = np.shape(x)[1]
        features = [tv.Gravity(), tv.Drag(1.0), tv.Distance(np.zeros((0, 2), int)), tv.Contact(), tv.Box([-9] * dim, [9] * dim)]
        w = world(tv.Particles(x, radius=0.1), features, path=path)
        report = w.run(0.1)
        assert w.position.shape == np.shape(x) and report.clean and w.explain() and len(w.hash()) == 64
    w = world(tv.Particles(one))
    w.run(0.1)
    np.testing.assert_array_equal(w.position, one)


def test_50_nan_is_flagged_in_launches():
    with thread_team.launching():
        found = check_nan_flag(tv.Box((-9, -9), (99, 99)), path="parallel")
    assert all(found.values()), found


def test_34_thousands_in_one_cell(world):
    # Correct, O(n^2), with a warning and without overflow. Launched phase by phase, where the list has a kernel of its own.
    n = 2048
    x = np.random.default_rng(0).uniform(0, 0.01, (n, 2))
    w = world(tv.Particles(x, radius=0.5), [tv.Contact()], path="launched")
    with pytest.warns(UserWarning, match="near pairs per particle"):
        w._runner.list_neighbours()
    np.testing.assert_array_equal(w._runner.memory.read(w._runner.search.list.number), n - 1)
    assert w._runner.search.list.need[None] * w._runner.search.list.blocks >= n * (n - 1)
