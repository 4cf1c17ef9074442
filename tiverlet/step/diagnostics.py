"""End-of-frame diagnostics: one pass over the state computes the figures of the report."""

import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from ..constraints.core.corner_passes import LOST
from ..device import runtime, ti
from ..device.number import OnDevice
from ..device.thread_team import LEAST
from ..features.feature import FAR
from ..forces.gravity import Gravity
from ..neighbours.cell_list import FARTHEST
from ..particles import LARGEST
from ..solvers.slots import SLIGHT, TENSEST
from ..solvers.solver import Solver
from .force_stiffness import ForceStiffness
from .integrator import STIFF
from .span import END, FIGURES, ORIGIN, SHEET, H, integer
from .step_report import COMPRESSED, UNCONVERGED, StepReport

if TYPE_CHECKING:
    from .step import Step

BLOCKS = 64  # partial sums: a fixed number, so the total is the same bit for bit on any number of threads; squared on a GPU
TURNS = (0, 26, 41)  # degrees, for 0, BENT and FAR

# The origin of a state: an ordinary substep; a substep that was a start (the first after velocities were set); no substep yet.
STEPPED, STARTED, UNSTEPPED = range(3)
ROUGH = 0.25  # of an overlap: the rounding of coordinates from which on it is the cause
BARE = 3  # added to one of these if only the energy is needed
# Indices on the sheet: energy, overlap, (omega h)^2 of forces, largest coordinate, kinetic energy, edges of the bounding box, and
# by how much passes have softened springs: the work of loads on violations, by that on compliance plus the kinetic energy.
ENERGY, OVERLAP, STIFFNESS, REACH, KINETIC, EXTENT, SOFTENED = 0, 2, 3, 7, 11, 12, 15
TOO_SOFT = 0.05  # of the energy of springs and of motion: what passes may add to it, before springs are told to be too soft


@ti.data_oriented
class Diagnostics:
    """Computes the figures of a StepReport, on the sheet of a frame, in the order in which report() reads them.

    A frame that is one launch ends with this; a frame that is launched phase by phase ends with the launch of measure().
    state_origin: STEPPED, STARTED or UNSTEPPED, plus BARE.
    """

    host_only = ("sheet", "report", "details", "force_stiffness")
    has_own_compile_time = True  # its compile time is reported by itself, as that of a Feature
    n: Any = OnDevice()  # particles

    def __init__(self, step: "Step", solver: Solver):
        self.step: Any = step
        self.team = step.team
        self.n, self.dim, self.state = step.scene.count, step.dim, step.state
        self.batches = step.batches
        self.contacts = step.contacts
        self.bits: Any = ti.u32 if step.real == ti.f32 else ti.u64
        self.exponent = 0x7F800000 if step.real == ti.f32 else 0x7FF0000000000000  # of numbers that are not finite
        self.pair_forces = step.pair_forces
        self.measured = [f for f in self.pair_forces if f.potential_arity]
        self.width = 11 if self.pair_forces else 9
        self.stride = step.stride
        add = step.scene.memory.field
        self.blocks = BLOCKS if runtime.architecture() == "cpu" else BLOCKS**2
        if step.scene.memory.copies:
            # One block per particle or constraint, if there are few: the sums are the same, and small worlds a fifth as large.
            most = max([step.scene.particles.count, *(b.members.count for b in step.batches)], default=1)
            self.blocks = min(BLOCKS, 1 << max(2, (most - 1).bit_length()))
        self.alone = step.team.size == 1 and not step.team.launched  # one thread computes all, and needs no partial sums
        if not self.alone:
            self.parts = add("survey.figures", self.blocks, width=self.width, kind=ti.f64)
            self.low = add("survey.low", self.blocks, width=self.dim, kind=ti.f64)
            self.high = add("survey.high", self.blocks, width=self.dim, kind=ti.f64)
        self.details: dict[int, Residuals] = {}  # by the id of a batch; compiled at the first call
        self.force_stiffness = ForceStiffness(step)
        self.sheet: Any = np.zeros(SHEET)
        self.report = Reporter(step, solver, self.sheet)
        step.diagnostics = self

    def __repr__(self) -> str:
        return "report"

    def of(self, step: "Step") -> "Diagnostics":
        """Return a copy with the same fields, for another Step."""
        new = copy.copy(self)
        new.step, new.details, new.force_stiffness = step, {}, ForceStiffness(step)
        step.diagnostics = new
        return new

    @ti.func
    def finite(self, x):
        """Return 1 if x is finite, by the bits of its exponent: Taichi's comparisons with NaN are not reliable."""
        exponent, largest = self.bits(self.exponent), self.bits(0)
        for k in ti.static(range(x.n)):
            largest = ti.max(largest, ti.bit_cast(x[k], self.bits) & exponent)
        return ti.cast(largest != exponent, ti.i32)

    @ti.func
    def energy(self, i, x, scale, back):
        """Return kinetic plus potential energy at x - back d, and the kinetic energy alone, in f64.

        Second order in the middle of a substep, where d / h is the velocity.
        """
        out, kinetic = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        if self.state.w[i] > 0:
            out, kinetic = self.energy_per_mass(i, x, scale, back)
            out /= self.state.w[i]
            kinetic /= self.state.w[i]
            for f in ti.static(self.measured):
                out += f.energy(i, back)
        return out, kinetic

    @ti.func
    def energy_per_mass(self, i, x, scale, back):
        """Return energy() per mass, without the energy of pair forces."""
        d = self.state.d[i] * ti.cast(1, ti.f64)
        kinetic = 0.5 * scale * scale * d.dot(d)
        out = kinetic
        for f in ti.static(self.step.integrator.forces.all):
            if ti.static(f.conservative):
                out += f.potential(i, ti.cast(x, ti.f64) - back * d)
        if ti.static(self.state.spins):
            turning = scale * scale * self.state.spin.energy(i)
            out += turning
            kinetic += turning
        return out, kinetic

    @ti.func
    def stiffness(self, i, x, h, t):
        """Return (omega h)^2 of the dominant motion of particle i.

        This is the Rayleigh quotient of forces along the last displacement, or the rate at which they turn the velocity.
        """
        d = self.state.d[i]
        dd, out = d.dot(d), ti.cast(0, ti.f64)
        if dd > 0 and self.state.w[i] > 0:
            out = -self.step.integrator.forces.change_along(i, x, d, h, t).dot(d) / dd * h * h
            if ti.static(self.step.integrator.uses_velocity):
                out = ti.max(out, ti.cast(self.step.integrator.forces.velocity_stiffness(i, x, d / h, t, h), ti.f64))
        return out

    @ti.func
    def pair_stiffness(self, i, h):
        """Return the share of particle i in the two sums of the Rayleigh quotient of pair forces, taken over all particles."""
        d, change, moved = self.state.d[i] * ti.cast(1, ti.f64), ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        if self.state.w[i] > 0:
            for f in ti.static(self.pair_forces):
                change -= h * h * (f.dev.now[i] - f.dev.last[i]).dot(d) / self.state.w[i]
            moved = d.dot(d) / self.state.w[i]
        return change, moved

    @ti.func
    def empty_figures(self):
        """Return the figures and the bounding box of nothing, from which sums begin."""
        zero, figures = ti.Vector.zero(ti.f64, self.dim), ti.Vector.zero(ti.f64, self.width)
        figures[5] = 2.0**31
        return figures, zero + ti.math.inf, zero - ti.math.inf

    @ti.func
    def block(self, b, h, t, frame_fraction, fresh, begin, bare):
        """Return the figures of block b of particles and constraints, and its bounding box, low and high.

        Figures: energy, residual, overlap, stiffness, contacts, bad, kinetic energy, the two sums of softening(); with pair
        forces also those of pair_stiffness(). begin: 1 before the first substep. bare: 1 to leave out overlap, stiffness,
        contacts and the box.
        """
        figures, low, high = self.empty_figures()
        scale, back = ti.cast(1, ti.f64), ti.cast(0, self.step.real)
        if begin == 0:
            scale, back = 1 / ti.cast(h, ti.f64), ti.cast(0.5, self.step.real)
        size = (self.n + self.blocks - 1) // self.blocks
        for i in range(b * size, ti.min((b + 1) * size, self.n)):
            x = self.state.place(i)
            sound = self.finite(x) & self.finite(self.state.d[i])
            if ti.static(self.state.spins):
                sound &= self.finite(self.state.spin.s[i])
            if sound == 0:
                figures[5] = ti.min(figures[5], ti.cast(i, ti.f64))
            else:
                if bare == 0:
                    low, high = ti.min(low, ti.cast(x, ti.f64)), ti.max(high, ti.cast(x, ti.f64))
                energy, kinetic = self.energy(i, x, scale, back)
                figures[0] += energy
                figures[6] += kinetic
                if ti.static(len(self.step.integrator.forces.uneven) > 0):
                    if begin == 0 and bare == 0:
                        figures[3] = ti.max(figures[3], self.stiffness(i, x, h, t))
                if ti.static(len(self.pair_forces) > 0):
                    if begin == 0:
                        change, moved = self.pair_stiffness(i, h)
                        figures[9] += change
                        figures[10] += moved
                for c in ti.static(self.contacts):
                    if bare == 0:
                        touching, worst = c.worst_overlap(i)
                        figures[2] = ti.max(figures[2], worst)
                        figures[4] += touching
        h2_effective = ti.select(begin == 0, self.step.integrator.h2_effective(h, fresh), 0 * h)
        for f in ti.static(self.batches):
            part = (f.count + self.blocks - 1) // self.blocks
            for c in range(b * part, ti.min((b + 1) * part, f.count)):
                residual = 0 * h
                if begin == 0:
                    residual = f.dev.residual_of(c, h, h2_effective, frame_fraction, fresh)
                    figures[1] = ti.max(figures[1], ti.cast(residual, ti.f64))
                    left, given = f.dev.softening(c, h2_effective, residual)
                    figures[7] += left
                    figures[8] += given
                figures[0] += f.dev.energy(c, back, h2_effective, residual)
        return figures, low, high

    @ti.func
    def block_of(self, b, h64, t64, state_origin):
        """Return block() for a state of this origin, at the end of a frame."""
        fresh, begin = ti.cast(state_origin % BARE == STARTED, ti.i32), ti.cast(state_origin % BARE == UNSTEPPED, ti.i32)
        h, t, fraction = ti.cast(h64, self.step.real), ti.cast(t64, self.step.real), self.step.integrator.frame_fraction(0, 1)
        return self.block(b, h, t, fraction, fresh, begin, ti.cast(state_origin >= BARE, ti.i32))

    @ti.func
    def filled(self):
        """Return how many blocks may contain something. Empty blocks would not change a bit of the sums."""
        out = self.blocks
        if ti.static(self.blocks <= BLOCKS):
            most = ti.cast(self.n, ti.i32)
            for f in ti.static(self.batches):
                most = ti.max(most, f.count)
            out = ti.min(self.blocks, most)
        return out

    @ti.func
    def reduce_blocks(self, thread, h64, state_origin):
        """Compute the sums that residuals of constraints on any number of particles need."""
        h, fresh = ti.cast(h64, self.step.real), ti.cast(state_origin % BARE == STARTED, ti.i32)
        self.step.constraints.reduce_blocks(thread, h, self.step.integrator.h2_effective(h, fresh), 0, fresh, False)

    @ti.kernel
    def measure(self, sheet: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """Write all figures to the sheet, and whether the frame stopped for a list."""
        h64, t64, state_origin = sheet[H], sheet[END], integer(sheet, ORIGIN)
        self.reduce_blocks(0, h64, state_origin)
        self.sum_up(0, h64, t64, state_origin, sheet)
        self.step.write_halt(sheet)

    @ti.func
    def sum_up(self, thread, h64, t64, state_origin, sheet: ti.template()):  # type: ignore[valid-type]
        """Write the figures to the sheet: sum up blocks; on a GPU, groups of blocks; then the rest on one thread."""
        filled = self.filled()
        if ti.static(not self.alone):
            for k in range(
                self.team.chunk_begin(filled * self.stride, thread), self.team.chunk_end(filled * self.stride, thread)
            ):  # fmt: skip
                if k % self.stride == 0:
                    b = k // self.stride
                    self.parts[b], self.low[b], self.high[b] = self.block_of(b, h64, t64, state_origin)
            self.team.wait()
            if ti.static(self.blocks > BLOCKS):
                for k in range(BLOCKS):
                    self.parts[k * BLOCKS], self.low[k * BLOCKS], self.high[k * BLOCKS] = self.fold(k * BLOCKS, 1, BLOCKS)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            for k in range(FIGURES):
                sheet[k] = 0  # entries that no kernel writes would come back from a GPU with old values
            total, low, high = self.empty_figures()
            if ti.static(self.alone):
                for b in range(filled):
                    part, lower, higher = self.block_of(b, h64, t64, state_origin)
                    total, low, high = self.with_part(total, low, high, part, lower, higher)
            else:
                total, low, high = self.fold(0, max(1, self.blocks // BLOCKS), ti.min(filled, BLOCKS))
            for k in ti.static(range(6)):
                sheet[k] = total[k]
            sheet[KINETIC] = total[6]
            if total[7] > 0:
                sheet[SOFTENED] = total[7] / (total[8] + total[6])  # where all moves, a spring at its rest value bears no load
            if ti.static(len(self.pair_forces) > 0):
                if total[10] > 0:
                    sheet[3] = ti.max(sheet[3], total[9] / total[10])
            if ti.static(self.step.integrator.forces.has_unresolved):
                sheet[3] = ti.max(sheet[3], self.step.integrator.forces.encounter(sheet[3], total[6]))
            if low[0] <= high[0]:
                for k in ti.static(range(self.dim)):
                    sheet[REACH] = ti.max(sheet[REACH], -low[k], high[k])
                    sheet[EXTENT + k] = high[k] - low[k]
            for c in ti.static(self.contacts):
                sheet[6] = c.dev.fast[None]
                c.dev.fast[None] = 0
            if ti.static(len(self.step.breakers) > 0):
                sheet[8] = self.step.slots.broken[None]
                self.step.slots.broken[None] = 0
            if ti.static(len(self.batches) > 0):
                sheet[10] = self.step.slots.turned[None]
                self.step.slots.turned[None] = 0
                if ti.static(self.step.slots.converges):
                    sheet[9] = self.step.slots.tension[None]
                    self.step.slots.tension[None] = 0

    @ti.func
    def fold(self, begin, step: ti.template(), count):  # type: ignore[valid-type]
        """Return the total of `count` parts, `step` apart, from `begin` on."""
        total, low, high = self.empty_figures()
        for b in range(count):
            at = begin + b * step
            total, low, high = self.with_part(total, low, high, self.parts[at], self.low[at], self.high[at])
        return total, low, high

    @ti.func
    def with_part(self, total, low, high, part, lower, higher):
        """Return figures and bounding box with those of one more part added."""
        total[0] += part[0]
        total[4] += part[4]
        for k in ti.static(range(6, self.width)):
            total[k] += part[k]
        for k in ti.static(range(1, 4)):
            total[k] = ti.max(total[k], part[k])
        total[5] = ti.min(total[5], part[5])
        return total, ti.min(low, lower), ti.max(high, higher)

    def residuals(self, batch, h: float, fresh: bool) -> np.ndarray:
        """Return the residuals of the constraints of a batch after the last substep, (m,). fresh: whether it was a start."""
        out = np.zeros(max(1, batch.count))
        if id(batch) not in self.details:
            self.details[id(batch)] = Residuals(self, batch)
        self.details[id(batch)].measure(h, int(fresh), out)
        return out[: batch.count]


@ti.data_oriented
class Residuals:
    """The kernel that computes the residuals of one batch."""

    def __init__(self, diagnostics: Diagnostics, batch):
        self.diagnostics, self.step, self.batch = diagnostics, diagnostics.step, batch

    @ti.kernel
    def measure(self, h64: ti.f64, fresh: ti.i32, out: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """Write the residual of every constraint to `out`."""
        if ti.static(self.step.team.size == 1):
            self.diagnostics.reduce_blocks(0, h64, fresh)
        elif ti.static(len(self.step.constraints.ragged) > 0):
            for thread in range(self.step.team.loop_length):
                if thread % LEAST == 0:
                    self.diagnostics.reduce_blocks(thread // LEAST, h64, fresh)
        for c in range(self.batch.count):
            h = ti.cast(h64, self.step.real)
            fraction = self.step.integrator.frame_fraction(0, 1)
            out[c] = self.batch.dev.residual_of(c, h, self.step.integrator.h2_effective(h, fresh), fraction, fresh)


class Reporter:
    """Makes a StepReport from the figures on the sheet."""

    def __init__(self, step: "Step", solver: Solver, sheet: np.ndarray):
        self.solver, self.scene, self.batches, self._step = solver, step.scene, step.batches, step
        self.remedy: str | None = None  # the setting that meets constraints better, computed when it is first needed
        self.fastest = step.integrator.fastest
        self.regroup()
        self.figures, self.sheet = sheet[: EXTENT + step.dim], sheet

    def regroup(self) -> None:
        """Set the number of particles and the largest valid coordinate, after particles or constraints were added or removed."""
        search, self.n, self.remedy = self._step.search, self._step.n, None
        self.farthest = min(LARGEST, search.finest * FARTHEST) if search else LARGEST

    def __call__(
        self,
        time: float,
        h: float,
        substeps: int,
        iterations: int,
        before: float | None,
        pressed: float,
        moved: float,
        released: float,
        asleep: int = 0,
    ) -> tuple[StepReport, list[float]]:
        """Return the report of a frame, and the edges of the bounding box [m].

        before: the energy one frame ago [J]. pressed: the overlap then [radii]. moved: the longest move of a particle before the
        first substep [m]. released: see Runner.
        """
        energy, residual, overlap, stiff, contacts, bad, fast, reach, broken, tension, turned, _, *extent = self.figures.tolist()
        stiff, soft = max(stiff, self.fastest * h * h), float(self.sheet[SOFTENED])
        first = int(bad) if bad < self.n else None
        notes = {}
        for flag, there in risks(
            self.n, self.farthest, bad, reach, fast, overlap, pressed, turned, moved, tension, soft, stiff, released, residual
        ).items():  # fmt: skip
            if there:
                notes[flag] = self._note(
                    flag, first, reach, overlap, moved, tension, soft, stiff, released, residual, substeps, h
                )
        damped = () if notes else self._damped(residual, substeps)
        report = StepReport.of(
            {
                "time": time,
                "substeps": substeps,
                "iterations": iterations,
                "residual": residual,
                "overlap": overlap,
                "contacts": int(contacts),
                "energy": energy,
                "energy_change": 0.0 if before is None else energy - before,
                "flags": frozenset(notes),
                "notes": (*notes.values(), *damped),
                "bad": first,
                "broken": int(broken),
                "asleep": asleep,
                "turn": TURNS[int(turned)],
                "tension": tension,
                "tries": 1,
                "seconds": 0.0,
            }
        )
        return report, extent

    def _damped(self, residual: float, substeps: int) -> tuple[str, ...]:
        """A note where solvers that converge leave constraints off by so much that they act along their directions at the end of
        the substep, which takes angular momentum from what turns, see CornerPasses. No flag: a load may do it to what is at
        rest."""
        slots = self.scene.slots
        relaxes = slots and (slots.semi_iteration or (slots.system and slots.system.steps))
        if not relaxes or residual <= LOST:
            return ()
        need = np.ceil(substeps * residual / LOST)  # of order h or higher
        return (
            f"Constraints are off by {100 * residual:.3g} % of their size; beyond {100 * LOST:g} % they are damped: what turns "
            f"loses energy and angular momentum. Use up to {need:.7g} substeps, or more steps of the solver.",
        )

    def _fastest_move(self) -> float:
        """Return the longest move in the last substep, relative to the longest with which a particle passes no other."""
        d = self.scene.memory.read(self.scene.state.d)[: self.n].astype(np.float64)
        way, worst = np.linalg.norm(d, axis=1), 0.0
        for geometry in (c.dev.geometry for c in self._step.contacts):
            limit = geometry.radius.strides(self.scene.particles.radius)
            worst = max(worst, float((way / np.minimum(limit, getattr(geometry, "stride", np.inf))).max(initial=0.0)))
        return worst

    def _passed(self, overlap: float, moved: float, substeps: int) -> str:
        """Return what to do about particles that may have passed others. moved: by what they were placed."""
        far = max(self._fastest_move(), overlap)  # both of order h
        placed = moved > self.scene.particles.radius.min(initial=np.inf)
        why = (
            "Particles were moved past others to where their rigid constraints are met: only other places help. "
            if placed
            else ""
        )
        if placed and far <= 1:
            return why.strip()
        return (
            f"{why}A particle moved by more than its own size in one substep, or got deeper into a body than its middle, and may "
            f"have passed it. Use more substeps, at first {np.ceil(substeps * max(far, 2)):.7g}."  # the fastest may have stopped
        )

    def _rounding(self, reach: float) -> float:
        """Return what coordinates up to `reach` are rounded to in f32 [m]; 0 in other precisions."""
        single = self.scene.real == ti.f32 and not self.scene.state.compensated
        return float(np.spacing(np.float32(reach))) if single else 0.0

    def rounds_loads(self, reach: float, h: float) -> str:
        """Return what to do besides, where gravity moves particles by less in a substep than coordinates are rounded to; else "".

        There, the directions in which straight ropes and flat nets would carry it are rounding.
        """
        forces = self._step.integrator.forces.all
        fall = sum(float(np.linalg.norm(f.kernel_values()["g"])) for f in forces if isinstance(f, Gravity)) * h * h
        rounding = self._rounding(reach)
        if not 0 < fall < rounding:
            return ""
        return (
            f" Loads move particles by {fall:.2g} m in a substep, and coordinates are rounded to {rounding:.2g} m in f32: use "
            'precision="f64", too.'
        )

    def _less_overlap(self, reach: float, overlap: float, substeps: int) -> str:
        """Return what to do about an overlap, relative to a radius."""
        radius, rounding = self.scene.particles.radius, self._rounding(reach)
        if rounding > ROUGH * overlap * radius[radius > 0].min(initial=np.inf):
            return (
                f"Coordinates of {reach:g} m are rounded to {rounding:.2g} m in f32: shift the scene towards the origin, or use "
                'precision="f32-compensated".'
            )
        need = np.ceil(substeps * overlap / COMPRESSED)  # of order h after impacts, h^2 under loads
        given = [c.push_out for c in self._step.contacts if c.push_out is not None]
        placed = f"; what was placed so parts at push_out = {max(given):g} m/s" if given else ""
        return f"Use up to {need:.7g} substeps{placed}. Where they do not help, there is less room than particles need."

    def _note(self, flag, first, reach, overlap, moved, tension, soft, stiff, released, residual, substeps, h) -> str:
        """Return the note of a flag: its meaning and a remedy, with the figures of this frame."""
        if flag == "non-finite":
            return (
                f"The state of particle {first} is not finite (the first of them). tv.report.autopsy(world, seconds) names the "
                "cause, such as a function of yours that divides by 0; else go back and use a smaller step."
            )
        if flag == "out-of-range":
            return f"A coordinate is out of range: it reached {reach:g} m, and beyond {self.farthest:g} m the precision fails."
        if flag == "tunnelling-risk":
            return self._passed(overlap, moved, substeps)
        if flag == "compressed":
            return (
                f"Contacts are pressed or thrown together by more than they hold: the worst overlaps by {100 * overlap:.3g} % "
                "of the radius of the smaller particle (world.contacts.overlap tells which). "
                f"{self._less_overlap(reach, overlap, substeps)}"
            )
        if flag == "turned":
            return (
                "A constraint turned by more than 41 degrees in one substep; it is damped there, or, as a soft spring, pulls and "
                f"pushes as before it turned. Use more substeps, at first {2 * substeps}."
            )
        if flag == "moved":
            return (
                f"Particles were off their rigid constraints by a thousandth or more, and were moved by up to {moved:.3g} m "
                "to where these are met. Place them there, or give the constraints other rest values, or compliance."
            )
        if flag == "softened" and tension > TENSEST:
            return (  # the numbers may be infinite
                f"A tension makes particles vibrate too fast for the substep: omega h >= {np.sqrt(tension):.3g}, stable below 2. "
                f"Its constraints give way instead. Use {more(substeps, tension / TENSEST, 2)}.{self.rounds_loads(reach, h)}"
            )
        if flag == "softened" and tension < TENSEST:
            return (  # of order h^2, or less where a floor of conjugate gradients acts
                f"Springs are softer than their compliance says, by {100 * soft:.3g} % (weighted by their energy): the solver "
                "leaves violations as large. Lengths are off by so much, and loads where they come of lengths, as in a net "
                f"stretched between pins. Use {more(substeps, soft / TOO_SOFT, 2)}, or compliance=0 for what is meant to be "
                "rigid."
            )
        if flag == "softened":
            # It is told until they give way by less than SLIGHT of their size: by the square of the slope that they sag to. What
            # they gave way by within the frame may be gone at its end.
            return (
                "A load has hardly a direction to be carried in, as that of a straight rope between two pins: its constraints "
                "give way and sag with h^2. Give them slack or compliance, or use "
                f"{more(substeps, max(residual / SLIGHT, 16), 4)}, with which they sag too little to be told."
                f"{self.rounds_loads(reach, h)}"
            )
        if flag == "stiff-force":
            need = np.ceil(substeps * np.sqrt(stiff / STIFF)) + 1
            return (
                f"A force changes too fast for the substep: omega h = {np.sqrt(stiff):.3g}, resolved below 2. "
                f"Use at least {need:.7g} substeps. A force that grows without bound, as 1 / r^2, is never resolved where its "
                "centers meet: let it end, as r / (r^2 + e^2)^1.5."
            )
        if released > 0:
            return (
                f"Links that contradict each other were off by {100 * released:.3g} % of their size "
                "as the frame began. A shorter substep turns that into energy; contradictions let all that hangs together with "
                "them give way. Give all frames as many substeps, or these constraints compliance, or lengths that fit."
            )
        need = np.ceil(substeps * residual / UNCONVERGED)  # of order h^2 under loads, h after impacts
        if self.remedy is None:
            self.remedy = self.solver.remedy(self.batches, self.scene.slots, self.scene.inv_mass)
        other = f", or {self.remedy}" if self.remedy else ""
        return (
            f"Constraints are not met: the worst is off by {100 * residual:.3g} % of its size. "
            f"Use about {need:.7g} substeps{other}. Where neither helps, constraints contradict each other."
        )


def more(substeps: int, times: float, order: int) -> str:
    """Return how many substeps lower a figure, which is `times` as large as it may be, below that.

    A load F gives it the order h^order; a blow, of a given impulse F h, half of that. A blow at another time in the substep gives
    another figure, up to the worst one, so that less than twice as many may change nothing.
    """
    about, blow = (np.floor(substeps * times ** (k / order)) + 1 for k in (1, 2))
    return f"about {about:.7g} substeps, or up to {max(blow, 2 * substeps):.7g} substeps after a blow"


def risks(
    n, farthest, bad, reach, fast, overlap, pressed, turned, moved, tension, soft, stiff, released, residual
) -> dict[str, Any]:  # fmt: skip
    """Return whether a frame has each flag, in the order of the notes. For arrays of figures, of many frames, return arrays."""
    return {
        "non-finite": bad < n,
        "out-of-range": reach >= farthest,
        "tunnelling-risk": fast > 0,
        "compressed": (overlap > COMPRESSED) & (pressed > COMPRESSED),
        "turned": turned == FAR,
        "moved": moved > 0,
        "softened": (tension >= TENSEST) | (soft > TOO_SOFT),
        "stiff-force": stiff > STIFF,
        "unconverged": (released > 0) | (residual > UNCONVERGED),
    }
