"""Piles of discs, and of boxes, that fall into a box, beside Box2D v3 and pymunk: CPU time and overlap.

All engines of a scene are in one process, on one thread, and take turns, TURN frames each. None lets bodies sleep.
"""

import time
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from itertools import combinations
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.measure import overlapping
from tiverlet.report.output import Table

G, FRAME, FRICTION, TURN = 9.81, 1 / 60, 0.3, 10
HEADS = ("engine", "steps of a frame", "ms a frame", "at rest", "worst frame", "overlap", "worst", "fastest [m/s]")
NOTES = [
    "CPU time of a frame: the mean of 900, the median of the last hundred, and the most beyond the first ten. Overlap at the "
    "end, mean and worst: of discs in radii of the smaller one, of corners in other boxes in half edges. Radii of 0.36 to 1 m, "
    "edges of 0.5 to 1 m: Box2D lets bodies of any size overlap by 5 mm. pymunk: 10 iterations in each step."
]
FRAMES = 900
SIZES = {"discs": (400, 4000), "equal discs": (400,), "boxes": (100,), "towers": (20,)}


class Scene:
    """Bodies above a floor of a width [m], between walls. Discs: places (n, 2) and radii (n,). Boxes: corners (n, 4, 2)."""

    def __init__(self, name: str, n: int):
        rng, side, self.discs = np.random.default_rng(0), int(np.ceil(np.sqrt(n))), "discs" in name
        at, self.radius, self.corners = np.stack([np.arange(n) % side, np.arange(n) // side], axis=1), np.zeros(0), np.zeros(0)
        if self.discs:
            self.radius = rng.uniform(0.36, 1.0, n) if name == "discs" else np.full(n, 1.0)
            self.x, self.width = 2.1 * at + 2 + rng.uniform(-0.1, 0.1, (n, 2)), 2.2 * side + 2
            return
        square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        if name == "towers":
            self.corners = np.array([square + [3 * k + 1.5, 0.5 + j] for k in range(n) for j in range(8)])
            self.width = 3.0 * n
        else:
            a, size = rng.uniform(-0.3, 0.3, n), rng.uniform(0.5, 1.0, (n, 1, 2))
            turn = np.moveaxis(np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]), 2, 0)
            self.corners, self.width = (square * size) @ turn + (at * [1.5, 1.4] + 0.9)[:, None], 1.5 * side + 0.5
        self.x = self.corners.mean(axis=1)

    @property
    def walls(self) -> list[tuple[tuple[float, float], tuple[float, float]]]:
        """The ends of the floor and of the two walls."""
        return [((0, 0), (self.width, 0)), ((0, 0), (0, 1000)), ((self.width, 0), (self.width, 1000))]

    def outline(self, k: int) -> list[tuple[float, ...]]:
        """Return the corners of box k relative to its place."""
        return [tuple(map(float, c)) for c in self.corners[k] - self.x[k]]

    def overlaps(self, x: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Return by how much bodies overlap at places x (n, 2), and turned by angles (n,), see NOTES."""
        if self.discs:
            pairs, depth = overlapping(x, self.radius)
            return depth / self.radius[pairs].min(axis=1, initial=np.inf)
        c, s = np.cos(angle), np.sin(angle)
        shape = self.corners - self.x[:, None]
        turned = np.einsum("nij,nkj->nki", np.moveaxis(np.array([[c, -s], [s, c]]), 2, 0), shape) + x[:, None]
        out = []
        for i, j in combinations(range(len(x)), 2):
            if np.hypot(*(x[i] - x[j])) < 1.5:
                for a, b in ((turned[i], turned[j]), (turned[j], turned[i])):
                    edge = np.roll(b, -1, axis=0) - b
                    n = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.hypot(*edge.T)[:, None]
                    inside = -((a[:, None] - b) * n).sum(axis=2).max(axis=1)  # of each corner of a
                    out += [d / (np.hypot(*edge.T).min() / 2) for d in inside if d > 0]
        return np.array(out)


class Tiverlet:
    """The scene in tiverlet."""

    def __init__(self, scene: Scene, steps: int):
        self.scene, floor = scene, tv.Box((0, 0), (scene.width, 1000), friction=FRICTION)
        if scene.discs:
            start, contact = tv.Particles(scene.x, radius=scene.radius, spin=True), [tv.Contact(friction=FRICTION)]
        else:
            start, loops = tv.Particles(scene.corners.reshape(-1, 2)), np.arange(4 * len(scene.x)).reshape(-1, 4)
            contact = [tv.Polygons(loops, friction=FRICTION), tv.ShapeMatch(loops)]
        self.world = tv.World(start, [tv.Gravity(G), floor, *contact], substeps=steps)

    def step(self) -> None:
        self.world.step(FRAME)

    def state(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return places (n, 2), angles (n,), and the largest speed [m/s]."""
        x, fastest = self.world.position, float(np.hypot(*self.world.velocity.T).max())
        if self.scene.discs:
            return x, np.zeros(len(x)), fastest
        x = x.reshape(-1, 4, 2)
        was, now = self.scene.corners[:, 2] - self.scene.corners[:, 0], x[:, 2] - x[:, 0]
        return x.mean(axis=1), np.arctan2(now[:, 1], now[:, 0]) - np.arctan2(was[:, 1], was[:, 0]), fastest


class Box2D:
    """The scene in Box2D v3."""

    def __init__(self, scene: Scene, steps: int):
        b2: Any = import_module("pyb2d3")
        self.world, self.steps = b2.World(gravity=(0, -G)), steps
        self.world.sleeping_enabled = False
        law = b2.shape_def(density=1.0, material=b2.surface_material(friction=FRICTION))
        ground = self.world.create_static_body(position=(0, 0))
        for a, b in scene.walls:
            ground.create_shape(law, b2.segment(a, b))
        self.bodies = [self.world.create_dynamic_body(position=tuple(map(float, x))) for x in scene.x]
        for k, body in enumerate(self.bodies):
            if scene.discs:
                body.create_shape(law, b2.circle((0, 0), float(scene.radius[k])))
            else:
                body.create_shape(law, b2.polygon(scene.outline(k)))

    def step(self) -> None:
        self.world.step(FRAME, self.steps)

    def state(self) -> tuple[np.ndarray, np.ndarray, float]:
        v = np.array([list(b.linear_velocity) for b in self.bodies])
        return (
            np.array([list(b.position) for b in self.bodies]),
            np.array([b.angle for b in self.bodies], dtype=float),
            float(np.hypot(*v.T).max()),
        )


class Pymunk:
    """The scene in pymunk."""

    def __init__(self, scene: Scene, steps: int):
        pymunk: Any = import_module("pymunk")
        self.space, self.steps = pymunk.Space(), steps
        self.space.gravity, self.space.iterations = (0, -G), 10
        shapes: list[Any] = [pymunk.Segment(self.space.static_body, a, b, 0) for a, b in scene.walls]
        self.bodies = [pymunk.Body() for _ in scene.x]
        for k, body in enumerate(self.bodies):
            body.position = tuple(map(float, scene.x[k]))
            if scene.discs:
                shapes.append(pymunk.Circle(body, float(scene.radius[k])))
            else:
                shapes.append(pymunk.Poly(body, scene.outline(k)))
        for shape in shapes:
            shape.friction, shape.density = FRICTION**0.5, 1.0  # pymunk multiplies those of the two
        self.space.add(*self.bodies, *shapes)

    def step(self) -> None:
        for _ in range(self.steps):
            self.space.step(FRAME / self.steps)

    def state(self) -> tuple[np.ndarray, np.ndarray, float]:
        x, angle = np.array([b.position for b in self.bodies]), np.array([b.angle for b in self.bodies])
        return x, angle, max(b.velocity.length for b in self.bodies)


ENGINES = ((Tiverlet, 1, ""), (Tiverlet, 2, ""), (Tiverlet, 4, ""), (Box2D, 4, "pyb2d3"), (Pymunk, 4, "pymunk"))


def main(args) -> Iterator[Table]:
    """Yield a table for each scene, and one of all."""
    tv.init(threads=1)
    short: dict[tuple[str, str], list[str]] = {}
    titles: list[str] = []
    notes = [*NOTES, *(f"Left out: {need}, since it is not installed." for *_, need in ENGINES if need and not find_spec(need))]
    for name, sizes in SIZES.items():
        if name in (args.parts or SIZES):
            for n in args.sizes or (sizes[:1] if args.quick else sizes):
                titles.append(f"{name.capitalize()}, {n}")
                some = list(rows(name, n, 60 if args.quick else FRAMES))
                for engine, steps, ms, rest, _, _, worst, _ in some:
                    short.setdefault((engine, steps), []).append(f"{float(ms):.2g}, {float(rest):.2g}; {float(worst):.1g}")
                yield Table(titles[-1], HEADS, some, notes)
    shown = [(f"{engine}, {steps} step{'s' * (steps != '1')}", *found) for (engine, steps), found in short.items()]
    yield Table("Milliseconds a frame, of all and at rest; worst overlap", ("engine", *titles), shown)


def rows(name: str, n: int, frames: int) -> Iterator[tuple]:
    """Yield a row for each engine that is installed."""
    scene = Scene(name, n)
    some = [(kind(scene, steps), steps, []) for kind, steps, need in ENGINES if not need or find_spec(need)]
    for k in range(frames // TURN):
        for engine, _, times in some if k % 2 else some[::-1]:
            for _ in range(TURN):
                begin = time.process_time()
                engine.step()
                times.append(1e3 * (time.process_time() - begin))
    for engine, steps, times in some:
        x, angle, fastest = engine.state()
        found = np.append(scene.overlaps(x, angle), 0.0)
        yield (
            type(engine).__name__.lower(), str(steps), f"{np.mean(times[10:]):.3f}", f"{np.median(times[-100:]):.3f}",
            f"{max(times[10:]):.1f}", f"{found.mean():.1e}", f"{found.max():.1e}", f"{fastest:.0e}",
        )  # fmt: skip
