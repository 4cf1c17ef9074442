"""Many worlds in one launch, beside one world, one large world, MuJoCo and Newton.

Every table has its own process, in which the compared runs alternate, so that other load on the machine affects them alike. Times
are medians; ratios are medians of the ratios of turns.
"""

import importlib.metadata
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.report.output import Table, error_line

from ..launches import launches
from .peers import Newton
from .processes import started
from .scenes import DT, SCENES, scattered
from .speed import powers

METHODS = (
    (2, 20, "f32"), (2, 20, "f64"), (4, 1, "f64"), (4, 2, "f64"), (4, 4, "f64"), (4, 20, "f64"),
    (6, 1, "f64"), (6, 2, "f64"), (8, 1, "f64"),
)  # fmt: skip
# Sizes of the full report and of a quick one: numbers of pendulums, chains and piles; worlds in comparisons; seconds of a turn;
# turns; order, substeps and precision of double pendulums.
FULL: dict[str, Any] = {
    "pendulum": (1, 10, 100, 1000, 10_000), "chain": (1, 10, 100, 1000), "pile": (1, 10, 100, 1000), "count": 1000,
    "seconds": 0.15, "turns": 5, "chains": 200, "discs": 100, "frames": 60, "methods": METHODS,
}  # fmt: skip
# Each further order needs its own kernels.
QUICK = FULL | {
    "pendulum": (1, 3), "chain": (3,), "pile": (3,), "count": 4, "seconds": 0.01, "turns": 2, "chains": 2, "discs": 10,
    "frames": 4, "methods": (METHODS[0], METHODS[-1]),
}  # fmt: skip
# Seconds over which errors of double pendulums are measured, and samples a second.
LATE, LOOKS = 3.0, 15
RATES = (30, 45, 60, 90, 120, 240, 480, 960, 1920, 3840)  # steps a second of MuJoCo; multiples of LOOKS
# Bodies as near to points as MuJoCo allows: 1e-12 kg m2 shifts positions by less than 1e-11 m. Everything unused is off.
MODEL = """<mujoco><compiler inertiafromgeom="false"/>
<option integrator="RK4" gravity="0 -9.81 0"><flag contact="disable" constraint="disable" limit="disable" equality="disable"
 frictionloss="disable" spring="disable" damper="disable" actuation="disable" sensor="disable" warmstart="disable"/></option>
<worldbody><body><joint type="hinge" axis="0 0 1"/><inertial pos="1 0 0" mass="1" diaginertia="1e-12 1e-12 1e-12"/>
<body pos="1 0 0"><joint type="hinge" axis="0 0 1"/><inertial pos="1 0 0" mass="1" diaginertia="1e-12 1e-12 1e-12"/></body>
</body></worldbody></mujoco>"""
CHAIN = 20  # links of the chain, each 5 cm long
SWING = 0.5  # [s] after which errors of chains are compared
SETTINGS = ((4, 10), (10, 10), (20, 20))  # of Newton: steps of a frame, iterations of each


def main(args) -> Iterator[Table]:
    """Yield the tables, of 1 and of all threads by default."""
    cores = args.threads or tuple(dict.fromkeys((1, powers(os.cpu_count() or 1)[-1])))
    with tempfile.TemporaryDirectory() as cache:
        for name in args.parts or PARTS:
            part, rows, notes = PARTS[name], [], list(PARTS[name].notes)
            if part.peer and not find_spec(part.peer):
                notes.append(f"Left out: {part.peer}, since it is not installed.")
                if not part.alone:
                    continue
            for count in cores if part.threads else cores[:1]:
                try:
                    with started("worlds", {"part": name, "threads": count, "quick": args.quick}, cache) as talker:
                        rows += [(str(count), *row) for row in talker.ask()]
                except (RuntimeError, OSError) as error:
                    notes.append(f"Missing: {name} on {count} threads: {error_line(error)}")
            yield Table(part.title, ("threads", *part.heads), rows, notes)


def process(job: dict[str, Any], imported: float) -> None:
    """Run the process of a part: print the rows of its table as JSON. What libraries print goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    tv.init(threads=job["threads"])
    sizes = QUICK if job["quick"] else FULL
    rows = [[cell if isinstance(cell, str) else f"{cell:.3g}" for cell in row] for row in PARTS[job["part"]].rows(job, sizes)]
    print(json.dumps(rows), file=answers, flush=True)


def in_turns(acts: dict[Any, Callable[[], Any]], turns: int) -> dict[Any, list[float]]:
    """Return the seconds of each act in each turn."""
    out: dict[Any, list[float]] = {name: [] for name in acts}
    for _ in range(turns):
        for name, act in acts.items():
            clock = perf_counter()
            act()
            out[name].append(perf_counter() - clock)
    return out


def ratio(these: list[float], those: list[float]) -> float:
    """Return the median of the ratios of turns."""
    return median(a / b for a, b in zip(these, those, strict=True))


def hung(links: int, length: float):
    """Build a chain that is released horizontally, held at one end: particles and features."""
    x = np.stack([length * np.arange(links + 1), np.zeros(links + 1)], axis=1)
    i = np.arange(links)
    return tv.Particles(x, pinned=[0]), [tv.Gravity(9.81), tv.Distance(np.stack([i, i + 1], axis=1))]


def ladder(job: dict[str, Any], sizes: dict[str, Any]) -> Iterator[tuple]:
    """Yield the rows of numbers of worlds and particles, each beside the same world alone."""
    scenes = {
        "pendulum": (lambda: hung(2, 1.0), 20), "chain": (lambda: hung(CHAIN, 0.05), 20),
        "pile": (lambda: SCENES["pile"].build(sizes["discs"]), 8),
    }  # fmt: skip
    for name, (build, substeps) in scenes.items():
        particles, features = build()
        for count in sizes[name]:
            with tv.World(particles, [f.copy() for f in features], substeps=substeps) as alone:
                with tv.Worlds(alone, count) as many:
                    many.step(DT)
                    alone.step(DT)
                    frames, frames_alone = (_fitting(world, sizes["seconds"]) for world in (many, alone))
                    acts = {"many": partial(many.run, frames * DT, DT), "alone": partial(alone.run, frames_alone * DT, DT)}
                    times: dict[str, list[float]] = {k: [] for k in acts}
                    for _ in range(sizes["turns"]):  # each turn begins at the start, before the pile comes to rest
                        many.reset()
                        alone.position, alone.velocity = particles.position, particles.velocity
                        for world in (many, alone):
                            world.step(DT)
                        for k, seconds in in_turns(acts, 1).items():
                            times[k] += seconds
                    long = min(1000, 20 * frames)
                    with launches(timed=True) as spent:
                        clock = perf_counter()
                        many.run(long * DT, DT)
                        python = 1 - sum(spent.seconds.values()) / (perf_counter() - clock)
                    each = [t / (count * frames) for t in times["many"]]
                    single = [t / frames_alone for t in times["alone"]]
                    yield (
                        name, f"{len(particles)}", f"{count:,}", 1 / median(each), 1e6 * median(each) * job["threads"],
                        1e6 * median(single), ratio(single, each), f"{100 * python:.1f}% of {long}",
                    )  # fmt: skip


def _fitting(world: Any, seconds: float) -> int:
    """Return the number of frames that take about `seconds`."""
    clock = perf_counter()
    world.run(2 * DT, DT)
    return int(np.clip(seconds / (perf_counter() - clock) * 2, 1, 600))


def pendulums(job: dict[str, Any], sizes: dict[str, Any]) -> Iterator[tuple]:
    """Yield the rows of double pendulums by each order, beside the time that MuJoCo takes for the same error."""
    count, frames = sizes["count"], 60
    times = np.arange(1, round(LATE * LOOKS) + 1) / LOOKS
    exact = double_pendulum(times)
    acts, errors = {}, {}
    for order, substeps, precision in sizes["methods"]:
        particles, features = hung(2, 1.0)
        many = tv.Worlds(tv.World(particles, features, substeps=substeps, order=order, precision=precision), count)
        track = many.rollout(LATE, DT, every=frames // LOOKS).position[0, :, 1:]
        errors[order, substeps, precision] = float(np.abs(track - exact).max())
        acts[order, substeps, precision] = partial(many.run, frames * DT, DT)
    theirs = MuJoCo(job["threads"], count) if find_spec("mujoco") else None
    if theirs:
        known = [(rate, float(np.abs(theirs.track(rate, times) - exact).max())) for rate in RATES]
        theirs.run()  # an untimed run, which allocates memory
        acts["mujoco"] = theirs.run
    spent = in_turns(acts, sizes["turns"])
    for (order, substeps, precision), error in errors.items():
        t = [x / (count * frames) for x in spent[order, substeps, precision]]
        row = (f"order {order}, {substeps} x {precision}", f"{error:.1e}", 1 / median(t), 1e6 * job["threads"] * median(t))
        if theirs:
            a_step = [x / (count * theirs.steps) for x in spent["mujoco"]]
            rate = rate_for(error, known)
            a_frame = [x * rate * DT for x in a_step]
            yield (*row, f"{rate:.0f}", 1 / median(a_frame), ratio(a_frame, t))
        else:
            yield (*row, "", "", "")
    if theirs:
        step = median(spent["mujoco"]) / (count * theirs.steps)
        for rate, error in known:
            t = step * rate * DT
            yield (f"MuJoCo {theirs.version}", f"{error:.1e}", 1 / t, 1e6 * job["threads"] * t, f"{rate}", "", "")


def rate_for(error: float, known: list[tuple[int, float]]) -> float:
    """Return the steps a second for an error, by log-log interpolation of `known`; beyond it, by order 4."""
    best = min(range(len(known)), key=lambda k: known[k][1])
    some = known[: best + 1]  # beyond the best, rounding dominates
    x, y = np.log([rate for rate, _ in some]), np.log([e for _, e in some])
    wanted = np.log(error)
    if wanted < y[-1]:
        return float(np.exp(x[-1] + (y[-1] - wanted) / 4))
    if wanted > y[0]:
        return float(np.exp(x[0] - (wanted - y[0]) / 4))
    return float(np.exp(np.interp(-wanted, -y, x)))


class MuJoCo:
    """The double pendulums in MuJoCo: mujoco.rollout with RK4, all from the same start."""

    steps = 60  # of a turn

    def __init__(self, threads: int, count: int):
        mujoco: Any = import_module("mujoco")
        rollout: Any = import_module("mujoco.rollout")
        self.version = importlib.metadata.version("mujoco")
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.data = [mujoco.MjData(self.model) for _ in range(threads)]
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.zeros(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self.data[0], start, kind)
        self.start = np.repeat(start[None], count, axis=0)
        self.out = np.ones((count, self.steps, len(start)))
        self.pool = rollout.Rollout(nthread=threads if threads > 1 else 0)

    def track(self, rate: int, times: np.ndarray) -> np.ndarray:
        """Return the positions of both masses at `times`, (times, 2, 2) [m], with `rate` steps a second."""
        self.model.opt.timestep = 1 / rate
        at = np.rint(times * rate).astype(int)
        states, _ = self.pool.rollout(self.model, self.data, self.start[:1], nstep=int(at[-1]))
        return arms(states[0, at - 1, 1], states[0, at - 1, 1:3].sum(axis=1))

    def run(self) -> None:
        """Compute `steps` steps of all pendulums."""
        self.pool.rollout(self.model, self.data, self.start, nstep=self.steps, state=self.out)


def arms(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the ends of two links of 1 m, (times, 2, 2) [m], from their angles to the horizontal."""
    one = np.stack([np.cos(first), np.sin(first)], axis=-1)
    return np.stack([one, one + np.stack([np.cos(second), np.sin(second)], axis=-1)], axis=-2)


def double_pendulum(times: np.ndarray, steps: int = 16, stages: int = 8) -> np.ndarray:
    """Return the positions of two masses of 1 kg on links of 1 m that fall from the horizontal, to 1e-12 m.

    Solves Lagrange's equations by Gauss collocation of order 16. times: multiples of the first. steps: between two times.
    """
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    nodes, weights = (nodes + 1) / 2, weights / 2
    powers = np.arange(stages)
    inverse = np.linalg.inv(nodes[:, None] ** powers)  # from values at the nodes to the polynomial through them
    matrix = (nodes[:, None] ** (powers + 1) / (powers + 1)) @ inverse
    h = times[0] / steps

    def slope(y):
        """Return the time derivatives of both angles and their rates, (stages, 4)."""
        a, b, w, v = y.T
        c, s = np.cos(a - b), np.sin(a - b)
        p, q = -2 * 9.81 * np.cos(a) - s * v * v, -9.81 * np.cos(b) + s * w * w
        return np.stack([w, v, (p - c * q) / (2 - c * c), (2 * q - c * p) / (2 - c * c)], axis=1)

    y, k, out = np.zeros(4), np.zeros((stages, 4)), []
    for step in range(1, steps * len(times) + 1):
        for _ in range(30):
            k = slope(y + h * matrix @ k)
        y = y + h * weights @ k
        if step % steps == 0:
            out.append(y[:2])
    angles = np.array(out)
    return arms(angles[:, 0], angles[:, 1])


def chains(job: dict[str, Any], sizes: dict[str, Any]) -> Iterator[tuple]:
    """Yield the rows of chains of 20 links, beside Newton's XPBD with all chains in one model."""
    count, frames = sizes["chains"], round(SWING / DT)
    particles, features = hung(CHAIN, 0.05)
    with tv.World(particles, features, substeps=8, order=8, precision="f64") as fine:
        fine.run(SWING, DT)
        exact = fine.position
    acts, errors = {}, {}
    for substeps in (2, 5, 20):
        many = tv.Worlds(tv.World(particles, [f.copy() for f in features], substeps=substeps), count)
        many.run(SWING, DT)
        errors[f"order 2, {substeps} substeps"] = float(np.abs(many.position[0] - exact).max())
        acts[f"order 2, {substeps} substeps"] = partial(many.run, frames * DT, DT)
    x, n = particles.position, len(particles)
    some = np.arange(count)[:, None, None]
    place = np.concatenate([x + [0.0, 3.0 * k] for k in range(count)])
    every = tv.Particles(place, pinned=n * np.arange(count)), [
        features[0].copy(), tv.Distance((features[1].indices[None] + n * some).reshape(-1, 2)),
    ]  # fmt: skip
    for setting in SETTINGS if sizes is FULL else SETTINGS[:1]:
        engine = Newton(*every, setting)
        for _ in range(frames):
            engine.frame()
        name = f"Newton {importlib.metadata.version('newton')}, {setting[0]} x {setting[1]}"
        errors[name] = float(np.abs(engine.position()[:n] - exact).max())
        acts[name] = lambda engine=engine: [engine.frame() for _ in range(3)]
    spent = in_turns(acts, min(3, sizes["turns"]))
    for name, error in errors.items():
        each = median(spent[name]) / (count * (3 if name.startswith("Newton") else frames))
        yield (name, f"{error:.1e}", 1 / each, 1e6 * each)


def piles(job: dict[str, Any], sizes: dict[str, Any]) -> Iterator[tuple]:
    """Yield the rows of many piles beside one pile of all their discs, falling and packed, with the contacts of both."""
    count, discs = sizes["count"], sizes["discs"]
    for name, build in (("falling", SCENES["pile"].build), ("packed", packed)):
        with tv.World(*build(discs), substeps=8) as one, tv.World(*build(discs * count), substeps=8) as large:
            with tv.Worlds(one, count) as many:
                times: dict[str, list[float]] = {"many": [], "large": []}
                contacts = {"many": 0, "large": 0}
                for world in (many, large):
                    world.run(sizes["frames"] // 3 * DT, DT)
                group = max(1, sizes["frames"] // 6)
                for _ in range(4):
                    for k, world in (("many", many), ("large", large)):
                        clock = perf_counter()
                        report = world.run(group * DT, DT)
                        times[k].append((perf_counter() - clock) / group)
                        contacts[k] += int(np.sum(report.contacts)) // 4
                per = [median(times[k]) / max(1, contacts[k]) * 1e9 for k in times]
                yield (
                    name, f"{count:,} x {discs:,}", f"{1e3 * median(times['many']):.3g}", f"{1e3 * median(times['large']):.3g}",
                    ratio(times["many"], times["large"]), f"{contacts['many']:,}", f"{contacts['large']:,}", per[0] / per[1],
                )  # fmt: skip


def packed(n: int):
    """Build discs that touch each other in rows and columns, in a box that is hardly wider."""
    side = int(np.ceil(n**0.5))
    i = np.arange(n)
    x = np.stack([i % side, i // side], axis=1) + 0.5 + 0.001 * np.stack([scattered(2 * i + 1), scattered(2 * i + 2)], axis=1)
    return tv.Particles(x, radius=0.5), [tv.Gravity(9.81), tv.Box([0, 0], [side + 0.001, 2.0 * side]), tv.Contact()]


def costs(job: dict[str, Any], sizes: dict[str, Any]) -> Iterator[tuple]:
    """Yield the rows of memory, first frame, and a reset of half of the worlds."""
    count = sizes["count"]
    for name, (particles, features) in (("pendulum", hung(2, 1.0)), ("pile", SCENES["pile"].build(sizes["discs"]))):
        with tv.World(particles, features, substeps=8) as one:
            clock = perf_counter()
            with tv.Worlds(one, count) as many:
                many.step(DT)
                first, kernels = perf_counter() - clock, len(many._world._runner.memory.compiler.times.kernels)
            before, clock = resident(), perf_counter()
            with tv.Worlds(one, count) as many:
                many.step(DT)
                second, after = perf_counter() - clock, resident()
                again = len(many._world._runner.memory.compiler.times.kernels)
                ours = sum(e.bytes * max(1, e.copies) for m in many._runner.memories for e in m.entries)
                theirs = sum(one.fields.values()) * count
                half, resets, steps = np.arange(count) % 2 == 0, [], []
                for _ in range(sizes["turns"]):
                    many.run(0.1, DT)
                    clock = perf_counter()
                    many.reset(half)
                    resets.append(perf_counter() - clock)
                    clock = perf_counter()
                    many.step(DT)
                    steps.append(perf_counter() - clock)
                grown = f"{max(0, after - before) / count:,.0f}"
                yield (
                    name, f"{count:,}", f"{theirs / count:,.0f}", f"{ours / theirs:.3f}", grown, f"{first:.2f}",
                    f"{kernels}", f"{second:.3f}", f"{again}", 1e3 * median(resets), 1e3 * median(steps),
                )  # fmt: skip


def resident() -> int:
    """Return the resident memory of the process [bytes]; 0 if the system does not provide it."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


@dataclass(frozen=True)
class Part:
    """One table, whose rows(job, sizes) run in their own process.

    peer: the engine to compare with, or "". alone: whether there are rows without it. threads: whether the part runs on each
    number of threads, or on the first alone.
    """

    title: str
    heads: tuple[str, ...]
    rows: Callable[[dict[str, Any], dict[str, Any]], Iterator[tuple]]
    notes: tuple[str, ...] = ()
    peer: str = ""
    alone: bool = True
    threads: bool = True


PARTS = {
    "ladder": Part(
        "Worlds and particles",
        ("scene", "particles", "worlds", "world-frames/s", "us x threads", "alone [us]", "times alone", "Python"), ladder,
        ("us x threads: of a frame of one world on one thread. alone: the same world by itself. Python: the rest of a launch.",),
    ),
    "pendulums": Part(
        f"Double pendulums: 1000, error after {LATE:g} s",
        ("method", "error [m]", "world-frames/s", "us x threads", "MuJoCo's steps/s", "its world-frames/s", "times as fast"),
        pendulums,
        (
            "Two links of 1 m, 1 kg each, let go of horizontally; the error is the largest of a coordinate at any of 45 times, "
            "from Lagrange's equations.",
            "MuJoCo's steps/s: those with which RK4 has the same error, between the steps tried (at the end). Its bodies have "
            "1e-12 kg m2, and all that they do not need is off.",
        ), "mujoco",
    ),
    "chains": Part(
        f"Chains of {CHAIN} links, error after {SWING:g} s", ("method", "error [m]", "world-frames/s", "us"), chains,
        ("Newton: XPBD, springs of 1e6 N/m, all chains in one model, on the one thread of Warp.",),
        "newton", alone=False, threads=False,
    ),
    "piles": Part(
        "Piles beside one of all their discs",
        ("start", "piles x discs", "ms", "one [ms]", "ratio", "contacts", "of one", "ratio per contact"), piles,
    ),
    "costs": Part(
        "Memory, start, reset of half of them",
        ("scene", "worlds", "bytes of one", "of each / one", "resident of each", "first [s]", "kernels", "again [s]", "kernels",
         "reset [ms]", "next step [ms]"), costs,
        ("of each / one: bytes of fields. resident: what the process grew by. kernels: that were compiled; first: with them.",),
        threads=False,
    ),
}  # fmt: skip
