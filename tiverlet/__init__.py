"""tiverlet: a particle engine on Taichi. Position Verlet, a spatial hash, and Jacobi constraints from soft to rigid."""

from typing import Any

from .device import runtime  # first: it sets what Taichi reads when it is imported  # isort: skip
from . import measure, shapes
from .colliders import Ball, Box, Capsule, HalfSpace, Mesh, Polygon, Sdf
from .constraints import AngleLimit, Area, Bend, Constraint, Dihedral, Distance, Path, Pin, Rope, ShapeMatch, Snap, Spacer, Volume
from .contact import Contact, Polygons
from .device.runtime import init
from .forces import Attractor, Drag, Force, Gravity, Wind
from .particles import Particles
from .recording import Recorder, replay
from .solvers import Chebyshev, ConjugateGradient, Direct, Jacobi
from .step_report import StepReport
from .tools import approach, clamp, golden, golden_colors, golden_index, mix, smoothstep
from .world import World

__all__ = [
    "AngleLimit", "Area", "Attractor", "Ball", "Bend", "Box", "Capsule", "Chebyshev", "ConjugateGradient", "Constraint",
    "Contact", "Dihedral", "Direct", "Distance", "Drag", "Force", "Gravity", "HalfSpace", "Jacobi", "Mesh", "Particles",
    "Path", "Pin", "Polygon", "Polygons", "Recorder", "Rope", "Sdf", "ShapeMatch", "Snap", "Spacer", "StepReport", "Volume",
    "Wind", "World", "approach", "clamp", "golden", "golden_colors", "golden_index", "init", "measure", "mix", "replay",
    "runtime", "shapes", "smoothstep",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """tv.report is imported when it is first asked for: scenes need none of it."""
    if name == "report":
        import importlib

        return importlib.import_module(".report", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
