"""Spurious gains and losses: bounds on the energy of a scene on which nothing does work.

A passive scene, of gravity, springs, dashpots, contacts and fixed walls, loses or conserves energy,

    E(t) <= E(0) + O(h^2),

whatever vibrates in it. E(0), the bound, is the energy at the beginning, or when the scene was last changed from outside:
particles placed, features edited, a knob changed, a pin or a wall moved. The check allows a gain of a tenth of the largest
kinetic energy since then, plus the error of forces that are hardly resolved, (omega h)^2 / 4 of that energy. A larger gain means
that substeps are too long for some motion that no other figure of the report measures. exceeds() checks this after each
frame; this file has the further checks for frames where it returns true.

A scene of springs, uniform gravity, and walls and contacts without friction that return what strikes them also has a lower bound,

    E(t) >= E(0) - O(h^2),

since nothing in it is known to take energy out. But springs that the substep does not resolve are damped by it: a vibration loses
2 pi s^5 of its energy in each period, s = omega h, see adaptive.damping(). A loss of more than a tenth of the largest kinetic
energy is flagged. falls_short() finds the frames for checked_for_loss(), see conserves() for the scenes.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colliders.collider import Collider
from ..colliders.surface import speed_of_parting
from ..constraints.core.anchored import Anchored
from ..constraints.core.scalar import Scalar
from ..features.feature import Acceleration, Batch
from ..forces.gravity import Gravity
from ..neighbours.periodic import Periodic
from .clock import CHANGED, DIGITS, NO, PARTED, UNKNOWN, YES, energy_floor, energy_limit, initial_margin
from .diagnostics import ENERGY, EXTENT, KINETIC, REACH, STIFFNESS
from .step_report import StepReport

if TYPE_CHECKING:
    from ..world import World

FALL = 1e-3  # share of the energy of a fall through the scene: contacts lift particles that they begin to bear
MISSED = 0.02  # share of the largest kinetic energy by which the energy may be wrong in a frame with substeps="auto"
BOUNCED = 0.003  # the same where bodies bounce and nothing takes energy out: impacts follow each other, and errors add up
SKIN = 1e-5  # share of the largest coordinate: apparent depth of particles that lie on a wall, at most
ROUNDED = 64  # rounding error of positions, in units in the last place of the largest coordinate
SMALL_LOSS = 0.05  # of its energy, that a spring may lose: half of what is flagged. In a radian it loses (omega h)^5 of it
GAIN, LOST = "energy-gain", "energy-loss"


def checked(world: "World", report: StepReport) -> StepReport:
    """Return the report of a frame after which exceeds() is true, with the flag "energy-gain" if the gain is spurious."""
    clock = world._clock
    bound: Any = clock.bound
    gain = report.energy - energy_limit(bound, clock.kinetic, report.energy)
    if not spurious_gain(world, np.array([gain]), world._runner.sheet[None])[0]:
        return report
    rounded = world._runner.diagnostics.report.rounds_loads(float(world._runner.sheet[REACH]), clock.h)
    note = (
        f"Nothing works on the scene, but it has {report.energy - bound:.3g} J more than it had; its kinetic energy was "
        f"{clock.kinetic:.3g} J at most. Use more substeps, at first {2 * report.substeps}, or soften what is stiff and heavy."
        f"{rounded}"
    )
    return replace(report, flags=report.flags | {GAIN}, notes=(*report.notes, note))


def spurious_gain(world: "World", gain: np.ndarray, figures: np.ndarray) -> np.ndarray:
    """Return in which frames the energy beyond energy_limit() is spurious, (frames,).

    gain: by how much it is beyond that, (frames,) [J]. figures: of the report, (frames, any). If they tell of work that is done,
    the bound is changed.
    """
    clock = world._clock
    if works(world):
        clock.bound = None
        return np.zeros(len(gain), dtype=bool)
    reach = figures[:, REACH]
    err = blur(world, figures[:, EXTENT : EXTENT + world.particles.dim], reach) + figures[:, STIFFNESS] / 4 * clock.kinetic
    if (gain > err).any() and inside(world, reach.max()):
        clock.bound, err = float(figures[:, ENERGY].max()), np.inf
    return gain > err + let_out(world)


def checked_for_loss(world: "World", report: StepReport) -> StepReport:
    """Return the report of a frame after which falls_short() is true, with "energy-loss" if the loss is spurious."""
    clock = world._clock
    bound: Any = clock.bound
    if not spurious_loss(world, energy_floor(bound, clock.kinetic, report.energy) - report.energy, world._runner.sheet):
        return report
    omega = fastest_spring(world)
    need = np.ceil(report.substeps * omega * clock.h * (omega * clock.time / SMALL_LOSS) ** 0.2)
    cause = f"Rigid links lose some where they turn far in a substep. Use more substeps, at first {2 * report.substeps}. "
    if need > report.substeps:
        cause = (
            f"Springs that a substep does not resolve are damped by it: the fastest has omega h = {omega * clock.h:.3g}. "
            f"With {need:.7g} substeps it would lose {100 * SMALL_LOSS:g} % by now. "
        )
    note = (
        f"Nothing is said to take energy out of the scene, but it has {bound - report.energy:.3g} J less than it had; its "
        f"kinetic energy was {clock.kinetic:.3g} J at most. {cause}"
        "Otherwise say that energy is lost: give springs damping, or make rigid what is too stiff (compliance 0)."
    )
    return replace(report, flags=report.flags | {LOST}, notes=(*report.notes, note))


def spurious_loss(world: "World", loss: float, figures: np.ndarray) -> bool:
    """Return whether the energy that lacks to energy_floor(), `loss` [J], is lost by nothing. figures: of the report."""
    clock = world._clock
    if clock.conserves == UNKNOWN:
        clock.conserves = YES if conserves(world) and not works(world) else NO
    extent, reach = figures[EXTENT : EXTENT + world.particles.dim], figures[REACH]
    if clock.conserves != YES or not loss > loss_error(world, extent, reach):
        return False
    begun, _, frames = clock.frame
    if begun == 0 and frames == 1 and any(isinstance(f, Scalar) and (f.compliance == 0).any() for f in world.features):
        clock.bound = float(figures[ENERGY])  # given velocities along rigid constraints are lost at once, as in an impact
        return False
    return True


def before(world: "World") -> float | None:
    """Return the energy before a frame [J]; None if the frame may add some: after a change, or while overlaps are released."""
    clock = world._clock
    return None if clock.bound == CHANGED or clock.parting else clock.energy


@np.errstate(all="ignore")  # energies may be infinite
def missed(world: "World", report: StepReport, energy: float | None) -> float:
    """Return the error of the energy in a frame that began with `energy` [J], relative to the allowed error.

    The error is the spurious gain; if there are only conservative forces, or if nothing takes energy out of bodies that bounce,
    also the loss. No other figure measures events that begin and end within a frame, such as two bodies that fly past each other,
    or an impact of linked particles, which is right to O(h). The kinetic energy of the common motion of all particles is not
    counted in the allowed error, since it takes no part in such events.
    """
    if energy is None:
        return 0.0
    clock, sheet = world._clock, world._runner.sheet
    conserves, bounces = keeps_energy(world), world._runner.bounces
    if conserves and (bounces or all(isinstance(f, (Periodic, Acceleration)) for f in world.features)):
        change = abs(report.energy - energy)
    else:
        change = report.energy - (energy if clock.bound is None else max(energy, clock.bound))
    if not change > 0 or works(world):
        return 0.0
    kinetic = max(clock.kinetic, sheet.item(KINETIC))
    share = BOUNCED if conserves and bounces else MISSED
    allowed = share * max(0.0, kinetic - _drift(world)) + DIGITS * (abs(report.energy) + kinetic)
    return float(change / allowed) if allowed else 0.0


def keeps_energy(world: "World") -> bool:
    """Whether nothing takes energy out of the scene, as far as is known: no force, contact, dashpot, plastic flow or break."""
    springs = [f for f in world.features if isinstance(f, Batch)]
    if not all(f.conserves for f in world.features if not isinstance(f, Batch)):
        return False
    return not any(f.driven or f.breaks or np.any(getattr(f, name, 0.0)) for f in springs for name in ("damping", "creep"))


def conserves(world: "World") -> bool:
    """Whether the scene has springs, and nothing that may take energy out of it or that errs by an unknown amount.

    False for what dissipates, see keeps_energy(); for rigid constraints on one side, since a rope that becomes taut is an
    inelastic impact; for forces that vary in space; and for constraints of unknown kinds. Rigid links do no work, so a beam of
    links and soft bends is checked.
    """
    if not keeps_energy(world) or not all(f.uniform for f in world.features if isinstance(f, Acceleration)):
        return False
    batches, inv_mass = [f for f in world.features if isinstance(f, Batch)], world._runner.scene.inv_mass
    springs = [f for f in batches if isinstance(f, (Scalar, Anchored))]
    jerks = any(getattr(f, "side", 0) and ((f.compliance == 0) & ~f.immovable(inv_mass)).any() for f in springs)
    return len(springs) == len(batches) and not jerks and any((f.compliance > 0).any() for f in springs)


def loss_error(world: "World", extent: np.ndarray, reach: Any) -> float:
    """Return by how much the energy of a scene that conserves energy may fall [J]. extent, reach: see blur().

    A load that begins to act makes stiff springs sag, and they lose the vibration about that: it does not count up to FALL of the
    energy of a fall as far as the scene is wide. The energy in the middle of a substep is (omega h)^2 / 4 of the stored energy
    less where a spring begins to relax than where it is at rest. Rounding stretches springs, which costs energy the stiffer they
    are.
    """
    h, inv_mass, x = world._clock.h, world._runner.scene.inv_mass, world.position
    sag = FALL * _masses(world).sum() * np.linalg.norm(extent) * np.linalg.norm(_pull(world))
    out = sag + rounding(world, reach) + initial_margin(inv_mass, extent, h)
    for f, some in springs(world):
        alpha, w = f.compliance[some], f.weights(x)[some]
        s2 = w * h**2 / alpha
        if isinstance(f, Scalar):
            C = f.violation(x)
            square = (np.maximum(f.side * C, 0) if f.side else C)[some] ** 2
        else:
            square = (f.offset(x)[some] ** 2).sum(axis=1)
        stretch = w / inv_mass[inv_mass > 0].min() * _digit(world, reach) ** 2  # at least |grad f|^2 times that of the digit
        out += float(((np.where(s2 < 1, s2 / 4, 0) * square + stretch) / (2 * alpha)).sum())
    return float(out)


def fastest_spring(world: "World") -> float:
    """Return the angular frequency of the fastest spring [rad/s]."""
    x = world.position
    return float(np.sqrt(max([(f.weights(x)[some] / f.compliance[some]).max() for f, some in springs(world)], default=0.0)))


def springs(world: "World") -> list[tuple[Any, np.ndarray]]:
    """Return the batches of springs, and the mask of those constraints in each that can move something."""
    inv_mass = world._runner.scene.inv_mass
    batches = [f for f in world.features if isinstance(f, (Scalar, Anchored))]
    each = [(f, (f.compliance > 0) & ~f.immovable(inv_mass)) for f in batches]
    return [(f, some) for f, some in each if some.any()]


def allowed_loss(world: "World", rate: float) -> float:
    """Return the energy that a frame may lose at a rate [1/s] of the largest kinetic energy, beside rounding [J]."""
    clock, sheet = world._clock, world._runner.sheet
    kinetic, energy = max(clock.kinetic, sheet.item(KINETIC)), sheet.item(ENERGY)
    return rate * clock.frame[1] * kinetic + DIGITS * abs(energy) + rounding(world, sheet.item(REACH))


def _drift(world: "World") -> float:
    """Return the kinetic energy of the common motion of all particles [J]."""
    runner, inv_mass, mass = world._runner, world._runner.scene.inv_mass, _masses(world)
    momentum = (runner.memory.read(runner.scene.state.d)[: len(inv_mass)][inv_mass > 0] / world._clock.h).T @ mass
    return float(momentum @ momentum / (2 * mass.sum())) if len(mass) else 0.0


def works(world: "World") -> bool:
    """Whether anything may add energy that the report does not account for: features that do work, static particles that spin."""
    state, memory = world._runner.scene.state, world._runner.memory
    if any(f.does_work for f in world.features):
        return True
    return bool(state.spins and memory.read(state.spin.s)[: len(world.particles)][world._runner.scene.inv_mass == 0].any())


def inside(world: "World", reach: float) -> bool:
    """Whether any particle that can move is inside of a wall, which pushes it out at push_out. reach: the largest coordinate
    [m]."""
    x, radius, moves = world.position, world.particles.radius, world._runner.scene.inv_mass > 0
    deep = PARTED * radius + SKIN * reach
    return any(bool((moves & (wall.clearance(x) - radius < -deep)).any()) for wall in _walls(world))


def let_out(world: "World") -> float:
    """Return the most energy that a wall gives a particle in the frame in which the particle gets free of it [J]."""
    push = max([speed_of_parting(wall.push_out) for wall in _walls(world)], default=0.0)
    lift = float(np.linalg.norm(_pull(world))) * world._clock.frame[1]
    return float(_masses(world).max()) * push * (lift + push / 2)


def blur(world: "World", extent: np.ndarray, reach: Any) -> Any:
    """Return the most energy that contacts which begin to bear a load, and the rounding of positions, may add [J].

    extent: edges of the bounding box, (..., dim) [m]. reach: the largest coordinate, (...) [m].
    """
    return _masses(world).sum() * FALL * extent @ _pull(world) + rounding(world, reach)


def rounding(world: "World", reach: Any) -> Any:
    """Return the energy that the rounding of positions may add [J]. reach: the largest coordinate, (...) [m]."""
    return _masses(world).sum() * (_digit(world, reach) / world._clock.h) ** 2


def _digit(world: "World", reach: Any) -> Any:
    """Return the rounding error of positions [m]. reach: the largest coordinate, (...) [m]."""
    return ROUNDED * (2.0**-23 if world._precision != "f64" else 2.0**-52) * reach


def _masses(world: "World") -> np.ndarray:
    """Return the masses of particles that can move [kg]."""
    inv_mass = world._runner.scene.inv_mass
    return 1 / inv_mass[inv_mass > 0]


def _pull(world: "World") -> np.ndarray:
    """Return the absolute values of the components of gravity, (dim,) [m/s^2]."""
    pulls = [np.abs(f.kernel_values()["g"]) for f in world.features if isinstance(f, Gravity)]
    return sum(pulls, np.zeros(world.particles.dim))


def _walls(world: "World") -> list[Collider]:
    """Return the walls that are present and implement clearance(), which walls of the user need not do."""
    walls = [f for f in world.features if isinstance(f, Collider) and f.was_active]
    return [wall for wall in walls if type(wall).clearance is not Collider.clearance]
