"""Replacements for parts of Taichi 1.7.4's Python: kernels compile and launch sooner, bit for bit the same.

device/__init__.py applies them if `patched` is true.
"""

import os

from ..language import COMPILER, ti

lean = os.environ.get("TIVERLET_PATCHES") != "0"  # whether to switch off passes that LLVM repeats, with either compiler
patched = lean and COMPILER == "taichi" and ti.__version__ == (1, 7, 4)  # whether this Taichi is the one to patch
