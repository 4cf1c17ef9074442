"""What replaces parts of Taichi 1.7.4, so that kernels compile and launch sooner, to the same bits.

device/__init__.py applies them where `patched` holds.
"""

import os

from ..language import COMPILER, ti

lean = os.environ.get("TIVERLET_PATCHES") != "0"  # whether passes are left out that LLVM does again: settings, of both compilers
patched = lean and COMPILER == "taichi" and ti.__version__ == (1, 7, 4)  # whether Taichi is the one that these are made for
