"""Two galaxies pass each other and draw out tails, by a force of the user's own between all pairs of stars.

    python demos/galaxy.py [galaxy.rrd]

What to look for: the tides pull a bridge and a long tail out of each disc (Toomre and Toomre 1972), while the cores swing past
each other on their parabola. Energy and momentum stay. The colours are speeds.
"""

import sys
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.device import ti

STARS, CORE, SOFT = 360, 1.0, 0.1  # stars of each galaxy; mass of its core, with G = 1; softening length
mass: Any = None  # masses of all stars, a field that kernels read


@ti.func
def gravity(r, i, j):
    s = r.norm_sqr() + SOFT * SOFT
    return -mass[i] * mass[j] * r / (s * ti.sqrt(s))


@ti.func
def energy(r, i, j):
    return -mass[i] * mass[j] / ti.sqrt(r.norm_sqr() + SOFT * SOFT)


def disc(center: np.ndarray, velocity: np.ndarray, tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of a core and of stars on circles around it, in a plane tilted about x."""
    k = np.arange(STARS)
    r, turn = 0.25 + 0.85 * np.sqrt((k + 0.5) / STARS), 2 * np.pi * tv.golden(k)
    speed = r * np.sqrt(CORE) / (r * r + SOFT * SOFT) ** 0.75
    flat = np.stack([r * np.cos(turn), r * np.sin(turn), 0 * r], axis=1)
    along = np.stack([-np.sin(turn), np.cos(turn), 0 * r], axis=1) * speed[:, None]
    c, s = np.cos(tilt), np.sin(tilt)
    about = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    x, v = (np.concatenate([[[0.0, 0, 0]], part @ about.T]) for part in (flat, along))
    return x + center, v + velocity


def build() -> tv.World:
    """Make two discs on a parabola around each other, with a closest approach of 1.2 between the cores."""
    near, far, total = 1.2, 4.0, 2 * CORE
    speed, aside = np.sqrt(2 * total / far), np.sqrt(2 * total * near) / far  # energy 0; angular momentum of the closest approach
    center, way = np.array([far / 2, 0, 0]), np.array([-np.sqrt(speed**2 - aside**2) / 2, aside / 2, 0])
    one, other = disc(center, way, 0.4), disc(-center, -way, -0.9)
    x, v = (np.concatenate(parts) for parts in zip(one, other, strict=True))
    m = np.full(len(x), 1e-4)
    m[[0, STARS + 1]] = CORE
    global mass
    tv.init()
    mass = ti.field(ti.f32, shape=len(m))
    mass.from_numpy(m.astype(np.float32))
    particles = tv.Particles(x, velocity=v, mass=m, radius=np.where(m == CORE, 0.1, 0.04))
    return tv.World(particles, [tv.PairForce(gravity, potential=energy)], substeps=2)


def main(path: str = "galaxy.rrd", *, seconds: float = 9.0) -> None:
    """Simulate, record, and check the conserved quantities."""
    world = build()
    m, start = world.particles.mass, world.particles.velocity
    scale = m @ np.linalg.norm(start, axis=1)
    with tv.Recorder(path, world, every=2, overwrite=True, color=("speed", 0.0, 1.8)) as recorder:
        before = world.step(1 / 60).energy
        for _ in range(round(60 * seconds)):
            report = world.step(1 / 60)
            recorder.log()
    drift = abs(report.energy - before) / abs(before)
    lost = np.abs(m @ (world.velocity - start)).max() / scale
    a, b = (world.position[[core]] for core in (0, STARS + 1))
    nearest = np.minimum(np.linalg.norm(world.position - a, axis=1), np.linalg.norm(world.position - b, axis=1))
    torn = float((nearest > 1.2).mean())  # discs end at 1.1
    print(f"{path}: energy kept to {drift:.1e}, momentum to {lost:.1e}, {100 * torn:.0f} % of the stars are in bridge and tails")
    if drift > 1e-3 or lost > 1e-5 or (seconds > 8 and torn < 0.2):
        raise SystemExit("something was lost between the stars")


if __name__ == "__main__":
    main(*sys.argv[1:2])
