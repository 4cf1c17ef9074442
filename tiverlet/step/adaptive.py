"""Frames that are made again with more substeps until they are good: substeps="auto", tolerance and budget."""

from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..constraints.core.scalar import Scalar
from ..constraints.path import Path
from ..solvers.slots import TENSEST
from . import checkpoint, energy_bound
from .clock import room
from .diagnostics import KINETIC, STIFFNESS
from .step_report import StepReport

if TYPE_CHECKING:
    from ..world import World

START = 8  # substeps of the first frame
MOST = 4096  # substeps of a frame
PASSES = 64  # iterations of a substep
RESIDUAL, OVERLAP = 1e-2, 0.1  # what is good where the user asks for nothing else
TENSION = 2.0  # (omega h)^2: half the limit of stability
STIFF = 2.0  # omega h from where on a spring is as good as rigid
FORCE = 0.06  # (omega h)^2: 25 substeps to a vibration, as molecular dynamics takes them
RISKS = {"tunnelling-risk", "stiff-force", "non-finite"}
GAIN = 1.4  # by which twice the effort has to lower the figures; of second order they fall by 4, of first order by 2
FEW = 16  # substeps with which what does not help yet may help later
IDLE = {"substeps": 2, "iterations": 1}  # doublings without a gain that are enough
ROOM = 6.0  # by which the figures have to be better than asked before less is tried
PLENTY = 24.0  # four times that: what is left after a try has room again, and failures are forgotten
PATIENCE = 64  # frames, at most, until it is tried again

Figures = tuple[float, ...]  # residual, overlap, tension, motion, stiffness and energy, relative to what is asked
TENSE, ENERGY = 2, 5  # the places of the tension and, as the last one, the energy among them
NOTHING: Figures = (1.0,) * 6
WORST: Figures = (float("inf"),) * 6


class StepController:
    """Chooses the substeps of a frame.

    A frame is undone, and made again with twice the substeps, when in one of them a constraint turned by more than 26 degrees
    (cos < 0.9, where SHAKE's direction is no longer good), a residual above 1e-2 or an overlap above a tenth of a radius was
    left, a tension made particles vibrate with (omega h)^2 > 2, or when it has a flag that shorter substeps remove. Where twice
    the substeps, 16 or more, bring no gain, twice the iterations are tried; where they bring none, it is "stuck": the frame is
    the one with the least effort of those that are as good, and what stays wrong is asked for no more in the next frames.
    Where they bring in energy, more with each try, what is left violated could not be put right first, and the frame is the best
    of the tries.
    A body that turns by phi in a substep does so by phi^2 / 24 of that too fast or too slowly, a relative error as a residual is:
    the 26 degrees above are one of 1e-2, and a tolerance that is asked for is asked of the turns of rigid constraints and of
    beads on curves, too, and of the vibrations of springs, see vibrates().
    What vibrates or orbits in forces that differ from place to place is too fast by (omega h)^2 / 24 in the same way, of which
    0.06 is allowed. Where a frame got more than a fiftieth of the energy wrong, see energy_bound.missed(), it is made again while
    that helps. What does not help is no fault of the frame, for the energy before it was that of longer substeps.

    When all figures, which are of the order of h^2, leave room for it, the next frame is tried with half the effort. Each time
    that fails, there has to be room in twice as many frames on end before the next try, up to 64, until it is room for two of
    them: a scene that went to and fro between two numbers would lose or gain with each change.

    Making a frame again needs the state at its begin, which is read back to the CPU before each frame: that is the price.
    """

    def __init__(self):
        self.auto = False
        self.substeps, self.iterations = START, 1  # of the next frame
        self.dt = 0.0  # of the last one
        self.wait, self.patience = 0, 1  # frames until less is tried, and after the next failure
        self.stuck = NOTHING  # the figures that no effort improved
        self.cost = 0.0  # measured seconds of an iteration

    @property
    def memory(self) -> tuple:
        """What the next frames depend on."""
        stuck = NOTHING[:1] if self.stuck == NOTHING else self.stuck
        return self.substeps, self.iterations, self.dt, self.wait, self.patience, *stuck

    @memory.setter
    def memory(self, value: tuple) -> None:
        """Go on from what it was at another time."""
        self.substeps, self.iterations, self.dt, self.wait, self.patience, *stuck = value
        self.stuck = tuple(stuck) if len(stuck) > 1 else NOTHING

    def advance(self, world: "World", dt: float, tolerance: float | None, budget: float | None) -> StepReport:
        """One frame, made again until it is good, nothing helps, or there can be no more."""
        tolerance = None if tolerance is None else checks.number("World.step", "tolerance", tolerance, above=0.0)
        budget = None if budget is None else checks.number("World.step", "budget", budget, above=0.0)
        end = float("inf") if budget is None else perf_counter() + budget
        self.prepare(world.iterations, dt, tolerance, budget)
        before, flags = world._undo  # type: ignore[misc]  # of the step; where nothing was uploaded since, it is the state now
        kept = checkpoint.keep(world) if any(map(any, flags)) else replace(before, controller=self.memory)
        world._runner.begin(dt, self.substeps, world.iterations)
        tries = Tries(self.substeps, self.iterations, self.stuck, world._clock.energy)
        energy = energy_bound.before(world)
        while True:
            n, k, begun = tries.substeps, tries.iterations, perf_counter()
            report = world._runner.advance(dt, n, k)
            took = perf_counter() - begun
            self.learn(took / (n * k))
            motion, missed = motion_error(world) if tolerance else 0.0, energy_bound.missed(world, report, energy)
            figures, risks = judge(report, tolerance, motion, stiffness(world), missed)
            if tries.note(figures, risks, report.energy, world._runner.sheet.item(KINETIC)):
                break
            if not tries.verdict and perf_counter() + 2 * took > end:
                tries.verdict = "substeps-capped"
                break
            checkpoint.put_back(world, kept)
            world._runner.begin(dt, tries.substeps, world.iterations)
        self.substeps, self.iterations, self.stuck = n, k, tries.stuck  # and the next frames do not try in vain
        self.look_ahead(world.iterations, report, max(figures), tries.verdict, tries.count)
        return told(report, max(figures), risks, tries.verdict, tries.count)

    def prepare(self, iterations: int, dt: float, tolerance: float | None, budget: float | None) -> None:
        """Choose the effort to begin with."""
        self.iterations = max(self.iterations, iterations)
        if self.dt and dt != self.dt:
            self.substeps = max(1, min(round(self.substeps * dt / self.dt), MOST))
        self.dt = dt
        if budget is not None and self.cost:
            fits = max(1, min(int(0.8 * budget / (self.cost * self.iterations)), MOST))
            if fits < self.substeps or (tolerance is None and fits > 1.25 * self.substeps):
                self.substeps = fits
        elif self.wait:
            self.wait -= 1
            if not self.wait:
                self.stuck = NOTHING

    def learn(self, cost: float) -> None:
        """Keep the cost of an iteration: lower ones at once, for the first frame compiles; higher ones by and by."""
        self.cost = min(cost, self.cost + 0.3 * (cost - self.cost)) if self.cost else cost

    def look_ahead(self, iterations: int, report: StepReport, figure: float, verdict: str, tries: int) -> None:
        """Choose less effort for the next frame, if this one leaves room for it; wait longer with the next try where that has
        just failed."""
        if verdict != "good" or tries > 1:
            self.patience = min(2 * self.patience, PATIENCE) if tries > 1 else self.patience
            self.wait = self.patience
        elif figure * ROOM > 1:
            self.wait = self.wait if self.patience == 1 or self.stuck != NOTHING else self.patience
        elif not self.wait:
            if self.iterations > iterations:
                self.iterations //= 2
            elif self.substeps > 1:
                self.substeps = (self.substeps + 1) // 2
            self.patience = 1 if figure * PLENTY <= 1 else self.patience


class Tries:
    """The tries of one frame, and what is tried next: `substeps` x `iterations`.

    stuck: figures that need not be better. energy: before the frame [J]. verdict: how the frame ends, once that is known.
    """

    def __init__(self, substeps: int, iterations: int, stuck: Figures, energy: Any):
        self.substeps, self.iterations, self.stuck = substeps, iterations, stuck
        self.verdict, self.count = "", 0
        self._best, self._idle, self._kind = WORST, 0, "substeps"
        self._known: dict[tuple[int, int], Figures] = {}  # of those without a risk
        self._made: dict[tuple[int, int], tuple] = {}  # how good all are, the best the least
        self._energies, self._kinetic = [energy], 0.0

    def note(self, figures: Figures, risks: set[str], energy: float, kinetic: float) -> bool:
        """Take note of a try, and of its energies [J]. Returns whether it is the last one; else it is known what comes next."""
        n, k, stuck = self.substeps, self.iterations, self.stuck
        wrong = [f > max(1.0, s) for f, s in zip(figures, stuck, strict=True)]
        self.count += 1
        self._energies.append(energy)
        self._kinetic = kinetic if self.count == 1 else self._kinetic
        self._made[n, k] = bool(risks), max(figures), n * k
        if self.verdict or not (risks or any(wrong)):
            self.verdict = self.verdict or ("stuck" if max(figures[:ENERGY]) > 1 else "good")
            return True
        if pumps(self._energies, self._kinetic):
            self.verdict = "stuck"
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
                if self._kind == "iterations" or k >= PASSES or not any(wrong[:ENERGY]):
                    self.verdict = "stuck" if any(wrong[:ENERGY]) else "good"
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
    """By how much constraints are too fast or too slow, at most, relative: by phi^2 / 24 where they turn by phi in a substep, and
    where springs vibrate, see vibrates()."""
    state, memory = world._runner.scene.state, world._runner.memory
    x = state.get(memory)
    d = memory.read(state.d)[: len(x)].astype(np.float64)
    return max(turned(world, x, d) ** 2 / 24, vibrates(world, x, d))


def vibrates(world: "World", x: np.ndarray, d: np.ndarray) -> float:
    """The worst error of a spring that vibrates, after a last move d to x [m]: of an amplitude A, relative to its size, and

        omega_h / omega - 1 = (omega h)^2 (1 / 24 - W / (8 w)),    omega^2 = w / alpha

    with W = w of split masses: it is solved as a spring of compliance alpha + W h^2 / 4, see Equation. A is what its speed, how
    much its length f changed in the substep, would carry it to, |f - f_0| / (omega h). What is stiffer than the substep, from
    omega h = 2 on, does not vibrate, and is right to |f - f_0|.
    """
    runner, h, worst = world._runner, world._clock.h, 0.0
    for b in runner.batches:
        if not (isinstance(b, Scalar) and b.arity and h):
            continue
        some = (b.compliance > 0) & ~b.broken
        if some.any():
            squares, split = (b.gradients(x) ** 2).sum(axis=2), runner.memory.read(runner.scene.slots.split)[: len(x)]
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
    """The largest angle [rad] by which a corner of a rigid constraint turned about its first one in the last substep, or a bead
    with its curve, after a move d to x [m]."""
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


def stiffness(world: "World") -> float:
    """(omega h)^2 of the fastest motion in forces that differ from place to place."""
    runner, clock = world._runner, world._clock
    probe = runner.diagnostics.force_stiffness
    if not probe or not clock.h:
        return 0.0
    with runner.memory.compiler():
        return max(probe(clock.h, clock.time), runner.sheet.item(STIFFNESS))


@np.errstate(all="ignore")  # they may be infinite
def pumps(energies: list[float], kinetic: float) -> bool:
    """Whether twice the effort brought in more energy than the time before, and more than there was before the frame, the first
    of them: what is left violated, since it cannot be put right first, is a spring that a shorter substep makes stiffer, see
    projection.py."""
    if len(energies) < 4:
        return False
    first, second = np.diff(energies[-3:]).tolist()
    return second > GAIN * first and energies[-1] > room(max(energies[:-2]), kinetic, energies[-1])


def judge(
    report: StepReport, tolerance: float | None, motion: float, stiffness: float, missed: float
) -> tuple[Figures, set[str]]:  # fmt: skip
    """How residual, overlap, tension, motion, stiffness and energy compare with what is asked (1: just met), and what shorter
    substeps have to remove."""
    risks = set(report.flags & RISKS)
    if report.turn:
        risks.add("turned")
    if report.tension > TENSEST:
        risks.add("softened")
    ratios = (
        report.residual / (tolerance or RESIDUAL),
        report.overlap / (tolerance or OVERLAP),
        report.tension / TENSION,
        motion / (tolerance or RESIDUAL),
        stiffness / (24 * tolerance if tolerance else FORCE),
        missed,
    )
    return tuple(float(r) if r == r else float("inf") for r in ratios), risks  # NaN is the worst of all


def cheapest(known: dict[tuple[int, int], Figures], stuck: Figures) -> tuple[int, int]:
    """The least effort with which all figures are as good as they have to be, or as they were with the most.

    Where a load has hardly a direction, the most substeps: the sag that bears it falls with h^2, and would spring back if they
    were not enough later.
    """
    enough = [max(1.0, s) for s in stuck]
    fit = [effort for effort, figures in known.items() if all(f <= e for f, e in zip(figures, enough, strict=True))]
    return next(e for e in fit if stuck[TENSE] <= 1 or e[0] == max(fit)[0])


def told(report: StepReport, figure: float, risks: set[str], verdict: str, tries: int) -> StepReport:
    """The report with what the controller has to say."""
    if verdict == "good":
        return replace(report, tries=tries)
    wrong = sorted(risks) or [f"a figure is {figure:.3g} times what is asked"]
    why = {
        "stuck": "Nothing helps: constraints contradict each other, a load has no direction to be carried in (that of a straight "
        "rope between two pins; give it slack or compliance), particles still part that began in one place, or what is "
        "violated cannot be put right first, and would be energy in a shorter substep.",
        "substeps-capped": f"More than {report.substeps} substeps are needed, but the budget is spent or there can be no more.",
    }[verdict]
    note = f"The frame is not as good as asked: {', '.join(wrong)}. {why}"
    return replace(report, flags=report.flags | {verdict}, notes=(*report.notes, note), tries=tries)
