"""Many worlds: sweeps of parameters over processes and machines."""

from .sweep import SweepResult, sweep

__all__ = ["SweepResult", "sweep"]
