"""Robustness of the user's own scene: make one parameter at a time extreme, and report what breaks."""

import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

import numpy as np

from ... import checks
from ...forces import Gravity
from ...measure import kinetic_energy
from ...particles import Particles
from ...step.step_report import FIGURE, StepReport
from ...world import World
from ..output import Report, Table, error_line
from .failure_trace import held

STANDS, REFUSED, BREAKS, UNTRIED = "stands it", "refused by name", "BREAKS", "not tried"
LOOSE = 0.1  # relative violation of a constraint beyond which it counts as broken
APART = 1e-3  # tolerance of a shifted scene's final positions, as a share of the motion


@dataclass(frozen=True)
class Outcome:
    """The result of one perturbation: the extreme parameter, the verdict and the reason. particle: the first affected or None."""

    parameter: str
    verdict: str
    how: str
    particle: int | None = None


class Endurance(Report):
    """The perturbations that a scene stands and those that break it. print() shows a table; see .breaks, .json()."""

    width = 140

    def __init__(self, outcomes: list[Outcome]):
        self.outcomes = outcomes

    @property
    def breaks(self) -> dict[str, str]:
        """The parameters that break the scene, with reasons."""
        return {o.parameter: o.how for o in self.outcomes if o.verdict == BREAKS}

    @property
    def passed(self) -> bool:
        """Whether no perturbation breaks the scene."""
        return not self.breaks

    def tables(self) -> Iterator[Table]:
        """Yield the table of all perturbations."""
        rows = [(o.parameter, o.verdict, o.how) for o in self.outcomes]
        styles = ["red" * (o.verdict == BREAKS) for o in self.outcomes]
        yield Table("One parameter at a time", ("parameter", "verdict", "how"), rows, (), ("verdict",), styles)

    def json(self) -> str:
        """Return the outcomes as JSON."""
        return json.dumps({"passed": self.passed, "outcomes": [asdict(o) for o in self.outcomes]}, indent=1)


class Untried(Exception):
    """Raised by a perturbation that the scene does not have."""


def perturbed(world: World, *, seconds: float = 1.0, dt: float = 1 / 60, shift: float = 1e6) -> Endurance:
    """Make one parameter of a scene extreme at a time, run it for `seconds` [s] in frames of dt [s], and report what breaks.

    Perturbations: frames of 10 dt; masses times 1e6, all and one; stiffnesses times 1e9; everything shifted by `shift` [m]; all
    particles at one point; NaN in one input, which must be refused by name. A scene breaks if its state is not finite, if it has
    a flag that the unperturbed scene does not have, if constraints no longer hold, if it has more energy than the scene can
    supply, or if the shifted scene moves differently. The world itself does not change. Knobs keep their values, targets stand
    still.
    """
    seconds = checks.number("stress", "seconds", seconds, above=0.0)
    dt = checks.number("stress", "dt", dt, above=0.0)
    free = np.flatnonzero(world.particles.inv_mass > 0)
    with world.clone() as w:
        plain = run_scene(w, seconds, dt)
    tries: list[tuple[str, Callable[[], World], float, float]] = [
        ("dt x 10", world.clone, 10 * dt, 0.0),
        ("all masses x 1e6", lambda: heavier(world, slice(None)), dt, 0.0),
        ("mass of one particle x 1e6", lambda: heavier(world, free[-1:]), dt, 0.0),
        ("stiffnesses x 1e9", lambda: stiffer(world), dt, 0.0),
        (f"shifted by {shift:g} m", lambda: shifted(world, shift), dt, shift),
        ("all particles at one point", lambda: gathered(world, free), dt, 0.0),
    ]
    outcomes = [plain.outcome("as it is")]
    for parameter, make, frame, by in tries:
        try:
            with make() as w:
                outcomes.append(run_scene(w, seconds, frame, plain, by).outcome(parameter))
        except Untried as why:
            outcomes.append(Outcome(parameter, UNTRIED, str(why)))
        except (ValueError, TypeError, RuntimeError) as error:
            outcomes.append(Outcome(parameter, REFUSED, error_line(error)))
    return Endurance([*outcomes, check_nan(world, free)])


@dataclass
class RunResult:
    """The result of one run: the worst report, positions before and after [m], faults, a figure in words, the first particle."""

    report: StepReport
    before: np.ndarray
    after: np.ndarray
    faults: list[str]
    figure: str
    particle: int | None

    def outcome(self, parameter: str) -> Outcome:
        """Return the verdict on the parameter that was made extreme."""
        return Outcome(parameter, BREAKS if self.faults else STANDS, "; ".join(self.faults) or self.figure, self.particle)


def run_scene(w: World, seconds: float, dt: float, plain: RunResult | None = None, shift: float = 0.0) -> RunResult:
    """Run a world and compare it with the run of the unperturbed scene. shift: how far it was moved along x [m]."""
    before, kinetic = w.position, [kinetic_energy(w)]
    report = w.step(dt)
    supply = kinetic[0] + abs(report.energy - report.energy_change)
    kinetic.append(kinetic_energy(w))
    for _ in range(max(1, round(seconds / dt)) - 1):
        report = report.worse(w.step(dt))
        kinetic.append(kinetic_energy(w))
    top = max(kinetic)
    x, faults, particle = w.position, [], report.bad
    sound = np.isfinite(x).all(axis=1)
    if not sound.all():
        particle = int(np.argmin(sound)) if particle is None else particle
        faults.append("; ".join([f"the state of particle {particle} is not finite", *map(str, held(w, particle)[:1])]))
    if report.flags - (plain.report.flags if plain else frozenset()):
        known = {FIGURE.sub("", note) for note in (plain.report.notes if plain else ())}
        faults += [note for note in report.notes if FIGURE.sub("", note) not in known]
    if report.residual > max(LOOSE, 2 * plain.report.residual if plain else 0.0):
        worst = held(w, None)[:1]
        faults.append(", most of all ".join([f"constraints are off by {report.residual:.2g} of their size", *map(str, worst)]))
        can_move = [i for s in worst for i in s.members if w.particles.inv_mass[i] > 0]
        particle = next(iter(can_move), None) if particle is None else particle
    # The energy that the scene can supply: at the start, and by a fall over its extent, with the gravity of the earth or more.
    span = float(np.ptp(x[sound], axis=0).max(initial=0.0)) + 1e-12
    gravity = max([9.81, *(float(np.linalg.norm(f.g)) for f in w.features if isinstance(f, Gravity))])
    supply += float(w.particles.mass[w.particles.inv_mass > 0].sum()) * gravity * span
    if np.isfinite(top) and top > supply:
        faults.append(f"it moves with {top:.2g} J, more than the scene has to give ({supply:.2g} J)")
    if plain and shift:
        off = np.linalg.norm(x - plain.after - shift * np.eye(x.shape[1])[0], axis=1)
        motion = float(np.linalg.norm(plain.after - plain.before, axis=1).max())
        if off.max() > APART * max(motion, 1e-12):
            particle = int(np.argmax(off))
            faults.append(
                f"particle {particle} ends {off.max():.2g} m from where it does at the origin (motion {motion:.2g} m): "
                f"coordinates beyond the digits of {w.precision}"
                + ('; use precision="f32-compensated"' if w.precision == "f32" else "")
            )
    figure = f"residual {report.residual:.1e}, kinetic energy {top:.1e} J at most"
    return RunResult(report, before, x, faults, figure, particle)


def heavier(world: World, some: slice | np.ndarray) -> World:
    """Return a new world of the scene with the masses of some particles times 1e6."""
    p, mass = world.particles, np.array(world.particles.mass)
    mass[some] *= 1e6
    spin, orientation = world.spin if p.spins else None, None if p.orientation is None else world.orientation
    start = Particles(
        world.position, velocity=world.velocity, mass=mass, radius=p.radius, pinned=p.pinned, group=p.group,
        spin=spin, inertia=p.inertia, orientation=orientation,
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return World(start, [f.copy() for f in world.features], **world.settings)


def stiffer(world: World) -> World:
    """Return a clone with compliances divided by 1e9. Raises Untried if nothing is soft."""
    w = world.clone()
    soft = [f for f in w.features if np.any(getattr(f, "compliance", 0) > 0)]
    if not soft:
        raise Untried("nothing in the scene is soft")
    for f in soft:
        f.compliance = f.compliance / 1e9  # type: ignore[attr-defined]
    return w


def shifted(world: World, shift: float) -> World:
    """Return a clone shifted along x by `shift` [m]. Raises Untried if a feature cannot be shifted."""
    if fixed := [f for f in world.features if f.is_fixed_in_space]:
        raise Untried(f"{fixed[0]!r} cannot be moved from outside")
    w = world.clone()
    w.shift(shift * np.eye(world.particles.dim)[0])
    return w


def gathered(world: World, free: np.ndarray) -> World:
    """Return a clone with the particles `free` at their mean position. Raises Untried if there are none."""
    if not len(free):
        raise Untried("nothing can move")
    w, position = world.clone(), np.array(world.position)
    position[free] = position[free].mean(axis=0)
    w.position = position
    return w


def check_nan(world: World, free: np.ndarray) -> Outcome:
    """Check that NaN in position and velocity is refused by name, and that the state is unchanged."""
    parameter, k = "NaN in one input", int(free[-1]) if len(free) else 0
    if not len(world.particles):
        return Outcome(parameter, UNTRIED, "there are no particles")
    with world.clone() as w:
        before = w.hash()
        for name in ("position", "velocity"):
            value = np.array(getattr(w, name))
            value[k, 0] = np.nan
            try:
                setattr(w, name, value)
            except ValueError as error:
                if f"[{k}, 0]" not in str(error):
                    return Outcome(parameter, BREAKS, f"{name} was refused without naming row {k}: {error}", k)
            else:
                return Outcome(parameter, BREAKS, f"{name}[{k}, 0] = nan was taken", k)
        if w.hash() != before:
            return Outcome(parameter, BREAKS, "refused, but the state changed", k)
    return Outcome(parameter, REFUSED, f"position[{k}, 0] and velocity[{k}, 0]")
