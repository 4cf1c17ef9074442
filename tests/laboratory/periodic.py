"""Gases and shear flows in periodic boxes compared with known results."""

from collections.abc import Iterator

import numpy as np

from tiverlet import Contact, Particles, Periodic, World
from tiverlet.features.feature import Feature
from tiverlet.report.output import Table

from .granular import compressibility, lattice, thermal, volume
from .results import mean_and_error

GASES = ((2, 0.1), (2, 0.3), (2, 0.5), (3, 0.1), (3, 0.2), (3, 0.3))  # dim, fraction
SHELL = 0.05  # [diameters] width of the first shell of the radial distribution
BLOCKS = 12  # of a run, for error bars


def gas(n: int, dim: int, fraction: float, contact: Feature, seed: int = 0, shear: float = 0.0) -> tuple[World, Periodic]:
    """Build n discs or spheres of diameter and mass 1 on a lattice in a periodic box. Returns the world and the box.

    Velocities have a mean square of 1 per axis. Their sum is 0, so only n - 1 of them are free, and kT = n / (n - 1).
    """
    size = (volume(np.full(n, 0.5), dim) / fraction) ** (1 / dim)
    x, v, box = lattice(n, dim, size), thermal(n, dim, seed), Periodic([0] * dim, [size] * dim, shear=shear)
    v[:, 0] += shear * (x[:, 1] - size / 2)
    return World(Particles(x, velocity=v, radius=0.5), [contact, box], substeps=1, precision="f64"), box


def contact_value(fraction: float, dim: int) -> float:
    """Return the radial distribution g at contact, from Z = 1 + 2 phi g in 2D and 1 + 4 phi g in 3D."""
    return (compressibility(fraction, dim) - 1) / (2 * fraction if dim == 2 else 4 * fraction)


def diffusion(fraction: float, dim: int) -> float:
    """Return the diffusion constant of hard discs or spheres of diameter, mass and kT of 1.

    By Enskog's theory in the first approximation: Boltzmann's value, 1 / (2 rho sqrt(pi)) in 2D and 3 / (8 rho sqrt(pi)) in 3D,
    over g at contact.
    """
    density = fraction / volume(np.array([0.5]), dim)
    return (1 / 2 if dim == 2 else 3 / 8) / (density * np.sqrt(np.pi) * contact_value(fraction, dim))


def virial(n: int, dim: int, fraction: float, h: float, seconds: float) -> dict[str, float]:
    """Run an elastic gas in equilibrium and measure pressure, radial distribution at contact and diffusion.

    seconds: the duration, or multiples of D m / kT if that is longer. h: the substep [s]. Returns the measured values over the
    known ones, with standard errors, the relative gain of energy, and the gain of momentum.

    pressure: from the virial, P V = N kT + sum J / (dim t) over all impulses J of pairs, from world.contacts.
    g: pairs in the shell of SHELL diameters beyond contact, extrapolated to contact with the shell behind it.
    D: d <x^2> / dt / (2 dim) of unwrapped positions, between 3 and 6 times D m / kT, when velocities are no longer correlated. It
    exceeds Enskog's because of long-time tails, which these times cut off, more so in dense gases (Alder, Gass and Wainwright
    1970).
    """
    world, box = gas(n, dim, fraction, Contact(restitution=1.0))
    known_d = diffusion(fraction, dim)
    steps = round(seconds * max(1.0, known_d) / h)
    warm = steps // 5
    each = (steps - warm) // BLOCKS
    late = 4 * max(1, round(3 * known_d / h / 4))
    shells = [volume(np.array([1 + k * SHELL]), dim) for k in range(3)]
    density = fraction / volume(np.array([0.5]), dim)
    with world:
        world.step(h)
        start = world.velocity
        energy, momentum = (start**2).sum() / 2, start.sum(axis=0)
        pressures, contacts, spreads = [], [], []
        work, pairs, looks, trail = 0.0, np.zeros(2), 0, []
        for k in range(warm + BLOCKS * each):
            world.step(h)
            work += float(world.contacts.impulse.sum())
            if k % 10 == 0:
                near = world.near(world.position, np.full(n, 1 + 2 * SHELL))
                r = box.difference(world.position[near[:, 0]], world.position[near[:, 1]])
                r = np.linalg.norm(r[near[:, 0] != near[:, 1]], axis=1)
                pairs += [(r < 1 + SHELL).sum(), (r >= 1 + SHELL).sum()]
                looks += 1
            if k >= warm and (k - warm) % (late // 4) == 0:
                trail.append(world.position)
            if (k + 1 - warm) % each == 0:
                if k >= warm:
                    pressures.append((1 + work / (dim * (n - 1) * each * h)) / compressibility(fraction, dim))
                    g = pairs / looks / (n * density * np.diff(shells))
                    contacts.append((1.5 * g[0] - 0.5 * g[1]) / contact_value(fraction, dim))
                work, pairs, looks = 0.0, np.zeros(2), 0
        path = np.array(trail)
        spread = ((path[8:] - path[:-8]) ** 2).sum(axis=(1, 2)) - ((path[4:-4] - path[:-8]) ** 2).sum(axis=(1, 2))
        spreads = [float(part.mean()) / (n * 2 * dim * late * h) / known_d for part in np.array_split(spread, BLOCKS)]
        end = world.velocity
        out = {"energy": float((end**2).sum() / 2 / energy - 1), "momentum": float(np.abs(end.sum(axis=0) - momentum).max())}
        for name, values in (("pressure", pressures), ("g", contacts), ("D", spreads)):
            out[f"{name} mean"], out[f"{name} error"] = mean_and_error(np.array(values))
        return out


def couette(n: int, shear: float, seconds: float, contact: Contact, layers: int = 10) -> dict[str, float]:
    """Run dissipative discs in a sheared box, and measure the velocity profile and the momentum.

    In layers along y, <v_x> = shear (y - middle). Its fluctuations last for height^2 / (4 pi^2 viscosity), which is long, so the
    standard error is taken over BLOCKS independent runs. Returns the slope over the shear and its standard error, the largest
    deviation of a layer over the speed of the boundary, and the largest drift of the momentum.
    """
    y, profiles, drift = (np.arange(layers) + 0.5) / layers - 0.5, [], 0.0
    for seed in range(BLOCKS):
        world, box = gas(n, 2, 0.6, contact.copy(), seed, shear)
        height, momenta, counts = box.lengths[1], np.zeros(layers), np.zeros(layers)
        with world:
            world.substeps = 4
            before, frames = world.velocity.sum(axis=0), round(seconds * 60)
            for k in range(frames):
                world.step(1 / 60)
                if k >= frames // 4 and k % 6 == 0:
                    x, v, boxes = box.wrap(world.position), world.velocity, box.boxes(world.position)
                    layer = np.minimum((x[:, 1] / height * layers).astype(int), layers - 1)
                    momenta += np.bincount(layer, v[:, 0] - boxes[:, 1] * shear * height, minlength=layers)
                    counts += np.bincount(layer, minlength=layers)
            drift = max(drift, float(np.abs(world.velocity.sum(axis=0) - before).max()))
        profiles.append(momenta / counts / (shear * height))
    slope, error = mean_and_error(np.array(profiles) @ y / (y @ y))
    return {"slope": slope, "error": error, "off": float(np.abs(np.mean(profiles, axis=0) - y).max()), "momentum": drift}


def main(args) -> Iterator[Table]:
    """Yield the tables of gases and of sheared discs."""
    n, seconds = args.sizes[0] if args.sizes else 200 if args.quick else 400, 24.0 if args.quick else 40.0
    rows = []
    for dim, fraction in GASES:
        f = virial(n, dim, fraction, 0.008, seconds)
        told = [f"{f[f'{name} mean']:.4f} +- {f[f'{name} error']:.4f}" for name in ("pressure", "g", "D")]
        rows.append((f"{dim}D, {fraction}", *told, f"{f['energy']:.1e}", f"{f['momentum']:.1e}"))
    heads = ("gas", "pressure / known", "g(contact) / known", "D / Enskog's", "energy gained", "momentum gained")
    yield Table(f"Elastic gases of {n} in periodic boxes", heads, rows)
    rows = []
    for name, contact in (("restitution 0.7", Contact(0.0, 0.7)), ("friction 0.5", Contact(0.5, 0.5))):
        f = couette(n // 4, 0.5, seconds, contact)
        rows.append((name, f"{f['slope']:.4f} +- {f['error']:.4f}", f"{f['off']:.4f}", f"{f['momentum']:.1e}"))
    yield Table("Sheared discs", ("contacts", "slope / shear", "worst layer / speed of the boundary", "momentum gained"), rows)
