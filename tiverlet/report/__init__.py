"""Error against run time on scenes with known answers and on the user's own scene, stiff and extreme cases, and failures."""

from .accuracy.cases import CASES, METHODS
from .accuracy.errors import ErrorReport
from .accuracy.sweep import error_vs_time
from .stress.certificate import Certificate, stress
from .stress.failure_trace import Autopsy, autopsy

__all__ = ["CASES", "METHODS", "Autopsy", "Certificate", "ErrorReport", "autopsy", "error_vs_time", "stress"]
