"""Names of files of a sequence."""

import os

from ..viewer import NUMBER, named


def numbered(path: str, frame: int) -> str:
    """The name of a frame's file: its number where the name has a %d, or else before the ending, in four digits or more."""
    if NUMBER.search(path):
        return named(path, frame)
    base, kind = os.path.splitext(path)
    return f"{base}_{frame:04d}{kind}"
