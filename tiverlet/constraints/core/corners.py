"""The corners of constraints on the device: their particles, positions, and the slots for their moves."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import always, at, inline, ti
from ...device.number import OnDevice

if TYPE_CHECKING:
    from ...features.feature import Scene

BLOCK = 32  # corners that one thread sums up: it fixes the order of all sums, whatever the threads


class FixedCorners:
    """Corners of constraints on `arity` particles each.

    count: of constraints. places: their slots, None where they have none. origin: see Quantity.
    """

    count: Any = OnDevice()

    def __init__(self, scene: "Scene", name: str, members: np.ndarray, places: np.ndarray | None, origin: Any):
        add, (m, arity) = scene.memory.field, members.shape
        self.origin, self.first = origin, 0 if origin else 1  # first: the first corner that is not at 0
        self.state, self.slots, self.real, self.arity = scene.state, scene.slots, scene.real, arity
        self.count = scene.memory.number(m)
        self.members = add(f"{name}.members", m, width=arity, kind=ti.i32, values=members)
        if places is not None:
            self.places = add(f"{name}.slots", m, width=arity, kind=ti.i32, values=places)

    @inline
    def member(self, c, k):
        """Return the particle at corner k of constraint c."""
        return at(at(self.members, c), k)

    @inline
    def awake(self, c):
        """Whether no particle of constraint c is asleep. All of its particles that can move sleep, or none does."""
        sleepers = self.state.sleepers
        if not sleepers:
            return always()
        asleep = at(sleepers.asleep, self.member(c, 0))
        for k in range(1, self.arity):
            asleep = ti.max(asleep, at(sleepers.asleep, self.member(c, k)))
        return asleep == 0

    @ti.func
    def write_move(self, c, k: ti.template(), move):  # type: ignore[valid-type]
        """Write the move of corner k into its slot; a particle that cannot move has none."""
        place = self.places[c][k]
        if place >= 0:
            self.slots.move[place] = move

    @ti.func
    def compare(self, loop: ti.template(), c, overload, number):  # type: ignore[valid-type]
        """Compare the overload of constraint c with others at its corners, see Breaks. Returns 1 if none comes before it."""
        out = 1
        for k in ti.static(range(self.arity)):
            out = ti.min(out, self.slots.breaks.compare(loop, self.member(c, k), overload, number))
        return out

    @ti.func
    def rest(self, c):
        """Write no moves for constraint c."""
        for k in ti.static(range(self.arity)):
            self.write_move(c, k, ti.Vector.zero(self.real, self.state.dim))

    @ti.func
    def relative_positions(self, c, back):
        """Return the corners of constraint c at x - back d, relative to the first (so f32 loses no digits) or the origin."""
        i = self.member(c, 0)
        q = ti.Matrix.zero(self.real, self.arity, self.state.dim)
        for k in ti.static(range(self.first, self.arity)):
            j = self.member(c, k)
            r = -back * self.state.d[j]
            if ti.static(bool(self.origin)):
                for a in ti.static(range(self.state.dim)):
                    r[a] += (self.state.x[j][a] - ti.static(self.origin[0][a])) - ti.static(self.origin[1][a])
                if ti.static(self.state.compensated):
                    r += self.state.low[j]
            else:
                moved = self.state.relative_displacement(self.state.d[j] - self.state.d[i], j, i)
                r = self.state.separation(j, i) - back * moved
            for a in ti.static(range(self.state.dim)):
                q[k, a] = r[a]
        return q

    @ti.func
    def now_and_start(self, c):
        """Return relative_positions() of constraint c now and at the start of the substep."""
        i = self.member(c, 0)
        now = ti.Matrix.zero(self.real, self.arity, self.state.dim)
        start = now
        if ti.static(bool(self.origin)):
            now, start = self.relative_positions(c, 0), self.relative_positions(c, 1)
        else:
            for k in ti.static(range(1, self.arity)):
                j = self.member(c, k)
                r, moved = self.state.separation(j, i), self.state.relative_displacement(self.state.d[j] - self.state.d[i], j, i)
                for a in ti.static(range(self.state.dim)):
                    now[k, a], start[k, a] = r[a] - 0 * moved[a], r[a] - moved[a]
        return now, start


class VariableCorners:
    """Corners of constraints of any size.

    A pass has three loops, so that one constraint on a hundred thousand particles is as parallel as many small ones:

        reduce_block(b)   sums over at most BLOCK corners of one constraint: block[b] = first corner, last + 1, constraint
        relax(c)   adds up its blocks, blocks[c] to blocks[c + 1], in order, and solves
        scatter_corner(e)  gives corner e its move, with write_move(e, move)

    The same loops run before push_spring_force(), and reduce_block() before residual_of() where passes say `needs_reduce_block`.
    count, total, block_count: of constraints, corners, blocks. members, owner: the particle and the constraint of each corner.
    starts: the first corner of each constraint.
    """

    count: Any = OnDevice()
    total: Any = OnDevice()
    block_count: Any = OnDevice()

    def __init__(
        self, scene: "Scene", name: str, starts: np.ndarray, members: np.ndarray, owner: np.ndarray, places: np.ndarray
    ):  # fmt: skip
        self.state, self.slots, self.real = scene.state, scene.slots, scene.real
        count, size, number = len(starts) - 1, len(members), scene.memory.number
        parts = -(-np.diff(starts) // BLOCK)
        first = np.concatenate([[0], np.cumsum(parts)])
        blocks = int(first[-1])
        self.count, self.total, self.block_count = number(count), number(size), number(blocks)
        whose = np.repeat(np.arange(count), parts)
        begin = starts[whose] + BLOCK * (np.arange(blocks) - first[whose])
        end = np.minimum(begin + BLOCK, starts[whose + 1])
        add = scene.memory.field
        self.members = add(f"{name}.members", size, kind=ti.i32, values=members)
        self.owner = add(f"{name}.owner", size, kind=ti.i32, values=owner)
        self.starts = add(f"{name}.starts", count + 1, kind=ti.i32, values=starts)
        self.block = add(f"{name}.block", blocks, width=3, kind=ti.i32, values=np.stack([begin, end, whose], axis=1))
        self.blocks = add(f"{name}.blocks", count + 1, kind=ti.i32, values=first)
        self.places = add(f"{name}.slots", size, kind=ti.i32, values=places)
        if scene.state.sleepers:  # a particle of each constraint that can move, else its first: all sleep or none does
            first = np.lexsort((scene.inv_mass[members] == 0, owner))[starts[:-1]]
            self.mover = add(f"{name}.mover", count, kind=ti.i32, values=members[first])

    @inline
    def awake(self, c):
        """Whether constraint c is awake."""
        sleepers = self.state.sleepers
        return at(sleepers.asleep, at(self.mover, c)) == 0 if sleepers else always()

    @ti.func
    def compare(self, loop: ti.template(), c, overload, number):  # type: ignore[valid-type]
        """Compare the overload of constraint c with others at its corners, see Breaks. Returns 1 if none comes before it."""
        out = 1
        for e in range(self.starts[c], self.starts[c + 1]):
            out = ti.min(out, self.slots.breaks.compare(loop, self.members[e], overload, number))
        return out

    @ti.func
    def write_move(self, e, move):
        """Write the move of corner e into its slot; a particle that cannot move has none."""
        place = self.places[e]
        if place >= 0:
            self.slots.move[place] = move

    @ti.func
    def rest(self, c):
        """Write no moves for constraint c."""
        for e in range(self.starts[c], self.starts[c + 1]):
            self.write_move(e, ti.Vector.zero(self.real, self.state.dim))

    @ti.func
    def reference_particle(self, c):
        """Return the particle that corners of constraint c are relative to, so that f32 loses no digits."""
        return self.members[self.starts[c]]

    @ti.func
    def relative_position(self, e, i0, back):
        """Return corner e relative to particle i0, at x - back d."""
        i = self.members[e]
        return self.state.separation(i, i0) - back * (self.state.d[i] - self.state.d[i0])
