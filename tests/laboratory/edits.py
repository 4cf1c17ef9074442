"""Time first steps, copies, and edits of a pile, beside the same edits by pymunk and Newton.

Every engine has its own process, tiverlet has two: one with an empty cache, one with the cache that the first has left. An edit
is timed with the frame that follows it, less an ordinary frame, because an engine may defer its work. Edits are measured in CPU
time of the host's thread, which other programs disturb less than wall time. First steps are measured in wall time.
"""

import json
import tempfile
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from statistics import median
from time import perf_counter, thread_time
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.report.output import Table

from .peers import Newton, Pymunk
from .processes import started
from .scenes import DT, SCENES

TIMES, QUICK = 30, 5  # repetitions of an edit, and in a quick run; the median counts
DISCS = 4000  # of the pile; a tenth in a quick run
FEW, SOME = 1, 100  # particles that are added and removed
POINTS, ROPES = 10, 5  # particles of the rope that is added and removed; ropes that stay
START, SECOND, COPY = "build, first step", "second world, first step", "copy, first step"
# Target times [s].
AIMS = {
    SECOND: 0.02, COPY: 0.01, f"add {FEW}": 0.002, f"add {SOME}": 0.002, f"remove {FEW}": 0.002, f"remove {SOME}": 0.002,
    "add as many again": 0.05, "pin another particle": 0.0002, "take another in hand": 0.0002, "switch a wall": 0.002,
    "add a rope": 0.002, "remove a rope": 0.002,
}  # fmt: skip


def main(args) -> Iterator[Table]:
    """Yield the table of edits."""
    times = QUICK if args.quick else TIMES
    engines = [name for name in ("pymunk", "newton") if find_spec(name)]
    for n in args.sizes or (DISCS // 10 if args.quick else DISCS,):
        if n <= SOME:
            raise SystemExit(f"edits: {n} discs are too few to remove {SOME} of them.")
        with tempfile.TemporaryDirectory() as cache:
            found = {}
            for name in ("cold", "warm", *engines):
                engine = name if name in engines else "tiverlet"
                with started("edits", {"import": engine, "n": n, "times": times}, cache) as talker:
                    found[name] = talker.ask()
        rows = [
            (act, *(f"{1e3 * t:.3g}" if (t := some.get(act)) is not None else "" for some in (AIMS, *found.values())))
            for act in found["cold"]
        ]
        yield Table(f"Edits of a pile of {n} discs [ms]", ("edit", "aim", *found), rows)


def process(job: dict[str, Any], imported: float) -> None:
    """Run the process of an engine: print the seconds of each edit."""
    acts = {"tiverlet": ours, "pymunk": pymunks, "newton": newtons}[job["import"]](job["n"], job["times"])
    print(json.dumps({"import": imported, **acts}), flush=True)


def clocked(act: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a function, and the seconds that it took."""
    clock = perf_counter()
    out = act()
    return out, perf_counter() - clock


def pile(n: int):
    """Return particles and features of the pile, and a function that makes further discs above it."""
    particles, features = SCENES["pile"].build(n)
    x, radius = particles.position, float(particles.radius[0])

    def more(k: int, turn: int) -> tv.Particles:
        """Return k more particles above the pile, higher with each turn."""
        place = np.stack([np.arange(k) % 30, np.arange(k) // 30], axis=1) * 2.2 * radius
        return tv.Particles(place + [x[:, 0].min(), x[:, 1].max() + 3 * radius + turn * 10 * radius], radius=radius)

    return particles, features, more


def hung(x: np.ndarray, radius: float, k: int) -> np.ndarray:
    """Return the points of the k-th rope, which hangs above particles at x."""
    left, top = x[:, 0].min() + 3 * radius * k, x[:, 1].max() + 40 * radius
    return np.stack([np.full(POINTS, left), top - 2.2 * radius * np.arange(POINTS)], axis=1)


Act = Callable[[int], Any]


def timed(acts: dict[str, tuple[Act, Act | None]], frame: Callable[[], Any], rounds: int) -> dict[str, float]:
    """Return the seconds of edits, each with the work that it defers to the next frame.

    acts: by name, the edit and the function that undoes it, or None. From one edit to the next there is an odd number of frames,
    because tiverlet takes out sound in every fourth frame of 8 substeps.
    """
    out = {}
    for name, (act, back) in acts.items():
        spent, usual = [], []
        for k in range(rounds):
            for _ in range(3 if back else 2):
                clock = thread_time()
                frame()
                usual.append(thread_time() - clock)
            clock = thread_time()
            act(k)
            frame()
            spent.append(thread_time() - clock)
            if back:
                back(k)
                frame()
        out[name] = max(0.0, median(spent) - median(usual))
    return out


def ours(n: int, rounds: int) -> dict[str, float]:
    """Return the times of edits by tiverlet, with a pin, a hand and a wall with a switch in the scene."""
    particles, features, more = pile(n)

    def built(count: int) -> tuple[tv.World, tv.HalfSpace, tv.Hand, tv.Pin]:
        """Return a World of the pile with `count` particles after its first step, and its wall, hand and pin."""
        some = tv.Particles(particles.position[:count], radius=particles.radius[:count])
        wall, hand, pin = tv.HalfSpace((0, -1), -1e3, active=True), tv.Hand((0.0, 0.0), rate=0.0), tv.Pin([0])
        world = tv.World(some, [*(f.copy() for f in features), wall, hand, pin], substeps=8)
        world.step(DT)
        return world, wall, hand, pin

    (world, wall, hand, pin), first = clocked(lambda: built(n))
    (other, *_), second = clocked(lambda: built(n - n // 8))
    other.close()
    world.run(5 * DT, DT)

    def copy() -> tv.World:
        """Return a copy of the world after a step."""
        other = world.clone()
        other.step(DT)
        return other

    other, copied = clocked(copy)
    other.close()

    def hold(k: int) -> None:
        """Let the pin hold another particle where it is."""
        pin.indices, pin.target = [n // 2 + k], world.position[n // 2 + k]

    def added(k: int) -> Act:
        """Return an edit that adds k particles above the pile."""
        return lambda turn: world.add(more(k, 0))

    def removed(k: int) -> Act:
        """Return an edit that removes the last k particles."""
        return lambda turn: world.remove(np.arange(len(world.particles) - k, len(world.particles)))

    acts = {
        f"add {FEW}": (added(FEW), removed(FEW)), f"add {SOME}": (added(SOME), removed(SOME)),
        f"remove {FEW}": (removed(FEW), added(FEW)), f"remove {SOME}": (removed(SOME), added(SOME)),
        "pin another particle": (hold, None), "take another in hand": (lambda k: setattr(hand, "particle", k), None),
        "switch a wall": (lambda k: setattr(wall, "active", bool(k % 2)), None), "add as many again": (added(n), removed(n)),
    }  # fmt: skip
    found = timed(acts, lambda: world.step(DT), rounds)
    world.close()
    return {START: first, SECOND: second, COPY: copied, **found, **roped(n, rounds)}


def roped(n: int, rounds: int) -> dict[str, float]:
    """Return the times of adding and removing a rope by tiverlet, in the pile with ropes."""
    particles, features, _ = pile(n)
    x, radius = particles.position, float(particles.radius[0])
    pairs = np.stack([np.arange(POINTS - 1), np.arange(1, POINTS)], axis=1)
    links = tv.Distance(np.concatenate([pairs + n + POINTS * k for k in range(ROPES)]))
    ropes = np.concatenate([hung(x, radius, k) for k in range(ROPES)])
    world = tv.World(tv.Particles(np.concatenate([x, ropes]), radius=radius), [*features, links], substeps=8)

    def add(turn: int):
        """Add one more rope."""
        more = tv.Particles(hung(x, radius, ROPES), radius=radius)
        world.add(more, extend={links: tv.Distance(pairs + len(world.particles))})

    def remove(turn: int):
        """Remove the last rope."""
        world.remove(np.arange(len(world.particles) - POINTS, len(world.particles)))

    acts: dict[str, tuple[Act, Act | None]] = {"add a rope": (add, remove), "remove a rope": (remove, add)}
    world.step(DT)
    add(0)
    return timed(acts, lambda: world.step(DT), rounds)


def pymunks(n: int, rounds: int) -> dict[str, float]:
    """Return the times of edits by pymunk."""
    pymunk: Any = import_module("pymunk")
    particles, features, more = pile(n)
    radius = float(particles.radius[0])

    def built() -> Pymunk:
        """Return the pile in pymunk after its first frame."""
        engine = Pymunk(particles, features, (8, 10))
        engine.frame()
        return engine

    engine, first = clocked(built)
    _, second = clocked(built)
    _, copied = clocked(lambda: (engine.space.copy(), engine.frame()))
    space, come, grip, tied = engine.space, [], [], []

    def bodies(x: np.ndarray) -> list[tuple[Any, Any]]:
        """Return bodies at x and their circles."""
        out = []
        for place in x.tolist():
            body = pymunk.Body(1.0, float("inf"))
            body.position = tuple(place)
            out.append((body, pymunk.Circle(body, radius)))
        return out

    def added(k: int) -> Act:
        """Return an edit that adds k bodies above the pile."""

        def act(turn: int) -> None:
            """Add the bodies one after the other."""
            for pair in bodies(more(k, turn).position):
                space.add(*pair)
                come.append(pair)

        return act

    def removed(k: int) -> Act:
        """Return an edit that removes the last k bodies."""

        def act(turn: int) -> None:
            """Remove the bodies one after the other."""
            for _ in range(k):
                space.remove(*come.pop())

        return act

    def hold(k: int) -> None:
        """Hold another body by a joint."""
        body = engine.bodies[n // 2 + k]
        space.remove(*grip)
        grip[:] = [pymunk.PivotJoint(space.static_body, body, tuple(body.position))]
        space.add(*grip)

    def tie(turn: int) -> None:
        """Add the bodies and joints of a rope."""
        rope = bodies(hung(particles.position, radius, ROPES))
        joints = [pymunk.PinJoint(a, b) for (a, _), (b, _) in pairwise(rope)]
        tied.append([part for pair in rope for part in pair] + joints)
        space.add(*tied[-1])

    def untie(turn: int) -> None:
        """Remove the bodies and joints of the last rope."""
        space.remove(*tied.pop())

    added(2 * SOME)(0)  # bodies that the edits can remove
    tie(0)
    acts = {
        f"add {FEW}": (added(FEW), removed(FEW)), f"add {SOME}": (added(SOME), removed(SOME)),
        f"remove {FEW}": (removed(FEW), added(FEW)), f"remove {SOME}": (removed(SOME), added(SOME)),
        "pin another particle": (hold, None), "add as many again": (added(n), removed(n)),
        "add a rope": (tie, untie), "remove a rope": (untie, tie),
    }  # fmt: skip
    return {START: first, SECOND: second, COPY: copied, **timed(acts, engine.frame, rounds)}


def newtons(n: int, rounds: int) -> dict[str, float]:
    """Return the times of edits by newton.

    Its models are fixed, except the contents of their arrays: adding or removing particles or springs needs a new model. Pinned
    particles have mass 0. Discs are balls in a plane.
    """
    particles, features, _ = pile(n)

    def built() -> Newton:
        """Return the pile in newton after its first frame."""
        engine = Newton(particles, features, (8, 2))
        engine.frame()
        return engine

    def copy() -> None:
        """Copy the state, and step the copy."""
        other = engine.model.state()
        other.assign(engine.now)
        engine.now = other
        engine.frame()

    engine, first = clocked(built)
    _, usual = clocked(engine.frame)
    _, again = clocked(built)
    _, copied = clocked(copy)
    inverse, held = engine.model.particle_inv_mass.numpy(), [0, 0.0]  # the array is shared, not copied, on a CPU

    def hold(k: int) -> None:
        """Give another particle infinite mass, and the last one its own mass again."""
        inverse[held[0]] = held[1] or inverse[held[0]]
        held[:] = n // 2 + k, float(inverse[n // 2 + k])
        inverse[held[0]] = 0.0

    edits = {act: again - usual for act in AIMS if act.startswith(("add", "remove"))}
    return {START: first, SECOND: again, COPY: copied, **edits, **timed({"pin another particle": (hold, None)}, engine.frame, 3)}
