"""A pool of processes for long commands."""

import argparse
import contextlib
import multiprocessing
import os
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the argument --workers."""
    number = max(1, min(8, os.cpu_count() or 1))
    parser.add_argument("--workers", type=int, default=number, metavar="N", help=f"processes (default {number}; 1: none)")


@contextlib.contextmanager
def workers(count: int) -> Iterator[Executor | None]:
    """Yield a pool of `count` processes, or None for one. They are spawned, because Taichi does not survive a fork."""
    if count < 1:
        raise ValueError(f"--workers {count}: at least 1 is needed.")
    if count == 1:
        yield None
        return
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool
