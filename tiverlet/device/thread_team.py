"""CPU threads that go through a whole frame together, in one launch.

Taichi's threads sleep between two loops, and waking them takes some 50 us for each: as long as 10 000 particles take for a whole
phase. So a frame is one loop over threads. Each does its share of every loop inside, and then waits for the others, which takes
0.1 us as long as each has a core. Where other programs want the cores too, a thread waits for one that does not run, for
milliseconds: after a few such waits the first thread goes on alone, and the others join it some frames later.
"""

import contextlib
from collections.abc import Iterator

import taichi as ti

from . import runtime
from .memory import Memory
from .patches.compiler import inline

LEAST = 512  # iterations of a loop that Taichi gives to a CPU thread, at least
PIECES = 16  # into which a team divides particles that touch, at most
SMALL = 128  # of them in a piece, at least: to send what neighbours need from core to core takes as long as to compute it
EVEN = 64  # or a multiple: they fill whole lines of a cache
BLOCK = 32  # of them that are asked at once whether any is near a wall, or touches another
SHARE = 500  # particles and constraints for each thread, at least; with fewer they wait for each other longer than they work
PATIENCE = 20_000  # looks at the counter, of 50 ns or less, and one more for each particle: then a wait was long
LONG = 4  # long waits in a frame after which one thread goes on alone
ALONE = 32  # frames until the others come back
LINE = 32  # integers that are not in the same line of a cache
SHIFT = 4096  # frames after which arrivals are counted from 0 again, while nobody waits


_apart = False


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Worlds that are built within it, on the parallel path, are launched phase by phase, as they are on a GPU."""
    global _apart
    before, _apart = _apart, True
    try:
        yield
    finally:
        _apart = before


def size_of(path: str, work: int) -> int:
    """How many threads make up the team of a world. work: particles and constraints."""
    return min(runtime.cores(), max(2, work // SHARE)) if path == "parallel" and not _apart else 1


@inline
def blocks(begin, end):
    """How many blocks particles from `begin` up to `end` are."""
    return (end - begin + (BLOCK - 1)) // BLOCK


@inline
def block(b, begin, end):
    """The particles of the b-th of them: the first, and where they end."""
    return begin + b * BLOCK, ti.min(begin + (b + 1) * BLOCK, end)


class Team:
    """size: the number of threads; 1 where there is nobody to wait for, because Taichi itself spreads loops over threads or
    because there is one thread only. launched: which of the two; phase by phase, as on a GPU. A share of n is what thread `me`
    does of it; what the shares are shows in no result. Particles are dealt out piece by piece, there and back, `pieces` in all:
    in a heap those below have more to do than those above, and one thread would wait for the other."""

    def __init__(self, memory: Memory, size: int, particles: int, launched: bool, pieces: int):
        self.size, self.launched, self.patience = size, launched, PATIENCE + particles
        even = -(-particles // (max(min(pieces, particles // SMALL), size) * EVEN)) * EVEN
        self.piece = max(1, 1 if launched else particles if size == 1 else even)
        self.spread = LEAST * size if size > 1 else 1
        self._alone, self._frames = 0, 0
        self.memory = memory
        if size > 1:
            self.arrived = memory.field("team.arrived", 2 * LINE, kind=ti.i32)
            self.hands = memory.field("team.hands", None, kind=ti.i32, values=size)  # how many of them are at work
            self.late = memory.field("team.long_waits", None, kind=ti.i32)
            self.ends = memory.field("team.ends", None, kind=ti.i32)  # 1: in the next substep all but the first leave

    def muster(self, hands: int) -> None:
        """Before a frame: those who left some frames ago come back. hands: how many were at work in the last one."""
        if self.size > 1:
            self._frames += 1
            if self._frames % SHIFT == 0:
                self.memory.write(self.arrived, 0)
            if self._alone == 0 and hands == 1:
                self._alone = ALONE
            elif self._alone > 0:
                self._alone -= 1
                if self._alone == 0:
                    self.memory.write(self.hands, self.size)

    @inline
    def works(self, me):
        """Whether thread `me` takes part in the coming substep; all must ask."""
        return self._works(me) if self.size > 1 else True

    @inline
    def low(self, n, me):
        """Where the share begins. That of a single thread begins at 0, which LLVM must not know: it would write out loops over
        few particles, one by one, and take half as long again for all."""
        return self._share(n, me) if self.size > 1 else me * n

    @inline
    def high(self, n, me):
        """Where it ends."""
        return self._share(n, me + 1) if self.size > 1 else n

    @inline
    def deal(self, n, unit, me):
        """How many of n things fall to thread `me` where they are dealt out in turn, `unit` at a time."""
        return self._deal(n, unit, me) if self.size > 1 else n

    @inline
    def turn(self, k, unit, me):
        """Which of them is the k-th."""
        return self._turn(k, unit, me) if self.size > 1 else me + k

    @inline
    def one(self, n, me):
        """All of it for one of them, nothing for the others."""
        return ti.select(me == 0, n, 0) if self.size > 1 else n

    @inline
    def wait(self):
        """Go on once all have come here, with what they have written."""
        return self._wait() if self.size > 1 else None

    @ti.func
    def _works(self, me):
        hands = self.hands[None]
        out = me < hands
        if out:
            if self.ends[None] != 0:
                self.meet(hands)
                if me == 0:
                    self.hands[None], self.ends[None] = 1, 0
                self.meet(hands)
                out = me == 0
        return out

    @ti.func
    def watch(self, me):
        """Once in a substep, between two waits, so that all know the same when they ask whether they take part in the next."""
        if ti.static(self.size > 1):
            if me == 0 and self.late[None] >= LONG and self.hands[None] > 1:
                self.ends[None] = 1

    @ti.func
    def _share(self, n: ti.template(), k):  # type: ignore[valid-type]
        hands = self.hands[None]
        return ti.min(k * ((n + hands - 1) // hands), n)

    @ti.func
    def _deal(self, n: ti.template(), unit: ti.template(), me):  # type: ignore[valid-type]
        hands, units = self.hands[None], ti.static(-(-n // unit))
        out = (units // hands + ti.cast(self._place(units // hands, me) < units % hands, ti.i32)) * unit
        if self._place((units - 1) // hands, (units - 1) % hands) == me:
            out -= ti.static(-(-n // unit) * unit - n)
        return out

    @ti.func
    def _turn(self, k, unit: ti.template(), me):  # type: ignore[valid-type]
        before = ti.cast(ti.cast(k, ti.u32) // ti.u32(unit), ti.i32)  # i32 would look at the sign
        return k + (before * (self.hands[None] - 1) + self._place(before, me)) * unit

    @ti.func
    def _place(self, turn, me):
        """The place of thread `me` in a turn: there and back, so that it goes on where it was, and none has always the busier."""
        return ti.select(turn & 1 == 0, me, self.hands[None] - 1 - me)

    @ti.func
    def _wait(self):
        self.meet(self.hands[None])

    @ti.func
    def meet(self, hands):
        """Wait for so many. The last one says so in another place than where all arrive, whom those who look would hold up."""
        if hands > 1:
            before = ti.atomic_add(self.arrived[0], 1)
            turn = before // hands + 1
            if before + 1 == turn * hands:
                ti.atomic_add(self.arrived[LINE], 1)
            else:
                looks = 0
                while ti.atomic_add(self.arrived[LINE], 0) < turn:
                    looks += 1
                if looks > self.patience:
                    ti.atomic_add(self.late[None], 1)

    @ti.func
    def forgive(self):
        """Count long waits from 0 again."""
        if ti.static(self.size > 1):
            self.late[None] = 0
