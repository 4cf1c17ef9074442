"""Functions that sweeps in other processes call; each process imports this file and what it imports."""

import os
import pathlib
import signal
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.device import runtime

G, SECONDS = 9.81, 0.25
STARTS = {"angle": np.linspace(0.1, 3.0, 7), "length": np.linspace(0.5, 2.0, 7)}


def pendulum(angle: float, length: float) -> tv.World:
    """Return two links, which are chaotic: any difference of bits grows; relaxed, as every process compiles them again."""
    bend = np.array([np.sin(angle), -np.cos(angle)]) * length
    x = [[0, 0], bend, [bend[0] + length, bend[1]]]
    features = [tv.Gravity(G), tv.Distance([(0, 1), (1, 2)])]
    return tv.World(tv.Particles(x, pinned=[0]), features, substeps=4, solver=tv.Jacobi())


def here(worlds) -> dict[str, Any]:
    """Return the id of the process that computes each world, and its number of threads."""
    return {"process": [os.getpid()] * len(worlds), "threads": [runtime.threads()] * len(worlds)}


def ends(worlds) -> dict[str, Any]:
    """Return where the particles are at the end, and how fast."""
    worlds.run(SECONDS)
    return {"end": worlds.position, "speed": worlds.velocity} | here(worlds)


def ball(speed: float, marker: str = "", always: bool = False) -> tv.World:
    """Return a ball thrown upwards.

    With a marker, the first process that throws one at 2 m/s is killed; with `always`, every such process ends.
    """
    if marker and speed == 2.0 and always:
        os._exit(3)
    if marker and speed == 2.0 and not os.path.exists(marker):
        pathlib.Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return tv.World(tv.Particles([[0.0, 0.0]], velocity=(0, speed)), [tv.Gravity(G)])


def height(worlds) -> dict[str, Any]:
    """Return the height of each ball after 0.5 s."""
    worlds.run(0.5)
    return {"y": worlds.position[:, 0, 1]} | here(worlds)


class Unsendable(Exception):
    """An exception that cannot be unpickled."""

    def __init__(self, a, b):
        super().__init__(f"{a} and {b}")


def wrong(speed: float, how: str = "") -> Any:
    """Do what make() may do wrong."""
    if how == "raise":
        raise ArithmeticError("no")
    if how == "unsendable":
        raise Unsendable("one", "other")
    return how if how else ball(speed)
