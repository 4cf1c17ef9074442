"""Rows about what is driven: motors and winches, fast, strong, weak, and beside contacts."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from ....constraints import Distance, Motor, Winch
from ....contact import Contact
from ....features.feature import Feature
from ....forces import Gravity
from ....particles import Particles
from ....step.step_report import UNCONVERGED
from .row import INF, Findings, at_most, excused, finite, row, world

G = 9.81


@contextmanager
def arm(g: float, speed: float, torque: float = INF, *more: Feature, **settings) -> Iterator[Any]:
    """Provide the world of a mass of 1 kg on an arm of 1 m that a motor turns from the horizontal."""
    start = Particles([[-1.0, 0], [0, 0], [1, 0]], radius=0.01, pinned=[0, 1])
    with world(start, [Gravity(g), Distance([[1, 2]]), Motor([[0, 1, 2]], speed, torque=torque), *more], **settings) as w:
        yield w


def held(*more: Feature) -> Findings:
    """Turn arms by torques near that of their weight, and by ones that a weight of 0 cannot resist, for closed forms."""
    for part, limit in ((0.5, 5e-5), (0.99, 2e-7)):
        with arm(G, 0.1, part * G, *more) as w:
            w.run(0.05)
            fall = 0.5 * G * (1 - part) * 0.05**2
            yield at_most(f"{part} m g L: falls by {-w.position[2, 1]:.2g} m", abs(w.position[2, 1] / -fall - 1), limit)
    with arm(G, 0.1, 1.01 * G, *more) as w:
        w.run(0.5)
        yield at_most(f"1.01 m g L: rises by {w.position[2, 1]:.3f} m", abs(w.position[2, 1] / (0.01 * G * 0.125) - 1), 1e-3)
    errors = []
    for torque in (1e-6, 1e-3, 1.0, 100.0):
        with arm(0.0, 1e6, torque, *more, substeps=100) as w:
            w.run(0.5)
            turned = torque * 0.5**2 / 2
            errors.append(np.abs(w.position[2] - [np.cos(turned), np.sin(turned)]).max() / turned)
    yield at_most(f"free, torques of 1e-6 ... 100 N m: T t^2 / 2 to {max(errors):.0e}", max(errors), 3e-4)


def turned(omega: float, turn: float) -> tuple[float, float, bool]:
    """Turn an arm for 0.1 s, by at most `turn` [rad] a substep. Returns the error of its angle [rad], and the worst residual and
    whether it is excused."""
    with arm(0.0, omega, substeps=int(np.ceil(omega / 60 / turn))) as w:
        reports = [w.step(1 / 60) for _ in range(6)]
        now = np.arctan2(w.position[2, 1], w.position[2, 0])
    off = max(r.residual for r in reports)
    return abs(np.angle(np.exp(1j * (now - 0.1 * omega)))), off, all(excused(r, "residual", UNCONVERGED) for r in reports)


@row(104, "motors at 1 ... 1e4 rad/s", "omega t where a substep turns by 0.1 rad, flagged where it turns by 0.8 rad")
def _fast() -> Findings:
    errors = [turned(omega, 0.1)[0] for omega in (1.0, 1e2, 1e4)]
    yield at_most(f"angle to {max(errors):.0e} rad", max(errors), 5e-5)
    for omega in (1e2, 1e4):
        _, off, said = turned(omega, 0.8)
        yield f"0.8 rad a substep: off by {off:.2g}, {'excused' if said else 'not excused'}", said


@row(125, "a motor at 1e4 rad/s in 20 substeps, 8 rad in each", "as far as a flag excuses it, its arm keeps its length",
     known="a motor that turns by more than half a turn in a substep draws its arm out to a thousand lengths")  # fmt: skip
def _too_fast() -> Findings:
    _, off, said = turned(1e4, 1e4 / 1200)
    yield f"off by {off:.2g}", said


@row(105, "torques of 1e-6 ... 100 N m, and near that of a weight",
     "T t^2 / 2 alone; below m g L an arm falls with what is left, above it rises")  # fmt: skip
def _weak() -> Findings:
    return held()


@row(106, "the same beside contacts that touch nothing", "the same closed forms")
def _weak_beside() -> Findings:
    return held(Contact())


def wound(*more) -> Findings:
    """Hang masses on winches that are too weak, strong enough, very fast, and on masses of 1e-6 ... 1e6 kg."""
    mass = np.array([1e-6, 1.0, 1e6])
    x = np.array([[k, y] for y in (0.0, -10.0) for k in range(3)])
    start = Particles(x, mass=np.r_[mass, mass], radius=0.01, pinned=[0, 1, 2])
    winch = Winch([[0, 3], [1, 4], [2, 5]], 0.0, shortest=0.5)
    with world(start, [Gravity(G), winch, *more]) as w:
        for part in (0.0, 0.5, 2.0):
            w.position, w.velocity, winch.force, winch.speed = x, 0 * x, part * G * mass, -1e6
            w.run(0.5)
            error = np.abs((w.position[3:, 1] + 10) / (0.5 * G * (part - 1) * 0.25) - 1).max()
            yield at_most(f"force of {part:g} m g: (F / m - g) t^2 / 2 to {error:.0e}", error, 1e-12)
    for speed in (1.0, 1e3):
        with world(start, [Gravity(G), Winch([[0, 3], [1, 4], [2, 5]], -speed, shortest=0.5), *more]) as w:
            seconds = 9.0 / speed
            w.run(seconds, dt=seconds / 10)
            error = np.abs(w.position[3:, 1] + 10 - 9.0).max()
            yield at_most(f"rigid, {speed:g} m/s: v t to {error:.0e} m", error, 1e-12)
            highest = max(w.step(1 / 60).energy for _ in range(120)) / mass.sum()
            yield f"then {highest:.3g} J/kg", finite(w) and highest <= 0.5 * speed**2 - 0.5 * G


@row(107, "winches of 0 ... 2 times the weight, and of 1 m/s and 1 km/s, with masses of 1e-6 ... 1e6 kg",
     "(F / m - g) t^2 / 2; v t; at the shortest length no more energy than at the speed")  # fmt: skip
def _winch() -> Findings:
    return wound()


@row(108, "the same winches beside contacts that touch nothing", "the same closed forms")
def _winch_beside() -> Findings:
    return wound(Contact())
