"""What tiverlet reports about itself: scenes with known answers, their errors and what they cost, and what is extreme."""

from .autopsy import Autopsy, autopsy
from .cases import CASES, METHODS
from .certificate import Certificate, stress
from .errors import ErrorReport
from .sweep import error_vs_time

__all__ = ["CASES", "METHODS", "Autopsy", "Certificate", "ErrorReport", "autopsy", "error_vs_time", "stress"]
