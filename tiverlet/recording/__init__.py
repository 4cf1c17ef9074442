"""Recordings for the rerun viewer, and their replay. Only this part of tiverlet imports rerun, and only when it is used."""

from .recorder import Recorder
from .replay import Replay, Verdict, load, replay
from .side_by_side import WorldsRecorder

__all__ = ["Recorder", "Replay", "Verdict", "WorldsRecorder", "load", "replay"]
