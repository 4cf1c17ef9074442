"""Every known answer of cases.json is reached, with the order and within the error that its case states; the law of a pass."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.report import CASES


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_case_reaches_its_known_answer(name):
    # Where the first method solves all, no order shows; then the second shows it, in short substeps.
    some = {"precisions": ("f64",), "baselines": False, "runs": 1}
    case = CASES[name]
    found = tv.report.error_vs_time([name], methods=case.methods[:1], quick=True, **some)
    if found.failures and case.order and found.order(name, case.methods[0]) is None:
        found = tv.report.error_vs_time([name], methods=case.methods, **some)
    assert not found.failures and not found.missing and len(found.points) > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["D06_chain100", "D08_massratio10", "S04_spring_pendulum", "S05_tennis_racket", "R16_bounce_e0.5"]
)
def test_f32_keeps_the_error_of_a_case(name):
    found = tv.report.error_vs_time([name], methods=CASES[name].methods[:1], efforts=[CASES[name].at], baselines=False, runs=1)
    assert not found.failures and {p.precision for p in found.points} == {"f32", "f64"}


def test_one_pass_sags_by_the_law(world):
    # A rigid chain of N links with masses m, one pass: link k carries k m g, and gives way by W h^2 times that, 4 k g h^2 inside.
    # All masses but the anchor fall by g h^2 before the pass, so the anchor's link gives way by that much less. With drag h^2 is
    # phi h^2.
    n, h = 100, 1 / 1200
    hh = h * -np.expm1(-20 * h) / 20
    weight = np.where(np.arange(n) == 0, 2.0, 4.0)  # W = 2 w + 2 w, but 2 w at the anchor, and 2 w + w at the free end
    weight[-1] = 3.0
    stretch = weight * (n - np.arange(n)) * 9.81 * hh
    stretch[0] -= 9.81 * hh
    y = -np.concatenate([[0.0], np.cumsum(0.01 + stretch * 0.9)])
    start = tv.Particles(np.stack([np.zeros(n + 1), y], axis=1), mass=0.01, pinned=[0])
    link = tv.Distance(np.stack([np.arange(n), np.arange(n) + 1], axis=1), 0.01)
    w = world(start, [tv.Gravity(9.81), link, tv.Drag(20.0)], precision="f64", solver=tv.Jacobi())
    w.run(4.0)
    np.testing.assert_allclose(-np.diff(w.position[:, 1]) - 0.01, stretch, rtol=1e-5)
    np.testing.assert_allclose(link.residual, stretch / 0.01, rtol=1e-5)
    np.testing.assert_allclose(link.load, 0.01 * 9.81 * (n - np.arange(n)), rtol=1e-5)
