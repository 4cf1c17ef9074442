"""The only entry point to Taichi: start-up, memory, threads. All other modules import Taichi from here."""

from typing import Any

from .language import always, at, copied, copied_with, inline, never, record, ti
from .patches import enabled

called: Any = copied
called_with: Any = copied_with
if "passes" in enabled:
    from .patches import assignments

    assignments.apply()
if "sources" in enabled:
    from .patches import source_cache, syntax_cache

    source_cache.apply()  # first: the modules imported after it then import in half the time
    syntax_cache.apply()
if "statements" in enabled:
    from .patches import statements

    statements.apply()
if "sharing" in enabled:
    from .patches import sharing, timing

    sharing.apply(timing.compiled)
    timing.apply()
if "calls" in enabled:
    from .patches import calls

    called, called_with = calls.called, calls.called_with
from . import copies  # noqa: E402

copies.apply()  # last, with and without patches: it wraps the final subscript function

__all__ = ["always", "at", "called", "called_with", "inline", "never", "record", "ti"]
