"""The report of frames of many worlds: the figures of a StepReport, as arrays."""

from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ..step.step_report import StepReport

COMBINED = {  # how figures of several frames are combined; others by their maximum
    "time": lambda a, b: b, "energy": lambda a, b: b, "energy_change": np.add, "broken": np.add,
    "bad": lambda a, b: np.where(a < 0, b, a),
}  # fmt: skip


@dataclass(frozen=True)
class WorldsReport:
    """The report of the last worlds.step() or worlds.run(): the worst figures of each world, as in StepReport.

    All are arrays with one value per world. bad: -1 where all values are finite. flags: by name, which worlds have the flag;
    flags that no world has are left out. seconds: run time of all frames of all worlds together, one number.
    """

    time: np.ndarray
    residual: np.ndarray
    overlap: np.ndarray
    contacts: np.ndarray
    energy: np.ndarray
    energy_change: np.ndarray
    bad: np.ndarray
    broken: np.ndarray
    turn: np.ndarray
    tension: np.ndarray
    flags: dict[str, np.ndarray]
    substeps: int
    iterations: int
    seconds: float = field(default=0.0, compare=False)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def clean(self) -> np.ndarray:
        """Which worlds have no flag, (worlds,)."""
        out = np.ones(len(self), dtype=bool)
        for there in self.flags.values():
            out &= ~there
        return out

    def of(self, k: int) -> StepReport:
        """Return the report of world k, without the sentences that explain its flags; those of worlds[k].step() have them."""
        k = range(len(self))[k]
        figures: dict[str, Any] = {name: getattr(self, name)[k].item() for name in ARRAYS}
        figures["bad"] = None if figures["bad"] < 0 else figures["bad"]
        flags = frozenset(name for name, there in self.flags.items() if there[k])
        return StepReport(substeps=self.substeps, iterations=self.iterations, flags=flags, seconds=self.seconds, **figures)

    def worse(self, later: "WorldsReport") -> "WorldsReport":
        """Combine with the report of later frames: the worst figures of both."""
        out: dict[str, Any] = {name: COMBINED.get(name, np.maximum)(getattr(self, name), getattr(later, name)) for name in ARRAYS}
        none = np.zeros(len(self), dtype=bool)
        names = [*self.flags, *(name for name in later.flags if name not in self.flags)]
        flags = {name: self.flags.get(name, none) | later.flags.get(name, none) for name in names}
        return WorldsReport(
            **out, flags=flags, substeps=max(self.substeps, later.substeps), iterations=max(self.iterations, later.iterations),
            seconds=self.seconds + later.seconds,
        )  # fmt: skip

    def __repr__(self) -> str:
        said = [f"{len(self)} worlds", f"time = {self.time.max(initial=0.0):.6g}"]
        said += [f"{name} <= {getattr(self, name).max(initial=0):.3g}" for name in ("residual", "overlap")]
        said += [f"{name}: {there.sum()}" for name, there in self.flags.items()]
        return f"WorldsReport({', '.join(said)})"


ARRAYS = tuple(f.name for f in fields(WorldsReport) if f.type is np.ndarray)
