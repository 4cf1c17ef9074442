"""Scripts of the user that commands run, numbers of ports, and colours."""

import argparse
import contextlib
import os
import sys
import traceback
from collections.abc import Iterator, Sequence


@contextlib.contextmanager
def as_script(path: str | os.PathLike, arguments: Sequence[str] = ()) -> Iterator[None]:
    """Within this context a script finds its arguments, and the modules beside it, as if Python had started it.

    An exception of the script ends the command as it would end Python: with the traceback, and exit status 1.
    """
    name, before = os.path.abspath(path), (sys.argv, list(sys.path))
    sys.argv, sys.path[0] = [os.fspath(path), *arguments], os.path.dirname(name)
    try:
        yield
    except Exception as error:
        trace = error.__traceback__
        while trace and os.path.abspath(trace.tb_frame.f_code.co_filename) != name:
            trace = trace.tb_next
        if trace is None and not (isinstance(error, SyntaxError) and os.path.abspath(error.filename or "") == name):
            raise  # not in the script
        traceback.print_exception(error.with_traceback(trace))
        raise SystemExit(1) from None
    finally:
        sys.argv, sys.path[:] = before


def port(text: str) -> int:
    """Return the number of a port, for argparse."""
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 0 to 65535")
    return int(text)


def color(text: str) -> str | tuple[str, float, float]:
    """Return a quantity by which particles are coloured, such as speed or speed,0,2, for argparse."""
    name, *ends = text.rsplit(",", 2) if text.count(",") > 1 else [text]
    return (name, float(ends[0]), float(ends[1])) if ends else name
