"""Access to the table in which Taichi's kernels look up the addresses of trees of fields.

Each launch reads the address of the tree from a table of Taichi's runtime. After another address is written to the table, the
same kernel works on other memory of the same layout, so one compiled kernel serves many worlds. Everything here depends on the
internals of Taichi 1.7.4 on a CPU. Where the table is not found, every world has a tree and kernels of its own.
"""

import ctypes
from typing import Any

import numpy as np

from ..language import impl

NEAR = 64  # the table begins within so many words of the runtime's begin; it begins at the twelfth
TREES = 512  # entries of the table


def finalize_without_memory(builder: Any) -> Any:
    """Finalize a tree of fields without memory. Kernels can be compiled for it; it needs an address before they run."""
    return builder._finalize_for_aot()


def table_of(finder: Any, kernel: str, addresses: np.ndarray, tree: int, offset: int) -> Any:
    """Return the table as an array of addresses, indexed by tree; None if it is not found.

    finder: an object with a kernel that writes the address of a field to the array `addresses`; the field is `offset` bytes
    behind the begin of the tree with number `tree`.
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
    builder = _words(_words(id(context), 3)[2], 3)  # the third word of pybind's object is the address of the C++ object
    owned, borrowed = builder[1], builder[2]  # two equal pointers to the context that kernels get
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
