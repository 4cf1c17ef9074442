"""The arguments of launches and phases: Span (which part of a frame), Moment (where in it), and the sheet of host and device."""

from struct import Struct

from ..device import at, inline, record, ti

BEFORE = -1  # the `half` of a substep that has not begun
ENDLESS = 1 << 20  # substeps of a frame in which nothing comes nearer to its target, and each substep counts as a frame
LISTS = -1  # what a frame stopped for; where phases are launched, it may be more passes of a kind, see contact/impulses.py


@record
class Span:
    """The part of a frame that a launch covers.

    h64: length of the substep (in orders above 2, of its first stage) [s]. start, end: of the frame [s]. tick: number of
    substeps so far. fresh: whether displacements hold velocities. owed: the kick by rigid constraints that these velocities
    lack, as a time [s]. state_origin: how the state came about, see Diagnostics. substeps, iterations: of the frame. begin,
    until: the substeps of this launch. part: iterations in the last of them. resumed: 1 if substep `begin` was interrupted
    before its half of a pass number `half`, or in it, by `what`, see LISTS.
    """

    def __init__(
        self, h64, start, end, tick, fresh, owed, state_origin, substeps, iterations, begin=0, half=0, resumed=0, until=1,
        part=1, thread=0, sheet=None, what=LISTS,
    ):  # fmt: skip
        self.h64, self.start, self.end, self.tick, self.fresh = h64, start, end, tick, fresh
        self.owed, self.state_origin = owed, state_origin
        self.substeps, self.iterations, self.begin, self.half = substeps, iterations, begin, half
        self.resumed, self.until, self.part, self.thread, self.sheet, self.what = resumed, until, part, thread, sheet, what


@record
class Moment:
    """The substep, and the pass over the constraints, in which a phase runs.

    s, h, last, time: number of the substep, its length, the length of the one before, its beginning [s]. frame_fraction: where it
    begins and ends in the frame, and its share of the frame. fresh: whether it is a start. final: whether it is the last one.
    resumed: 1 if the frame had stopped in it, and goes on there. it: number of the pass. first: whether multipliers begin in this
    pass. checks_list: whether the pass ends with a check for a stale list (every substep begins with one, too). half: number of
    the half, counted through all passes. newton: the Newton step within the pass, 0 or 1.
    """

    def __init__(
        self, span, s, h=0.0, last=0.0, time=0.0, tick=0, frame_fraction=None, fresh=0, final=0, resumed=0, it=0,
        first=0, checks_list=0, half=0, newton=0,
    ):  # fmt: skip
        self.span, self.thread, self.s, self.h, self.last, self.time, self.tick = span, span.thread, s, h, last, time, tick
        self.frame_fraction, self.fresh, self.final, self.resumed = frame_fraction, fresh, final, resumed
        self.it, self.first, self.checks_list, self.half, self.newton = it, first, checks_list, half, newton

    @inline
    def of(self, it, first=0, checks_list=0, half=0, newton=0):
        """The same substep, in this pass."""
        return Moment(
            self.span, self.s, self.h, self.last, self.time, self.tick, self.frame_fraction, self.fresh, self.final,
            self.resumed, it, first, checks_list, half, newton,
        )  # fmt: skip

    @inline
    def newton_step(self, k):
        """The same pass, in its k-th Newton step."""
        return self.of(self.it, self.first * (1 - k), self.checks_list, self.half, k)


# The sheet of a frame is one array, since each further array costs 0.25 us per launch. First the figures of the report, see
# Diagnostics. Then how the frame ended: whether it stopped, in which substep, before which half of a pass, and for what; how many
# rounds of impacts and passes of impulses and of places a substep took at most; and how many threads of the team were active.
# Then its arguments, see Span, with the number of the first thread.
FIGURES = 16
HALT, MOST, ACTIVE_THREADS = FIGURES, FIGURES + 4, FIGURES + 7
GIVEN = tuple(range(ACTIVE_THREADS + 1, ACTIVE_THREADS + 16))
H, START, END, TICK, FRESH, OWED, SUBSTEPS, ITERATIONS, BEGIN, HALF, RESUMED, FIRST, ORIGIN, UNTIL, PART = GIVEN
SHEET = PART + 1
GIVE = Struct(f"{len(GIVEN)}d").pack_into  # takes a third of the time of an array assignment


@inline
def integer(sheet, k):
    """Entry k of a sheet as an integer."""
    return ti.cast(at(sheet, k), ti.i32)


@ti.func
def span_on(sheet: ti.template(), thread):  # type: ignore[valid-type]
    """Read the Span of a thread from a sheet."""
    h64, start, end = sheet[H], sheet[START], sheet[END]
    tick, fresh = integer(sheet, TICK), integer(sheet, FRESH)
    owed, state_origin = sheet[OWED], integer(sheet, ORIGIN)
    substeps, iterations = integer(sheet, SUBSTEPS), integer(sheet, ITERATIONS)
    begin, half, resumed = integer(sheet, BEGIN), integer(sheet, HALF), integer(sheet, RESUMED)
    until, part = integer(sheet, UNTIL), integer(sheet, PART)
    return Span(
        h64, start, end, tick, fresh, owed, state_origin, substeps, iterations, begin, half, resumed, until, part,
        thread, sheet,
    )  # fmt: skip
