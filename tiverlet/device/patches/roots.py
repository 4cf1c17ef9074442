"""Where Taichi's kernels look up where the fields of a tree are.

Each launch reads the address of the tree from a table of Taichi's runtime. What is written to there makes the same kernel work on
other memory of the same layout, so that one compiled kernel serves many worlds. Everything here knows the inside of Taichi 1.7.4
on a CPU; where it is not found, every world has a tree and kernels of its own.
"""

import ctypes
from typing import Any

import numpy as np

from ..language import impl

NEAR = 64  # words from the begin of the runtime within which the table begins; it is the twelfth
TREES = 512  # that it has room for


def planned(builder: Any) -> Any:
    """A tree of fields that kernels can be compiled for, without bytes: they have to be told of some before they run."""
    return builder._finalize_for_aot()


def table_of(finder: Any, kernel: str, addresses: np.ndarray, tree: int, offset: int) -> Any:
    """The table, as an array of addresses by the numbers of trees; None where it is not found.

    finder: an object with a kernel that writes the address of a field to the array `addresses`; the field is `offset` bytes
    behind the begin of the tree of this number.
    """
    program: Any = impl.get_runtime().prog
    getattr(finder, kernel)(addresses)
    if str(program.config().arch) not in ("Arch.x64", "Arch.arm64"):
        return None
    primal: Any = getattr(type(finder), kernel)._primal
    made = primal.compiled_kernels[primal.ensure_compiled(finder, addresses)]
    context = made.make_launch_context()
    context.set_arg_external_array_with_shape((0,), addresses.ctypes.data, addresses.nbytes, addresses.shape, 0)
    program.launch_kernel(program.compile_kernel(program.config(), program.get_device_caps(), made), context)
    builder = _words(_words(id(context), 3)[2], 3)  # of pybind's object, the third word is where the one of C++ is
    owned, borrowed = builder[1], builder[2]  # one pointer to what kernels get, twice
    if not owned or owned != borrowed:
        return None
    runtime = _words(owned, 2)[1]
    if not runtime or runtime % 8:
        return None
    found = [k for k, word in enumerate(_words(runtime, NEAR)) if word == int(addresses[0]) - offset]
    if len(found) != 1 or found[0] < tree:
        return None
    return np.ctypeslib.as_array((ctypes.c_uint64 * TREES).from_address(runtime + 8 * (found[0] - tree)))


def _words(address: int, count: int) -> Any:
    return (ctypes.c_uint64 * count).from_address(address)
