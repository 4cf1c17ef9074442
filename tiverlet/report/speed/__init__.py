"""Speed, its share of what the machine can do, and the cost of first steps: `python -m tiverlet report speed`.

Every figure of a scene comes from its own process: Taichi's threads are set once in a process, and only its first step is cold.
"""

from .measure import speed
from .result import Absent, Peer, Run, SpeedReport, Wait
from .scenes import SCENES

__all__ = ["SCENES", "Absent", "Peer", "Run", "SpeedReport", "Wait", "speed"]
