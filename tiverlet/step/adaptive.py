"""Frames that are repeated with more substeps until they are good: substeps="auto", tolerance and budget."""

from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..constraints.core.anchored import Anchored
from ..constraints.core.scalar import Scalar
from ..constraints.core.spring import FIRM
from ..constraints.path import Path
from ..solvers.slots import TENSEST
from . import checkpoint, energy_bound
from .clock import Pace, energy_limit
from .diagnostics import KINETIC, STIFFNESS
from .integrator import FORCE
from .step_report import COMPRESSED, StepReport

if TYPE_CHECKING:
    from ..world import World

MOST = 4096  # substeps of a frame
PASSES = 64  # iterations of a substep
RESIDUAL, OVERLAP = 1e-2, COMPRESSED  # aims if no tolerance is given
TENSION = 2.0  # (omega h)^2 across a tension: half the limit of stability
STIFF = 2.0  # omega h from which on a spring is as good as rigid
RISKS = {"tunnelling-risk", "stiff-force", "non-finite"}
FASTEST = 50.0  # omega dt of the fastest springs that substeps="auto" resolves: 8 periods in a frame, some 500 substeps
FOLLOWS = 0.5  # of its violation: a spring that changes by less in a substep follows others, and does not vibrate by itself
LOSS = 2e-3  # share of the largest kinetic energy that springs may lose in a second: a percent in 5 s
UNSEEN = 0.1  # of what drag and dashpots take out of a vibration: what its substep may take besides
GAIN = 1.4  # factor by which twice the effort must lower a figure; second order lowers it by 4, first order by 2
FEW = 16  # substeps below which more of them may still help, although two doublings did not
IDLE = {"substeps": 2, "iterations": 1}  # doublings without a gain after which no more are tried
ROOM = 6.0  # factor by which all figures must be better than their aims before less effort is tried
PATIENCE = 1024  # most frames with room before an effort that failed is tried again
GROWTH = 4  # factor by which each failure makes them more
ENOUGH = 64  # frames with plenty of room after which failures are forgotten
OCTAVES = (MOST * PASSES).bit_length()  # of efforts, in substeps times iterations

Figures = tuple[float, ...]  # residual, overlap, tension, motion, stiffness, damping and energy, relative to their aims
MEASURES = (
    "the residual", "the overlap", "(omega h)^2 of a tension", "the turn of a constraint", "(omega h)^2 of a force",
    "the loss of springs", "the change of energy",
)  # fmt: skip
TENSE, HOPED = 2, 5  # in Figures: the index of the tension; the first of those that need not be met if no effort meets them
NOTHING: Figures = (1.0,) * 7
WORST: Figures = (float("inf"),) * 7
WELL = 1, 1.0  # the end of the controller's memory where no frame has failed yet


class StepController:
    """Chooses the number of substeps of each frame: at least the usual one, but with a tolerance or a budget.

    A frame is undone, and repeated with twice the substeps, in these cases: a constraint turned by more than 26 degrees in a
    substep (cos < 0.9, where SHAKE's direction is no longer good); the frame left a residual above 1e-2, or an overlap that is
    flagged if it stays; particles vibrated across a tension with (omega h)^2 > 2; or a flag is set that shorter substeps remove.
    If doubling the substeps, 16 or more, brings no gain, the iterations are doubled. If that brings no gain either, the frame is
    "stuck": among the tries that are as good, the one with the least effort is kept, and the next frames no longer aim at the
    figures that stay wrong. If each try adds more energy than the one before, violations could not be removed first, and the
    best of the earlier tries is kept.
    A body that turns by phi in a substep turns too fast or too slowly by phi^2 / 24 of that. This is a relative error like the
    residual: for the 26 degrees above it is 1e-2. A tolerance also applies to the turns of rigid constraints and of beads on
    curves, and to the vibrations of springs, see vibration_error().
    In the same way, motion in forces that vary in space is too fast by (omega h)^2 / 24; by default (omega h)^2 may be 0.06. A
    frame is also repeated, as long as that helps, if its energy is wrong by more than a fiftieth of the kinetic energy, see
    energy_bound.missed(), or if springs lose more than they may, see damping(). If it does not help, the frame counts as good,
    since the energy before it was computed with longer substeps. Springs of omega dt > FASTEST are left unresolved, and what they
    vibrate with is lost; once that is a tenth of the largest kinetic energy, the flag "energy-loss" says so.

    All figures are of the order of h^2. If they leave room for it, the next frame is tried with half the effort, but no fewer
    substeps than usual: impacts of bodies are right to O(h), and no figure tells. Each effort has a patience of its own: the
    number of frames in a row in which there must be room before it is tried. A failure makes it four times what it was, or what
    that of any lower effort is. It is forgotten once the figures of up to 64 frames have left room for that effort and as much
    again. A scene that changed back and forth between two numbers of substeps would lose or gain energy with each change, and
    loads would swing: where passes leave a violation, a sag takes many frames to grow, and a longer substep seems good meanwhile.

    The cost: to repeat a frame, the state at its start is read back to the host before each frame.
    """

    def __init__(self):
        self.auto = False
        self.pace = Pace()  # of frames of the usual substeps, or of those that the user has set
        self.substeps, self.iterations = 1, 1  # of the next frame
        self.dt = 0.0  # of the last frame [s]
        self.wait = 0  # frames until less effort is tried
        self.patience = [1] * OCTAVES  # frames with room before an effort is tried, by its octave
        self.worst = 0.0  # the largest figure since the wait began
        self.stuck = NOTHING  # the figures that no effort improved
        self.cost = 0.0  # measured run time of an iteration [s]

    @property
    def memory(self) -> tuple:
        """The values on which the next frames depend."""
        now = self.pace.substeps, self.pace.dt, self.pace.off, self.substeps, self.iterations, self.dt, self.wait
        failed = self.stuck != NOTHING or max(self.patience) > 1
        return (*now, self.worst, *self.patience, *self.stuck) if failed else (*now, *WELL)

    @memory.setter
    def memory(self, value: tuple) -> None:
        """Restore the values of another time."""
        *pace, self.substeps, self.iterations, self.dt, self.wait, self.worst = value[:8]
        self.pace, rest = Pace(*pace), value[8:]
        failed = tuple(value[7:]) != WELL
        self.patience = list(rest[:OCTAVES]) if failed else [1] * OCTAVES
        self.stuck = tuple(rest[OCTAVES:]) if failed else NOTHING

    def advance(self, world: "World", dt: float, tolerance: float | None, budget: float | None) -> StepReport:
        """Run one frame, and repeat it until it is good, nothing helps, or the limit of substeps or the budget is reached."""
        tolerance = None if tolerance is None else checks.number("World.step", "tolerance", tolerance, above=0.0)
        budget = None if budget is None else checks.number("World.step", "budget", budget, above=0.0)
        end, first = float("inf") if budget is None else perf_counter() + budget, not self.dt
        least = self.prepare(world._usual_substeps, world.iterations, dt, tolerance, budget)
        before, flags = world._undo  # type: ignore[misc]  # before the upload of knobs; without an upload, the present state
        kept = checkpoint.keep(world) if any(map(any, flags)) else replace(before, controller=self.memory)
        world._runner.begin(dt, self.substeps, world.iterations, self.iterations)
        if first:
            world._runner.compile_for_repeats()
        tries = Tries(self.substeps, self.iterations, self.stuck, world._clock.energy)
        energy = energy_bound.before(world)
        while True:
            n, k, begun = tries.substeps, tries.iterations, perf_counter()
            report = world._runner.advance(dt, n, k)
            took = perf_counter() - begun
            self.learn(took / (n * k))
            motion, missed = motion_error(world) if tolerance else 0.0, energy_bound.missed(world, report, energy)
            errors = tension(world, report), motion, stiffness(world), damping(world, n, energy is None), missed
            # What clusters store is estimated too low, see stored(): so they may not lean on it.
            softness = 1.0 if any(b.clusters for b in world._runner.batches) else world._clock.softness
            figures, risks = judge(report, tolerance, softness, *errors)
            if tries.record(figures, risks, report.energy, world._runner.sheet.item(KINETIC)):
                break
            if not tries.verdict and perf_counter() + 2 * took > end:
                tries.verdict = "substeps-capped"
                break
            checkpoint.put_back(world, kept)
            world._runner.begin(dt, tries.substeps, world.iterations, tries.iterations)
        self.substeps, self.iterations, self.stuck = n, k, tries.stuck  # so that the next frames do not try in vain
        self.plan_next_frame(least, world.iterations, max(figures), tries.verdict, tries.count)
        off = report.residual / (tolerance or RESIDUAL)
        worst = max((off, MEASURES[0]), *zip(figures, MEASURES, strict=True))
        verdict = "stuck" if tries.verdict == "good" and off > 1 else tries.verdict  # links stiffen as energy allows
        return with_verdict(report, worst, risks, verdict, tries.count)

    def prepare(self, usual: int, iterations: int, dt: float, tolerance: float | None, budget: float | None) -> int:
        """Choose the substeps and iterations of the first try. Returns the least substeps of this frame: those that it has with
        `usual` ones where the user does not say; fewer may do for a tolerance, or have to for a budget."""
        self.iterations = max(self.iterations, iterations)
        if not self.dt:
            self.substeps = max(self.substeps, usual)
        elif dt != self.dt:
            self.substeps = max(1, min(round(self.substeps * dt / self.dt), MOST))
        self.dt = dt
        least = self.pace.fit(dt, usual) if tolerance is None and budget is None else 1
        self.substeps = max(self.substeps, least)
        if budget is not None and self.cost:
            fits = max(1, min(int(0.8 * budget / (self.cost * self.iterations)), MOST))
            if fits < self.substeps or (tolerance is None and fits > 1.25 * self.substeps):
                self.substeps = fits
        elif self.wait:
            self.wait -= 1
            if not self.wait:
                self.stuck = NOTHING
        return least

    def learn(self, cost: float) -> None:
        """Update the cost of an iteration [s]: at once if it is lower, since the first frame compiles; gradually if higher."""
        self.cost = min(cost, self.cost + 0.3 * (cost - self.cost)) if self.cost else cost

    def plan_next_frame(self, least: int, iterations: int, figure: float, verdict: str, tries: int) -> None:
        """Choose less effort for the next frame, if this one leaves room for it; if that has just failed, wait longer before the
        next try. least, iterations: that it has at least. figure: the largest of the figures."""
        self.worst = max(self.worst, figure)
        lower = self._octave - 1  # of the effort that failed, or that comes next
        if verdict != "good" or tries > 1:
            if tries > 1 and lower >= 0:
                self.patience[lower] = min(GROWTH * max(self.patience[: lower + 1]), PATIENCE)
            self._wait()
        elif figure * ROOM > 1:
            if self.stuck == NOTHING:
                self._wait()
        else:
            if self.patience[lower] - self.wait >= min(self.patience[lower], ENOUGH):
                self._forget()
            if not self.wait and (self.iterations > iterations or self.substeps > least):
                if self.iterations > iterations:
                    self.iterations //= 2
                else:
                    self.substeps = max(least, (self.substeps + 1) // 2)
                self._wait()

    @property
    def _octave(self) -> int:
        """The octave of the present effort."""
        return (self.substeps * self.iterations).bit_length() - 1

    def _wait(self) -> None:
        """Begin to wait until less effort is tried: not at all if that has never failed."""
        patience = self.patience[max(self._octave - 1, 0)]
        self.wait, self.worst = patience if patience > 1 else 0, 0.0

    def _forget(self) -> None:
        """Forget the failures of efforts for which the figures of this wait leave room, and as much again."""
        for lower in range(self._octave):
            if self.worst * 4.0 ** (self._octave - lower) * ROOM <= 1:
                self.patience[lower] = 1
        if self.patience[self._octave - 1] == 1:
            self.wait = 0


class Tries:
    """The tries of one frame. The next one has `substeps` x `iterations`.

    stuck: values that figures need not fall below. energy: before the frame [J]. verdict: how the frame ends; empty until that is
    known.
    """

    def __init__(self, substeps: int, iterations: int, stuck: Figures, energy: Any):
        self.substeps, self.iterations, self.stuck = substeps, iterations, stuck
        self.verdict, self.count = "", 0
        self._best, self._idle, self._kind = WORST, 0, "substeps"
        self._known: dict[tuple[int, int], Figures] = {}  # of tries without a risk, by substeps and iterations
        self._made: dict[tuple[int, int], tuple] = {}  # of all tries: a key by which the best one is the least
        self._energies, self._kinetic = [energy], 0.0

    def record(self, figures: Figures, risks: set[str], energy: float, kinetic: float) -> bool:
        """Record a try, with its energies [J]. Returns whether it is the last one; else the next one has been chosen."""
        n, k, stuck = self.substeps, self.iterations, self.stuck
        wrong = [f > max(1.0, s) for f, s in zip(figures, stuck, strict=True)]
        self.count += 1
        self._energies.append(energy)
        self._kinetic = kinetic if self.count == 1 else self._kinetic
        self._made[n, k] = bool(risks), max(figures), n * k
        if self.verdict or not (risks or any(wrong)):
            self.verdict = self.verdict or ("stuck" if max(figures[:HOPED]) > 1 else "good")
            return True
        if pumps(self._energies, self._kinetic):
            self.verdict = "stuck"
            del self._made[n, k]
            self.substeps, self.iterations = to = min(self._made, key=self._made.__getitem__)
            self.stuck = tuple(max(s, GAIN * f) for s, f in zip(stuck, self._known.get(to, NOTHING), strict=True))
            return False
        if risks:
            self._best, self._idle, self._kind = WORST, 0, "substeps"
        else:
            self._known[n, k] = figures
            gains = any(f * GAIN <= b for f, b, w in zip(figures, self._best, wrong, strict=True) if w)
            self._idle = 0 if gains else self._idle + 1
            self._best = tuple(map(min, figures, self._best))
            if self._idle >= IDLE[self._kind] and n >= FEW:
                if self._kind == "iterations" or k >= PASSES or not any(wrong[:HOPED]):
                    self.verdict = "stuck" if any(wrong[:HOPED]) else "good"
                    self.stuck = tuple(max(s, GAIN * f) if w else s for s, f, w in zip(stuck, figures, wrong, strict=True))
                    self.substeps, self.iterations = cheapest(self._known, self.stuck)
                    return (self.substeps, self.iterations) == (n, k)
                self._kind, self._idle = "iterations", 0
        if n >= MOST:
            self.verdict = "substeps-capped"
            return True
        self.substeps, self.iterations = (min(2 * n, MOST), k) if self._kind == "substeps" else (n, 2 * k)
        return False


def motion_error(world: "World") -> float:
    """Return the largest relative error of the speed of constraints: phi^2 / 24 if they turn by phi in a substep, and the error
    of springs, see vibration_error()."""
    state, memory = world._runner.scene.state, world._runner.memory
    x = state.get(memory)
    d = memory.read(state.d)[: len(x)].astype(np.float64)
    return max(turned(world, x, d) ** 2 / 24, vibration_error(world, x, d))


def vibration_error(world: "World", x: np.ndarray, d: np.ndarray) -> float:
    """Return the largest relative error of springs that vibrate, after a last move d to x [m].

    For an amplitude A, relative to the size of the spring, it is A times

        omega_h / omega - 1 = (omega h)^2 (1 / 24 - W / (8 w)),    omega^2 = w / alpha

    with W = w of split masses: the step solves it as a spring of compliance alpha + W h^2 / 4, see Equation. A is the amplitude
    that its speed would reach, |f - f_0| / (omega h), where f is its length now and f_0 before the substep. A spring stiffer than
    the substep, from omega h = 2 on, does not vibrate, and is right to |f - f_0|.
    """
    runner, h, worst, split = world._runner, world._clock.h, 0.0, None
    for b in runner.batches:
        if not (isinstance(b, Scalar) and b.arity and h):
            continue
        some = (b.compliance > 0) & ~b.broken
        if some.any():
            split = runner.memory.read(runner.scene.slots.split)[: len(x)] if split is None else split
            squares = (b.gradients(x) ** 2).sum(axis=2)
            w, shared = ((each[b.indices] * squares).sum(axis=1) for each in (runner.scene.inv_mass, split))
            some &= w > 0
            now, before = (b.violation(each) for each in (x, x - d))
            if b.side:
                now, before = (np.maximum(b.side * each, 0) for each in (now, before))
            changed = np.abs(now - before) * b.inverse_size(x)
            omega = np.minimum(h * np.sqrt(w[some] / b.compliance[some]), STIFF)
            worst = max(worst, float((changed[some] * omega * (shared[some] / w[some] / 8 - 1 / 24)).max(initial=0.0)))
    return worst


def turned(world: "World", x: np.ndarray, d: np.ndarray) -> float:
    """Return the largest angle [rad] by which a corner of a rigid constraint turned about its first one in the last substep, or a
    bead with its curve, after a move d to x [m]."""
    memory, worst = world._runner.memory, 0.0
    for b in world._runner.batches:
        if isinstance(b, Path) and b.curve.smooth:
            place, who = b.dev.place, b.indices[:, 0]
            s = b.curve.starts[memory.read(place.piece)[: b.count]] + memory.read(place.rest)[: b.count]
            way = b.curve.tangent(s)
            back = b.curve.tangent(s - (way * d[who]).sum(axis=1))
            worst = max(worst, float(((way - back) ** 2).sum(axis=1).max()))
        rigid = np.broadcast_to(getattr(b, "compliance", 0.0) == 0, b.count)
        if b.count and b.indices.size > b.count and rigid.any() and not getattr(b, "side", 0):
            starts = np.arange(b.count + 1) * b.arity if b.arity else b.members.starts
            who, owner = b.indices.ravel(), b.owner
            hub = who[starts[owner]]
            r, u = x[who] - x[hub], d[who] - d[hub]
            size = np.where((r**2).sum(axis=1) > 0, (r**2).sum(axis=1), np.inf)
            across = u - r * ((r * u).sum(axis=1) / size)[:, None]
            worst = max(worst, float(((across**2).sum(axis=1) / size)[rigid[owner]].max()))
    return worst**0.5


def tension(world: "World", report: StepReport) -> float:
    """Return (omega h)^2 of the fastest vibration across a tension; 0 where systems stay as soft as in a longer substep."""
    return 0.0 if "softened" in report.flags and world._clock.part_softness > 1 else report.tension


def stiffness(world: "World") -> float:
    """Return (omega h)^2 of the fastest motion in forces that vary in space."""
    runner, clock = world._runner, world._clock
    probe = runner.diagnostics.force_stiffness
    if not probe or not clock.h:
        return 0.0
    with runner.memory.compiler():
        return max(probe(clock.h, clock.time), runner.sheet.item(STIFFNESS))


def damping(world: "World", substeps: int, changed: bool) -> float:
    """Return the energy that springs lose by their substep, relative to what they may lose, as a figure of the order of h^2.

    changed: whether the scene was changed from outside before the frame.

    The stiff share theta of the law of springs, see Equation, takes about

        theta u^2 / alpha,    theta = s^4 / (1 + s^4), s = omega h

    from a spring that became longer by u in a substep: 2 pi s^5 of its energy in each period. Springs at rest lose nothing,
    however stiff. They may lose LOSS, and UNSEEN of what drag and their own dashpots take. Nothing counts where work is done:
    springs may follow it. Where bodies bounce, springs with theta > FIRM are rigid, see BodyImpacts, and do not count: an impact
    would make them vibrate in a substep that is some 40 times shorter. Springs of more than FASTEST that vibrate do not count
    either: to resolve them would take more time than it is worth. Where they follow a slower motion, as the bends of a beam do,
    they count: what they lose is energy of that motion. It falls with h^5 where theta is small, and with h where theta is 1.
    """
    runner, clock = world._runner, world._clock
    springs = [b for b in runner.batches if isinstance(b, (Scalar, Anchored)) and not b.is_kinematic and (b.compliance > 0).any()]
    works = changed or any(b.driven for b in runner.batches) or energy_bound.works(world)
    if not (springs and clock.h) or (works and not energy_bound.keeps_energy(world)):
        return 0.0
    state, memory, lost, firm = runner.scene.state, runner.memory, 0.0, 0.0
    x = state.get(memory)
    d = memory.read(state.d)[: len(x)].astype(np.float64)
    for b in springs:
        alpha, w = b.compliance, b.weights(x) * clock.h**2
        if isinstance(b, Scalar):
            now, before = (np.maximum(b.side * C, 0) if b.side else C for C in (b.violation(x), b.violation(x - d)))
            square, bent = (now - before) ** 2, now**2
        else:
            now = b.offset(x)
            square, bent = ((now - b.offset(x - d)) ** 2).sum(axis=1), (now**2).sum(axis=1)
        theta = w**2 / (w**2 + alpha**2)
        follows = (substeps**2 * w <= FASTEST**2 * alpha) | (square < FOLLOWS**2 * bent)
        some = (alpha > 0) & ~b.broken & ((theta <= FIRM) | (not runner.bounces)) & follows
        rate = theta[some] / alpha[some] - UNSEEN * b.damping[some] / clock.h
        each = np.maximum(rate, 0.0) * square[some]
        lost, firm = lost + float(each.sum()), firm + float((theta[some] * each).sum())
    if not lost:
        return 0.0
    drag = 2 * sum(f.rate for f in runner.drags) * runner.sheet.item(KINETIC)
    allowed = energy_bound.allowed_loss(world, LOSS) + UNSEEN * drag * clock.frame[1]
    return (substeps * lost / allowed) ** (2 / (5 - 4 * firm / lost))


@np.errstate(all="ignore")  # energies may be infinite
def pumps(energies: list[float], kinetic: float) -> bool:
    """Whether the last doubling of the effort added more energy than the one before, and led beyond the bound.

    energies: before the frame, then after each try [J]. The bound follows from all but the last two of them, see energy_limit().
    Violations that could not be removed first act as springs, which a shorter substep makes stiffer, see settling.py.
    """
    if len(energies) < 4:
        return False
    first, second = np.diff(energies[-3:]).tolist()
    return second > GAIN * first and energies[-1] > energy_limit(max(energies[:-2]), kinetic, energies[-1])


def judge(
    report: StepReport, tolerance: float | None, softness: float, tension: float, motion: float, stiffness: float, damping: float,
    missed: float,
) -> tuple[Figures, set[str]]:  # fmt: skip
    """Return residual, overlap, tension, motion, stiffness, damping and energy relative to their aims (1: just met), and the
    risks that shorter substeps must remove.

    softness: of links, which bear loads as in longer substeps at first. So much of a violation is not the fault of this frame.
    """
    risks = set(report.flags & RISKS)
    if report.turn:
        risks.add("turned")
    if report.tension > TENSEST:
        risks.add("softened")
    ratios = (
        report.residual / softness / (tolerance or RESIDUAL),
        report.overlap / (tolerance or OVERLAP),
        tension / TENSION,
        motion / (tolerance or RESIDUAL),
        stiffness / (24 * tolerance if tolerance else FORCE),
        damping,
        missed,
    )
    return tuple(float(r) if r == r else float("inf") for r in ratios), risks  # NaN is the worst of all


def cheapest(known: dict[tuple[int, int], Figures], stuck: Figures) -> tuple[int, int]:
    """Return the least effort with which all figures are as good as they have to be, or as good as with the most effort.

    If constraints have hardly a direction in which to bear a load, return the most substeps: the sag that bears the load falls
    with h^2, and once it is there, shorter substeps keep it.
    """
    enough = [max(1.0, s) for s in stuck]
    fit = [effort for effort, figures in known.items() if all(f <= e for f, e in zip(figures, enough, strict=True))]
    tense = any(known[e][TENSE] > 1 for e in fit)
    return next(e for e in fit if not tense or e[0] == max(fit)[0])


def with_verdict(report: StepReport, worst: tuple[float, str], risks: set[str], verdict: str, tries: int) -> StepReport:
    """Return the report with the flag, the note and the number of tries of the controller. worst: a figure, and what it is."""
    if verdict == "good":
        return replace(report, tries=tries)
    wrong = sorted(risks) or [f"{worst[1]} is {worst[0]:.3g} times what is asked"]
    why = {
        "stuck": "Nothing helps: constraints contradict each other, a load has no direction to be carried in (that of a straight "
        "rope between two pins; give it slack or compliance), particles still part that began in one place, a force has no end "
        "where its centers meet, or what is violated cannot be put right first, and would be energy in a shorter substep.",
        "substeps-capped": f"More than {report.substeps} substeps are needed, but the budget is spent or there can be no more.",
    }[verdict]
    note = f"The frame is not as good as asked: {', '.join(wrong)}. {why}"
    return replace(report, flags=report.flags | {verdict}, notes=(*report.notes, note), tries=tries)
