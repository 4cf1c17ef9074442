"""A team of CPU threads that runs a whole frame together, in one launch.

Taichi's threads sleep between two loops, and waking them takes some 50 us each: as long as a whole phase of 10 000 particles. So
a frame is one loop over threads. Each thread does its share of every inner loop and then waits for the others, which takes 0.1 us
as long as each thread has a core. If other programs use the cores too, a thread may wait milliseconds for one that does not run.
After a few such waits the first thread continues alone, and the others rejoin some frames later.
"""

from typing import TYPE_CHECKING, Any

from . import called, runtime
from .language import at, current, impl, inline, ti
from .number import OnDevice

if TYPE_CHECKING:
    from .memory import Memory

LEAST = 512  # the fewest iterations of a loop that Taichi gives to a CPU thread
PIECES = 16  # the most pieces into which a team divides particles with contacts
SMALL = 2048  # fewest particles per piece: sending data of neighbours between cores takes longer than computing with it
EVEN = 64  # pieces are multiples of this, so that they fill whole cache lines
BLOCK = 32  # particles per block: one test finds whether any of them is near a wall or has a contact
SHARE = 500  # fewest particles and constraints per thread; with fewer, threads wait longer than they work
PATIENCE = 20_000  # a wait is long after so many reads of the counter, of at most 50 ns, plus one per particle
LONG = 4  # long waits in a frame after which one thread continues alone
ALONE = 32  # frames until the others rejoin
LINE = 32  # integers so far apart are in different cache lines
SHIFT = 4096  # frames after which the count of arrivals restarts from 0, while no thread waits


def size_of(path: str, work: int) -> int:
    """Return the number of threads in a world's team. work: its number of particles and constraints."""
    return min(runtime.cores(), max(2, work // SHARE)) if path == "parallel" else 1


@inline
def blocks(begin, end):
    """Return the number of blocks of the particles from `begin` up to `end`."""
    return (end - begin + (BLOCK - 1)) // BLOCK


@inline
def block(b, begin, end):
    """Return the first particle of block b, and where the block ends."""
    return begin + b * BLOCK, ti.min(begin + (b + 1) * BLOCK, end)


@inline
def quotient(a, b):
    """Return a // b of non-negative numbers; division of i32 would test the signs."""
    return ti.cast(ti.cast(a, ti.u32) // ti.cast(b, ti.u32), ti.i32)


class Team:
    """The threads that run a frame together, and how they divide loops.

    size: the number of threads; 1 where none has to wait, because Taichi itself spreads loops over threads or because there is
    only one. launched: which of the two; True if phases are launched one by one, as on a GPU. A share of n is the part of a loop
    that one thread does; no result depends on how loops are shared. Particles are dealt out in `pieces` pieces, forwards and
    backwards in turn: in a heap, particles below have more contacts than those above, and one thread would wait for the other.

    halt: a field in which a frame launched phase by phase notes that it waits for a new neighbour list, [1, substep, half of a
    pass]; phases launched after that do nothing. None where this cannot happen, or is handled in another way.
    """

    host_only = ("_alone", "_frames", "_in_substep", "_pieces")

    halt: Any = None

    piece: Any = OnDevice()
    patience: Any = OnDevice()

    def __init__(self, memory: "Memory", size: int, particles: int, launched: bool, pieces: int):
        memory.compiler.launches = launched
        self.size, self.launched, self.patience = size, launched, memory.number(PATIENCE + particles)
        self._pieces = pieces
        self.piece = memory.number(self.piece_of(particles))
        self.loop_length = LEAST * size if size > 1 else 1
        self._alone, self._frames = 0, 0
        self._in_substep: tuple[Any, Any] = (None, None)  # a kernel, and its number of active threads in the present substep
        self.memory = memory
        if size > 1:
            self.arrived = memory.field("team.arrived", 2 * LINE, kind=ti.i32)
            self.active_threads = memory.field("team.active_threads", None, kind=ti.i32, values=size)
            self.long_waits = memory.field("team.long_waits", None, kind=ti.i32)
            # 1: all threads but the first leave before the next substep
            self.others_leave = memory.field("team.ends", None, kind=ti.i32)

    def piece_of(self, particles: int) -> int:
        """Return how many particles make up a piece."""
        even = -(-particles // (max(min(self._pieces, particles // SMALL), self.size) * EVEN)) * EVEN
        return max(1, 1 if self.launched else particles if self.size == 1 else even)

    def regroup(self, particles: int) -> None:
        """Adapt to a new number of particles."""
        self.piece, self.patience = self.piece_of(particles), PATIENCE + particles

    def rejoin(self, active: int) -> None:
        """Before a frame: let threads that left some frames ago rejoin. active: how many threads ran the last frame."""
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
    def takes_part(self, thread):
        """Whether a thread takes part in the coming substep; all threads must call this.

        The number of active threads is kept in a variable up to the end of the substep. Each loop uses it, and reading a field
        takes as much code as twenty operations.
        """
        if self.size == 1:
            return True
        works = self._takes_part(thread)
        self._in_substep = current().compiling_callable, impl.expr_init(at(self.active_threads, None))
        return works

    @inline
    def active(self):
        """Return the number of active threads."""
        kernel, number = self._in_substep
        return number if kernel is current().compiling_callable else at(self.active_threads, None)

    @inline
    def left(self, n):
        """Return how many of n things remain to do: none while the frame waits for a list."""
        return n if self.halt is None else n * (1 - at(at(self.halt, None), 0))

    @inline
    def chunk_begin(self, n, thread):
        """Return where a thread's share of a loop begins.

        For a single thread it is 0, in a form that LLVM cannot fold to a constant. If it could, it would unroll loops over few
        particles completely, and all compiling would take half as long again.
        """
        return self._share(n, thread) if self.size > 1 else thread * n

    @inline
    def chunk_end(self, n, thread):
        """Return where a thread's share of a loop ends."""
        return self._share(n, thread + 1) if self.size > 1 else self.left(n)

    @inline
    def dealt_count(self, n, unit, thread):
        """Return how many of n things a thread gets when they are dealt out in turn, `unit` at a time."""
        return self._dealt_count(n, unit, thread) if self.size > 1 else self.left(n)

    @inline
    def dealt_index(self, k, unit, thread):
        """Return the index of the k-th thing that a thread gets."""
        return self._dealt_index(k, unit, thread) if self.size > 1 else thread + k

    @inline
    def one(self, n, thread):
        """Give all n things to the first thread, none to the others."""
        return ti.select(thread == 0, n, 0) if self.size > 1 else self.left(n)

    @inline
    def wait(self):
        """Wait until all threads have arrived; everything that they wrote before is then visible."""
        return self._wait() if self.size > 1 else None

    @ti.func
    def _takes_part(self, thread):
        active = self.active_threads[None]
        out = thread < active
        if out:
            if self.others_leave[None] != 0:
                self.wait_for(active)
                if thread == 0:
                    self.active_threads[None], self.others_leave[None] = 1, 0
                self.wait_for(active)
                out = thread == 0
        return out

    @ti.func
    def check_waits(self, thread):
        """Decide whether the others leave before the next substep.

        Called once per substep, between two waits, so that all threads agree on it.
        """
        if ti.static(self.size > 1):
            if thread == 0 and self.long_waits[None] >= LONG and self.active_threads[None] > 1:
                self.others_leave[None] = 1

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
        """Return the place of a thread in a turn. The order alternates, so that no thread always gets the busier pieces."""
        return ti.select(turn & 1 == 0, thread, self.active() - 1 - thread)

    @inline
    def _wait(self):
        return self.wait_for(self.active())

    @called
    @ti.func
    def wait_for(self, active: ti.i32):
        """Wait for `active` threads to arrive.

        The last one signals in another cache line than the arrivals, which the waiting threads would slow down.
        """
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
                    ti.atomic_add(self.long_waits[None], 1)

    @ti.func
    def reset_wait_count(self):
        """Restart the count of long waits."""
        if ti.static(self.size > 1):
            self.long_waits[None] = 0
