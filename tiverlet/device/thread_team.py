"""CPU threads that go through a whole frame together, in one launch.

Taichi's threads sleep between two loops, and waking them takes some 50 us for each: as long as 10 000 particles take for a whole
phase. So a frame is one loop over threads. Each does its share of every loop inside, and then waits for the others, which takes
0.1 us as long as each has a core. Where other programs want the cores too, a thread waits for one that does not run, for
milliseconds: after a few such waits the first thread goes on alone, and the others join it some frames later.
"""

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from . import called, runtime
from .language import at, current, impl, inline, ti
from .number import OnDevice

if TYPE_CHECKING:
    from .memory import Memory

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


_launching = False


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Worlds that are built within it, on the parallel path, are launched phase by phase, as they are on a GPU."""
    global _launching
    before, _launching = _launching, True
    try:
        yield
    finally:
        _launching = before


def size_of(path: str, work: int) -> int:
    """How many threads make up the team of a world. work: particles and constraints."""
    return min(runtime.cores(), max(2, work // SHARE)) if path == "parallel" and not _launching else 1


@inline
def blocks(begin, end):
    """How many blocks particles from `begin` up to `end` are."""
    return (end - begin + (BLOCK - 1)) // BLOCK


@inline
def block(b, begin, end):
    """The particles of the b-th of them: the first, and where they end."""
    return begin + b * BLOCK, ti.min(begin + (b + 1) * BLOCK, end)


@inline
def quotient(a, b):
    """a // b of numbers that are not negative: that of i32 would look at the signs."""
    return ti.cast(ti.cast(a, ti.u32) // ti.cast(b, ti.u32), ti.i32)


class Team:
    """size: the number of threads; 1 where there is nobody to wait for, because Taichi itself spreads loops over threads or
    because there is one thread only. launched: which of the two; phase by phase, as on a GPU. A share of n is what a thread
    does of it; what the shares are shows in no result. Particles are dealt out piece by piece, there and back, `pieces` in all:
    in a heap those below have more to do than those above, and one thread would wait for the other.

    halt: where a frame that is launched phase by phase notes that it waits for a list, [1, substep, half of a pass]; what was
    launched behind has nothing to do then. None where it cannot happen, or is asked in other ways."""

    halt: Any = None

    piece: Any = OnDevice()
    patience: Any = OnDevice()

    def __init__(self, memory: "Memory", size: int, particles: int, launched: bool, pieces: int):
        memory.compiler.launches = launched
        self.size, self.launched, self.patience = size, launched, memory.number(PATIENCE + particles)
        self._pieces = pieces
        self.piece = memory.number(self.piece_of(particles))
        self.spread = LEAST * size if size > 1 else 1
        self._alone, self._frames = 0, 0
        self._in_substep: tuple[Any, Any] = (None, None)  # a kernel, and how many are at work in the substep it is in
        self.memory = memory
        if size > 1:
            self.arrived = memory.field("team.arrived", 2 * LINE, kind=ti.i32)
            self.active_threads = memory.field("team.active_threads", None, kind=ti.i32, values=size)  # at work
            self.late = memory.field("team.long_waits", None, kind=ti.i32)
            self.ends = memory.field("team.ends", None, kind=ti.i32)  # 1: in the next substep all but the first leave

    def piece_of(self, particles: int) -> int:
        """How many particles make up a piece."""
        even = -(-particles // (max(min(self._pieces, particles // SMALL), self.size) * EVEN)) * EVEN
        return max(1, 1 if self.launched else particles if self.size == 1 else even)

    def regroup(self, particles: int) -> None:
        """There are so many particles now."""
        self.piece, self.patience = self.piece_of(particles), PATIENCE + particles

    def rejoin(self, active: int) -> None:
        """Before a frame: those who left some frames ago come back. active: how many were at work in the last one."""
        if self.size > 1:
            self._frames += 1
            if self._frames % SHIFT == 0:
                self.memory.write(self.arrived, 0)
            if self._alone == 0 and active == 1:
                self._alone = ALONE
            elif self._alone > 0:
                self._alone -= 1
                if self._alone == 0:
                    self.memory.write(self.active_threads, self.size)

    @inline
    def works(self, thread):
        """Whether a thread takes part in the coming substep; all must ask. Up to its end it knows how many do: each loop asks,
        and a field takes as much code as twenty operations."""
        if self.size == 1:
            return True
        works = self._works(thread)
        self._in_substep = current().compiling_callable, impl.expr_init(at(self.active_threads, None))
        return works

    @inline
    def active(self):
        """How many are at work."""
        kernel, number = self._in_substep
        return number if kernel is current().compiling_callable else at(self.active_threads, None)

    @inline
    def left(self, n):
        """How many of n things there are to do: none while the frame waits."""
        return n if self.halt is None else n * (1 - at(at(self.halt, None), 0))

    @inline
    def chunk_begin(self, n, thread):
        """Where the share begins. That of a single thread begins at 0, which LLVM must not know: it would write out loops over
        few particles, one by one, and take half as long again for all."""
        return self._share(n, thread) if self.size > 1 else thread * n

    @inline
    def chunk_end(self, n, thread):
        """Where it ends."""
        return self._share(n, thread + 1) if self.size > 1 else self.left(n)

    @inline
    def dealt_count(self, n, unit, thread):
        """How many of n things fall to a thread where they are dealt out in turn, `unit` at a time."""
        return self._dealt_count(n, unit, thread) if self.size > 1 else self.left(n)

    @inline
    def dealt_index(self, k, unit, thread):
        """Which of them is the k-th."""
        return self._dealt_index(k, unit, thread) if self.size > 1 else thread + k

    @inline
    def one(self, n, thread):
        """All of it for one of them, nothing for the others."""
        return ti.select(thread == 0, n, 0) if self.size > 1 else self.left(n)

    @inline
    def wait(self):
        """Go on once all have come here, with what they have written."""
        return self._wait() if self.size > 1 else None

    @ti.func
    def _works(self, thread):
        active = self.active_threads[None]
        out = thread < active
        if out:
            if self.ends[None] != 0:
                self.wait_for(active)
                if thread == 0:
                    self.active_threads[None], self.ends[None] = 1, 0
                self.wait_for(active)
                out = thread == 0
        return out

    @ti.func
    def watch(self, thread):
        """Once in a substep, between two waits, so that all know the same when they ask whether they take part in the next."""
        if ti.static(self.size > 1):
            if thread == 0 and self.late[None] >= LONG and self.active_threads[None] > 1:
                self.ends[None] = 1

    @inline
    def _share(self, n, k):
        return ti.min(k * quotient(n + (self.active() - 1), self.active()), n)

    @ti.func
    def _dealt_count(self, n, unit, thread):
        active, units = self.active(), quotient(n + unit - 1, unit)
        turns = quotient(units, active)
        rest = units - turns * active
        out = (turns + ti.cast(self._place(turns, thread) < rest, ti.i32)) * unit
        last, place = ti.select(rest == 0, turns - 1, turns), ti.select(rest == 0, active, rest) - 1
        if self._place(last, place) == thread:
            out -= units * unit - n
        return out

    @inline
    def _dealt_index(self, k, unit, thread):
        before = impl.expr_init(quotient(k, unit))
        return k + (before * (self.active() - 1) + self._place(before, thread)) * unit

    @inline
    def _place(self, turn, thread):
        """The place of a thread in a turn: there and back, so that it goes on where it was, and none has always the busier."""
        return ti.select(turn & 1 == 0, thread, self.active() - 1 - thread)

    @inline
    def _wait(self):
        return self.wait_for(self.active())

    @called
    @ti.func
    def wait_for(self, active: ti.i32):
        """Wait for so many. The last one says so in another place than where all arrive, whom those who look would hold up."""
        if active > 1:
            before = ti.atomic_add(self.arrived[0], 1)
            turn = quotient(before, active) + 1
            if before + 1 == turn * active:
                ti.atomic_add(self.arrived[LINE], 1)
            else:
                looks = 0
                while ti.atomic_add(self.arrived[LINE], 0) < turn:
                    looks += 1
                if looks > self.patience:
                    ti.atomic_add(self.late[None], 1)

    @ti.func
    def reset_wait_count(self):
        """Count long waits from 0 again."""
        if ti.static(self.size > 1):
            self.late[None] = 0
