"""Robustness of the user's own scene: make one parameter at a time extreme, and report what breaks."""

import json
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...colliders import Box, HalfSpace
from ...colliders.moving import Moving
from ...constraints import Constraint, Path, Snap
from ...features.feature import Batch, Feature
from ...forces import Force, Gravity
from ...measure import kinetic_energy
from ...particles import Particles
from ...world import World
from ..output import Report, Table, error_line

if TYPE_CHECKING:
    from ...step.step_report import StepReport

STANDS, REFUSED, BREAKS, UNTRIED = "stands it", "refused by name", "BREAKS", "not tried"
LOOSE = 0.1  # relative violation of a constraint beyond which it counts as broken
APART = 1e-3  # tolerance of a shifted scene's final positions, as a share of the motion
PLACES = ("lower", "upper", "center", "a", "b", "target")  # attributes of features that are positions


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
        rows, styles = (
            [(o.parameter, o.verdict, o.how) for o in self.outcomes],
            ["red" * (o.verdict == BREAKS) for o in self.outcomes],
        )
        yield Table("One parameter at a time", ("parameter", "verdict", "how"), rows, (), ("verdict",), styles)

    def json(self) -> str:
        """Return the outcomes as JSON."""
        return json.dumps({"passed": self.passed, "outcomes": [asdict(o) for o in self.outcomes]}, indent=1)


@dataclass
class Scene:
    """The data that a world is built from, of which one item is changed."""

    position: np.ndarray
    velocity: np.ndarray
    mass: np.ndarray
    features: list[Feature]
    dt: float

    def build(self, world: World) -> World:
        """Return a world with this data and the settings and structure of `world`."""
        p = world.particles
        start = Particles(self.position, velocity=self.velocity, mass=self.mass, radius=p.radius, pinned=p.pinned, group=p.group)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return World(start, self.features, **world.settings)


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
    plain = run_scene(world, scene_of(world, dt), seconds, None)
    tries: list[tuple[str, Callable[[], Scene | str]]] = [
        ("dt x 10", lambda: scene_of(world, 10 * dt)),
        ("all masses x 1e6", lambda: heavier(world, dt, None)),
        ("mass of one particle x 1e6", lambda: heavier(world, dt, last(world))),
        ("stiffnesses x 1e9", lambda: stiffer(world, dt)),
        (f"shifted by {shift:g} m", lambda: shifted(world, dt, shift)),
        ("all particles at one point", lambda: gathered(world, dt)),
    ]
    outcomes = [Outcome("as it is", BREAKS if plain.faults else STANDS, "; ".join(plain.faults) or plain.figure, plain.particle)]
    for parameter, make in tries:
        try:
            scene = make()
            if isinstance(scene, str):
                outcomes.append(Outcome(parameter, UNTRIED, scene))
                continue
            seen = run_scene(world, scene, seconds, plain, moves=parameter.startswith("shifted") and shift)
            outcomes.append(
                Outcome(parameter, BREAKS if seen.faults else STANDS, "; ".join(seen.faults) or seen.figure, seen.particle)
            )
        except (ValueError, TypeError, RuntimeError) as error:
            outcomes.append(Outcome(parameter, REFUSED, error_line(error)))
    outcomes.append(check_nan(world))
    return Endurance(outcomes)


@dataclass
class RunResult:
    """The result of one run: the worst report, final positions, faults, a figure in words, and the first particle affected."""

    report: "StepReport"
    position: np.ndarray
    faults: list[str]
    figure: str
    particle: int | None


def run_scene(world: World, scene: Scene, seconds: float, plain: RunResult | None, moves: Any = False) -> RunResult:
    """Run a scene and compare it with the run of the unperturbed scene. moves: the shift along x [m], or False."""
    with scene.build(world) as w:
        first = w.step(scene.dt)
        begin = first.energy - first.energy_change
        report, top = first, kinetic_energy(w)
        for _ in range(max(1, round(seconds / scene.dt)) - 1):
            report = report.worse(w.step(scene.dt))
            top = max(top, kinetic_energy(w))
        x = w.position
        faults, particle = [], report.bad
        if not np.isfinite(x).all():
            bad = ~np.isfinite(x).all(axis=1)
            particle = int(np.argmax(bad)) if particle is None else particle
            faults.append(f"the state of particle {particle} is not finite{constraint_of(w, particle)}")
        new = report.flags - (plain.report.flags if plain else frozenset())
        faults += [note for flag, note in zip(sorted(report.flags), sorted_notes(report), strict=False) if flag in new]
        before = plain.report.residual if plain else 0.0
        if report.residual > max(LOOSE, 2 * before):
            worst = most_violated(w)
            faults.append(f"constraints are off by {report.residual:.2g} of their size{worst[0]}")
            particle = worst[1] if particle is None else particle
        span = float(np.ptp(x[np.isfinite(x).all(axis=1)], axis=0).max(initial=0.0)) + 1e-12
        weight = float(np.where(w.particles.inv_mass > 0, w.particles.mass, 0.0).sum())
        kinetic = 0.5 * float(np.where(w.particles.inv_mass > 0, w.particles.mass, 0.0) @ (scene.velocity**2).sum(axis=1))
        # The energy that the scene can supply: at the start, and by a fall over the extent of the scene.
        allowed = abs(begin) + kinetic + weight * gravity_of(w) * span
        if np.isfinite(top) and top > allowed:
            faults.append(f"it moves with {top:.2g} J, more than the scene has to give ({allowed:.2g} J)")
        if moves and plain:
            off = np.linalg.norm(x - plain.position - moves * np.eye(x.shape[1])[0], axis=1)
            motion = float(np.linalg.norm(plain.position - scene.position + moves * np.eye(x.shape[1])[0], axis=1).max())
            if off.max() > APART * max(motion, 1e-12):
                particle = int(np.argmax(off))
                faults.append(
                    f"particle {particle} ends {off.max():.2g} m from where it does at the origin (motion {motion:.2g} m): "
                    f"coordinates beyond the digits of {w.precision}"
                    + ('; use precision="f32-compensated"' if w.precision == "f32" else "")
                )
        figure = f"residual {report.residual:.1e}, kinetic energy {top:.1e} J at most"
        return RunResult(report, x, faults, figure, particle)


def gravity_of(w: World) -> float:
    """Return the largest gravity [m/s^2], but at least that of the earth, to allow for other forces."""
    pulls = [float(np.linalg.norm(f.g)) for f in w.features if isinstance(f, Gravity)]
    return max([*pulls, 9.81])


def sorted_notes(report: "StepReport") -> list[str]:
    """Return a note for each flag of a report, in the order of the flags' names; the flag itself if it has no note."""
    order = (
        "non-finite", "out-of-range", "tunnelling-risk", "compressed", "turned", "softened", "stiff-force", "unconverged",
        "energy-gain", "energy-loss",
    )  # fmt: skip
    told = dict(zip([f for f in order if f in report.flags], report.notes, strict=False))
    return [told.get(flag, flag) for flag in sorted(report.flags)]


def constraint_of(w: World, particle: int) -> str:
    """Return the first constraint of a particle, in words; empty if it has none."""
    for f in w.features:
        if isinstance(f, Batch) and f.arity:
            rows = np.flatnonzero((f.indices == particle).any(axis=1))
            if len(rows):
                return f"; it is in {f!r} {int(rows[0])} = {tuple(int(i) for i in f.indices[rows[0]])}"
    return ""


def most_violated(w: World) -> tuple[str, int | None]:
    """Return the most violated constraint, in words, and its first particle that can move."""
    worst, said_, who = 0.0, "", None
    for f in w.features:
        if isinstance(f, Batch) and f.count:
            left = f.residual
            k = int(np.argmax(left))
            if left[k] > worst:
                at = [int(i) for i in f.members_of(k)]
                worst, said_ = float(left[k]), f", most of all {f!r} {k} = {tuple(at)}" if len(at) < 9 else f", {f!r} {k}"
                who = next((i for i in at if w.particles.inv_mass[i] > 0), None)
    return said_, who


def scene_of(world: World, dt: float) -> Scene:
    """Return the current scene of a world."""
    features = [f.copy() for f in world.features]
    return Scene(world.position.copy(), world.velocity.copy(), world.particles.mass.copy(), features, dt)


def last(world: World) -> int | None:
    """Return the last particle that can move; None if there is none."""
    free = np.flatnonzero(world.particles.inv_mass > 0)
    return int(free[-1]) if len(free) else None


def heavier(world: World, dt: float, particle: int | None) -> Scene:
    """Return the scene with masses times 1e6: of all particles (None), or of one."""
    scene = scene_of(world, dt)
    scene.mass[slice(None) if particle is None else particle] *= 1e6
    return scene


def stiffer(world: World, dt: float) -> Scene | str:
    """Return the scene with compliances divided by 1e9, or the reason why it cannot be perturbed so."""
    scene, soft = scene_of(world, dt), False
    for f in scene.features:
        alpha = getattr(f, "compliance", None)
        if isinstance(alpha, np.ndarray) and (alpha > 0).any():
            f.__dict__["compliance"], soft = alpha / 1e9, True
    return scene if soft else "nothing in the scene is soft"


def shifted(world: World, dt: float, shift: float) -> Scene | str:
    """Return the scene shifted along x by `shift` [m], or the reason why it cannot be shifted."""
    scene = scene_of(world, dt)
    by = shift * np.eye(scene.position.shape[1])[0]
    for f in scene.features:
        if isinstance(f, (Force, Path, Snap)) or (isinstance(f, Constraint)):
            return f"{f!r} cannot be moved from outside"
        own = f.__dict__
        if isinstance(f, Moving):
            own["position"] = np.asarray(f.position) + by
        elif isinstance(f, HalfSpace):
            own["offset"] = float(f.offset + np.asarray(f.normal) @ by)
        else:
            for name in PLACES if not isinstance(f, Batch) or hasattr(f, "target") or isinstance(f, Box) else ():
                if name in own:
                    own[name] = np.asarray(own[name]) + by
    scene.position = scene.position + by
    return scene


def gathered(world: World, dt: float) -> Scene | str:
    """Return the scene with all particles that can move at their mean position, or the reason why there are none."""
    scene, free = scene_of(world, dt), world.particles.inv_mass > 0
    if not free.any():
        return "nothing can move"
    # Features that were built before keep their rest values.
    scene.position[free] = scene.position[free].mean(axis=0)
    return scene


def check_nan(world: World) -> Outcome:
    """Check that NaN in position and velocity is refused by name, and that the world is unchanged."""
    parameter, before = "NaN in one input", world.hash()
    k = last(world) or 0
    for name in ("position", "velocity"):
        value = np.array(getattr(world, name))
        if not len(value):
            return Outcome(parameter, UNTRIED, "there are no particles")
        value[k, 0] = np.nan
        try:
            setattr(world, name, value)
        except ValueError as error:
            if f"[{k}, 0]" not in str(error):
                return Outcome(parameter, BREAKS, f"{name} was refused without naming row {k}: {error}", k)
        else:
            return Outcome(parameter, BREAKS, f"{name}[{k}, 0] = nan was taken", k)
    if world.hash() != before:
        return Outcome(parameter, BREAKS, "refused, but the state changed", k)
    return Outcome(parameter, REFUSED, f"position[{k}, 0] and velocity[{k}, 0]")
