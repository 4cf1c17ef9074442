"""Walls of one kind, which share code: kernels loop over them."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import inline, ti
from ..device.members import Members
from .surface import TOUCH
from .wall_tree import WallTree

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .collider import Collider

MARGIN = 1 / 8  # of a particle's radius: how far around its path walls are found


class WallGroup:
    """Walls that differ only in what fields hold, see Collider.code_key.

    wall: the first of them, whose code serves all; in a loop over the members, its fields are those of the member entered last.
    single: whether it is the only one, whose kernels have no loop. tree: by which a particle finds the walls near it; None where
    walls are without bounds, or particles have images.
    """

    host_only = ("walls", "faces")

    def __init__(self, walls: "Sequence[Collider]"):
        self.walls = list(walls)
        self.wall: Any = walls[0]
        self.single = len(walls) == 1
        self.total: Any = None  # of all
        self.owner: Any = None  # of each face: its wall
        self.first_side: Any = None  # of each wall
        self.members: Any = None
        self.tree: Any = None
        self.state: Any = None
        self.first_face: Any = None  # the number of its first face, among those of all walls
        self.faces: list[np.ndarray] = []  # of each wall, their numbers

    def bind(self, scene: "Scene") -> None:
        """Bind the walls."""
        memory, self.state = scene.memory, scene.state
        if self.single:
            with memory.owned(self.wall):
                self.wall.bind(scene)
            return
        self.members = Members(memory, len(self.walls))
        for wall in self.walls:
            with memory.member(self.members):
                wall.bind(scene)
        memory.place_members(self.members)
        if self.wall.has_bounds and not scene.state.images:
            self.tree = WallTree(scene, repr(self.wall), np.array([wall.middle for wall in self.walls]))

    @inline
    def count(self):
        """Return the number of walls."""
        return 1 if self.single else self.members.count

    @inline
    def enter(self, k):
        """In a kernel: from here on, the fields of `wall` are those of member k."""
        if self.members:
            self.members.enter(k)

    @ti.func
    def pose(self, frame_fraction, begins):
        """Compute the poses of the walls in a substep; at the begin of a frame also where they are in it."""
        if ti.static(self.single):
            self.wall.pose(frame_fraction)
        else:
            for k in range(self.count()):
                self.enter(k)
                if ti.static(self.wall.poses):
                    self.wall.pose(frame_fraction)
                if ti.static(bool(self.tree)):
                    if begins:
                        low, high = self.wall.bounds()
                        close = ti.static(4 * TOUCH) * ti.max(abs(low).sum(), abs(high).sum())
                        self.tree.put(k, low - close, high + close)
            if ti.static(bool(self.tree)):
                if begins:
                    self.tree.join()

    def number_faces(self, scene: "Scene", first: int) -> int:
        """Number the faces of the walls, from `first` on. Returns the number behind the last."""
        sides = np.array([wall.sides for wall in self.walls])
        self.faces = np.split(first + np.arange(sides.sum()), np.cumsum(sides)[:-1])
        self.first_face, self.total = scene.memory.number(first), scene.memory.number(int(sides.sum()))
        if not self.single:
            add, name = scene.memory.field, repr(self.wall)
            self.owner = add(f"{name}.owner", int(sides.sum()), kind=ti.i32, values=np.repeat(np.arange(len(sides)), sides))
            self.first_side = add(f"{name}.first_side", len(sides), kind=ti.i32, values=np.cumsum(sides) - sides)
        return first + int(sides.sum())

    @ti.func
    def face(self, k, side):
        """Return the number of a side of member k, among the faces of all walls."""
        out = self.first_face.now + side
        if ti.static(not self.single):
            out += self.first_side[k]
        return out

    @inline
    def has_face(self, face):
        """Whether a face is one of this group."""
        return (face >= self.first_face.now) & (face < self.first_face.now + self.total.now)

    @ti.func
    def wall_of(self, face):
        """Return the member to which a face belongs. For faces of other groups it is 0 if there is one member, else -1."""
        out = 0
        if ti.static(not self.single):
            out = -1
            if self.has_face(face):
                out = self.owner[face - self.first_face.now]
        return out

    @ti.func
    def side_of(self, face):
        """Return the side of its wall that a face is."""
        out = face - self.first_face.now
        if ti.static(not self.single):
            out -= self.first_side[self.owner[out]]
        return out

    @ti.func
    def may_touch(self, i, radius):
        """Return 0 where no wall has anything to do for particle i, if that can be computed fast, else 1."""
        out = 0
        if ti.static(self.single):
            out = self.wall.may_touch(i, radius)
        elif ti.static(bool(self.tree)):
            low, high = self.path_box(i, radius)
            out = ti.cast(self.tree.meets(0, low, high), ti.i32)
        else:
            for k in range(self.count()):
                self.enter(k)
                out |= self.wall.may_touch(i, radius)
        return out

    @property
    def poses(self) -> bool:
        """Whether pose() has anything to do."""
        return self.wall.poses or bool(self.tree)

    @ti.func
    def next_near(self, last, i, radius):
        """Return the first wall behind the wall `last` that particle i may meet on its path in this substep; `count` if none."""
        out = last + 1
        if ti.static(bool(self.tree)):
            low, high = self.path_box(i, radius)
            out = self.tree.next(last, low, high, self.count())
        return out

    @ti.func
    def next_within(self, last, i, reach):
        """Return the first wall behind the wall `last` that is within `reach` of particle i during the frame; `count` if none."""
        out = last + 1
        if ti.static(bool(self.tree)):
            x = self.state.place(i)
            low, high = self.widened(i, x, x, reach)
            out = self.tree.next(last, low, high, self.count())
        return out

    @ti.func
    def path_box(self, i, radius):
        """Return the corners of a box around the path of particle i in this substep."""
        x, d = self.state.place(i), self.state.d[i]
        low, high = ti.min(x, x - d), ti.max(x, x - d)
        if ti.static(self.state.starts):
            start = self.state.begin(i)
            low, high = ti.min(low, start, start + d), ti.max(high, start, start + d)
        return self.widened(i, low, high, ti.static(1 + MARGIN) * radius)

    @ti.func
    def widened(self, i, low, high, reach):
        """Return the corners of a box that is wider by `reach`, and by the rounding of particle i and of walls."""
        more = reach + 8 * self.state.digits(i) + ti.static(4 * TOUCH) * ti.max(abs(low).sum(), abs(high).sum())
        return low - more, high + more


def grouped(walls: "Sequence[Collider]") -> list[WallGroup]:
    """Return walls in groups that share code, in the order of the first of each. Within a group they stay in order."""
    groups: dict[Any, list[Any]] = {}
    for wall in walls:
        groups.setdefault(wall.code_key or id(wall), []).append(wall)
    return [WallGroup(some) for some in groups.values()]
