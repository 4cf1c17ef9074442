"""File names of a sequence."""

import os

from ..viewer import NUMBER, named


def numbered(path: str, frame: int) -> str:
    """Return the name of a frame's file: its number replaces a %d, or precedes the ending with at least four digits."""
    if NUMBER.search(path):
        return named(path, frame)
    base, kind = os.path.splitext(path)
    return f"{base}_{frame:04d}{kind}"
