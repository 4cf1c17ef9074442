"""What a launch, and each phase in it, is told: spans, moments, and the sheet on which the host writes them."""

from struct import Struct

from ..device import at, inline, record, ti

BEFORE = -1  # the half of a pass in which a substep is that has not begun


@record
class Span:
    """What a launch is to do.

    h64: the substep (of orders above 2: its first stage) [s]. start, end: of the frame [s]. tick, since: substeps so far, and
    since the last start. fresh: whether displacements are velocities; owed: [s] of the kick by rigid constraints that these lack.
    state_origin: how the state that it leaves came about, see
    Diagnostics. substeps, iterations: of the frame. begin, until: substeps of it that this launch makes. part: iterations of the
    last of these. resumed: 1 where `begin` was interrupted before its `half`-th half of a pass.
    """

    def __init__(
        self, h64, start, end, tick, since, fresh, owed, state_origin, substeps, iterations, begin=0, half=0, resumed=0, until=1,
        part=1, thread=0, sheet=None,
    ):  # fmt: skip
        self.h64, self.start, self.end, self.tick, self.since, self.fresh = h64, start, end, tick, since, fresh
        self.owed, self.state_origin = owed, state_origin
        self.substeps, self.iterations, self.begin, self.half = substeps, iterations, begin, half
        self.resumed, self.until, self.part, self.thread, self.sheet = resumed, until, part, thread, sheet


@record
class Moment:
    """What phases have to know of the substep, and of the pass over the constraints, in which they are.

    s, h, last, time: number, length, length of the one before, start [s]. frame_fraction: where it starts and ends in the frame.
    fresh: whether it is a start. damps: whether sound is taken out after it. final: whether it is the last of the frame.
    it: the pass. first: whether multipliers begin in it. checks_list: whether it is checked after it if the list is stale; the
    next substep does so, too. half: of the passes, counted through. newton: the step of Newton's method in the pass, 0 or 1.
    """

    def __init__(
        self, span, s, h=0.0, last=0.0, time=0.0, tick=0, frame_fraction=None, fresh=0, damps=0, final=0, it=0, first=0,
        checks_list=0, half=0, newton=0,
    ):  # fmt: skip
        self.span, self.thread, self.s, self.h, self.last, self.time, self.tick = span, span.thread, s, h, last, time, tick
        self.frame_fraction, self.fresh, self.damps, self.final = frame_fraction, fresh, damps, final
        self.it, self.first, self.checks_list, self.half, self.newton = it, first, checks_list, half, newton

    @inline
    def of(self, it, first=0, checks_list=0, half=0, newton=0):
        """The same, in a pass."""
        return Moment(
            self.span, self.s, self.h, self.last, self.time, self.tick, self.frame_fraction, self.fresh, self.damps, self.final,
            it, first, checks_list, half, newton,
        )  # fmt: skip

    @inline
    def newton_step(self, k):
        """The same, in the k-th step of Newton's method in its pass."""
        return self.of(self.it, self.first * (1 - k), self.checks_list, self.half, k)


# The sheet of a frame, one array, since a launch takes 0.25 us more for each. First what the frame came to, see Diagnostics; then
# how it ended: whether, in which substep and before which half of a pass it stopped to have the list grown; how many threads of a
# team were at work. Then what it is given, see Span, and the number of the first thread.
FIGURES = 15
HALT, ACTIVE_THREADS = FIGURES, FIGURES + 3
GIVEN = tuple(range(ACTIVE_THREADS + 1, ACTIVE_THREADS + 17))
H, START, END, TICK, SINCE, FRESH, OWED, SUBSTEPS, ITERATIONS, BEGIN, HALF, RESUMED, FIRST, ORIGIN, UNTIL, PART = GIVEN
SHEET = PART + 1
GIVE = Struct(f"{len(GIVEN)}d").pack_into  # in a third of the time of an assignment to an array


@inline
def integer(sheet, k):
    """An integer on it."""
    return ti.cast(at(sheet, k), ti.i32)


@ti.func
def span_on(sheet: ti.template(), thread):  # type: ignore[valid-type]
    """The span that is on it, for a thread."""
    h64, start, end = sheet[H], sheet[START], sheet[END]
    tick, since, fresh = integer(sheet, TICK), integer(sheet, SINCE), integer(sheet, FRESH)
    owed, state_origin = sheet[OWED], integer(sheet, ORIGIN)
    substeps, iterations = integer(sheet, SUBSTEPS), integer(sheet, ITERATIONS)
    begin, half, resumed = integer(sheet, BEGIN), integer(sheet, HALF), integer(sheet, RESUMED)
    until, part = integer(sheet, UNTIL), integer(sheet, PART)
    return Span(
        h64, start, end, tick, since, fresh, owed, state_origin, substeps, iterations, begin, half, resumed, until, part,
        thread, sheet,
    )  # fmt: skip
