"""What a constraint bears, and when it breaks."""

import numpy as np

from ... import checks
from ...device import ti
from ...features.feature import Batch, Knob, Scene

BREAKS = 2**30  # substeps after which the number of one comes again


class Breaking(Batch):
    """A batch with one multiplier per constraint, `dev.lam`: its load, what is left of its violation, and where it breaks.

    A constraint whose load exceeds break_at at the end of a substep acts no more from the next one on. It keeps its share of the
    masses that are split between constraints, which is safe, if slower than need be, until the world is built anew.
    """

    break_at = Knob(lambda f, v: f._strength(v), "Load beyond which a constraint breaks, (m,); None for never.")

    def _strength(self, value):
        if value is None:
            return None
        return checks.per_item(repr(self), "break_at", value, self.count, above=0.0, infinite=True)

    def bind_strength(self, scene: Scene) -> None:
        """Declare what breaking needs, if anything can break."""
        if self.breaks:
            self.dev.strength = scene.memory.field(f"{self!r}.break_at", self.count, values=self.break_at)
            self.dev.broken = scene.memory.field(f"{self!r}.broken", self.count, kind=ti.i32, state=True)

    @property
    def breaks(self) -> bool:
        """Whether a load can break constraints of the batch."""
        return self.break_at is not None or "strength" in vars(self.dev)

    def upload_strength(self) -> None:
        """Write new ones."""
        if self.breaks:
            self.scene.memory.write(self.dev.strength, np.full(self.count, np.inf) if self.break_at is None else self.break_at)

    @property
    def load(self) -> np.ndarray:
        """The force in each constraint during the last substep [N], (m,); positive where it pulls (f above rest).

        More exactly the force along grad f: newtons where f is a length, N m where it is an angle. In f32, rounding of positions
        is felt as about m ulp(x) / h^2, 1 N for 1 kg some 10 m from the origin at 1200 substeps/s; use f64 where that matters.
        """
        if not self.count:
            return np.zeros(0)
        if self.scene is None:
            raise RuntimeError(f"{self!r}.load: there is none before a world has been stepped with it.")
        if not self.acts:
            return np.zeros(self.count)
        scale = 1 / self.scene.hh if self.scene.hh else 0.0
        return -scale * self.scene.memory.read(self.dev.lam)[: self.count].astype(np.float64)

    @property
    def broken(self) -> np.ndarray:
        """Which constraints have broken so far, Boolean (m,)."""
        return self.stamps() > 0

    def stamps(self) -> np.ndarray:
        """When each constraint broke, (m,): the number of the substep from 1 on, modulo BREAKS; 0 where it holds."""
        if not self.breaks or not self.acts:
            return np.zeros(self.count, dtype=np.int32)
        return self.scene.memory.read(self.dev.broken)

    @ti.func
    def holds(self, c):
        """Whether constraint c has not broken."""
        out = True
        if ti.static(self.breaks):
            out = self.dev.broken[c] == 0
        return out

    @ti.func
    def tear(self, c, hh, tick):
        """Break constraint c if its load in this substep was too large; it acts no more from the next one on."""
        if self.dev.broken[c] == 0 and ti.abs(self.dev.lam[c]) > self.dev.strength[c] * hh:
            self.part(c, tick)

    @ti.func
    def part(self, c, tick):
        """Note that constraint c breaks in this substep."""
        self.dev.broken[c] = tick % ti.static(BREAKS) + 1
        self.dev.slots.broken[None] += 1
