"""What commands that measure for minutes share: processes, verdicts as they come, and files for machines."""

import argparse
import contextlib
import multiprocessing
import os
import pathlib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any


def output(name: str) -> str:
    """Return the name of a file that can be written: the `type` of an argument, so that a command fails before it measures."""
    path = pathlib.Path(name)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{name} is a folder, but the name of a file is needed.")
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"the folder {path.parent} of {name} does not exist; make it first.")
    return name


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add the argument --workers."""
    number = max(1, min(8, os.cpu_count() or 1))
    parser.add_argument("--workers", type=int, default=number, metavar="N", help=f"processes (default {number}; 1: none)")


def measured(workers: int, measure: Callable[..., Any], *given: Any, **options: Any) -> Any:
    """Return what measure(*given, **options) measures in this number of processes, and print it."""
    from rich.console import Console

    with _pool(workers) as executor:
        report = measure(*given, **options, executor=executor, progress=True)
    Console().print(report)
    return report


def write(path: str | None, text: Callable[[], str]) -> None:
    """Write a text to a file, if there is a name for it."""
    if path:
        pathlib.Path(path).write_text(text(), encoding="utf-8")


@contextlib.contextmanager
def _pool(count: int) -> Iterator[Executor | None]:
    """Yield a pool of `count` processes, or None for one. They are spawned, because Taichi does not survive a fork."""
    if count < 1:
        raise ValueError(f"--workers {count}: at least 1 is needed.")
    if count == 1:
        yield None
        return
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool
