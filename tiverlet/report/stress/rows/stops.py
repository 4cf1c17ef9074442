"""Rows about springs of a grid, stops of joints, dampers, and what breaks."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from ....constraints import AngleLimit, Distance, Snap
from ....forces import Gravity
from ....measure import angular_momentum
from ....particles import Particles
from ....solvers import Jacobi
from ....step.step_report import UNCONVERGED, StepReport
from .row import Findings, at_most, excused, finite, row, world

DECADES: Any = 10.0 ** np.arange(-12, 4)


@row(109, "a grid of compliances from 1e-12 to 1e3 m/N",
     "a cos(omega t) where a substep resolves it, never beyond the start; no energy")  # fmt: skip
def _grid() -> Findings:
    n, a = len(DECADES), 0.3
    x = np.stack([np.arange(n) + a, np.zeros(n)], axis=1)
    with world(Particles(x), [Snap(np.arange(n), 1.0, compliance=DECADES)], substeps=40) as w:
        supplied, most, far = (a**2 / (2 * DECADES)).sum(), -np.inf, 0.0
        for _ in range(60):
            report = w.step(1 / 60)
            most = max(most, report.energy / supplied - 1)
            far = max(far, np.abs(w.position[:, 0] - np.arange(n)).max() / a - 1)
        omega = 1 / np.sqrt(DECADES)
        resolved = omega / 2400 < 0.05
        error = np.abs(w.position[:, 0] - np.arange(n) - a * np.cos(omega))[resolved].max()
        yield at_most(f"a cos(omega t) to {error:.0e} m", error, 1e-2, finite(w))
        yield at_most(f"energy {most:+.0e}", most, 0.0)
        yield at_most(f"reach {far:+.0e}", far, 1e-12)


def reached(alpha: float, heavy: float, *omegas: float) -> Iterator[tuple[float, list[StepReport], float]]:
    """Turn a joint of masses 1 : heavy towards its stop of 0.5 rad.

    Yields the speed [rad/s], the reports, and the share of angular momentum that is lost.
    """
    start = Particles([[-1.0, 0], [0, 0], [1, 0]], mass=[heavy, heavy, 1.0])
    with world(start, [Distance([[0, 1], [1, 2]]), AngleLimit([[0, 1, 2]], -0.5, 0.5, compliance=alpha)]) as w:
        for omega in omegas:
            w.position, w.velocity = start.position, [[0, 0], [0, 0], [0, omega]]
            turning = angular_momentum(w)
            reports = [w.step(1 / 60) for _ in range(60)]
            yield omega, reports, float(np.abs((angular_momentum(w) - turning) / turning).max()) if finite(w) else np.inf


@row(110, "joints that reach their stop at 1 and 30 rad/s, masses of 1 : 1e6, stops of 0 ... 1e-2 rad/(N m)",
     "no energy, angular momentum kept, the stop holds")  # fmt: skip
def _stops() -> Findings:
    for alpha, limit in ((0.0, 3e-4), (1e-9, 3e-4), (1e-2, 1e-3)):
        gains, drifts, beyond = [], [], []
        for heavy in (1.0, 1e6):
            for omega, reports, drift in reached(alpha, heavy, 1.0, 30.0):
                gains.append(max(r.energy for r in reports) / (0.5 * omega**2) - 1)
                drifts.append(drift)
                beyond.append(max(r.residual for r in reports))
        yield at_most(f"{alpha:g}: energy {max(gains):+.0e}", max(gains), limit)
        yield at_most(f"angular momentum {max(drifts):.0e}", max(drifts), 1e-12)
        yield at_most(f"{max(beyond):.0e} beyond the stop", max(beyond), 1e-7)


@row(130, "the same at 1e4 rad/s, 8 rad in a substep", "no energy, and what is not met is excused by a flag",
     known="a joint that reaches its stop by several radians in a substep draws its links out")  # fmt: skip
def _fast_stops() -> Findings:
    for alpha in (0.0, 1e-2):
        for heavy in (1.0, 1e6):
            for omega, reports, _ in reached(alpha, heavy, 1e4):
                name, off = f"{alpha:g}, 1 : {heavy:g}", max(r.residual for r in reports)
                yield f"{name}: off by {off:.2g}", all(excused(r, "residual", UNCONVERGED) for r in reports)
                gain = max(r.energy for r in reports) / (0.5 * omega**2) - 1
                yield f"{name}: energy {gain:+.0e}", gain <= 0.0


@row(111, "damping of 1e-9 ... 1e9 N s/m of a link of 100 N/m", "the closed form of the damped oscillator; no energy")
def _damped() -> Findings:
    c = 10.0 ** np.arange(-9.0, 10)
    k, n, t = 100.0, len(c), 0.5
    x = np.stack([np.tile(np.arange(float(n)), 2), np.repeat([0.0, -1.1], n)], axis=1)
    pairs = np.stack([np.arange(n), np.arange(n) + n], axis=1)
    with world(Particles(x, pinned=np.arange(n)), [Distance(pairs, 1.0, compliance=1 / k, damping=c)], solver=Jacobi()) as w:
        reports = [w.step(1 / 60) for _ in range(30)]
        root = np.sqrt(c.astype(complex) ** 2 / 4 - k)
        slow = -k / (c / 2 + root)  # of the two roots of s^2 + c s + k, without cancellation
        fast = -c / 2 - root
        want = 0.1 * ((fast * np.exp(slow * t) - slow * np.exp(fast * t)) / (fast - slow)).real
        error = float(np.abs(-1 - w.position[n:, 1] - want).max())
        gain = max(r.energy for r in reports) / (0.5 * k * 0.01 * n) - 1
    yield at_most(f"{error:.0e} m", error, 1e-5)
    yield at_most(f"energy {gain:+.0e}", gain, 0.0)


@row(112, "chains under loads of 1e-5 ... 1e7 N that break at half of the largest",
     "the most loaded link breaks, all below falls freely from the substep after; no energy")  # fmt: skip
def _breaks() -> Findings:
    n, counts, errors, gains = 10, [], [], []
    x = np.stack([np.zeros(n + 1), -0.1 * np.arange(n + 1)], axis=1)
    for mass in (1e-7, 1.0, 1e5):
        link = Distance(np.stack([np.arange(n), np.arange(n) + 1], axis=1), break_at=5.5 * mass * 9.81)
        with world(Particles(x, mass=mass, pinned=[0]), [Gravity(9.81), link], substeps=40) as w:
            reports = [w.step(1 / 60) for _ in range(30)]
            counts.append(sum(r.broken for r in reports))
            first = reports[0].energy - reports[0].energy_change
            gains.append(max(r.energy - first for r in reports) / (mass * 9.81 * n))
            errors.append(float(np.abs(w.position[1:, 1] - x[1:, 1] + 9.81 * 0.25 / 2).max()))
    yield f"{counts} links break", counts == [1, 1, 1]
    yield at_most(f"fall to {max(errors):.0e} m", max(errors), 9.81 * 0.5 / 2400)  # g t h
    yield at_most(f"energy {max(gains):+.0e} m g L", max(gains), 1e-12)
