"""Energy that comes from nowhere: how much of it a scene can have while nothing works on it.

What is passive, gravity, springs, dashpots, contacts, walls that stand, loses energy or keeps it,

    E(t) <= E(0) + O(h^2),

whatever vibrates in it, and why. E(0), the bound, is what it had when it began, or when it was last changed from outside: placed,
edited, a knob turned, a pin or a wall moved. Where it has more by a tenth of the largest kinetic energy since, and by what forces
that are hardly resolved may err, (omega h)^2 / 4 of it, substeps are too long for something that no figure of its own tells. What
each frame asks is in Clock.exceeds(); here is what is asked where that says yes.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colliders.collider import Collider
from ..features.feature import Acceleration
from ..forces.gravity import Gravity
from ..neighbours.periodic import Periodic
from .clock import CHANGED, DIGITS, PARTED, room
from .diagnostics import EXTENT, KINETIC, REACH, STIFFNESS
from .step_report import StepReport

if TYPE_CHECKING:
    from ..world import World

FALL = 1e-3  # of what all would gain in a fall through the scene: contacts lift what they begin to bear
MISSED = 0.02  # of the largest kinetic energy: how much of it a frame with substeps="auto" may get wrong
SKIN = 1e-5  # of the largest coordinate: how deep what lies on a wall may seem
ROUNDED = 64  # units in the last place of a coordinate, by which positions may be off
FLAG = "energy-gain"


def checked(world: "World", report: StepReport) -> StepReport:
    """The report of a frame at the end of which the scene may have too much, with a flag if that came from nowhere."""
    clock, sheet = world._clock, world._runner.sheet
    if works(world):
        clock.bound = None
        return report
    bound: Any = clock.bound
    gain = report.energy - room(bound, clock.kinetic, report.energy)
    err = blur(world, sheet[EXTENT : EXTENT + world.particles.dim], sheet[REACH]) + sheet[STIFFNESS] / 4 * clock.kinetic
    if not gain > err:
        return report
    if inside(world, sheet[REACH]):
        clock.bound = report.energy
        return report
    if not gain > err + let_out(world):
        return report
    note = (
        f"Nothing works on the scene, but it has {report.energy - bound:.3g} J more than it had; its kinetic energy was "
        f"{clock.kinetic:.3g} J at most. Use more substeps, at first {2 * report.substeps}, or soften what is stiff and heavy."
    )
    return replace(report, flags=report.flags | {FLAG}, notes=(*report.notes, note))


def before(world: "World") -> float | None:
    """The energy before a frame; None where it may get more, for it was changed from outside, or parts from overlaps."""
    clock = world._clock
    return None if clock.bound == CHANGED or clock.parting else clock.energy


@np.errstate(all="ignore")  # energies may be infinite
def missed(world: "World", report: StepReport, energy: float | None) -> float:
    """By how much a frame that had `energy` before got it wrong, relative to what is good: what came from nowhere or, where
    there is nothing but forces, was lost. What begins and ends in one frame, as when two bodies fly past each other, no other
    figure tells. What all fly by is not counted, for it takes no part in that."""
    if energy is None:
        return 0.0
    clock, sheet = world._clock, world._runner.sheet
    if all(isinstance(f, Periodic) or (isinstance(f, Acceleration) and not _brakes(f)) for f in world.features):
        change = abs(report.energy - energy)
    else:
        change = report.energy - (energy if clock.bound is None else max(energy, clock.bound))
    if not change > 0 or works(world):
        return 0.0
    kinetic = max(clock.kinetic, sheet.item(KINETIC))
    allowed = MISSED * max(0.0, kinetic - _drift(world)) + DIGITS * (abs(report.energy) + kinetic)
    return float(change / allowed) if allowed else 0.0


def _brakes(force: Acceleration) -> bool:
    """Whether it may take energy."""
    return force.decays or force.uses_velocity


def _drift(world: "World") -> float:
    """The kinetic energy of all that moves as one [J]."""
    runner, inv_mass, mass = world._runner, world._runner.scene.inv_mass, _masses(world)
    momentum = (runner.memory.read(runner.scene.state.d)[: len(inv_mass)][inv_mass > 0] / world._clock.h).T @ mass
    return float(momentum @ momentum / (2 * mass.sum())) if len(mass) else 0.0


def works(world: "World") -> bool:
    """Whether anything may bring in energy that the report does not know."""
    state, memory = world._runner.scene.state, world._runner.memory
    if any(f.does_work for f in world.features):
        return True
    return bool(state.spins and memory.read(state.spin.s)[: len(world.particles)][world._runner.scene.inv_mass == 0].any())


def inside(world: "World", reach: float) -> bool:
    """Whether any particle is in a wall, which lets it out at push_out."""
    x, radius = world.position, world.particles.radius
    deep = PARTED * radius + SKIN * reach
    return any(bool((wall.clearance(x) - radius < -deep).any()) for wall in _walls(world))


def let_out(world: "World") -> float:
    """What a wall gives a particle in the frame in which it has let it out [J]."""
    push = max([wall.push_out for wall in _walls(world)], default=0.0)
    lift = float(np.linalg.norm(_pull(world))) * world._clock.frame[1]
    return float(_masses(world).max()) * push * (lift + push / 2)


def blur(world: "World", extent: np.ndarray, reach: Any) -> Any:
    """What contacts that begin to bear something, and the rounding of positions, may make of the energy [J]. extent: edges of
    the bounding box, (..., dim) [m]. reach: the largest coordinate, (...) [m]."""
    digit = ROUNDED * (2.0**-23 if world._precision != "f64" else 2.0**-52) * reach / world._clock.h
    return _masses(world).sum() * (FALL * extent @ _pull(world) + digit**2)


def _masses(world: "World") -> np.ndarray:
    """Of what can move [kg]."""
    inv_mass = world._runner.scene.inv_mass
    return 1 / inv_mass[inv_mass > 0]


def _pull(world: "World") -> np.ndarray:
    """The sizes of the components of gravity."""
    pulls = [np.abs(f.settings()["g"]) for f in world.features if isinstance(f, Gravity)]
    return sum(pulls, np.zeros(world.particles.dim))


def _walls(world: "World") -> list[Collider]:
    """Those that stand, and that can be asked; one of the user's need not."""
    walls = [f for f in world.features if isinstance(f, Collider) and f.was_active]
    return [wall for wall in walls if type(wall).clearance is not Collider.clearance]
