"""The same scene, run in other ways, has the same bits: other paths, clones, recordings, and particles added and removed."""

import os
import tempfile
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import tiverlet as tv

from .scenes import Call, Event, Set, Step, Structure
from .trials import Find, Refused, Trial, door, quiet


def quietly(events: list[Event], world: tv.World, features: list[Any], log=None) -> None:
    """Run events without warnings."""
    try:
        with warnings.catch_warnings():
            quiet()
            for event in events:
                event.do(world, features)
                if log and isinstance(event, Step):
                    log()
    except Exception as error:  # noqa: BLE001
        door(error)


def same(what: str, a: str, b: str) -> None:
    """Raise a find if hashes differ."""
    if a != b:
        raise Find("twin", f"{what} has other bits: {a[:12]}, {b[:12]}")


def by_path(trial: Trial, events: list[Event], path: str = "launched") -> None:
    """Compare with another path: many launches, as on a GPU, unless the scene has that path."""
    settings = trial.structure.settings
    if settings.get("order", 2) > 2:
        return
    path = "fused" if settings["path"] == path else path
    other = Trial(Structure(trial.structure.particles, trial.structure.features, settings | {"path": path}))
    try:
        same(f'path="{path}"', trial.replay(events), other.replay(events))
    finally:
        other.close()


def by_threads(trial: Trial, events: list[Event]) -> None:
    """Compare one thread with a team of threads."""
    by_path(trial, events, "parallel")


def by_clone(trial: Trial, events: list[Event]) -> None:
    """Check that a clone continues bit for bit."""
    half = len(events) // 2 + 1
    trial.replay(events[:half])
    try:
        twin = trial.world.clone()
    except Exception as error:  # noqa: BLE001
        door(error)
    with twin:
        same("a clone", trial.world.hash(), twin.hash())
        quietly(events[half:], trial.world, trial.features)
        quietly(events[half:], twin, list(twin.features))
        same("a clone after some frames", trial.world.hash(), twin.hash())


def by_copies(trial: Trial, events: list[Event]) -> None:
    """Check that a copy among many continues as the world does alone, frame by frame and in one launch."""
    half = len(events) // 2 + 1
    trial.replay(events[:half])
    later = [e for e in events[half:] if isinstance(e, Step) or (isinstance(e, Set) and e.of is not None)]
    later += [e for e in events if isinstance(e, Step)][:2]
    try:
        with warnings.catch_warnings():
            quiet()
            many = tv.Worlds(trial.world, 3)
    except Exception as error:  # noqa: BLE001
        door(error)
    with many:
        many._clocks.known[1] = many._clocks.softest[1] != 1  # this copy is examined by itself, unless it settles
        same("a copy", trial.world.hash(), many.hash(1))
        for event in later:
            outgrown = isinstance(event, Set)
            quietly([event], trial.world, trial.features)
            try:
                quietly([event], many, list(many.features))  # type: ignore[arg-type]
            except Refused:
                if outgrown:
                    return
                raise
            for k in (0, 2):
                same(f"copy {k}", trial.world.hash(), many.hash(k))
        dt = next((e.dt for e in events if isinstance(e, Step)), 1 / 60)
        with warnings.catch_warnings():
            quiet()
            many.run(3 * dt, dt)
        for _ in range(3):
            quietly([Step(dt)], trial.world, trial.features)
        for k in range(3):
            same(f"copy {k} after three frames in one launch", trial.world.hash(), many.hash(k))


def functions_of(structure: Structure) -> list[Any]:
    """Return the user's own functions, which a recording does not hold."""
    values = [v for f in structure.features for v in f.args.values()]
    return [v for v in values if callable(v) or getattr(v, "_is_taichi_function", False)]


def by_recording(trial: Trial, events: list[Event]) -> None:
    """Check that a recording, computed again, gives what was recorded."""
    trial.reset()
    own = functions_of(trial.structure)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "scene.rrd")
        try:
            with warnings.catch_warnings():
                quiet()
                with tv.Recorder(path, trial.world) as recorder:
                    quietly(events, trial.world, trial.features, recorder.log)
                verdict = tv.replay(path, given=own).verify()
        except Exception as error:  # noqa: BLE001
            door(error)
    if not verdict:
        raise Find("twin", f"a recording: {verdict}")


def by_company(trial: Trial, events: list[Event]) -> None:
    """Check that a particle added and removed far away changes nothing."""
    structure = trial.structure
    if structure.periodic or any(f.name in ("Sleep", "PairForce") for f in structure.features):
        return  # nothing is far; edits wake sleepers, and are a start where pair forces create velocities
    other, n, radius = Trial(structure), len(structure.position), float(trial.world.particles.radius.max())
    try:
        steps = [e for e in events if isinstance(e, Step)][:3]
        for world in (trial, other):
            world.reset()
        far = structure.position.max(axis=0) + 50 * max(trial.world.particles.size, 1e-3)
        for k in range(4):
            if k == 1:
                other.world.add(Call("Particles", {"position": far[None], "radius": radius}).make())
            if k == 3:
                other.world.remove([n])
            for world in (trial, other):
                quietly(steps[:1], world.world, world.features)
            a, b = trial.world.position, other.world.position[:n]
            if not np.array_equal(a, b, equal_nan=True):
                i = int(np.argmax((a != b).any(axis=1)))
                raise Find("twin", f"a particle far away ({far}) moves particle {i} by {np.abs(a - b).max():.3g} m in frame {k}")
    except (Find, Refused):
        raise
    except Exception as error:  # noqa: BLE001
        door(error)
    finally:
        other.close()


def by_questions(trial: Trial, events: list[Event]) -> None:
    """Check near, nearest, inside and ray queries against comparisons of all particles."""
    if trial.structure.periodic:  # test_periodic.py tests queries of images
        return
    trial.replay(events)
    w, x = trial.world, trial.world.position
    if not np.isfinite(x).all():
        return
    size = w.particles.size
    points = x.mean(axis=0) + size * (tv.golden(np.arange(5), dim=x.shape[1]) - 0.5)
    apart = np.linalg.norm(points[:, None] - x[None], axis=2)
    radius = float(np.median(apart))
    blur = 1e-5 * (np.abs(x).max() + radius)
    try:
        near, (index, distance) = w.near(points, radius), w.nearest(points)
        ways = tv.golden(np.arange(7, 12), dim=x.shape[1]) - 0.5
        hits, held = w.ray(points, ways, features=()), w.inside(tv.Ball(points[0], radius))
        first = w.ray(points, ways).distance
        w.explain(), w.contacts, repr(w)
    except Exception as error:  # noqa: BLE001
        door(error)
    got = np.zeros(apart.shape, dtype=bool)
    got[near[:, 0], near[:, 1]] = True
    wrong = (got != (apart <= radius)) & (np.abs(apart - radius) > blur)
    if wrong.any() or np.abs(distance - apart.min(axis=1)).max() > blur:
        raise Find("twin", f"near {near.tolist()}, nearest {index.tolist()} of {points.tolist()} within {radius}")
    wrong = (np.isin(np.arange(len(x)), held) != (apart[0] <= radius)) & (np.abs(apart[0] - radius) > blur)
    # A ray passes a center at the distance h, and is inside its disc along 2 sqrt(r^2 - h^2). It hits none before the first.
    along = np.einsum("kid,kd->ki", x - points[:, None], ways / np.linalg.norm(ways, axis=1)[:, None])
    h, r = np.sqrt(np.maximum(apart**2 - along**2, 0)), w.particles.radius
    enter = along - np.sqrt(np.maximum(r**2 - h**2, 0))
    late = hits.distance > np.where((h <= r - blur) & (enter > blur), enter, np.inf).min(axis=1) + blur
    met = hits.particle >= 0
    off = np.abs(np.linalg.norm(hits.point[met] - x[hits.particle[met]], axis=1) - r[hits.particle[met]])
    if wrong.any() or late.any() or (off > blur).any() or (first > hits.distance).any():
        raise Find("twin", f"inside {held.tolist()}, rays from {points.tolist()} along {ways.tolist()}: {hits}, {first}")


Way = Callable[[Trial, list[Event]], None]
WAYS: tuple[Way, ...] = (by_path, by_threads, by_clone, by_copies, by_recording, by_company, by_questions)
