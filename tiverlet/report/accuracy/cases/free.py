"""Free particles, and particles on springs: falls, orbits, oscillators and modes of chains."""

from typing import Any

import numpy as np

from ....constraints import Area, Distance, ShapeMatch
from ....device import ti
from ....forces import Attractor, Drag, Force, Gravity
from ....particles import Particles
from ....shapes import net, polygon
from .case import Case, Limits, Scene, ends_at, known, links, pendulum, sideways, single, spin


def fall(name: str) -> Case:
    """Return a case of R01: constant acceleration, for which position Verlet with half a kick at the start is exact."""
    p = known(name)["params"]
    t = p["steps"] * p["dt"]
    y = p["y0"] + p["v0"] * t - p["g"] * t * t / 2
    return Case(
        name, f"Free fall in frames of {p['dt']:g} s",
        lambda: single((0.0, p["y0"]), (0, p["v0"]), Gravity(p["g"])), t, ends_at([0], [[0, y]]), (1e-12, 2e-5), 1.0,
        frame=p["dt"], efforts=(1, 2, 4, 8), order=None, at=1,
    )  # fmt: skip


def thrown() -> Scene:
    """Build R02: a projectile in 3D."""
    p = known("R02_projectile")["params"]
    e, a = np.radians(p["elevation_deg"]), np.radians(p["azimuth_deg"])
    v = p["speed"] * np.array([np.cos(e) * np.cos(a), np.sin(e), np.cos(e) * np.sin(a)])
    return single((0, p["y0"], 0), v, Gravity(p["g"]))


def dragged() -> Scene:
    """Build R03: a projectile with linear drag."""
    p = known("R03_linear_drag")["params"]
    return single((0.0, 0.0), (p["vx0"], p["vy0"]), Gravity(p["g"]), Drag(p["k"]))


@ti.func
def _soft_spring(x):
    """Return the force of a spring of 100 N/m."""
    return -100.0 * x


@ti.func
def _hard_spring(x):
    """Return the force of a spring of 10000 N/m."""
    return -10000.0 * x


def rings(name: str, spring, seconds: float, limit: Limits, **more) -> Case:
    """Return a case of R04: the user's own spring. Its error is that of Verlet's frequency, 2 asin(omega h / 2) / h."""
    p = known(name)["params"]
    want = p["x0"] * np.cos(np.sqrt(p["k"] / p["m"]) * seconds)
    return Case(
        name, f"Oscillator by a force of the user's, {p['k']:g} N/m", lambda: single((p["x0"], 0.0), 0.0, Force(spring)),
        seconds, ends_at([0], [[want, 0.0]]), limit, p["x0"], conserves=False, **more,
    )  # fmt: skip


def sprung(name: str, seconds: float, limit: Limits) -> Case:
    """Return a case of R04b: a compliant link between an anchor and a mass; with XPBD the amplitude decays to nothing."""
    p = known(name)["params"]
    want = 1.0 + 0.1 * np.cos(np.sqrt(p["k"] / p["m"]) * seconds)
    return Case(
        name, f"Oscillator by a compliant link, {p['k']:g} N/m",
        lambda: pendulum((1.1, 0), mass=p["m"], rest=1.0, compliance=p["alpha"]), seconds, ends_at([1], [[want, 0]]), limit, 0.2,
    )  # fmt: skip


def dashpot() -> Scene:
    """Build R05: a spring with a dashpot."""
    p = known("R05_damped_oscillator")["params"]
    return pendulum((1 + p["x0"], 0), mass=p["m"], rest=1.0, compliance=1 / p["k"], damping=p["c"])


def orbit(e: str, limit: Limits, **more) -> Case:
    """Return a case of R09: Kepler's orbit after 10 s. e: the key of its eccentricity, such as "e0.5"."""
    states = known("R09_kepler")["values"]["states"]
    s, want = states[f"{e}_start"], states[f"{e}_t10"]
    return Case(
        f"R09_kepler:{e}", f"Kepler's orbit of eccentricity {e[1:]}",
        lambda: single((s["x"], s["y"]), (s["vx"], s["vy"]), Attractor((0, 0), 1.0)), 10.0,
        ends_at([0], [[want["x"], want["y"]]]), limit, 1.0, momentum=spin, **more,
    )  # fmt: skip


def mode(j: int, limit: Limits) -> Case:
    """Return a case of R12: mode j of a chain of springs between two walls, which keeps its amplitude."""
    p, values = known("R12_chain_modes")["params"], known("R12_chain_modes")["values"]["modes"]["dt0.001"]
    n, seconds = p["N"], 2.0
    x = np.stack([np.arange(n + 2.0), np.zeros(n + 2)], axis=1)
    u = np.sin(j * np.pi * np.arange(n + 2) / (n + 1))[:, None] * [0.01, 0.0]
    u[-1] = 0
    want = x + np.cos(values[f"mode{j}"]["omega"] * seconds) * u

    start = Particles(x + u, mass=p["m"], pinned=[0, n + 1])
    return Case(
        f"R12_chain_modes:{j}", f"Mode {j} of a chain of {n} masses on springs",
        lambda: (start, [Distance(links(n + 1), p["rest"], compliance=p["alpha"])]), seconds, ends_at(slice(None), want), limit,
        0.01, methods=("Direct", "Jacobi"),
    )  # fmt: skip


def sway(n: int, limit: Limits) -> Case:
    """Return a case of R13: the slowest transverse mode of a hanging chain of n links, with an amplitude of 0.1 mm."""
    omega, seconds = known("R13_hanging_chain_modes")["values"][f"N{n}"]["omega1"], 5.0
    tension = np.arange(n, 0, -1) * 9.81 * n  # over the length of a link, with mass 1
    K = np.diag(tension + np.append(tension[1:], 0)) - np.diag(tension[1:], 1) - np.diag(tension[1:], -1)
    u = np.concatenate([[0.0], np.linalg.eigh(K)[1][:, 0]])
    x = np.stack([1e-4 * u / np.abs(u).max(), np.zeros(n + 1)], axis=1)
    x[1:, 1] = -np.cumsum(np.sqrt(1 / n**2 - np.diff(x[:, 0]) ** 2))
    want, start = np.cos(omega * seconds), Particles(x, pinned=[0])
    return Case(
        f"R13_hanging_chain_modes:N{n}", f"Slowest mode of a hanging chain of {n} links",
        lambda: (start, [Gravity(9.81), Distance(links(n), 1 / n)]), seconds,
        lambda run: abs(float(run.world.position[:, 0] @ u / (x[:, 0] @ u)) - want), limit, 1.0, "relative",
        methods=("Direct", "Jacobi"), trusted=1e-8, conserves=False,
    )  # fmt: skip


def racket() -> Scene:
    """Build S05: a rigid cluster that tumbles about its intermediate axis."""
    p = known("S05_tennis_racket")["params"]
    x = np.repeat(np.diag(p["half_axes"]), 2, axis=0) * np.array([1, -1] * 3)[:, None]
    return Particles(x, velocity=np.cross(p["omega0_body"], x)), [ShapeMatch([np.arange(6)])]


def ring() -> Scene:
    """Build R25: a soft ring of 12 links around a rigid area, released out of shape."""
    n = 12
    rim = polygon((0.0, 0.0), 1.0, n)
    edges = Distance(rim.links, 2 * np.sin(np.pi / n), compliance=1e-2)
    area = Area(rim.loops, known("R25_polygon_area")["values"]["n12"]["area"])
    return Particles(rim.position * [1.2, 1 / 1.2]), [area, edges, Drag(2.0)]


def swollen(run) -> float:
    """Return the relative error of the area of the ring."""
    area = run.world.features[0]
    return abs(float(area.rest_of(run.world.position)[0] / area.rest[0]) - 1)


def thrown_net() -> Scene:
    """Build a net of unequal masses, soft in places, that flies and tumbles."""
    rng, flat = np.random.default_rng(4), net((0, 0), (5, 0), (0, 5), (6, 6))
    x = flat.position + rng.uniform(-0.1, 0.1, (36, 2))
    v, mass = rng.normal(size=(36, 2)) + [2.0, 5.0], np.exp(rng.uniform(0, np.log(100), 36))
    alpha: Any = np.where(np.arange(60) % 3 == 0, 1e-3, 0.0)
    return Particles(x, velocity=v, mass=mass), [Gravity(9.81), Distance(flat.links, 1.0, compliance=alpha)]


def parabola_error(run) -> float:
    """Return the distance of the centre of mass from its parabola [m]."""
    p, t = run.world.particles, run.times[-1]
    share = p.mass / p.mass.sum()
    return float(np.linalg.norm(share @ (run.world.position - p.position - p.velocity * t) - [0, -9.81 * t * t / 2]))


R02, R03, R05 = (known(f"{n}")["values"] for n in ("R02_projectile", "R03_linear_drag", "R05_damped_oscillator"))
S05 = known("S05_tennis_racket")["values"]["t2.0"]
EXACT = {"order": None, "efforts": (1, 2, 4, 8), "at": 2}

CASES = [
    Case(
        "M01_thrown_net", "Centre of mass of a net that is thrown", thrown_net, 1.0, parabola_error, (1e-11, 5e-6), order=None,
        momentum=sideways, conserves=False,
    ),
    Case(
        "S05_tennis_racket", "Tennis racket: six masses that tumble", racket, 2.0,
        ends_at([0, 2], [S05["particle1_xyz"], S05["particle3_xyz"]]), (3e-5, 3e-5), momentum=spin,
    ),
    fall("R01_free_fall_dt0.01"),
    fall("R01_free_fall_dt0.001"),
    Case(
        "R02_projectile", "Projectile", thrown, R02["t_flight"], ends_at([0], [[R02["x_end"], 0.0, R02["z_end"]]]),
        (1e-12, 2e-5), 1.0, frame=R02["t_flight"] / 100, **EXACT,
    ),
    Case(
        "R03_linear_drag", "Projectile with linear drag", dragged, 2.0, ends_at([0], [[R03["x"], R03["y"]]]), (1e-12, 2e-5), 1.0,
        conserves=False, **EXACT,
    ),
    rings("R04_oscillator_k100_dt0.01", _soft_spring, 10.0, (2e-4, 2e-4)),
    rings("R04_oscillator_k10000_dt0.001", _hard_spring, 1.0, (4e-3, 4e-3), efforts=(10, 20, 40, 80, 160)),
    sprung("R04b_xpbd_oscillator_decay_k100", 10.0, (1e-4, 1e-4)),
    sprung("R04b_xpbd_oscillator_decay_k1000", 2.0, (4e-4, 4e-4)),
    Case(
        "R05_damped_oscillator", "Spring with a dashpot", dashpot, 1.0, ends_at([1], [[1 + R05["x_T"], 0.0]]), (4e-5, 4e-5), 0.3,
        conserves=False,
    ),
    orbit("e0", (1e-5, 4e-5)),
    orbit("e0.5", (1e-4, 2e-4)),
    orbit("e0.9", (1e-4, 1e-3), efforts=(20, 40, 80, 160, 320), at=320, fit=(80, 160, 320)),
    mode(1, (5e-7, 2e-6)),
    mode(5, (5e-5, 5e-5)),
    sway(5, (2e-5, 2e-5)),
    sway(20, (5e-6, 1e-5)),
    Case("R25_polygon_area", "Soft ring around a rigid area", ring, 4.0, swollen, (5e-7, 5e-7), 0.1, "relative", conserves=False,
         methods=("Jacobi", "Jacobi x 10"), order=None),
]  # fmt: skip
