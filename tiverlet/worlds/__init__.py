"""Many worlds: copies that are stepped together, and sweeps of parameters over processes and machines."""

from .report import WorldsReport
from .sweep import SweepResult, sweep
from .worlds import Rollout, Worlds

__all__ = ["Rollout", "SweepResult", "Worlds", "WorldsReport", "sweep"]
