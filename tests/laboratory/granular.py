"""Piles, gases and packings compared with known results."""

import tempfile
from collections.abc import Iterator
from time import perf_counter

import numpy as np

from tiverlet import Box, Contact, Drag, Particles, World, measure, tools
from tiverlet.device import runtime
from tiverlet.report.output import Table

from . import c_baseline, scenes
from .results import mean_and_error

# dim, fraction, time [s]
GASES = ((2, 0.1, 400.0), (2, 0.3, 160.0), (2, 0.5, 80.0), (3, 0.1, 160.0), (3, 0.2, 80.0), (3, 0.3, 80.0))
FRAMES = 120  # of a pile
BEATS = 0.1, 0.05, 0.025  # substeps over the mean time between two collisions


def volume(radius: np.ndarray, dim: int) -> float:
    """Return the total area of discs [m^2] or volume of spheres [m^3]."""
    return float((np.pi * radius**2 if dim == 2 else 4 / 3 * np.pi * radius**3).sum())


def lattice(n: int, dim: int, size: float) -> np.ndarray:
    """Return n points of a square or cubic lattice that fills a box of `size` [m]."""
    m = int(np.ceil(n ** (1 / dim) - 1e-9))
    return (np.stack(np.meshgrid(*[np.arange(m)] * dim, indexing="ij"), -1).reshape(-1, dim)[:n] + 0.5) * (size / m)


def pile(n: int, dim: int, substeps: int) -> dict[str, float]:
    """Drop equal discs or spheres from a loose lattice into a box, as in scenes.py.

    Returns the mean overlap in diameters, the kinetic energy per particle in m g r, and the mean time of a frame [s].
    """
    particles, features = scenes.pile(n, dim)
    with World(particles, features, substeps=substeps) as world:
        world.step(1 / 60)
        before = perf_counter()
        world.run((FRAMES - 1) / 60)
        seconds = (perf_counter() - before) / (FRAMES - 1)
        energy = measure.kinetic_energy(world) / n / (9.81 * 0.5)
        return {"overlap": float(world.contacts.overlap.mean()), "energy": energy, "seconds": seconds}


def pile_in_c(program: str, n: int, substeps: int) -> dict[str, float]:
    """Run the pile of n discs in C on as many threads: mean overlap in diameters and time of a frame [s]."""
    with c_baseline.started(program, n, substeps, runtime.threads()) as talker:
        talker.ask("restart")
        seconds = talker.ask(f"run {FRAMES}") / FRAMES
        return {"overlap": talker.ask("quality")["overlap"], "seconds": seconds}


def compressibility(fraction: float, dim: int) -> float:
    """Return Z = P / (density kT) of hard discs (Henderson 1975) or spheres (Carnahan and Starling 1969), to about 1 %."""
    p = fraction
    return (1 + p**2 / 8) / (1 - p) ** 2 if dim == 2 else (1 + p + p**2 - p**3) / (1 - p) ** 3


def collision_rate(fraction: float, dim: int) -> float:
    """Return the collisions per particle and second, for diameter, mass and kT of 1; it is proportional to Z - 1 (Enskog)."""
    return 2 * dim * (compressibility(fraction, dim) - 1) / np.sqrt(np.pi)


def thermal(n: int, dim: int, seed: int = 0) -> np.ndarray:
    """Return velocities (n, dim) with a mean square of 1 per axis and a sum of 0."""
    v = np.random.default_rng(seed).normal(size=(n, dim))
    v -= v.mean(axis=0)
    return v / np.sqrt((v**2).mean())


def box_of_gas(n: int, dim: int, fraction: float, substeps: int) -> tuple[World, float]:
    """Build n elastic discs or spheres of radius 0.5 m and thermal speed 1 m/s on a lattice in an elastic box.

    Returns the world and the size of the box [m].
    """
    size = (volume(np.full(n, 0.5), dim) / fraction) ** (1 / dim)
    start = Particles(lattice(n, dim, size - 1) + 0.5, velocity=thermal(n, dim), radius=0.5)
    return World(start, [Contact(restitution=1.0), Box([0] * dim, [size] * dim, restitution=1.0)], substeps=substeps), size


def gas(n: int, dim: int, fraction: float, h: float, seconds: float, away: float = 3.0) -> dict[str, float]:
    """Run a gas in a box, and measure pressure and speed moment in the last three quarters of the time.

    Returns the pressure on the walls over the known one, its standard error, and <v^4> / <v^2>^2 over Maxwell's.

    The pressure on a whole wall differs from that of the gas. Balance at the middle plane of a box of side L gives the force
    P L^2 - 4 g L in 3D, where g is the tension of a wall. By scaled particle theory, g = 3 p (2 + p) / (2 pi (1 - p)^2) kT /
    diameter^2 at a fraction p, which is 6 % of P for 4096 spheres. So only impacts on the middle of each wall count, further than
    `away` [m] from the other walls. Density and temperature are those of the bulk, as far from all walls.

    The momentum on a wall follows from x and v alone. With S(t) = sum 2 m |v_k| over all particles that reach the wall within t,
    S(t) / t tends to the momentum per second for t to 0. It falls with t, by 2 % at 8 ms and p = 0.3, because some particles are
    struck on their way. 2 S(h) / h - S(2 h) / (2 h) removes that to second order.
    """
    world, size = box_of_gas(n, dim, fraction, 1)
    steps = round(seconds / h)
    warm, each = steps // 4, steps // 16
    blocks, blows, bulk, moments = [], 0.0, [], []
    with world:
        for k in range(warm + 12 * each):
            x, v = world.position, world.velocity
            gap, toward = np.minimum(x, size - x) - 0.5, np.where(x < size / 2, -v, v)
            i, axis = np.nonzero(gap < 2 * h * toward)
            inner = gap[i] > away - 0.5
            inner[np.arange(len(i)), axis] = True
            speed = np.where(inner.all(axis=1), toward[i, axis], 0.0)
            blows += 2 * float((speed * (2 * (gap[i, axis] < h * speed) - 0.5)).sum())
            if k % 10 == 0:
                inside = (gap > away - 0.5).all(axis=1)
                square = (v**2).sum(axis=1)
                bulk.append((inside.sum(), square[inside].sum() / dim))
                moments.append((square**2).mean() / square.mean() ** 2)
            if (k + 1 - warm) % each == 0:
                count, energy = np.mean(bulk, axis=0)
                middle = size - 2 * away
                known = energy / middle**dim * compressibility(count / middle**dim * volume(np.array([0.5]), dim), dim)
                blocks.append((blows / (each * h) / (2 * dim * middle ** (dim - 1)) / known, float(np.mean(moments))))
                blows, bulk, moments = 0.0, [], []
            world.step(h)
    pressures, moment = np.array(blocks[-12:]).T
    pressure, error = mean_and_error(pressures)
    return {"pressure": pressure, "error": error, "moment": float(moment.mean()) / (2.0 if dim == 2 else 5 / 3)}


def energies_gained(n: int, dim: int, fraction: float, beats: dict[float, float]) -> list[float]:
    """Return the relative energy that a gas gains, for each of several substeps.

    beats: collisions per particle, by b, the substep over the mean time between two collisions. An impact keeps energy to the
    last digit, and overlap that it leaves is removed from positions only, see Contact. So no energy is gained: in f64 it is kept
    to 1e-15 for b = 1/10. From b = 1/5 on some is lost, when a third particle strikes a pair that has not separated yet, or a
    particle at a wall.
    """
    rate, out = collision_rate(fraction, dim), []
    with box_of_gas(n, dim, fraction, 20)[0] as world:
        for beat, collisions in beats.items():
            world.position, world.velocity = world.particles.position, world.particles.velocity
            start = measure.kinetic_energy(world)
            world.run(collisions / rate, dt=20 * beat / rate)
            out.append(measure.kinetic_energy(world) / start - 1)
    return out


def packing(n: int, dim: int, speed: float) -> dict[str, float]:
    """Compress frictionless discs (half of them 1.4 times as large) or equal spheres by walls that close in at `speed` [m/s].

    Ends at 2 dim contacts per particle on average, as in an isostatic packing. Returns the packing fraction in the middle, away
    from the walls, corrected for overlap, and the mean overlap in mean diameters.
    """
    radius = np.where(np.arange(n) % 2 == 0, 0.5, 0.7) if dim == 2 else np.full(n, 0.5)
    radius = np.random.default_rng(1).permutation(radius)
    total = volume(radius, dim)
    size = (total / (0.6 if dim == 2 else 0.46)) ** (1 / dim)
    x = lattice(n, dim, size)
    v = np.random.default_rng(2).normal(size=x.shape) * 0.5
    box = Box([0] * dim, [size] * dim)
    with World(Particles(x, velocity=v, radius=radius), [Drag(1.0), Contact(), box], substeps=8) as world:
        low, contacts = 0.0, 0.0
        while contacts < 2 * dim:
            low += speed / 120
            box.lower, box.upper = [low] * dim, [size - low] * dim
            report = world.step(1 / 60)
            contacts = 2 * report.contacts / n
            if size - 2 * low < total ** (1 / dim):
                raise RuntimeError("packing: the particles fill more than the box, so contacts were lost.")
        # The fraction is the share of points in the middle that particles cover.
        points = (tools.golden(np.arange(40_000), dim) - 0.5) * 0.6 * (size - 2 * low) + size / 2
        near = world.near(points, np.full(len(points), radius.max()))
        distance = np.linalg.norm(world.position[near[:, 1]] - points[near[:, 0]], axis=1)
        covered = np.unique(near[distance < radius[near[:, 1]], 0])
        overlap = world.contacts.overlap.mean() / (2 * radius.mean())
        return {"fraction": len(covered) / len(points) * (1 - overlap) ** dim, "overlap": float(overlap)}


def piles(n: int) -> Table:
    """Return the table of piles of n discs or spheres, and of the same discs in C."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        program, how = c_baseline.build(folder)
        for dim, substeps in ((d, s) for d in (2, 3) for s in (4, 8, 20)):
            ours, c = pile(n, dim, substeps), pile_in_c(program, n, substeps) if program and dim == 2 else None
            row = [
                str(dim),
                str(substeps),
                f"{100 * ours['overlap']:.3f}",
                f"{ours['energy']:.3g}",
                f"{1e3 * ours['seconds']:.2f}",
            ]
            rows.append(row + ([f"{100 * c['overlap']:.3f}", f"{1e3 * c['seconds']:.2f}"] if c else ["", ""]))
    heads = ("dim", "substeps", "mean overlap (% d)", "kinetic energy (m g r)", "ms per frame", "C: overlap", "C: ms per frame")
    return Table(f"Piles of {n} after {FRAMES} frames", heads, rows, [f"C: {how}, {runtime.threads()} threads"])


def gases(n: int, share: float) -> Table:
    """Return the table of pressures and speeds of elastic gases of n. share: of the full duration."""
    rows = []
    for dim, fraction, seconds in GASES:
        f = gas(n, dim, fraction, 0.008, share * seconds)
        rows.append((f"{dim}D, {fraction}", f"{f['pressure']:.4f} +- {f['error']:.4f}", f"{f['moment']:.4f}"))
    return Table(f"Elastic gases, {n} particles", ("scene", "pressure / known", "<v^4>/<v^2>^2 / Maxwell"), rows)


def energies(n: int, collisions: float) -> Table:
    """Return the table of energies that gases of n gain in so many collisions of each particle."""
    rows = []
    for dim, fraction in ((2, 0.3), (2, 0.5), (3, 0.2), (3, 0.3)):
        gains = energies_gained(n, dim, fraction, dict.fromkeys(BEATS, collisions))
        rows.append((f"{dim}D, {fraction}", *(f"{100 * gain:.3g}" for gain in gains)))
    title = f"Energy gained by elastic gases, {n} particles, in {collisions:g} collisions of each (%)"
    return Table(title, ("scene", *(f"{beat} of the time between two" for beat in BEATS)), rows)


def packings(n: int) -> Table:
    """Return the table of jammed packings of n."""
    rows = []
    for dim, known, speed in ((2, "0.842", 0.1), (3, "0.64", 0.05)):
        f = packing(n, dim, speed)
        rows.append((str(dim), f"{f['fraction']:.4f}", known, f"{100 * f['overlap']:.3f}"))
    return Table(f"Jammed packings, {n} particles", ("dim", "packing fraction", "known", "mean overlap (% d)"), rows)


def main(args) -> Iterator[Table]:
    """Yield the tables."""
    n, q = args.sizes[0] if args.sizes else 0, args.quick
    parts = {
        "piles": lambda: piles(n or (1000 if q else 10_000)),
        "gases": lambda: gases(n or (500 if q else 4096), 0.2 if q else 1.0),
        "energies": lambda: energies(n or (200 if q else 1000), 100.0 if q else 1000.0),
        "packings": lambda: packings(n or (500 if q else 2000)),
    }
    for name in args.parts or parts:
        yield parts[name]()
