"""Events of one wall: which particles began to touch it, went on touching it, or left it in a frame."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact.touches import BEFORE, NEVER, Touches, span
from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Scene

ASIDE = 1e-6  # of an impulse: it is longer by more than that than along the first normal where others gave to it, too


class WallLog:
    """A row for each particle, written where the wall presses it, see Surface.press().

    touching: whether it was pressed in the last substep of the last frame, all that is carried on between frames. when: the
    substeps of the frame, from 1 on, in which it was first pressed and pressed last, or BEFORE or NEVER. impulse: what the
    displacement got along normals [m], of which there are several in corners and in hollows; normal: the first of them. speed:
    what it came nearer in the substep in which it met the wall [m].
    """

    per_particle = True

    def __init__(self, scene: "Scene", name: str):
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self._scene, self.state, self.radius = scene, scene.state, scene.radius
        self.touching = add(f"events.{name}.touching", n, kind=ti.i32, state=True, told=True)
        self.when = add(f"events.{name}.when", n, width=2, kind=ti.i32)
        self.impulse, self.speed = add(f"events.{name}.impulse", n, width=dim), add(f"events.{name}.speed", n)
        sleeps = bool(scene.state.sleepers)  # where what sleeps touches, nobody finds again
        self.normal, self.point = (
            add(f"events.{name}.{what}", n, width=dim, state=sleeps, told=sleeps) for what in ("normal", "point")
        )
        self.substep = add(f"events.{name}.substep", None, kind=ti.i32)  # of the frame, from 1 on; 0 before any
        self.in_state = {"touching": self.touching} | ({"normal": self.normal, "point": self.point} if sleeps else {})

    @ti.func
    def open(self, i):
        """As a frame begins: what particle i has, which touched before or not."""
        began = ti.select(self.touching[i] != 0, BEFORE, NEVER)
        self.when[i] = [began, began]
        self.impulse[i] = ti.zero(self.state.x[i])
        self.speed[i] = 0
        if self.state.awake(i):
            self.normal[i] = ti.zero(self.state.x[i])
            self.point[i] = ti.zero(self.state.x[i])

    @ti.func
    def wake(self, i, substep):
        """Particle i wakes after so many substeps of the frame: it has touched until then what it touched before."""
        if self.when[i][0] == BEFORE:
            self.when[i][1] = substep

    @ti.func
    def note(self, i, depth, n, push, approach):
        """Particle i is `depth` [m] inside of the wall with the normal n, and its displacement gets `push` along it, which was
        `approach` towards the wall [m]."""
        began, last, now = self.when[i][0], self.when[i][1], self.substep[None]
        if last < now - 1:
            self.speed[i] = ti.max(self.speed[i], approach)
        if began == NEVER or began == BEFORE:
            self.normal[i] = n
            self.point[i] = self.state.place(i) - (self.radius.of(i) - depth) * n
        self.when[i] = [ti.select(began == NEVER, now, began), now]
        self.add(i, push * n)

    @ti.func
    def add(self, i, push):
        """Its displacement gets so much more, a vector."""
        self.impulse[i] = self.impulse[i] + push

    @ti.func
    def close(self, i):
        """As a frame ends: keep whether particle i touches; what sleeps touches what it touched."""
        if self.when[i][0] == BEFORE and not self.state.awake(i):
            self.when[i][1] = self.substep[None]
        self.touching[i] = ti.cast(self.when[i][1] == self.substep[None], ti.i32)

    @property
    def made(self) -> Any:
        """The field that is 0 where there are no events to tell of."""
        return self.substep

    def forget(self) -> None:
        """No frame was made, for another state than that of one."""
        self._scene.memory.write(self.made, 0)

    def read(self, number: int, h: float, time: float) -> Touches:
        """What the last frame, of substeps h [s], which ended at `time` [s], came to. number: of the wall in world.features."""
        memory = self._scene.memory
        substeps, when = int(memory.read(self.substep)[0]), memory.read(self.when)[: self._scene.particles.count]
        some = np.flatnonzero(when[:, 0] != NEVER) if substeps else np.zeros(0, dtype=np.int64)
        columns = (self.point, self.normal, self.impulse, self.speed)
        point, normal, impulse, speed = (memory.read(field)[some].astype(np.float64) for field in columns)
        along, size = (impulse * normal).sum(axis=1), np.linalg.norm(impulse, axis=1)
        several = size > np.abs(along) * (1 + ASIDE)
        normal[several] = impulse[several] / size[several, None]
        pairs = np.stack([some, np.full(len(some), number)], axis=1)
        given = np.where(several, size, along) / self._scene.inv_mass[some] / h
        return Touches(pairs, point, normal, given, speed / h, *span(when[some], substeps, h, time))
