"""Counts the kernels that Taichi launches, and launches phases one by one."""

import contextlib
from collections import Counter
from collections.abc import Iterator
from time import perf_counter
from typing import Any

import numpy as np
import pytest

from tiverlet.device.language import COMPILER, module, ti
from tiverlet.device.patches.compiler import CachedLaunch
from tiverlet.step import build

Kernel: Any = module("kernel_impl" if COMPILER == "taichi" else "kernel").Kernel


def known_as(kernel: Any, args: tuple) -> str:
    """Return the name of a kernel, or its first argument that is a text, which names it."""
    return next((a for a in args if isinstance(a, str)), kernel.func.__name__)


class Launches(Counter[str]):
    """The number of launches by name of the kernel.

    seconds: their total times, if they were timed. answers: how often the host waited for a result, either a number or an array.
    """

    def __init__(self):
        super().__init__()
        self.seconds: dict[str, float] = {}
        self.answers = 0


@contextlib.contextmanager
def launching() -> Iterator[None]:
    """Within this context, worlds built for the parallel path are launched phase by phase, as on a GPU."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "size_of", lambda path, work: 1)
        yield


@contextlib.contextmanager
def launches(timed: bool = False) -> Iterator[Launches]:
    """Count the kernels launched within this context. timed: wait for the end of each."""
    count = Launches()

    def counted(launch, name):
        """Wrap a method that launches kernels."""

        def run(self, *args, **options):
            """Launch, and record count and time."""
            clock = perf_counter()
            out = launch(self, *args, **options)
            known = name(self, args)
            count[known] += 1
            count.answers += out is not None or any(isinstance(a, np.ndarray) for a in (*args, *getattr(self, "arrays", ())))
            if timed:
                ti.sync()
                count.seconds[known] = count.seconds.get(known, 0.0) + perf_counter() - clock
            return out

        return run

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Kernel, "launch_kernel", counted(Kernel.launch_kernel, known_as))
        patch.setattr(CachedLaunch, "launch", counted(CachedLaunch.launch, lambda quick, _: quick.name))
        yield count
