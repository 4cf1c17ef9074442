"""Spurious energy: an upper bound on the energy of a scene on which nothing does work.

A passive scene, of gravity, springs, dashpots, contacts and fixed walls, loses or conserves energy,

    E(t) <= E(0) + O(h^2),

whatever vibrates in it. E(0), the bound, is the energy at the beginning, or when the scene was last changed from outside:
particles placed, features edited, a knob changed, a pin or a wall moved. The check allows a gain of a tenth of the largest
kinetic energy since then, plus the error of forces that are hardly resolved, (omega h)^2 / 4 of that energy. A larger gain means
that substeps are too long for some motion that no other figure of the report measures. Clock.exceeds() checks this after each
frame; this file has the further checks for frames where it returns true.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colliders.collider import Collider
from ..features.feature import Acceleration
from ..forces.gravity import Gravity
from ..neighbours.periodic import Periodic
from .clock import CHANGED, DIGITS, PARTED, energy_limit
from .diagnostics import EXTENT, KINETIC, REACH, STIFFNESS
from .step_report import StepReport

if TYPE_CHECKING:
    from ..world import World

FALL = 1e-3  # share of the energy of a fall through the scene: contacts lift particles that they begin to bear
MISSED = 0.02  # share of the largest kinetic energy by which the energy may be wrong in a frame with substeps="auto"
SKIN = 1e-5  # share of the largest coordinate: apparent depth of particles that lie on a wall, at most
ROUNDED = 64  # rounding error of positions, in units in the last place of the largest coordinate
FLAG = "energy-gain"


def checked(world: "World", report: StepReport) -> StepReport:
    """Return the report of a frame after which Clock.exceeds() is true, with the flag "energy-gain" if the gain is spurious."""
    clock, sheet = world._clock, world._runner.sheet
    if works(world):
        clock.bound = None
        return report
    bound: Any = clock.bound
    gain = report.energy - energy_limit(bound, clock.kinetic, report.energy)
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
    """Return the energy before a frame [J]; None if the frame may add some: after a change, or while overlaps are released."""
    clock = world._clock
    return None if clock.bound == CHANGED or clock.parting else clock.energy


@np.errstate(all="ignore")  # energies may be infinite
def missed(world: "World", report: StepReport, energy: float | None) -> float:
    """Return the error of the energy in a frame that began with `energy` [J], relative to the allowed error.

    The error is the spurious gain; if there are only conservative forces, also the loss. No other figure measures events that
    begin and end within a frame, such as two bodies that fly past each other. The kinetic energy of the common motion of all
    particles is not counted in the allowed error, since it takes no part in such events.
    """
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
    """Whether a force may take energy out of the scene."""
    return force.decays or force.uses_velocity


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
    """Whether any particle is inside of a wall, which pushes it out at push_out. reach: the largest coordinate [m]."""
    x, radius = world.position, world.particles.radius
    deep = PARTED * radius + SKIN * reach
    return any(bool((wall.clearance(x) - radius < -deep).any()) for wall in _walls(world))


def let_out(world: "World") -> float:
    """Return the most energy that a wall gives a particle in the frame in which the particle gets free of it [J]."""
    push = max([wall.push_out for wall in _walls(world)], default=0.0)
    lift = float(np.linalg.norm(_pull(world))) * world._clock.frame[1]
    return float(_masses(world).max()) * push * (lift + push / 2)


def blur(world: "World", extent: np.ndarray, reach: Any) -> Any:
    """Return the most energy that contacts which begin to bear a load, and the rounding of positions, may add [J].

    extent: edges of the bounding box, (..., dim) [m]. reach: the largest coordinate, (...) [m].
    """
    digit = ROUNDED * (2.0**-23 if world._precision != "f64" else 2.0**-52) * reach / world._clock.h
    return _masses(world).sum() * (FALL * extent @ _pull(world) + digit**2)


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
