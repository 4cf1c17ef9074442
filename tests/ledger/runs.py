"""What is run for the ledger, and the figures of each run.

Every case with a known answer and every scene of the catalogue, by the default solver in f32 and f64, and by each other solver
that it can have in f64; with the substeps of COLUMNS. Scenes by other solvers leave "auto" out: it takes thousands of substeps
where a solver does not fit.
"""

import contextlib
import re
import warnings
from collections.abc import Callable, Iterator
from time import process_time
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.contact.impulses import IMPULSES
from tiverlet.features.feature import Batch
from tiverlet.report.accuracy.cases import CASES, METHODS, Case
from tiverlet.report.accuracy.points import observe
from tiverlet.step.span import MOST

from ..fuzz import oracles
from ..fuzz.scenes import Set, Step, Structure
from ..fuzz.trials import Trial, quiet
from ..launches import launches, launching
from ..scenes import SCENES
from ..scenes.scene import Scene
from .book import COLUMNS, Book, Row

FRAMES = 60  # of a scene
SOLVERS = ("Jacobi", "Direct", "CG x 20", "Chebyshev x 10")  # names in METHODS that scenes are also run with
FINE = 640  # substeps of the run whose end counts as the right one, where a scene converges
JITTER = np.random.default_rng(0).uniform(0.6, 1.4, FRAMES)  # share of a frame, see dt_of()
HITCH, EVERY = 0.25, 20  # [s] the length of every so manieth frame
# Below these, relative to the size of the motion, figures are rounding: 64 units in the last place of f32; in f64 what solvers
# that iterate leave.
ROUNDING = {"f32": 2.0**-17, "f64": 1e-9}


def begin() -> None:
    """Start Taichi in a worker."""
    tv.init(arch="cpu", threads=1)


def names() -> list[str]:
    """Return the names of all that can be run: cases, then scenes."""
    return [*CASES, *SCENES]


def dt_of(column: str, k: int) -> float:
    """Return the length of frame k [s]."""
    if column != "late":
        return 1 / 60
    return HITCH if k % EVERY == EVERY - 1 else JITTER[k] / 60


def figure(value: float, floor: float = 0.0) -> str:
    """Return a number with three digits; 0 below what rounding makes of it."""
    return f"{value:.3g}" if not value <= floor else "0"


def told(words: Any) -> str:
    """Return flags as one word; 0 for none."""
    return "+".join(sorted(words)) or "0"


def figures_of(name: str) -> tuple[Book, float]:
    """Return all figures of a case or scene, without those that are 0, and the CPU seconds that it took."""
    clock, book = process_time(), {}
    of: Callable = of_case if name in CASES else of_scene
    with warnings.catch_warnings():
        quiet()
        for how, what, column, cell in of(CASES.get(name) or SCENES[name]):
            if cell != "0":
                book.setdefault((name, how, what), Row())[column] = cell
    return book, process_time() - clock


Cell = tuple[str, str, str, str]  # how it is solved, figure, column, cell


def made_of(world: tv.World) -> Iterator[tuple[str, str]]:
    """Yield what a world is made of: fields and their bytes."""
    yield "fields", str(len(world.fields))
    yield "bytes a particle", figure(sum(world.fields.values()) / max(1, len(world.particles)))


def launched(build: Callable[[], tv.World]) -> str:
    """Return how many launches a frame takes where each phase is launched, as on a GPU."""
    try:
        with launching(), build() as world:
            return re.search(r"(\d+) launches", world.explain())[1]  # type: ignore[index]
    except ValueError:  # as by orders above 2
        return "0"


def ways(build: Callable[[str, str], tv.World], methods: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yield (method, precision) for each way to solve a scene: "default" in both precisions, others where they differ from it."""
    seen = set()
    for method, precision in [("default", "f32"), ("default", "f64"), *((m, "f64") for m in methods)]:
        try:
            with build(method, precision) as world:
                key = (precision, type(world._solver).__name__, repr(vars(world._solver)), world.iterations)
        except ValueError:  # refused: the scene has something that this solver cannot solve
            continue
        if key not in seen:
            seen.add(key)
            yield method, precision


def of_case(case: Case) -> Iterator[Cell]:
    """Yield the figures of a case with a known answer."""

    def build(method: str, precision: str) -> tv.World:
        particles, features = case.build()
        solver, iterations = METHODS.get(method, (None, 1))
        return tv.World(particles, features, solver=solver, iterations=iterations, precision=precision, path="fused")

    for method, precision in ways(build, case.methods):
        how, floor = f"{method} {precision}", ROUNDING[precision]
        with build(method, precision) as world:
            for column in COLUMNS[:-1]:
                world.substeps = column if column == "auto" else int(column)
                run, energy, momentum = observe(case, world)
                error = float(case.error(run)) if np.isfinite(world.position).all() else np.inf
                reports = run.reports or [world.step(case.frame)]
                yield how, f"error [{case.unit}]", column, figure(error, max(floor * case.size, case.trusted))
                yield how, "energy drift", column, figure(np.nan_to_num(energy), floor)
                yield how, "momentum drift", column, figure(np.nan_to_num(momentum), floor)
                yield from reported(how, column, reports, floor)


def has_links(scene: Scene) -> bool:
    """Return whether a scene has constraints, which a solver solves."""
    return any(issubclass(getattr(tv, call.name), Batch) for call in scene.structure.features)


def extent(trial: Trial, places: np.ndarray) -> float:
    """Return the weight times the heights that are passed, and the kinetic energy at the start [J].

    places: (frames, n, dim), the positions at the ends of frames.
    """
    p, m = trial.world.particles, np.where(trial.free > 0, trial.world.particles.mass, 0.0)
    v = np.broadcast_to(np.asarray(trial.structure.particles.args.get("velocity", 0.0)), places[0].shape)
    finite = np.isfinite(places).all(axis=(1, 2))
    low, high = places[finite].min(axis=(0, 1)), places[finite].max(axis=(0, 1))
    height = oracles.height(trial.features, p, trial.free, low, np.maximum(high, low + p.size))
    return height + m @ (v**2).sum(axis=1) / 2


def of_scene(scene: Scene) -> Iterator[Cell]:
    """Yield the figures of a scene of the catalogue."""

    def with_(method: str, precision: str, path: str = "fused") -> Structure:
        s = scene.structure
        settings = {k: v for k, v in s.settings.items() if k not in ("solver", "precision", "path")}
        solver = {"solver": METHODS[method][0]} if method in METHODS else {}
        return Structure(s.particles, s.features, settings | solver | {"precision": precision, "path": path})

    def build(method: str, precision: str, path: str = "fused") -> tv.World:
        return with_(method, precision, path).build()[0]

    end: Any = None
    for method, precision in ways(build, SOLVERS if has_links(scene) else ()):
        how = f"{method} {precision}"
        with contextlib.closing(Trial(with_(method, precision))) as trial:
            if method == "default" and precision == "f32":
                with launches() as count:
                    trial.world.step(1 / 60)
                for what, cell in (*made_of(trial.world), ("kernels", str(len(count)))):
                    yield how, what, COLUMNS[0], cell
                yield how, "launches a frame", COLUMNS[0], launched(lambda: build("default", "f32", "parallel"))
            if scene.smooth and method == "default" and precision == "f64":
                end = played(trial, scene, method, str(FINE))[1]
            for column in COLUMNS:
                if column == "auto" and method != "default":
                    continue
                seen, x = played(trial, scene, method, column)
                yield from seen_in(trial, how, column, seen, ROUNDING[precision])
                if end is not None and column != "late":
                    size = float(np.abs(end - trial.structure.position).max())
                    yield how, "error [m]", column, figure(float(np.abs(x - end).max()), ROUNDING[precision] * size)


def played(trial: Trial, scene: Scene, method: str, column: str) -> tuple[list[tuple], np.ndarray]:
    """Run a scene. Returns its frames as (report, positions, momentum, passes over contacts), and where it ends."""
    substeps = {"auto": "auto", "late": 20}.get(column) or int(column)
    first = [e for e in scene.first if not (isinstance(e, Set) and e.of is None and e.name == "substeps")]
    if method in METHODS:
        first.append(Set(None, "iterations", METHODS[method][1]))
    trial.reset()
    w, m = trial.world, np.where(trial.free > 0, trial.world.particles.mass, 0.0)
    for event in (*first, Set(None, "substeps", substeps)):
        event.do(w, trial.features)
    seen: list[tuple] = [(None, w.position, m @ w.velocity, 0.0)]
    for k in range(FRAMES):
        report = Step(dt_of(column, k)).do(w, trial.features)
        seen.append((report, w.position, m @ w.velocity, float(w._runner.sheet[MOST + IMPULSES])))
        if {"non-finite", "out-of-range"} & report.flags:
            break
    return seen, seen[-1][1]


def seen_in(trial: Trial, how: str, column: str, seen: list[tuple], floor: float) -> Iterator[Cell]:
    """Yield the figures of the frames of a scene."""
    reports = [report for report, *_ in seen[1:]]
    places, passes = np.array([x for _, x, *_ in seen]), [count for *_, count in seen[1:]]
    structure, p = trial.structure, trial.world.particles
    energies = np.array([reports[0].energy - reports[0].energy_change, *(r.energy for r in reports)])
    v = np.broadcast_to(np.asarray(structure.particles.args.get("velocity", 0.0)), places[0].shape)
    m = np.where(trial.free > 0, p.mass, 0.0)
    size = extent(trial, places)
    if oracles.passive(structure):
        # The largest rise since any earlier frame, in the heights that are passed and the motion at the start.
        rise = np.nan_to_num(energies - np.minimum.accumulate(energies), nan=np.inf) / (size or abs(energies[0]) or 1.0)
        yield how, "energy rise", column, figure(float(rise.max()), floor)
    if oracles.closed(structure):
        momenta = np.array([q for *_, q, _ in seen])
        speed = np.nan_to_num(momenta - momenta[0], nan=np.inf)
        yield how, "momentum", column, figure(float(np.abs(speed).max()) / max(m @ np.linalg.norm(v, axis=1), 1e-300), floor)
    yield from reported(how, column, reports, floor)
    if trial.world._runner.launcher.rows:
        yield how, "passes", column, figure(float(np.mean(passes)))
    broken = sum(r.broken for r in reports)
    yield how, "broken", column, str(broken)


def reported(how: str, column: str, reports: list[tv.StepReport], floor: float) -> Iterator[Cell]:
    """Yield what reports say: the worst violation and overlap, flags, and the substeps of "auto", with those of its tries."""
    yield how, "residual", column, figure(max(r.residual for r in reports), floor)
    yield how, "overlap", column, figure(max(r.overlap for r in reports), floor)
    yield how, "flags", column, told(set().union(*(r.flags for r in reports)))
    if column == "auto":
        yield how, "substeps", column, figure(float(np.mean([r.substeps for r in reports])))
        yield how, "tries", column, figure(float(np.mean([r.tries for r in reports])))
