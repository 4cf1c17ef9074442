"""The conditions of the matrix: each runs a scene in another way, and raises a Find where it does not keep its equality.

A bench keeps what is compiled: the worlds of one scene, each built once, in which all conditions run.
"""

import contextlib
import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np

import tiverlet as tv

from ..fuzz import twins
from ..fuzz.oracles import EPS
from ..fuzz.scenes import Call, Event, Step, Structure
from ..fuzz.trials import HARD, Find, Trial, quiet
from ..fuzz.units import has_units, in_units
from .scene import SUBSTEPS, Run, Scene

KINDS = HARD | {"energy", "energy, flagged", "wall, several"}
DRAWN = np.random.default_rng(0).random(60)
FAR = 60.0  # [m] where nothing of a scene comes


class Bench:
    """The worlds of a scene, compiled once each, and what is compared with: how it runs at 20 and 40 substeps."""

    def __init__(self, scene: Scene):
        self.scene, self.built = scene, {}

    def close(self) -> None:
        """Free the memory of all worlds."""
        for trial in self.built.values():
            trial.close()

    def trial(self, particles: dict[str, Any] | None = None, more: tuple[Call, ...] = (), **settings: Any) -> Trial:
        """Return the scene with other arguments of particles, more features, other settings; built once."""
        key = repr((particles, more, settings))
        if key not in self.built:
            s = self.scene.structure
            start = Call("Particles", s.particles.args | (particles or {}))
            self.built[key] = Trial(Structure(start, s.features + more, s.settings | settings))
        return self.built[key]

    def run(self, trial: Trial, dts: Any = (), substeps: Callable[[int], Any] = lambda k: None) -> Run:
        """Run the scene in a world; raise what the judge finds, or a promise that is not kept."""
        out = Run(trial, self.scene.events(dts, substeps), KINDS)
        for promise in self.scene.promises:
            promise.check(out)
        return out

    @cached_property
    def plain(self) -> Run:
        """How the scene runs as it is."""
        return Run(self.trial(), self.scene.events(), set())

    @cached_property
    def exact(self) -> Run:
        """The same in f64."""
        return Run(self.trial(precision="f64"), self.scene.events(), set())

    @cached_property
    def fine(self) -> Run:
        """The same in f64, with twice the substeps."""
        return Run(self.trial(precision="f64"), self.scene.events(substeps=lambda k: 2 * SUBSTEPS if k == 0 else None), set())


def alike(a: Run, b: Run, some: Any, allowed: np.ndarray, what: str) -> None:
    """Raise a find where particles of two runs are further apart than allowed, (frames + 1,) or a number. some: their indices."""
    off = np.linalg.norm(a.x[:, some] - b.x[:, some], axis=2)
    over = off - np.broadcast_to(np.atleast_1d(allowed)[:, None], off.shape)
    if not (over <= 0).all():
        k, i = np.unravel_index(np.argmax(over), over.shape)
        allows, i = off[k, i] - over[k, i], np.arange(a.x.shape[1])[some][i]
        raise Find("motion", f"{what}: particle {i} differs by {off[k].max():.3g} m in frame {k}, allowed {allows:.3g}")


def second_order(bench: Bench, other: Run, what: str) -> None:
    """Compare two laws of second order, in f64.

    Each is off by 4/3 of what halving its substep changes: together by 4 of it, where the error of the other law is no more than
    twice as large. Loads likewise; and flags, and what breaks, are the same.
    """
    one, fine, count = bench.exact, bench.fine, bench.exact.x.shape[1]
    size = float(np.ptp(one.x, axis=(0, 1)).max())
    change = np.maximum.accumulate(np.linalg.norm(one.x - fine.x, axis=2).max(axis=1))
    alike(one, other, slice(count), 4 * change + 1e-9 * size, what)
    for k, load in one.loads.items():
        change = np.maximum.accumulate(np.abs(load - fine.loads[k]).reshape(len(load), -1).max(axis=1))
        off = np.abs(load - other.loads[k]).reshape(len(load), -1)
        over = off.max(axis=1) - 4 * change - 1e-6 * np.abs(load).max()
        if not (over <= 0).all():
            f, m = int(np.argmax(over)), int(np.argmax(off[np.argmax(over)]))
            name, a, b = (
                type(one.features[k]).__name__,
                load.reshape(len(load), -1)[f, m],
                other.loads[k].reshape(len(load), -1)[f, m],
            )
            raise Find(
                "load",
                f"{what}: {name} {m} in frame {f} bears {b:.6g}, without {a:.6g}, allowed {4 * change[f]:.3g} more or less",
            )
    for k, gone in one.broken.items():
        if (gone != other.broken[k]).any():
            raise Find("broken", f"{what}: {other.broken[k].tolist()} break, without {gone.tolist()}")
    if other.flags != one.flags:
        raise Find("flags", f"{what}: {set(other.flags)}, without {set(one.flags)}")


def same(a: Run, b: Run, what: str) -> None:
    """Raise a find where positions, velocities or loads have other bits."""
    count = a.x.shape[1]
    alike(a, b, slice(count), np.zeros(1), what)
    if not np.array_equal(a.v, b.v[:, :count], equal_nan=True):
        raise Find("bits", f"{what}: velocities differ by {np.abs(a.v - b.v[:, :count]).max():.3g} m/s")
    for k, load in a.loads.items():
        if not np.array_equal(load, b.loads[k], equal_nan=True):
            raise Find("bits", f"{what}: loads of {type(a.features[k]).__name__} differ by {np.abs(load - b.loads[k]).max():.3g}")


def has(scene: Scene, *names: str) -> bool:
    """Whether a scene has features of these names."""
    return any(call.name in names for call in scene.structure.features)


# Beside other features


def contact(bench: Bench) -> None:
    """A Contact of groups that nobody is in: the same motion and loads to second order, flags, and what breaks."""
    trial = bench.trial(more=(Call("Contact", {"groups": [(8, 9)]}),), precision="f64")
    second_order(bench, bench.run(trial), "beside a Contact that touches nothing")


def polygons(bench: Bench) -> None:
    """Two triangles far away, wider than forces between pairs reach, with contacts of Polygons: the same."""
    args, n = bench.scene.structure.particles.args, len(bench.scene.structure.position)
    far = {"position": FAR + np.array([[0.0, 0], [3, 0], [0, 3], [9, 0], [12, 0], [9, 3]]), "velocity": np.zeros((6, 2))}
    more = far | {"mass": np.ones(6), "group": np.zeros(6, int)}
    with_them = {
        name: np.concatenate([np.broadcast_to(args[name], (n, *values.shape[1:])), values])
        for name, values in more.items() if name in args
    }  # fmt: skip
    loops = n + np.arange(6).reshape(2, 3)
    trial = bench.trial(with_them, (Call("Polygons", {"loops": loops}),), precision="f64")
    second_order(bench, bench.run(trial), "beside Polygons far away")


def idle(bench: Bench) -> None:
    """A Sleep that never comes, and particles that may spin where nothing turns them: the same bits."""
    turning, wakeful = may_spin(bench.scene), may_sleep(bench.scene)
    more = (Call("Sleep", {"speed": 1e-9, "time": 1e6}),) if wakeful else ()
    what = [word for word, is_so in (("Sleep that never sleeps", wakeful), ("spin, which nothing turns", turning)) if is_so]
    same(bench.plain, bench.run(bench.trial({"spin": True} if turning else {}, more)), f"beside {' and '.join(what)}")


def may_sleep(scene: Scene) -> bool:
    """Whether a Sleep may be added: there is none, and nothing that refuses it."""
    return not has(scene, "Sleep", "PairForce")


def may_spin(scene: Scene) -> bool:
    """Whether spin may be added and is not turned: without friction."""
    return not any("friction" in call.args for call in scene.structure.features) and "spin" not in scene.structure.particles.args


# In other ways


def turned_twice(bench: Bench) -> list[Event]:
    """Return the events of a scene with substeps that change in the middle and back."""
    half = bench.scene.frames // 2
    return bench.scene.events(substeps=lambda k: {half: 3, half + 2: SUBSTEPS}.get(k))


def by(way: twins.Way) -> Callable[[Bench], None]:
    """Return the condition that a scene has the same bits in one of the ways of the fuzzer."""

    def condition(bench: Bench) -> None:
        trial = bench.trial()
        with warnings.catch_warnings():
            quiet()
            way(trial, turned_twice(bench))

    return condition


# Other digits and units


def f64(bench: Bench) -> None:
    """In f64 the same motion to rounding: d is rounded by eps x in a substep, at random, and its sum of sums grows as N^(3/2).

    What is too weak breaks in both, but in f32 only once its load can be told from rounding.
    """
    run, plain = bench.run(bench.trial(precision="f64")), bench.plain
    gone = [f.members_of(m) for k, f in enumerate(run.features) if k in run.broken for m in np.flatnonzero(run.broken[k])]
    kept = np.setdiff1d(np.arange(run.x.shape[1]), np.concatenate([[], *gone]))
    steps = SUBSTEPS * np.arange(len(run.x))
    alike(run, plain, kept, EPS["f32"] * np.abs(plain.x).max() * (1 + steps**1.5), "f32 and f64")
    for k, broken in plain.broken.items():
        if (broken != run.broken[k]).any():
            raise Find("broken", f"in f32 {broken.tolist()} break, in f64 {run.broken[k].tolist()}")


def units(bench: Bench) -> None:
    """Lengths times 2^a, masses times 2^b: positions times 2^a, bit for bit."""
    s = bench.scene.structure
    for length, mass in ((2.0**-7, 2.0**-10), (2.0**5, 2.0**12)):
        calls = [in_units(call, length, mass) for call in bench.scene.calls]
        turns = {
            k: [t if t.of is None else turn_in_units(s, t, length, mass) for t in some] for k, some in bench.scene.turns.items()
        }
        other = Scene(Structure(calls[0], tuple(calls[1:]), s.settings), [], bench.scene.frames, turns)
        with contextlib.closing(Trial(other.structure)) as trial:
            run = Run(trial, other.events(), set())
        off = np.abs(run.x / length - bench.plain.x)
        if off.max() > 0:
            k, i = np.unravel_index(np.argmax(off.max(axis=2)), off.shape[:2])
            raise Find(
                "units", f"lengths by {length:g}, masses by {mass:g}: particle {i} differs by {off.max():.3g} m in frame {k}"
            )


def turn_in_units(s: Structure, event: Any, length: float, mass: float) -> Any:
    """Return an assignment in other units."""
    call = in_units(Call(s.features[event.of].name, {event.name: event.value}), length, mass)
    return type(event)(event.of, event.name, call.args[event.name])


# Other times


def timed(dts: Callable[[Scene], Any] = lambda s: (), substeps: Callable[[int], Any] = lambda k: None) -> Callable[[Bench], None]:
    """Return the condition that promises, energy and momentum keep under these lengths and substeps of frames."""
    return lambda bench: None if bench.run(bench.trial(), dts(bench.scene), substeps) else None


def late(dt: float) -> Callable[[Scene], Any]:
    """Return lengths of frames: that in the middle is late."""
    return lambda s: [1 / 60] * (s.frames // 2) + [dt] + [1 / 60] * s.frames


def uneven(s: Scene) -> list[float]:
    """Return lengths of frames, at random within 40 %, whose sum is as before."""
    dts = 1 / 60 * (1 + 0.4 * (2 * DRAWN[: s.frames] - 1))
    return list(dts * s.frames / 60 / dts.sum())


def by_saving(trial: Trial, events: list[Event]) -> None:
    """Check that what was saved and loaded, or recorded and loaded, half way goes on with the same bits."""
    half = max(
        k for k in range(len(events) // 2 + 1) if isinstance(events[k - 1], Step)
    )  # what is set after a frame is not recorded
    own = twins.functions_of(trial.structure)
    with tempfile.TemporaryDirectory() as folder:
        saved, recorded = os.path.join(folder, "saved.rrd"), os.path.join(folder, "recorded.rrd")
        trial.reset()
        with tv.Recorder(recorded, trial.world) as recorder:
            twins.quietly(events[:half], trial.world, trial.features, recorder.log)
        trial.world.save(saved)
        loaded = [tv.load(saved, given=own), tv.load(recorded, given=own)]
    twins.quietly(events[half:], trial.world, trial.features)
    for what, world in zip(("what was saved", "what was recorded"), loaded, strict=True):
        with world:
            twins.quietly(events[half:], world, list(world.features))
            twins.same(what, trial.world.hash(), world.hash())


CONDITIONS: dict[str, Callable[[Bench], None]] = {
    "plain": timed(),
    "contact": contact,
    "polygons": polygons,
    "idle": idle,
    "company": by(twins.by_company),
    "saved": by(by_saving),
    "cloned": by(twins.by_clone),
    "recorded": by(twins.by_recording),
    "worlds": by(twins.by_copies),
    "launched": by(twins.by_path),
    "f64": f64,
    "units": units,
    "late 0.05": timed(late(0.05)),
    "late 0.25": timed(late(0.25)),
    "uneven": timed(uneven),
    "changed back": timed(substeps=lambda k: {0: 20, 8: 3, 10: 20, 12: 60, 14: 20}.get(k)),
    "auto": timed(substeps=lambda k: "auto" if k == 0 else None),
    "2": timed(substeps=lambda k: 2 if k == 0 else None),
    "60": timed(substeps=lambda k: 60 if k == 0 else None),
}


def applicable(scene: Scene) -> Iterator[str]:
    """Yield the conditions that make sense in a scene, by what it is made of."""
    s = scene.structure
    touching, dim = has(scene, "Contact", "Polygons"), s.position.shape[1]
    shut_out = {
        "contact": touching,  # a world has at most one
        "polygons": touching or dim == 3 or s.periodic,
        "idle": not may_sleep(scene) and not may_spin(scene),
        "company": s.periodic or has(scene, "Sleep", "PairForce"),  # nothing is far
        "worlds": has(scene, "Sleep"),  # refused
        "units": not has_units(s),
        **dict.fromkeys(scene.without, True),
    }
    return (name for name in CONDITIONS if not shut_out.get(name, False))
