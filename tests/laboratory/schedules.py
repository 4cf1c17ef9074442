"""Passive scenes of the catalogue in six schedules of substeps and frames, by solver: which gain energy, and which tell so."""

import contextlib
from collections.abc import Iterator

import numpy as np

import tiverlet as tv
from tiverlet.report.output import Table

from ..fuzz import oracles
from ..fuzz.scenes import Structure
from ..fuzz.trials import RISKS, Refused, Trial
from ..ledger.runs import extent, has_links
from ..properties import SCHEDULES, scheduled
from ..scenes import SCENES
from ..scenes.scene import Scene

SOLVERS = {
    "default": None, "Direct": tv.Direct(), "Jacobi": tv.Jacobi(), "ConjugateGradient(5)": tv.ConjugateGradient(5),
    "Chebyshev": tv.Chebyshev(),
}  # fmt: skip
MOST = 1e-3  # of the heights that are passed and the kinetic energy at the start: a gain that counts
NOTES = [
    "Scenes that gain a thousandth of the heights that they pass and of their first kinetic energy, of all passive scenes with",
    "links; in brackets those without a flag in any frame, and the worst gain. 60 frames, f32.",
]


def main(args) -> Iterator[Table]:
    """Yield the table of solvers and schedules, and that of the scenes that gain."""
    tv.init(threads=1)
    passive = {name: s for name, s in SCENES.items() if has_links(s) and oracles.passive(s.structure)}
    some = {name: s for name, s in passive.items() if not args.parts or name in args.parts}
    cells, gains = [], []
    for solver in SOLVERS:
        found = [row for name, scene in some.items() for row in gained(name, scene, solver)]
        gains += [(solver, *row[:2], f"{row[2]:.1e}", row[3] or "none") for row in found if row[2] > MOST]
        cells.append((solver, *(told([row for row in found if row[1] == label]) for label in SCHEDULES)))
    yield Table("Scenes that gain energy", ("solver", *SCHEDULES), cells, NOTES)
    yield Table("Which", ("solver", "scene", "schedule", "gain", "flags"), gains)


def told(found: list[tuple]) -> str:
    """Return how many scenes gain, of how many, without a flag, and the worst gain."""
    some = [row for row in found if row[2] > MOST]
    silent = sum(not row[3] for row in some)
    return f"{len(some)} of {len(found)}" + (f" ({silent} silent, {max(row[2] for row in some):.0e})" if some else "")


def gained(name: str, scene: Scene, solver: str) -> Iterator[tuple]:
    """Yield (scene, schedule, largest gain of energy as a share, flags) for each schedule; none where the solver is refused."""
    s = scene.structure
    chosen = {"solver": SOLVERS[solver]} if SOLVERS[solver] else {}
    with contextlib.suppress(Refused):
        with contextlib.closing(Trial(Structure(s.particles, s.features, {**s.settings, **chosen}))) as trial:
            for label, schedule in SCHEDULES.items():
                trial.reset()
                trial.world.substeps = None
                reports, places = [], [trial.world.position]
                for event in scheduled(name, schedule):
                    report = event.do(trial.world, trial.features)
                    if report is not None:
                        reports.append(report)
                        places.append(trial.world.position)
                share = max(r.energy for r in reports) - (reports[0].energy - reports[0].energy_change)
                flags = set().union(*(r.flags for r in reports)) & {*RISKS, "energy-gain", "non-finite", "out-of-range"}
                size = extent(trial, np.array(places))
                yield name, label, share / size if size else 0.0, ", ".join(sorted(flags))
