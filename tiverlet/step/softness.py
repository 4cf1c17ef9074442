"""Softness: keeps links as stiff as they are where a loop measures dt, so that nets come to rest in frames of uneven length.

A pass holds a load F by a violation Z = s W h^2 F, beside that of its compliance, like a spring of stiffness 1 / (s W h^2). The
softness s is 1, and the stiffness changes with h. So the place where a net rests would be another one in each frame, and its
weight would not be balanced: frames that differ by a fifth keep a net of 1 m moving at 0.2 m/s, however well it is damped. Moving
positions to the new place, as in projection.py, takes long, and lifts the net again and again. Instead,

    s' h'^2 = s h^2,  s' >= 1

s is 1 again in a substep that is longer than all before, which takes energy out. So links are as soft as in the longest recent
substep. Once frames are even, or none has been about as long for HOLD, s approaches 1, (s - 1)' = -(s - 1) / SETTLE, which lifts
what sags. This adds a share dt / SETTLE of the stored energy in a frame at most, and waits where the scene would have more energy
than ever. Where contacts keep their stiffness, too, stretched links do not press on them, and nothing has to move.

Links are projected instead after a frame in which the machine was busy (MOST), or where substeps get much shorter (LEAST). So are
springs with alpha near W h^2, which hold their loads by alpha + (1 + 3 theta) s W h^2 / 4: s h^2 does not keep that. And so are

- all links of a scene in which any may break (`break_at`): velocities lack g (h_old - h) / 2 at a start. What that makes vibrate
  changes loads: those of rigid angles by 3, 14 and 24 % at the ends of frames, after h = h_old / 1.2, / 2 and / 4;
- links that passes hold with hardly a violation (CONVERGED): these need no softness, and passes converge s times as slowly then.
"""

from math import exp
from typing import TYPE_CHECKING, Any

import numpy as np

from ..constraints.core.anchored import Anchored
from ..constraints.core.scalar import Scalar
from ..particles import LARGEST
from .projection import is_slight

if TYPE_CHECKING:
    from .runner import Runner

LEAST, MOST = 0.2, 2.2  # of the substep whose stiffness links have: the shortest and the longest one after which they keep it
NEAR = 0.8  # of that substep: a substep about as long
HOLD, SETTLE = 1.0, 1.0  # how long links stay soft, and the time constant with which they stiffen then [s]
SETTLED = 1e-3  # excess of s that is dropped
CONVERGED = 1e-3  # of the violations W h^2 F that one pass leaves: with less, links rest in the same place whatever h is
HALF_RESOLVED = 0.2, 4.0  # (omega h)^2 between which theta depends on h
BUSY = -1.0  # clock.softened after a frame longer than MOST


def can_keep(runner: "Runner", h: float, dt: float, substeps: int, contacts_keep: bool) -> bool:
    """Whether links keep their stiffness where the coming frame of dt [s] has substeps h [s].

    contacts_keep: whether contacts do, see Contact.keep_stiffness(). A change of `substeps` is made to change the stiffness.
    """
    clock, slots = runner.clock, runner.scene.slots
    if (
        not (slots and slots.can_soften)
        or any(b.breaks for b in runner.batches)
        or runner.paths
        or runner.probe
        or not clock.h
        or clock.first_moved == 0
        or dt == clock.frame[1]
    ):
        return False
    kept = clock.h * clock.softness**0.5
    if round(clock.frame[1] / clock.h) != substeps or not LEAST * kept <= h <= MOST * kept or clock.softened == BUSY:
        return False
    if not (contacts_keep or not runner.step.contacts) or has_half_resolved_springs(runner, max(h, kept)):
        return False
    return clock.softness > 1 or h > clock.h or not _converges(runner)


def keep(runner: "Runner", ratio: float, dt: float) -> None:
    """Keep links as soft as they are, where the coming frame dt [s] has substeps `ratio` times as long as the last one."""
    clock, softness = runner.clock, runner.clock.softness
    if ratio != 1 and ratio**2 >= NEAR**2 * softness:
        clock.softened = clock.time
    elif softness > 1 and clock.time > clock.softened + HOLD:
        stiffer = 1 + (softness - 1) * exp(-dt / SETTLE)
        if is_slight(clock, _stored(runner), (stiffer / softness) ** 0.5):
            softness = stiffer
    softness /= ratio**2
    runner.set_softness(softness if softness > 1 + SETTLED else 1.0)
    clock.longest = ratio * clock.h * clock.softness**0.5


def end(runner: "Runner", h: float) -> None:
    """Make links as stiff as passes of substeps h [s] make them, after they were projected."""
    clock = runner.clock
    clock.softened = BUSY if h > MOST * clock.h * clock.softness**0.5 > 0 else 0.0
    runner.set_softness(1.0)


def _borne_by(batch: Scalar, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the loads F of constraints [N], (m,), and |F Z| of their violations at x (n, dim) [m], beside that of compliance."""
    F = batch.load
    return F, np.maximum(np.abs(F * batch.violation(x)) - batch.compliance * F * F, 0.0)


def _stored(runner: "Runner") -> float:
    """Return the energy that violations of scalar constraints store, beside that of their compliance: sum |F Z| / 2 [J]."""
    x = runner.scene.state.get(runner.memory)
    return sum(float(_borne_by(b, x)[1].sum()) / 2 for b in runner.batches if isinstance(b, Scalar) and b.count)


def _converges(runner: "Runner") -> bool:
    """Whether passes have left less than CONVERGED of the violations that one pass would: of the energy that these store."""
    stored, of_one_pass, x, h = 0.0, 0.0, runner.scene.state.get(runner.memory), runner.clock.h
    if not (np.abs(x) < LARGEST).all():  # or NaN
        return False
    sags = runner.scene.slots.sags(runner.scene.inv_mass, runner.batches)
    for b in runner.batches:
        if isinstance(b, Scalar) and b.count:
            F, energy = _borne_by(b, x)
            some = np.bincount(b.owner, sags[b.indices.ravel()], minlength=b.count) > 0
            stored += float((energy * some).sum())
            of_one_pass += float((_weights(b) * (h * F) ** 2 * some).sum())
    return stored < CONVERGED * of_one_pass


def has_half_resolved_springs(runner: "Runner", h: float) -> bool:
    """Whether passes solve springs that substeps h [s] neither resolve nor see as stiff, see stiff()."""
    for b in runner.batches:
        if b.soft and b.count:
            key = b, id(b.start)  # many worlds share a batch, and have masses of their own
            if key not in runner.weights_alone:
                runner.weights_alone[key] = _weights(b) * (runner.scene.slots.rows(b) < 0)
            square = runner.weights_alone[key] * h * h
            if ((square > HALF_RESOLVED[0] * b.compliance) & (square < HALF_RESOLVED[1] * b.compliance)).any():
                return True
    return False


def _weights(batch: Any) -> np.ndarray:
    """Return the inverse mass with which each constraint of a batch vibrates, (m,): w |grad C|^2, or that of a cluster."""
    if isinstance(batch, (Scalar, Anchored)):
        return batch.weights(batch.start.position)
    return 1 / np.bincount(batch.owner, batch.start.mass[batch.indices.ravel()], minlength=batch.count)
