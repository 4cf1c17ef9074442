"""Spinning grains compared with known laws: heaps, drums, silos."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tiverlet import Box, Contact, Gravity, HalfSpace, Particles, Polygon, World
from tiverlet.report.output import Table

from . import grain_peers, rolling
from .results import mean_and_error

G, SIZE, SUBSTEPS, FRAME = 9.81, 0.06, 16, 1 / 60  # SIZE: d, the mean diameter of grains [m]
FRICTIONS, ROLLINGS = (0.1, 0.3, 0.5, 1.0), (0.0, 0.05, 0.1, 0.2)
DENSITY = 1000.0  # [kg/m^2], [kg/m^3]


def loose(n: int, widths: Sequence[float], seed: int, low: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n, dim) [m] and radii of n grains of 0.8 to 1.2 of SIZE, placed loosely above `low`.

    widths: of the box, one in 2D, two in 3D; walls are at 0 and at the widths [m]. Each layer is shifted against the one below,
    because columns of grains that do not spin would stand for ever.
    """
    rng = np.random.default_rng(seed)
    radius = SIZE / 2 * rng.permutation(0.8 + 0.4 * (np.arange(n) + 0.5) / n)
    pitch = 1.22 * SIZE
    rows = [int(w / pitch - 0.5) for w in widths]
    layer = np.arange(n) // np.prod(rows)
    k, x = np.arange(n), np.empty((n, len(widths) + 1))
    for axis, row, width in zip((0, -1), rows, widths, strict=False):
        x[:, axis] = (k % row + 0.5 + 0.5 * (layer % 2)) * (width / (row + 0.5))
        k = k // row
    x[:, 1] = low + pitch * (layer + 0.6)
    return x + rng.uniform(-0.01, 0.01, x.shape) * SIZE, radius


def particles(x: np.ndarray, radius: np.ndarray, fixed: np.ndarray, size: float, spins: bool = True) -> Particles:
    """Return grains at x in group 0, and pinned particles of radius `size` at `fixed` in group 1. spins: whether grains spin."""
    n, m, dim = len(x), len(fixed), x.shape[1]
    mass = DENSITY * (np.pi * radius**2 if dim == 2 else 4 / 3 * np.pi * radius**3)
    return Particles(
        np.concatenate([x, fixed]), radius=np.r_[radius, np.full(m, size)], mass=np.r_[mass, np.ones(m)],
        pinned=np.arange(n, n + m), group=np.r_[np.zeros(n, int), np.ones(m, int)], spin=0 if spins else None,
    )  # fmt: skip


class Heap:
    """A heap on a rough base that extends `half` diameters to all sides. Walls at its edges move out, and grains flow off.

    Grains are discs, or spheres on a square base, whose heap is a pyramid. At a distance s from the nearest edge, the surface is
    s tan(angle) high.
    """

    def __init__(self, n: int, half: float, dim: int, seed: int, spins: bool = True):
        self.n, self.dim, self.half, self.spins = n, dim, half * SIZE, spins
        x, radius = loose(n, [2 * self.half] * (dim - 1), seed)
        flat = [0] if dim == 2 else [0, 2]
        x[:, flat] -= self.half
        line = np.linspace(-self.half, self.half, round(4 * half if dim == 2 else 8 / 3 * half) + 1)
        corners = np.stack(np.meshgrid(*[line] * (dim - 1), indexing="ij"), -1).reshape(-1, dim - 1)
        fixed = np.zeros((len(corners), dim))
        fixed[:, flat] = corners
        fixed[:, 1] = -SIZE / 2
        self.flat, self.start = flat, particles(x, radius, fixed, SIZE / 2, spins)
        self.box, self.contact = Box(*self.walls(self.half)), Contact(friction=self.friction_argument(0.5, 0.0))
        self.floor = HalfSpace(np.eye(dim)[1], -1.2, friction=self.friction_argument(0.5, 0.1))
        self.world = World(self.start, [Gravity(G), self.contact, self.box, self.floor], substeps=SUBSTEPS)

    def friction_argument(self, friction: float, resistance: float):
        """Return the friction argument: with rolling resistance if the grains spin."""
        return (friction, friction, resistance) if self.spins else friction

    def walls(self, half: float) -> tuple[list[float], list[float]]:
        """Return the corners of a box of half width `half` [m] that is open above and below."""
        upper = [half] * self.dim
        upper[1] = np.inf
        return [-u for u in upper], upper

    def pile(self, friction: float, resistance: float, speed: float = 0.15, rest: float = 1.0) -> float:
        """Return the angle of the heap [degrees].

        friction, resistance: of sliding and rolling. speed: of the walls as they move out [m/s]. rest: duration without walls
        [s].
        """
        w, p = self.world, self.start
        w.position, w.velocity = p.position, p.velocity
        if self.spins:
            w.spin = p.spin
        self.contact.friction = self.friction_argument(friction, resistance)
        self.box.lower, self.box.upper = self.walls(self.half)
        w.run(1.0)
        gap = 0.0
        while gap < 6 * SIZE:
            gap += speed * FRAME
            self.box.lower, self.box.upper = self.walls(self.half + gap)
            w.step(FRAME)
        self.box.lower, self.box.upper = self.walls(np.inf)
        w.run(rest)
        return self.angle(w.position[: self.n], p.radius[: self.n])

    def angle(self, x: np.ndarray, radius: np.ndarray) -> float:
        """Return the angle of a line fitted to the flanks [degrees].

        Heights are those of the highest grain in each cell, averaged over cells at the same distance from the edge. The fit goes
        from 1.5 diameters to the distance where the height is 0.8 of the largest. If that leaves too few points, the line goes
        from the edge to there.
        """
        x, top = x[x[:, 1] > 0], (x[:, 1] + radius)[x[:, 1] > 0]
        cells = int(self.half / SIZE)
        at = np.floor((x[:, self.flat] + self.half) / SIZE).astype(int)
        inside = ((at >= 0) & (at < 2 * cells)).all(axis=1)
        height = np.zeros((2 * cells,) * (self.dim - 1))
        np.maximum.at(height, tuple(at[inside].T), top[inside])
        line = cells - np.abs(np.arange(2 * cells) + 0.5 - cells)  # from the edge, in diameters
        away = np.minimum.reduce(np.meshgrid(*[line] * (self.dim - 1), indexing="ij"))
        s = np.unique(away)
        mean = np.array([height[away == value].mean() for value in s])
        end = int(np.argmax(mean >= 0.8 * mean.max())) + 1
        slope = np.polyfit(s[1:end], mean[1:end], 1)[0] if end >= 4 else mean[end - 1] / s[end - 1]
        return float(np.degrees(np.arctan(slope / SIZE)))


def repose(
    n: int, half: float, dim: int, seeds: Sequence[int], settings: Sequence[tuple[float, float]], spins: bool = True
) -> np.ndarray:
    """Return the angles of heaps [degrees], (settings, seeds), for pairs of friction and rolling resistance."""
    out = np.empty((len(settings), len(seeds)))
    for k, seed in enumerate(seeds):
        heap = Heap(n, half, dim, seed, spins)
        with heap.world:
            for i, setting in enumerate(settings):
                out[i, k] = heap.pile(*setting)
    return out


def drum(n: int, friction: float, resistance: float, turn: float = 0.8, seconds: float = 10.0) -> tuple[float, float]:
    """Return the dynamic angle of n discs in a drum [degrees], over the second half of the time, and its standard error.

    The drum has a radius of 1 m. turn: its angular velocity [rad/s]. resistance: to rolling.
    """
    rim = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    grip = (friction, friction, resistance)
    wall = Polygon(np.stack([np.cos(rim), np.sin(rim)], axis=1), inside=True, friction=grip)
    x, radius = loose(n, [1.3], 0, low=-0.7)
    x[:, 0] -= 0.65
    angles = []
    with World(
        particles(x, radius, np.zeros((0, 2)), 0.0), [Gravity(G), Contact(friction=grip), wall], substeps=SUBSTEPS
    ) as world:
        world.run(1.0)
        for frame in range(round(seconds / FRAME)):
            wall.rotation = turn * (frame + 1) * FRAME
            world.step(FRAME)
            middle = world.position.mean(axis=0)
            angles.append(np.degrees(np.arctan2(middle[0], -middle[1])))
    # Avalanches follow each other, so means over a second are nearly independent.
    later = np.array(angles[len(angles) // 2 :])
    blocks = later[: len(later) // 60 * 60].reshape(-1, 60).mean(axis=1)
    return mean_and_error(blocks)


@dataclass(frozen=True)
class Silo:
    """Grains in a silo of `width` [m] on a floor of fixed discs with a radius of a fourth of SIZE.

    The floor has no friction by default.
    """

    n: int
    width: float
    friction: float = 0.5
    wall_friction: float = 0.5
    rolling: float = 0.05
    floor_friction: float = 0.0
    seed: int = 0

    def build(self) -> tuple[World, list[Polygon]]:
        """Return the world and its two walls."""
        floor = np.arange(-self.width / 2, self.width / 2 + 1e-9, SIZE / 2)
        x, radius = loose(self.n, [self.width], self.seed, low=SIZE)
        x[:, 0] -= self.width / 2
        start = particles(x, radius, np.stack([floor, 0 * floor], axis=1), SIZE / 4)
        top = float(x[:, 1].max()) + 1.0
        sides = [-self.width / 2 - 0.1, self.width / 2]
        walls = [
            Polygon(
                np.array([(0, 0), (0.1, 0), (0.1, top), (0, top)]) + (left, -SIZE / 4),
                friction=(self.wall_friction, self.wall_friction, self.rolling),
            )
            for left in sides
        ]  # fmt: skip
        grip = {
            (0, 0): (self.friction, self.friction, self.rolling),
            (0, 1): (self.floor_friction, self.floor_friction, self.rolling),
        }
        ground = HalfSpace((0, 1), -2.5, friction=(0.5, 0.5, 0.0))
        return World(start, [Gravity(G), Contact(friction=grip), *walls, ground], substeps=SUBSTEPS), walls


def pinned_load(world: World) -> float:
    """Return the downward force of grains on pinned particles, along contact normals [N]."""
    found, pinned = world.contacts, world.particles.pinned
    i, j = found.pairs.T
    push = found.impulse * found.normal[:, 1]  # on the first of each pair, upwards
    return float((push[~pinned[i] & pinned[j]].sum() - push[pinned[i] & ~pinned[j]].sum()) / (FRAME / world.substeps))


def janssen(
    silo: Silo, substeps: int = 48, settle: float = 2.0, rise: float = 0.02, seconds: float = 1.5
) -> tuple[float, float, float]:
    """Return the height of the fill H [m], its weight [N] and the load on the floor [N].

    Walls rise at `rise` [m/s], so that wall friction is fully mobilised and holds the grains up. The load is the mean over the
    second half of `seconds`.
    """
    world, walls = silo.build()
    world.substeps = substeps
    with world:
        world.run(settle)
        loads = []
        for frame in range(round(seconds / FRAME)):
            for wall in walls:
                wall.position = (0.0, rise * (frame + 1) * FRAME)
            world.step(FRAME)
            loads.append(pinned_load(world))
        p = world.particles
        free = ~p.pinned
        # The height that the column has at the packing fraction of its lower nine tenths.
        x, area = world.position[free, 1], np.pi * p.radius[free] ** 2
        below = float(np.quantile(x, 0.9))
        height = area.sum() / area[x < below].sum() * below
        return height, float(G * p.mass[free].sum()), float(np.mean(loads[len(loads) // 2 :]))


def saturation(heights: ArrayLike, shares: ArrayLike) -> tuple[float, float]:
    """Return lambda [m] of share = lambda / H (1 - exp(-H / lambda)) by least squares, and the largest difference of a share."""
    h, known = np.asarray(heights), np.asarray(shares)
    tries = np.geomspace(0.02 * h.max(), 50 * h.max(), 4000)[:, None]
    off = tries / h * -np.expm1(-h / tries) - known
    best = int(np.argmin((off**2).sum(axis=1)))
    return float(tries[best, 0]), float(np.abs(off[best]).max())


@dataclass(frozen=True)
class Gate:
    """An opening in the floor of a silo.

    gone: indices of the floor particles to remove. width: D [m], between the surfaces of the remaining ones.
    """

    gone: np.ndarray
    width: float

    @classmethod
    def of(cls, p: Particles, opening: float) -> "Gate":
        """Return the opening of `opening` diameters, or a little more."""
        edge = np.abs(p.position[:, 0]) - p.radius
        inside = edge < (opening / 2 - 0.01) * SIZE
        return cls(np.flatnonzero(p.pinned & inside), float(2 * edge[p.pinned & ~inside].min()))


def packed(silo: Silo, p: Particles, x: np.ndarray) -> float:
    """Return the packing fraction of grains settled at x, away from walls and surface."""
    free = ~p.pinned
    low, top = 3 * SIZE, float(np.quantile(x[free, 1], 0.85))
    bulk = free & (x[:, 1] > low) & (x[:, 1] < top) & (np.abs(x[:, 0]) < 0.4 * silo.width)
    return float((np.pi * p.radius[bulk] ** 2).sum() / ((top - low) * 0.8 * silo.width))


def steady(silo: Silo, gate: Gate, out: Sequence[float], fraction: float, least: float) -> dict[str, float]:
    """Return the results of flow() from the area that has flowed out after each frame [m^2]."""
    area = np.asarray(out)
    total = silo.n * np.pi / 4 * SIZE**2 * (1 + 0.04 / 3)  # area of diameters from 0.8 to 1.2
    fill = (total - area) / (fraction * silo.width * SIZE)
    end = int(np.argmax(fill < least)) if (fill < least).any() else len(fill)
    counts = np.arange(round(0.4 / FRAME), end)
    halves = np.array_split(counts, 2)
    rate, first, second = (float(np.polyfit(FRAME * part, area[part], 1)[0]) for part in (counts, *halves))
    unit = fraction * np.sqrt(G) * SIZE**1.5
    fills = [float(fill[half].mean()) for half in halves]
    found = {"opening": gate.width / SIZE, "rate": float(rate / unit), "ratio": second / first}
    return found | {"first": fills[0], "second": fills[1]}


def flow(silo: Silo, opening: float, seconds: float, settle: float = 2.0, least: float = 10.0) -> dict[str, float]:
    """Let grains flow out of an opening of that many diameters, or a little more, until the fill is `least` diameters high.

    Returns by name: opening, D in diameters between the surfaces of the remaining floor; rate, W in units of rho sqrt(g) d^1.5,
    where rho is the density of the bulk; ratio, W in the second half of the time over W in the first; first and second, the mean
    heights of the fill in both halves, in diameters.
    """
    world, _walls = silo.build()
    with world:
        world.run(settle)
        p = world.particles
        fraction, gate = packed(silo, p, world.position), Gate.of(p, opening)
        area = np.delete(np.where(p.pinned, 0, np.pi * p.radius**2), gate.gone)
        world.remove(gate.gone)
        out = []
        for _ in range(round(seconds / FRAME)):
            world.step(FRAME)
            out.append(float(area[world.position[:, 1] < -SIZE].sum()))
            if area.sum() - out[-1] < least * SIZE * fraction * silo.width:
                break
        return steady(silo, gate, out, fraction, least)


def flow_in_lammps(
    silo: Silo, opening: float, seconds: float, pythons: Sequence[str], settle: float = 2.0, least: float = 10.0
) -> dict[str, float] | str:
    """Return the results of flow() by LAMMPS from the same start, without rolling resistance, or why there are none."""
    world, _walls = silo.build()
    world.close()
    p = world.particles
    gate = Gate.of(p, opening)
    job = {
        "x": p.position.tolist(), "radius": p.radius.tolist(), "mass": p.mass.tolist(), "grains": silo.n, "width": silo.width,
        "size": SIZE, "friction": silo.friction, "gravity": G, "frame": FRAME, "frames": round(seconds / FRAME), "settle": settle,
        "gone": gate.gone.tolist(),
    }  # fmt: skip
    answer = rolling.run_engine(grain_peers.SILO, pythons, [job])
    if isinstance(answer, str):
        return answer
    return steady(silo, gate, answer[0]["out"], packed(silo, p, np.array(answer[0]["settled"])), least)


def beverloo(openings: ArrayLike, rates: ArrayLike) -> tuple[float, float, float]:
    """Return C and k of W = C (D - k)^1.5, from a line fitted to W^(2/3), and R^2 of the fit."""
    d, root = np.asarray(openings), np.asarray(rates) ** (2 / 3)
    slope, begin = np.polyfit(d, root, 1)
    rest = root - (slope * d + begin)
    return float(slope**1.5), float(-begin / slope), float(1 - rest @ rest / ((root - root.mean()) ** 2).sum())


def with_error(values: np.ndarray) -> str:
    """Return the mean of values and its standard error as text."""
    return "{:.1f} +- {:.1f}".format(*mean_and_error(values))


def heaps(n: int, half: float, dim: int, seeds: Sequence[int], rollings: Sequence[float], skaters: bool) -> Table:
    """Return the table of angles of repose. skaters: also measure grains that do not spin."""
    rows = []
    for name, resistance, spins in [(str(r), r, True) for r in rollings] + [("do not spin", 0.0, False)] * skaters:
        angles = repose(n, half, dim, seeds, [(friction, resistance) for friction in FRICTIONS], spins)
        rows.append((name, *map(with_error, angles)))
    title = f"Angle of repose (degrees) of {n} {'discs' if dim == 2 else 'spheres'}, by friction"
    return Table(title, ("rolling", *map(str, FRICTIONS)), rows)


def drums(seconds: float) -> Table:
    """Return the table of dynamic angles of drums."""
    found = [(str(resistance), *drum(420, 0.6, resistance, seconds=seconds)) for resistance in ROLLINGS]
    rows = [(name, f"{angle:.1f} +- {error:.1f}") for name, angle, error in found]
    return Table("Drum of 420 discs, friction 0.6, 0.8 rad/s", ("rolling", "angle (degrees)"), rows)


def silos(counts: Sequence[int]) -> Table:
    """Return the table of loads on the floor of silos, at several heights H. counts: numbers of grains."""
    rows, notes = [], []
    for friction in (0.0, 0.25, 0.5):
        found = np.array([janssen(Silo(n, 10 * SIZE, wall_friction=friction)) for n in counts])
        heights, shares = found[:, 0] / (10 * SIZE), found[:, 2] / found[:, 1]
        if not rows:
            rows.append(("H / width", *(f"{height:.2f}" for height in heights)))
        rows.append((f"wall {friction}", *(f"{share:.3f}" for share in shares)))
        if friction:
            length, off = saturation(heights, shares)
            k = 1 / (2 * friction * length)
            notes.append(f"wall {friction}: lambda {length:.2f} w, K = w / (2 mu lambda) = {k:.2f}, within {off:.2f}")
    title = "Load on the floor over the weight, silo of 10 diameters, friction 0.5 between grains"
    return Table(title, ("grains", *map(str, counts)), rows, notes)


def flows(n: int, openings: Sequence[float], resistance: float, pythons: Sequence[str]) -> Table:
    """Return the table of rates of flow, with those of LAMMPS if there is no rolling resistance."""
    silo = Silo(n, 30 * SIZE, rolling=resistance, floor_friction=0.5)
    ours = [flow(silo, opening, 8.0) for opening in openings]
    peers = [None if resistance else flow_in_lammps(silo, opening, 8.0, pythons) for opening in openings]
    rows, notes = [], ["W = C rho sqrt(g) (D - k d)^1.5"]
    for row, peer in zip(ours, peers, strict=True):
        other = f"{peer['rate']:.2f}" if isinstance(peer, dict) else peer or ""
        fills = (f"{row['first']:.0f}", f"{row['second']:.0f}", f"{row['ratio']:.2f}")
        rows.append((f"{row['opening']:.1f}", f"{row['rate']:.2f}", *fills, other))
    for name, found in (("tiverlet", ours), ("LAMMPS", [peer for peer in peers if isinstance(peer, dict)])):
        if len(found) > 2:
            c, k, square = beverloo([row["opening"] for row in found], [row["rate"] for row in found])
            notes.append(f"{name}: C = {c:.2f}, k = {k:.2f}, R^2 of W^(2/3) = {square:.4f}")
    heads = "D / d", "W / (rho sqrt(g) d^1.5)", "fill of the first half / d", "of the second", "W then / W first", "W of LAMMPS"
    return Table(f"Flow out of a silo of 30 diameters, {n} discs, friction 0.5, rolling {resistance}", heads, rows, notes)


def main(args) -> Iterator[Table]:
    """Yield the tables."""
    q, openings = args.quick, (5.0, 8.0, 12.0) if args.quick else (5.0, 6.5, 8.0, 10.0, 12.0)
    parts = {
        "heaps": lambda: [heaps(470, 20.0, 2, range(1 if q else 5), ROLLINGS, not q)],
        "pyramids": lambda: [heaps(1600, 9.0, 3, range(1 if q else 2), (0.0, 0.1), False)],
        "drums": lambda: [drums(4.0 if q else 10.0)],
        "silos": lambda: [silos((50, 150, 400) if q else (50, 100, 150, 200, 300, 400, 600))],
        "flows": lambda: [flows(1500, openings, r, (sys.executable, *args.pythons)) for r in (0.0, 0.1)],
    }
    for name in args.parts or parts:
        yield from parts[name]()
