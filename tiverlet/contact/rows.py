"""The rows of contacts: pairs and walls that may press on a particle in a substep, with what they bore in the last one.

Rows live at the entries of the neighbour list. Entries of walls stand behind those of particles; their number is WALL plus
that of the wall's face. In each substep those that may press are listed as rows, particle by particle, so that
passes run through memory in order.

A row of two particles that both move belongs to the first of them, which gives the other one its impulse. Where the two are in
different pieces of a team, or on a GPU, each has a row, with the same numbers: then each particle only gathers. A particle adds
up the impulses of its rows in the same order either way, so results have the same bits on any number of threads.
"""

from typing import TYPE_CHECKING, Any

from ..device import at, inline, ti
from ..device.language import impl
from ..device.number import OnDevice
from ..features.material import DYNAMIC, RESTITUTION, ROLLING, STATIC, TANGENTIAL, TOUCH, TOUCHES, TWISTING
from ..neighbours.neighbour_list import WALL
from ..neighbours.pair_data import Column, PairData
from .impacts import Impacts
from .limits import AHEAD, BEYOND, FEW, FOREIGN, FULL, OWN, SLIPS, SLOP, SLOW, TOGETHER
from .meeting import meeting

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from .edges import Edges
    from .narrow_phase import DiscGeometry

NOISE = 64.0  # times the rounding of a displacement: what comes together no faster is at rest
STEADY = 1 / 16  # of an impulse: it may change by so much in a substep, beside what forces change, and be a load
QUARTER = 0.25  # of the smaller radius: by how much a pair that overlaps parts in a substep at most

# In which turn a particle lists a pair, by where the other one is: in a piece before, behind it in the same piece, in a piece
# behind, or where impulses do not move it. The last is for pairs that the other particle lists.
BEFORE, MOVED, BEHIND, HELD, LISTED = range(5)

# The different entries of a symmetric matrix, by dimension.
ENTRIES = {2: ((0, 0), (1, 1), (0, 1)), 3: ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))}


class Rows:
    """The rows of one world.

    The rows of a particle: from `begin` those that particles of lower pieces have, too; from `own` those that give the other
    particle its impulse; from `kept` other pairs; from `pressed` walls, up to `end`. share: among how many rows the mass of a
    particle is divided.
    Columns by row: `other` the other particle, or WALL + the face of a wall; `entry` in the neighbour list; `normal`; `gap` at
    the start of the substep where it was open [m]; `bend` the curvature of the gap [1/m]; `stiff` the effective mass in a pass of
    impulses, along the normal and across it, and `firm` in one of places [kg]; `friction` static and dynamic; `moved` the motion
    of a wall in the substep [m]; `p` the impulse and `step` its change in the last pass [kg m].
    The normal is that at the start of the substep, or that of the time at which a pair meets.
    """

    ahead: Any = OnDevice()  # gap up to which pairs are rows where one of them may be stopped [m]
    push_out: Any = OnDevice()  # largest speed at which pairs part that overlap [m/s]; negative for QUARTER of the radius

    def __init__(
        self, scene: "Scene", table: Any, has_friction: bool, bounces: bool, in_turn: bool, turns: bool, walls: list[Any],
        team: "Team", push_out: float | None, ahead: float, edges: "Edges | None" = None,
    ):  # fmt: skip
        n, add = scene.count, scene.memory.field
        self.scene, self.state, self.table = scene, scene.state, table
        self.has_friction, self.real, self.dim, self.radius = has_friction, scene.real, scene.particles.dim, scene.radius
        self.sheared = bool(scene.state.images and scene.state.images.sheared)  # whether images move relative to each other
        self.slots: Any = scene.slots if scene.slots and scene.slots.answers else None
        self.edges: Any = edges
        self.ends = 2 if edges else 1  # particles on which a row presses
        self.walls, self.width = walls, scene.particles.dim if has_friction else 0
        self.begin, self.own, self.kept, self.pressed, self.end = (
            add(f"Contact.rows_{name}", n, kind=ti.i32) for name in ("begin", "own", "kept", "pressed", "end")
        )
        self.share, self.eigenvalue = add("Contact.share", n), add("Contact.eigenvalue", n)
        self.spread = add("Contact.spread", n, width=len(ENTRIES[self.dim]), kind=ti.i32)  # sum of n n^T, in 2^-20
        # How far rows that bear a load moved each particle in the last substep, and turned its surface [m].
        self.borne = add("Contact.borne", n, width=self.dim, state=True)
        if scene.state.spins:
            self.turned = add("Contact.turned", n, width=scene.particles.axes, state=True)
        # What each pair and wall bore in the last substep [kg m]: along the normal, or with friction the whole vector.
        self.memory = PairData("impulse" if has_friction else "push", self.width, persistent=True, has_owner=not edges)
        self.columns: list[Column] = [*edges.columns] if edges else []
        self.other, self.entry = self.column("other", kind=ti.i32), self.column("entry", kind=ti.i32)
        self.normal, self.gap, self.bend = self.column("normal", self.dim), self.column("gap"), self.column("bend")
        self.stiff, self.firm = self.column("stiff", 2 if has_friction else 0), self.column("firm")
        self.p, self.step = self.column("p", self.width), self.column("step", self.width)
        self.moved: Any = self.column("moved", self.dim) if walls else None
        self.friction: Any = self.column("friction", 2) if has_friction else None
        number = scene.memory.number
        self.push_out, self.ahead = number(-1.0 if push_out is None else push_out, scene.real), number(ahead, scene.real)
        # Whether a pair slid in the last substep, where static and dynamic friction differ, see bound_friction().
        self.slid: Any = PairData("slides", 0, persistent=True, kind=ti.i32, has_owner=not edges) if has_friction else None
        self.bounces, self.rounding = bounces, NOISE * (2.0**-52 if scene.real == ti.f64 else 2.0**-23)
        self.touched: Any = None
        if bounces:
            # What each pair gave along the normal in the last substep, with impacts [kg m].
            self.given = PairData("given", 0, persistent=True, for_reports=True, has_owner=not edges)
            # Whether a pair touched in the last substep: then it goes on together instead of bouncing.
            self.touched = PairData("touches", 0, persistent=True, kind=ti.i32, has_owner=not edges)
            self.bounce, self.time, self.target = self.column("bounce"), self.column("time"), self.column("target")
            self.slight = self.column("slight")  # what forces can change of a load in a substep [kg m]
            self.when = add("Contact.when", n)  # the part of the substep before the impact of the island of a particle
        self.impacts: Any = Impacts(scene, self) if in_turn else None
        self.belts = bool(self.impacts) and self.impacts.belts
        self.one_way = [group for group in walls if group.wall.one_way is not None]
        self.logging = [group for group in walls if group.wall.events]  # each has a log of its own
        self.events: Any = None
        self.turns, self.axes = turns, scene.particles.axes
        if turns:
            # Moments against rolling and twisting, over the radius of the pair [kg m]; what was borne of them.
            self.borne_moment = PairData("moment", self.axes, persistent=True, has_owner=True)
            self.f, self.f_step = self.column("moment", self.axes), self.column("moment_step", self.axes)
            self.arms, self.rolling, self.turn_stiff = (self.column(name, 2) for name in ("arms", "rolling", "turn_stiff"))
            self.across = self.column("across", self.dim)  # tangential displacement that the points which touch aim at [m]
        self.divided = (team.size > 1 or team.launched) and not edges
        # Of the substep: its length [s]; the fractions of the frame at its ends; by how much what rows bore is scaled;
        # the part of State.kick() that it adds to displacements; and spin_shares().
        self.h, self.frame_fraction = add("Contact.h", None), add("Contact.frame_fraction", None, width=2)
        self.scale, self.whole, self.turn_shares = (add(f"Contact.{name}", None) for name in ("scale", "whole", "turn_shares"))
        # Whether particles moved so far that a contact may be missed, or went deeper into a body than its middle, in the frame.
        self.fast = add("Contact.fast", None, kind=ti.i32)
        self.list: Any = None
        self.geometry: Any = None

    def column(self, name: str, width: int = 0, kind: Any = None) -> Column:
        """Add a column of numbers, or of vectors of a width, by row."""
        self.columns.append(Column(f"row_{name}", width, kind))
        return self.columns[-1]

    def bind(self, listed: Any, geometry: "DiscGeometry") -> None:
        """Add the columns to the neighbour list, before it is allocated."""
        self.list, self.geometry = listed, geometry
        listed.columns = [*listed.columns, *self.columns]
        if self.edges:
            self.edges.bind(self, listed, geometry)
        else:
            listed.movable = lambda: self.scene.inv_mass > 0

    @inline
    def zero(self):
        """Return an impulse of 0."""
        return ti.Vector.zero(self.real, self.dim) if self.has_friction else ti.cast(0, self.real)

    @ti.func
    def along(self, p, n):
        """Return the part of an impulse along the normal n."""
        if ti.static(self.has_friction):
            return p.dot(n)
        return p

    @inline
    def vector(self, p, n):
        """Return an impulse as a vector."""
        return p if self.has_friction else p * n

    @inline
    def hit(self, row):
        """Return the impulse of impacts in turn of a row along its normal [kg m], which is no part of p."""
        return at(self.impacts.hit.field, row) if self.impacts else ti.cast(0, self.real)

    @inline
    def most_taken(self, row):
        """Return by how much p may be less than 0: what impacts in turn gave too much of [kg m]."""
        return ti.select(at(self.bounce.field, row) > 0, self.hit(row), 0) if self.impacts else ti.cast(0, self.real)

    @ti.func
    def is_set(self, p):
        """Whether an impulse is not 0."""
        if ti.static(self.has_friction):
            return (p != 0).any()
        return p != 0

    @inline
    def first(self, i, part):
        """Return the first row of a part of the rows of particle i: FOREIGN, those that lower pieces have, too, or OWN."""
        return ti.select(part == FOREIGN, at(self.begin, i), at(self.own, i)) if self.divided else at(self.own, i)

    @inline
    def last(self, i, part):
        """Return the row behind the last of a part."""
        return ti.select(part == FOREIGN, at(self.own, i), at(self.end, i)) if self.divided else at(self.end, i)

    @inline
    def parts(self):
        """Return the first part that there may be."""
        return FOREIGN if self.divided else OWN

    @ti.func
    def kick(self, i):
        """Return the displacement that forces add to particle i in the substep [m]."""
        return self.whole[None] * self.state.kick(i)

    @ti.func
    def relative(self, u, d: ti.template(), i, other, row, pressed):  # type: ignore[valid-type]
        """Return the displacement u of particle i, relative to that of what a row presses on; d: displacements of particles."""
        if row < pressed:
            for k in ti.static(range(self.ends)):
                u -= self.part(row, k) * d[self.pressed_on(row, k)]
            u = self.state.relative_displacement(u, i, other)
        elif ti.static(len(self.walls) > 0):
            u -= self.moved.field[row]
        return u

    @inline
    def pressed_on(self, row, k):
        """Return one of the particles on which a row presses."""
        return at(self.edges.end.field, row) if k else at(self.other.field, row)

    @inline
    def part(self, row, k):
        """Return the part of the impulse of a row that this particle gets."""
        return self.edges.part(row, k) if self.edges else 1

    @inline
    def size(self, i):
        """Return the size of particle i, of which slop is a part [m]."""
        return at(self.edges.size, i) if self.edges else self.radius.of(i)

    @ti.func
    def size_at(self, i, row):
        """Return the size of what touches at a row of particle i, the smaller one; of a point, the size of the other [m]."""
        out = self.size(i)
        if row < self.pressed[i]:
            other = self.size(self.other.field[row])
            out = ti.select(out > 0, ti.min(out, other), other)
        return out

    @inline
    def when_of(self, i):
        """Return the part of the substep before the impact of the island of particle i, 0 without one."""
        return at(self.when, i) if self.bounces else ti.cast(0, self.real)

    @ti.func
    def note_fast(self):
        """Note that a contact may be missed. The flag is read first: threads that write to one place are slow."""
        if self.fast[None] == 0:
            self.fast[None] = 1

    @ti.func
    def note_when(self, i, when):
        """Note that a body, whose lowest particle is i, has its first impact at a time: all that are struck write the same."""
        if self.when[i] == 0:
            self.when[i] = ti.max(when, ti.static(FEW))

    @ti.func
    def is_steady(self, change, size, slight):
        """Whether an impulse of this size, which has changed by `change`, is a load. An impact passes."""
        return change <= self.steady_change(size, slight)

    @ti.func
    def steady_change(self, size, slight):
        """Return by how much a load of this size may change in a substep. slight: what forces can change. All are in one unit."""
        return ti.static(SLOW) * slight + ti.static(STEADY) * size

    @ti.func
    def relative_kick(self, i, row):
        """Return State.kick() of particle i, relative to that of what a row presses on."""
        f = self.state.kick(i)
        if row < self.pressed[i]:
            for k in ti.static(range(self.ends)):
                if self.state.moves(self.pressed_on(row, k)):
                    f -= self.part(row, k) * self.state.kick(self.pressed_on(row, k))
        return f

    @ti.func
    def spin_shares(self):
        """Return among how many kinds of moments each row divides the spin of its particles: 2 if any resists rolling."""
        out = 1
        if ti.static(self.turns and self.table.turns):
            for k in range(ti.static(1 if self.table.uniform else self.table.groups**2)):
                c = self.table.entries[k]
                if c[ROLLING] + c[TWISTING] > 0:
                    out = 2
        for group, w in ti.static([(g, g.wall) for g in self.walls if self.turns and g.wall.dev.surface.turns]):
            for k in range(group.count()):
                group.enter(k)
                if w.dev.surface.rolling[None][0] + w.dev.surface.rolling[None][1] > 0:
                    out = 2
        return out

    @ti.func
    def clear(self, i):
        """Clear the sums of particle i, to which its rows and those of others add."""
        self.share[i] = 0
        self.spread[i] = 0 * self.spread[i]

    @ti.func
    def begin_empty(self, i, row):
        """Let particle i have no rows, before `row`."""
        self.begin[i], self.own[i], self.kept[i], self.pressed[i], self.end[i] = row, row, row, row, row

    @ti.func
    def find(self, i, begin, end, row):
        """List the rows of particle i from `row` on. begin, end: of its piece. Returns the row behind the last."""
        scale = self.scale[None]
        self.begin[i] = row
        if ti.static(bool(self.edges)):
            row = self.find_edges(i, row)
        else:
            row = self.find_pairs(i, begin, end, row, scale)
        self.pressed[i] = row
        if ti.static(len(self.walls) > 0):
            first = self.list.first[i] + self.list.number[i]
            if self.state.moves(i):
                for e in range(first, first + self.list.wall_number[i]):
                    row = self.find_wall(i, e, row, scale)
                self.level(i, row)
                pressing = self.pressed[i]
                for e in range(first, first + self.list.wall_number[i]):
                    if pressing < row and self.entry.field[pressing] == e:
                        pressing += 1
                    else:
                        self.forget(e)
        self.end[i] = row
        self.share[i] = self.share[i] + ti.cast(row - self.begin[i], self.real)
        spread = self.spread[i]
        for k in range(self.begin[i], row):
            spread += self.square(self.normal.field[k])
        self.spread[i] = spread
        return row

    @ti.func
    def find_edges(self, i, row):
        """List the rows of which particle i is the vertex. Returns the row behind the last."""
        self.own[i], self.kept[i] = row, row
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            row = self.edges.list_row(i, e, row)
        return row

    @ti.func
    def find_pairs(self, i, begin, end, row, scale):
        """List the rows of pairs of particle i. Returns the row behind the last.

        Its entries are sorted by the other particle, so they come in the order of kinds, but for those that are held.
        """
        first, number = self.list.first[i], self.list.number[i]
        own, kept, some_held = row, row, 0
        for held in range(2):
            for e in range(first, first + number * ti.max(1 - held, some_held)):
                j = self.list.neighbour[e]
                kind = self.kind_of(i, j, begin, end)
                some_held |= ti.cast(kind == HELD, ti.i32)
                if kind != LISTED and (kind == HELD) == (held == 1):
                    before = row
                    row = self.find_pair(i, j, e, row, scale)
                    if kind == BEFORE:
                        own = row
                    if kind <= MOVED:
                        kept = row
                    if kind == MOVED and row > before:
                        self.share[j] = self.share[j] + 1
                        self.spread[j] = self.spread[j] + self.square(self.normal.field[before])
        self.own[i], self.kept[i] = own, kept
        return row

    @ti.func
    def kind_of(self, i, j, begin, end):
        """Return in which turn particle i lists its pair with j; LISTED where j lists it."""
        out = MOVED
        if ti.static(self.divided):
            out = ti.select(j < begin, BEFORE, ti.select(j < end, MOVED, BEHIND))
        if out == MOVED and j < i:
            out = LISTED
        if not self.state.moves(j):
            out = HELD
        return out

    @ti.func
    def square(self, n):
        """Return the different entries of n n^T in integers, whose sums have the same bits in any order."""
        products = ti.Vector([n[a] * n[b] for a, b in ti.static(ENTRIES[self.dim])])
        return ti.cast(products * ti.static(2.0**20), ti.i32)

    @ti.func
    def find_eigenvalue(self, i):
        """Compute the largest eigenvalue of the sum of n n^T over the rows of particle i."""
        s = ti.cast(self.spread[i], self.real) * ti.static(2.0**-20)
        if ti.static(self.dim == 2):
            half = (s[0] - s[1]) / 2
            self.eigenvalue[i] = (s[0] + s[1]) / 2 + ti.sqrt(half * half + s[2] * s[2])
        else:  # m + p (1 + e), e^2 (3 + e) = 2 + det((S - m) / p), with m = tr S / 3, 6 p^2 = |S - m|^2: by Newton's method
            m = (s[0] + s[1] + s[2]) / 3
            a, b, c = s[0] - m, s[1] - m, s[2] - m
            det = a * (b * c - s[4] * s[4]) - s[3] * (s[3] * c - s[4] * s[5]) + s[5] * (s[3] * s[4] - b * s[5])
            p = ti.sqrt((a * a + b * b + c * c + 2 * (s[3] * s[3] + s[4] * s[4] + s[5] * s[5])) / 6)
            q = ti.max(2 + det / ti.max(p * p * p, FEW), 0)
            e = ti.sqrt(q / 3.5)
            for _ in range(4):
                e -= (e * e * (3 + e) - q) / ti.max(3 * e * (2 + e), FEW)
            self.eigenvalue[i] = m + p * (1 + e)

    @ti.func
    def bound_friction(self, row, n, slip, slight):
        """Choose the bound of friction of a row for this substep, which none of its passes changes.

        What stuck at the end of the last substep is held by static friction; what slid is braked by dynamic friction, and held by
        static friction once its slip has vanished. What comes to touch slides where its slip is more than forces make of it.
        slip: across the normal at the start of the passes. slight: by how much forces move its particles [m].
        """
        e = self.entry.field[row]
        if not self.is_set(self.memory.field[e]):
            self.slid.field[e] = ti.cast(slip.norm() > ti.static(SLOW) * slight, ti.i32)

    @ti.func
    def friction_bound(self, row, across, n):
        """Return the coefficient of friction of a row whose impulse across the normal n is `across`."""
        f = self.friction.field[row]
        out = f[0]
        if f[1] < f[0]:
            if self.slid.field[self.entry.field[row]] != 0:
                if not across.dot(self.braking(row, n)) < 0:  # else it brakes no more, but holds
                    out = f[1]
        return out

    @ti.func
    def braking(self, row, n):
        """Return the impulse across the normal of the last substep."""
        p = self.memory.field[self.entry.field[row]]
        return p - p.dot(n) * n

    @ti.func
    def note_slip(self, row, p, n, slip, slight):
        """Note whether a row slides at the end of the substep: with all of its friction, and other than by what passes lack.

        p: its impulse, with those of impacts in turn. slip, slight: as in bound_friction(), at the end.
        """
        e, load = self.entry.field[row], p.dot(n)
        across = p - load * n
        bound = self.friction_bound(row, across, n)
        brakes = self.slid.field[e] != 0 and bound < self.friction.field[row][0]
        full = load > 0 and across.norm() >= (1 - ti.static(FULL)) * bound * load
        slides = full and (brakes or slip.norm() > ti.static(SLIPS) * slight)
        self.slid.field[e] = ti.cast(slides, ti.i32)

    @ti.func
    def work_of_others(self, i):
        """Return the work of the rows of particle i on what they do not move: walls, driven particles, a periodic box sheared.

        It is times h^2 [kg m^2]."""
        out, pressed = ti.cast(0, ti.f64), self.pressed[i]
        for row in range(self.kept[i], pressed):
            p = self.vector(self.p.field[row], self.normal.field[row])
            for k in ti.static(range(self.ends)):
                if not self.state.moves(self.pressed_on(row, k)):
                    out += self.part(row, k) * p.dot(self.state.d[self.pressed_on(row, k)])
            if ti.static(bool(self.edges)):
                if not self.state.moves(i):
                    out -= p.dot(self.state.d[i])
        if ti.static(self.sheared):
            for row in range(self.own[i], pressed):
                sheared = self.state.relative_displacement(0 * self.state.d[i], i, self.other.field[row])
                out -= self.vector(self.p.field[row], self.normal.field[row]).dot(sheared)
        if ti.static(len(self.walls) > 0):
            for row in range(pressed, self.end[i]):
                out += self.vector(self.p.field[row], self.normal.field[row]).dot(self.moved.field[row])
        return out

    @ti.func
    def find_pair(self, i, j, e, row, scale):
        """List the pair at entry e of particle i if it may press. Returns the next free row."""
        r = self.state.separation(i, j)
        u = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
        p, distance = self.memory.field[e], self.geometry.contact_distance(i, j)
        least = ti.min(self.radius.of(i), self.radius.of(j))
        rr, near = r.dot(r), distance + ti.static(SLOP) * least
        # Nearest on the way: what passes each other within the substep touches there.
        uu, ru, start = u.dot(u), r.dot(u), r - u
        passes = (ru > 0) & (ru < uu) & (rr * uu - ru * ru < distance * distance * uu)
        # Where one of them is stopped, the other one goes on. Only pairs that a valid list has for sure.
        goes = ti.max(-start.dot(self.state.d[i]), start.dot(self.state.d[j]))
        reach = distance + ti.min(ti.static(AHEAD) * least, self.ahead)
        ahead = (start.dot(start) - distance * distance < 2 * goes) & (rr < reach * reach)
        if ti.static(bool(self.impacts)):  # what is struck may go anywhere
            reach = distance + self.ahead
            ahead = rr < reach * reach
        lists = (rr < near * near) | self.is_set(p) | passes | ahead  # without branches: half of the pairs are apart
        if ti.static(not self.table.uniform):
            lists = lists and ti.cast(self.table.of(i, j)[TOUCH], ti.i32) == TOUCHES
        if lists:
            length = start.norm()
            bend, gap = 1 / length, ti.max(length - distance, 0)
            n = bend * start
            if length > near and uu > 0:  # a pair that meets in this substep has the normal of the time when it does
                before, closing = length * length - distance * distance, -start.dot(u)
                root = closing * closing - uu * before
                if root >= 0 and closing > 0 and before <= closing + ti.sqrt(root):
                    s = before / (closing + ti.sqrt(root))
                    n, bend = (start + s * u) / distance, 1 / distance
                    gap = -s * u.dot(n)
            if not length > ti.static(2.0**-40) * distance:
                n, bend = self.geometry.fallback_normal(i, j, r), 1 / distance
            if ti.static(self.bounces):
                c = self.table.of(i, j)
                self.bounce.field[row], self.time.field[row] = 0, 1
                if ti.static(bool(self.impacts)):
                    self.impacts.begin(row, c[RESTITUTION], length - distance, 1 / length, start, least, self.is_set(p))
                else:
                    f, f_own = self.state.kick(i), self.state.kick(i)
                    if self.state.moves(j):
                        f_other = self.state.kick(j)
                        f -= f_other
                        f_own = ti.select(f_own.dot(f_own) > f_other.dot(f_other), f_own, f_other)
                    hit, s, m = self.strike(length - distance, start, 1 / length, u, f, f_own, c[RESTITUTION], e, rr)
                    if hit:
                        n, self.bounce.field[row], self.time.field[row] = m, c[RESTITUTION], s
            self.put(row, j, e, n, gap, bend, p * scale)
            if ti.static(self.has_friction):
                c = self.table.of(i, j)
                self.friction.field[row] = [c[STATIC], c[DYNAMIC]]
            if ti.static(self.turns):
                c, a, b = self.table.of(i, j), self.radius.of(i), self.radius.of(j)
                rolling, twisting, back = 0 * a, 0 * a, 0 * a
                if ti.static(self.table.turns):
                    rolling, twisting, back = c[ROLLING], c[TWISTING], c[TANGENTIAL]
                self.put_turn(row, e, a / ti.max(a + b, FEW), b / ti.max(a + b, FEW), rolling, twisting, back, scale)
            row += 1
        else:
            self.forget(e)
        return row

    @ti.func
    def forget(self, e):
        """Forget what the pair or wall at entry e bore: it does not press."""
        self.memory.field[e] = self.zero()
        if ti.static(self.has_friction):
            self.slid.field[e] = 0
        if ti.static(self.bounces):
            self.touched.field[e] = 0
            self.given.field[e] = 0
        if ti.static(self.turns):
            self.borne_moment.field[e] = ti.Vector.zero(self.real, self.axes)

    @ti.func
    def strike(self, gap, way, bend, u, f, f_own, e, entry, size):
        """Return whether a row bounces in this substep, the part of the substep before its impact, and the normal then.

        gap, way, bend: see meeting(). u: relative displacement. f: by forces in the substep, f_own: of the particle that has
        more. e: restitution. The path is u s - f s (1 - s) / 2 after the part s.
        What touched goes on together, so that what stands on each other bounces as a whole. What comes back within the substep
        rests.
        """
        hit, v, s, m = False, u - f / 2, ti.cast(1, self.real), way
        if e > 0 and not (gap <= 0 and self.touched.field[entry] != 0):
            s, m = meeting(gap, bend, way, 0 * u, v, f, ti.cast(1, self.real), ti.cast(0, self.real))
            met = -(v + f * s).dot(m)
            blur = self.rounding * (u.norm() + ti.sqrt(size) * ti.static(2.0**-7))
            least = ti.static(SLOW) * ti.max(self.whole[None], 1) * f_own.norm() + blur
            rests = e * met <= ti.max(-f.dot(m), 0) * (1 - s) / 2
            hit = 0 <= s and (s - 1) * met <= blur and gap >= -met and met > least and not rests
            s = ti.min(s, 1)
        return hit, s, m

    @ti.func
    def bounced(self, row):
        """Whether a row bounced that bears no load."""
        out = self.bounce.field[row] > 0
        if ti.static(bool(self.impacts)):
            out = out and self.impacts.joined.field[row] != TOGETHER
        return out

    @ti.func
    def count_hits(self, i):
        """Return how many rows of particle i bounce in this substep."""
        out = ti.cast(0, self.real)
        for row in range(self.begin[i], self.end[i]):
            if self.bounce.field[row] > 0:
                out += 1
        return out

    @ti.func
    def aim(self, i, when):
        """Set what the bouncing rows of particle i aim at. when: the part of the substep before the impact of its island.

        They leave at e times their approach at that time, or as impacts in turn have thrown them; displacements are those in
        the middle of the substep.
        """
        self.when[i] = when
        for row in range(self.begin[i], self.end[i]):
            if ti.static(self.turns):
                if self.bounce.field[row] == 0:
                    self.across.field[row] = 0 * self.across.field[row]
            if self.bounce.field[row] > 0:
                other, n, then = self.other.field[row], self.normal.field[row], when
                if ti.static(bool(self.impacts)):
                    then = self.time.field[row]
                f = self.relative_kick(i, row)
                u = self.relative(self.state.d[i], self.state.d, i, other, row, self.pressed[i])
                if ti.static(self.turns):  # the points that touch leave across n at -e_t times their velocity then
                    s = self.state.spin.s[i]
                    if row < self.pressed[i]:
                        s += self.state.spin.s[other]
                    shift = (then - 0.5) * (f - f.dot(n) * n)
                    slip = u - u.dot(n) * n - self.state.spin.surface(s, n) + shift
                    self.across.field[row] = -self.across.field[row][0] * slip - shift
                if ti.static(bool(self.impacts)):
                    self.impacts.aim(i, row)
                else:
                    later = (then - 0.5) * f.dot(n)
                    self.target.field[row] = ti.max(-u.dot(n) - later, 0) * self.bounce.field[row] - later

    @inline
    def rise(self, tt, un, bend):
        """Return by how much a gap with this curvature opens where the particle moves by sqrt(tt) across its normal and by un
        along it: sqrt((1 / bend + un)^2 + tt) - (1 / bend + un), to fourth order [m]."""
        q = impl.expr_init(bend * tt)
        return q * (0.5 - ti.min(ti.abs(bend * q), 1) / 8 - ti.min(ti.max(bend * un, -0.5), 0.5) / 2)

    @ti.func
    def goes_past(self, gap, bend, u, un):
        """Whether a particle that moves by u, and by un along its normal, goes past the corner of a wall in this substep.

        Where it is r = 1 / bend away from the corner, its path is r |u_t| / |u| away at its nearest, after the part -r un / u^2.
        The gap to the plane across the normal would be below 0 beyond.
        """
        out, uu = False, u.dot(u)
        if bend > 0 and un < 0 and -un <= bend * uu:
            r = 1 / bend
            out = r * r * (uu - un * un) > (r - gap) * (r - gap) * uu
        return out

    @ti.func
    def put(self, row, other, e, n, gap, bend, p):
        """Write a row. p: the impulse that it bore; what is left of it along the normal and within friction is kept."""
        self.other.field[row], self.entry.field[row] = other, e
        self.normal.field[row], self.gap.field[row], self.bend.field[row] = n, gap, bend
        self.p.field[row], self.step.field[row] = p, 0 * p

    @ti.func
    def put_turn(self, row, e, arm, other_arm, rolling, twisting, back, scale):
        """Write what a row needs against rolling. back: tangential restitution, kept in `across` until aim()."""
        self.arms.field[row], self.rolling.field[row] = [arm, other_arm], [rolling, twisting]
        f = scale * self.borne_moment.field[e]
        self.f.field[row], self.f_step.field[row] = f, 0 * f
        across = ti.Vector.zero(self.real, self.dim)
        across[0] = back
        self.across.field[row] = across

    @ti.func
    def find_wall(self, i, e, row, scale):
        """List the wall at entry e of particle i if it may press. Returns the next free row."""
        face, p = self.list.neighbour[e] - WALL, self.memory.field[e]
        lists = False
        for group, w in ti.static([(g, g.wall) for g in self.walls]):
            if group.has_face(face):
                group.enter(group.wall_of(face))
                gap, n, bend, moved = w.gap(group.side_of(face), i, self.radius.of(i), self.frame_fraction[None], True)
                u = self.state.d[i] - moved
                un = u.dot(n)
                ahead = gap + un
                if ti.static(w.bends):
                    ahead += self.rise(u.dot(u) - un * un, un, bend)
                if ti.static(bool(self.impacts)):  # what is struck may go anywhere
                    ahead = ti.min(ahead, gap + un - self.ahead)
                near = ti.cast(SLOP, self.real)
                if ti.static(bool(self.slots) and not self.bounces):
                    if self.slots.begin[i + 1] > self.slots.begin[i]:  # what links hold, others may press there in the substep
                        near = ti.cast(AHEAD, self.real)
                # What it bore, it may still bear; but an open side, which is nowhere, has no row.
                lists = ahead < ti.select(self.is_set(p), 1, near) * self.size(i)
                if ti.static(w.bends):
                    lists = lists and not self.goes_past(gap, bend, u, un)
                if ti.static(w.dev.surface.has_switch):
                    lists = lists and w.dev.surface.active[None] != 0
                if ti.static(w.dev.surface.is_one_way):
                    depth = ti.select(self.bore(i, group, face), 0 * gap, -gap - ti.static(SLOP * BEYOND) * self.radius.of(i))
                    reach = self.radius.of(i) + ti.cast(w.radius, self.real)
                    lists = lists and not w.dev.surface.lets_through(i, w.in_frame_of_one_way(n), depth, reach)
                if lists:
                    if ti.static(self.bounces):
                        self.bounce.field[row], self.time.field[row] = 0, 1
                        e_wall, way = 0 * gap, n
                        if bend != 0:
                            way = n / bend
                        if ti.static(w.dev.surface.has_restitution):
                            e_wall = w.dev.surface.restitution[None]
                        if ti.static(bool(self.impacts)):
                            self.impacts.begin(row, e_wall, gap, bend, way, self.radius.of(i), self.is_set(p))
                        else:
                            # On the path on which the loads of the last substep go on: what slides over level walls is borne.
                            f, reach, borne = self.state.kick(i), self.state.place(i), scale * self.borne[i]
                            hit, s, m = self.strike(gap, way, bend, u + borne, f + borne, f, e_wall, e, reach.dot(reach))
                            if hit:
                                n, self.bounce.field[row], self.time.field[row] = m, e_wall, s
                    self.put(row, face + WALL, e, n, gap, bend, p * scale)
                    if ti.static(w.dev.surface.has_velocity):
                        belt = w.dev.surface.velocity[None]
                        along = self.h[None] * (belt - belt.dot(n) * n)
                        moved += along
                        if ti.static(self.belts):
                            self.impacts.belt.field[row] = along
                    elif ti.static(self.belts):
                        self.impacts.belt.field[row] = 0 * n
                    self.moved.field[row] = moved
                    if ti.static(self.has_friction):
                        self.friction.field[row] = [0, 0]
                        if ti.static(w.dev.surface.has_friction):
                            self.friction.field[row] = [w.dev.surface.static(), w.dev.surface.dynamic()]
                    if ti.static(self.turns):
                        turning, one = ti.Vector.zero(self.real, 3), ti.cast(1, self.real)
                        if ti.static(w.dev.surface.turns):
                            turning = w.dev.surface.rolling[None]
                        self.put_turn(row, e, 0 * one, one, turning[0], turning[1], turning[2], scale)
        if lists:
            row += 1
        return row

    @ti.func
    def level(self, i, end):
        """Let particle i get as deep into each of its walls as it lies in another that faces the same way, up to the slop.

        So what slides over level walls does not catch on their corners, nor bounces off them. end: the row behind the last.
        """
        deepest, depth, up = -1, ti.cast(0, self.real), 0 * self.state.x[i]
        for row in range(self.pressed[i], end):
            if -self.gap.field[row] > depth:
                deepest, depth, up = row, -self.gap.field[row], self.normal.field[row]
        depth = ti.min(depth, ti.static(SLOP * BEYOND) * self.size(i))
        for row in range(self.pressed[i], end):
            n = self.normal.field[row]
            if row != deepest:
                self.gap.field[row] += depth * ti.max(up.dot(n), 0)
                if ti.static(self.bounces and not self.impacts):
                    u = self.state.d[i] - self.moved.field[row]
                    if self.gap.field[row] + u.dot(n) + self.rise(u.dot(u) - u.dot(n) ** 2, u.dot(n), self.bend.field[row]) > 0:
                        self.bounce.field[row] = 0
            self.gap.field[row] = ti.max(self.gap.field[row], 0)

    @ti.func
    def marked(self, i, row, p):
        """Return the impulse p of a row, to remember; other than 0 at a one-way wall that holds particle i, for bore()."""
        for group in ti.static(self.one_way):
            if row >= self.pressed[i] and not self.is_set(p):
                if group.has_face(self.other.field[row] - WALL):
                    if ti.static(self.has_friction):
                        p = ti.static(FEW) * self.normal.field[row]
                    else:
                        p += ti.static(FEW)
        return p

    @ti.func
    def bore(self, i, group: ti.template(), face):  # type: ignore[valid-type]
        """Whether the wall with this face held particle i in the last substep, by any of its faces."""
        out, begin = False, self.list.first[i] + self.list.number[i]
        for e in range(begin, begin + self.list.wall_number[i]):
            other = self.list.neighbour[e] - WALL
            if group.has_face(other):
                out = out or (self.is_set(self.memory.field[e]) and group.wall_of(other) == group.wall_of(face))
        return out

    @ti.func
    def log_wall(self, i, row):
        """Record the impulse of a wall in its log of events, if it presses."""
        n, side = self.normal.field[row], self.other.field[row] - WALL
        p = self.along(self.p.field[row], n) + self.hit(row)
        if p > 0:
            moved = self.moved.field[row]
            ahead = (self.state.d[i] - moved).dot(n)
            for group in ti.static(self.logging):
                if group.has_face(side):
                    push = p * self.state.w[i]
                    group.wall.dev.log.record(i, -(self.gap.field[row] + ahead), n, push, -ahead, moved, self.h[None], False)

    @ti.func
    def most_parting(self, radius, push_out):
        """Return by how much what overlaps may part in the substep [m]. radius: the smaller one; a point has none."""
        return ti.select(push_out < 0, ti.select(radius > 0, ti.static(QUARTER) * radius, self.ahead), push_out * self.h[None])

    @ti.func
    def depth_in_walls(self, i):
        """Return how deep particle i is in the walls of its rows, relative to its size."""
        worst = ti.cast(0, self.real)
        if ti.static(len(self.walls) > 0):
            for row in range(self.pressed[i], self.end[i]):
                gap, _n, _push_out = self.wall_gap(i, self.other.field[row] - WALL)
                worst = ti.max(worst, -gap / ti.max(self.size(i), FEW))
        return worst

    @ti.func
    def wall_gap(self, i, face):
        """Return the gap of particle i at a wall at the end of the substep [m], its normal, and at what speed it lets out."""
        gap, n, push_out = ti.cast(1, self.real), 0 * self.state.x[i], ti.cast(-1, self.real)
        for group, w in ti.static([(g, g.wall) for g in self.walls]):
            if group.has_face(face):
                group.enter(group.wall_of(face))
                gap, n, _bend, _moved = w.gap(group.side_of(face), i, self.radius.of(i), self.frame_fraction[None], False)
                push_out = w.dev.surface.push_out[None]
        return gap, n, push_out
