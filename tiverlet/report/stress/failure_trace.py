"""Trace a failure: the particle that shows it, the constraints and contacts at it, and the last states, as text or recording."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ... import checks
from ...features.feature import Batch
from ...step.checkpoint import keep, put_back
from ...step.step_report import StepReport
from ...world import World


@dataclass(frozen=True)
class Suspect:
    """A constraint or contact at the particle: its name, its particles, and its violation before the failure."""

    name: str
    members: tuple[int, ...]
    amount: float
    unit: str

    def __str__(self) -> str:
        particles = f", particles {self.members}" if len(self.members) < 9 else ""
        return f"{self.name}{particles}, off by {self.amount:.3g} {self.unit}"


@dataclass(frozen=True)
class Autopsy:
    """The first failure of a run. print() describes it, record(path) draws it; see .found.

    report: of the substep that failed, or None. frame, substep: counted from 0. particle: the one that shows the failure most.
    others: further particles that are not finite. suspects: constraints and contacts at the particle before that substep, the
    most violated first. times [s] (k,), positions [m] (k, n, dim): the last states, the failed one at the end.
    """

    report: StepReport | None
    frame: int
    substep: int
    particle: int | None
    others: tuple[int, ...]
    suspects: tuple[Suspect, ...]
    times: np.ndarray
    positions: np.ndarray

    @property
    def found(self) -> bool:
        """Whether there was a failure."""
        return self.report is not None

    def __str__(self) -> str:
        if self.report is None:
            return "Nothing went wrong."
        flags = ", ".join(sorted(self.report.flags))
        lines = [f"{flags} at t = {self.times[-1]:.6g} s, in substep {self.substep} of frame {self.frame}.", *self.report.notes]
        if self.particle is not None:
            lines.append(f"Particle {self.particle} shows it" + (f", then {self.others}." if self.others else "."))
            lines += [f"  {s}" for s in self.suspects] or ["  No constraint or contact acted on it: look at the forces."]
            lines.append("Its last states, t [s] and x [m]:")
            rows = zip(self.times, self.positions[:, self.particle], strict=True)
            lines += [f"  {t:.6g}  ({', '.join(f'{v:.6g}' for v in x)})" for t, x in rows]
        return "\n".join(lines)

    def record(self, path) -> None:
        """Write the last states for the rerun viewer, with the particle and its suspects in red."""
        import rerun as rr

        if not self.found:
            raise RuntimeError("Autopsy: nothing went wrong, so there is nothing to record.")
        from ...recording.layout import transform

        flat = self.positions.shape[2] == 2
        points, strips = (rr.Points2D, rr.LineStrips2D) if flat else (rr.Points3D, rr.LineStrips3D)
        stream: Any = rr.RecordingStream("tiverlet_autopsy")
        stream.save(os.fspath(path))
        stream.log(
            "world/scene", transform(np.array([0.0, 1.0]), 1.0) if flat else rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True
        )
        stream.log("about", rr.TextDocument(str(self)), static=True)
        for k, (t, x) in enumerate(zip(self.times, self.positions, strict=True)):
            stream.set_time("substep", sequence=k)
            stream.set_time("time", duration=float(t))
            good = np.isfinite(x).all(axis=1)
            stream.log("world/scene/particles", points(x[good], radii=-2.5, colors=[[140, 140, 150]]))
            red = [i for i in (self.particle, *self.others) if i is not None and good[i]]
            stream.log("world/scene/wrong", points(x[red], radii=-6.0, colors=[[240, 60, 50]], labels=[str(i) for i in red]))
            held = [x[list(s.members)] for s in self.suspects if len(s.members) > 1 and good[list(s.members)].all()]
            stream.log("world/scene/suspects", strips(held, colors=[[240, 60, 50]], radii=-2.0))
        stream.disconnect()


def autopsy(
    world: World, seconds: float, dt: float = 1 / 60, wrong: Callable[[StepReport], bool] | None = None, last: int = 8
) -> Autopsy:
    """Run a clone of a world until it fails, then run that frame again substep by substep.

    seconds, dt [s]: as in world.run(). wrong: report of a frame or substep -> whether it is a failure; by default, whether it has
    a flag. last: the number of states to keep. The world itself does not change. Targets stand still, so use a world shortly
    before the failure.
    """
    seconds = checks.number("autopsy", "seconds", seconds, above=0.0)
    dt = checks.number("autopsy", "dt", dt, above=0.0)
    last = checks.integer("autopsy", "last", last, least=1)
    wrong = wrong or (lambda report: bool(report.flags))
    with world.clone() as w:
        for frame in range(max(1, round(seconds / dt))):
            kept = keep(w)
            seen = w.step(dt)
            if wrong(seen):
                put_back(w, kept)
                return dissect(w, dt, seen, frame, wrong, last)
    none = np.zeros(0)
    return Autopsy(None, 0, 0, None, (), (), none, np.zeros((0, len(world.particles), world.particles.dim)))


def dissect(w: World, dt: float, seen: StepReport, frame: int, wrong, last: int) -> Autopsy:
    """Run the frame again one substep at a time, bit for bit, until it fails. seen: the report of the frame."""
    substeps, w.substeps = seen.substeps, 1
    times, states, report, substep = [w.time], [w.position], seen, 0
    kept = keep(w)
    for substep in range(substeps):
        kept = keep(w)
        report = w.step(dt / substeps)
        times.append(w.time)
        states.append(w.position)
        if wrong(report):
            break
    x = states[-1]
    lost = np.flatnonzero(~np.isfinite(x).all(axis=1))
    put_back(w, kept)
    held = suspects(w, None) if w._clock.h else []
    if len(lost):
        # NaN spreads to all particles of a system. The particle that caused it has a NaN velocity one substep earlier.
        spoilt = np.flatnonzero(~np.isfinite(w.velocity).all(axis=1))
        particle: int | None = int(spoilt[0] if len(spoilt) else lost[0])
    else:
        free = [i for s in held[:1] for i in s.members if w.particles.inv_mass[i] > 0]
        before = 2 * states[-2] - states[-3] if len(states) > 2 else states[-2]
        jump = np.linalg.norm(x - before, axis=1)
        candidates = free if free and "turned" in report.flags else range(len(x))
        particle = max(candidates, key=lambda i: jump[i], default=None)
    near = suspects(w, particle) if w._clock.h and particle is not None else []
    keepers = slice(-last, None)
    return Autopsy(
        report if wrong(report) else seen, frame, substep, particle, tuple(int(i) for i in lost if i != particle)[:8],
        tuple(near[:4]), np.array(times)[keepers], np.array(states)[keepers],
    )  # fmt: skip


def suspects(w: World, particle: int | None) -> list[Suspect]:
    """Return constraints and contacts, the most violated first: all of one particle, or the worst of each feature for None."""
    out, found = held(w, particle), w.contacts
    for k in np.argsort(-found.overlap)[: None if particle is not None else 1]:
        pair = tuple(int(i) for i in found.pairs[k])
        if particle is None or particle in pair:
            out.append(Suspect("Contact", pair, float(found.overlap[k]), "m of overlap"))
    return sorted(out, key=lambda s: -s.amount)


def held(w: World, particle: int | None) -> list[Suspect]:
    """Return constraints alone, in the same order."""
    out = []
    for f in w.features:
        if isinstance(f, Batch) and f.count:
            left = f.residual
            for c in np.argsort(-left)[: None if particle is not None else 1]:
                members = tuple(int(i) for i in f.members_of(int(c)))
                if particle is None or particle in members:
                    out.append(Suspect(f"{f!r} {int(c)}", members, float(left[c]), "of its size"))
    return sorted(out, key=lambda s: -s.amount)
