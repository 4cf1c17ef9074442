"""Replacements for parts of Taichi 1.7.4's Python: kernels compile and launch sooner, bit for bit the same.

TIVERLET_PATCHES=0 switches all of them off, TIVERLET_PATCHES=-calls,-launches these two. device/__init__.py applies the others.
All but "passes" depend on the internals of Taichi 1.7.4, and are off with another version.
"""

import os

from ..language import COMPILER, ti

PATCHES = {  # by name: what each does, and the one that it needs
    "passes": ("leaves out passes that LLVM makes again", ""),
    "sources": ("reads, parses and translates functions once", ""),
    "statements": ("makes fewer statements", ""),
    "calls": ("compiles long code once, and calls it", "sources"),
    "sharing": ("worlds of one structure share kernels", ""),
    "loops": ("LLVM unrolls no loops", "sharing"),
    "launches": ("checks the arguments of a launch once", ""),
}


def chosen(text: str) -> set[str]:
    """Return the patches that are on by a text like "-calls,-launches". Raises ImportError for an unknown name."""
    off = {*PATCHES} if text == "0" else {name.removeprefix("-") for name in text.split(",")} - {"", "1"}
    if not off <= {*PATCHES}:
        raise ImportError(
            f'TIVERLET_PATCHES = {text!r}, but it must be "0", which switches all patches off, or a list of those to switch off, '
            f'like "-calls,-launches"; their names are {", ".join(PATCHES)}.'
        )
    return {name for name, (_, need) in PATCHES.items() if not off & {name, need}}


enabled = frozenset(chosen(os.environ.get("TIVERLET_PATCHES", "")))
if COMPILER != "taichi" or ti.__version__ != (1, 7, 4):
    enabled &= {"passes"}  # settings that every version has
