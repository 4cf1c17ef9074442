"""Many worlds: copies stepped together, derivatives by central differences, and sweeps over processes and machines."""

from .gradient import Gradient, gradient
from .report import WorldsReport
from .sweep import SweepResult, sweep
from .worlds import Rollout, Worlds

__all__ = ["Gradient", "Rollout", "SweepResult", "Worlds", "WorldsReport", "gradient", "sweep"]
