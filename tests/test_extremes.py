"""Rows of the stiff and extreme matrix that no other file holds. The numbers are the rows'."""

import numpy as np
import pytest
import taichi as ti

import tiverlet as tv

from .conftest import CASES, case, figures, pendulums, rerun, rms
from .test_direct import beyond


def test_4_infinite_mass_is_static(world):
    made = []
    for kwargs in ({"mass": [np.inf, 1.0]}, {"pinned": [0]}):
        w = world(tv.Particles([[0.0, 0], [1, 0]], **kwargs), [tv.Gravity(), tv.Distance([[0, 1]])])
        w.run(0.5)
        made.append(w.hash())
        np.testing.assert_array_equal(w.position[0], 0.0)
    assert made[0] == made[1]


def test_6_7_all_static(world):
    # A step of statics is no step; a link between them is counted as idle, and warned about where it is violated.
    x = [[0.0, 0], [1, 0], [2, 0.5]]
    with pytest.warns(UserWarning, match=r"pairs\[1\] = \(1, 2\).* cannot move"):
        w = world(
            tv.Particles(x, pinned=[0, 1, 2], radius=0.7, velocity=(3, 3)),
            [
                tv.Gravity(),
                tv.Distance([[0, 1], [1, 2]], [1.0, 3.0]),
                tv.Contact(),
                tv.Drag(1.0),
                tv.Box((0, 0), (2, 2)),
            ],
        )
    report = w.run(0.5)
    np.testing.assert_array_equal(w.position, x)
    np.testing.assert_array_equal(w.velocity, 0.0)
    assert not report.flags and np.isfinite(report.energy)


class Chains:
    """All D cases as chains of one world, with g = 9.81."""

    def __init__(self, world, **settings):
        self.names = [name for name in CASES if name.startswith("D0")]
        x, mass, pairs = zip(*(pendulums(name) for name in self.names), strict=True)
        begin = np.cumsum([0, *map(len, x)])
        self.parts = [slice(a, b) for a, b in zip(begin[:-1], begin[1:], strict=True)]
        self.mass = np.concatenate(mass)
        self.mass[begin[:-1]] = 0  # of the anchors, in sums
        self.links = tv.Distance(np.concatenate([p + k for p, k in zip(pairs, begin, strict=False)]))
        start = tv.Particles(np.vstack(x), mass=np.concatenate(mass), pinned=begin[:-1])
        self.world = world(start, [tv.Gravity(9.81), self.links], precision="f64", **settings)

    def energies(self):
        """Of each chain [J], and m g L, what gravity can supply in a swing."""
        w = self.world
        each = self.mass * (0.5 * (w.velocity**2).sum(axis=1) + 9.81 * w.position[:, 1])
        reach = np.linalg.norm(np.diff(w.particles.position, axis=0), axis=1)
        return [(each[p].sum(), 9.81 * self.mass[p].sum() * reach[p.start : p.stop - 1].sum()) for p in self.parts]


@pytest.mark.parametrize("solver", [None, tv.Jacobi()])
def test_12_one_substep_of_a_tenth_of_a_second(world, solver):
    # Bounded: finite, and no more energy than there was, give or take the resolution, half of m g L of the whole chain. One pass
    # of 0.1 s holds a heavy end about as well as a rubber band would, which is what the residual says.
    chains = Chains(world, substeps=1, solver=solver)
    w, x = chains.world, chains.world.particles.position
    assert repr(w._solver) == ("Jacobi(relaxation=1)" if solver else "Direct(width=2)")
    start = [energy for energy, _ in chains.energies()]
    for iterations in (1, 20):
        w.position, w.velocity = x, np.zeros_like(x)
        w.iterations = iterations
        for _ in range(100):
            report = w.step(0.1)
            assert np.isfinite(w.position).all() and "non-finite" not in report.flags
            for (now, most), begin, name in zip(chains.energies(), start, chains.names, strict=True):
                assert now <= begin + 0.5 * most, (name, iterations)
    if solver:
        # Rows 1 and 2: one Jacobi pass cannot hold a heavy end. It is as far off as that of the prototype, to six digits, and the
        # residual, which is what a ruler measures, says so.
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


def test_15_17_links_without_direction(world):
    # Zero rest length: a spring to a point. Coincident, and 1e-20 apart: no NaN. Coincident at x_n but apart after: it works.
    x = np.array([[0.0, 0], [0, 0], [1, 0], [1 + 1e-20, 0], [2, 0], [2, 0], [3, 0], [3.5, 0]])
    pairs = [[0, 1], [2, 3], [4, 5], [6, 7]]
    rest = [0.0, 0.0, 0.5, 0.0]
    for precision in ("f32", "f64"):
        start = tv.Particles(x, velocity=[[0, 0]] * 5 + [[0, 3.0]] + [[0, 0]] * 2)
        w = world(start, [tv.Distance(pairs, rest, compliance=[0, 0, 0, 0.01])], precision=precision)
        w.run(1.0)
        assert np.isfinite(w.position).all()
        np.testing.assert_allclose(w.position[:4], x[:4], atol=1e-15)
        assert tv.measure.strain(w, [[4, 5]], [0.5])[0] == pytest.approx(0, abs=1e-3)
        assert abs(w.position[7, 0] - w.position[6, 0]) <= 0.5 + 1e-6


def test_18_a_whip_falls_back_and_says_so(world):
    x, mass, pairs = pendulums("D06_chain100")
    w = world(
        tv.Particles(x, mass=mass, pinned=[0]),
        [tv.Gravity(9.81), tv.Distance(pairs)],
        substeps=4,
        iterations=10,
        precision="f64",
        solver=tv.Jacobi(),
    )
    report = w.run(1.5)
    assert np.isfinite(w.position).all() and "turned" in report.flags
    assert "more substeps" in " ".join(report.notes)
    assert w.last.energy <= 9.81 * mass[1:] @ x[1:, 1] + 1e-2


def test_36_nothing_and_almost_nothing(world):
    for x in (np.zeros((0, 2)), np.zeros((0, 3)), [[1.0, 2.0]]):
        for path in ("fused", "parallel"):
            features = [
                tv.Gravity(),
                tv.Drag(1.0),
                tv.Distance(np.zeros((0, 2), int)),
                tv.Contact(),
                tv.Box([-9] * np.shape(x)[1], [9] * np.shape(x)[1]),
            ]
            w = world(tv.Particles(x, radius=0.1), features, path=path)
            report = w.run(0.1)
            assert w.position.shape == np.shape(x) and report.clean and w.explain() and len(w.hash()) == 64
    w = world(tv.Particles([[1.0, 2.0]]))
    w.run(0.1)
    np.testing.assert_array_equal(w.position, [[1.0, 2.0]])


def test_37_a_million_particles(world):
    rng = np.random.default_rng(0)
    side = 1000
    i = np.arange(side * side)
    x = np.stack([i % side, i // side], axis=1) * 1.05 + 0.5 + rng.uniform(0, 0.02, (side * side, 2))
    w = world(tv.Particles(x, radius=0.5), [tv.Gravity(), tv.Contact(), tv.Box((0, 0), (1100, 1200))], substeps=2)
    report = w.step(1 / 60)
    assert report.clean and w.path == ("parallel" if tv.runtime.cores() > 1 else "fused")
    assert sum(w.fields.values()) <= 200 * len(x)


def test_48_deep_overlap_does_not_explode(world):
    # 200 particles in a tenth of the room that they need: kinetic energy stays at the scale of push_out.
    rng = np.random.default_rng(0)
    w = world(tv.Particles(rng.uniform(0, 0.5, (200, 2)), radius=0.1), [tv.Contact(push_out=0.5)])
    w.run(1.0)
    assert np.isfinite(w.position).all() and w.last.overlap < 0.2
    # The rim is pushed by the 8 to 10 particles between it and the middle, each growing by at most push_out.
    assert tv.measure.kinetic_energy(w) <= 0.5 * 200 * (10 * 0.5) ** 2


def test_50_51_52_nan_is_flagged_on_its_frame(world):
    # A force that returns NaN from some time on. Walls would clamp NaN to their side, but the flag names the particle at once.
    @ti.func
    def bad(x, v, t, i):
        f = 0.0 * x
        if t > 0.099 and i == 3:
            f[0] = ti.sqrt(-1.0 - x[0] * x[0])
        return f

    for precision, path in (("f32", "fused"), ("f64", "parallel")):
        start = tv.Particles(np.arange(12.0).reshape(6, 2), radius=0.1)
        features = [tv.Force(bad), tv.Contact(), tv.Box((-9, -9), (99, 99))]
        w = world(start, features, precision=precision, path=path, substeps=4)
        reports = [w.step(0.05) for _ in range(4)]
        assert [("non-finite" in r.flags, r.bad) for r in reports] == [(False, None)] * 2 + [(True, 3)] * 2
        assert "particle 3" in reports[-1].notes[0] and not reports[-1].clean


def test_29_out_of_range_is_flagged(world):
    w = world(tv.Particles([[0.0, 0.0]], velocity=(1e16, 0)), [tv.Drag(0.0)])
    assert "out-of-range" in w.step(1.0).flags
    w = world(tv.Particles([[0.0, 0], [1, 0]], radius=0.1, velocity=(1e6, 0)), [tv.Contact()], substeps=1)
    assert "out-of-range" in w.step(1.5).flags


def test_61_gravity_from_nothing_to_a_million(world):
    gravity = tv.Gravity(0.0)
    w = world(tv.Particles([[0.0, 0.0]]), [gravity], precision="f64", substeps=3)
    for g in (0.0, 1e6, -1e6):
        gravity.g = g
        rerun(w, 0.5, dt=0.1)
        assert w.position[0, 1] == pytest.approx(-g * 0.125, rel=1e-13)


def test_62_forces_that_are_too_stiff_are_named(world):
    # omega h = 2.2 grows without bound; the note gives a number of substeps that is stable, and it is.
    @ti.func
    def stiff(x):
        return -1e6 * x

    w = world(tv.Particles([[1e-6, 0.0]]), [tv.Force(stiff)], substeps=4, precision="f64")
    h = 2.2e-3
    flagged = [w.step(4 * h) for _ in range(3)]
    assert "stiff-force" in flagged[-1].flags
    note = next(n for n in flagged[-1].notes if "omega h" in n)
    need = int(note.split("at least ")[1].split(" ")[0])
    assert 5 <= need <= 6
    rerun(w, 1.0, dt=4 * h, substeps=need)
    assert w.last.clean and abs(w.position[0, 0]) < 1e-5


def test_67_particles_outside_still_collide(world):
    # Outside an open box, beyond any grid: contacts do not need a domain.
    w = world(
        tv.Particles([[-50.0, 0], [-50.5, 0.0]], velocity=[[-1, 0], [1, 0]], radius=0.2),
        [tv.Contact()],
        precision="f64",
    )
    w.run(1.0)
    assert abs(w.position[0, 0] - w.position[1, 0]) >= 0.4 - 1e-9


def test_11_microsecond_steps_in_f32(world):
    # h = 1e-6 at 10 m: d stays below half an ulp of x, 4.8e-7, for the first 0.05 s. Without the dither nothing would fall.
    for precision in ("f32", "f32-compensated"):
        w = world(tv.Particles([[0.0, 10.0]]), [tv.Gravity(9.81)], substeps=10_000, precision=precision)
        w.run(0.2, dt=0.01)
        drop = 9.81 * 0.2**2 / 2
        assert abs(10 - w.position[0, 1] - drop) <= 1e-3 * drop


def test_34_thousands_in_one_cell(world):
    # Correct, n^2, warned of, and nothing overflows.
    n = 4096
    x = np.random.default_rng(0).uniform(0, 0.01, (n, 2))
    w = world(tv.Particles(x, radius=0.5), [tv.Contact()])
    with pytest.warns(UserWarning, match="near pairs per particle"):
        w._list()
    np.testing.assert_array_equal(w._grid.number.to_numpy(), n - 1)
    assert w._grid.need[None] * w._grid.blocks >= n * (n - 1)
