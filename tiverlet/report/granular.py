"""Many bodies in contact against what is known of them: piles, gases, packings. `python -m tiverlet.report.granular`."""

import argparse
from time import process_time

import numpy as np
from rich.console import Console
from rich.table import Table

from .. import measure, tools
from ..constraints import Box, Contact
from ..forces import Drag, Gravity
from ..particles import Particles
from ..world import World


def volume(radius: np.ndarray, dim: int) -> float:
    """Of discs [m^2] or spheres [m^3] together."""
    return float((np.pi * radius**2 if dim == 2 else 4 / 3 * np.pi * radius**3).sum())


def lattice(n: int, dim: int, size: float) -> np.ndarray:
    """n points of a square or cubic lattice that fills a box of this size [m]."""
    m = int(np.ceil(n ** (1 / dim) - 1e-9))
    return (np.stack(np.meshgrid(*[np.arange(m)] * dim, indexing="ij"), -1).reshape(-1, dim)[:n] + 0.5) * (size / m)


def pile(n: int, dim: int, substeps: int, frames: int = 120) -> dict[str, float]:
    """Equal discs or spheres, dropped from a loose lattice into a box 1.3 times as wide and twice as high.

    Returns the mean overlap in diameters, the kinetic energy per particle in m g r, and the median time of a frame [s].
    """
    side = int(np.ceil(n ** (1 / dim) - 1e-9))
    x = lattice(side**dim, dim, 1.1 * side)[:, ::-1] if dim == 2 else lattice(side**dim, dim, 1.1 * side)[:, [1, 2, 0]]
    x = x[:n] + 0.05 * tools.golden(np.arange(n), dim)
    wide = [1.3 * side] * dim
    wide[1] = 2 * side
    features = [Gravity(9.81), Box([0] * dim, wide), Contact()]
    with World(Particles(x, radius=0.5), features, substeps=substeps) as world:
        times = []
        for _ in range(frames):
            before = process_time()
            world.step(1 / 60)
            times.append(process_time() - before)
        energy = measure.kinetic_energy(world) / n / (9.81 * 0.5)
        overlap = world.contacts.overlap
        return {"overlap": float(overlap.mean()), "energy": energy, "seconds": float(np.median(times))}


def gas(n: int, dim: int, fraction: float, h: float, seconds: float) -> dict[str, float]:
    """Elastic discs or spheres of thermal speed 1 m/s and radius 0.5 m in an elastic box, from a lattice.

    Returns the pressure on the walls over that of Henderson (1975) or Carnahan and Starling (1969) at the density in the middle,
    the speed moment <v^4> / <v^2>^2 over Maxwell's, and the energy over that of the start.
    """
    r = 0.5
    size = (volume(np.full(n, r), dim) / fraction) ** (1 / dim)
    x = lattice(n, dim, size - 2 * r) + r
    v = np.random.default_rng(0).normal(size=(n, dim))
    v -= v.mean(axis=0)
    v /= np.sqrt((v**2).mean())
    features = [Contact(restitution=1.0), Box([0] * dim, [size] * dim, restitution=1.0)]
    with World(Particles(x, velocity=v, radius=r), features, substeps=1) as world:
        start, blows, density, moment = measure.kinetic_energy(world), 0.0, [], []
        warm, steps = round(2 / h), round(seconds / h)
        for k in range(steps):
            # What would cross a wall in this step is thrown back: twice its momentum.
            crosses = ((x + v * h < r) & (v < 0)) | ((x + v * h > size - r) & (v > 0))
            blows += 2 * float(np.abs(v[crosses]).sum()) if k >= warm else 0.0
            if k >= warm and k % 50 == 0:
                density.append(float((np.abs(x - size / 2) < size / 4).all(axis=1).sum()) / (size / 2) ** dim)
                square = (v**2).sum(axis=1)
                moment.append(float((square**2).mean() / square.mean() ** 2))
            world.step(h)
            x, v = world.position, world.velocity
        inside = float(np.mean(density))
        p = inside * volume(np.array([r]), dim)
        state = (1 + p**2 / 8) / (1 - p) ** 2 if dim == 2 else (1 + p + p**2 - p**3) / (1 - p) ** 3
        pressure = blows / ((steps - warm) * h) / (2 * dim * size ** (dim - 1))
        return {
            "pressure": pressure / (inside * float((v**2).mean()) * state),
            "moment": float(np.mean(moment)) / (2.0 if dim == 2 else 5 / 3),
            "energy": measure.kinetic_energy(world) / start,
        }


def packing(n: int, dim: int, speed: float) -> dict[str, float]:
    """Frictionless discs (half of them 1.4 times as large) or equal spheres, between walls that close in at `speed` [m/s].

    Ends when they bear a load, at 2 dim contacts per particle on average, as an isostatic packing has.
    Returns the packing fraction in the middle, away from the walls, less what they overlap.
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
        # The share of points in the middle that a particle covers.
        points = (tools.golden(np.arange(40_000), dim) - 0.5) * 0.6 * (size - 2 * low) + size / 2
        near = world.near(points, np.full(len(points), radius.max()))
        distance = np.linalg.norm(world.position[near[:, 1]] - points[near[:, 0]], axis=1)
        covered = np.unique(near[distance < radius[near[:, 1]], 0])
        overlap = world.contacts.overlap.mean() / (2 * radius.mean())
        return {"fraction": len(covered) / len(points) * (1 - overlap) ** dim, "overlap": float(overlap)}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tiverlet.report.granular", description=__doc__)
    parser.add_argument("--particles", type=int, default=10_000, help="of the piles (default 10000)")
    parser.add_argument("--quick", action="store_true", help="piles only")
    given = parser.parse_args()
    console = Console()
    table = Table(
        "dim", "substeps", "mean overlap (% d)", "kinetic energy (m g r)", "ms per frame", title="Piles after 120 frames"
    )
    for dim in (2, 3):
        for substeps in (4, 8, 20):
            figures = pile(given.particles, dim, substeps)
            row = f"{100 * figures['overlap']:.3f}", f"{figures['energy']:.3g}", f"{1e3 * figures['seconds']:.2f}"
            table.add_row(str(dim), str(substeps), *row)
    console.print(table)
    if given.quick:
        return
    table = Table("scene", "pressure / known", "<v^4>/<v^2>^2 / Maxwell", "energy kept", title="Elastic gases, 4096 particles")
    for dim, fraction in ((2, 0.1), (2, 0.3), (2, 0.5), (3, 0.1), (3, 0.2), (3, 0.3)):
        figures = gas(4096, dim, fraction, 0.003, 40.0)
        table.add_row(f"{dim}D, {fraction}", *(f"{figures[k]:.4f}" for k in ("pressure", "moment", "energy")))
    console.print(table)
    table = Table("dim", "packing fraction", "known", "mean overlap (% d)", title="Jammed packings, 2000 particles")
    for dim, known, speed in ((2, "0.842", 0.1), (3, "0.64", 0.05)):
        figures = packing(2000, dim, speed)
        table.add_row(str(dim), f"{figures['fraction']:.4f}", known, f"{100 * figures['overlap']:.3f}")
    console.print(table)


if __name__ == "__main__":
    main()
