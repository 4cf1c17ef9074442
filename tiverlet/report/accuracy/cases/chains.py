"""Pendulums, chains and spinning rods: rigid and elastic links in motion."""

import numpy as np

from ....constraints import Distance
from ....forces import Gravity
from ....particles import Particles
from .case import Case, Limits, Run, Scene, ends_at, known, links, pendulum, rms, spin, upright

CHAIN = ("Direct", "Jacobi")


def hung(name: str) -> tuple[Particles, tuple[Gravity, Distance]]:
    """Build the planar chain of an entry, with its first particle as the anchor."""
    p = known(name)["params"]
    if name.startswith("D06"):  # "100 x 0.01", "all 90"
        p = {**p, "theta0_deg": [90.0] * 100, "lengths": [0.01] * 100, "masses": [0.01] * 100}
    if name.startswith("S03"):  # "10 x 0, 90, 10 x 180 deg"
        n = p["links"]
        p = {**p, "theta0_deg": [0.0] * 10 + [90.0] + [180.0] * 10, "lengths": [p["l"]] * n, "masses": [p["m"]] * n}
    angle = np.radians(p["theta0_deg"])
    steps = np.stack([np.sin(angle), -np.cos(angle)], axis=1) * np.array(p["lengths"])[:, None]
    x = np.vstack([[0, 0], np.cumsum(steps, axis=0)])
    start = Particles(x, mass=np.r_[1.0, p["masses"]], pinned=[0])
    return start, (Gravity(p["g"]), Distance(links(len(angle))))


def swings(name: str, t: float, limit: Limits, **more) -> Case:
    """Return the case of a planar chain: the positions of all its particles, or those that the entry lists, at time t."""
    values = known(name)["values"][f"t{t}"]
    if "tip_xy" in values:
        at, want = [11, 21], [values["node11_xy"], values["tip_xy"]]
    elif "heavy_xy" in values:
        at, want = [2], [values["heavy_xy"]]
    else:
        want = np.atleast_2d(values["xy"])
        at = list(values.get("nodes_1based", range(1, len(want) + 1)))
    if name.startswith("D08"):  # only the heavy end, because the light links vibrate
        at, want = at[-1:], want[-1:]
    size = 0.5 * np.abs(hung(name)[0].position).max()
    error = ends_at(at, want)
    return Case(name, known(name)["title"], lambda: hung(name), t, error, limit, size, **{"methods": CHAIN, **more})


def skew() -> Scene:
    """Build S02: a chain of five links in 3D."""
    p = S02["params"]
    return Particles(p["x0"], mass=np.r_[1.0, p["masses"]], pinned=[0]), [Gravity(p["g"]), Distance(links(5))]


def released(angle: float) -> Scene:
    """Build a pendulum of 1 m, released at `angle` [rad] from the vertical."""
    return pendulum((np.sin(angle), -np.cos(angle)), 0.0, Gravity(9.81))


def period_error(run: Run) -> float:
    """Return the relative error of the period: after a quarter of it the pendulum should pass its lowest point."""
    x, v = run.world.position[1], run.world.velocity[1]
    return abs(float(np.arctan2(x[0], -x[1]) / (v[0] * run.times[-1])))


def rod(omega: float, masses: tuple[float, float], dim: int = 2) -> Scene:
    """Build R08 or S09: two masses on a rod of 1 m that spins about their centre of mass."""
    a, b = masses[1] / sum(masses), -masses[0] / sum(masses)
    x, v = np.zeros((2, dim)), np.zeros((2, dim))
    x[:, 0], v[:, 1] = (a, b), (omega * a, omega * b)
    return Particles(x, velocity=v, mass=masses), [Distance([[0, 1]])]


def spun(name: str, omega: float, masses: tuple[float, float], seconds: float, limit: Limits, **more) -> Case:
    """Return the case of a free rod: the ends of the rod after `seconds`, at an angle of omega t."""
    a = omega * seconds
    arm = np.array([masses[1], -masses[0]]) / sum(masses)
    want = arm[:, None] * [np.cos(a), np.sin(a)]
    build, error = (lambda: rod(omega, masses)), ends_at([0, 1], want)
    title = f"{known(name.partition(':')[0])['title'].partition(' (')[0]}, {omega:g} rad/s"
    return Case(name, title, build, seconds, error, limit, 0.5, methods=("Jacobi",), momentum=spin, **more)


def period(degrees: int, seconds: float, limit: Limits) -> Case:
    """Return a case of R06: the period at an amplitude of `degrees`, measured from a quarter of it."""
    angle, frame = np.radians(degrees), seconds / 160
    title = f"Pendulum, period of {degrees} degrees"
    return Case(
        f"R06_pendulum_period:{degrees}", title, lambda: released(angle), seconds / 4, period_error, limit, 0.1,
        "relative", frame, methods=("Jacobi",),
    )  # fmt: skip


def state(degrees: int, t: int, limit: Limits) -> Case:
    """Return a case of R06b: the position of the pendulum after t seconds."""
    v, angle = known("R06b_pendulum_state")["values"][f"{degrees}deg_t{t}"], np.radians(degrees)
    title = f"Pendulum of {degrees} degrees after {t} s"
    error = ends_at([1], [[v["x"], v["y"]]])
    return Case(f"R06b_pendulum_state:{degrees}", title, lambda: released(angle), t, error, limit, 0.5)


PERIODS = known("R06_pendulum_period")["values"]["period"]
S01, S02, S04, R07 = map(known, ("S01_spherical_pendulum", "S02_chain5_3d", "S04_spring_pendulum", "R07_conical_pendulum"))
HEAVY = {"efforts": (20, 80, 320, 640, 1280, 2560, 5120), "at": 320, "fit": (1280, 2560, 5120)}

CASES = [
    swings("D01_double_pendulum", 2.0, (1e-5, 2e-5)),
    swings("D02_double_pendulum_low", 5.0, (5e-6, 5e-6)),
    swings("D03_mueller_triple", 1.0, (1.4e-4, 1.4e-4)),
    swings("D04_mueller_heavy", 0.5, (5e-6, 5e-6)),
    swings("D05_chain10", 0.5, (1.15e-5, 1.2e-5)),
    swings("D06_chain100", 0.5, (1.25e-4, 1.25e-4), efforts=(10, 20, 40, 80, 160, 320, 640), fit=(80, 160, 320, 640)),
    swings("D07_massratio_1000", 0.5, (4e-6, 4e-6)),
    swings("D07_massratio_10000", 0.5, (3e-8, 3e-7), **HEAVY),
    swings("D07_massratio_100000", 0.5, (5e-8, 3e-7), **HEAVY),
    swings(
        "D07_massratio_1000000", 0.5, (2e-8, 3e-7), efforts=(80, 320, 1280, 5120, 10240, 20480), at=320, fit=(5120, 10240, 20480)
    ),
    swings("D08_massratio10", 0.5, (1e-5, 1e-5)),
    swings("D09_massratio_inverted", 0.5, (1e-5, 1e-5)),
    Case(
        "S01_spherical_pendulum", "Spherical pendulum",
        lambda: pendulum(S01["params"]["x0"], S01["params"]["v0"], Gravity(S01["params"]["g"])), 10.0,
        ends_at([1], [S01["values"]["t10.0"]["xyz"]]), (1.8e-5, 4e-5), methods=CHAIN, momentum=upright,
    ),
    Case(
        "S02_chain5_3d", "Skew chain of 5 links in space", skew, 1.0,
        ends_at(slice(1, None), S02["values"]["t1.0"]["xyz"]), (1.3e-4, 1.3e-4), methods=CHAIN, momentum=upright,
    ),
    swings("S03_folded_chain", 0.3, (5e-5, 5e-5)),
    Case(
        "S04_spring_pendulum", "Elastic pendulum",
        lambda: pendulum(
            S04["params"]["x0"], 0.0, Gravity(S04["params"]["g"]), rest=S04["params"]["L"], compliance=S04["params"]["alpha"]
        ), 5.0, ends_at([1], [S04["values"]["t5.0"]["xy"]]), (1.2e-6, 3e-6),
    ),
    spun("S09_spinning_rod_decay", 10.0, (1.0, 1.0), 10.0, (2e-3, 2e-3)),
    spun("R08_spinning_dumbbell", 50.0, (1.0, 3.0), 1.0, (2e-2, 2e-2)),
    period(10, PERIODS["10deg"], (5e-7, 5e-7)),
    period(90, PERIODS["90deg"], (2e-6, 2e-6)),
    period(170, PERIODS["170deg"], (1e-5, 1e-5)),
    state(90, 10, (5e-5, 1e-4)),
    Case(
        "R07_conical_pendulum", "Conical pendulum",
        lambda: pendulum(
            (R07["values"]["radius"], -R07["values"]["depth"], 0), (0, 0, R07["values"]["speed"]), Gravity(R07["params"]["g"])
        ), 10.0,
        lambda run: rms(run.world.position[1, [0, 2]], [R07["values"][k] for k in ("x_t10", "z_t10")]), (4e-5, 4e-5),
        momentum=upright,
    ),
]  # fmt: skip
