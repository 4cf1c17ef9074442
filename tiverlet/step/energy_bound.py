"""Energy that comes from nowhere: how much of it a scene can have while nothing works on it.

What is passive, gravity, springs, dashpots, contacts, walls that stand, loses energy or keeps it,

    E(t) <= E(0) + O(h^2),

whatever vibrates in it, and why. E(0), the bound, is what it had when it began, or when it was last changed from outside: placed,
edited, a knob turned, a pin or a wall moved. Where it has more by a tenth of the largest kinetic energy since, the method pumps:
substeps are too long for something that no figure of its own tells. What each frame asks is in Clock.exceeds(); here is what is
asked where that says yes.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..forces import Gravity
from .clock import room
from .diagnostics import EXTENT, REACH
from .step_report import StepReport

if TYPE_CHECKING:
    from ..world import World

FALL = 1e-3  # of what all would gain in a fall through the scene: contacts lift what they begin to bear
ROUNDED = 64  # units in the last place of a coordinate, by which positions may be off
FLAG = "energy-gain"


def checked(world: "World", report: StepReport) -> StepReport:
    """The report of a frame at the end of which the scene may have too much, with a flag if that came from nowhere."""
    clock, sheet = world._clock, world._runner.sheet
    if works(world):
        clock.bound = None
        return report
    gain = report.energy - room(clock.bound, clock.kinetic, report.energy)
    if not gain > blur(world, sheet[EXTENT : EXTENT + world.particles.dim], sheet[REACH]):
        return report
    note = (
        f"Nothing works on the scene, but it has {report.energy - clock.bound:.3g} J more than it had; its kinetic energy was "
        f"{clock.kinetic:.3g} J at most. Use more substeps, at first {2 * report.substeps}, or soften what is stiff and heavy."
    )
    return replace(report, flags=report.flags | {FLAG}, notes=(*report.notes, note))


def works(world: "World") -> bool:
    """Whether anything may bring in energy that the report does not know."""
    state, memory = world._runner.scene.state, world._runner.memory
    if any(f.does_work for f in world.features):
        return True
    return bool(state.spins and memory.read(state.spin.s)[: len(world.particles)][world._runner.scene.inv_mass == 0].any())


def blur(world: "World", extent: np.ndarray, reach: Any) -> Any:
    """What contacts that begin to bear something, and the rounding of positions, may make of the energy [J]. extent: edges of
    the bounding box, (..., dim) [m]. reach: the largest coordinate, (...) [m]."""
    scene, h = world._runner.scene, world._clock.h
    pull = sum((np.abs(f.settings()["g"]) for f in world.features if isinstance(f, Gravity)), np.zeros(extent.shape[-1]))
    digit = ROUNDED * (2.0**-23 if world._precision != "f64" else 2.0**-52) * reach / h
    return (1 / scene.inv_mass[scene.inv_mass > 0]).sum() * (FALL * extent @ pull + digit**2)
