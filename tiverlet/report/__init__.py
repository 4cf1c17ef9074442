"""What tiverlet reports about itself: scenes with known answers, their errors and what they cost, and what is extreme."""

from .cases import CASES, METHODS
from .certificate import Certificate, stress
from .errors import ErrorReport
from .sweep import error_vs_time

__all__ = ["CASES", "METHODS", "Certificate", "ErrorReport", "error_vs_time", "stress"]
