"""What a scene of the matrix is: calls that are data, what happens to them, and what each option promises in any condition."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import tiverlet as tv

from ..fuzz.scenes import Call, Event, Set, Step, Structure
from ..fuzz.trials import Find, Trial

SUBSTEPS = 20


@dataclass(frozen=True)
class Promise:
    """What options do, in words, and a figure that tells so: figure(run) is within bounds.

    options: of a class, such as ("Motor", "torque"). only: conditions in which it holds, None for all of them.
    """

    options: tuple[tuple[str, str], ...]
    says: str
    figure: Callable[["Run"], float]
    least: float = -np.inf
    most: float = np.inf

    def check(self, run: "Run") -> None:
        """Raise a find unless it is kept."""
        value = float(self.figure(run))
        if not self.least <= value <= self.most:
            what = ", ".join(f"{kind}.{name}" for kind, name in self.options)
            raise Find("promise", f"{what}: {self.says}: {value:.6g} is not within [{self.least:.6g}, {self.most:.6g}]")


@dataclass(frozen=True)
class Scene:
    """A scene: calls, what is set before which frame, and promises.

    without: conditions that do not apply, with the reason. An error for invalid arguments is right in these, and only there.
    """

    structure: Structure
    promises: list[Promise]
    frames: int = 20
    turns: dict[int, list[Set]] = field(default_factory=dict)
    without: dict[str, str] = field(default_factory=dict)

    @property
    def calls(self) -> tuple[Call, ...]:
        """Particles and features."""
        return (self.structure.particles, *self.structure.features)

    def events(self, dts: Iterable[float] = (), substeps: Callable[[int], Any] = lambda k: None) -> list[Event]:
        """Return all that happens. dts: [s] of the first frames, others last 1/60 s. substeps: set before frame k."""
        return list(self._events(dict(enumerate(dts)), substeps))

    def _events(self, dts: dict[int, float], substeps: Callable[[int], Any]) -> Iterator[Event]:
        for k in range(self.frames):
            number = substeps(k) or (SUBSTEPS if k == 0 else None)
            if number:
                yield Set(None, "substeps", number)
            yield from self.turns.get(k, [])
            yield Step(dts.get(k, 1 / 60))


def kept(of: str, *options: str, says: str, figure: Callable[["Run"], float], **bounds: float) -> Promise:
    """Return a promise of options of one class."""
    return Promise(tuple((of, name) for name in options), says, figure, **bounds)


class Run:
    """What was seen while a scene ran: x, v (frames + 1, n, dim), energy and reports (frames,), and by feature what it tells."""

    def __init__(self, trial: Trial, events: list[Event], kinds: set[str] | None):
        w, self.features = trial.world, trial.features
        trial.reset()
        x, v, spins = [w.position], [w.velocity], []
        self.reports: list[tv.StepReport] = []
        self.met: list[tuple[int, int]] = []  # pairs that began to touch
        self.walls: list[tuple[int, int]] = []  # particles and walls that met
        loads: list[dict[int, np.ndarray]] = []
        for report in trial.frames(events, kinds):
            x.append(w.position)
            v.append(w.velocity)
            if w.particles.spins:
                spins.append(w.spin)
            self.reports.append(report)
            loads.append({k: f.load.copy() for k, f in enumerate(self.features) if bears(f)})
            pairs, walls = w._all_events()
            self.met += [tuple(map(int, p)) for p in pairs.begun.pairs]
            self.walls += [tuple(map(int, p)) for p in walls.begun.pairs]
        self.x, self.v, self.spins = np.array(x), np.array(v), np.array(spins)
        self.loads = {k: np.array([one[k] for one in loads]) for k in loads[0]}
        self.broken = {k: f.broken.copy() for k, f in enumerate(self.features) if hasattr(f, "broken")}
        self.rest = {k: f.rest.copy() for k, f in enumerate(self.features) if isinstance(getattr(f, "rest", None), np.ndarray)}
        self.energy = np.array([report.energy for report in self.reports])
        self.flags = frozenset().union(*(report.flags for report in self.reports))

    def part(self, some: slice, numbers: list[int], frames: int) -> "Run":
        """Return what was seen of some particles and features in the first frames."""
        out = object.__new__(Run)
        out.features, out.met, out.walls = [self.features[k] for k in numbers], self.met, self.walls
        out.x, out.v, out.spins = self.x[: frames + 1, some], self.v[: frames + 1, some], self.spins
        out.reports, out.energy, out.flags = self.reports[:frames], self.energy[:frames], self.flags
        out.loads = {k: self.loads[of][:frames] for k, of in enumerate(numbers) if of in self.loads}
        out.broken, out.rest = ({k: each[of] for k, of in enumerate(numbers) if of in each} for each in (self.broken, self.rest))
        return out

    def apart(self, i: int, j: int) -> np.ndarray:
        """Return the distances of two particles, (frames + 1,)."""
        return np.linalg.norm(self.x[:, i] - self.x[:, j], axis=1)

    def length(self, k: int) -> np.ndarray:
        """Return the lengths of particles 2k and 2k + 1, (frames + 1,)."""
        return self.apart(2 * k, 2 * k + 1)


def bears(f: Any) -> bool:
    """Whether a feature tells loads."""
    return hasattr(type(f), "load") and not getattr(f, "is_kinematic", False)
