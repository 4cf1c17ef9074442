"""Softness: what links hold by violations stays as stiff as it was where substeps get shorter, so that no energy comes of it.

A pass holds a load F by a violation C = s W h^2 F, beside that of its compliance, like a spring of stiffness 1 / (s W h^2); n
passes hold it by an n-th of that. The softness s is 1. A shorter substep would make that spring stiffer while it is stretched,
and its energy (h / h')^2 times as large. So stiffness is state: links are as soft as in a substep of the length `longest`,

    s = (longest / h)^2

and nothing has to move. Substeps keep their length from frame to frame, to rounding of their number (Pace in clock.py); so where
frames are uneven, links are always as soft as in the longest substep so far, and a net rests in one place. Where the user sets
another number of substeps, "auto" does, or after a frame that was far too late, s is larger at first, and approaches that by
(s - 1)' = -(s - 1) / SETTLE, which lifts what sags. So a frame adds a share dt / SETTLE of the energy that violations store, but
not while the scene would have more energy than ever.

Parts of systems that gave way in a longer substep bear no larger tensions than in that one, see Elimination. In each frame these
grow by half of what the energy allows.
"""

from math import exp
from typing import TYPE_CHECKING, Any

import numpy as np

from ..constraints.core.anchored import Anchored
from ..constraints.core.scalar import Scalar
from ..particles import LARGEST
from .clock import CHANGED
from .solids import Solids

if TYPE_CHECKING:
    from .runner import Runner

NEAR = 0.6  # of a substep: one that is about as long; where two are set, they are from 3/4 to 5/4 as long in uneven frames
SETTLE = 0.5  # time constant with which soft links stiffen [s]
CONVERGED = 1e-3  # of the violations that one pass leaves: with less, passes hold loads in the same place whatever h is
TINY = 1e-4  # of its size: a violation that needs no care, in a substep as long as the last one
SETTLED = 1e-3  # excess of s that is dropped
SLIGHT = 5e-4  # of the largest kinetic energy: what may be more than ever


def acts(runner: "Runner", h: float, iterations: int) -> bool:
    """Whether links bear their loads as before where the coming frame has substeps h [s] of so many passes.

    Then a start must begin with velocities that users read: others lack half a kick of what bears a load, which only rigid links
    supply at once.
    """
    clock, slots = runner.clock, runner.scene.slots
    if not (slots and slots.sags_anywhere and clock.h) or runner.probe or clock.first_moved == 0:
        return False
    return clock.softness > 1 or h < clock.longest or _growth(runner, h, iterations) < 1


def _growth(runner: "Runner", h: float, iterations: int) -> float:
    """Return by how much a violation grows that bears a load in so many passes of substeps h [s]."""
    return (h / runner.clock.h) ** 2 * runner.clock.iterations / iterations


def keep(runner: "Runner", h: float, dt: float, iterations: int, adapts: bool = False, left: float = 1.0) -> None:
    """Keep links as soft as they are where the coming frame of dt [s] has so many passes of substeps h [s], but for what they
    stiffen in a frame.

    adapts: whether substeps are chosen for accuracy. Then links stiffen as far as the energy allows. left: the part of what they
    stored that is left, where violations have just settled. By so much links may stiffen at once.
    """
    clock, system = runner.clock, runner.scene.slots.system if runner.scene.slots else None
    clock.part_softness = system.softest if system else 1.0
    if acts(runner, h, iterations):
        soft = clock.softness * left / _growth(runner, h, iterations)
        clock.longest = clock.longest if NEAR * clock.longest <= h <= clock.longest else h
        least = (clock.longest / h) ** 2
        more = max(1.0, soft / least)
        if more > 1 and clock.softness == 1 and needs_no_care(runner, more * least):
            clock.longest, least, more = h, 1.0, 1.0
        if more > 1:
            more /= stiffening(runner, more, _stored_before(runner, left), dt, adapts)
        runner.set_softness(least * more if more > 1 + SETTLED else least)
    else:
        clock.longest = h
    if system and clock.part_softness > 1:
        system.stiffen((1 + stiffening(runner, clock.part_softness, _stored_before(runner, left), dt, adapts=True)) / 2)


def stiffening(runner: "Runner", s: float, store: float, dt: float, adapts: bool) -> float:
    """Return by what factor links of the softness s, which store so much [J], may stiffen in a frame of dt [s].

    adapts: whether the energy alone decides.
    """
    if not store > 0:
        return s
    most, room = s / (1 + (s - 1) * exp(-dt / SETTLE)), _room(runner)
    if room is not None:
        most = room / store if adapts else min(most, room / store)
    return max(1.0, min(s, most))


def _stored_before(runner: "Runner", left: float) -> float:
    """Return what relaxed links stored before they settled [J], as they do with the softness that keep() gives them, and what
    parts of systems store that gave way in a longer substep."""
    system, out = runner.scene.slots.system, stored(runner) / left if left > 0 else 0.0
    return out + system.stored / runner.clock.h**2 if system else out


def _room(runner: "Runner") -> float | None:
    """Return how much more energy the scene may have than now [J]; None where that is unknown."""
    clock = runner.clock
    if clock.energy is None or clock.bound is None or clock.bound == CHANGED:
        return None
    return clock.bound + SLIGHT * clock.kinetic - clock.energy


def needs_no_care(runner: "Runner", s: float) -> bool:
    """Whether links may be as stiff as passes make them at once, where they would be `s` times as soft.

    So it is where violations are tiny and nothing may break, or where passes have left less than CONVERGED of the violations that
    one pass would leave by the same loads.
    """
    memory, batches, w, h = runner.memory, runner.batches, runner.scene.inv_mass, runner.clock.h
    x = runner.scene.state.get(memory)
    if not (np.abs(x) < LARGEST).all():  # or NaN
        return False
    solids = Solids(batches, w)
    far = float(solids.far(x).max(initial=0.0)) if solids.count else 0.0
    if not any(b.soft or b.breaks for b in batches) and max(worst(batches, x), far) <= TINY / s:
        return True
    if any(isinstance(b, Anchored) or (b.clusters and b.soft) for b in batches) or not far <= CONVERGED * solids.worst:
        return False
    if worst(batches, x) > CONVERGED:  # an impact left it
        return False
    split, stores, one = memory.read(runner.scene.slots.split), 0.0, 0.0
    for b in batches:
        if isinstance(b, Scalar) and b.count:
            one += float((b.weights(x, split) * (h * b.load) ** 2).sum()) / 2
            stores += _stored_in(b, b.violation(x) * ~b.broken, np.zeros(b.count))
    return stores <= CONVERGED * one


def worst(batches: list[Any], x: np.ndarray) -> float:
    """Return the worst violation of links at x, (n, dim), as a share of its size."""
    out = 0.0
    for b in batches:
        if isinstance(b, Scalar) and b.count:
            C = b.violation(x) * b.inverse_size(b.start.position) * ~b.broken
            out = max(out, float((np.abs(C) if b.side == 0 else b.side * C).max(initial=0.0)))
    return out


def stored(runner: "Runner") -> float:
    """Return the energy that violations store beside that of compliance, sum s W lam^2 / 2 h^2 [J]."""
    memory, w, h, out = runner.memory, runner.scene.inv_mass, runner.clock.h, 0.0
    x, split = runner.scene.state.get(memory), memory.read(runner.scene.slots.split)
    for b in runner.batches:
        if isinstance(b, Scalar) and b.count:
            sag = runner.scene.slots.sag(b)
            S = sag * b.weights(x, split) * h * h / runner.clock.iterations
            out += _stored_in(b, b.violation(x) * (~b.broken & (sag > 0)), S)
        elif isinstance(b, Anchored) or b.clusters:
            who = b.indices.ravel()
            lam = memory.read(b.dev.lam if isinstance(b, Anchored) else b.dev.pull)[: len(who)].astype(np.float64)
            if b.clusters:  # the move of a corner by itself [m]
                lam *= np.divide(1, w[who], out=np.zeros(len(who)), where=w[who] > 0)[:, None]
            out += float((lam**2).sum(axis=1) @ split[who]) / (2 * h * h)
    return out


def _stored_in(b: Scalar, C: np.ndarray, S: np.ndarray) -> float:
    """Return the same for scalar constraints, which hold a load F by C = (alpha + S) F, sum (C - alpha F) F / 2 [J].

    F is the load of the last substep, or that of C, whichever stores more: a step that was taken back leaves the first at 0.
    """
    F = np.divide(np.where(C * b.side < 0, 0.0, C), b.compliance + S, out=np.zeros(b.count), where=S > 0)
    return float(np.maximum(S * F**2, np.abs(b.load * C) - b.compliance * b.load**2).sum()) / 2
