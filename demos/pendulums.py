"""A million double pendulums: which of them flip, and when, by where they are let go.

    python demos/pendulums.py [pendulums.rrd [side [processes]]]

What to look for: each pendulum hangs where its two angles are on the map, and has the colour of the time of its first flip.
Around the middle none has the energy to flip; outside, neighbours that start almost alike part sooner or later, and the border
between them is a fractal. A side of 24 is the default, and the time of a million is told; a side of 1000 computes them, writes
the whole map to pendulums.npy, and records some.
"""

import pathlib
import sys
from time import perf_counter
from typing import Any

import numpy as np

import tiverlet as tv

SECONDS, G, ARM = 10.0, 9.81, 1.0  # duration [s]; [m/s^2]; length of both arms [m], each with 1 kg at its end
SHOWN = 24  # most pendulums along a side of the recording


def angles(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the angles of upper and lower arms from below: a map from -pi to pi, whose halves mirror each other bit for bit."""
    some = (2 * np.arange(side) + 1 - side) * (np.pi / side)
    first, second = np.meshgrid(some, some)
    return first.ravel(), second.ravel()


def hanging(first, second) -> np.ndarray:
    """Return anchor, elbow and end of pendulums, (..., 3, 2) [m]."""
    elbow = ARM * np.stack([np.sin(first), -np.cos(first)], axis=-1)
    end = elbow + ARM * np.stack([np.sin(second), -np.cos(second)], axis=-1)
    return np.stack([0 * elbow, elbow, end], axis=-2)


def make(first: float, second: float) -> tv.World:
    """Make one double pendulum, at rest."""
    particles = tv.Particles(hanging(first, second), pinned=[0])
    return tv.World(particles, [tv.Gravity(G), tv.Distance([(0, 1), (1, 2)])], substeps=10, precision="f64")


def figures(worlds: Any) -> dict[str, np.ndarray]:
    """Return the time at which an arm first goes over the top; SECONDS if none does."""
    arms = np.diff(worlds.rollout(SECONDS).position, axis=2)  # (worlds, frames, arms, 2)
    x, y = arms[..., 0], arms[..., 1]
    over = ((x[:, 1:] > 0) != (x[:, :-1] > 0)) & (np.minimum(y[:, 1:], y[:, :-1]) > 0)
    frame = over.any(axis=2)
    return {"flip": np.where(frame.any(axis=1), (frame.argmax(axis=1) + 2) / 60, SECONDS)}


def build(first: np.ndarray | None = None, second: np.ndarray | None = None) -> tv.World:
    """Make one world with the pendulums of a map, each at its place; by default of a small map."""
    if first is None or second is None:
        first, second = angles(SHOWN)
    apart = 3.2 * ARM * np.sqrt(len(first)) / (2 * np.pi)  # pendulums may cross, since there are no contacts
    x = hanging(first, second) + apart * np.stack([first, second], axis=-1)[:, None]
    joints = 3 * np.arange(len(first))
    links = np.concatenate([np.stack([joints + k, joints + k + 1], axis=1) for k in (0, 1)])
    particles = tv.Particles(x.reshape(-1, 2), radius=np.tile([0.05, 0.3, 0.6], len(first)), pinned=joints)
    return tv.World(particles, [tv.Gravity(G), tv.Distance(links)], substeps=10)


def main(path: str = "pendulums.rrd", side: int | str = 24, processes: int | str | None = None, *, at_once: int = 192) -> None:
    """Sweep the map, check it, estimate the time of a million, and record a few pendulums."""
    side, processes = int(side), None if processes is None else int(processes)
    first, second = angles(side)
    parameters = {"first": first, "second": second}
    if processes is None:  # compile first, so that compilation is not timed
        tv.sweep(make, {name: values[:at_once] for name, values in parameters.items()}, figures)
    clock = perf_counter()
    flip = tv.sweep(make, parameters, figures, processes, at_once, progress=True)["flip"]
    each = (perf_counter() - clock) / len(flip)

    flips = flip < SECONDS
    bound = 2 * np.cos(first) + np.cos(second) > 1  # less energy than with the upper arm hanging and the lower one upright
    map_ = flip.reshape(side, side)
    if (flips & bound).any():
        raise SystemExit("a pendulum flips without the energy for it")
    if (map_ != map_[::-1, ::-1]).any():
        raise SystemExit("a pendulum and its mirror image flip at different times")
    if not flips.any():
        raise SystemExit("none flips")

    some = np.linspace(0, side - 1, min(side, SHOWN)).round().astype(int)
    chosen = np.arange(side * side).reshape(side, side)[np.ix_(some, some)].ravel()
    if side > SHOWN:
        np.save(pathlib.Path(path).with_suffix(".npy"), map_)
    world = build(first[chosen], second[chosen])
    with tv.Recorder(path, world, every=2, overwrite=True, color=("flip", 0.0, SECONDS)) as recorder:
        for _ in range(round(60 * SECONDS)):
            world.step(1 / 60)
            recorder.log(flip=np.repeat(flip[chosen], 3))
    print(
        f"{path}: {flips.sum()} of {len(flips)} double pendulums flip within {SECONDS:g} s, none of the {bound.sum()} without "
        f"the energy; {1e3 * each:.2g} ms each, so a million take {1e6 * each / 3600:.1f} h"
    )


if __name__ == "__main__":
    main(*sys.argv[1:4])
