"""Time first steps, copies, and edits of a pile, beside the same edits by other engines.

Every engine has its own process, tiverlet has two: one with an empty cache, one with the cache that the first has left. An edit
is timed with the frame that follows it, less an ordinary frame, because an engine may defer its work. Edits are measured in CPU
time of the host's thread, which other programs disturb less than wall time. First steps are measured in wall time.
"""

import json
from collections.abc import Callable
from itertools import pairwise
from statistics import median
from time import perf_counter, thread_time
from typing import Any

import numpy as np

from .result import Wait

TIMES, QUICK = 30, 5  # repetitions of an edit in a full and in a quick report; the median counts
FEW, SOME = 1, 100  # particles that are added and removed
POINTS, ROPES = 10, 5  # particles of the rope that is added and removed; ropes that stay
START = """
from time import perf_counter
clock = perf_counter()
import sys, json
job = json.loads(sys.argv[1])
__import__(job["engine"])
seconds = perf_counter() - clock
from tiverlet.report.speed.waits import main
main(job, seconds)
"""
FIRST = ("import", "build, first step")
# Target times [s].
AIMS = {
    "second world, first step": 0.02, "copy, first step": 0.01, f"add {FEW}": 0.002, f"add {SOME}": 0.002,
    f"remove {FEW}": 0.002, f"remove {SOME}": 0.002, "add as many again": 0.05, "pin another particle": 0.0002,
    "take another in hand": 0.0002, "switch a wall": 0.002, "add a rope": 0.002, "remove a rope": 0.002,
}  # fmt: skip


def waits(n: int, times: int, cache: str, peers: list[str]) -> list[Wait]:
    """Return the times of edits of a pile of n discs. times: repetitions. cache: an empty folder. peers: installed engines."""
    from .processes import started

    def of(engine: str) -> dict[str, float]:
        """Return the seconds of each edit by one engine, in its own process."""
        with started(START, {"engine": engine, "n": n, "times": times}, cache) as talker:
            return talker.ask()

    cold, warm, theirs = of("tiverlet"), of("tiverlet"), {name: of(name) for name in peers}
    found = {act: {name: seconds[act] for name, seconds in theirs.items() if act in seconds} for act in cold}
    return [Wait(act, n, AIMS.get(act), cold[act], warm[act], found[act]) for act in cold]


def main(job: dict[str, Any], imported: float) -> None:
    """Run the process of an engine: print the seconds of each edit."""
    out = {FIRST[0]: imported, **{"tiverlet": ours, "pymunk": pymunks, "newton": newtons}[job["engine"]](job["n"], job["times"])}
    print(json.dumps(out), flush=True)


def pile(n: int):
    """Return particles and features of the pile, and a function that makes further discs above it."""
    from ...particles import Particles
    from .scenes import SCENES

    particles, features = SCENES["pile"].build(n)
    x, radius = particles.position, float(particles.radius[0])

    def more(k: int, turn: int) -> Particles:
        """Return k more particles above the pile, higher with each turn."""
        place = np.stack([np.arange(k) % 30, np.arange(k) // 30], axis=1) * 2.2 * radius
        return Particles(place + [x[:, 0].min(), x[:, 1].max() + 3 * radius + turn * 10 * radius], radius=radius)

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
    import tiverlet as tv

    from .counting import DT

    particles, features, more = pile(n)

    def built(count: int):
        """Return a World of the pile with `count` particles, and its wall, hand and pin."""
        some = tv.Particles(particles.position[:count], radius=particles.radius[:count])
        wall, hand = tv.HalfSpace((0, -1), -1e3, active=True), tv.Hand((0.0, 0.0), rate=0.0)
        pin = tv.Pin([0])
        own = [f.copy() for f in features]
        return tv.World(some, [*own, wall, hand, pin], substeps=8), wall, hand, pin

    clock = perf_counter()
    world, wall, hand, pin = built(n)
    world.step(DT)
    first = perf_counter() - clock
    clock = perf_counter()
    with built(n - n // 8)[0] as other:
        other.step(DT)
        second = perf_counter() - clock
    for _ in range(5):
        world.step(DT)
    clock = perf_counter()
    with world.clone() as other:
        other.step(DT)
        copied = perf_counter() - clock

    def frame():
        """Step one frame."""
        world.step(DT)

    def hold(k: int):
        """Let the pin hold another particle where it is."""
        pin.indices, pin.target = [n // 2 + k], world.position[n // 2 + k]

    def take(k: int):
        """Let the hand pull another particle."""
        hand.particle = k

    def switch(k: int):
        """Switch the wall on or off."""
        wall.active = bool(k % 2)

    def added(k: int):
        """Return an edit that adds k particles above the pile."""
        return lambda turn: world.add(more(k, 0))

    def removed(k: int):
        """Return an edit that removes the last k particles."""
        return lambda turn: world.remove(np.arange(len(world.particles) - k, len(world.particles)))

    acts = {
        f"add {FEW}": (added(FEW), removed(FEW)), f"add {SOME}": (added(SOME), removed(SOME)),
        f"remove {FEW}": (removed(FEW), added(FEW)), f"remove {SOME}": (removed(SOME), added(SOME)),
        "pin another particle": (hold, None), "take another in hand": (take, None), "switch a wall": (switch, None),
        "add as many again": (added(n), removed(n)),
    }  # fmt: skip
    found = timed(acts, frame, rounds)
    world.close()
    return {FIRST[1]: first, "second world, first step": second, "copy, first step": copied, **found, **roped(n, rounds)}


def roped(n: int, rounds: int) -> dict[str, float]:
    """Return the times of adding and removing a rope by tiverlet, in the pile with ropes."""
    import tiverlet as tv

    from .counting import DT

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
    import pymunk  # pyright: ignore[reportMissingImports]
    from pymunk.constraints import PinJoint, PivotJoint  # pyright: ignore[reportMissingImports]

    from .peers import Pymunk

    particles, features, more = pile(n)

    def built():
        """Return the pile in pymunk."""
        return Pymunk(particles, features, 1, (8, 10))

    clock = perf_counter()
    engine = built()
    engine.frame()
    first = perf_counter() - clock
    clock = perf_counter()
    built().frame()
    second = perf_counter() - clock
    clock = perf_counter()
    engine.space.copy()
    engine.frame()
    copied = perf_counter() - clock
    space, come, grip, tied = engine.space, [], [], []

    def added(k: int):
        """Return an edit that adds k bodies."""

        def act(turn: int):
            """Add the bodies above the pile."""
            for x in more(k, turn).position.tolist():
                body = pymunk.Body(1.0, float("inf"))
                body.position = tuple(x)
                circle = pymunk.Circle(body, float(particles.radius[0]))
                space.add(body, circle)
                come.append((body, circle))

        return act

    def removed(k: int):
        """Return an edit that removes the last k bodies."""

        def act(turn: int):
            """Remove the bodies one after the other."""
            for _ in range(k):
                space.remove(*come.pop())

        return act

    def hold(k: int):
        """Hold another body by a joint."""
        body = engine.bodies[n // 2 + k]
        space.remove(*grip)
        grip[:] = [PivotJoint(space.static_body, body, tuple(body.position))]
        space.add(*grip)

    def tie(turn: int):
        """Add the bodies and joints of a rope."""
        rope = []
        for place in hung(particles.position, float(particles.radius[0]), ROPES).tolist():
            body = pymunk.Body(1.0, float("inf"))
            body.position = tuple(place)
            rope += [body, pymunk.Circle(body, float(particles.radius[0]))]
        joints = [PinJoint(a, b) for a, b in pairwise(rope[::2])]
        tied.append([*rope, *joints])
        space.add(*tied[-1])

    def untie(turn: int):
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
    return {FIRST[1]: first, "second world, first step": second, "copy, first step": copied, **timed(acts, engine.frame, rounds)}


def newtons(n: int, rounds: int) -> dict[str, float]:
    """Return the times of edits by newton.

    Its models are fixed, except the contents of their arrays: adding or removing particles or springs needs a new model. Pinned
    particles have mass 0. Discs are balls in a plane.
    """
    from .peers import Newton

    particles, features, _ = pile(n)

    def built():
        """Return the pile in newton, after its first frame."""
        engine = Newton(particles, features, 1, (8, 2))
        engine.frame()
        return engine

    clock = perf_counter()
    engine = built()
    first = perf_counter() - clock
    clock = perf_counter()
    engine.frame()
    usual = perf_counter() - clock
    clock = perf_counter()
    built()
    again = perf_counter() - clock
    clock = perf_counter()
    other = engine.model.state()
    other.assign(engine.now)
    engine.now = other
    engine.frame()
    copied = perf_counter() - clock
    inverse, held = engine.model.particle_inv_mass.numpy(), [0, 0.0]  # the array is shared, not copied, on a CPU

    def hold(k: int):
        """Give another particle infinite mass, and the last one its own mass again."""
        inverse[held[0]] = held[1] or inverse[held[0]]
        held[:] = n // 2 + k, float(inverse[n // 2 + k])
        inverse[held[0]] = 0.0

    pinned, times = [], []
    for k in range(3):
        clock = thread_time()
        engine.frame()
        times.append(thread_time() - clock)
        clock = thread_time()
        hold(k)
        engine.frame()
        pinned.append(thread_time() - clock)
    edits = {act: again - usual for act in AIMS if act.startswith(("add", "remove"))}
    edits["pin another particle"] = max(0.0, median(pinned) - median(times))
    return {FIRST[1]: first, "second world, first step": again, "copy, first step": copied, **edits}
