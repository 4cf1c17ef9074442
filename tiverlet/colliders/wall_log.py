"""Events of one wall: which particles began to touch it, went on touching it, or left it in a frame."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact.touches import BEFORE, NEVER, Touches, span
from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Scene

ASIDE = 1e-6  # of an impulse: if it is longer by more than that than its part along the first normal, several normals contributed


class WallLog:
    """A row for each particle, written where the wall presses it, see Surface.push().

    touching: whether it was pressed in the last substep of the last frame; only this is kept between frames. when: the substeps
    of the frame, from 1 on, in which it was first pressed and last pressed, or BEFORE or NEVER. impulse: the sum of the changes
    of its displacement along normals [m]; there are several normals in corners and in hollows. normal: the first of them. speed:
    its approach in the substep in which it met the wall [m].

    A start from given velocities moves particles by h^2 / 2 times what presses them, h^2 in other substeps. So there, what a wall
    gives counts `late` times more, as far as it is not the blow of the velocity `given`, as whose impulse it is whole.
    """

    host_only = ("_scene",)

    per_particle = True

    def __init__(self, scene: "Scene", name: str):
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self._scene, self.state, self.radius = scene, scene.state, scene.radius
        self.touching = add(f"events.{name}.touching", n, kind=ti.i32, state=True, for_reports=True)
        self.when = add(f"events.{name}.when", n, width=2, kind=ti.i32)
        self.impulse, self.speed = add(f"events.{name}.impulse", n, width=dim), add(f"events.{name}.speed", n)
        self.given, self.late = add(f"events.{name}.given", n, width=dim), add(f"events.{name}.late", None)
        sleeps = bool(scene.state.sleepers)  # sleeping particles are not tested again, so their points are state
        self.normal, self.point = (
            add(f"events.{name}.{what}", n, width=dim, state=sleeps, for_reports=sleeps) for what in ("normal", "point")
        )
        self.substep = add(f"events.{name}.substep", None, kind=ti.i32)  # of the frame, from 1 on; 0 before any
        self.in_state = {"touching": self.touching} | ({"normal": self.normal, "point": self.point} if sleeps else {})

    @ti.func
    def begin(self, substep, late):
        """Begin a substep, numbered from 1 on. late: see above, 0 but for starts from given velocities. One thread calls it."""
        self.substep[None] = substep
        self.late[None] = late

    @ti.func
    def open(self, i):
        """At the start of a frame: clear the events of particle i, and note its velocity: d_i, if the frame is a start."""
        self.given[i] = self.state.d[i]
        began = ti.select(self.touching[i] != 0, BEFORE, NEVER)
        self.when[i] = [began, began]
        self.impulse[i] = ti.zero(self.state.x[i])
        self.speed[i] = 0
        if self.state.awake(i):
            self.normal[i] = ti.zero(self.state.x[i])
            self.point[i] = ti.zero(self.state.x[i])

    @ti.func
    def wake(self, i, substep):
        """Particle i wakes after `substep` substeps of the frame: until then it touched if it touched before."""
        if self.when[i][0] == BEFORE:
            self.when[i][1] = substep

    @ti.func
    def record(self, i, depth, n, push, approach, moved, h, bounces):
        """Record that particle i is `depth` [m] inside of the wall with the normal n.

        push: change of its displacement along n [m]. approach: its displacement towards the wall, which moved by `moved` in this
        substep of h [s] itself [m]. bounces: whether it leaves the wall.
        """
        began, last, now = self.when[i][0], self.when[i][1], self.substep[None]
        if last < now - 1:
            self.speed[i] = ti.max(self.speed[i], approach)
        if began == NEVER or began == BEFORE:
            self.normal[i] = n
            self.point[i] = self.state.place(i) - (self.radius.of(i) - depth) * n
        self.when[i] = [ti.select(began == NEVER, now, began), now]
        if self.late[None] > 0 and not bounces:
            blow = ti.min(ti.max(approach, 0), ti.max((moved - h * self.given[i]).dot(n), 0))
            push += self.late[None] * (push - ti.min(blow, push))
        self.add(i, push * n)

    @ti.func
    def add(self, i, push):
        """Add a vector to the impulse of particle i."""
        self.impulse[i] = self.impulse[i] + push

    @ti.func
    def presses(self, i):
        """Return 1 if the wall presses particle i in this substep, else 0."""
        return ti.cast(self.when[i][1] == self.substep[None], ti.i32)

    @ti.func
    def close(self, i):
        """At the end of a frame: store whether particle i touches. A sleeping particle touches if it did before."""
        if self.when[i][0] == BEFORE and not self.state.awake(i):
            self.when[i][1] = self.substep[None]
        self.touching[i] = self.presses(i)

    @property
    def counter(self) -> Any:
        """The field that is 0 where there are no events to report."""
        return self.substep

    def forget(self) -> None:
        """Discard the events: the state does not come from the last frame."""
        self._scene.memory.write(self.counter, 0)

    def read(self, number: int, h: float, time: float) -> Touches:
        """Return the events of the last frame, until `time` [s]. number: of the wall in world.features. h: the substep [s]."""
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
        groups = np.stack([self._scene.particles.group[some], np.full(len(some), -1)], axis=1)
        return Touches(pairs, groups, point, normal, given, speed / h, *span(when[some], substeps, h, time))
