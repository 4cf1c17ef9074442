"""Recordings for the rerun viewer. The only part of tiverlet that imports rerun, and only when it is used."""

from .recorder import Recorder

__all__ = ["Recorder"]
