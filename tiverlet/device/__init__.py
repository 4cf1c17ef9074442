"""The only entry point to Taichi: start-up, memory, threads. All other modules import Taichi from here."""

from typing import Any

from .language import at, copied, copied_with, inline, record, ti
from .patches import assignments, lean, patched

if lean:
    assignments.apply()
if patched:
    from .patches import calls, sharing, source_cache, statements, syntax_cache, timing

    source_cache.apply()  # first: the modules imported after it then import in half the time
    syntax_cache.apply()
    statements.apply()
    sharing.apply(timing.compiled)
    timing.apply()
    called: Any = calls.called
    called_with: Any = calls.called_with
else:
    called, called_with = copied, copied_with
from . import copies

copies.apply()  # last, with and without patches: it wraps the final subscript function

__all__ = ["at", "called", "called_with", "inline", "record", "ti"]
