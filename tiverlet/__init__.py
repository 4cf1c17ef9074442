"""tiverlet: a particle engine on Taichi. Position Verlet, a spatial hash, and Jacobi constraints from soft to rigid."""

from typing import TYPE_CHECKING, Any

from .device import runtime  # first: it sets variables that Taichi reads at import  # isort: skip
from . import checks, measure, shapes
from .colliders import Ball, Box, Capsule, HalfSpace, Mesh, Polygon, Sdf
from .constraints import (
    AngleLimit,
    Area,
    Bend,
    Constraint,
    Dihedral,
    Distance,
    Motor,
    Path,
    Pin,
    Rope,
    ShapeMatch,
    Snap,
    Spacer,
    Volume,
    Winch,
)
from .contact import Contact, Polygons
from .features.unknown_names import no_name
from .forces import Attractor, Drag, Force, Gravity, Hand, PairForce, Wind
from .neighbours import Periodic
from .particles import Particles
from .recording import Recorder, WorldsRecorder, load, replay
from .solvers import Chebyshev, ConjugateGradient, Direct, Jacobi
from .step.sleep import Sleep
from .step.step_report import StepReport
from .tools import approach, clamp, golden, golden_colors, golden_index, mix, smoothstep
from .world import World
from .worlds import SweepResult, Worlds, gradient, sweep

if TYPE_CHECKING:
    from .live import play

__all__ = [
    "AngleLimit", "Area", "Attractor", "Ball", "Bend", "Box", "Capsule", "Chebyshev", "ConjugateGradient", "Constraint",
    "Contact", "Dihedral", "Direct", "Distance", "Drag", "Force", "Gravity", "HalfSpace", "Hand", "Jacobi", "Mesh", "Motor",
    "PairForce", "Particles", "Path", "Periodic", "Pin", "Polygon", "Polygons", "Recorder", "Rope", "Sdf", "ShapeMatch", "Sleep",
    "Snap", "Spacer", "StepReport", "SweepResult", "Volume", "Winch", "Wind", "World", "Worlds", "WorldsRecorder", "approach",
    "clamp", "golden", "golden_colors", "golden_index", "gradient", "init", "load", "measure", "mix", "play", "replay", "runtime",
    "shapes", "smoothstep", "sweep",
]  # fmt: skip
init = checks.answer_arguments(runtime.init)
__version__ = "0.1.0"  # the only place where it is written


def __dir__() -> list[str]:
    """Return the public names, for tab completion."""
    return sorted([*__all__, "__version__", "report"])


def __getattr__(name: str) -> Any:
    """Import tv.report and tv.play at first use: scenes need neither of them, nor rerun."""
    if name == "report":
        import importlib

        return importlib.import_module(".report", __name__)
    if name == "play":
        from .live import play

        return play
    for part in (shapes, measure):
        if name.lower() in part.__all__:
            write = f"write tv.{part.__name__.rpartition('.')[2]}.{name.lower()}"
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}; {write}.")
    raise no_name(__name__, name, __all__)
