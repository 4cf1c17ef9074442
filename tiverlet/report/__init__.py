"""Reports about tiverlet itself: errors and costs on scenes with known answers, stiff and extreme cases, and speed."""

from .accuracy.cases import CASES, METHODS
from .accuracy.errors import ErrorReport
from .accuracy.sweep import error_vs_time
from .speed import SpeedReport, speed
from .stress.certificate import Certificate, stress
from .stress.failure_trace import Autopsy, autopsy

__all__ = [
    "CASES", "METHODS", "Autopsy", "Certificate", "ErrorReport", "SpeedReport", "autopsy", "error_vs_time", "speed", "stress",
]  # fmt: skip
