"""How fast it is, how near to what the machine can do, and what a start costs: `python -m tiverlet report speed`.

Every figure of a scene comes from a process of its own (Taichi's threads are set once in a process, and a start is cold once).
"""

from .measure import speed
from .result import Absent, Peer, Run, SpeedReport, Wait
from .scenes import SCENES

__all__ = ["SCENES", "Absent", "Peer", "Run", "SpeedReport", "Wait", "speed"]
