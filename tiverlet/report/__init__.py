"""What tiverlet reports about itself: scenes with known answers, their errors and what they cost, what is extreme, and speed."""

from .autopsy import Autopsy, autopsy
from .cases import CASES, METHODS
from .certificate import Certificate, stress
from .errors import ErrorReport
from .speed import SpeedReport, speed
from .sweep import error_vs_time

__all__ = [
    "CASES", "METHODS", "Autopsy", "Certificate", "ErrorReport", "SpeedReport", "autopsy", "error_vs_time", "speed", "stress",
]  # fmt: skip
