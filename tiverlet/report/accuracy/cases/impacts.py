"""Collisions, bounces and friction, compared with closed forms, which hold for any step."""

import numpy as np

from ....colliders import Box, HalfSpace
from ....contact import Contact
from ....forces import Drag, Gravity
from ....particles import Particles
from .case import Case, Limits, Run, Scene, known, rms, sideways


def head_on(m1: float, m2: float, u1: float, u2: float, e: float, limit: Limits) -> Case:
    """Return a case of R14: the velocities of two balls after a collision head on."""
    start = Particles([[-0.3, 0], [0.3, 0]], velocity=[[u1, 0], [u2, 0]], mass=(m1, m2), radius=0.1)
    key = f"m{m1:g}_{m2:g}_u{u1:g}_{u2:g}_e{e:g}"
    v = known("R14_collision_1d")["values"][key]
    title = f"Head-on collision, masses {m1:g} and {m2:g}, e = {e:g}"
    return Case(
        f"R14_collision_1d:{key}", title, lambda: (start, [Contact(restitution=e)]), 0.4,
        lambda run: rms(run.world.velocity, [[v["v1"], 0], [v["v2"], 0]]), limit, u1, "m/s", efforts=(5, 10, 20, 40),
        order=None, momentum=sideways, conserves=e == 1,
    )  # fmt: skip


def glanced() -> Scene:
    """Build R15: a disc that hits another off center."""
    p = known("R15_oblique_discs")["params"]
    start = Particles([[-0.4, p["b"]], [0, 0]], velocity=[[p["u"], 0], [0, 0]], radius=p["r"])
    return start, [Contact(restitution=1.0)]


def turned(run: Run) -> float:
    """Return the largest error of the directions after the collision [rad]."""
    want = np.array([known("R15_oblique_discs")["values"]["e1"][k] for k in ("v1", "v2")]) * [1, -1]  # b is counted downwards
    v = run.world.velocity
    return float(np.abs(np.arctan2(v[:, 1], v[:, 0]) - np.arctan2(want[:, 1], want[:, 0])).max())


def bounces(e: float, limit: Limits) -> Case:
    """Return a case of R16: the relative errors of the first three bounce heights, from the parabolas between impacts."""
    want = np.array(known(f"R16_bounce_e{e}")["values"]["heights"][:3])
    times = known(f"R16_bounce_e{e}")["values"]["impact_times"]
    start = Particles([[0.0, 1.1]], radius=0.1)

    def error(run: Run) -> float:
        """Return the largest relative error of the heights between impacts."""
        y, v, t = np.array([s[0] for s in run.seen]), np.array([s[1] for s in run.seen]), np.array(run.times)
        found = []
        for a, b in zip(times, times[1:], strict=False):
            k = int(np.argmin(np.abs(t - (a + b) / 2)))  # in free flight the apex is at y + v^2 / 2g
            found.append(y[k] + v[k] ** 2 / (2 * 9.81))
        return float(np.abs(np.array(found[:3]) / want - 1).max())

    return Case(
        f"R16_bounce_e{e}", f"Ball that bounces, e = {e}",
        lambda: (start, [Gravity(9.81), HalfSpace((0, 1), restitution=e)]), times[4],
        error, limit, 1.0, "relative", times[4] / 150,
        lambda w: np.array([w.position[0, 1] - 0.1, w.velocity[0, 1]]), efforts=(2, 5, 10, 20, 40), order=None, conserves=False,
    )  # fmt: skip


def cradle() -> Scene:
    """Build R17: five balls in a row, the first of them moving."""
    p = known("R17_newton_cradle")["params"]
    x = np.zeros((p["n"], 2))
    x[:, 0] = np.arange(p["n"]) * (2 * p["r"] + p["gap"])
    x[0, 0] -= 0.1
    return Particles(x, velocity=[[1.0, 0]] + [[0, 0]] * 4, radius=p["r"]), [Contact(restitution=1.0)]


def slides(degrees: int, mu: float, speed: int, limit: Limits) -> Case:
    """Return a case of R18: a disc on an incline, the distance until it stops, or in a second."""
    key = f"{degrees}deg_mu{mu:g}_v{speed}"
    v = known("R18_incline_friction")["values"][key]
    stops, a = v["state"] != "slides", np.radians(degrees)
    want = v["stop_distance"] if stops else v["distance_1s"]
    way, up = np.array([np.cos(a), -np.sin(a)]), np.array([np.sin(a), np.cos(a)])
    start = Particles([0.1 * up], velocity=speed * way, radius=0.1)

    def error(run: Run) -> float:
        """Return the relative error of the sliding distance."""
        return abs(float((run.world.position[0] - run.world.particles.position[0]) @ way) / want - 1)

    return Case(
        f"R18_incline_friction:{key}", f"Incline of {degrees} degrees, friction {mu:g}, {speed} m/s",
        lambda: (start, [Gravity(9.81), HalfSpace(up, friction=mu)]), 3.0 if stops else 1.0, error,
        limit, 1.0, "relative", efforts=(2, 5, 10, 20, 40), order=None, conserves=False,
    )  # fmt: skip


def round_hill() -> Scene:
    """Build R19: a disc that slides off a smooth one, from 0.05 rad."""
    start = Particles([[0, 0], [np.sin(0.05), np.cos(0.05)]], radius=[0.9, 0.1], pinned=[0])
    return start, [Gravity(9.81), Contact()]


def leaves(run: Run) -> float:
    """Return the error of the angle at which the disc leaves [degrees].

    The known angle has cos = 2/3 cos(0.05). In flight v_x^2 = g R cos^3 of the angle of departure, with R = 1 m.
    """
    angle = np.arccos(np.cbrt(run.world.velocity[1, 0] ** 2 / 9.81))
    return abs(float(np.degrees(angle - np.arccos(2 / 3 * np.cos(0.05)))))


def column() -> Scene:
    """Build R21: ten discs on top of each other."""
    x = np.stack([np.full(10, 0.5), 0.5 + np.arange(10.0)], axis=1)
    return Particles(x, radius=0.5), [Gravity(9.81), Drag(8.0), Contact(), Box((0, 0), (1, np.inf))]


def carried(run: Run) -> float:
    """Return the largest relative error of the contact forces.

    The k-th contact from the top carries k m g, less the share that drag takes in the substep.
    """
    c, h = run.world.contacts, run.times[0] / run.reports[-1].substeps
    if len(c.pairs) < 9:
        return np.inf
    phi = -np.expm1(-8 * h) / (8 * h)
    return float(np.abs(np.sort(c.impulse)[-9:] / h / (9.81 * phi * np.arange(1, 10)) - 1).max())


CASES = [
    head_on(1, 3, 2, -1, 0.5, (1e-12, 5e-8)),
    head_on(1, 1000, 5, 0, 1, (1e-12, 1e-6)),
    Case("R15_oblique_discs", "Oblique collision of two discs", glanced, 0.6, turned, (1e-12, 5e-7), 1.0, "rad", order=None,
         momentum=sideways),
    bounces(0.5, (1e-12, 5e-6)),
    bounces(0.8, (1e-12, 4e-6)),
    bounces(0.9, (1e-12, 3e-6)),
    Case("R17_newton_cradle", "Newton's cradle with gaps of 1 mm", cradle, 0.2,
         lambda run: rms(run.world.velocity[:, :1], [[0.0], [0], [0], [0], [1]]), (1e-12, 1e-12), 1.0, "m/s", 0.01,
         efforts=(2, 5, 10, 20, 40), order=None, momentum=sideways),
    slides(10, 0.5, 3, (2e-7, 2e-5)),
    slides(30, 0.5, 0, (1e-12, 1e-5)),
    Case("R19_sphere_departure", "Sliding off a smooth disc", round_hill, 1.4, leaves, (2e-4, 2e-4), 30.0, "degrees", order=None,
         conserves=False),
    Case("R21_stack_N", "Column of ten discs: forces at rest", column, 6.0, carried, (1e-12, 2e-6), 1.0, "relative",
         efforts=(5, 10, 20, 40), order=None, conserves=False),
]  # fmt: skip
